"""Triangles cover exactly what the rings enclose, and face the side that was seen."""

from dataclasses import replace

import numpy as np
import pytest

import office
from facet.export.triangles import (
    inward_normal,
    middle_of,
    polygon,
    surface_triangles,
    triangulate,
)
from facet_protocol.messages import HoleKind


def _area(vertices: np.ndarray, faces: np.ndarray) -> float:
    a, b, c = (vertices[faces[:, k]].astype(float) for k in range(3))
    ab, ac = b - a, c - a
    return float((ab[:, 0] * ac[:, 1] - ab[:, 1] * ac[:, 0]).sum() / 2.0)


@pytest.mark.parametrize("planes", [office.planes(), office.rough()], ids=["clean", "jagged"])
def test_areas_are_those_of_the_rings(planes):
    for plane in planes:
        for surface in plane.surfaces:
            holes = [hole.ring for hole in surface.holes]
            vertices, faces = triangulate(surface.outer, holes)
            expected = polygon(surface.outer, holes).area
            assert _area(vertices, faces) == pytest.approx(expected, rel=1e-3)


def test_the_middle_of_a_surface_lies_on_it():
    ring = office.rectangle((0.0, 0.0, 4.0, 4.0))
    floor = office.planes()[0]
    for box, expected in (((1.0, 1.0, 1.1, 1.1), (2.0, 2.0)), ((0.5, 0.5, 3.5, 3.5), None)):
        surface = office.surface(1, ring, [(HoleKind.OPENING, box)])
        x, y, z = middle_of(floor, surface)
        assert z == pytest.approx(0.0)
        if expected:
            assert (x, y) == pytest.approx(expected, abs=0.01)
        assert not (box[0] < x < box[2] and box[1] < y < box[3])
    nothing = replace(surface, outer=ring[:2], holes=())
    assert np.isnan(middle_of(floor, nothing)).all()


def test_faces_turn_towards_the_side_that_was_seen():
    for plane in office.planes():
        for surface in plane.surfaces:
            p, faces = surface_triangles(plane, surface)
            turn = np.cross(p[faces[:, 1]] - p[faces[:, 0]], p[faces[:, 2]] - p[faces[:, 0]])
            assert (turn @ inward_normal(plane) > 0.0).all()
            assert np.abs(p @ plane.normal - plane.d).max() < 1e-9


def test_a_ring_that_touches_itself_keeps_both_parts():
    bow_tie = np.array([[0, 0], [8, 0], [4, 4], [8, 8], [0, 8], [4, 4]], dtype=np.int32)
    vertices, faces = triangulate(bow_tie)
    assert _area(vertices, faces) == 32.0


@pytest.mark.parametrize("count", [0, 1, 2])
def test_less_than_a_triangle_gives_none(count):
    vertices, faces = triangulate(np.zeros((count, 2), dtype=np.int32))
    assert vertices.shape == (0, 2)
    assert faces.shape == (0, 3)


def test_a_flat_ring_gives_none():
    flat = np.array([[0, 0], [4, 4], [8, 8]], dtype=np.int32)
    assert len(triangulate(flat)[1]) == 0
