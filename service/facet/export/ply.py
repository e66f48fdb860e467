"""PLY: the points with their planes; or, where there are none, the surfaces as triangles."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from plyfile import PlyData, PlyElement

from facet.export.colours import CLASS_COLOURS, point_colours
from facet.export.triangles import inward_normal, surface_triangles
from facet_protocol.messages import Plane, TilePoints

POSITION = [("x", "f4"), ("y", "f4"), ("z", "f4")]
NORMAL = [("nx", "f4"), ("ny", "f4"), ("nz", "f4")]
COLOUR = [("red", "u1"), ("green", "u1"), ("blue", "u1")]
LABEL = [("plane_id", "i4")]
VERTEX = np.dtype(POSITION + NORMAL + COLOUR + LABEL)
FACE = np.dtype([("vertex_indices", "i4", (3,)), ("plane_id", "i4")])


def write_points(planes: Sequence[Plane], tiles: Sequence[TilePoints], path: Path) -> None:
    """One vertex a voxel: its centroid, its plane's inward normal and id (0 on no plane)."""
    ids = np.concatenate([tile.plane_ids for tile in tiles])
    xyz = np.concatenate([tile.xyz() for tile in tiles])
    colours = point_colours(ids, {plane.id: plane.plane_class for plane in planes})
    vertices = _vertices(xyz, _normals(planes, ids), colours, ids)
    _write([PlyElement.describe(vertices, "vertex")], path)


def write_surfaces(planes: Sequence[Plane], path: Path) -> None:
    """The surfaces as triangles, coloured by class, each face with its plane's id."""
    vertices, faces, first = [], [], 0
    for plane in planes:
        for surface in plane.surfaces:
            xyz, corners = surface_triangles(plane, surface)
            ids = np.full(len(xyz), plane.id, dtype=np.int32)
            normals = np.broadcast_to(inward_normal(plane), xyz.shape)
            colours = np.broadcast_to(CLASS_COLOURS[plane.plane_class], xyz.shape)
            vertices.append(_vertices(xyz, normals, colours, ids))
            face = np.zeros(len(corners), dtype=FACE)
            face["vertex_indices"] = corners + np.uint32(first)
            face["plane_id"] = plane.id
            faces.append(face)
            first += len(xyz)
    vertex = np.concatenate([np.zeros(0, dtype=VERTEX), *vertices])
    face = np.concatenate([np.zeros(0, dtype=FACE), *faces])
    _write([PlyElement.describe(vertex, "vertex"), PlyElement.describe(face, "face")], path)


def _normals(planes: Sequence[Plane], ids: NDArray[np.int32]) -> NDArray[np.float64]:
    known = {plane.id: inward_normal(plane) for plane in planes}
    unique, rows = np.unique(ids, return_inverse=True)
    table = np.array([known.get(int(i), np.zeros(3)) for i in unique]).reshape(-1, 3)
    return np.asarray(table[rows])


def _vertices(
    xyz: NDArray[np.floating],
    normals: NDArray[np.floating],
    colours: NDArray[np.integer],
    ids: NDArray[np.int32],
) -> NDArray[np.void]:
    vertices = np.zeros(len(xyz), dtype=VERTEX)
    for fields, columns in ((POSITION, xyz), (NORMAL, normals), (COLOUR, colours)):
        for k, (name, _) in enumerate(fields):
            vertices[name] = columns[:, k]
    vertices["plane_id"] = ids
    return vertices


def _write(elements: list[PlyElement], path: Path) -> None:
    comments = ["facet: metres, z up; plane_id 0 is on no plane"]
    PlyData(elements, byte_order="<", comments=comments).write(str(path))
