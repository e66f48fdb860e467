"""Patches as the voxels of a block near by see them: planes and boxes in columns, one a candidate.

Lengths are eighths of a voxel, from the corner of the block that asks.
"""

from __future__ import annotations

import numpy as np

from facet.mapping.blocks import CENTRE, find, pack, unpack
from facet.mapping.kernel import kernel

HALF = 32.0  # half a block
OFFSET_STEP = 0.25  # to so much the offset of a patch from the middle of its block is rounded
NX, NY, NZ, OFFSET, WEIGHT = range(5)  # a candidate's plane: unit normal, offset; and 1 over
# a power of two of its votes
LOW, HIGH = 5, 8  # its box: least and largest x, y, z


@kernel(allocates=False)
def set_plane(columns, q, plane, sx, sy, sz):  # type: ignore[no-untyped-def]
    """Write the plane (5,) of a patch, whose block lies (sx, sy, sz) away from the one that asks,
    as candidate q. Returns how far it passes that block by."""
    ux, uy, uz = float(plane[0]), float(plane[1]), float(plane[2])
    one = 1.0 / np.sqrt(ux * ux + uy * uy + uz * uz)
    ux, uy, uz = ux * one, uy * one, uz * one
    offset = plane[3] * OFFSET_STEP + ux * (HALF + sx) + uy * (HALF + sy) + uz * (HALF + sz)
    columns[NX, q], columns[NY, q], columns[NZ, q], columns[OFFSET, q] = ux, uy, uz, offset
    return abs(HALF * (ux + uy + uz) - offset) - HALF * (abs(ux) + abs(uy) + abs(uz))


@kernel(allocates=False)
def _add_candidates(patches, places, num_places, tolerance, count, found):  # type: ignore[no-untyped-def]
    """Append the patches of blocks whose plane comes within `tolerance` of the block that asks.
    places (N, 5): block, code of its first patch, and blocks away along x, y, z. Returns how many
    there are now."""
    codes, columns = found.codes, found.columns
    for at in range(num_places):
        other = places[at, 0]
        sx, sy, sz = 64 * places[at, 2], 64 * places[at, 3], 64 * places[at, 4]
        for p in range(patches.number[other]):
            if count == codes.shape[0]:
                return count
            plane = patches.plane[other, p]
            if set_plane(columns, count, plane, sx, sy, sz) > tolerance:
                continue
            columns[WEIGHT, count] = 1.0 / (1 << plane[4])
            columns[LOW, count] = 8 * patches.box[other, p, 0] + sx
            columns[LOW + 1, count] = 8 * patches.box[other, p, 1] + sy
            columns[LOW + 2, count] = 8 * patches.box[other, p, 2] + sz
            columns[HIGH, count] = 8 * patches.box[other, p, 3] + 8 + sx
            columns[HIGH + 1, count] = 8 * patches.box[other, p, 4] + 8 + sy
            columns[HIGH + 2, count] = 8 * patches.box[other, p, 5] + 8 + sz
            codes[count] = places[at, 1] + p
            count += 1
    return count


@kernel(allocates=False)
def near_candidates(blocks, patches, block, tolerance, found):  # type: ignore[no-untyped-def]
    """Patches of a block and its 26 neighbours."""
    places, num = found.places, 0
    for n in range(27):
        other = block if n == CENTRE else np.int64(blocks.neighbours[block, n])
        if other >= 0:
            places[num, 0], places[num, 1] = other, 16 * n
            places[num, 2], places[num, 3], places[num, 4] = n % 3 - 1, n // 3 % 3 - 1, n // 9 - 1
            num += 1
    count = _add_candidates(patches, places, num, tolerance, 0, found)
    found.of_code[:] = -1
    for q in range(count):
        found.of_code[found.codes[q]] = q
        found.num_angled[q] = found.num_parallel[q] = -1
    return count


@kernel(allocates=False)
def far_candidates(blocks, patches, block, tolerance, count, found):  # type: ignore[no-untyped-def]
    """Append the patches of the blocks two away: the other jamb of a door."""
    places, num = found.places, 0
    i, j, k = unpack(blocks.keys[block])
    for n in range(125):
        di, dj, dk = n % 5 - 2, (n // 5) % 5 - 2, n // 25 - 2
        if max(abs(di), abs(dj), abs(dk)) < 2:
            continue
        other = find(blocks.table_keys, blocks.table_values, pack(i + di, j + dj, k + dk))
        if other >= 0:
            places[num, 0], places[num, 1] = other, 0
            places[num, 2], places[num, 3], places[num, 4] = di, dj, dk
            num += 1
    found.num_parallel[:count] = -1
    return _add_candidates(patches, places, num, tolerance, count, found)


@kernel(allocates=False)
def place_of(local, seen):  # type: ignore[no-untyped-def]
    """A voxel's rounded centroid, eighths from the block corner."""
    return (
        float(8 * (local & 7) + (seen & 15)),
        float(8 * ((local >> 3) & 7) + ((seen >> 4) & 15)),
        float(8 * (local >> 6) + ((seen >> 8) & 15)),
    )


@kernel(allocates=False)
def distance(columns, q, c):  # type: ignore[no-untyped-def]
    """Distance of a place from the plane of a candidate."""
    return abs(
        columns[NX, q] * c[0] + columns[NY, q] * c[1] + columns[NZ, q] * c[2] - columns[OFFSET, q]
    )


@kernel(allocates=False)
def cosine(columns, q, others, o):  # type: ignore[no-untyped-def]
    """Of the angle between candidate q and o of others."""
    return (
        columns[NX, q] * others[NX, o]
        + columns[NY, q] * others[NY, o]
        + columns[NZ, q] * others[NZ, o]
    )
