"""Triangles of a bounded surface with holes, in its plane. Rings are taken as they are."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import shapely
from numpy.typing import NDArray

from facet_protocol.messages import Plane, Surface

Ring = NDArray[np.int32]  # (M, 2) frame units


def polygon(outer: Ring, holes: Sequence[Ring] = ()) -> shapely.Geometry:
    """The area inside `outer` and outside `holes`; rings that touch or cross are mended."""
    if len(outer) < 3:
        return shapely.MultiPolygon()
    area = shapely.Polygon(outer, [ring for ring in holes if len(ring) >= 3])
    return area if area.is_valid else shapely.make_valid(area, method="structure")


def triangulate(outer: Ring, holes: Sequence[Ring] = ()) -> tuple[Ring, NDArray[np.uint32]]:
    """Vertices (V, 2) in frame units and faces (T, 3), counter-clockwise in (u, v).

    Constrained Delaunay. A vertex that mending a crossing made is rounded to the frame's units.
    """
    parts = shapely.constrained_delaunay_triangles(polygon(outer, holes))
    corners = shapely.get_coordinates(parts).reshape(-1, 4, 2)[:, :3]
    lattice = np.round(corners.reshape(-1, 2)).astype(np.int32)
    vertices, rows = np.unique(lattice, axis=0, return_inverse=True)
    return vertices, _counter_clockwise(vertices, rows.reshape(-1, 3).astype(np.uint32))


def _counter_clockwise(vertices: Ring, faces: NDArray[np.uint32]) -> NDArray[np.uint32]:
    a, b, c = (vertices[faces[:, k]].astype(np.int64) for k in range(3))
    ab, ac = b - a, c - a
    twice = ab[:, 0] * ac[:, 1] - ab[:, 1] * ac[:, 0]
    faces, twice = faces[twice != 0], twice[twice != 0]
    return np.where((twice < 0)[:, None], faces[:, ::-1], faces)


def surface_triangles(
    plane: Plane, surface: Surface
) -> tuple[NDArray[np.float64], NDArray[np.uint32]]:
    """Vertices (V, 3) m, world, and faces (T, 3), counter-clockwise seen from the facing side."""
    vertices, faces = triangulate(surface.outer, [hole.ring for hole in surface.holes])
    return plane.lift(vertices), faces


def middle_of(plane: Plane, surface: Surface) -> NDArray[np.float64]:
    """(3,) m, world: the surface's centroid, or where that is in none of it, a point that is. NaN
    when it has no area."""
    area = polygon(surface.outer, [hole.ring for hole in surface.holes])
    middle = shapely.centroid(area)
    if not shapely.contains(area, middle):
        middle = shapely.point_on_surface(area)
    if shapely.is_empty(middle):
        return np.full(3, np.nan)
    return np.asarray(plane.lift(shapely.get_coordinates(middle))[0])


def inward_normal(plane: Plane) -> NDArray[np.float64]:
    """(3,) unit, world: towards the side from which the plane was seen."""
    return np.asarray(plane.facing * plane.normal)
