"""The plan reads walls, doors and windows as they stand; the cutaway hides what is behind."""

from dataclasses import replace

import numpy as np
import pytest
from matplotlib.figure import Figure

import office
from facet.export import cutaway
from facet.export.floorplan import Piece, floor_level, wall_segments
from facet.export.picture import _draw_legend
from facet.export.viewpoint import corners, is_overhead, turned, view_rotation, walls_azimuth
from facet_protocol.messages import PlaneClass

PLANES = {plane.id: plane for plane in office.planes()}


def _pieces(number: int) -> list[tuple[Piece, float]]:
    plane = PLANES[number]
    segments = wall_segments(plane, plane.surfaces[0], 0.0)
    return [(s.piece, round(float(np.linalg.norm(s.ends[1] - s.ends[0])), 2)) for s in segments]


def test_windows_are_gaps_of_their_own_width():
    solid, window = Piece.SOLID, Piece.WINDOW
    assert _pieces(3) == [(solid, 0.8), (window, 1.2), (solid, 0.8), (window, 1.2), (solid, 1.0)]


def test_a_gap_in_the_outline_is_a_door():
    assert _pieces(4) == [(Piece.SOLID, 3.6), (Piece.DOOR, 0.9), (Piece.SOLID, 0.5)]


def test_a_shadow_is_not_a_door():
    assert (Piece.UNOBSERVED, 1.2) in _pieces(10)


def test_segments_lie_on_the_wall():
    for plane in PLANES.values():
        if plane.plane_class == "wall":
            for segment in wall_segments(plane, plane.surfaces[0], 0.0):
                p = np.column_stack([segment.ends, [1.2, 1.2]])
                np.testing.assert_allclose(p @ plane.normal, plane.d, atol=1e-9)


def test_the_cut_misses_what_is_above_it():
    assert wall_segments(PLANES[3], PLANES[3].surfaces[0], 9.0) == []


@pytest.mark.parametrize(("planes", "level"), [(office.planes(), 0.0), ((), 0.0)])
def test_floor_level(planes, level):
    assert floor_level(planes) == level


def test_a_nearer_wall_hides_the_one_behind():
    wall, behind = PLANES[11], PLANES[12]  # inward +y and inward -y: only the second is seen
    R_view_world = view_rotation([wall])
    canvas = cutaway.Canvas.fit(behind.lift(behind.surfaces[0].outer), R_view_world, 120, 90)
    canvas.fill(PLANES[16])
    before = canvas.colour.copy()
    canvas.fill(PLANES[20])  # nearer to the viewer, seen from its front
    assert (canvas.colour != before).any()
    before = canvas.colour.copy()
    canvas.fill(PLANES[16])  # behind what is drawn now
    changed = (canvas.colour != before).any(axis=2)
    assert not changed.any()


def test_view_is_a_rotation():
    R = view_rotation(office.planes())
    np.testing.assert_allclose(R @ R.T, np.eye(3), atol=1e-12)
    assert np.linalg.det(R) == pytest.approx(1.0)


def test_a_building_that_stands_askew_is_turned_straight():
    askew = [turned(plane, -0.3) for plane in office.planes()]
    assert walls_azimuth(askew) == pytest.approx(0.3)
    straight = corners(turned(plane, 0.3) for plane in askew)
    np.testing.assert_allclose(straight, corners(office.planes()), atol=1e-9)


def test_a_slope_that_looks_down_is_overhead():
    ramp = PLANES[23]
    assert not is_overhead(ramp)
    assert is_overhead(replace(ramp, facing=-ramp.facing))
    assert [plane.id for plane in PLANES.values() if is_overhead(plane)] == [2]


def test_the_legend_names_the_classes_that_are_there():
    figure = Figure()
    _draw_legend(figure, {PlaneClass.FLOOR, PlaneClass.WALL})
    (legend,) = figure.legends
    said = [text.get_text() for text in legend.get_texts()]
    assert said[:3] == ["floor", "wall", "cut away to look inside"]
    assert "other" not in said
