"""Which voxels are stale: those whose region, as far as it was looked at, holds a dirty voxel."""

from __future__ import annotations

import numpy as np
from numba import njit

from facet.mapping.bits import box_mask, trailing_zeros
from facet.mapping.blocks import find, pack, unpack


@njit(cache=True, nogil=True)
def find_stale(blocks, columns, reach, deepest, dirty_rows, dirty_mask, dirty_blocks, flags, out):  # type: ignore[no-untyped-def]
    """Rows whose region, as far as they looked, holds a dirty voxel. dirty_mask (B, 8) has a bit
    per dirty voxel; flags (V,) is scratch and comes back clear. Returns how many."""
    count = 0
    for d in range(dirty_rows.shape[0]):  # a dirty voxel is stale itself
        row = dirty_rows[d]
        flags[row] = True
        out[count] = row
        count += 1
    for q in range(dirty_blocks.shape[0]):
        source = dirty_blocks[q]
        bi, bj, bk = unpack(blocks.keys[source])
        for n in range(343):
            di, dj, dk = n % 7 - 3, (n // 7) % 7 - 3, n // 49 - 3
            gap = max(0, 8 * max(abs(di), abs(dj), abs(dk)) - 7)
            if gap <= 8:
                if di == 0 and dj == 0 and dk == 0:
                    target = source
                else:
                    target = blocks.neighbours[source, (di + 1) + 3 * (dj + 1) + 9 * (dk + 1)]
            else:
                if gap > deepest[1]:
                    continue
                key = pack(bi + di, bj + dj, bk + dk)
                target = find(blocks.table_keys, blocks.table_values, key)
            if target < 0 or deepest[2 + target] < gap:
                continue
            for tz in range(8):
                word = blocks.occupied[target, tz]
                while word != np.uint64(0):
                    bit = np.int64(trailing_zeros(word))
                    word &= word - np.uint64(1)
                    row = blocks.rows[target, 64 * tz + bit]
                    if flags[row]:
                        continue
                    r = np.int64(reach[row])
                    x = (bit & 7) + 8 * di
                    y = (bit >> 3) + 8 * dj
                    z = tz + 8 * dk
                    x0, x1, y0, y1 = max(0, x - r), min(7, x + r), max(0, y - r), min(7, y + r)
                    if x0 > x1 or y0 > y1:
                        continue
                    mask = box_mask(x0, x1, y0, y1)
                    for sz in range(max(0, z - r), min(7, z + r) + 1):
                        if dirty_mask[source, sz] & mask:
                            flags[row] = True
                            out[count] = row
                            count += 1
                            break
    for s in range(count):
        flags[out[s]] = False
    return count


@njit(cache=True, nogil=True)
def mark_dirty(columns, rows, dirty_mask, block_flags, out):  # type: ignore[no-untyped-def]
    """Set the rows' bits in dirty_mask and list their blocks once. Returns how many blocks."""
    count = 0
    for d in range(rows.shape[0]):
        block, local = columns.block[rows[d]], columns.local[rows[d]]
        dirty_mask[block, local >> 6] |= np.uint64(1) << np.uint64(local & 63)
        if not block_flags[block]:
            block_flags[block] = True
            out[count] = block
            count += 1
    for q in range(count):
        block_flags[out[q]] = False
    return count


@njit(cache=True, nogil=True)
def deepen(blocks, columns, rows, reach, deepest):  # type: ignore[no-untyped-def]
    """Refresh, for the rows' blocks, the largest reach of a block's voxels (deepest[2 + block])."""
    for s in range(rows.shape[0]):
        deepest[2 + columns.block[rows[s]]] = 0
    for s in range(rows.shape[0]):
        block = columns.block[rows[s]]
        if deepest[2 + block] > 0:
            continue
        largest = 0
        for local in range(512):
            row = blocks.rows[block, local]
            if row >= 0:
                largest = max(largest, np.int64(reach[row]))
        deepest[2 + block] = max(1, largest)
        deepest[1] = max(deepest[1], largest)
