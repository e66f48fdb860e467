"""A map that is not what a map must be is noticed."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from facet.mapping.invariants import check_plane, crossings, signed_area2
from facet.mapping.mapper import Mapper
from facet.mapping.quantise import Ticks, quantise
from facet_protocol.messages import Plane
from mapping_logs import log, mapped


def room() -> Mapper:
    whole = log("room-depth")
    return mapped(whole.scans, whole.settings, every=5)


def tile(mapper: Mapper) -> object:
    return next(t for t in mapper._tiles.tiles.values() if t.num_planes)


def labelled(mapper: Mapper) -> int:
    return int(np.flatnonzero(mapper._patches.patches.label >= 0)[0])


def add(array: np.ndarray, index: object, by: int) -> None:
    array[index] += by  # type: ignore[index]


def rename(mapper: Mapper) -> None:
    tile(mapper).ids[:] = 999  # type: ignore[attr-defined]


FAULTS: dict[str, Callable[[Mapper], object]] = {
    "a neighbour link": lambda m: add(m._store.blocks.neighbours, (0, 4), 1),
    "a block key": lambda m: add(m._store.blocks.keys, 3, 1),
    "a row": lambda m: add(m._store.columns.local, 5, 1),
    "a point more": lambda m: add(m._store.columns.low, (7, 0), 1),
    "a sum": lambda m: add(m._store.columns.low, (7, 1), -5000),
    "a square": lambda m: add(m._store.columns.low, (7, 4), 1 << 29),
    "a view": lambda m: add(m._store.columns.low, (7, 11), 100_000),
    "an observable": lambda m: add(m._store.columns.observable, 9, 1 << 4),
    "an occupied bit": lambda m: add(m._store.blocks.occupied, (2, 3), 1),
    "a class": lambda m: m._normals.normals.kind.__setitem__(9, 0),
    "a normal": lambda m: m._normals.normals.unit.__setitem__(slice(None), 3),
    "a label": lambda m: m._patches.patches.label.__setitem__(labelled(m), 16 * 13 + 11),
    "a lost label": lambda m: m._patches.patches.label.__setitem__(labelled(m), -1),
    "the histogram": lambda m: add(m._patches.histogram, 3, 1),
    "an occupation": lambda m: add(tile(m).occupation, 0, 1),  # type: ignore[attr-defined]
    "a plane's name": rename,
    "a count": lambda m: m._census.count(log("room-depth").scans[:1], _ticks(m), 1),
}


def _ticks(mapper: Mapper) -> Ticks:
    return quantise([log("room-depth").scans[0]], mapper.settings)


def test_a_map_is_what_it_must_be() -> None:
    room().check_invariants()


@pytest.mark.parametrize("fault", FAULTS)
def test_a_fault_is_noticed(fault: str) -> None:
    mapper = room()
    FAULTS[fault](mapper)
    with pytest.raises(AssertionError):
        mapper.check_invariants()


def test_a_map_that_missed_a_change_is_noticed() -> None:
    """All parts agree with each other, but not with the integers."""
    whole, mapper = log("room-depth"), room()
    normals = mapper._normals
    kept = type(normals.normals)(*(column.copy() for column in normals.normals))
    mapper.retract(whole.scans[0])
    mapper._store.settle()  # behind the mapper's back
    normals.normals = kept
    with pytest.raises(AssertionError):
        mapper.check_invariants()


def test_while_scans_wait_only_the_integers_are_checked() -> None:
    mapper = room()
    mapper.insert(log("room-lidar3d").scans[0])
    mapper.check_invariants()
    mapper._store.columns.low[3, 0] += 1
    with pytest.raises(AssertionError):
        mapper.check_invariants()


def plane() -> Plane:
    return max(room().snapshot().changed, key=lambda p: p.num_voxels)


def test_a_wrong_plane_is_noticed() -> None:
    good = plane()
    check_plane(good)
    surface = good.surfaces[0]
    frame = good.frame
    for bad in (
        replace(good, d=-1.0),
        replace(good, normal=good.normal * 1.001),
        replace(good, facing=-good.facing),
        replace(good, facing=0),
        replace(good, last_seen_ns=0),
        replace(good, frame=replace(frame, axis_u=frame.axis_v, axis_v=frame.axis_u)),
        replace(good, surfaces=(replace(surface, outer=surface.outer[::-1]),)),
        replace(good, surfaces=(replace(surface, area_m2=surface.area_m2 + 0.001),)),
        replace(good, surfaces=(surface, surface)),
    ):
        with pytest.raises(AssertionError):
            check_plane(bad)


def test_exact_areas_and_crossings() -> None:
    square = np.array([(0, 0), (10, 0), (10, 10), (0, 10)], np.int32)
    assert signed_area2(square) == 200
    assert signed_area2(square[::-1]) == -200
    assert len(crossings(square)) == 0
    assert crossings(square[[0, 2, 1, 3]]).tolist() == [[0, 2]]
    far = square.astype(np.int64) + (1 << 22)
    assert signed_area2(far) == 200
