"""Planes merge on statistics alone: the same as on their points, in any order of the input."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from facet.mapping.merging import Limits, Nodes, limits, merge_nodes, plane_of, pool
from facet.mapping.settings import MapSettings

Points = NDArray[np.float64]
UPPER = np.triu_indices(3)
LIMIT = limits(MapSettings(), 0.2)


def covariance(points: Points) -> NDArray[np.float64]:
    return np.cov(points.T, bias=True)


def full(scatter: NDArray[np.float64]) -> NDArray[np.float64]:
    return scatter[[0, 1, 2, 1, 3, 4, 2, 4, 5]].reshape(3, 3)


def statistics(points: Points) -> tuple[float, NDArray[np.float64], NDArray[np.float64]]:
    """(votes, mean, scatter) of points."""
    return float(len(points)), points.mean(0), covariance(points)[UPPER] * len(points)


def sheet(rng: np.random.Generator, at: Points, normal: Points, count: int = 60) -> Points:
    """Noisy points of a square of 8 voxels round `at`."""
    normal = normal / np.linalg.norm(normal)
    u = np.cross(normal, [0.3, 0.5, 0.8])
    u /= np.linalg.norm(u)
    v = np.cross(normal, u)
    a, b = rng.uniform(-4, 4, (2, count))
    return at + a[:, None] * u + b[:, None] * v + rng.normal(0, 0.15, count)[:, None] * normal


def nodes_of(sheets: list[tuple[Points, Points]]) -> Nodes:
    """Nodes of (points, normal)."""
    parts = [(*statistics(p), n / np.linalg.norm(n) * len(p)) for p, n in sheets]
    return Nodes(*(np.array(column, np.float64) for column in zip(*parts, strict=True)))


def test_p2_equals_the_covariance_of_the_union() -> None:
    rng = np.random.default_rng(0)
    for _ in range(50):
        a = rng.normal(size=(rng.integers(1, 40), 3)) + rng.normal(size=3) * 100
        b = rng.normal(size=(rng.integers(1, 40), 3)) * [2, 1, 0.1] + rng.normal(size=3) * 100
        mean, scatter = np.zeros(3), np.zeros(6)
        total = pool(*statistics(a), *statistics(b), mean, scatter)
        both = np.concatenate([a, b])
        assert total == len(both)
        expected = covariance(both)
        np.testing.assert_allclose(mean, both.mean(0), rtol=1e-12, atol=1e-12)
        error = np.abs(full(scatter) / total - expected).max()
        assert error <= 1e-12 * np.abs(expected).max()


def test_p4_equals_the_mean_squared_distance() -> None:
    """From (votes, mean, scatter) of the points alone, also after pooling."""
    rng = np.random.default_rng(1)
    for _ in range(50):
        points = rng.normal(size=(30, 3)) * [3, 2, 0.2] + rng.normal(size=3) * 10
        normal = rng.normal(size=3)
        normal /= np.linalg.norm(normal)
        d = float(rng.normal() * 10)
        exact = float(np.mean((points @ normal - d) ** 2))
        mean, scatter = np.zeros(3), np.zeros(6)
        total = pool(*statistics(points[:11]), *statistics(points[11:]), mean, scatter)
        told = normal @ full(scatter) @ normal / total + (normal @ mean - d) ** 2
        assert told == pytest.approx(exact, rel=1e-12)


def test_the_plane_of_many_voxels_is_their_fit() -> None:
    rng = np.random.default_rng(2)
    normal = np.array([0.2, -0.9, 0.4])
    points = sheet(rng, np.array([50.0, -20.0, 7.0]), normal, 500)
    votes, _, scatter = statistics(points)
    x, y, z, variance, _ = plane_of(votes, scatter, normal)
    values, vectors = np.linalg.eigh(covariance(points))
    assert variance == pytest.approx(values[0], rel=1e-6)
    assert np.array([x, y, z]) @ vectors[:, 0] * np.sign(normal @ vectors[:, 0]) > 1 - 1e-9
    assert np.array([x, y, z]) @ normal > 0  # towards the members' side


def test_limits_follow_the_noise_within_bounds() -> None:
    quiet, loud = limits(MapSettings(), 0.0), limits(MapSettings(), 5.0)
    assert 0.0 < quiet.offset < loud.offset <= 1.0
    for limit in (quiet, loud):
        assert limit.cross <= limit.offset
        assert limit.edge_cos <= limit.cos


def scene(seed: int) -> tuple[Nodes, NDArray[np.int32], list[int]]:
    """Patches of two walls that meet and of a parallel one, with edges between near ones."""
    rng = np.random.default_rng(seed)
    sheets, wall = [], []
    for number, (normal, spots) in enumerate((
        ([1.0, 0.0, 0.0], [(0.0, 8.0 * i, 8.0 * j) for i in range(5) for j in range(3)]),
        ([0.0, 1.0, 0.0], [(4.0 + 8.0 * i, -4.0, 8.0 * j) for i in range(4) for j in range(3)]),
        ([1.0, 0.0, 0.0], [(12.0, 8.0 * i, 8.0 * j) for i in range(2) for j in range(3)]),
    )):  # fmt: skip
        for spot in spots:
            tilt = np.array(normal) + rng.normal(0, 0.01, 3)
            sheets.append(
                (sheet(rng, np.array(spot), np.array(normal), rng.integers(40, 90)), tilt)
            )
            wall.append(number)
    nodes = nodes_of(sheets)
    gap = np.linalg.norm(nodes.mean[:, None] - nodes.mean[None], axis=2)
    edges = np.argwhere(np.triu(gap < 13.0, 1)).astype(np.int32)
    return nodes, edges, wall


def parts(roots: NDArray[np.int64]) -> set[frozenset[int]]:
    return {frozenset(np.flatnonzero(roots == r).tolist()) for r in np.unique(roots)}


@pytest.mark.parametrize("seed", range(4))
def test_walls_come_out_whole_and_apart(seed: int) -> None:
    nodes, edges, wall = scene(seed)
    roots, merged = merge_nodes(nodes, edges, LIMIT)
    assert parts(roots) == {
        frozenset(np.flatnonzero(np.array(wall) == w).tolist()) for w in range(3)
    }
    for root in np.unique(roots):
        own = roots == root
        assert root == np.flatnonzero(own)[0]
        assert merged.votes[root] == nodes.votes[own].sum()
        np.testing.assert_allclose(merged.unit[root], nodes.unit[own].sum(0), atol=1e-9)
        mean = np.average(nodes.mean[own], axis=0, weights=nodes.votes[own])
        np.testing.assert_allclose(merged.mean[root], mean, atol=1e-9)


@pytest.mark.parametrize("seed", range(4))
def test_the_order_of_edges_does_not_matter(seed: int) -> None:
    nodes, edges, _ = scene(seed)
    roots, merged = merge_nodes(nodes, edges, LIMIT)
    for shuffle in range(3):
        mixed = np.random.default_rng(shuffle).permutation(edges)
        again, other = merge_nodes(nodes, mixed, LIMIT)
        np.testing.assert_array_equal(again, roots)
        for a, b in zip(merged, other, strict=True):
            np.testing.assert_array_equal(a, b)


@pytest.mark.parametrize("seed", range(4))
def test_the_order_of_nodes_does_not_matter(seed: int) -> None:
    nodes, edges, _ = scene(seed)
    told = parts(merge_nodes(nodes, edges, LIMIT)[0])
    order = np.random.default_rng(seed).permutation(len(nodes.votes))
    place = np.argsort(order)
    mixed = Nodes(*(np.ascontiguousarray(column[order]) for column in nodes))
    roots, _ = merge_nodes(mixed, np.sort(place[edges], axis=1), LIMIT)
    assert {frozenset(order[list(part)].tolist()) for part in parts(roots)} == told


def test_merging_changes_none_of_its_arguments() -> None:
    nodes, edges, _ = scene(0)
    copies = [c.copy() for c in (*nodes, edges)]
    merge_nodes(nodes, edges, LIMIT)
    for a, b in zip((*nodes, edges), copies, strict=True):
        np.testing.assert_array_equal(a, b)


def pair(
    at: tuple[float, float, float], normal: tuple[float, float, float], limit: Limits = LIMIT
) -> int:
    """How many planes are left of one at the origin, facing +x, and another."""
    rng = np.random.default_rng(5)
    first = np.array([1.0, 0.0, 0.0])
    sheets = [
        (sheet(rng, np.zeros(3), first, 400), first),
        (sheet(rng, np.array(at), np.array(normal), 200), np.array(normal)),
    ]
    roots, _ = merge_nodes(nodes_of(sheets), np.array([[0, 1]], np.int32), limit)
    return len(np.unique(roots))


def test_what_is_one_plane_and_what_is_not() -> None:
    assert pair((0.0, 9.0, 0.0), (1.0, 0.0, 0.0)) == 1
    assert pair((0.0, 9.0, 0.0), (-1.0, 0.0, 0.0)) == 2  # the other side of a thin wall
    assert pair((2.0, 9.0, 0.0), (1.0, 0.0, 0.0)) == 2  # parallel, two voxels away
    assert pair((0.0, 9.0, 0.0), (1.0, 0.5, 0.0)) == 2  # at an angle


def test_across_a_gap_places_count_not_noise_and_only_so_far() -> None:
    """As planes that do not touch are compared: with less offset, and as far as one reaches."""
    tight = LIMIT._replace(offset=0.1, reach=8.0)
    rng = np.random.default_rng(3)
    up = np.array([0.0, 0.0, 1.0])
    edge = np.array([[0, 1]], np.int32)
    for away, offset, one in ((30.0, 0.0, True), (30.0, 0.4, False), (90.0, 0.0, False)):
        here = sheet(rng, np.zeros(3), up, 400)
        there = sheet(rng, np.array([away, 0.0, offset]), up, 200)
        there -= up * (there[:, 2].mean() - here[:, 2].mean() - offset)
        assert there[:, 2].std() > tight.offset  # it scatters by more than it may be off
        roots, _ = merge_nodes(nodes_of([(here, up), (there, up)]), edge, tight)
        assert (roots[0] == roots[1]) == one


def test_what_touches_is_asked_no_reach() -> None:
    """A node of one voxel has no extent at all."""
    up = np.array([0.0, 0.0, 1.0])
    sheets = [(np.zeros((1, 3)), up), (np.array([[1.0, 0.0, 0.0]]), up)]
    roots, _ = merge_nodes(nodes_of(sheets), np.array([[0, 1]], np.int32), LIMIT)
    assert roots.tolist() == [0, 0]


def test_far_from_the_origin_nothing_is_different() -> None:
    """Offsets d are never compared: they depend on where the origin is."""
    nodes, edges, _ = scene(1)
    told = parts(merge_nodes(nodes, edges, LIMIT)[0])
    for shift in ([64_000.0, -32_000.0, 640.0], [1e6, 1e6, -1e6]):
        far = nodes._replace(mean=nodes.mean + shift)
        assert parts(merge_nodes(far, edges, LIMIT)[0]) == told


def test_nothing_to_merge() -> None:
    none = Nodes(np.zeros(0), np.zeros((0, 3)), np.zeros((0, 6)), np.zeros((0, 3)))
    roots, merged = merge_nodes(none, np.zeros((0, 2), np.int32), LIMIT)
    assert len(roots) == len(merged.votes) == 0
    nodes, _, _ = scene(0)
    roots, _ = merge_nodes(nodes, np.zeros((0, 2), np.int32), LIMIT)
    assert roots.tolist() == list(range(len(nodes.votes)))
