"""Which voxels belong to which tile-plane, and what they belonged to before."""

from __future__ import annotations

import numpy as np

from facet.mapping.bits import trailing_zeros
from facet.mapping.blocks import CENTRE, find, pack, row_at, unpack
from facet.mapping.kernel import kernel
from facet.mapping.merging import plane_of
from facet.mapping.settings import BLOCK, STEPS, TILE
from facet.mapping.sums import SUMS, count_points, read_sums, shift_moments

STRAY = 0.47  # voxels: a voxel whose centroid is so far off its tile-plane is not fitted to


@kernel
def collect(blocks, patches, plane_of_patch, tile_key, which, rows, owner, corner):  # type: ignore[no-untyped-def]
    """Voxels of the blocks `which` whose patch, own or claiming, lies in the tile. How many."""
    ti, tj, tk = unpack(tile_key)
    count = 0
    for q in range(which.shape[0]):
        block = which[q]
        i, j, k = unpack(blocks.keys[block])
        for z in range(8):
            word = blocks.occupied[block, z]
            while word != np.uint64(0):
                bit = np.int64(trailing_zeros(word))
                word &= word - np.uint64(1)
                row = row_at(blocks, block, 64 * z + bit)
                for claim in range(2):
                    label = patches.second[row] if claim else patches.label[row]
                    if label < 0:
                        continue
                    n = label >> 4
                    x, y, w = i + n % 3 - 1, j + (n // 3) % 3 - 1, k + n // 9 - 1
                    if x >> 3 != ti or y >> 3 != tj or w >> 3 != tk:
                        continue
                    other = block if n == CENTRE else blocks.neighbours[block, n]
                    rows[count] = row
                    owner[count] = plane_of_patch[other, label & 15]
                    corner[count] = claim == 1
                    count += 1
    return count


@kernel
def shell(table_keys, table_values, tile_key, out):  # type: ignore[no-untyped-def]
    """Existing blocks of a tile and of the one-block shell round it, by ascending key."""
    ti, tj, tk = unpack(tile_key)
    count = 0
    for i in range(8 * ti - 1, 8 * ti + 9):
        for j in range(8 * tj - 1, 8 * tj + 9):
            for k in range(8 * tk - 1, 8 * tk + 9):
                block = find(table_keys, table_values, pack(i, j, k))
                if block >= 0:
                    out[count] = block
                    count += 1
    return count


@kernel
def inherit(old_rows, old_owner, old_corner, rows, owner, corner, scratch, counts):  # type: ignore[no-untyped-def]
    """counts[old, new]: voxels that went from one tile-plane to another. scratch (V,) stays 0."""
    for m in range(old_rows.shape[0]):
        if not old_corner[m]:
            scratch[old_rows[m]] = old_owner[m] + 1
    for m in range(rows.shape[0]):
        if not corner[m] and scratch[rows[m]] > 0:
            counts[scratch[rows[m]] - 1, owner[m]] += 1
    for m in range(old_rows.shape[0]):
        scratch[old_rows[m]] = 0


@kernel
def sum_points(  # type: ignore[no-untyped-def]
    rows, owner, corner, tile_key, blocks, columns, border, second, nodes, points, total
):
    """Sum the voxels' point moments about the tile's corner into points (T, 10), without those
    that hold points of others: at a border, claimed by a plane at an angle, or STRAY from their
    tile-plane; count all in total (T,).

    Leftovers count as well: the tails of the noise lie in them, and without these a plane across
    the grid is bent by where the grid cuts it."""
    ti, tj, tk = unpack(tile_key)
    count = total.shape[0]
    normals, offsets = np.empty((count, 3)), np.empty(count)
    for t in range(count):
        nx, ny, nz, _, _ = plane_of(nodes.votes[t], nodes.scatter[t], nodes.unit[t])
        normals[t, 0], normals[t, 1], normals[t, 2] = nx, ny, nz
        mean = nodes.mean[t]
        offsets[t] = (
            nx * (mean[0] - TILE * ti) + ny * (mean[1] - TILE * tj) + nz * (mean[2] - TILE * tk)
        )
    sums = np.empty(SUMS, np.int64)
    for m in range(rows.shape[0]):
        if corner[m]:
            continue
        row, own = rows[m], owner[m]
        seen = columns.observable[row]
        i, j, k = unpack(blocks.keys[columns.block[row]])
        local = np.int64(columns.local[row])
        x = BLOCK * i - TILE * ti + (local & 7)
        y = BLOCK * j - TILE * tj + ((local >> 3) & 7)
        z = BLOCK * k - TILE * tk + (local >> 6)
        off = (
            normals[own, 0] * (x + (seen & 15) / STEPS)
            + normals[own, 1] * (y + ((seen >> 4) & 15) / STEPS)
            + normals[own, 2] * (z + ((seen >> 8) & 15) / STEPS)
            - offsets[own]
        )
        if border[row] or second[row] >= 0 or abs(off) > STRAY:
            total[own] += count_points(columns, row)
            continue
        read_sums(columns, row, sums)
        total[own] += sums[0]
        shift_moments(sums, x, y, z, points[own])
