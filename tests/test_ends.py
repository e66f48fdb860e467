"""Planes end where their surface goes on in an arc, and nowhere else."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest
from numpy.typing import NDArray

from facet.mapping import contours
from facet.mapping.contours import FRAME_UNIT, ContourField
from facet.mapping.ends import CUT, Ends, find_ends
from facet.mapping.mapper import Mapper
from facet.mapping.normals import UNIT
from facet.mapping.planes import fit_points
from facet.mapping.settings import STEPS, MapSettings
from facet.warmup import warm_up
from facet_protocol.messages import Scan
from mapping_logs import cloud, mapped

Points = NDArray[np.float64]
HEIGHT, LENGTH, DENSITY, SIGMA = 2.4, 2.5, 8_000, 0.012  # m, m, points a square metre, m
TURN, SHIFT = np.radians(41.0), np.array([2.814, 0.4, 0.2])  # not along the grid; the border of
# a tile crosses the arc where x = 0.45
VOXEL_M = 0.05


def placed(points: Points) -> Points:
    """Points (N, 3) m of the scene in the world."""
    c, s = np.cos(TURN), np.sin(TURN)
    return np.asarray(points @ np.array([[c, s, 0.0], [-s, c, 0.0], [0.0, 0.0, 1.0]]) + SHIFT)


def back(points: Points) -> Points:
    """Points of the world in the scene."""
    c, s = np.cos(TURN), np.sin(TURN)
    return np.asarray((points - SHIFT) @ np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]]))


def raised(rng: np.random.Generator, xy: Points, normal: Points) -> Points:
    """Noisy points over places (N, 2) of a ground plan with normals (N, 2), at all heights."""
    noisy = xy + SIGMA * rng.normal(size=(len(xy), 1)) * normal
    return np.column_stack([noisy, HEIGHT * rng.random(len(xy))])


def flat(rng: np.random.Generator, start: Points, end: Points) -> Points:
    """An upright wall from one place of the ground plan to another."""
    along = np.subtract(end, start)
    length = float(np.hypot(*along))
    count = int(DENSITY * HEIGHT * length)
    normal = np.array([-along[1], along[0]]) / length
    return raised(rng, start + rng.random((count, 1)) * along, np.tile(normal, (count, 1)))


def round_corner(rng: np.random.Generator, radius: float) -> Points:
    """The wall y = 0 up to x = 0, a quarter of a circle, and the wall x = `radius` from there."""
    angle = rng.random(int(DENSITY * HEIGHT * radius * np.pi / 2)) * np.pi / 2
    out = np.stack([np.sin(angle), np.cos(angle)], axis=1)
    arc = raised(rng, radius * out - np.array([0.0, radius]), out)
    one = flat(rng, np.array([-LENGTH, 0.0]), np.zeros(2))
    two = flat(rng, np.array([radius, -radius]), np.array([radius, -radius - LENGTH]))
    return np.concatenate([one, arc, two])


def scans_of(points: Points, seen_from: tuple[float, float], count: int = 1) -> list[Scan]:
    """Points dealt out to scans from a place in the ground plan."""
    at = placed(np.array([[*seen_from, 1.2]]))[0]
    own = placed(points)
    return [cloud(own[n::count], at=at, sequence=n + 1) for n in range(count)]


def ends_of(mapper: Mapper) -> Ends:
    points = fit_points(mapper._table, mapper._planes, VOXEL_M)
    bent = mapper._bends.bent
    return find_ends(mapper._table, mapper._planes, bent, points, mapper.settings)


def ends_at(mapper: Mapper) -> tuple[Points, Points, Points]:
    """(E, 2) in the ground plan: where tile-planes end, the direction beyond, and their planes'
    normals."""
    nodes, cuts = ends_of(mapper)
    at = back(cuts[:, :3] * (VOXEL_M / STEPS))
    beyond = back(cuts[:, 3:6] / UNIT + SHIFT)
    unit = mapper._planes.nodes.unit[mapper._planes.label[nodes]]
    normals = back(unit / np.linalg.norm(unit, axis=1, keepdims=True) + SHIFT)
    return at[:, :2], beyond[:, :2], normals[:, :2]


FROM = {"within": (-0.6, -2.6), "without": (3.5, 2.0)}


@pytest.mark.parametrize("seen_from", FROM)
@pytest.mark.parametrize("radius", [1.0, 1.5])
def test_walls_end_where_an_arc_begins(radius: float, seen_from: str) -> None:
    """To a voxel, though for three to six voxels the arc is no farther off than noise."""
    points = round_corner(np.random.default_rng(4), radius)
    at, beyond, normals = ends_at(mapped(scans_of(points, FROM[seen_from])))
    for axis, place, way in ((1, [0.0, 0.0], [1.0, 0.0]), (0, [radius, -radius], [0.0, 1.0])):
        own = np.abs(normals[:, axis]) > 0.999
        assert own.any()
        np.testing.assert_allclose(at[own], [place] * own.sum(), atol=VOXEL_M)
        np.testing.assert_allclose(beyond[own], [way] * own.sum(), atol=0.02)


def polygon(*corners: tuple[float, float]) -> Points:
    """Walls from corner to corner."""
    rng = np.random.default_rng(8)
    places = np.array(corners, float)
    return np.concatenate([flat(rng, a, b) for a, b in pairwise(places)])


@pytest.mark.parametrize(
    "points",
    [
        polygon((-LENGTH, 0.0), (LENGTH, 0.0)),
        polygon((-LENGTH, 0.0), (1.0, 0.0), (1.0, -LENGTH)),
        polygon((-LENGTH, 0.0), (0.0, 0.0), (0.5, -0.15), (0.5, -LENGTH)),
        polygon((-LENGTH, 0.0), (0.0, 0.0), (0.3, -0.1), (0.6, -0.35), (0.6, -LENGTH)),
    ],
    ids=["wall", "corner", "bevel", "two bevels"],
)
def test_flat_walls_end_nowhere(points: Points) -> None:
    mapper = mapped(scans_of(points, FROM["within"]))
    assert mapper.snapshot().changed
    assert ends_of(mapper).cuts.shape == (0, CUT)


def test_an_empty_map_has_no_ends() -> None:
    assert ends_of(mapped([])).cuts.shape == (0, CUT)


def test_ends_do_not_depend_on_order_or_batches() -> None:
    scans = scans_of(round_corner(np.random.default_rng(4), 1.5), FROM["within"], 6)
    once, turned = ends_of(mapped(scans)), ends_of(mapped(scans[::-1], every=2))
    assert len(once.nodes)
    np.testing.assert_array_equal(once.nodes, turned.nodes)
    np.testing.assert_array_equal(once.cuts, turned.cuts)


def outlines(mapper: Mapper) -> list[Points]:
    """(M, 3) outer rings in the scene, largest first."""
    surfaces = [(p, s) for p in mapper.snapshot().changed for s in p.surfaces]
    surfaces.sort(key=lambda own: -own[1].area_m2)
    return [back(p.lift(s.outer)) for p, s in surfaces]


def walls_end_with_the_arc(mapper: Mapper, radius: float) -> None:
    """The outlines of both walls end within a voxel of it, and on the arc is nothing else."""
    one, two = outlines(mapper)
    if np.ptp(one[:, 1]) > np.ptp(two[:, 1]):
        one, two = two, one
    assert abs(one[:, 0].max()) < VOXEL_M
    assert abs(two[:, 1].max() + radius) < VOXEL_M
    assert abs(np.ptp(one[:, 0]) - LENGTH) < 2 * VOXEL_M
    assert abs(np.ptp(two[:, 1]) - LENGTH) < 2 * VOXEL_M


@pytest.mark.parametrize("seen_from", FROM)
def test_outlines_end_with_their_planes(seen_from: str) -> None:
    """And a part of the arc so flat that it passed for a plane has none."""
    points = round_corner(np.random.default_rng(4), 1.5)
    walls_end_with_the_arc(mapped(scans_of(points, FROM[seen_from])), 1.5)


def test_walls_run_on_where_nobody_ends_them(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(Ends, "by_tile", lambda self, table: {})
    points = round_corner(np.random.default_rng(4), 1.5)
    with pytest.raises((AssertionError, ValueError)):
        walls_end_with_the_arc(mapped(scans_of(points, FROM["within"])), 1.5)


def test_outlines_follow_an_arc_that_comes_and_goes() -> None:
    points = round_corner(np.random.default_rng(4), 1.5)
    rest = (points[:, 0] > 1.5 * np.sin(np.radians(45.0))) & (points[:, 1] < -0.44)
    (before,) = scans_of(points[~rest], FROM["within"])
    (last,) = scans_of(points[rest], FROM["within"])
    mapper = mapped([before])
    (first, *_) = outlines(mapper)
    assert not len(ends_of(mapper).nodes)
    mapper.insert(last)
    mapper.update()
    walls_end_with_the_arc(mapper, 1.5)
    assert mapper.digest() == mapped([last, before]).digest()
    mapper.retract(last)
    mapper.update()
    np.testing.assert_array_equal(outlines(mapper)[0], first)
    mapper.check_invariants()


def test_outlines_change_where_only_ends_do() -> None:
    """As when the rest of an arc is seen, tiles away."""
    mapper = mapped(scans_of(round_corner(np.random.default_rng(4), 1.5), FROM["within"]))
    field, tiles = mapper._contours, mapper._tiles.tiles
    normals = {i: np.array(c.rounded) / FRAME_UNIT for i, c in field.contours.items()}
    cuts, ended = ends_of(mapper).by_tile(mapper._table), rings_of(field)
    assert field.update(mapper._store, tiles, set(), normals, cuts) == set()
    assert field.update(mapper._store, tiles, set(), normals, {}) >= {1, 2}
    assert rings_of(field) != ended
    assert field.update(mapper._store, tiles, set(), normals, cuts) >= {1, 2}
    assert rings_of(field) == ended


def rings_of(field: ContourField) -> dict[int, list[bytes]]:
    """Outer rings by plane id."""
    return {i: [o.outer.tobytes() for o in c.outlines] for i, c in field.contours.items()}


def test_a_service_that_is_warm_has_met_an_arc(monkeypatch: pytest.MonkeyPatch) -> None:
    calls, before_end = [], contours.before_end

    def counted(*given: object) -> NDArray[np.int32]:
        calls.append(given)
        return np.asarray(before_end(*given))

    monkeypatch.setattr(contours, "before_end", counted)
    warm_up(MapSettings())
    assert calls
