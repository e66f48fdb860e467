"""Planes: the paper's four stages, run whole over the tile-planes whenever one changed (Table 3).

Local normals and patches have made tile-planes (stage 1). Here similar ones merge where they touch
(stage 2), the detail level drops what holds too little (stage 3), and what is left is consolidated:
planes merge across gaps, freed tile-planes are offered to the survivors (stage 4).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from facet.mapping.blocks import unpack_all
from facet.mapping.kernel import kernel
from facet.mapping.merging import Limits, Nodes, merge_nodes, plane_of, pool
from facet.mapping.settings import TICKS, TILE, MapSettings
from facet.mapping.table import Table

FREE = -1
ADOPTIONS = 10  # rounds in which freed tile-planes are offered to the planes beside them
ENOUGH_POINTS = 1000  # pure points that a plane is fitted to; with fewer the voxels, one vote each


Judge = Callable[[Table, NDArray[np.int64], Nodes, NDArray[np.int64]], NDArray[np.bool_]]


@dataclass(slots=True)
class Stages:
    """What each stage left behind, for the report."""

    seeds: int = 0
    merged: int = 0
    detailed: int = 0
    final: int = 0
    average_sigma: float = 0.0  # voxel-weighted over the merged planes, voxels
    detail_reached: float = 1.0
    min_occupation: int = 0


@dataclass(slots=True)
class PlaneSet:
    """Planes over the nodes of a table; K planes in canonical order."""

    label: NDArray[np.int64]  # (T,) plane of each node, FREE: remainder
    nodes: Nodes  # (K, ...) statistics of the voxels
    occupation: NDArray[np.int64]  # (K,) voxels
    stages: Stages


def group_planes(
    table: Table, limit: Limits, settings: MapSettings, flat: Judge | None = None
) -> PlaneSet:
    """Stages 2 to 4 over a table of tile-planes. `flat` says which planes are none after all."""
    stages = Stages(seeds=len(table.nodes.votes))
    roots, merged = merge_nodes(table.nodes, table.edges, limit)
    label, nodes = _relabel(roots, merged)
    label, nodes = _drop(label, nodes, nodes.votes >= settings.n_min)  # less makes no plane
    occupation = _occupation(label, table, len(nodes.votes))
    stages.merged = len(nodes.votes)
    stages.average_sigma = _average_sigma(nodes)

    keep, least, stages.detail_reached = detail_level(occupation, settings)
    keep &= nodes.votes >= settings.member_share * least  # leftovers alone make no plane
    stages.min_occupation = least
    if flat is not None:
        keep[keep] = flat(table, *_drop(label, nodes, keep), occupation[keep])
    stages.detailed = int(keep.sum())
    label, nodes = _drop(label, nodes, keep)

    every = _every_pair(len(nodes.votes))
    tight = limit._replace(
        edge_cos=float(np.cos(limit.bridge)), offset=limit.cross, reach=settings.cross_reach
    )
    roots, merged = merge_nodes(nodes, every, tight)
    into, nodes = _relabel(roots, merged)
    label = np.where(label == FREE, FREE, into[label]) if len(into) else label
    label = _adopt(table, label, nodes, limit)
    occupation = _occupation(label, table, len(nodes.votes))
    stages.final = len(nodes.votes)
    return PlaneSet(label, nodes, occupation, stages)


@kernel
def _every_pair(count):  # type: ignore[no-untyped-def]
    """(E, 2) all edges between `count` nodes, ascending."""
    out, num = np.empty((count * (count - 1) // 2, 2), np.int32), 0
    for a in range(count):
        for b in range(a + 1, count):
            out[num, 0], out[num, 1] = a, b
            num += 1
    return out


def detail_level(
    occupation: NDArray[np.int64], settings: MapSettings
) -> tuple[NDArray[np.bool_], int, float]:
    """C7: the smallest set of planes that holds the detail level's share of the occupied voxels.

    Returns (kept (K,), minimum occupation, share reached)."""
    total = int(occupation.sum())
    if total == 0:
        return np.zeros(len(occupation), np.bool_), 0, 1.0
    order = np.argsort(-occupation, kind="stable")
    shares = np.cumsum(occupation[order]) / total
    count = int(np.searchsorted(shares, settings.detail_level - 1e-12)) + 1
    least = int(occupation[order[min(count, len(order)) - 1]])
    least = min(least, int(settings.min_area_m2 / settings.voxel_m**2))
    keep = occupation >= max(1, least)
    return keep, least, float(occupation[keep].sum() / total)


def _relabel(roots: NDArray[np.int64], merged: Nodes) -> tuple[NDArray[np.int64], Nodes]:
    is_root = roots == np.arange(len(roots))
    label = (np.cumsum(is_root) - 1)[roots]
    return label, Nodes(*(np.take(c, np.flatnonzero(is_root), axis=0) for c in merged))


def _drop(
    label: NDArray[np.int64], nodes: Nodes, keep: NDArray[np.bool_]
) -> tuple[NDArray[np.int64], Nodes]:
    new = np.where(keep, np.cumsum(keep) - 1, FREE)
    label = np.where(label == FREE, FREE, new[label]) if len(new) else label
    return label, Nodes(*(np.take(c, np.flatnonzero(keep), axis=0) for c in nodes))


def _occupation(label: NDArray[np.int64], table: Table, count: int) -> NDArray[np.int64]:
    on = label != FREE
    return np.bincount(label[on], table.occupation[on], minlength=count).astype(np.int64)


@kernel
def _fits_of(votes, scatter, unit):  # type: ignore[no-untyped-def]
    """(K, 4) unit normals of nodes and their variance along them."""
    out = np.empty((votes.shape[0], 4))
    for k in range(votes.shape[0]):
        nx, ny, nz, variance, _ = plane_of(votes[k], scatter[k], unit[k])
        out[k, 0], out[k, 1], out[k, 2], out[k, 3] = nx, ny, nz, variance
    return out


def _average_sigma(nodes: Nodes) -> float:
    """Mean over planes of sigma_N, weighted by their voxels."""
    if not len(nodes.votes):
        return 0.0
    sigmas = np.sqrt(_fits_of(nodes.votes, nodes.scatter, nodes.unit)[:, 3])
    return float(np.average(sigmas, weights=nodes.votes))


@kernel(allocates=False)
def _fits(mean, scatter, unit, t, size, share, normal, centre, limit):  # type: ignore[no-untyped-def]
    """Mean square distance of a node's voxels to a plane, or -1 where it does not belong there.
    size: the length of its `unit`; share: 1 over its votes."""
    n, u = normal, unit[t]
    cos = 2.0 * limit.cos * limit.cos - 1.0  # of twice the angle
    if u[0] * n[0] + u[1] * n[1] + u[2] * n[2] < cos * size:
        return -1.0
    w = 0.0
    for a in range(3):
        w += n[a] * (mean[t, a] - centre[a])
    if abs(w) > limit.offset:
        return -1.0
    s = scatter[t]
    spread = share * (
        s[0] * n[0] * n[0] + s[3] * n[1] * n[1] + s[5] * n[2] * n[2]
        + 2.0 * (s[1] * n[0] * n[1] + s[2] * n[0] * n[2] + s[4] * n[1] * n[2])
    )  # fmt: skip
    square = max(0.0, spread) + w * w
    return square if square <= limit.offset * limit.offset else -1.0


@kernel
def _adopt_along(nodes, edges, label, normals, centres, limit):  # type: ignore[no-untyped-def]
    """Offer free nodes to the planes of their neighbours, nearest first, until nothing changes:
    label (T,)."""
    votes, mean, scatter, unit = nodes
    count, num = votes.shape[0], edges.shape[0]
    size, share = np.empty(count), np.empty(count)
    for t in range(count):
        u = unit[t]
        size[t] = np.sqrt(u[0] * u[0] + u[1] * u[1] + u[2] * u[2])
        share[t] = 1.0 / votes[t]
    is_free, best, nearest = label == FREE, np.full(count, FREE), np.full(count, np.inf)
    taken, loose = np.empty(count, np.int64), np.empty(num, np.int32)
    for turn in range(ADOPTIONS):
        left, num_taken = 0, 0
        for at in range(num):
            e = np.int64(loose[at]) if turn else at
            t, other = edges[e, 0], edges[e, 1]
            if is_free[t] and is_free[other]:  # perhaps later
                loose[left] = e
                left += 1
                continue
            if is_free[other]:
                t, other = other, t
            if not is_free[t]:  # neither is any more
                continue
            p = label[other]
            own = _fits(mean, scatter, unit, t, size[t], share[t], normals[p], centres[p], limit)
            if own >= 0.0 and (own < nearest[t] or (own == nearest[t] and p < best[t])):
                if best[t] == FREE:
                    taken[num_taken] = t
                    num_taken += 1
                best[t], nearest[t] = p, own
        for at in range(num_taken):
            label[taken[at]] = best[taken[at]]
            is_free[taken[at]] = False
        if num_taken == 0:
            break
        num = left


def _adopt(
    table: Table, label: NDArray[np.int64], nodes: Nodes, limit: Limits
) -> NDArray[np.int64]:
    label = label.copy()
    normals = _fits_of(nodes.votes, nodes.scatter, nodes.unit)[:, :3]
    _adopt_along(table.nodes, table.edges, label, normals, nodes.mean, limit)
    return label


class PointFit(NamedTuple):
    """What planes are fitted to, K of them. Metres, about the map's origin."""

    total: NDArray[np.int64]  # (K,) points of all members
    weight: NDArray[np.float64]  # (K,) pure points, or voxels where these are too few
    centroid: NDArray[np.float64]  # (K, 3)
    scatter: NDArray[np.float64]  # (K, 6)


@kernel
def _pool_points(points, corners, label, num, mean, scatter):  # type: ignore[no-untyped-def]
    m, s = np.zeros(3), np.zeros(6)
    own_mean, own = np.zeros(3), np.zeros(6)
    for t in range(points.shape[0]):
        p = label[t]
        if p < 0 or points[t, 0] == 0:
            continue
        n = float(points[t, 0])
        i = 0
        for a in range(3):
            own_mean[a] = corners[t, a] + points[t, 1 + a] / n / TICKS
            for b in range(a, 3):
                centred = points[t, 4 + i] - points[t, 1 + a] / n * points[t, 1 + b]
                own[i] = centred / (TICKS * TICKS)
                i += 1
        if num[p] == 0:
            mean[p], scatter[p] = own_mean, own
        else:
            pool(float(num[p]), mean[p], scatter[p], n, own_mean, own, m, s)
            mean[p], scatter[p] = m, s
        num[p] += points[t, 0]


def pool_points(
    table: Table, label: NDArray[np.int64], count: int
) -> tuple[NDArray[np.int64], NDArray[np.float64], NDArray[np.float64]]:
    """Pool the exact point moments of the tile-planes of `count` things, in canonical order.

    label: (T,) which thing, FREE: none. Returns number (K,), mean
    (K, 3) and scatter (K, 6) about it, voxels."""
    num = np.zeros(count, np.int64)
    mean, scatter = np.zeros((count, 3)), np.zeros((count, 6))
    corners = (unpack_all(table.tile_keys) * float(TILE))[table.tile_of]
    _pool_points(table.points, corners, label, num, mean, scatter)
    return num, mean, scatter


def fit_points(table: Table, planes: PlaneSet, voxel_m: float) -> PointFit:
    """Pool the exact point moments of each plane's tile-planes, in canonical order.

    A plane with hardly any pure points is fitted to its voxels' centroids instead."""
    count = len(planes.nodes.votes)
    num, mean, scatter = pool_points(table, planes.label, count)
    few = num < ENOUGH_POINTS
    mean[few], scatter[few] = planes.nodes.mean[few], planes.nodes.scatter[few]
    on = planes.label != FREE
    total = np.bincount(planes.label[on], table.total[on], minlength=count).astype(np.int64)
    weight = np.where(few, planes.nodes.votes, num)
    return PointFit(total, weight, mean * voxel_m, scatter * voxel_m**2)
