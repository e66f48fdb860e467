"""Boundary edges become rings, rings become surfaces with holes."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from alpha_oracle import boundary, scattered, tiled
from facet.mapping.cells import SIZE
from facet.mapping.invariants import crossings, signed_area2
from facet.mapping.rings import OUTWARD, inside, outward, stitch, surfaces_of

Grid = NDArray[np.int64]


def ring_edges(*rings: list[tuple[int, int]]) -> Grid:
    """Directed edges (E, 4) of rings, in no order."""
    edges = [(*p, *q) for ring in rings for p, q in zip(ring, [*ring[1:], ring[0]], strict=True)]
    return np.random.default_rng(0).permutation(np.array(edges, np.int64))


def square(u: int, v: int, side: int) -> list[tuple[int, int]]:
    """Counter-clockwise."""
    return [(u, v), (u + side, v), (u + side, v + side), (u, v + side)]


def lattice(low: int, high: int, hole: tuple[int, int] | None = None) -> Grid:
    """Every eighth grid point of a square, but for a square hole."""
    side = np.arange(low, high + 1, 8)
    u, v = np.meshgrid(side, side)
    points = np.stack([u.ravel(), v.ravel()], axis=1)
    if hole:
        points = points[~np.all((points > hole[0]) & (points < hole[1]), axis=1)]
    return points


@pytest.mark.parametrize("seed", range(6))
def test_ring_areas_sum_to_triangle_areas(seed: int) -> None:
    points = scattered(seed, [900, 2500, 7000][seed % 3], 2 * SIZE, 150 * (seed % 2))
    edges, area2 = boundary(points)
    rings = stitch(tiled(points))
    assert sum(signed_area2(r) for r in rings) == area2
    assert sum(len(r) for r in rings) == len(edges)
    assert all(len(crossings(r)) == 0 for r in rings)


def test_the_order_of_edges_does_not_matter() -> None:
    edges = tiled(scattered(3, 4000, SIZE, 60))
    told = stitch(edges)
    for seed in range(3):
        mixed = np.random.default_rng(seed).permutation(edges)
        again = stitch(np.concatenate([mixed, mixed[:50]]))  # and an edge told twice is one
        for a, b in zip(told, again, strict=True):
            np.testing.assert_array_equal(a, b)


def test_a_square_with_a_hole_is_one_outer_ring_and_one_hole() -> None:
    """method.md 10.8"""
    points = lattice(0, 480, hole=(160, 320))
    (surface,) = surfaces_of(tiled(points), 100.0)
    assert len(surface.holes) == 1
    assert signed_area2(surface.outer) > 0 > signed_area2(surface.holes[0])
    hole, outer = sorted(signed_area2(r) / 2 for r in stitch(tiled(points)))
    assert outer == 480.0**2
    assert -(160.0**2) < hole < -0.85 * 160.0**2  # the disc does not get into the corners
    assert outer + hole == boundary(points)[1] / 2
    assert surface.area > outer + hole


def test_surfaces_apart_are_two() -> None:
    points = np.concatenate([lattice(0, 160), np.add(lattice(0, 240), [400, 0])])
    assert [len(s.holes) for s in surfaces_of(tiled(points), 100.0)] == [0, 0]
    assert len(surfaces_of(tiled(points), 200.0**2)) == 1


def test_an_island_in_a_hole_is_a_surface_of_its_own() -> None:
    points = np.concatenate([lattice(0, 800, hole=(160, 640)), lattice(320, 480)])
    outer, island = sorted(surfaces_of(tiled(points), 100.0), key=lambda s: -s.area)
    assert len(outer.holes) == 1
    assert island.holes == []


def test_each_hole_goes_to_the_surface_round_it() -> None:
    inner = square(40, 40, 20)[::-1], square(340, 40, 60)[::-1]
    edges = ring_edges(square(0, 0, 100), square(300, 0, 200), *inner)
    small, large = sorted(surfaces_of(edges, 1.0), key=lambda s: s.area)
    assert (len(small.holes), len(large.holes)) == (1, 1)
    assert small.holes[0][:, 0].max() < 100 < 300 < large.holes[0][:, 0].min()


def test_surfaces_that_touch_in_a_point_stay_apart() -> None:
    edges = ring_edges(square(0, 0, 10), square(10, 10, 10))
    assert [signed_area2(r) for r in stitch(edges)] == [200, 200]


def test_a_hole_that_touches_its_ring_in_a_point_is_a_hole() -> None:
    """A ring that comes back to a vertex is split there: no ring touches itself."""
    pinched = [(0, 0), (10, 5), (5, 10)]
    edges = ring_edges(square(0, 0, 30), pinched[::-1])
    outer, hole = sorted(stitch(edges), key=signed_area2, reverse=True)
    assert signed_area2(outer) == 2 * 900
    assert signed_area2(hole) == -75


def test_an_edge_both_ways_bounds_nothing() -> None:
    strip = np.array([(10, 10, 40, 10), (40, 10, 10, 10)], np.int64)
    edges = np.concatenate([ring_edges(square(0, 0, 10)), strip])
    assert len(stitch(edges)) == 1
    assert stitch(strip) == []
    assert stitch(np.zeros((0, 4), np.int64)) == []


def gate() -> Grid:
    """Points on a square with a door at its low side, grid units."""
    points = lattice(0, 480)
    return points[~((points[:, 0] > 160) & (points[:, 0] < 320) & (points[:, 1] < 320))]


def test_a_row_of_voxels_closes_a_door() -> None:
    (open_one,) = surfaces_of(tiled(gate()), 800.0)
    assert open_one.holes == []
    row = np.stack([np.arange(160, 321, 8), np.full(21, 5)], axis=1)
    (closed,) = surfaces_of(tiled(np.concatenate([gate(), row])), 800.0)
    (hole,) = closed.holes
    assert signed_area2(hole) / 2 == pytest.approx(-160.0 * 315.0, rel=0.12)  # less in its corners
    assert closed.area == pytest.approx(open_one.area, rel=0.02)
    assert len(crossings(closed.outer)) == len(crossings(hole)) == 0


def test_points_apart_close_nothing() -> None:
    row = np.stack([np.arange(160, 321, 32), np.full(6, 5)], axis=1)
    (still_open,) = surfaces_of(tiled(np.concatenate([gate(), row])), 800.0)
    assert still_open.holes == []


def test_a_row_that_ends_bounds_nothing() -> None:
    row = np.stack([np.full(20, 240), np.arange(488, 641, 8)], axis=1)
    (spurred,) = surfaces_of(tiled(np.concatenate([gate(), row])), 800.0)
    (plain,) = surfaces_of(tiled(gate()), 800.0)
    assert spurred.area == pytest.approx(plain.area, rel=0.01)


def test_a_row_round_nothing_is_no_surface() -> None:
    turn = np.linspace(0.0, 2.0 * np.pi, 300, endpoint=False)
    circle = np.round(300.0 * np.stack([np.cos(turn), np.sin(turn)], axis=1)).astype(np.int64)
    assert len(stitch(tiled(circle))) >= 2  # there and back
    assert surfaces_of(tiled(circle), 800.0) == []


def test_rings_begin_at_their_smallest_vertex() -> None:
    (ring,) = stitch(ring_edges(square(-7, 3, 20)))
    assert ring.tolist() == [[-7, 3], [13, 3], [13, 23], [-7, 23]]


def test_outward_moves_away_from_the_surface() -> None:
    ring = np.array(square(0, 0, 100), np.int64)
    assert outward(ring).tolist() == [[-2, -2], [102, -2], [102, 102], [-2, 102]]
    hole = ring[::-1]
    assert sorted(outward(hole).tolist()) == [[2, 2], [2, 98], [98, 2], [98, 98]]
    assert signed_area2(outward(hole)) == -2 * 96**2


def test_outward_moves_no_vertex_far() -> None:
    for ring in stitch(tiled(scattered(5, 3000, SIZE, 100))):
        moved = outward(ring)
        gap = np.abs(moved[:, None, :] - ring[None, :, :]).max(axis=2).min(axis=1)
        assert gap.max() <= np.ceil(2.83 * OUTWARD) + 1


def test_inside_is_even_odd() -> None:
    ring = np.array(square(0, 0, 10), np.int64)
    assert inside(ring, 5.0, 5.0)
    assert not inside(ring, 15.0, 5.0)
    assert not inside(ring, -1.0, 5.0)
    assert not inside(ring, 5.0, 10.5)


PINCHED = [(-60, -30), (-60, 30), (0, 0), (60, 30), (60, -30), (0, 0)]


def test_outward_leaves_a_pinched_ring_simple() -> None:
    """Two triangular holes that touch in a point are one ring."""
    edges = ring_edges(square(-100, -100, 200), PINCHED)
    (surface,) = surfaces_of(edges, 1.0)
    assert len(crossings(surface.outer)) == 0
    assert [len(crossings(hole)) for hole in surface.holes] == [0] * len(surface.holes)


def test_outward_leaves_rings_without_pinched_vertices_simple() -> None:
    for seed in range(20):
        for ring in stitch(tiled(scattered(seed, 150 + 40 * (seed % 5), SIZE))):
            if len(np.unique(ring, axis=0)) == len(ring):
                assert len(crossings(outward(ring))) == 0


def test_crossings_finds_a_bow_tie_and_allows_a_touch() -> None:
    assert len(crossings(np.array([(0, 0), (10, 10), (10, 0), (0, 10)]))) == 1
    assert len(crossings(np.array([(0, 0), (5, 5), (10, 0), (10, 10), (5, 5), (0, 10)]))) == 0
