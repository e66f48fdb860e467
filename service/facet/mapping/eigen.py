"""Principal variances and directions of symmetric 3x3 matrices, inside kernels."""

from __future__ import annotations

import numpy as np

from facet.mapping.kernel import kernel

_THIRD, _SIXTH = 1.0 / 3.0, 1.0 / 6.0  # a product is there long before a quotient
_C = (  # cos(acos(h) / 3) on [0, 1] to 2e-9: a sum of products in pairs, that wait for few others
    0.866025405599564,
    0.1666663711445931,
    -0.04810444145461756,
    0.02460429680494765,
    -0.01510727520943827,
    0.009383330672620772,
    -0.004929691292929874,
    0.001764856947715879,
    -0.0003028542202729437,
)


@kernel(allocates=False, inlined=True)
def eigenvalues(a, b, c, d, e, f):  # type: ignore[no-untyped-def]
    """Eigenvalues, descending, of [[a, d, e], [d, b, f], [e, f, c]] (Smith 1961, closed form).

    The root furthest from the others is simple, so a step of Newton's finds it to the last bit; the
    other two solve the quadratic that is left. No libm: the same bits on every machine. No
    branches: a loop over several matrices takes them side by side."""
    q = (a + b + c) * _THIRD
    aa, bb, cc = a - q, b - q, c - q
    p2 = (aa * aa + bb * bb + cc * cc + 2.0 * (d * d + e * e + f * f)) * _SIXTH
    p = np.sqrt(p2)
    half = 0.5 * (aa * (bb * cc - f * f) - d * (d * cc - f * e) + e * (d * f - bb * e)) / (p2 * p)
    h = min(1.0, abs(half))
    h2 = h * h
    h4 = h2 * h2
    head = (_C[0] + _C[1] * h) + h2 * (_C[2] + _C[3] * h)
    tail = (_C[4] + _C[5] * h) + h2 * (_C[6] + _C[7] * h) + h4 * _C[8]
    t = head + h4 * tail
    t -= ((4.0 * t * t - 3.0) * t - h) / (12.0 * t * t - 3.0)
    spread = 1.7320508075688772 * np.sqrt(max(0.0, 1.0 - t * t))
    far, one, other = 2.0 * p * t, p * (t + spread), p * (t - spread)
    high, middle, low = (far, -other, -one) if half > 0.0 else (one, other, -far)
    same = p2 <= 1e-300
    return q if same else q + high, q if same else q + middle, q if same else q + low


@kernel(allocates=False, inlined=True)
def eigenvector(a, b, c, d, e, f, value):  # type: ignore[no-untyped-def]
    """Unit eigenvector of that matrix for a simple eigenvalue; (0, 0, 1) where none is clear."""
    x0, y0, z0 = a - value, d, e
    x1, y1, z1 = d, b - value, f
    x2, y2, z2 = e, f, c - value
    ux, uy, uz = y0 * z1 - z0 * y1, z0 * x1 - x0 * z1, x0 * y1 - y0 * x1
    vx, vy, vz = y0 * z2 - z0 * y2, z0 * x2 - x0 * z2, x0 * y2 - y0 * x2
    wx, wy, wz = y1 * z2 - z1 * y2, z1 * x2 - x1 * z2, x1 * y2 - y1 * x2
    uu = ux * ux + uy * uy + uz * uz
    vv = vx * vx + vy * vy + vz * vz
    ww = wx * wx + wy * wy + wz * wz
    second = (vv > uu) & (vv >= ww)
    third = (ww > uu) & (not second)
    ux, uy, uz = vx if second else ux, vy if second else uy, vz if second else uz
    ux, uy, uz = wx if third else ux, wy if third else uy, wz if third else uz
    longest = vv if second else ww if third else uu
    length = np.sqrt(longest)
    none = longest <= 1e-280
    return (
        0.0 if none else ux / length,
        0.0 if none else uy / length,
        1.0 if none else uz / length,
    )


@kernel(allocates=False)
def smallest(scatter):  # type: ignore[no-untyped-def]
    """(variance, nx, ny, nz, middle, largest) of a scatter (xx, xy, xz, yy, yz, zz)."""
    a, d, e, b, f, c = scatter[0], scatter[1], scatter[2], scatter[3], scatter[4], scatter[5]
    first, second, third = eigenvalues(a, b, c, d, e, f)
    nx, ny, nz = eigenvector(a, b, c, d, e, f, third)
    return third, nx, ny, nz, second, first
