"""What the sums of a region's votes say (eq. 2-10, 18): its shape, its thickness, its normal.

Those of a voxel, or of as many voxels, are taken eight side by side, in vector registers: one after
the other each would wait for the roots and quotients of the one before.
"""

from __future__ import annotations

import numpy as np

from facet.mapping.eigen import eigenvalues, eigenvector
from facet.mapping.kernel import kernel

ABREAST = 8  # sums side by side
PLACES = 2 * ABREAST  # sums that there is room for
LAMBDA, TAN_GAMMA, NX, NY, NZ, XX, YY, ZZ, XY, XZ, YZ = range(0, 11 * PLACES, PLACES)  # where what
# they say, and their covariance, begins: one array, so that it is known that nothing overlaps
PRINCIPAL = YZ + PLACES  # numbers of that array


@kernel(allocates=False, inlined=True)
def _covariance(sums):  # type: ignore[no-untyped-def]
    """(xx, yy, zz, xy, xz, yz) of the votes, population form (eq. 3), (1/8 voxel)^2."""
    one = 1.0 / sums[1]
    mx, my, mz = sums[2] * one, sums[3] * one, sums[4] * one
    return (
        sums[5] * one - mx * mx,
        sums[8] * one - my * my,
        sums[10] * one - mz * mz,
        sums[6] * one - mx * my,
        sums[7] * one - mx * mz,
        sums[9] * one - my * mz,
    )


@kernel(allocates=False, inlined=True)
def _analyse(a, b, c, d, e, f, floor2):  # type: ignore[no-untyped-def]
    """(lambda of eq. 18, tan gamma of eq. 9, both of floored variances; normal) of a covariance."""
    first, second, third = eigenvalues(a, b, c, d, e, f)
    s1, s2, s3 = max(first, floor2), max(second, floor2), max(third, floor2)
    ratio = s2 / np.sqrt(s1 * s3)
    tan_gamma = 1.1547005383792515 * np.sqrt(s3 / np.sqrt(s1 * s2))
    return ratio, tan_gamma, *eigenvector(a, b, c, d, e, f, third)


@kernel(allocates=False)
def analyse(kept, e, floor2, principal):  # type: ignore[no-untyped-def]
    """What the sums kept[e] say, to principal[LAMBDA + e] .. principal[NZ + e]."""
    ratio, tan_gamma, nx, ny, nz = _analyse(*_covariance(kept[e]), floor2)
    principal[LAMBDA + e], principal[TAN_GAMMA + e] = ratio, tan_gamma
    principal[NX + e], principal[NY + e], principal[NZ + e] = nx, ny, nz


@kernel(allocates=False)
def analyse_all(kept, count, floor2, principal):  # type: ignore[no-untyped-def]
    """What the sums kept[:count] say."""
    for e in range(count):
        put(kept[e], e, principal)
    solve(count, floor2, principal)


@kernel(allocates=False, inlined=True)
def put(sums, e, principal):  # type: ignore[no-untyped-def]
    """Put the covariance of sums at a place: `solve` tells what they say."""
    a, b, c, d, f, g = _covariance(sums)
    principal[XX + e], principal[YY + e], principal[ZZ + e] = a, b, c
    principal[XY + e], principal[XZ + e], principal[YZ + e] = d, f, g


@kernel(allocates=False, inlined=True)
def take_over(source, at, principal, e):  # type: ignore[no-untyped-def]
    """What was found at a place of another array, to a place."""
    for column in (LAMBDA, TAN_GAMMA, NX, NY, NZ):
        principal[column + e] = source[column + at]


@kernel(allocates=False)
def solve(count, floor2, principal):  # type: ignore[no-untyped-def]
    """What was put at the places up to `count` says, and what lies behind them up to a full set of
    lanes: that is nonsense, and as fast."""
    for e in range((count + ABREAST - 1) // ABREAST * ABREAST):
        ratio, tan_gamma, nx, ny, nz = _analyse(
            principal[XX + e], principal[YY + e], principal[ZZ + e],
            principal[XY + e], principal[XZ + e], principal[YZ + e], floor2,
        )  # fmt: skip
        principal[LAMBDA + e], principal[TAN_GAMMA + e] = ratio, tan_gamma
        principal[NX + e], principal[NY + e], principal[NZ + e] = nx, ny, nz
