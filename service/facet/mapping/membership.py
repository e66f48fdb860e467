"""Which voxels belong to which tile-plane, and what they belonged to before."""

from __future__ import annotations

import numpy as np
from numba import prange

from facet.mapping.bits import population, trailing_zeros
from facet.mapping.blocks import CENTRE, find, pack, row_at, unpack
from facet.mapping.eigen import smallest
from facet.mapping.kernel import kernel
from facet.mapping.merging import plane_of
from facet.mapping.settings import BLOCK, STEPS, TILE
from facet.mapping.store import centroid
from facet.mapping.sums import SUMS, count_points, read_sums, shift_moments

STRAY = 0.47  # voxels: a voxel whose centroid is so far off its tile-plane is not fitted to
RIMMED = (12.0, 40.0)  # voxels: a tile-plane of such a width may be tilted by its rim
CORE = 0.3  # voxels: centroids so near say where it truly lies
ROUNDS = 4
FEW = 30  # voxels say nothing
SHELL = 1000  # blocks of a tile and of the shell round it
CHUNK = 256  # members that are looked at together
PURE, MIXED, CLAIMED = range(3)  # what a member is to its tile-plane


@kernel
def _collect(blocks, patches, plane_of_patch, tile_key, which, rows, owner, corner):  # type: ignore[no-untyped-def]
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
def _shell(blocks, tile_key, out):  # type: ignore[no-untyped-def]
    """Existing blocks of a tile and of the one-block shell round it, by ascending key."""
    ti, tj, tk = unpack(tile_key)
    count = 0
    for i in range(8 * ti - 1, 8 * ti + 9):
        for j in range(8 * tj - 1, 8 * tj + 9):
            for k in range(8 * tk - 1, 8 * tk + 9):
                block = find(blocks.table_keys, blocks.table_values, pack(i, j, k))
                if block >= 0:
                    out[count] = block
                    count += 1
    return count


@kernel(parallel=True)
def find_shells(blocks, tile_keys, near, num_near, room):  # type: ignore[no-untyped-def]
    """For each tile the blocks that may hold its members, near (N, SHELL) and how many, and room:
    as many members as there can be."""
    for n in prange(tile_keys.shape[0]):
        count = _shell(blocks, tile_keys[n], near[n])
        voxels = np.int64(0)
        for q in range(count):
            for z in range(8):
                voxels += np.int64(population(blocks.occupied[near[n, q], z]))
        num_near[n], room[n] = count, 2 * voxels


@kernel(parallel=True)
def collect_members(  # type: ignore[no-untyped-def]
    blocks, patches, plane_of_patch, tile_keys, near, num_near, first, starts, rows, corner
):
    """Members of all tile-planes of tiles: those of tile n from first[n] on, by tile-plane, of
    which the t-th begins at starts[n, t], counted from there."""
    for n in prange(tile_keys.shape[0]):
        room = first[n + 1] - first[n]
        own, owner, claimed = (
            np.empty(room, np.int32),
            np.empty(room, np.int16),
            np.empty(room, np.bool_),
        )
        which = near[n, : num_near[n]]
        count = _collect(blocks, patches, plane_of_patch, tile_keys[n], which, own, owner, claimed)
        place = starts[n]
        place[:] = 0
        for m in range(count):
            place[owner[m] + 1] += 1
        for t in range(1, place.shape[0]):
            place[t] += place[t - 1]
        place = place.copy()
        for m in range(count):  # a stable sort: members stay by block
            at = first[n] + place[owner[m]]
            place[owner[m]] += 1
            rows[at], corner[at] = own[m], claimed[m]


@kernel
def inherit(old, new, scratch, counts):  # type: ignore[no-untyped-def]
    """counts[old, new]: voxels that went from one tile-plane to another; old and new: rows (M,),
    corner (M,), and where each tile-plane starts. scratch (V,) stays 0."""
    rows, corner, starts = old
    for t in range(starts.shape[0] - 1):
        for m in range(starts[t], starts[t + 1]):
            if not corner[m]:
                scratch[rows[m]] = t + 1
    rows, corner, starts = new
    for t in range(starts.shape[0] - 1):
        for m in range(starts[t], starts[t + 1]):
            if not corner[m] and scratch[rows[m]] > 0:
                counts[scratch[rows[m]] - 1, t] += 1
    rows = old[0]
    for m in range(rows.shape[0]):
        scratch[rows[m]] = 0


@kernel
def list_abroad(blocks, block_of, tile_key, rows, corner, starts, ids, out):  # type: ignore[no-untyped-def]
    """Members of a tile's tile-planes that lie in other tiles, with the plane ids (T,) that they go
    by, as row << 32 | id. How many."""
    ti, tj, tk = unpack(tile_key)
    count = 0
    for t in range(starts.shape[0] - 1):
        for m in range(starts[t], starts[t + 1]):
            if corner[m]:
                continue
            i, j, k = unpack(blocks.keys[block_of[rows[m]]])
            if i >> 3 != ti or j >> 3 != tj or k >> 3 != tk:
                out[count] = (np.int64(rows[m]) << 32) | ids[t]
                count += 1
    return count


@kernel(parallel=True)
def sum_points(  # type: ignore[no-untyped-def]
    rows, corner, starts, tile_keys, shares, blocks, columns, border, second, nodes, planes, points,
    total
):  # fmt: skip
    """Sum the voxels' point moments about the tile's corner into points (T, 10), without those
    that hold points of others: at a border, claimed by a plane at an angle, or STRAY from their
    tile-plane; count all in total (T,). A tile-plane neither narrow nor wide is settled first:
    the rim of a table's top tilts it.

    planes: (T, 4) comes out: unit normal and offset of what members are STRAY from.
    rows, corner: members of T tile-planes, one after another, those of t from starts[t] on;
    tile_keys: (T,); shares: (S + 1,) tile-planes that each thread begins with.
    Leftovers count as well: the tails of the noise lie in them, and without these a plane across
    the grid is bent by where the grid cuts it."""
    for share in prange(shares.shape[0] - 1):
        places = np.empty((CHUNK, 3), np.int64)
        state = np.empty(CHUNK, np.int8)
        for t in range(shares[share], shares[share + 1]):
            points[t] = 0
            total[t] = 0
            plane, width = _seen_from(nodes, t, tile_keys[t])
            if RIMMED[0] <= width <= RIMMED[1]:
                own = rows[starts[t] : starts[t + 1]], corner[starts[t] : starts[t + 1]]
                plane = _settled(own, blocks, columns, border, second, tile_keys[t], plane)
            planes[t, 0], planes[t, 1], planes[t, 2], planes[t, 3] = plane
            for start in range(starts[t], starts[t + 1], CHUNK):
                stop = min(starts[t + 1], start + CHUNK)
                own = rows[start:stop], corner[start:stop]
                _look(own, blocks, columns, border, second, tile_keys[t], plane, places, state)
                total[t] += _add(own[0], columns, places, state, points[t])


@kernel
def _seen_from(nodes, t, tile_key):  # type: ignore[no-untyped-def]
    """(unit normal of a tile-plane and its offset from the corner of the tile, its width), voxels.
    The width is 0 where it is too small to have one."""
    ti, tj, tk = unpack(tile_key)
    nx, ny, nz, _, across = plane_of(nodes.votes[t], nodes.scatter[t], nodes.unit[t])
    mean = nodes.mean[t]
    offset = nx * (mean[0] - TILE * ti) + ny * (mean[1] - TILE * tj) + nz * (mean[2] - TILE * tk)
    return (nx, ny, nz, offset), np.sqrt(12.0 * max(0.0, across))


@kernel
def _settled(own, blocks, columns, border, second, tile_key, plane):  # type: ignore[no-untyped-def]
    """The plane moved to where most of the members' centroids lie. A rim that tilts it, or another
    surface close by, is left behind."""
    rows, corner = own
    ti, tj, tk = unpack(tile_key)
    spread = np.empty(6)
    for _ in range(ROUNDS):
        nx, ny, nz, offset = plane
        n, pure = 0, 0
        x, y, z, xx, xy, xz, yy, yz, zz = 0, 0, 0, 0, 0, 0, 0, 0, 0
        for m in range(rows.shape[0]):
            row = rows[m]
            if corner[m] or border[row] or second[row] >= 0:
                continue
            a, b, c = centroid(blocks, columns, row)
            a, b, c = a - STEPS * TILE * ti, b - STEPS * TILE * tj, c - STEPS * TILE * tk
            pure += 1
            if abs((nx * a + ny * b + nz * c) / STEPS - offset) > CORE:
                continue
            n, x, y, z = n + 1, x + a, y + b, z + c
            xx, xy, xz = xx + a * a, xy + a * b, xz + a * c
            yy, yz, zz = yy + b * b, yz + b * c, zz + c * c
        if n < FEW or 2 * n < pure:
            break
        mx, my, mz = x / n, y / n, z / n
        spread[0], spread[1], spread[2] = xx - x * mx, xy - x * my, xz - x * mz
        spread[3], spread[4], spread[5] = yy - y * my, yz - y * mz, zz - z * mz
        _, ux, uy, uz, _, _ = smallest(spread)
        sign = 1.0 if ux * nx + uy * ny + uz * nz > 0.0 else -1.0
        ux, uy, uz = sign * ux, sign * uy, sign * uz
        plane = ux, uy, uz, (ux * mx + uy * my + uz * mz) / STEPS
    return plane


@kernel
def _look(own, blocks, columns, border, second, tile_key, plane, places, state):  # type: ignore[no-untyped-def]
    """Where members lie in their tile, voxels, and what they are: PURE, not, or only claimed."""
    rows, corner = own
    ti, tj, tk = unpack(tile_key)
    nx, ny, nz, offset = plane
    for m in range(rows.shape[0]):  # nothing here waits for the last member
        row = rows[m]
        i, j, k = unpack(blocks.keys[columns.block[row]])
        local = np.int64(columns.local[row])
        seen = columns.observable[row]
        x = BLOCK * i - TILE * ti + (local & 7)
        y = BLOCK * j - TILE * tj + ((local >> 3) & 7)
        z = BLOCK * k - TILE * tk + (local >> 6)
        places[m, 0], places[m, 1], places[m, 2] = x, y, z
        off = (
            nx * (x + (seen & 15) / STEPS)
            + ny * (y + ((seen >> 4) & 15) / STEPS)
            + nz * (z + ((seen >> 8) & 15) / STEPS)
            - offset
        )
        mixed = border[row] | (second[row] >= 0) | (abs(off) > STRAY)
        state[m] = CLAIMED if corner[m] else MIXED if mixed else PURE


@kernel
def _add(rows, columns, places, state, points):  # type: ignore[no-untyped-def]
    """Add the moments of PURE members to points (10,). Returns the points of all."""
    total = np.int64(0)
    sums = np.empty(SUMS, np.int64)
    for m in range(rows.shape[0]):
        if state[m] == PURE:
            read_sums(columns, rows[m], sums)
            total += sums[0]
            shift_moments(sums, places[m, 0], places[m, 1], places[m, 2], points)
        elif state[m] == MIXED:
            total += count_points(columns, rows[m])
    return total


@kernel
def add_changes(  # type: ignore[no-untyped-def]
    rows, before, first, blocks, columns, border, patches, plane_of_patch, tile_keys, planes,
    points, total
):  # fmt: skip
    """Add to `sum_points` of T tile-planes what came to their members `rows` (R,) since they had
    the sums `before` (R, SUMS). All else must be as it was then.

    first: (B,) of the tile-planes, that of a block's tile which comes first, -1: none of these."""
    places, state = np.empty((1, 3), np.int64), np.empty(1, np.int8)
    sums, corner = np.empty(SUMS, np.int64), np.zeros(1, np.bool_)
    for q in range(rows.shape[0]):
        block, label = columns.block[rows[q]], patches.label[rows[q]]
        if label < 0:
            continue
        other = block if label >> 4 == CENTRE else blocks.neighbours[block, label >> 4]
        if first[other] < 0:
            continue
        t = first[other] + plane_of_patch[other, label & 15]
        plane = planes[t, 0], planes[t, 1], planes[t, 2], planes[t, 3]
        own = rows[q : q + 1], corner
        _look(own, blocks, columns, border, patches.second, tile_keys[t], plane, places, state)
        read_sums(columns, rows[q], sums)
        sums -= before[q]
        total[t] += sums[0]
        if state[0] == PURE:
            shift_moments(sums, places[0, 0], places[0, 1], places[0, 2], points[t])
