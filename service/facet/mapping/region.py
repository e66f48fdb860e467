"""The votes of a cubic region, and their sums. What these say: `principal`.

Votes are unpacked once, to columns of 32-bit integers with what decides whether they count; every
radius, side and slab is then one pass over these short columns, eight votes at a time in vector
registers. All sums are integers, so their order never matters.
"""

from __future__ import annotations

import numpy as np

from facet.mapping.kernel import kernel

MOST = 8192  # votes of a region that are looked at: w x x of so many stay below 2^31
COLUMNS = 9  # x, y, z (1/8 voxel from the voxel's corner), weight, view x, y, z, distance,
# seen from the side of the voxel (1, 0)
SUMS = 11  # number, weight, w x, y, z, w xx, xy, xz, yy, yz, zz


@kernel(allocates=False)
def decode(lists, count, seen, x0, y0, z0, votes):  # type: ignore[no-untyped-def]
    """Unpack what was listed round a voxel at packed place (x0, y0, z0) with observable `seen` into
    votes (COLUMNS, MOST) int32. A vote is of the voxel's side where their views differ by less than
    120 degrees; where the voxel itself was seen from opposite sides, every vote is, until a normal
    is known."""
    words, places = lists[0], lists[2]
    vx = np.int32(((seen >> 16) & 31) - 8)
    vy = np.int32(((seen >> 21) & 31) - 8)
    vz = np.int32(((seen >> 26) & 31) - 8)
    length2 = np.int32(vx * vx + vy * vy + vz * vz)
    any_side = np.int32((seen >> 31) & 1)
    x, y, z, w = votes[0], votes[1], votes[2], votes[3]
    view_x, view_y, view_z = votes[4], votes[5], votes[6]
    distance, side = votes[7], votes[8]
    for i in range(count):  # few columns a loop: the compiler must see that they do not overlap
        word, place = words[i], places[i]
        x[i] = 8 * ((place & 255) - x0) + (word & 15)
        y[i] = 8 * (((place >> 8) & 255) - y0) + ((word >> 4) & 15)
    for i in range(count):
        word, place = words[i], places[i]
        z[i] = 8 * ((place >> 16) - z0) + ((word >> 8) & 15)
        w[i] = (word >> 12) & 15
    for i in range(count):
        place = places[i]
        dx = np.int32((place & 255) - x0)
        dy = np.int32(((place >> 8) & 255) - y0)
        dz = np.int32((place >> 16) - z0)
        distance[i] = max(abs(dx), abs(dy), abs(dz))
    for i in range(count):
        word = words[i]
        view_x[i] = ((word >> 16) & 31) - 8
        view_y[i] = ((word >> 21) & 31) - 8
    for i in range(count):
        view_z[i] = ((words[i] >> 26) & 31) - 8
        side[i] = any_side | _is_near(vx, vy, vz, length2, words[i])


@kernel(allocates=False)
def _is_near(vx, vy, vz, length2, word):  # type: ignore[no-untyped-def]
    """Whether (1, 0) the view of a vote, that was seen from one side, is near a view."""
    ox = np.int32(((word >> 16) & 31) - 8)
    oy = np.int32(((word >> 21) & 31) - 8)
    oz = np.int32(((word >> 26) & 31) - 8)
    dot = np.int32(min(0, np.int32(vx * ox + vy * oy + vz * oz)))
    near = np.int32(4 * dot * dot) <= np.int32(length2 * np.int32(ox * ox + oy * oy + oz * oz))
    return np.int32(near) & ((word >> 31) + 1)


@kernel(allocates=False)
def is_beside(seen, word):  # type: ignore[no-untyped-def]
    """Whether a vote is of the side of the voxel with observable `seen`, as `decode` says."""
    if (seen >> 31) & 1 == 1:
        return True
    vx = np.int32(((seen >> 16) & 31) - 8)
    vy = np.int32(((seen >> 21) & 31) - 8)
    vz = np.int32(((seen >> 26) & 31) - 8)
    return _is_near(vx, vy, vz, np.int32(vx * vx + vy * vy + vz * vz), np.int32(word)) == 1


@kernel(allocates=False)
def within(votes, count, r, sums):  # type: ignore[no-untyped-def]
    """Sums of the votes of the voxel's side within r."""
    x, y, z, w, distance, side = votes[0], votes[1], votes[2], votes[3], votes[7], votes[8]
    zero = np.int32(0)
    number, weight, sx, sy, sz = zero, zero, zero, zero, zero
    sxx, sxy, sxz, syy, syz, szz = zero, zero, zero, zero, zero, zero
    for i in range(count):
        one = np.int32(side[i] if distance[i] <= r else zero)
        number = np.int32(number + one)
        wi = np.int32(w[i] * one)
        weight = np.int32(weight + wi)
        wx, wy, wz = np.int32(wi * x[i]), np.int32(wi * y[i]), np.int32(wi * z[i])
        sx, sy, sz = np.int32(sx + wx), np.int32(sy + wy), np.int32(sz + wz)
        sxx = np.int32(sxx + np.int32(wx * x[i]))
        sxy = np.int32(sxy + np.int32(wx * y[i]))
        sxz = np.int32(sxz + np.int32(wx * z[i]))
        syy = np.int32(syy + np.int32(wy * y[i]))
        syz = np.int32(syz + np.int32(wy * z[i]))
        szz = np.int32(szz + np.int32(wz * z[i]))
    sums[0], sums[1], sums[2], sums[3], sums[4] = number, weight, sx, sy, sz
    sums[5], sums[6], sums[7], sums[8], sums[9], sums[10] = sxx, sxy, sxz, syy, syz, szz


@kernel(allocates=False)
def is_one_pose(lists, votes, count, r):  # type: ignore[no-untyped-def]
    """Whether all votes of the voxel's side within r come from one known line-scan pose."""
    poses, distance, side = lists[1], votes[7], votes[8]
    known = np.int32(0)
    for i in range(count):
        if side[i] == 1 and distance[i] <= r:
            if poses[i] == 0 or (known != 0 and poses[i] != known):
                return False
            known = poses[i]
    return known != 0


@kernel(allocates=False)
def within_slab(votes, count, r, nx, ny, nz, own, half, sums):  # type: ignore[no-untyped-def]
    """Sums of the votes within r that were seen from the side of the normal, whole numbers, and
    whose centroid lies within `half` of n . c = own."""
    x, y, z, w, distance = votes[0], votes[1], votes[2], votes[3], votes[7]
    view_x, view_y, view_z = votes[4], votes[5], votes[6]
    fx, fy, fz = np.float32(nx), np.float32(ny), np.float32(nz)
    middle, farthest = np.float32(own), np.float32(half)  # whole numbers, all below 2^24
    nothing = np.float32(0.0)
    zero, unit = np.int32(0), np.int32(1)
    number, weight, sx, sy, sz = zero, zero, zero, zero, zero
    sxx, sxy, sxz, syy, syz, szz = zero, zero, zero, zero, zero, zero
    for i in range(count):
        off = fx * np.float32(x[i]) + fy * np.float32(y[i]) + fz * np.float32(z[i]) - middle
        towards = (
            fx * np.float32(view_x[i]) + fy * np.float32(view_y[i]) + fz * np.float32(view_z[i])
        )
        inside = (distance[i] <= r) & (abs(off) < farthest) & (towards > nothing)
        one = unit if inside else zero
        number = np.int32(number + one)
        wi = np.int32(w[i] * one)
        weight = np.int32(weight + wi)
        wx, wy, wz = np.int32(wi * x[i]), np.int32(wi * y[i]), np.int32(wi * z[i])
        sx, sy, sz = np.int32(sx + wx), np.int32(sy + wy), np.int32(sz + wz)
        sxx = np.int32(sxx + np.int32(wx * x[i]))
        sxy = np.int32(sxy + np.int32(wx * y[i]))
        sxz = np.int32(sxz + np.int32(wx * z[i]))
        syy = np.int32(syy + np.int32(wy * y[i]))
        syz = np.int32(syz + np.int32(wy * z[i]))
        szz = np.int32(szz + np.int32(wz * z[i]))
    sums[0], sums[1], sums[2], sums[3], sums[4] = number, weight, sx, sy, sz
    sums[5], sums[6], sums[7], sums[8], sums[9], sums[10] = sxx, sxy, sxz, syy, syz, szz
