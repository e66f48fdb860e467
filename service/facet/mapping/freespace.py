"""Free space: how many beams passed each coarse cell. Integers, additive, undone exactly."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from facet.mapping.blocks import Int64Array, find, hash_key, pack, put, rehash, unpack
from facet.mapping.kernel import kernel
from facet.mapping.memory import Heap, Memory, copied
from facet.mapping.quantise import Ticks
from facet.mapping.settings import TICKS

CELL = 4  # voxels per cell edge
SHIFT = 12  # ticks to cells: 2^12 = CELL * TICKS
IN_BLOCK = SHIFT + 3  # ticks to blocks of 8 cells
BEAMS_OF = 8  # of a cloud's beams one in so many, a power of two, is followed: by a hash of its end
FAR = np.int64(1) << 62  # an axis whose last cell is reached goes no farther
FIRST_BLOCKS = 1024  # capacity to begin with

assert 1 << SHIFT == CELL * TICKS


@kernel(allocates=False)
def _block(table, keys, num_blocks, key):  # type: ignore[no-untyped-def]
    """The block `key`, a new one where there is none; and the number of blocks."""
    block = np.int64(find(table[0], table[1], key))
    if block < 0:
        block = num_blocks
        put(table[0], table[1], key, block)
        keys[block] = key
        num_blocks += 1
    return block, num_blocks


@kernel(allocates=False)
def _pass(table, counts, keys, passed, num_blocks, a, b, sign, ends):  # type: ignore[no-untyped-def]
    """Count a beam from a to b (ticks) in every cell it passes, and note in which blocks these are;
    the last one only if nothing is there (`ends` false). Amanatides & Woo 1987, in integers."""
    i, j, k = a[0] >> SHIFT, a[1] >> SHIFT, a[2] >> SHIFT
    ei, ej, ek = b[0] >> SHIFT, b[1] >> SHIFT, b[2] >> SHIFT
    d0, d1, d2 = b[0] - a[0], b[1] - a[1], b[2] - a[2]
    s0, s1, s2 = (1 if d0 > 0 else -1), (1 if d1 > 0 else -1), (1 if d2 > 0 else -1)
    # distance to the next border along each axis, over the axis' length: compared crosswise
    n0 = ((i + 1) << SHIFT) - a[0] if d0 > 0 else a[0] - (i << SHIFT) + 1
    n1 = ((j + 1) << SHIFT) - a[1] if d1 > 0 else a[1] - (j << SHIFT) + 1
    n2 = ((k + 1) << SHIFT) - a[2] if d2 > 0 else a[2] - (k << SHIFT) + 1
    l0, l1, l2 = abs(d0), abs(d1), abs(d2)
    e01, e02, e12 = n0 * l1 - n1 * l0, n0 * l2 - n2 * l0, n1 * l2 - n2 * l1  # <= 0: the first axis
    if i == ei:
        e01, e02 = FAR, FAR
    if j == ej:
        e01, e12 = -FAR, FAR
    if k == ek:
        e02, e12 = -FAR if i != ei else FAR, -FAR
    last, block = np.int64(-1), np.int64(-1)
    l0, l1, l2 = l0 << SHIFT, l1 << SHIFT, l2 << SHIFT
    for _ in range(abs(ei - i) + abs(ej - j) + abs(ek - k)):
        key = pack(i >> 3, j >> 3, k >> 3)
        if key != last:
            block, num_blocks = _block(table, keys, num_blocks, key)
            passed[0][block] = passed[1]
            last = key
        counts[block, (i & 7) + 8 * (j & 7) + 64 * (k & 7)] += sign
        if e01 <= 0 and e02 <= 0:
            i += s0
            e01, e02 = (e01 + l1, e02 + l2) if i != ei else (FAR, FAR)
        elif e12 <= 0:
            j += s1
            e01, e12 = (e01 - l0, e12 + l2) if j != ej else (-FAR, FAR)
        else:
            k += s2
            e02, e12 = (e02 - l0, e12 - l1) if k != ek else (-FAR, -FAR)
    if not ends:
        block, num_blocks = _block(table, keys, num_blocks, pack(i >> 3, j >> 3, k >> 3))
        passed[0][block] = passed[1]
        counts[block, (i & 7) + 8 * (j & 7) + 64 * (k & 7)] += sign
    return num_blocks


@kernel(allocates=False)
def _blocks_apart(a, b):  # type: ignore[no-untyped-def]
    """Blocks between two points (ticks), axis by axis."""
    total = 0
    for axis in range(3):
        total += abs((a[axis] >> IN_BLOCK) - (b[axis] >> IN_BLOCK))
    return total


@kernel(allocates=False)
def _pass_all(  # type: ignore[no-untyped-def]
    table, counts, keys, passed, num_blocks, scans, points, starts, start, sign, ends
):
    """Follow the chosen beams from `start` on, those of scans (S,) with (sensors, pose_hashes)
    beginning at starts (S + 1,). passed: when blocks were passed last (B,), and what time it is.
    Returns (next beam, number of blocks)."""
    sensors, pose_hashes = scans
    scan, every = -1, 1
    for p in range(start, points.shape[0]):
        while p >= starts[scan + 1]:
            scan += 1
            every = BEAMS_OF if pose_hashes[scan] < 0 else 1
        sensor = sensors[scan]
        mixed = hash_key(
            points[p, 0] * 73856093 ^ points[p, 1] * 19349663 ^ points[p, 2] * 83492791
        )
        if mixed & (every - 1) != 0:
            continue
        most = 3 + _blocks_apart(sensor, points[p])  # that this beam can add
        if num_blocks + most > counts.shape[0]:
            return p, num_blocks
        num_blocks = _pass(table, counts, keys, passed, num_blocks, sensor, points[p], sign, ends)
    return points.shape[0], num_blocks


@kernel(allocates=False)
def passed_all(table_keys, table_values, counts, points, least):  # type: ignore[no-untyped-def]
    """In how many of N columns of points (M, N, 3) ticks every cell was passed by at least `least`
    beams."""
    number = 0
    for n in range(points.shape[1]):
        through = True
        for m in range(points.shape[0]):
            x, y, z = points[m, n]
            i, j, k = x >> SHIFT, y >> SHIFT, z >> SHIFT
            block = find(table_keys, table_values, pack(i >> 3, j >> 3, k >> 3))
            local = (i & 7) + 8 * (j & 7) + 64 * (k & 7)
            if block < 0 or counts[block, local] < least:
                through = False
                break
        number += through
    return number


@kernel
def blocks_of(points):  # type: ignore[no-untyped-def]
    """Keys of the blocks that points (M, N, 3) ticks lie in, ascending."""
    keys, count = np.empty(points.shape[0] * points.shape[1], np.int64), 0
    for m in range(points.shape[0]):
        for n in range(points.shape[1]):
            x, y, z = points[m, n]
            keys[count] = pack(x >> IN_BLOCK, y >> IN_BLOCK, z >> IN_BLOCK)
            if count == 0 or keys[count] != keys[count - 1]:
                count += 1
    return np.unique(keys[:count])


class FreeSpace:
    """Beam counts by cell of 4 voxels, in dense blocks of 8^3 cells."""

    def __init__(self, memory: Memory | None = None) -> None:
        self._memory = memory or Heap()
        self._keys = np.zeros(FIRST_BLOCKS, np.int64)
        self._counts = self._memory.grown(np.zeros((0, 512), np.int32), 0, FIRST_BLOCKS)
        self._table = rehash(self._keys, 0, 4 * FIRST_BLOCKS)
        self._passed = np.zeros(FIRST_BLOCKS, np.int64)  # when a block was passed last
        self.num_blocks, self.now = 0, 1

    def freeze(self) -> tuple[Int64Array, NDArray[np.int32]]:
        """Copies of block keys (B,) and their cells' counts (B, 512)."""
        counts = copied(self._memory, self._counts, self.num_blocks)
        return self._keys[: self.num_blocks].copy(), counts

    def restore(self, keys: Int64Array, counts: NDArray[np.int32]) -> None:
        """Become what was frozen. Raises ValueError for what does not fit together."""
        if counts.shape != (len(keys), 512) or len(np.unique(keys)) < len(keys):
            raise ValueError(f"{counts.shape} cells for {len(keys)} blocks of free space")
        capacity = max(FIRST_BLOCKS, len(keys))
        self._keys, self._passed = np.zeros((2, capacity), np.int64)
        self._counts = self._memory.grown(self._counts, 0, capacity)
        self._keys[: len(keys)], self._counts[: len(keys)] = keys, counts
        self._table = rehash(self._keys, len(keys), 4 << (capacity - 1).bit_length())
        self.num_blocks, self._passed[: len(keys)] = len(keys), self.now

    def passed_since(self, then: int) -> list[int]:
        """Keys of the blocks that a beam passed, or was taken out of, after the time `then`. Each
        call begins a new `now`."""
        self.now += 1
        lately = np.flatnonzero(self._passed[: self.num_blocks] > then)
        return [int(key) for key in self._keys[lately]]

    def insert(self, ticks: Ticks) -> None:
        """Count the beams of scans."""
        self._apply(ticks, 1)

    def remove(self, ticks: Ticks) -> None:
        """Take the beams of scans out again."""
        self._apply(ticks, -1)

    def passed_all(self, points: Int64Array, least: int) -> int:
        """In how many of N columns of points (M, N, 3) ticks, world, at least `least` beams passed
        the cell of every one."""
        return int(passed_all(*self._table, self._counts, points, least))

    def cells(self) -> tuple[Int64Array, NDArray[np.int32]]:
        """Keys (C,), ascending, and counts (C,) of the cells that were passed."""
        block, local = np.nonzero(self._counts[: self.num_blocks])
        keys = np.empty(len(block), np.int64)
        _cell_keys(self._keys, block, local, keys)
        order = np.argsort(keys)
        return keys[order], self._counts[block, local][order]

    def _apply(self, ticks: Ticks, sign: int) -> None:
        scans, passed = (ticks.sensors, ticks.pose_hashes), (self._passed, self.now)
        hits, empty = (ticks.points, ticks.starts, True), (ticks.beams, ticks.beam_starts, False)
        for points, starts, ends in (hits, empty):
            done = 0
            while done < len(points):
                done, self.num_blocks = _pass_all(
                    self._table, self._counts, self._keys, passed, self.num_blocks, scans,
                    points, starts, done, sign, ends,
                )  # fmt: skip
                if done < len(points):
                    self._grow()
                    passed = self._passed, self.now

    def _grow(self) -> None:
        capacity = 2 * len(self._keys)
        self._keys = np.concatenate([self._keys, np.zeros_like(self._keys)])
        self._passed = np.concatenate([self._passed, np.zeros_like(self._passed)])
        self._counts = self._memory.grown(self._counts, self.num_blocks, capacity)
        self._table = rehash(self._keys, self.num_blocks, 4 << (capacity - 1).bit_length())


@kernel(allocates=False)
def _cell_keys(block_keys, block, local, out):  # type: ignore[no-untyped-def]
    for c in range(block.shape[0]):
        i, j, k = unpack(block_keys[block[c]])
        x, y, z = local[c] & 7, (local[c] >> 3) & 7, local[c] >> 6
        out[c] = pack(8 * i + x, 8 * j + y, 8 * k + z)
