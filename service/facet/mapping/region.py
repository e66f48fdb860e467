"""The votes of a cubic region, and their sums. What these say: `principal`.

Votes lie in short columns of 16-bit integers, with what decides whether they count; every radius,
side and slab is one pass over these, sixteen votes at a time. All sums are integers, so their order
never matters.
"""

from __future__ import annotations

import numpy as np

from facet.mapping.bits import population
from facet.mapping.halo import IN_VIEW, IN_X, IN_Y, IN_Z, WEIGHT_IN_X, rows_within
from facet.mapping.kernel import kernel
from facet.mapping.lanes import (
    LANES,
    add_products,
    larger,
    load,
    load_part,
    no_sums,
    splat,
    store,
    total,
)

FACED = 9  # columns of votes as a voxel sees them: centroids from its corner, 1/8 voxels; weights;
# views; -1 where these are of its side, else 0; how far it is to their voxels (Chebyshev)
X, Y, Z, WEIGHT, VIEW_X, VIEW_Y, VIEW_Z, SIDE, DISTANCE = range(FACED)
BEYOND = 127  # a distance farther than any
SUMS = 11  # number, weight, w x, y, z, w xx, xy, xz, yy, yz, zz


@kernel(allocates=False)
def face(taken, count, seen, i0, j0, k0, votes):  # type: ignore[no-untyped-def]
    """See the votes taken[:count], round a voxel at place (i0, j0, k0) in its halo, as that voxel
    does: votes (FACED, >= count + LANES).

    seen: its observable. A vote is of its side where their views differ by less than 120 degrees;
    where the voxel itself was seen from opposite sides, every vote is, until a normal is known."""
    vx, vy, vz = ((seen >> 16) & 31) - 8, ((seen >> 21) & 31) - 8, ((seen >> 26) & 31) - 8
    length2, any_side = vx * vx + vy * vy + vz * vz, splat(-((seen >> 31) & 1))
    for i in range(0, count, LANES):
        x, y = load_part(taken, i, IN_X), load_part(taken, i, IN_Y)
        z, view = load_part(taken, i, IN_Z), load_part(taken, i, IN_VIEW)
        store(votes[WEIGHT], i, x >> WEIGHT_IN_X)
        x = x & ((1 << WEIGHT_IN_X) - 1)
        i_place, j_place, k_place = x >> 4, y >> 4, z >> 4
        di, dj, dk = i_place - i0, j_place - j0, k_place - k0
        store(votes[DISTANCE], i, larger(larger(abs(di), abs(dj)), abs(dk)))
        store(votes[X], i, x - i_place * 8 - 8 * i0)
        store(votes[Y], i, y - j_place * 8 - 8 * j0)
        store(votes[Z], i, z - k_place * 8 - 8 * k0)
        ox, oy, oz = (view & 31) - 8, ((view >> 5) & 31) - 8, ((view >> 10) & 31) - 8
        store(votes[VIEW_X], i, ox)
        store(votes[VIEW_Y], i, oy)
        store(votes[VIEW_Z], i, oz)
        dot = ox * vx + oy * vy + oz * vz  # views are at most as long as (7, 7, 7)
        near = (dot >= 0) | (dot * dot <= ((ox * ox + oy * oy + oz * oz) * length2 >> 2))
        store(votes[SIDE], i, any_side | (near & (view >= 0)))
    store(votes[DISTANCE], count, splat(BEYOND))  # of what lies behind the last


@kernel(allocates=False)
def is_beside(seen, word):  # type: ignore[no-untyped-def]
    """Whether a vote is of the side of the voxel with observable `seen`, as `face` says."""
    if (seen >> 31) & 1 == 1:
        return True
    vx, vy, vz = ((seen >> 16) & 31) - 8, ((seen >> 21) & 31) - 8, ((seen >> 26) & 31) - 8
    ox, oy, oz = ((word >> 16) & 31) - 8, ((word >> 21) & 31) - 8, ((word >> 26) & 31) - 8
    dot = min(0, vx * ox + vy * oy + vz * oz)
    near = 4 * dot * dot <= (vx * vx + vy * vy + vz * vz) * (ox * ox + oy * oy + oz * oz)
    return near and (word >> 31) & 1 == 0


@kernel(allocates=False)
def is_one_pose(halo, margin, x, y, z, r, seen):  # type: ignore[no-untyped-def]
    """Whether all votes within r (at most `margin`) of the voxel x, y, z of the block, and of its
    side, come from one known line-scan pose. seen: its observable. The first few mostly tell."""
    edge, first_y, low, cube, before = rows_within(halo, margin, x, y, r)
    known = np.int32(0)
    for k in range(z + margin - r, z + margin + r + 1):
        for line in range(k * edge + first_y, k * edge + first_y + 2 * r + 1):
            row = halo.rows[line]
            start = halo.first[line] + np.int64(population(row & before))
            for i in range(start, start + np.int64(population((row >> low) & cube))):
                if is_beside(seen, np.int64(halo.words[i])):
                    if halo.poses[i] == 0 or (known != 0 and halo.poses[i] != known):
                        return False
                    known = halo.poses[i]
    return known != 0


@kernel(allocates=False, inlined=True)
def _add(sums, counts, votes, i):  # type: ignore[no-untyped-def]
    """Sums, and those of votes i .. i + LANES that count."""
    number, weight, sx, sy, sz, xx, xy, xz, yy, yz, zz = sums
    one, w = splat(1), load(votes[WEIGHT], i) & counts
    x, y, z = load(votes[X], i), load(votes[Y], i), load(votes[Z], i)
    wx, wy, wz = w * x, w * y, w * z
    return (
        add_products(number, one & counts, one),
        add_products(weight, w, one),
        add_products(sx, wx, one),
        add_products(sy, wy, one),
        add_products(sz, wz, one),
        add_products(xx, wx, x),
        add_products(xy, wx, y),
        add_products(xz, wx, z),
        add_products(yy, wy, y),
        add_products(yz, wy, z),
        add_products(zz, wz, z),
    )


@kernel(allocates=False)
def within(votes, count, r, out):  # type: ignore[no-untyped-def]
    """Sums (SUMS,) of the votes of the voxel's side within r."""
    sums = _nothing()
    for i in range(0, count, LANES):
        sums = _add(sums, (load(votes[DISTANCE], i) <= r) & load(votes[SIDE], i), votes, i)
    _write(sums, out)


@kernel(allocates=False)
def within_slab(votes, count, r, nx, ny, nz, own, half, out):  # type: ignore[no-untyped-def]
    """Sums (SUMS,) of the votes within r that were seen from the side of the normal, whole numbers,
    and whose centroid lies within `half` of n . c = own."""
    sums, most = _nothing(), min(np.int64(np.ceil(half)), 32767)  # n . c - own is a whole number
    for i in range(0, count, LANES):
        off = load(votes[X], i) * nx + load(votes[Y], i) * ny + load(votes[Z], i) * nz - own
        view = load(votes[VIEW_X], i), load(votes[VIEW_Y], i), load(votes[VIEW_Z], i)
        towards = view[0] * nx + view[1] * ny + view[2] * nz
        near = (load(votes[DISTANCE], i) <= r) & (abs(off) < most)
        sums = _add(sums, near & (towards > 0), votes, i)
    _write(sums, out)


@kernel(allocates=False, inlined=True)
def _nothing():  # type: ignore[no-untyped-def]
    """SUMS of no votes."""
    none = no_sums()
    return none, none, none, none, none, none, none, none, none, none, none


@kernel(allocates=False, inlined=True)
def _write(sums, out):  # type: ignore[no-untyped-def]
    number, weight, sx, sy, sz, xx, xy, xz, yy, yz, zz = sums
    out[0], out[1], out[2], out[3], out[4] = (
        total(number), total(weight), total(sx), total(sy), total(sz)
    )  # fmt: skip
    out[5], out[6], out[7] = total(xx), total(xy), total(xz)
    out[8], out[9], out[10] = total(yy), total(yz), total(zz)
