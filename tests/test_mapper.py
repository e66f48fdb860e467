"""The whole core on things small enough to know the answer."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from facet.mapping.mapper import Mapper
from facet.mapping.settings import MapSettings
from facet_protocol.messages import EventKind, Plane, PlaneClass, Scan
from mapping_logs import cloud, log, mapped, wall

STAGES = ["settle", "normals", "patches", "tiles", "planes", "identity", "contours", "describe"]


def rng(seed: int = 0) -> np.random.Generator:
    return np.random.default_rng(seed)


def floor(seed: int, count: int, size: tuple[float, float], z: float = 0.0) -> NDArray[np.float64]:
    made = wall(rng(seed), count, size, 0.004)
    return np.stack([made[:, 1], made[:, 2], made[:, 0] - 2.03 + z], axis=1)


def only(mapper: Mapper) -> Plane:
    (plane,) = mapper.snapshot().changed
    return plane


def test_a_wall_is_one_plane() -> None:
    mapper = mapped([cloud(wall(rng(), 60_000, (3.0, 2.5), 0.008), at=(0.0, 2.0, 1.5))])
    plane = only(mapper)
    assert plane.plane_class is PlaneClass.WALL
    assert plane.d == pytest.approx(2.03, abs=0.002)
    assert plane.facing == -1  # away from the origin's side it was seen from
    assert plane.normal @ [1.0, 0.0, 0.0] > np.cos(np.radians(0.3))
    assert plane.sigma_n_m == pytest.approx(0.008, rel=0.25)
    (surface,) = plane.surfaces
    assert surface.area_m2 == pytest.approx(3.0 * 2.5, rel=0.05)
    corners = plane.lift(surface.outer)
    np.testing.assert_allclose(corners.min(0)[1:], [0.5, 0.5], atol=0.06)
    np.testing.assert_allclose(corners.max(0)[1:], [3.5, 3.0], atol=0.06)
    mapper.check_invariants()


def thin_wall(thickness: float) -> list[Plane]:
    """Planes of a free-standing wall seen from both sides, largest first."""
    near, far = wall(rng(0), 60_000, (3.0, 2.5), 0.004), wall(rng(1), 60_000, (3.0, 2.5), 0.004)
    back = cloud(np.add(far, [thickness, 0.0, 0.0]), at=(4.5, 2.0, 1.5))
    mapper = mapped([cloud(near, at=(0.0, 2.0, 1.5)), back])
    mapper.check_invariants()
    return sorted(mapper.snapshot().changed, key=lambda p: -p.num_voxels)


@pytest.mark.parametrize("thickness", [0.1, 0.15, 0.2, 0.3])
def test_both_faces_of_a_thin_wall_are_planes(thickness: float) -> None:
    near, far = sorted(thin_wall(thickness)[:2], key=lambda p: p.d)
    assert (near.facing, far.facing) == (-1, 1)
    np.testing.assert_allclose([near.d, far.d], [2.03, 2.03 + thickness], atol=0.005)


@pytest.mark.parametrize("thickness", [0.1, 0.15, 0.18, 0.2, 0.22, 0.25])
def test_nothing_stands_between_the_faces_of_a_thin_wall(thickness: float) -> None:
    """The rims of both are seen from one side, and lie on one plane: with nothing between."""
    assert len(thin_wall(thickness)) == 2


def test_a_floor_at_height_zero_keeps_its_side() -> None:
    mapper = Mapper()
    for seed in range(6):
        mapper.insert(cloud(floor(seed, 20_000, (3.0, 2.5)), at=(2.0, 2.0, 1.0)))
        mapper.update()
        plane = only(mapper)
        assert plane.plane_class is PlaneClass.FLOOR
        assert plane.normal[2] * plane.facing > 0.99
        assert 0.0 <= plane.d < 0.001
        assert plane.id == 1
    mapper.check_invariants()


def test_surfaces_of_one_plane_may_lie_apart() -> None:
    """Planes are unbounded (C5): a corridor wall goes on behind a junction."""
    one, two = wall(rng(0), 40_000, (2.0, 2.5), 0.004), wall(rng(1), 40_000, (2.0, 2.5), 0.004)
    mapper = mapped(
        [cloud(np.concatenate([one, np.add(two, [0.0, 4.0, 0.0])]), at=(0.0, 3.5, 1.5))]
    )
    assert len(only(mapper).surfaces) == 2
    mapper.check_invariants()


def test_a_corner_is_two_planes() -> None:
    points = np.concatenate([wall(rng(0), 50_000, (3.0, 2.5), 0.004), floor(1, 50_000, (3.0, 2.5))])
    mapper = mapped([cloud(points, at=(0.9, 2.0, 1.5))])
    assert sorted(p.plane_class for p in mapper.snapshot().changed) == ["floor", "wall"]
    mapper.check_invariants()


def clutter() -> Mapper:
    """200 points anywhere in 27 m^3."""
    mapper = mapped([cloud(rng().uniform(0.0, 3.0, (200, 3)), at=(0.0, 0.0, 5.0))])
    mapper.check_invariants()
    return mapper


def test_a_handful_of_points_is_hardly_a_surface() -> None:
    area = sum(s.area_m2 for p in clutter().snapshot().changed for s in p.surfaces)
    assert area < 0.5


def test_every_plane_owns_a_surface() -> None:
    """design 3.4: it owns one or more surfaces."""
    assert all(p.surfaces for p in clutter().snapshot().changed)


def story() -> tuple[Scan, Scan, Scan]:
    """Two pieces of a wall, and what joins them."""
    left, right = wall(rng(0), 30_000, (1.5, 2.0), 0.004), wall(rng(1), 50_000, (2.5, 2.0), 0.004)
    middle = wall(rng(2), 60_000, (4.0, 2.0), 0.004)
    at = (0.0, 3.0, 1.5)
    return (
        cloud(left, at=at),
        cloud(np.add(right, [0.0, 2.4, 0.0]), at=at, sequence=2),
        cloud(middle, at=at, sequence=3),
    )


def test_ids_and_events_of_a_wall_that_grows() -> None:
    left, right, middle = story()
    mapper = Mapper(map_id="story")
    mapper.insert(left)
    first = mapper.update()
    assert [(e.kind, e.plane_id) for e in first.events] == [(EventKind.CREATED, 1)]
    assert (first.map_id, first.revision, first.base_revision) == ("story", 1, 0)
    mapper.insert(right)
    mapper.insert(middle)
    second = mapper.update()
    assert [e.number for u in (first, second) for e in u.events] == list(
        range(1, 1 + len(first.events) + len(second.events))
    )
    assert only(mapper).id == 1
    assert only(mapper).revision == 2
    assert (second.revision, second.base_revision, second.stamp_ns) == (2, 1, middle.stamp_ns)
    for scan in story():
        mapper.retract(scan)
    third = mapper.update()
    assert [(t.plane_id, t.subsumed_by) for t in third.retired] == [(1, 0)]
    assert [e.kind for e in third.events] == [EventKind.RETIRED]
    mapper.insert(left)
    mapper.update()
    assert only(mapper).id == 2  # never used again
    mapper.check_invariants()


@pytest.mark.parametrize("name", ["room-lidar3d", "room-pushbroom"])
def test_ids_in_a_long_run(name: str) -> None:
    whole, mapper = log(name), Mapper(log(name).settings)
    alive: dict[int, int] = {}
    dead: set[int] = set()
    numbers = []
    for scan in whole.scans:
        mapper.insert(scan)
        update = mapper.update()
        gone = {t.plane_id for t in update.retired}
        assert gone <= alive.keys()
        dead |= gone
        alive = {i: r for i, r in alive.items() if i not in gone}
        for plane in update.changed:
            assert plane.id not in dead
            assert plane.revision == alive.get(plane.id, 0) + 1
            alive[plane.id] = plane.revision
        assert [p.id for p in mapper.snapshot().changed] == sorted(alive)
        assert all(t.subsumed_by == 0 or t.subsumed_by in alive for t in update.retired)
        numbers += [e.number for e in update.events]
    assert numbers == list(range(1, len(numbers) + 1))
    mapper.check_invariants()


def test_an_empty_map() -> None:
    mapper = Mapper()
    mapper.check_invariants()
    update = mapper.update()
    assert (update.changed, update.retired, update.events) == ((), (), ())
    assert mapper.points() == []
    mapper.insert(cloud(np.zeros((0, 3))))
    mapper.update()
    assert mapper.counts().scans == 1
    mapper.check_invariants()


def test_the_timer_hears_every_stage_in_order() -> None:
    mapper, heard = Mapper(), []
    mapper.insert(log("room-lidar3d").scans[0])
    mapper.update(heard.append)
    assert heard == STAGES


@pytest.mark.parametrize("voxel_m", [0.02, 0.05, 0.2])
def test_voxel_size_is_the_resolution_and_nothing_else(voxel_m: float) -> None:
    points = wall(rng(), 150_000, (4.0, 3.0), 0.003)
    mapper = mapped([cloud(points, at=(0.0, 2.5, 1.5))], MapSettings(voxel_m=voxel_m))
    plane = max(mapper.snapshot().changed, key=lambda p: p.num_voxels)
    assert plane.d == pytest.approx(2.03, abs=0.003)
    assert sum(s.area_m2 for s in plane.surfaces) == pytest.approx(12.0, rel=0.15)
    mapper.check_invariants()


def test_settings_out_of_range_are_refused() -> None:
    for wrong in ({"voxel_m": 0.0}, {"theta_deg": 90.0}, {"detail_level": 1.5}, {"max_radius": 99}):
        with pytest.raises(ValueError, match=next(iter(wrong))):
            MapSettings(**wrong)
