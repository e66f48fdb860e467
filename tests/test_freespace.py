"""Beams counted by cell: against the exact line, additive, and undone to nothing."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from facet.mapping.blocks import unpack_all
from facet.mapping.freespace import BEAMS_OF, SHIFT, FreeSpace
from facet.mapping.quantise import Ticks
from mapping_logs import ticks_of_one

Points = NDArray[np.int64]
NOTHING = np.zeros((0, 3), np.int64)
tick = st.integers(-100_000, 100_000)
point = st.tuples(tick, tick, tick)


def ticks_of(
    sensor: object, points: object = NOTHING, beams: object = NOTHING, hashed: int = 0
) -> Ticks:
    """A scan whose beams are all followed (a line scan's), unless `hashed` is -1."""
    hits, empty = (np.asarray(p, np.int64).reshape(-1, 3) for p in (points, beams))
    views = np.zeros((len(hits), 3), np.int16)
    return ticks_of_one(hits, views, empty, np.asarray(sensor, np.int64), hashed)


def cells_of(free: FreeSpace) -> dict[tuple[int, ...], int]:
    keys, counts = free.cells()
    return {tuple(c): int(n) for c, n in zip(unpack_all(keys).tolist(), counts, strict=True)}


def entered(a: Points, b: Points) -> set[tuple[int, ...]]:
    """Cells that the straight line a -> b enters by two ticks and more."""
    step = (b - a).astype(float)
    at = [0.0, 1.0]
    for axis in range(3):
        if step[axis]:
            low, high = sorted((int(a[axis]) >> SHIFT, int(b[axis]) >> SHIFT))
            borders = (np.arange(low, high + 2) << SHIFT).astype(float)
            cut = (borders - a[axis]) / step[axis]
            at.extend(cut[(cut > 0.0) & (cut < 1.0)].tolist())
    at.sort()
    told = set()
    for s, t in pairwise(at):
        middle = a + 0.5 * (s + t) * step
        cell = np.floor(middle / (1 << SHIFT)).astype(int)
        depth = np.minimum(middle - (cell << SHIFT), ((cell + 1) << SHIFT) - middle)
        if depth.min() >= 2.0:
            told.add(tuple(cell.tolist()))
    return told


def distance(cell: tuple[int, ...], a: Points, b: Points) -> float:
    """From a cell to the line, ticks, by dense sampling."""
    t = np.linspace(0.0, 1.0, 4001)[:, None]
    line = a + t * (b - a)
    low = np.array(cell) << SHIFT
    gap = np.maximum(np.maximum(low - line, line - (low + (1 << SHIFT) - 1)), 0.0)
    return float(gap.max(axis=1).min())


@settings(max_examples=80, deadline=None)
@given(point, point)
def test_a_beam_counts_the_cells_on_its_way_once(a: tuple[int, ...], b: tuple[int, ...]) -> None:
    free = FreeSpace()
    free.insert(ticks_of(a, beams=[b]))
    found, start, stop = cells_of(free), np.array(a), np.array(b)
    assert set(found.values()) == {1}
    must = entered(start, stop)
    assert must <= found.keys()
    spacing = np.abs(stop - start).max() / 4000 + 2.0
    assert all(distance(c, start, stop) <= spacing for c in found.keys() - must)
    manhattan = sum(abs((x >> SHIFT) - (y >> SHIFT)) for x, y in zip(a, b, strict=True))
    assert len(found) == manhattan + 1  # one face after the other: no cell is jumped over


@settings(max_examples=50, deadline=None)
@given(point, point)
def test_where_something_came_back_is_not_free(a: tuple[int, ...], b: tuple[int, ...]) -> None:
    hit, empty = FreeSpace(), FreeSpace()
    hit.insert(ticks_of(a, points=[b]))
    empty.insert(ticks_of(a, beams=[b]))
    end = tuple(c >> SHIFT for c in b)
    told = cells_of(empty)
    assert told.pop(end) == 1
    assert cells_of(hit) == told


def many(seed: int, count: int, hashed: int = 0) -> Ticks:
    rng = np.random.default_rng(seed)
    ends = rng.integers(-60_000, 60_000, (2, count, 3))
    return ticks_of(rng.integers(-20_000, 20_000, 3), ends[0], ends[1], hashed)


@settings(max_examples=20, deadline=None)
@given(st.permutations(range(5)), st.integers(0, 100))
def test_counts_add_up_in_any_order(order: list[int], seed: int) -> None:
    scans = [many(seed + k, 30, hashed=-(k % 2)) for k in range(5)]
    one, two, sums = FreeSpace(), FreeSpace(), {}
    for scan in scans:
        one.insert(scan)
        alone = FreeSpace()
        alone.insert(scan)
        for cell, n in cells_of(alone).items():
            sums[cell] = sums.get(cell, 0) + n
    for k in order:
        two.insert(scans[k])
    assert cells_of(one) == cells_of(two) == sums


@settings(max_examples=20, deadline=None)
@given(st.integers(0, 100))
def test_removed_beams_leave_nothing(seed: int) -> None:
    kept, gone = many(seed, 40), many(seed + 1, 60, hashed=-(seed % 2))
    free, fresh = FreeSpace(), FreeSpace()
    fresh.insert(kept)
    free.insert(gone)
    free.insert(kept)
    free.remove(gone)
    assert cells_of(free) == cells_of(fresh)
    free.remove(kept)
    assert cells_of(free) == {}


def test_a_cloud_is_thinned_by_a_hash_of_its_ends() -> None:
    """The same beams whatever else is in the scan: so it adds up."""
    whole = many(7, 4000, hashed=-1)
    halves = [ticks_of(whole.sensors[0], p, b, -1) for p, b in (
        (whole.points[::2], whole.beams[1::2]), (whole.points[1::2], whole.beams[::2]),
    )]  # fmt: skip
    one, two, all_of = FreeSpace(), FreeSpace(), FreeSpace()
    one.insert(whole)
    for half in halves:
        two.insert(half)
    all_of.insert(whole._replace(pose_hashes=np.zeros(1, np.int64)))
    assert cells_of(one) == cells_of(two)
    share = sum(cells_of(one).values()) / sum(cells_of(all_of).values())
    assert share == pytest.approx(1.0 / BEAMS_OF, rel=0.15)


def test_passed_reads_the_counts() -> None:
    free = FreeSpace()
    scan = ticks_of((0, 0, 0), beams=[(40_000, 10, 20)])
    spots = np.array([(20_000, 100, 4000), (20_000, 5000, 20), (90_000, 10, 20), (-1, 10, 20)])
    assert free.passed_all(spots[None], 1) == 0
    for times in (1, 2, 3):
        free.insert(scan)
        passed = [free.passed_all(spot[None, None], 3) for spot in spots]
        assert passed == [int(times == 3), 0, 0, 0]
    through = (30_000, 75, 150), (10_000, 25, 50)
    assert free.passed_all(np.array([[spots[0], spots[0]], through]), 3) == 2
    assert free.passed_all(np.array([[spots[0], spots[1]], through]), 3) == 1  # of either column
    free.remove(scan)
    assert free.passed_all(spots[None], 3) == 0


def test_growing_loses_nothing() -> None:
    rng = np.random.default_rng(3)
    ends = rng.integers(-1_500_000, 1_500_000, (300, 3))
    free, parts = FreeSpace(), {}
    free.insert(ticks_of((0, 0, 0), beams=ends))
    assert free.num_blocks > 4096
    for end in ends:
        one = FreeSpace()
        one.insert(ticks_of((0, 0, 0), beams=[end]))
        for cell, n in cells_of(one).items():
            parts[cell] = parts.get(cell, 0) + n
    assert cells_of(free) == parts
