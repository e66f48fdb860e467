"""Planes end where their surface goes on in an arc, and nowhere else."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest
from numpy.typing import NDArray

from facet.mapping.ends import CUT, Ends, find_ends
from facet.mapping.mapper import Mapper
from facet.mapping.normals import UNIT
from facet.mapping.planes import fit_points
from facet.mapping.settings import STEPS
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
