"""What is stale: voxels whose region, as far as it was looked at, holds a dirty voxel."""

from __future__ import annotations

import numpy as np

from facet.mapping.bits import population
from facet.mapping.blocks import CENTRE, EMPTY, find, list_voxels, pack, unpack
from facet.mapping.halo import SIDE_BLOCKS, fill_rows, find_near
from facet.mapping.kernel import kernel
from facet.mapping.settings import BLOCK

RINGS = SIDE_BLOCKS // 2 - 1  # of blocks, beyond a block and its neighbours, that are looked at
ASKED = 16**3  # places for blocks that were looked up: those beside one another do not meet


@kernel(allocates=False)
def mark_dirty(columns, rows, dirty, first, following, out):  # type: ignore[no-untyped-def]
    """Set the rows' bits in dirty (B, 8) and list their blocks once. Returns how many blocks.

    first (B,), zeros: 1 + the place in rows (D,) of a dirty voxel of the block, 0: none; following
    (D,): likewise of the next one of the same block."""
    count = 0
    for d in range(rows.shape[0]):
        block, local = columns.block[rows[d]], columns.local[rows[d]]
        dirty[block, local >> 6] |= np.uint64(1) << np.uint64(local & 63)
        if first[block] == 0:
            out[count] = block
            count += 1
        following[d] = first[block]
        first[block] = d + 1
    return count


@kernel(allocates=False)
def _list_once(block, flags, out, count):  # type: ignore[no-untyped-def]
    """List a block unless it is flagged, and flag it. Returns how many are listed."""
    if not flags[block]:
        flags[block] = True
        out[count] = block
        count += 1
    return count


@kernel(allocates=False)
def _clear(flags, out, count):  # type: ignore[no-untyped-def]
    """Take the flags back. Returns how many are listed."""
    for q in range(count):
        flags[out[q]] = False
    return count


@kernel(allocates=False)
def find_candidates(blocks, deepest, sources, flags, asked, out):  # type: ignore[no-untyped-def]
    """Blocks that look as far as one of the blocks `sources`, these included. deepest (1 + B,):
    the largest reach of all, then by block; asked (RINGS, ASKED): room. Returns how many."""
    count = 0
    asked[:] = EMPTY
    for s in range(sources.shape[0]):
        for n in range(27):
            target = np.int64(blocks.neighbours[sources[s], n]) if n != CENTRE else sources[s]
            if target >= 0 and (deepest[1 + target] >= 1 or n == CENTRE):
                count = _list_once(target, flags, out, count)
        bi, bj, bk = unpack(blocks.keys[sources[s]])
        for ring in range(2, 2 + RINGS):
            if deepest[0] <= BLOCK * (ring - 1):
                break
            for dk in range(-ring, ring + 1):
                for dj in range(-ring, ring + 1):
                    step = 1 if max(abs(dj), abs(dk)) == ring else 2 * ring  # its two ends alone
                    for di in range(-ring, ring + 1, step):
                        i, j, k = bi + di, bj + dj, bk + dk
                        key, place = pack(i, j, k), (i & 15) | ((j & 15) << 4) | ((k & 15) << 8)
                        if asked[ring - 2, place] == key:
                            continue
                        asked[ring - 2, place] = key
                        target = np.int64(find(blocks.table_keys, blocks.table_values, key))
                        if target >= 0 and deepest[1 + target] > BLOCK * (ring - 1):
                            count = _list_once(target, flags, out, count)
    return _clear(flags, out, count)


@kernel(allocates=False)
def find_stale(blocks, dirty, reach, block, deepest, common, near, lines, listed, stale):  # type: ignore[no-untyped-def]
    """Set in stale (8,) the bits of a block's voxels that look at a dirty one, or are dirty
    themselves. `common` is the reach that most voxels have; listed (3, VOXELS): room. Returns how
    many."""
    margin = max(common, deepest)
    edge = BLOCK + 2 * margin
    blocks_out = (margin + 7) >> 3
    find_near(blocks, block, blocks_out, near)
    rest = np.uint64(0)  # voxels that are not dirty
    for z in range(8):
        stale[z] = dirty[block, z]
        rest |= blocks.occupied[block, z] & ~stale[z]
    if rest == np.uint64(0):
        return _count(stale)
    fill_rows(dirty, near, blocks_out, margin, False, lines)
    rows, places, reaches = listed[0], listed[1], listed[2]
    count = list_voxels(blocks, block, blocks.occupied[block], rows, places)
    for v in range(count):
        reaches[v] = reach[rows[v]]
    last, seen = np.int64(-1), np.uint64(0)
    for v in range(count):
        r, line, bit = reaches[v], places[v] >> 3, places[v] & 7
        y, z = (line & 7) + margin, (line >> 3) + margin
        if line != last:
            last, seen = line, _column(lines, edge, y, z, common)
        found = seen
        if r != common:
            found = _column(lines, edge, y, z, r)
        cube = (np.uint64(1) << np.uint64(2 * r + 1)) - np.uint64(1)
        if (found >> np.uint64(bit + margin - r)) & cube != np.uint64(0):
            stale[line >> 3] |= np.uint64(1) << np.uint64(places[v] & 63)
    return _count(stale)


@kernel(allocates=False)
def _count(bits):  # type: ignore[no-untyped-def]
    """How many bits of a block (8,) are set."""
    number = 0
    for z in range(8):
        number += np.int64(population(bits[z]))
    return number


@kernel(allocates=False)
def _column(lines, edge, y, z, r):  # type: ignore[no-untyped-def]
    """All rows within r of the row (y, z), one over the other."""
    seen = np.uint64(0)
    for k in range(z - r, z + r + 1):
        for line in range(k * edge + y - r, k * edge + y + r + 1):
            seen |= lines[line]
    return seen
