"""A plane is described again when something about it changed, and only then."""

from __future__ import annotations

from itertools import combinations

import numpy as np
import pytest

from facet.mapping.contours import Contour, make_frame
from facet.mapping.describe import Describer, Figures
from facet.mapping.fitting import fit_planes
from facet.mapping.freespace import FreeSpace
from facet.mapping.rings import Outline
from facet.mapping.settings import MapSettings
from facet.mapping.witness import Sighting

SETTINGS = MapSettings()
SCATTER = np.array([0.001, 0.0, 0.0, 30.0, 0.0, 20.0])


def figures(x: float = 2.0, sighting: Sighting | None = None, voxels: int = 70) -> Figures:
    centroid = np.array([x, 1.0, 1.0])
    weight, side = np.array([100.0]), np.array([[-1.0, 0.0, 0.0]])
    (fit,) = fit_planes(weight, centroid[None], SCATTER[None], side, SETTINGS.tick_m)
    return Figures(fit, 100, voxels, centroid, sighting or Sighting(1, 2, {"r"}))


def square(u: int, side: int = 400) -> Outline:
    ring = np.array([(u, 0), (u + side, 0), (u + side, side), (u, side)], np.int32)
    return Outline(ring, [], float(side * side))


def contour(*outlines: Outline) -> Contour:
    made = Contour((-32, 0, 0), make_frame((-32, 0, 0), SETTINGS.voxel_m))
    made.outlines = list(outlines)
    return made


def test_only_what_changed_is_described_again() -> None:
    describer, free, outline = Describer(SETTINGS), FreeSpace(), contour(square(0))
    planes = {3: figures(), 5: figures(4.0)}
    outlines = {3: outline, 5: contour(square(9))}
    assert describer.update(planes, outlines, free) == [3, 5]
    assert describer.update(planes, outlines, free) == []
    assert describer.update(planes | {3: figures(2.001)}, outlines, free) == [3]
    assert (describer[3].revision, describer[5].revision) == (2, 1)
    outlines[5].outlines = [square(10)]
    assert describer.update(planes | {3: figures(2.001)}, outlines, free) == [5]
    assert describer.update({5: planes[5]}, outlines, free) == []
    assert [p.id for p in describer.planes] == [5]


def test_the_robots_of_a_sighting_have_no_order() -> None:
    """A set of names has an order of its own in every process."""
    names = [f"robot-{k}" for k in range(40)]
    both = ((set(p), {p[1]} | {p[0]}) for p in combinations(names, 2))
    one, two = next((a, b) for a, b in both if list(a) != list(b))
    assert one == two
    describer, free, outlines = Describer(SETTINGS), FreeSpace(), {1: contour(square(0))}
    assert describer.update({1: figures(sighting=Sighting(1, 2, one))}, outlines, free) == [1]
    assert describer.update({1: figures(sighting=Sighting(1, 2, two))}, outlines, free) == []
    told = {1: figures(sighting=Sighting(1, 2, one | {"another"}))}
    assert describer.update(told, outlines, free) == [1]
    assert describer[1].robots == tuple(sorted({*one, "another"}))


def test_a_surface_keeps_its_id_where_it_stays() -> None:
    describer, free, outline = Describer(SETTINGS), FreeSpace(), contour(square(0), square(4000))
    describer.update({1: figures()}, {1: outline}, free)
    assert [s.id for s in describer[1].surfaces] == [1, 2]
    outline.outlines = [square(4010), square(-2000)]
    describer.update({1: figures()}, {1: outline}, free)
    assert [s.id for s in describer[1].surfaces] == [2, 3]
    outline.outlines = [square(-2000), square(4010), square(0)]
    describer.update({1: figures()}, {1: outline}, free)
    assert [s.id for s in describer[1].surfaces] == [3, 2, 4]  # 1 is never used again


def test_a_description_holds_the_figures() -> None:
    describer = Describer(SETTINGS)
    describer.update({7: figures()}, {7: contour(square(0))}, FreeSpace())
    plane = describer[7]
    assert (plane.id, plane.revision, plane.num_points, plane.num_voxels) == (7, 1, 100, 70)
    assert (plane.first_seen_ns, plane.last_seen_ns, plane.robots) == (1, 2, ("r",))
    assert plane.d == pytest.approx(2.0)
    assert plane.facing == -1
    assert plane.surfaces[0].area_m2 == pytest.approx((400 * 0.05 / 8) ** 2)
    lifted = plane.lift(plane.surfaces[0].outer)
    np.testing.assert_allclose(lifted @ plane.normal, plane.d, atol=1e-12)
