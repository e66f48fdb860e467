"""The voxel store: exact integer moments by voxel, inserted and removed by one loop.

Insert and remove are the same additions with opposite signs, so their order never matters and
remove is the exact inverse of insert. `settle` says which voxels' observables changed.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from facet.mapping.blocks import Blocks, add_block, find, pack, rehash, unpack_all
from facet.mapping.kernel import kernel
from facet.mapping.quantise import VIEW, Ticks
from facet.mapping.settings import BLOCK, TICKS

# columns of `moments`: n, sum x, y, z, sum xx, xy, xz, yy, yz, zz of the local ticks 0..1023
MOMENTS = 10
SETTLED = 64  # from so many points on a centroid is rounded to 1/4 voxel: it moves half as often
# columns of `views`: sum of the quantised unit vectors towards the sensor
# columns of `poses`: line-scan points: count, sum h, sum h^2 of their pose hashes


class Columns(NamedTuple):
    """The voxels as columns, by row (V,); capacity V."""

    block: NDArray[np.int32]
    local: NDArray[np.int16]  # x + 8 y + 64 z in the block
    moments: NDArray[np.int64]  # (V, 10)
    views: NDArray[np.int64]  # (V, 3)
    poses: NDArray[np.int64]  # (V, 3), or (0, 3) while no line scan came
    observable: NDArray[np.int64]  # 0: empty
    touched: NDArray[np.bool_]  # moments changed since the last settle


@kernel
def _insert(blocks, columns, ticks, views, pose_hash, sign, start, used, touched_rows):  # type: ignore[no-untyped-def]
    """Add points from `start` on with `sign`. Returns (next point, blocks, rows, touched) used;
    next < N means that a capacity ran out and the caller must grow and go on."""
    num_blocks, num_rows, num_touched = used
    last_key = -1
    last_block = -1
    max_blocks = blocks.keys.shape[0]
    max_rows = columns.block.shape[0]
    max_touched = touched_rows.shape[0]
    for p in range(start, ticks.shape[0]):
        if num_blocks == max_blocks or num_rows == max_rows or num_touched == max_touched:
            return p, num_blocks, num_rows, num_touched
        tx, ty, tz = ticks[p, 0], ticks[p, 1], ticks[p, 2]
        i, j, k = tx >> 10, ty >> 10, tz >> 10
        key = pack(i >> 3, j >> 3, k >> 3)
        if key != last_key:
            last_key = key
            last_block = find(blocks.table_keys, blocks.table_values, key)
            if last_block < 0:
                last_block = add_block(blocks, num_blocks, key)
                num_blocks += 1
        local = (i & 7) + 8 * (j & 7) + 64 * (k & 7)
        row = blocks.rows[last_block, local]
        if row < 0:
            row = num_rows
            num_rows += 1
            blocks.rows[last_block, local] = row
            columns.block[row] = last_block
            columns.local[row] = local
        if not columns.touched[row]:
            columns.touched[row] = True
            touched_rows[num_touched] = row
            num_touched += 1
        x, y, z = tx & 1023, ty & 1023, tz & 1023
        m = columns.moments[row]
        m[0] += sign
        m[1] += sign * x
        m[2] += sign * y
        m[3] += sign * z
        m[4] += sign * x * x
        m[5] += sign * x * y
        m[6] += sign * x * z
        m[7] += sign * y * y
        m[8] += sign * y * z
        m[9] += sign * z * z
        v = columns.views[row]
        v[0] += sign * views[p, 0]
        v[1] += sign * views[p, 1]
        v[2] += sign * views[p, 2]
        if pose_hash >= 0:
            h = columns.poses[row]
            h[0] += sign
            h[1] += sign * pose_hash
            h[2] += sign * pose_hash * pose_hash
    return ticks.shape[0], num_blocks, num_rows, num_touched


@kernel
def shift_moments(own, x, y, z, total):  # type: ignore[no-untyped-def]
    """Add moments (10,) to `total`, about a corner that lies x, y, z voxels before their own."""
    n, dx, dy, dz = own[0], TICKS * x, TICKS * y, TICKS * z
    total[0] += n
    total[1] += own[1] + n * dx
    total[2] += own[2] + n * dy
    total[3] += own[3] + n * dz
    total[4] += own[4] + 2 * dx * own[1] + n * dx * dx
    total[5] += own[5] + dx * own[2] + dy * own[1] + n * dx * dy
    total[6] += own[6] + dx * own[3] + dz * own[1] + n * dx * dz
    total[7] += own[7] + 2 * dy * own[2] + n * dy * dy
    total[8] += own[8] + dy * own[3] + dz * own[2] + n * dy * dz
    total[9] += own[9] + 2 * dz * own[3] + n * dz * dz


@kernel
def _coarse(component):  # type: ignore[no-untyped-def]
    """A component of a direction, in eighths: 1, 4 or 7 with its sign. The sign is what tells the
    side of a surface; the rest mostly drifts with the sensor."""
    size = abs(component)
    eighths = np.int64(1)
    if size >= 0.6875:
        eighths = np.int64(7)
    elif size >= 0.3125:
        eighths = np.int64(4)
    return eighths if component >= 0.0 else -eighths


@kernel
def observe(moments, views, poses):  # type: ignore[no-untyped-def]
    """A voxel's observable, 49 bits: centroid in eighths (4, 4, 4), from SETTLED points on in
    quarters; votes min(n, 8) (4); direction towards the sensor, `_coarse` (5, 5, 5); mixed (1);
    pose hash + 1 of its only pose (17). What only drifts as points come in is rounded coarsely:
    each change makes some sixty neighbours stale."""
    n = moments[0]
    if n == 0:
        return np.int64(0)
    word = np.int64(0)
    coarse = 2 if n >= SETTLED else 1
    for axis in range(3):  # round half up, to 1/8 voxel, or to 1/4
        eighths = (moments[1 + axis] * 16 + n * TICKS * coarse) // (2 * n * TICKS * coarse)
        word |= (eighths * coarse) << (4 * axis)
    word |= min(n, 8) << 12
    vx, vy, vz = float(views[0]), float(views[1]), float(views[2])
    length = np.sqrt((vx * vx + vy * vy) + vz * vz)
    if length > 0.0:
        word |= (_coarse(vx / length) + 8) << 16
        word |= (_coarse(vy / length) + 8) << 21
        word |= (_coarse(vz / length) + 8) << 26
    else:
        word |= (8 << 16) | (8 << 21) | (8 << 26)
    if length < 0.5 * VIEW * n:  # seen from both sides
        word |= np.int64(1) << 31
    if poses.shape[0] > 0 and poses[0] == n and n * poses[2] == poses[1] * poses[1]:
        word |= (poses[1] // n + 1) << 32
    return word


@kernel
def _settle(blocks, columns, touched_rows, num_touched, dirty_rows):  # type: ignore[no-untyped-def]
    """Refresh the observables of touched rows. Returns how many of them changed."""
    num_dirty = 0
    no_poses = columns.poses[:0].reshape(-1)
    for t in range(num_touched):
        row = touched_rows[t]
        columns.touched[row] = False
        poses = columns.poses[row] if columns.poses.shape[0] > 0 else no_poses
        word = observe(columns.moments[row], columns.views[row], poses)
        if word == columns.observable[row]:
            continue
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


@kernel
def _add_blocks(blocks, keys):  # type: ignore[no-untyped-def]
    """Add the blocks of keys (B,) to none. How many."""
    for b in range(keys.shape[0]):
        add_block(blocks, b, keys[b])
    return keys.shape[0]


@kernel
def _place(blocks, columns, rows):  # type: ignore[no-untyped-def]
    """Enter rows in their blocks."""
    for row in range(rows):
        block, local = columns.block[row], columns.local[row]
        blocks.rows[block, local] = row
        if columns.observable[row] != 0:
            blocks.occupied[block, local >> 6] |= np.uint64(1) << np.uint64(local & 63)


def _grown(array: NDArray[np.generic], capacity: int, fill: int) -> NDArray[np.generic]:
    out = np.empty((capacity, *array.shape[1:]), array.dtype)
    out[: len(array)] = array
    out[len(array) :] = fill
    return out


class VoxelStore:
    """Occupied voxels with their exact moments. `insert` and `remove` are the only doors in."""

    def __init__(self) -> None:
        blocks, rows = 256, 4096
        keys, values = rehash(np.empty(0, np.int64), 0, 1024)
        self.blocks = Blocks(
            table_keys=keys,
            table_values=values,
            keys=np.zeros(blocks, np.int64),
            rows=np.full((blocks, 512), -1, np.int32),
            occupied=np.zeros((blocks, 8), np.uint64),
            neighbours=np.full((blocks, 27), -1, np.int32),
        )
        self.columns = Columns(
            block=np.zeros(rows, np.int32),
            local=np.zeros(rows, np.int16),
            moments=np.zeros((rows, MOMENTS), np.int64),
            views=np.zeros((rows, 3), np.int64),
            poses=np.zeros((0, 3), np.int64),
            observable=np.zeros(rows, np.int64),
            touched=np.zeros(rows, np.bool_),
        )
        self.num_blocks = 0
        self.num_rows = 0
        self._touched_rows = np.empty(4096, np.int32)
        self._num_touched = 0

    def restore(self, columns: Mapping[str, NDArray[Any]], block_keys: NDArray[np.int64]) -> None:
        """Become the store whose columns by row (V,) and block keys (B,) these are.

        Raises ValueError where they do not fit together."""
        rows, blocks = len(columns["block"]), len(block_keys)
        fresh: dict[str, Any] = {}
        for name, empty in self.columns._asdict().items():
            column, length = columns[name], len(columns[name])
            right = length == rows or (name == "poses" and length == 0)
            if not right or column.shape[1:] != empty.shape[1:] or column.dtype != empty.dtype:
                raise ValueError(f"{name} is {column.dtype} {column.shape} for {rows} voxels")
            capacity = rows + 4096 if length or name != "poses" else 0
            fresh[name] = _grown(column, capacity, 0)
        self.columns = Columns(**fresh)
        block, local = self.columns.block[:rows], self.columns.local[:rows]
        if rows and not (block.min() >= 0 and block.max() < blocks):
            raise ValueError(f"a voxel lies in no one of {blocks} blocks")
        if rows and not (local.min() >= 0 and local.max() < BLOCK**3):
            raise ValueError("a voxel lies in no place of its block")
        if len(np.unique(block_keys)) < blocks:
            raise ValueError("a block is there twice")
        self._grow_blocks(max(blocks + 1, 256))
        self.num_blocks, self.num_rows = _add_blocks(self.blocks, block_keys), rows
        _place(self.blocks, self.columns, rows)

    def insert(self, ticks: Ticks) -> None:
        """Add a scan's points."""
        self._apply(ticks, 1)

    def remove(self, ticks: Ticks) -> None:
        """Take a scan's points out again: the exact inverse of `insert`."""
        self._apply(ticks, -1)

    @property
    def touched_rows(self) -> NDArray[np.int32]:
        """(T,) rows whose moments changed since the last `settle`, a view."""
        return self._touched_rows[: self._num_touched]

    def settle(self) -> NDArray[np.int32]:
        """Dirty rows (D,): those whose observable changed since the last call."""
        dirty = np.empty(self._num_touched, np.int32)
        count = _settle(self.blocks, self.columns, self._touched_rows, self._num_touched, dirty)
        self._num_touched = 0
        return dirty[:count]

    def voxel_keys(self, rows: NDArray[np.int32]) -> NDArray[np.int64]:
        """(V, 3) voxel indices of rows (V,)."""
        local = self.columns.local[rows].astype(np.int64)
        inside = np.stack([local & 7, (local >> 3) & 7, local >> 6], axis=-1)
        return unpack_all(self.blocks.keys[self.columns.block[rows]]) * 8 + inside

    def occupied_rows(self) -> NDArray[np.int32]:
        """(V,) rows that hold points."""
        return np.flatnonzero(self.columns.moments[: self.num_rows, 0]).astype(np.int32)

    def _apply(self, ticks: Ticks, sign: int) -> None:
        if ticks.pose_hash >= 0 and not len(self.columns.poses):
            poses = np.zeros((len(self.columns.block), 3), np.int64)
            self.columns = self.columns._replace(poses=poses)
        done = 0
        while done < len(ticks.points):
            used = (self.num_blocks, self.num_rows, self._num_touched)
            done, self.num_blocks, self.num_rows, self._num_touched = _insert(
                self.blocks, self.columns, ticks.points, ticks.views, ticks.pose_hash, sign,
                done, used, self._touched_rows,
            )  # fmt: skip
            self._grow()

    def _grow(self) -> None:
        if self.num_blocks == len(self.blocks.keys):
            self._grow_blocks(2 * self.num_blocks)
        if self.num_rows == len(self.columns.block):
            capacity = self.num_rows + max(self.num_rows // 2, 4096)
            self.columns = Columns(
                *(_grown(c, capacity, 0) if len(c) else c for c in self.columns)  # type: ignore[arg-type]
            )
        if self._num_touched == len(self._touched_rows):
            self._touched_rows = np.resize(self._touched_rows, 2 * self._num_touched)

    def _grow_blocks(self, capacity: int) -> None:
        old = self.blocks
        keys, values = rehash(old.keys, self.num_blocks, 4 << (capacity - 1).bit_length())
        self.blocks = Blocks(
            keys,
            values,
            _grown(old.keys, capacity, 0),  # type: ignore[arg-type]
            _grown(old.rows, capacity, -1),  # type: ignore[arg-type]
            _grown(old.occupied, capacity, 0),  # type: ignore[arg-type]
            _grown(old.neighbours, capacity, -1),  # type: ignore[arg-type]
        )
