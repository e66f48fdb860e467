"""Boundary edges to rings, rings to surfaces: outer rings with their holes."""

from __future__ import annotations

import itertools
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from facet.mapping.kernel import kernel
from facet.mapping.runs import starts_of

OUTWARD = 2.0  # grid units (1/8 voxel): a border centroid sits inside its voxel
ROW = 24  # grid units: points so near to one another are of one row of voxels
_SHIFT = 1 << 30  # keys of vertices sort as vertices do


class Outline(NamedTuple):
    """One surface in its plane's frame, 1/8 voxel."""

    outer: NDArray[np.int32]  # (M, 2) counter-clockwise
    holes: list[NDArray[np.int32]]  # (M, 2) clockwise each
    area: float  # (1/8 voxel)^2, holes taken out


@kernel(allocates=False)
def _vertex_key(u, v):  # type: ignore[no-untyped-def]
    return ((u + _SHIFT) << 32) | (v + _SHIFT)


@kernel(allocates=False)
def _half(x, y):  # type: ignore[no-untyped-def]
    """0 for angles in [0, 180), 1 for [180, 360)."""
    return 0 if y > 0 or (y == 0 and x > 0) else 1


@kernel(allocates=False)
def _before(ax, ay, bx, by, rx, ry):  # type: ignore[no-untyped-def]
    """Whether a comes before b, turning counter-clockwise from the direction r (r itself comes
    last)."""
    au, av = ax * rx + ay * ry, ay * rx - ax * ry  # in r's frame, counter-clockwise positive
    bu, bv = bx * rx + by * ry, by * rx - bx * ry
    turn_a = 2 if av == 0 and au > 0 else _half(au, av)
    turn_b = 2 if bv == 0 and bu > 0 else _half(bu, bv)
    if turn_a != turn_b:
        return turn_a < turn_b
    return au * bv - av * bu > 0


@kernel
def _successors(start, stop, edges):  # type: ignore[no-untyped-def]
    """(E,) for each edge the next of its ring; `start` is ascending. Interior on the left: at a
    vertex the ring goes on along what is outside, with the first outgoing edge counter-clockwise
    from the way it came."""
    count = start.shape[0]
    follow = np.empty(count, np.int64)
    for e in range(count):
        low = np.searchsorted(start, stop[e])
        best = -1
        rx, ry = edges[e, 0] - edges[e, 2], edges[e, 1] - edges[e, 3]
        o = low
        while o < count and start[o] == stop[e]:
            x, y = edges[o, 2] - edges[o, 0], edges[o, 3] - edges[o, 1]
            if best < 0:
                best = o
            else:
                bx, by = edges[best, 2] - edges[best, 0], edges[best, 3] - edges[best, 1]
                if _before(x, y, bx, by, rx, ry):
                    best = o
            o += 1
        follow[e] = best
    return follow


@kernel
def _keys(edges):  # type: ignore[no-untyped-def]
    start = np.empty(edges.shape[0], np.int64)
    stop = np.empty(edges.shape[0], np.int64)
    for e in range(edges.shape[0]):
        start[e] = _vertex_key(edges[e, 0], edges[e, 1])
        stop[e] = _vertex_key(edges[e, 2], edges[e, 3])
    return start, stop


@kernel
def _single(start, stop, edges, row):  # type: ignore[no-untyped-def]
    """(E,) whether an edge bounds something: it is there one way only, or it joins points at most
    `row` apart; edges (E, 4) ascend by (start, stop)."""
    count = start.shape[0]
    single = np.ones(count, np.bool_)
    for e in range(count):
        du, dv = edges[e, 2] - edges[e, 0], edges[e, 3] - edges[e, 1]
        if du * du + dv * dv <= row * row:
            continue
        o = np.searchsorted(start, stop[e])
        while o < count and start[o] == stop[e]:
            if stop[o] == start[e]:
                single[e] = False
            o += 1
    return single


@kernel
def _chains(follow):  # type: ignore[no-untyped-def]
    """Closed chains: their edges (N,) one after the other, and where each ends."""
    count = follow.shape[0]
    done = np.zeros(count, np.bool_)
    edges, ends = np.empty(count, np.int64), np.empty(count, np.int64)
    num, num_chains = 0, 0
    for first in range(count):
        begin, e = num, first
        while e >= 0 and not done[e]:
            done[e] = True
            edges[num] = e
            num += 1
            e = follow[e]
        if num > begin and e == first:
            ends[num_chains] = num
            num_chains += 1
        else:
            num = begin
    return edges[:num], ends[:num_chains]


@kernel
def _split(chained, ends, vertex):  # type: ignore[no-untyped-def]
    """Chains of edges (N,), each up to one of ends (C,), as rings of them that pass no vertex
    twice, each from its smallest; vertex: (E,) where edges start from, numbered in order. Signed
    areas add up to those of the chains. Rings of two edges are left out.

    Returns their edges (M,), and where each ring ends (R,)."""
    edges, stops = np.empty(chained.shape[0], np.int64), np.empty(chained.shape[0], np.int64)
    at = np.full(vertex.shape[0], -1, np.int64)  # where on the path a vertex is
    path = np.empty(chained.shape[0], np.int64)
    num, rings, begin = 0, 0, 0
    for c in range(ends.shape[0]):
        length = 0
        for n in range(begin, ends[c] + 1):
            cut = 0 if n == ends[c] else at[vertex[chained[n]]]
            if cut >= 0:  # the path comes back to a vertex, or the chain ends
                if length - cut > 2:
                    num = _turn(path[cut:length], vertex, edges, num)
                    stops[rings] = num
                    rings += 1
                for p in range(cut, length):
                    at[vertex[path[p]]] = -1
                length = cut
            if n < ends[c]:
                at[vertex[chained[n]]] = length
                path[length] = chained[n]
                length += 1
        begin = ends[c]
    return edges[:num], stops[:rings]


@kernel(allocates=False)
def _turn(path, vertex, edges, num):  # type: ignore[no-untyped-def]
    """Append a ring to edges, from its smallest vertex on. Returns the number of edges."""
    first = 0
    for p in range(path.shape[0]):
        if vertex[path[p]] < vertex[path[first]]:
            first = p
    for p in range(path.shape[0]):
        edges[num + p] = path[(first + p) % path.shape[0]]
    return num + path.shape[0]


def stitch(edges: NDArray[np.int64]) -> list[NDArray[np.int64]]:
    """Closed rings (M, 2) of directed edges (E, 4), each from its smallest vertex, in order of it.

    An edge that is there both ways has no area at either side. A row of voxels is such a strip: the
    threshold that closes a door. Others are left out."""
    if not len(edges):
        return []
    start, stop = _keys(edges)
    order = np.lexsort((stop, start))
    start, stop = start[order], stop[order]
    new = np.concatenate([[True], (start[1:] != start[:-1]) | (stop[1:] != stop[:-1])])
    order, start, stop = order[new], start[new], stop[new]
    single = _single(start, stop, edges[order], ROW)
    edges, start, stop = edges[order[single]], start[single], stop[single]
    chained, ends = _chains(_successors(start, stop, edges))
    vertex = np.cumsum(np.diff(start, prepend=start[:1]) > 0)
    chained, ends = _split(chained, ends, vertex)
    vertices, begins = edges[chained, :2], starts_of(np.diff(ends, prepend=0))
    rings = [vertices[a:b] for a, b in zip(begins.tolist(), ends.tolist(), strict=False)]
    by_first = np.argsort(vertex[chained[begins[:-1]]], kind="stable").tolist()
    return [rings[n] for n in by_first]


def signed_area(ring: NDArray[np.int64] | NDArray[np.int32]) -> float:
    """Shoelace, positive counter-clockwise."""
    return float(_shoelace(ring)) / 2.0


@kernel(allocates=False)
def _shoelace(ring):  # type: ignore[no-untyped-def]
    """Twice the signed area of a ring (M, 2)."""
    total = np.int64(0)
    for m in range(ring.shape[0]):
        n = m + 1 if m + 1 < ring.shape[0] else 0
        total += np.int64(ring[m, 0]) * ring[n, 1] - np.int64(ring[n, 0]) * ring[m, 1]
    return total


@kernel(allocates=False)
def inside(ring, u, v):  # type: ignore[no-untyped-def]
    """Whether the point lies inside the ring (even-odd)."""
    odd = False
    count = ring.shape[0]
    j = count - 1
    for i in range(count):
        if (ring[i, 1] > v) != (ring[j, 1] > v):
            cross = (ring[j, 0] - ring[i, 0]) * (v - ring[i, 1]) / (ring[j, 1] - ring[i, 1])
            if u < cross + ring[i, 0]:
                odd = not odd
        j = i
    return odd


def surfaces_of(edges: NDArray[np.int64], least_area: float) -> list[Outline]:
    """Outlines of at least `least_area` (1/8 voxel)^2 from boundary edges (E, 4)."""
    rings = stitch(edges)
    areas = [signed_area(r) for r in rings]
    outers = [(r, a) for r, a in zip(rings, areas, strict=True) if a >= least_area]
    holes: list[list[NDArray[np.int64]]] = [[] for _ in outers]
    by_size = sorted(range(len(outers)), key=lambda i: (outers[i][1], i))
    for ring, area in zip(rings, areas, strict=True):
        if area >= 0.0:
            continue
        (u0, v0), (u1, v1) = ring[0].astype(float), ring[1].astype(float)
        length = float(np.hypot(u1 - u0, v1 - v0))
        u = (u0 + u1) / 2 + 0.05 * (v1 - v0) / length  # just right of an edge: in the hole
        v = (v0 + v1) / 2 - 0.05 * (u1 - u0) / length
        for i in by_size:
            if inside(outers[i][0], u, v):
                holes[i].append(ring)
                break
    whole = [
        (outer, own)
        for (outer, area), own in zip(outers, holes, strict=True)
        if area + sum(signed_area(hole) for hole in own) >= least_area
    ]  # without rows of voxels round nothing
    moved = iter(outward([ring for outer, own in whole for ring in (outer, *own)]))
    outlines = []
    for _, own in whole:
        grown, *others = itertools.islice(moved, 1 + len(own))
        sizes = [signed_area(hole) for hole in others]
        shrunk = [hole for hole, size in zip(others, sizes, strict=True) if size < 0.0]
        area = signed_area(grown) + float(sum(size for size in sizes if size < 0.0))
        outlines.append(Outline(grown, shrunk, area))
    return outlines


def outward(rings: list[NDArray[np.int64]]) -> list[NDArray[np.int32]]:
    """Each vertex moved by OUTWARD away from the surface, along the mean of its edges' normals."""
    if not rings:
        return []
    starts = starts_of([len(ring) for ring in rings])
    firsts, lasts = starts[:-1], starts[1:] - 1
    after, before = np.arange(1, starts[-1] + 1), np.arange(-1, starts[-1] - 1)
    after[lasts], before[firsts] = firsts, lasts
    p = np.concatenate(rings).astype(np.float64)
    step = p[after] - p
    step /= np.hypot(step[:, 0], step[:, 1])[:, None]
    right = np.stack([step[:, 1], -step[:, 0]], axis=1)  # the surface is on the left
    mean = right + right[before]
    norm2 = np.maximum(np.sum(mean * mean, axis=1), 0.5)  # a miter of at most 2.8
    moved = np.floor(p + OUTWARD * 2.0 * mean / norm2[:, None] + 0.5).astype(np.int32)
    keep = np.any(moved != moved[before], axis=1)
    keep |= np.repeat(np.add.reduceat(keep, firsts, dtype=np.int64) <= 2, np.diff(starts))
    kept = starts_of(keep)[starts].tolist()
    moved = moved[keep]
    return [moved[a:b].copy() for a, b in itertools.pairwise(kept)]
