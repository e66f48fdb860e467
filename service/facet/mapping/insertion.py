"""Points into voxels: the one loop by which a store is filled, and emptied."""

from __future__ import annotations

import numpy as np

from facet.mapping.blocks import add_block, find, pack, put_row, row_at
from facet.mapping.kernel import kernel
from facet.mapping.sums import TOUCHED, add_point, carry, read_sums

AHEAD = 32  # points whose rows are looked up at a time


@kernel(allocates=False)
def _place_of(point):  # type: ignore[no-untyped-def]
    """Block key, and x + 8 y + 64 z in the block, of the voxel of a point."""
    i, j, k = point[0] >> 10, point[1] >> 10, point[2] >> 10
    return pack(i >> 3, j >> 3, k >> 3), (i & 7) + 8 * (j & 7) + 64 * (k & 7)


@kernel(allocates=False)
def _find_rows(blocks, points, rows):  # type: ignore[no-untyped-def]
    """The rows of the voxels of points (N, 3), -1: it has none yet. One look-up at a time for all
    of them: they do not wait for one another."""
    last_key, block = np.int64(-1), np.int64(-1)
    for p in range(points.shape[0]):
        key, local = _place_of(points[p])
        if key != last_key:
            last_key = key
            block = np.int64(find(blocks.table_keys, blocks.table_values, key))
        rows[p] = row_at(blocks, block, local) if block >= 0 else -1


@kernel(allocates=False)
def _add_row(blocks, columns, point, used):  # type: ignore[no-untyped-def]
    """The row of a point's voxel, which had none, unless a point just before has made it; and the
    numbers of blocks, lines and rows."""
    num_blocks, num_lines, num_rows = used
    key, local = _place_of(point)
    block = np.int64(find(blocks.table_keys, blocks.table_values, key))
    if block < 0:
        block = add_block(blocks, num_blocks, key)
        num_blocks += 1
    row = np.int64(row_at(blocks, block, local))
    if row < 0:
        row = num_rows
        num_rows += 1
        num_lines = put_row(blocks, num_lines, block, local, row)
        columns.block[row] = block
        columns.local[row] = local
    return row, num_blocks, num_lines, num_rows


@kernel(allocates=False)
def insert_points(blocks, columns, ticks, sign, start, used, touched_rows, before, rows):  # type: ignore[no-untyped-def]
    """Add the points of scans from `start` on with `sign`; note the rows touched, and their sums
    before. Returns (next point, what is used now: blocks, ...); next < N means that a capacity ran
    out and the caller must grow and go on. rows (AHEAD,): room."""
    points, views, starts, pose_hashes = ticks
    scan, pose_hash = -1, np.int64(-1)
    first, known = start, start  # points whose rows were looked up
    num_blocks, num_lines, num_rows, num_touched = used
    max_blocks = blocks.keys.shape[0]
    max_lines = blocks.rows.shape[0]
    max_rows = columns.block.shape[0]
    max_touched = touched_rows.shape[0]
    for p in range(start, points.shape[0]):
        full = num_blocks == max_blocks or num_lines == max_lines
        if full or num_rows == max_rows or num_touched == max_touched:
            return p, (num_blocks, num_lines, num_rows, num_touched)
        while p >= starts[scan + 1]:
            scan += 1
            pose_hash = pose_hashes[scan]
        if p == known:
            known = min(p + AHEAD, points.shape[0])
            _find_rows(blocks, points[p:known], rows)
            first = p
        row = np.int64(rows[p - first])
        if row < 0:
            row, num_blocks, num_lines, num_rows = _add_row(
                blocks, columns, points[p], (num_blocks, num_lines, num_rows)
            )
        if columns.flags[row] & TOUCHED == 0:
            columns.flags[row] |= TOUCHED
            touched_rows[num_touched] = row
            if num_touched < before.shape[0]:
                read_sums(columns, row, before[num_touched])
            num_touched += 1
        x, y, z = points[p, 0] & 1023, points[p, 1] & 1023, points[p, 2] & 1023
        if add_point(columns.low[row], sign, x, y, z, views[p]):
            carry(columns.low, columns.middle, columns.high, columns.flags, row)
        if pose_hash >= 0:
            h = columns.poses[row]
            h[0] += sign
            h[1] += sign * pose_hash
            h[2] += sign * pose_hash * pose_hash
    return points.shape[0], (num_blocks, num_lines, num_rows, num_touched)
