"""Merging of planes by orientation and distance, on statistics alone (method.md 6.1, 6.3).

A node is (votes, mean, scatter, unit): voxels, their centroid, their summed outer products about
it, and the sum of their normals. Nodes merge along edges, best first; an edge that is refused is
tried again until nothing changes. The order of edges is total, so the result is a pure function.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numba import prange
from numpy.typing import NDArray

from facet.mapping.eigen import smallest
from facet.mapping.kernel import kernel
from facet.mapping.runs import SHARES
from facet.mapping.settings import MapSettings

NARROW = 5.0  # voxels: of a narrower node the fit tells no more than its members' normals
MANY = 1 << 14  # edges that are worth waking other threads for
TRUSTED = 30  # below this many voxels the mean normal is trusted more than the fit


class Nodes(NamedTuple):
    """Things to merge, as columns (T, ...). Lengths in voxels, about the map's origin."""

    votes: NDArray[np.float64]  # (T,)
    mean: NDArray[np.float64]  # (T, 3)
    scatter: NDArray[np.float64]  # (T, 6) xx, xy, xz, yy, yz, zz about the mean
    unit: NDArray[np.float64]  # (T, 3) sum of unit normals


class Limits(NamedTuple):
    """When two planes are one. Lengths in voxels."""

    edge_cos: float  # of the nodes at the ends of an edge
    cos: float
    offset: float
    rms: float  # distance of the smaller one's voxels from the larger one's plane
    cross: float  # offset between planes that do not touch
    reach: float  # of the larger one's extent towards the other: how far apart their middles may be
    variance: float
    bridge: float  # angle that a merged normal may leave its members' own, radians
    tilt: float  # and what noise adds to that angle: this, over the width


def limits(settings: MapSettings, sigma: float, angle_deg: float | None = None) -> Limits:
    """Limits for a scene noise `sigma` in voxels."""
    offset = min(max(settings.merge_sigmas * sigma, 0.5), 0.7)
    return Limits(
        edge_cos=math.cos(math.radians(settings.edge_angle_deg)),
        cos=math.cos(math.radians(angle_deg or settings.merge_angle_deg)),
        offset=offset,
        rms=offset,
        cross=min(settings.cross_sigmas * sigma, offset),
        reach=math.inf,
        variance=settings.max_merged_sigma**2,
        bridge=math.radians(settings.bridge_angle_deg),
        tilt=settings.tilt_offset,
    )


@kernel(allocates=False)
def plane_of(votes, scatter, unit):  # type: ignore[no-untyped-def]
    """(nx, ny, nz, variance along it, variance across it) of a node: the fit, or the mean normal of
    a small one. Across: the smaller of the two principal variances in the plane."""
    length = np.sqrt(unit[0] * unit[0] + unit[1] * unit[1] + unit[2] * unit[2])
    nx, ny, nz = unit[0] / length, unit[1] / length, unit[2] / length
    if votes >= TRUSTED:
        total, fx, fy, fz, across, _ = smallest(scatter)
        dot = fx * nx + fy * ny + fz * nz
        if dot < 0.0:
            fx, fy, fz = -fx, -fy, -fz
        return fx, fy, fz, max(0.0, total) / votes, across / votes
    spread = (
        scatter[0] * nx * nx + scatter[3] * ny * ny + scatter[5] * nz * nz
        + 2.0 * (scatter[1] * nx * ny + scatter[2] * nx * nz + scatter[4] * ny * nz)
    )  # fmt: skip
    return nx, ny, nz, max(0.0, spread) / votes, 0.0


@kernel(allocates=False)
def pool(va, ma, sa, vb, mb, sb, mean, scatter):  # type: ignore[no-untyped-def]
    """P1, P2: mean and scatter of the union, into the last two (Chan, Golub & LeVeque 1979)."""
    total = va + vb
    k = va * vb / total
    d0, d1, d2 = mb[0] - ma[0], mb[1] - ma[1], mb[2] - ma[2]
    scatter[0] = sa[0] + sb[0] + k * d0 * d0
    scatter[1] = sa[1] + sb[1] + k * d0 * d1
    scatter[2] = sa[2] + sb[2] + k * d0 * d2
    scatter[3] = sa[3] + sb[3] + k * d1 * d1
    scatter[4] = sa[4] + sb[4] + k * d1 * d2
    scatter[5] = sa[5] + sb[5] + k * d2 * d2
    f = vb / total
    mean[0], mean[1], mean[2] = ma[0] + f * d0, ma[1] + f * d1, ma[2] + f * d2
    return total


@kernel(allocates=False)
def _offset(normals, mean, a, b):  # type: ignore[no-untyped-def]
    """Signed distance of b's centroid from a's plane."""
    return (
        normals[a, 0] * (mean[b, 0] - mean[a, 0])
        + normals[a, 1] * (mean[b, 1] - mean[a, 1])
        + normals[a, 2] * (mean[b, 2] - mean[a, 2])
    )


@kernel(allocates=False)
def _dot(normals, a, b):  # type: ignore[no-untyped-def]
    return (
        normals[a, 0] * normals[b, 0]
        + normals[a, 1] * normals[b, 1]
        + normals[a, 2] * normals[b, 2]
    )


@kernel(allocates=False)
def _agreement(nx, ny, nz, unit):  # type: ignore[no-untyped-def]
    """Cosine between a normal and the mean of the members' normals."""
    length = np.sqrt(unit[0] * unit[0] + unit[1] * unit[1] + unit[2] * unit[2])
    return (nx * unit[0] + ny * unit[1] + nz * unit[2]) / length


@kernel(allocates=False)
def _best_cos(normals, own, a, b):  # type: ignore[no-untyped-def]
    """Cosine between the normals of a and b. A narrow b may have that of its fit or the mean of its
    members', as the one turns with its noise, the other with what lies beside it."""
    n, u = normals[a], own[b]
    return max(_dot(normals, a, b), n[0] * u[0] + n[1] * u[1] + n[2] * u[2])


@kernel(allocates=False)
def _face(votes, scatter, unit, start, stop, normals, own):  # type: ignore[no-untyped-def]
    """Normals (T, 3) of the nodes from start to stop, and their `own` ones (T, 3)."""
    for t in range(start, stop):
        nx, ny, nz, _, across = plane_of(votes[t], scatter[t], unit[t])
        _turn(t, nx, ny, nz, across, unit[t], normals, own)


@kernel(allocates=False)
def _turn(t, nx, ny, nz, across, unit, normals, own):  # type: ignore[no-untyped-def]
    """Give a node its normal, and its own one: the mean of its members' where it is narrow."""
    normals[t, 0], normals[t, 1], normals[t, 2] = nx, ny, nz
    if 12.0 * across < NARROW * NARROW:
        length = np.sqrt(unit[0] * unit[0] + unit[1] * unit[1] + unit[2] * unit[2])
        nx, ny, nz = unit[0] / length, unit[1] / length, unit[2] / length
    own[t, 0], own[t, 1], own[t, 2] = nx, ny, nz


@kernel(allocates=False)
def _weigh(votes, mean, normals, own, edges, start, stop, limit, worth, costs):  # type: ignore[no-untyped-def]
    """List the edges from start to stop whose two ends agree by themselves: their numbers, worth
    (E,), and the costs (E,) of merging along them, from `start` on. Returns where these end."""
    num = start
    for e in range(start, stop):
        a, b = edges[e, 0], edges[e, 1]
        if votes[b] > votes[a]:
            a, b = b, a
        cos = _best_cos(normals, own, a, b)
        if cos < limit.edge_cos:  # most of them
            continue
        w = abs(_offset(normals, mean, a, b))
        if w <= limit.offset:
            worth[num] = e
            costs[num] = (1.0 - cos) / (1.0 - limit.edge_cos) + (w / limit.offset) ** 2
            num += 1
    return num


@kernel(parallel=True)
def _weigh_many(votes, mean, scatter, unit, edges, limit, normals, own, worth, costs, ends):  # type: ignore[no-untyped-def]
    count, num = votes.shape[0], edges.shape[0]
    for share in prange(SHARES):
        start, stop = share * count // SHARES, (share + 1) * count // SHARES
        _face(votes, scatter, unit, start, stop, normals, own)
    for share in prange(SHARES):
        start, stop = share * num // SHARES, (share + 1) * num // SHARES
        ends[share] = _weigh(
            votes, mean, normals, own, edges, start, stop, limit, worth, costs
        )  # fmt: skip


@kernel(allocates=False)
def _root(parent, t):  # type: ignore[no-untyped-def]
    while parent[t] != t:
        parent[t] = parent[parent[t]]
        t = parent[t]
    return t


@kernel(allocates=False)
def _reaches(votes, mean, scatter, to, reach):  # type: ignore[no-untyped-def]
    """Whether a place is so near to a node, against its extent that way, that its plane says
    anything there."""
    x, y, z, s = to[0] - mean[0], to[1] - mean[1], to[2] - mean[2], scatter
    square = x * x + y * y + z * z
    spread = (
        s[0] * x * x + s[3] * y * y + s[5] * z * z
        + 2.0 * (s[1] * x * y + s[2] * x * z + s[4] * y * z)
    ) / votes  # fmt: skip
    return square * square <= reach * reach * 12.0 * spread


@kernel(allocates=False)
def _try(votes, mean, scatter, unit, normals, own, a, b, limit, m, s, u):  # type: ignore[no-untyped-def]
    """Whether a and b (a the larger) are one plane; m, s, u are then its statistics, and what comes
    with it its normal and the variance across it."""
    if _best_cos(normals, own, a, b) < limit.cos:
        return False, 0.0, 0.0, 0.0, 0.0
    w = _offset(normals, mean, a, b)
    if abs(w) > limit.offset:
        return False, 0.0, 0.0, 0.0, 0.0
    if limit.reach < np.inf and not _reaches(votes[a], mean[a], scatter[a], mean[b], limit.reach):
        return False, 0.0, 0.0, 0.0, 0.0
    n = normals[a]
    sb = scatter[b]
    spread = (
        sb[0] * n[0] * n[0] + sb[3] * n[1] * n[1] + sb[5] * n[2] * n[2]
        + 2.0 * (sb[1] * n[0] * n[1] + sb[2] * n[0] * n[2] + sb[4] * n[1] * n[2])
    ) / votes[b]  # fmt: skip
    if spread + w * w > limit.rms * limit.rms:  # P4
        return False, 0.0, 0.0, 0.0, 0.0
    total = pool(votes[a], mean[a], scatter[a], votes[b], mean[b], sb, m, s)
    u[0], u[1], u[2] = unit[a, 0] + unit[b, 0], unit[a, 1] + unit[b, 1], unit[a, 2] + unit[b, 2]
    nx, ny, nz, variance, across = plane_of(total, s, u)
    if variance > limit.variance:
        return False, 0.0, 0.0, 0.0, 0.0
    # a bridge: the merged normal leaves its members' own by more than noise tilts a thing so wide
    noise = limit.tilt / np.sqrt(across) if across > 0.0 else 1.0
    allowed = np.cos(min(1.5, limit.bridge + np.arctan(noise)))
    return _agreement(nx, ny, nz, u) >= allowed, nx, ny, nz, across


@kernel
def _merge(votes, mean, scatter, unit, normals, own, edges, limit):  # type: ignore[no-untyped-def]
    """Merge nodes along edges (E, 2), given best first. The statistics end as those of the merged
    nodes, at the root's row. Returns (T,) the root of each node: its smallest member."""
    count = votes.shape[0]
    parent = np.arange(count)
    version = np.zeros(count, np.int64)
    m, s, u = np.zeros(3), np.zeros(6), np.zeros(3)
    tried = np.full((edges.shape[0], 2), -1, np.int64)
    merged = True
    while merged:
        merged = False
        for e in range(edges.shape[0]):
            a, b = _root(parent, edges[e, 0]), _root(parent, edges[e, 1])
            if a == b or (tried[e, 0] == version[a] and tried[e, 1] == version[b]):
                continue
            tried[e, 0], tried[e, 1] = version[a], version[b]
            large, small = (a, b) if votes[a] >= votes[b] else (b, a)
            one, nx, ny, nz, across = _try(
                votes, mean, scatter, unit, normals, own, large, small, limit, m, s, u
            )
            if not one:
                continue
            merged = True
            keep, drop = min(a, b), max(a, b)
            parent[drop] = keep
            votes[keep] = votes[a] + votes[b]
            mean[keep], scatter[keep], unit[keep] = m, s, u
            _turn(keep, nx, ny, nz, across, u, normals, own)
            version[keep] = version[a] + version[b] + 1
    for t in range(count):
        parent[t] = _root(parent, t)
    return parent


@kernel
def _merge_worth(votes, mean, scatter, unit, normals, own, edges, worth, costs, ends, limit):  # type: ignore[no-untyped-def]
    """Merge nodes along the edges that are worth it, as `_weigh` listed them in S parts of all
    edges, each up to one of ends (S,), best first."""
    parts, num = ends.shape[0], 0
    for part in range(parts):  # one part is moved to where the one before ends
        for at in range(part * edges.shape[0] // parts, ends[part]):
            worth[num], costs[num] = worth[at], costs[at]
            num += 1
    best_first = worth[:num][np.argsort(costs[:num], kind="mergesort")]
    return _merge(votes, mean, scatter, unit, normals, own, edges[best_first], limit)


@kernel
def merge_all(votes, mean, scatter, unit, edges, limit):  # type: ignore[no-untyped-def]
    """Merge nodes along edges (E, 2), which must come in a canonical order. The four statistics end
    as those of the merged nodes, at the root's row. Returns (T,) the root of each node: its
    smallest member."""
    count, num = votes.shape[0], edges.shape[0]
    normals, own = np.empty((count, 3)), np.empty((count, 3))
    worth, costs, ends = np.empty(num, np.int32), np.empty(num), np.empty(1, np.int64)
    _face(votes, scatter, unit, 0, count, normals, own)
    ends[0] = _weigh(votes, mean, normals, own, edges, 0, num, limit, worth, costs)
    return _merge_worth(
        votes, mean, scatter, unit, normals, own, edges, worth, costs, ends, limit
    )  # fmt: skip


def merge_nodes(
    nodes: Nodes, edges: NDArray[np.int32], limit: Limits
) -> tuple[NDArray[np.int64], Nodes]:
    """Merge `nodes` along `edges` (E, 2), which must come in a canonical order.

    Returns (root of each node (T,), statistics with the merged ones at the roots' rows)."""
    merged = Nodes(*(column.copy() for column in nodes))
    count, num = len(nodes.votes), len(edges)
    if num < MANY:
        return merge_all(*merged, edges, limit), merged
    judged = np.empty((count, 3)), np.empty((count, 3))
    listed = np.empty(num, np.int32), np.empty(num), np.empty(SHARES, np.int64)
    _weigh_many(*merged, edges, limit, *judged, *listed)
    return _merge_worth(*merged, *judged, edges, *listed, limit), merged
