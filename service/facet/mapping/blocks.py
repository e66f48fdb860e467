"""Index arithmetic: voxel and block keys, and the open-addressing table from block key to block."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from facet.mapping.bits import trailing_zeros
from facet.mapping.kernel import kernel

Int64Array = NDArray[np.int64]

OFFSET = 1 << 20  # voxel indices are in [-OFFSET, OFFSET)
MASK = (1 << 21) - 1
EMPTY = np.int64(-1)
CENTRE = 13  # a block's own place among its 27 neighbours


@kernel(allocates=False)
def pack(i: int, j: int, k: int) -> int:
    """One sortable int64 from three indices in [-2^20, 2^20)."""
    return ((i + OFFSET) << 42) | ((j + OFFSET) << 21) | (k + OFFSET)


@kernel(allocates=False)
def unpack(key: int) -> tuple[int, int, int]:
    """The inverse of `pack`."""
    return (key >> 42) - OFFSET, ((key >> 21) & MASK) - OFFSET, (key & MASK) - OFFSET


def unpack_all(keys: Int64Array) -> Int64Array:
    """(N,) keys to (N, 3) indices."""
    return np.stack(
        [(keys >> 42) - OFFSET, ((keys >> 21) & MASK) - OFFSET, (keys & MASK) - OFFSET], axis=-1
    )


def pack_all(ijk: Int64Array) -> Int64Array:
    """(N, 3) indices to (N,) keys."""
    i, j, k = (ijk[..., axis].astype(np.int64) + OFFSET for axis in range(3))
    return np.asarray((i << 42) | (j << 21) | k, dtype=np.int64)


@kernel(allocates=False)
def hash_key(key: Any) -> Any:
    """A 63-bit mix (splitmix64's finaliser)."""
    z = np.uint64(key)
    z = (z ^ (z >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
    z = (z ^ (z >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
    return np.int64((z ^ (z >> np.uint64(31))) >> np.uint64(1))


@kernel(allocates=False)
def find(table_keys: Int64Array, table_values: NDArray[np.int32], key: Any) -> Any:
    """The value stored under `key`, or -1. Table size is a power of two, never full."""
    mask = table_keys.shape[0] - 1
    slot = hash_key(key) & mask
    while True:
        if table_keys[slot] == key:
            return table_values[slot]
        if table_keys[slot] == EMPTY:
            return -1
        slot = (slot + 1) & mask


@kernel(allocates=False)
def put(table_keys: Int64Array, table_values: NDArray[np.int32], key: int, value: int) -> None:
    """Store a key that is not in the table yet."""
    mask = table_keys.shape[0] - 1
    slot = hash_key(key) & mask
    while table_keys[slot] != EMPTY:
        slot = (slot + 1) & mask
    table_keys[slot] = key
    table_values[slot] = value


@kernel
def rehash(keys: Int64Array, count: int, size: int) -> tuple[Int64Array, NDArray[np.int32]]:
    """A table of `size` slots that maps keys[b] to b."""
    table_keys = np.full(size, EMPTY, np.int64)
    table_values = np.full(size, -1, np.int32)
    for b in range(count):
        put(table_keys, table_values, keys[b], b)
    return table_keys, table_values


class Blocks(NamedTuple):
    """Blocks of 8^3 voxels as columns; what the kernels read. (B, ...) with capacity B: by block.

    Most of the lines of a block are empty, as a wall or a floor takes a seventh of its voxels."""

    table_keys: Int64Array  # (H,)
    table_values: NDArray[np.int32]  # (H,)
    keys: Int64Array  # (B,) packed block index
    lines: NDArray[np.int32]  # (B, 64) line of 8 voxels along x at y + 8 z, 0: none has a row
    rows: NDArray[np.int32]  # (L, 8) by line, capacity L: the row of each voxel plus 1, 0: none
    occupied: NDArray[np.uint64]  # (B, 8) a bit x + 8 y for each z: observable says occupied
    neighbours: NDArray[np.int32]  # (B, 27) at (dx+1) + 3 (dy+1) + 9 (dz+1), -1: none


@kernel(allocates=False, inlined=True)
def row_at(blocks: Blocks, block: int, local: int) -> Any:
    """The row of a voxel at local index x + 8 y + 64 z of a block, or -1."""
    return blocks.rows[blocks.lines[block, local >> 3], local & 7] - 1


@kernel(allocates=False)
def list_voxels(blocks, block, bits, rows, places):  # type: ignore[no-untyped-def]
    """List the voxels of a block whose bits are set in bits (8,), as rows and places x + 8 y + 64 z
    in the block. How many. One look-up at a time for all of them: they do not wait for one
    another."""
    count = 0
    for z in range(8):
        word = bits[z]
        while word != np.uint64(0):
            places[count] = 64 * z + np.int64(trailing_zeros(word))
            word &= word - np.uint64(1)
            count += 1
    for v in range(count):
        place = places[v]
        rows[v] = blocks.rows[blocks.lines[block, place >> 3], place & 7] - 1
    return count


@kernel(allocates=False)
def list_rows(blocks, block, rows, places):  # type: ignore[no-untyped-def]
    """List likewise all voxels that a block has a row for, even where they are empty now."""
    count = 0
    for y in range(64):
        line = blocks.lines[block, y]
        if line == 0:
            continue
        for x in range(8):
            rows[count] = blocks.rows[line, x] - 1
            places[count] = 8 * y + x
            count += rows[count] >= 0
    return count


@kernel(allocates=False)
def put_row(blocks: Blocks, num_lines: int, block: int, local: int, row: int) -> int:
    """Enter a voxel's row, line `num_lines` being the first that is free. Returns the next one."""
    line = blocks.lines[block, local >> 3]
    if line == 0:
        line = num_lines
        blocks.lines[block, local >> 3] = line
        num_lines += 1
    blocks.rows[line, local & 7] = row + 1
    return num_lines


@kernel(allocates=False)
def add_block(blocks: Blocks, count: int, key: int) -> int:
    """Append the block `key` as number `count` and link it with its neighbours. Returns `count`."""
    blocks.keys[count] = key
    put(blocks.table_keys, blocks.table_values, key, count)
    bi, bj, bk = unpack(key)
    for n in range(27):
        other_key = pack(bi + n % 3 - 1, bj + (n // 3) % 3 - 1, bk + n // 9 - 1)
        other = find(blocks.table_keys, blocks.table_values, other_key)
        blocks.neighbours[count, n] = other
        if other >= 0:
            blocks.neighbours[other, 26 - n] = count
    return count
