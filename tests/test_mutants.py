"""Broken cores that the laws must notice (design 3.9). Each is the core with one part replaced."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from facet.mapping import contours, describe
from facet.mapping.mapper import Mapper
from facet.mapping.quantise import Ticks
from facet.mapping.settings import TICKS
from facet.mapping.store import Dirty, VoxelStore
from facet_protocol.maps import encode_update
from facet_protocol.messages import HoleKind, MapUpdate, Scan
from mapping_logs import cloud, keeps_order, log, mapped, undoes, wall
from test_work import checks_late_work, drive_along, works

Patch = pytest.MonkeyPatch
Keep = Callable[[NDArray[np.int64], NDArray[np.int64]], object]


def late_work() -> None:
    mapper = Mapper(replace(log("room-lidar3d").settings, voxel_m=0.1))
    checks_late_work(mapper, works(mapper, drive_along()))


def order() -> None:
    keeps_order(log("room-lidar3d"), every=2, seed=8)


def orders() -> None:
    for name in ("room-lidar3d", "room-depth", "room-pushbroom"):
        for seed in (8, 9):
            keeps_order(log(name), every=2, seed=seed)


def undo() -> None:
    undoes(log("room-lidar3d"), seed=13)


def invariants() -> None:
    whole = log("room-lidar3d")
    mapped(whole.scans, whole.settings, every=3).check_invariants()


def small_change() -> None:
    """A few more points at one end of a long wall leave the outline of the rest alone."""
    rng = np.random.default_rng(0)
    mapper = mapped([cloud(wall(rng, 300_000, (24.0, 3.0), 0.005), at=(0.0, 12.0, 1.5))])
    assert mapper.work["outline_tiles"] >= 8
    for sequence in range(2, 7):
        more = np.add(wall(rng, 60, (0.2, 0.2)), [0.0, 0.05, 3.1])
        mapper.insert(cloud(more, at=(0.0, 0.0, 1.5), sequence=sequence))
        mapper.update()
        rolled = mapper.work["outline_tiles"]
        assert rolled <= 4, f"{rolled} tiles of the outline for 60 points"
    mapper.check_invariants()


LAWS = (order, orders, undo, invariants, late_work, small_change)


@pytest.mark.parametrize("law", LAWS)
def test_the_core_keeps_the_laws(law: Callable[[], object]) -> None:
    law()


def broken(law: Callable[[], object]) -> None:
    """The law notices."""
    with pytest.raises(AssertionError):
        law()


# no halo: a voxel is stale only if it is dirty itself


def shortened(patch: Patch, length: Callable[[NDArray[np.uint8]], NDArray[np.uint8]]) -> None:
    """Every region looked farther than it says: `length` of the truth."""
    field = type(Mapper()._normals)
    whole = field.update

    def update(self: object, store: VoxelStore, dirty: NDArray[np.int32]) -> object:
        result = whole(self, store, dirty)
        reach = self.normals.reach  # type: ignore[attr-defined]
        reach[:] = length(reach)
        return result

    patch.setattr(field, "update", update)


def no_halo(patch: Patch) -> None:
    shortened(patch, np.zeros_like)


@pytest.mark.parametrize("law", [order, undo, invariants])
def test_no_halo_is_noticed(law: Callable[[], object], monkeypatch: Patch) -> None:
    no_halo(monkeypatch)
    broken(law)


def test_a_halo_one_voxel_short_is_noticed(monkeypatch: Patch) -> None:
    def shorter(reach: NDArray[np.uint8]) -> NDArray[np.uint8]:
        return np.asarray(np.maximum(reach, 1) - 1, np.uint8)

    shortened(monkeypatch, shorter)
    broken(order)


# exact frames: contours in a frame that follows the exact normal. A frame here has no origin of its
# own (it is the world's), so "origin at the centroid" has no place to go wrong; an exact normal
# moves every vertex in the same way. The map stays pure: only the work tells.


def test_exact_frames_are_noticed_by_their_work(monkeypatch: Patch) -> None:
    def exact(normal: NDArray[np.float64]) -> tuple[int, int, int]:
        n = np.floor(normal * 2.0**40 + 0.5).astype(int)
        return int(n[0]), int(n[1]), int(n[2])

    monkeypatch.setattr(contours, "round_normal", exact)
    order()
    broken(small_change)


def test_a_frame_that_stays_as_it_began_is_noticed(monkeypatch: Patch) -> None:
    """The cheap way to keep frames still is memory: the first frame of each plane."""
    field = contours.ContourField
    whole = field.update

    def update(
        self: contours.ContourField,
        store: object,
        tiles: object,
        changed: object,
        normals: object,
        cuts: object,
    ) -> object:
        still = {
            i: np.array(self.contours[i].rounded, float) / contours.FRAME_UNIT
            if i in self.contours
            else normal
            for i, normal in normals.items()  # type: ignore[attr-defined]
        }
        return whole(self, store, tiles, changed, still, cuts)  # type: ignore[arg-type]

    monkeypatch.setattr(field, "update", update)
    broken(orders)


# hysteresis: an observable that moves only when it must


def remembering(patch: Patch, keep: Keep) -> None:
    """Voxels whose old and new observables (D,) `keep` accepts keep the old one."""
    settle = VoxelStore.settle

    def settles(self: VoxelStore) -> Dirty:
        rows, old = settle(self)
        new = self.columns.observable[rows]
        still = np.asarray(keep(old, new)) & (old != 0) & (new != 0)
        self.columns.observable[rows[still]] = old[still]
        return Dirty(rows[~still], old[~still])

    patch.setattr(VoxelStore, "settle", settles)


@pytest.mark.parametrize("law", [order, undo, invariants])
def test_hysteresis_is_noticed(law: Callable[[], object], monkeypatch: Patch) -> None:
    def near(old: NDArray[np.int64], new: NDArray[np.int64]) -> object:
        steps = [np.abs(((old >> s) & 15) - ((new >> s) & 15)) for s in (0, 4, 8)]
        return np.max(steps, axis=0) <= 1

    remembering(monkeypatch, near)
    broken(law)


# first wins: what came first in a voxel stays


@pytest.mark.parametrize("law", [order, undo, invariants])
def test_the_first_observable_wins_is_noticed(
    law: Callable[[], object], monkeypatch: Patch
) -> None:
    remembering(monkeypatch, lambda old, new: np.ones(len(old), bool))
    broken(law)


def test_the_first_point_wins_is_noticed(monkeypatch: Patch) -> None:
    insert = VoxelStore.insert

    def inserts(self: VoxelStore, ticks: Ticks) -> None:
        there = {tuple(v) for v in self.voxel_keys(self.occupied_rows()).tolist()}
        new = [tuple(v) not in there for v in (ticks.points // TICKS).tolist()]
        starts = np.append(0, np.cumsum(new))[ticks.starts]
        kept = ticks._replace(points=ticks.points[new], views=ticks.views[new], starts=starts)
        insert(self, kept)

    monkeypatch.setattr(VoxelStore, "insert", inserts)
    broken(order)


# cuts by the clock: the core knows no clock, so the mutant is a shell that cuts by one. The map
# does not depend on it; ids, revisions and events do, and they come back only from logged cuts.


def live(scans: tuple[Scan, ...], clock: Iterator[float]) -> tuple[list[MapUpdate], list[int]]:
    """A run that updates when 0.2 s of the clock have passed. Returns (updates, the log's cuts)."""
    mapper, updates, cuts, last = Mapper(log("room-pushbroom").settings), [], [], 0.0
    for number, scan in enumerate(scans, start=1):
        mapper.insert(scan)
        now = next(clock)
        if now - last >= 0.2 or number == len(scans):
            updates.append(mapper.update())
            cuts.append(number)
            last = now
    return updates, cuts


def replayed(scans: tuple[Scan, ...], cuts: list[int]) -> list[MapUpdate]:
    """A run that updates where the log says."""
    mapper, updates = Mapper(log("room-pushbroom").settings), []
    for number, scan in enumerate(scans, start=1):
        mapper.insert(scan)
        if number in cuts:
            updates.append(mapper.update())
    return updates


def ticking(seed: int) -> Iterator[float]:
    """A clock that is read at uneven times."""
    rng, now = np.random.default_rng(seed), 0.0
    while True:
        now += rng.exponential(0.05)
        yield now


def same(one: list[MapUpdate], two: list[MapUpdate]) -> None:
    assert [encode_update(u) for u in one] == [encode_update(u) for u in two]


def test_cuts_by_the_clock_are_noticed() -> None:
    scans = log("room-pushbroom").scans
    updates, cuts = live(scans, ticking(1))
    same(updates, replayed(scans, cuts))
    broken(lambda: same(updates, live(scans, ticking(2))[0]))


# hole kinds that are not read again


def scans_of_a_hole() -> tuple[Scan, Scan]:
    """A wall with a hole, and beams that leave through the hole and meet nothing."""
    rng = np.random.default_rng(3)
    points = wall(rng, 60_000, (3.0, 2.5), 0.004)
    y, z = points[:, 1], points[:, 2]
    hole = (y > 1.4) & (y < 2.6) & (z > 1.0) & (z < 2.2)
    beams = np.stack([np.full(4000, 4.0), *(1.2 + 1.6 * rng.random((2, 4000)))], axis=1)
    at = (0.1, 2.0, 1.7)
    return cloud(points[~hole], at=at), cloud(np.zeros((0, 3)), at=at, no_return=beams, sequence=2)


def kinds(mapper: Mapper) -> list[HoleKind]:
    (plane,) = mapper.snapshot().changed
    return [hole.kind for surface in plane.surfaces for hole in surface.holes]


def reads_holes_again() -> Mapper:
    """Beams come and go while the wall stands still: the kind of its hole follows."""
    seen, through = scans_of_a_hole()
    mapper = mapped([seen])
    blind = mapper.digest()
    assert kinds(mapper) == [HoleKind.UNOBSERVED]
    mapper.insert(through)
    mapper.update()
    assert kinds(mapper) == [HoleKind.OPENING]
    mapper.retract(through)
    mapper.update()
    assert kinds(mapper) == [HoleKind.UNOBSERVED]
    assert mapper.digest() == blind
    return mapper


def test_hole_kinds_follow_the_beams() -> None:
    reads_holes_again().check_invariants()


def test_hole_kinds_not_read_again_are_noticed(monkeypatch: Patch) -> None:
    known: dict[bytes, HoleKind] = {}
    read = describe.hole_kind

    def once(probe: NDArray[np.int64], *args: object) -> HoleKind:
        key = probe.tobytes()
        if known.get(key, HoleKind.UNOBSERVED) is HoleKind.UNOBSERVED:  # once open, open for good
            known[key] = read(probe, *args)  # type: ignore[arg-type]
        return known[key]

    monkeypatch.setattr(describe, "hole_kind", once)
    broken(reads_holes_again)
