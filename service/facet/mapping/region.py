"""The votes of a cubic region, and what their moments say (eq. 2-10, 18).

Votes are collected once, with what decides whether they count; every radius, side and slab is then
a pass over this short list. All sums are integers, so their order never matters.
"""

from __future__ import annotations

import numpy as np
from numba import njit

from facet.mapping.bits import box_mask, trailing_zeros
from facet.mapping.blocks import find, pack, unpack
from facet.mapping.eigen import eigenvalues

MOST = 8192  # votes of a region that are looked at
COLUMNS = 8  # x, y, z (1/8 voxel from the voxel's corner), weight, view x, y, z, distance
SUMS = 12  # number, weight, w x, y, z, w xx, xy, xz, yy, yz, zz, pose (0 unknown, -1 many)


@njit(cache=True, nogil=True)
def _merge_pose(one, other):  # type: ignore[no-untyped-def]
    """The only pose of two sets, -1 if they have several, 0 if both are empty."""
    if one == 0:
        return other
    return one if other in (0, one) else np.int64(-1)


@njit(cache=True, nogil=True)
def collect(blocks, observable, block, local, r, view, least, votes, shells):  # type: ignore[no-untyped-def]
    """List the occupied voxels within r (Chebyshev) of a voxel into votes (MOST, COLUMNS) float64,
    and sum by distance, into shells (> r, SUMS), those whose view direction has more than `least`
    (times its length) along `view`; with least = -inf all. Returns how many are listed."""
    shells[: r + 1] = 0
    count = 0
    x, y, z = local & 7, (local >> 3) & 7, local >> 6
    bi, bj, bk = unpack(blocks.keys[block])
    least2 = least * least
    for dk in range((z - r) >> 3, ((z + r) >> 3) + 1):
        z0, z1 = max(0, z - r - 8 * dk), min(7, z + r - 8 * dk)
        for dj in range((y - r) >> 3, ((y + r) >> 3) + 1):
            y0, y1 = max(0, y - r - 8 * dj), min(7, y + r - 8 * dj)
            for di in range((x - r) >> 3, ((x + r) >> 3) + 1):
                if di == 0 and dj == 0 and dk == 0:
                    other = block
                elif -1 <= di <= 1 and -1 <= dj <= 1 and -1 <= dk <= 1:
                    other = blocks.neighbours[block, (di + 1) + 3 * (dj + 1) + 9 * (dk + 1)]
                else:
                    key = pack(bi + di, bj + dj, bk + dk)
                    other = find(blocks.table_keys, blocks.table_values, key)
                if other < 0:
                    continue
                x0, x1 = max(0, x - r - 8 * di), min(7, x + r - 8 * di)
                mask = box_mask(x0, x1, y0, y1)
                for oz in range(z0, z1 + 1):
                    word = blocks.occupied[other, oz] & mask
                    while word != np.uint64(0):
                        bit = np.int64(trailing_zeros(word))
                        word &= word - np.uint64(1)
                        if count == votes.shape[0]:
                            return count
                        seen = observable[blocks.rows[other, 64 * oz + bit]]
                        dx = (bit & 7) + 8 * di - x
                        dy = (bit >> 3) + 8 * dj - y
                        dz = oz + 8 * dk - z
                        distance = max(abs(dx), abs(dy), abs(dz))
                        cx = 8 * dx + (seen & 15)
                        cy = 8 * dy + ((seen >> 4) & 15)
                        cz = 8 * dz + ((seen >> 8) & 15)
                        w = (seen >> 12) & 15
                        vx = ((seen >> 16) & 31) - 8
                        vy = ((seen >> 21) & 31) - 8
                        vz = ((seen >> 26) & 31) - 8
                        votes[count, 0] = cx
                        votes[count, 1] = cy
                        votes[count, 2] = cz
                        votes[count, 3] = w
                        votes[count, 4] = vx
                        votes[count, 5] = vy
                        votes[count, 6] = vz
                        votes[count, 7] = distance
                        count += 1
                        if least > -np.inf:
                            if (seen >> 31) & 1:  # seen from opposite sides: its own needs a normal
                                continue
                            dot = view[0] * vx + view[1] * vy + view[2] * vz
                            if dot < 0.0 and dot * dot > least2 * (vx * vx + vy * vy + vz * vz):
                                continue
                        wx, wy, wz = w * cx, w * cy, w * cz
                        shells[distance, 0] += 1
                        shells[distance, 1] += w
                        shells[distance, 2] += wx
                        shells[distance, 3] += wy
                        shells[distance, 4] += wz
                        shells[distance, 5] += wx * cx
                        shells[distance, 6] += wx * cy
                        shells[distance, 7] += wx * cz
                        shells[distance, 8] += wy * cy
                        shells[distance, 9] += wy * cz
                        shells[distance, 10] += wz * cz
                        pose = (seen >> 32) & 0x1FFFF
                        shells[distance, 11] = _merge_pose(
                            shells[distance, 11], pose if pose > 0 else np.int64(-1)
                        )
    return count


@njit(cache=True, nogil=True)
def within(shells, r, sums):  # type: ignore[no-untyped-def]
    """Sums of the votes within r."""
    for s in range(11):
        total = np.int64(0)
        for distance in range(r + 1):
            total += shells[distance, s]
        sums[s] = total
    pose = np.int64(0)
    for distance in range(r + 1):
        pose = _merge_pose(pose, shells[distance, 11])
    sums[11] = pose


@njit(cache=True, nogil=True)
def within_slab(votes, count, r, nx, ny, nz, own, slab, sums):  # type: ignore[no-untyped-def]
    """Sums of the votes within r that were seen from the side of the normal and whose centroid
    lies within `slab` of n . c = own. The pose in sums stays."""
    number, weight = 0.0, 0.0  # integers below 2^53: exact
    sx, sy, sz = 0.0, 0.0, 0.0
    sxx, sxy, sxz, syy, syz, szz = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
    limit = float(r)
    for i in range(count):
        x, y, z = votes[i, 0], votes[i, 1], votes[i, 2]
        if (
            (votes[i, 7] <= limit)
            & (abs(nx * x + ny * y + nz * z - own) <= slab)
            & (nx * votes[i, 4] + ny * votes[i, 5] + nz * votes[i, 6] > 0.0)
        ):
            w = votes[i, 3]
            number += 1.0
            weight += w
            wx, wy, wz = w * x, w * y, w * z
            sx += wx
            sy += wy
            sz += wz
            sxx += wx * x
            sxy += wx * y
            sxz += wx * z
            syy += wy * y
            syz += wy * z
            szz += wz * z
    sums[0], sums[1] = np.int64(number), np.int64(weight)
    sums[2], sums[3], sums[4] = np.int64(sx), np.int64(sy), np.int64(sz)
    sums[5], sums[6], sums[7] = np.int64(sxx), np.int64(sxy), np.int64(sxz)
    sums[8], sums[9], sums[10] = np.int64(syy), np.int64(syz), np.int64(szz)


@njit(cache=True, nogil=True)
def covariance(sums):  # type: ignore[no-untyped-def]
    """(xx, yy, zz, xy, xz, yz) of the votes, population form (eq. 3), (1/8 voxel)^2."""
    w = float(sums[1])
    mx, my, mz = sums[2] / w, sums[3] / w, sums[4] / w
    return (
        sums[5] / w - mx * mx,
        sums[8] / w - my * my,
        sums[10] / w - mz * mz,
        sums[6] / w - mx * my,
        sums[7] / w - mx * mz,
        sums[9] / w - my * mz,
    )


@njit(cache=True, nogil=True)
def shape(sums, floor2):  # type: ignore[no-untyped-def]
    """(lambda of eq. 18, tan gamma of eq. 9, third eigenvalue unfloored) with floored variances."""
    a, b, c, d, e, f = covariance(sums)
    v1, v2, v3 = eigenvalues(a, b, c, d, e, f)
    s1, s2, s3 = max(v1, floor2), max(v2, floor2), max(v3, floor2)
    return s2 / np.sqrt(s1 * s3), 1.1547005383792515 * np.sqrt(s3 / np.sqrt(s1 * s2)), v3
