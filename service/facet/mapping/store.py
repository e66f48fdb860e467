"""The voxel store: exact integer moments by voxel, inserted and removed by one loop.

Insert and remove are the same additions with opposite signs, so their order never matters and
remove is the exact inverse of insert. `settle` says which voxels' observables changed.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from facet.mapping.blocks import (
    Blocks,
    add_block,
    put_row,
    rehash,
    unpack,
    unpack_all,
)
from facet.mapping.insertion import AHEAD, insert_points
from facet.mapping.kernel import kernel
from facet.mapping.memory import Heap, Memory, copied, grow_all
from facet.mapping.observable import observe
from facet.mapping.quantise import Ticks
from facet.mapping.settings import BLOCK, STEPS
from facet.mapping.sums import (
    DEEP,
    MOMENTS,
    SUMS,
    TOUCHED,
    count_points,
    read_sums,
    shift_moments,
    sums_of,
)

NOTED = 1 << 17  # touched voxels whose sums before are noted: what some scans of 130,000 beams see


class Dirty(NamedTuple):
    """Voxels whose observable changed."""

    rows: NDArray[np.int32]  # (D,)
    before: NDArray[np.int64]  # (D,) their observables when they were last settled


class Touched(NamedTuple):
    """Voxels that points came to, or left."""

    rows: NDArray[np.int32]  # (T,)
    before: NDArray[np.int64] | None  # (T, SUMS) their sums when they were last settled; None:
    # there are too many to note


class Columns(NamedTuple):
    """The voxels as columns, by row (V,); capacity V."""

    block: NDArray[np.int32]
    local: NDArray[np.int16]  # x + 8 y + 64 z in the block
    low: NDArray[np.int32]  # (V, SUMS) the sums of the voxel, see `sums`
    middle: NDArray[np.int8]  # (V, SUMS)
    high: NDArray[np.int32]  # (V, SUMS)
    poses: NDArray[np.int64]  # (V, 3) line-scan points: count, sum h, h^2 of their pose hashes
    observable: NDArray[np.int64]  # 0: empty
    flags: NDArray[np.uint8]  # TOUCHED, DEEP


@kernel
def _settle(blocks, columns, touched_rows, num_touched, dirty_rows, before):  # type: ignore[no-untyped-def]
    """Refresh the observables of touched rows. Returns how many of them changed."""
    num_dirty = 0
    sums = np.empty(SUMS, np.int64)
    for t in range(num_touched):
        row = touched_rows[t]
        columns.flags[row] &= ~TOUCHED
        read_sums(columns, row, sums)
        word = observe(sums[:MOMENTS], sums[MOMENTS:], columns.poses[row])
        if word == columns.observable[row]:
            continue
        before[num_dirty] = columns.observable[row]
        columns.observable[row] = word
        block, local = columns.block[row], columns.local[row]
        bit = np.uint64(1) << np.uint64(local & 63)
        if word != 0:
            blocks.occupied[block, local >> 6] |= bit
        else:
            blocks.occupied[block, local >> 6] &= ~bit
        dirty_rows[num_dirty] = row
        num_dirty += 1
    return num_dirty


@kernel(allocates=False)
def centroid(blocks, columns, row):  # type: ignore[no-untyped-def]
    """x, y, z of a voxel's rounded centroid, 1/8 voxels, whole."""
    i, j, k = unpack(blocks.keys[columns.block[row]])
    seen, local = columns.observable[row], np.int64(columns.local[row])
    return (
        STEPS * (BLOCK * i + (local & 7)) + (seen & 15),
        STEPS * (BLOCK * j + ((local >> 3) & 7)) + ((seen >> 4) & 15),
        STEPS * (BLOCK * k + (local >> 6)) + ((seen >> 8) & 15),
    )


@kernel(allocates=False)
def _count_points(columns, rows, out):  # type: ignore[no-untyped-def]
    for q in range(rows.shape[0]):
        out[q] = count_points(columns, rows[q])


@kernel(allocates=False)
def _add_blocks(blocks, keys):  # type: ignore[no-untyped-def]
    """Add the blocks of keys (B,) to none. How many."""
    for b in range(keys.shape[0]):
        add_block(blocks, b, keys[b])
    return keys.shape[0]


@kernel(allocates=False)
def _place(blocks, columns, rows):  # type: ignore[no-untyped-def]
    """Enter rows in their blocks. Returns how many lines are used."""
    num_lines = 1
    for row in range(rows):
        block, local = columns.block[row], columns.local[row]
        num_lines = put_row(blocks, num_lines, block, local, row)
        if columns.observable[row] != 0:
            blocks.occupied[block, local >> 6] |= np.uint64(1) << np.uint64(local & 63)
    return num_lines


class VoxelStore:
    """Occupied voxels with their exact moments. `insert` and `remove` are the only doors in."""

    def __init__(self, memory: Memory | None = None) -> None:
        self._memory = memory or Heap()
        blocks, rows = 256, 4096
        keys, values = rehash(np.empty(0, np.int64), 0, 1024)
        empty = Blocks(
            table_keys=keys,
            table_values=values,
            keys=np.zeros(0, np.int64),
            lines=np.zeros((0, 64), np.int32),
            rows=np.zeros((0, 8), np.int32),
            occupied=np.zeros((0, 8), np.uint64),
            neighbours=np.zeros((0, 27), np.int32),
        )
        self.blocks = empty
        self.columns = Columns(
            block=np.zeros(0, np.int32),
            local=np.zeros(0, np.int16),
            low=np.zeros((0, SUMS), np.int32),
            middle=np.zeros((0, SUMS), np.int8),
            high=np.zeros((0, SUMS), np.int32),
            poses=np.zeros((0, 3), np.int64),
            observable=np.zeros(0, np.int64),
            flags=np.zeros(0, np.uint8),
        )
        self.num_blocks = 0
        self.num_lines = 1  # line 0 is that of no voxels
        self.num_rows = 0
        self.num_voxels = 0  # occupied, as last settled
        self._grow_blocks(blocks)
        self._grow_lines(rows)
        self.columns = grow_all(self._memory, self.columns, 0, rows)
        self._touched_rows = np.empty(4096, np.int32)
        self._before = np.empty((NOTED, SUMS), np.int64)
        self._num_touched = 0
        self._rows = np.empty(AHEAD, np.int64)

    def freeze(self) -> dict[str, NDArray[Any]]:
        """Copies of the columns, of the high parts only where they are in use."""
        rows = self.num_rows
        columns = {
            name: copied(self._memory, column, rows)
            for name, column in self.columns._asdict().items()
            if name != "high"
        }
        deep = np.flatnonzero(columns["flags"] & DEEP).astype(np.int32)
        return columns | {"deep": deep, "high": self.columns.high[deep]}

    def restore(self, columns: Mapping[str, NDArray[Any]], block_keys: NDArray[np.int64]) -> None:
        """Become the store whose columns, as frozen, and block keys (B,) these are.

        Raises ValueError where they do not fit together."""
        rows, blocks = len(columns["block"]), len(block_keys)
        deep = columns["deep"]
        for name, own in self.columns._asdict().items():
            column, length = columns[name], len(deep) if name == "high" else rows
            if column.shape != (length, *own.shape[1:]) or column.dtype != own.dtype:
                raise ValueError(f"{name} is {column.dtype} {column.shape} for {length} voxels")
        if not np.array_equal(deep, np.flatnonzero(columns["flags"] & DEEP)):
            raise ValueError("the voxels of many points are others than said")
        if rows and not (columns["block"].min() >= 0 and columns["block"].max() < blocks):
            raise ValueError(f"a voxel lies in no one of {blocks} blocks")
        if rows and not (columns["local"].min() >= 0 and columns["local"].max() < BLOCK**3):
            raise ValueError("a voxel lies in no place of its block")
        if len(np.unique(block_keys)) < blocks:
            raise ValueError("a block is there twice")
        self.columns = grow_all(self._memory, self.columns, 0, rows + 4096)
        for name, own in self.columns._asdict().items():
            own[deep if name == "high" else slice(rows)] = columns[name]
        self._grow_blocks(max(blocks + 1, 256))
        self._grow_lines(rows + 4096)
        self.num_blocks, self.num_rows = _add_blocks(self.blocks, block_keys), rows
        self.num_lines = _place(self.blocks, self.columns, rows)
        self.num_voxels = int(np.count_nonzero(columns["observable"]))

    def insert(self, ticks: Ticks) -> None:
        """Add the points of scans."""
        self._apply(ticks, 1)

    def remove(self, ticks: Ticks) -> None:
        """Take the points of scans out again: the exact inverse of `insert`."""
        self._apply(ticks, -1)

    @property
    def touched(self) -> Touched:
        """The voxels whose sums changed since the last `settle`: views, good until points come."""
        count = self._num_touched
        return Touched(self._touched_rows[:count], self._before[:count] if count <= NOTED else None)

    def touch_all(self) -> None:
        """Take all voxels for touched, as if none had been looked at."""
        rows = self.occupied_rows()
        self._touched_rows, self._num_touched = rows, len(rows)
        self._before[:] = 0

    def settle(self) -> Dirty:
        """The voxels whose observable changed since the last call."""
        size = self._num_touched
        dirty = Dirty(np.empty(size, np.int32), np.empty(size, np.int64))
        count = _settle(self.blocks, self.columns, self._touched_rows, size, *dirty)
        self._num_touched = 0
        dirty = Dirty(dirty.rows[:count], dirty.before[:count])
        new, gone = dirty.before == 0, self.columns.observable[dirty.rows] == 0
        self.num_voxels += int(np.count_nonzero(new)) - int(np.count_nonzero(gone))
        return dirty

    def blocks_of(self, rows: NDArray[np.int32]) -> NDArray[np.int32]:
        """Blocks that rows (V,) lie in, ascending, each once."""
        is_one = np.zeros(self.num_blocks, np.bool_)
        is_one[self.columns.block[rows]] = True
        return np.flatnonzero(is_one).astype(np.int32)

    def voxel_keys(self, rows: NDArray[np.int32]) -> NDArray[np.int64]:
        """(V, 3) voxel indices of rows (V,)."""
        local = self.columns.local[rows].astype(np.int64)
        inside = np.stack([local & 7, (local >> 3) & 7, local >> 6], axis=-1)
        return unpack_all(self.blocks.keys[self.columns.block[rows]]) * 8 + inside

    def occupied_rows(self) -> NDArray[np.int32]:
        """(V,) rows that hold points."""
        rows = np.arange(self.num_rows, dtype=np.int32)
        return np.compress(self.num_points(rows) != 0, rows)

    def num_points(self, rows: NDArray[Any]) -> NDArray[np.int64]:
        """(V,) points that rows (V,) hold."""
        out = np.empty(len(rows), np.int64)
        _count_points(self.columns, rows, out)
        return out

    def moments(self, rows: NDArray[np.int32]) -> NDArray[np.int64]:
        """(V, 10) of rows (V,): n, sum x, y, z, sum xx, xy, xz, yy, yz, zz, local ticks 0..1023."""
        return sums_of(self.columns, rows)[:, :MOMENTS]

    def views(self, rows: NDArray[np.int32]) -> NDArray[np.int64]:
        """(V, 3) of rows (V,): sums of the quantised unit vectors towards the sensor."""
        return sums_of(self.columns, rows)[:, MOMENTS:]

    def _apply(self, ticks: Ticks, sign: int) -> None:
        own, done = (ticks.points, ticks.views, ticks.starts, ticks.pose_hashes), 0
        while done < len(ticks.points):
            used = (self.num_blocks, self.num_lines, self.num_rows, self._num_touched)
            done, used = insert_points(
                self.blocks, self.columns, own, sign, done, used, self._touched_rows, self._before,
                self._rows,
            )  # fmt: skip
            self.num_blocks, self.num_lines, self.num_rows, self._num_touched = used
            self._grow()

    def _grow(self) -> None:
        if self.num_blocks == len(self.blocks.keys):
            self._grow_blocks(2 * self.num_blocks)
        growth, rows = self._memory.growth, self.num_rows
        if self.num_lines == len(self.blocks.rows):
            self._grow_lines(growth * self.num_lines)
        if rows == len(self.columns.block):
            self.columns = grow_all(self._memory, self.columns, rows, growth * rows)
        if self._num_touched == len(self._touched_rows):
            self._touched_rows = np.resize(self._touched_rows, 2 * self._num_touched)

    def _grow_blocks(self, capacity: int) -> None:
        old, used = self.blocks, self.num_blocks
        keys, values = rehash(old.keys, used, 4 << (capacity - 1).bit_length())
        by_block = {
            name: self._memory.grown(getattr(old, name), used, capacity)
            for name in ("keys", "lines", "occupied", "neighbours")
        }
        self.blocks = old._replace(table_keys=keys, table_values=values, **by_block)

    def _grow_lines(self, capacity: int) -> None:
        old = self.blocks.rows
        rows = self._memory.grown(old, min(self.num_lines, len(old)), capacity)
        self.blocks = self.blocks._replace(rows=rows)


__all__ = ["MOMENTS", "Columns", "VoxelStore", "shift_moments"]
