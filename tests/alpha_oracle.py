"""The boundary of an alpha complex by the plain definition: Delaunay, then a test in integers."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import Delaunay

from facet.mapping.cells import SIZE
from facet.mapping.pivot import CELLS, HALO, boundary_edges
from facet.mapping.settings import ALPHA2

Edge = tuple[int, int, int, int]
Grid = NDArray[np.int64]


def alpha_triangles(points: Grid) -> tuple[Grid, int]:
    """Triangles (T, 3) with circumradius^2 <= ALPHA2, counter-clockwise, and twice their area."""
    triangles = Delaunay(points.astype(float)).simplices
    a, b, c = (points[triangles[:, i]].astype(object) for i in range(3))  # Python's integers
    cross = (b[:, 0] - a[:, 0]) * (c[:, 1] - a[:, 1]) - (b[:, 1] - a[:, 1]) * (c[:, 0] - a[:, 0])
    sides = ((d[:, 0] ** 2 + d[:, 1] ** 2) for d in (a - b, b - c, c - a))
    p, q, r = sides
    kept = (p * q * r <= 4 * cross * cross * ALPHA2).astype(bool) & (cross != 0).astype(bool)
    triangles, cross = triangles[kept], cross[kept]
    ordered = np.where((cross > 0).astype(bool)[:, None], triangles, triangles[:, [0, 2, 1]])
    return ordered.astype(np.int64), int(sum(abs(x) for x in cross))


def boundary(points: Grid) -> tuple[list[Edge], int]:
    """Directed edges on the boundary, the complex on their left, and twice its area."""
    triangles, area2 = alpha_triangles(points)
    sides = {(i, j) for t in triangles.tolist() for i, j in zip(t, [*t[1:], t[0]], strict=True)}
    rows = points.tolist()
    return sorted((*rows[i], *rows[j]) for i, j in sides if (j, i) not in sides), area2


def window_of(points: Grid, place: tuple[int, int]) -> NDArray[np.uint64]:
    """Cells of a (u, v) tile and its halo."""
    window = np.zeros((CELLS + 2 * HALO,) * 2, np.uint64)
    cell = (points >> 3) - np.array(place) * CELLS + HALO
    inside = np.all((cell >= 0) & (cell < CELLS + 2 * HALO), axis=1)
    bit = (points[:, 0] & 7) + 8 * (points[:, 1] & 7)
    for (u, v), b in zip(cell[inside].tolist(), bit[inside].tolist(), strict=True):
        window[v, u] |= np.uint64(1) << np.uint64(b)
    return window


def tiled(points: Grid) -> Grid:
    """(E, 4) edges found tile by tile, each with its halo only."""
    parts = [np.zeros((0, 4), np.int64)]
    for place in np.unique(points // SIZE, axis=0).tolist():
        edges = boundary_edges(window_of(points, tuple(place))[None])[0].astype(np.int64)
        parts.append(edges + np.tile(np.array(place) * SIZE, 2))
    return np.concatenate(parts)


def regular(edges: Grid) -> list[Edge]:
    """Those with the complex on one side only."""
    found = {tuple(e) for e in edges.tolist()}
    return sorted(e for e in found if (e[2], e[3], e[0], e[1]) not in found)


def scattered(seed: int, count: int, width: int, hole: int = 0) -> Grid:
    """Different grid points in a square, but for a round hole in its middle."""
    rng = np.random.default_rng(seed)
    points = np.unique(rng.integers(0, width, (count, 2)), axis=0)
    away = ((points - width // 2) ** 2).sum(axis=1) > hole * hole
    return points[away]
