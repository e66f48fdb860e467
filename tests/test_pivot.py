"""Edges found by rolling a disc are those of the alpha complex, tile by tile as if whole."""

from __future__ import annotations

import math

import numpy as np
import pytest

from alpha_oracle import boundary, regular, scattered, tiled, window_of
from facet.mapping.cells import SIZE
from facet.mapping.pivot import boundary_edges
from facet.mapping.settings import ALPHA2


@pytest.mark.parametrize("count", [60, 300, 1000, 3000, 6000])
@pytest.mark.parametrize("hole", [0, 80])
def test_a_tile_has_the_edges_of_the_alpha_complex(count: int, hole: int) -> None:
    points = scattered(count + hole, count, SIZE, hole)
    edges = boundary_edges(window_of(points, (0, 0))[None])[0].astype(np.int64)
    assert regular(edges) == boundary(points)[0]


@pytest.mark.parametrize(("seed", "count"), [(0, 1500), (1, 5000), (2, 12_000)])
def test_tile_by_tile_with_halo_equals_whole(seed: int, count: int) -> None:
    points = scattered(seed, count, 3 * SIZE, 300) - [SIZE + 77, 2 * SIZE - 5]
    assert regular(tiled(points)) == boundary(points)[0]


def test_a_lattice_has_no_ties_to_get_wrong() -> None:
    """Cocircular points everywhere; no circle of radius alpha goes through three of them."""
    u, v = np.meshgrid(np.arange(0, 700, 8), np.arange(0, 300, 8))
    points = np.stack([u.ravel(), v.ravel()], axis=1).astype(np.int64)
    away = ((points - [350, 150]) ** 2).sum(axis=1) > 90**2
    found, told = regular(tiled(points[away])), boundary(points[away])[0]
    assert found == told


def test_the_alpha_radius_hits_no_grid_triangle() -> None:
    """16 area^2 ALPHA2 = a^2 b^2 c^2 has no solution on the grid: checked for small triangles."""
    reach = 24
    u, v = np.meshgrid(np.arange(-reach, reach + 1), np.arange(-reach, reach + 1))
    p = np.stack([u.ravel(), v.ravel()], axis=1)
    for a in range(1, 60):
        side = np.array([a, a // 3])
        product = (side @ side) * (p**2).sum(1) * ((p - side) ** 2).sum(1)
        cross = side[0] * p[:, 1] - side[1] * p[:, 0]
        assert not np.any((product == 4 * ALPHA2 * cross * cross) & (cross != 0))


@pytest.mark.parametrize("points", [[], [(5, 5)], [(5, 5), (20, 9)], [(5, 5), (5, 5 + 81)]])
def test_too_few_points_enclose_nothing(points: list[tuple[int, int]]) -> None:
    rows = np.array(points, np.int64).reshape(-1, 2)
    assert regular(boundary_edges(window_of(rows, (0, 0))[None])[0].astype(np.int64)) == []


def test_a_triangle_is_kept_up_to_alpha() -> None:
    """Sides of an equilateral triangle at alpha are sqrt(3) alpha."""
    side = math.sqrt(3 * ALPHA2)
    for length, kept in ((int(side) - 2, True), (int(side) + 3, False)):
        tip = (length // 2 + 100, 100 + round(length * math.sqrt(3) / 2))
        points = np.array([(100, 100), (100 + length, 100), tip], np.int64)
        edges = regular(boundary_edges(window_of(points, (0, 0))[None])[0].astype(np.int64))
        assert len(edges) == (3 if kept else 0)
        assert edges == boundary(points)[0]
