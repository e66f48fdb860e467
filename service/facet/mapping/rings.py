"""Boundary edges to rings, rings to surfaces: outer rings with their holes."""

from __future__ import annotations

import itertools
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from facet.mapping.kernel import kernel

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


@kernel
def _in_order(edges):  # type: ignore[no-untyped-def]
    """Edges (E, 4) by where they start, then by where they stop, each once."""
    start, stop = _keys(edges)
    kept, count = np.empty(start.shape[0], np.int64), 0
    for e in np.argsort(start, kind="mergesort"):
        at = count  # among the few that start there
        while at > 0 and start[kept[at - 1]] == start[e] and stop[kept[at - 1]] > stop[e]:
            at -= 1
        if at > 0 and start[kept[at - 1]] == start[e] and stop[kept[at - 1]] == stop[e]:
            continue
        for n in range(count, at, -1):
            kept[n] = kept[n - 1]
        kept[at] = e
        count += 1
    return edges[kept[:count]]


@kernel
def _stitch(edges):  # type: ignore[no-untyped-def]
    """Vertices (M, 2) of the rings of edges (E, 4), and where each stops (R,): see `stitch`."""
    edges = _in_order(edges)
    start, stop = _keys(edges)
    edges = edges[_single(start, stop, edges, ROW)]
    start, stop = _keys(edges)
    vertex, number = np.empty(start.shape[0], np.int64), np.int64(0)
    for e in range(start.shape[0]):
        number += e > 0 and start[e] > start[e - 1]
        vertex[e] = number
    chained, ends = _chains(_successors(start, stop, edges))
    chained, ends = _split(chained, ends, vertex)
    begins = np.empty(ends.shape[0], np.int64)
    for r in range(ends.shape[0]):
        begins[r] = ends[r - 1] if r else 0
    order = np.argsort(vertex[chained[begins]], kind="mergesort")
    vertices, stops = np.empty((chained.shape[0], 2), np.int64), np.empty_like(ends)
    count = 0
    for r in range(order.shape[0]):
        for n in range(begins[order[r]], ends[order[r]]):
            vertices[count] = edges[chained[n], :2]
            count += 1
        stops[r] = count
    return vertices, stops


def stitch(edges: NDArray[np.int64]) -> list[NDArray[np.int64]]:
    """Closed rings (M, 2) of directed edges (E, 4), each from its smallest vertex, in order of it.

    An edge that is there both ways has no area at either side. A row of voxels is such a strip: the
    threshold that closes a door. Others are left out."""
    vertices, stops = _stitch(edges)
    return [vertices[a:b] for a, b in itertools.pairwise([0, *stops.tolist()])]


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


@kernel
def _owners(vertices, stops, least_area):  # type: ignore[no-untyped-def]
    """(R,) the outer ring of at least `least_area` that each ring lies in, or is; -1: none."""
    count, begin = stops.shape[0], np.int64(0)
    areas, owner = np.empty(count), np.full(count, -1, np.int64)
    for r in range(count):
        areas[r] = _shoelace(vertices[begin : stops[r]]) / 2.0
        begin = stops[r]
    by_size = np.argsort(areas, kind="mergesort")
    outers = by_size[areas[by_size] >= least_area]
    begin = np.int64(0)
    for r in range(count):
        if areas[r] >= least_area:
            owner[r] = r
        elif areas[r] < 0.0:
            u0, v0 = float(vertices[begin, 0]), float(vertices[begin, 1])
            u1, v1 = float(vertices[begin + 1, 0]), float(vertices[begin + 1, 1])
            length = np.sqrt((u1 - u0) * (u1 - u0) + (v1 - v0) * (v1 - v0))
            u = (u0 + u1) / 2 + 0.05 * (v1 - v0) / length  # just right of an edge: in the hole
            v = (v0 + v1) / 2 - 0.05 * (u1 - u0) / length
            for o in outers:
                if inside(vertices[(stops[o - 1] if o else 0) : stops[o]], u, v):
                    owner[r] = o
                    break
        begin = stops[r]
    whole = np.zeros(count)
    for r in range(count):
        if owner[r] >= 0:
            whole[owner[r]] += areas[r]
    for r in range(count):
        if owner[r] >= 0 and whole[owner[r]] < least_area:  # a row of voxels round nothing
            owner[r] = -1
    return owner


@kernel
def outward(ring):  # type: ignore[no-untyped-def]
    """A ring (M, 2) with each vertex moved by OUTWARD away from the surface, along the mean of its
    edges' normals, int32."""
    count = ring.shape[0]
    right, moved = np.empty((count, 2)), np.empty((count, 2), np.int32)
    for m in range(count):
        n = m + 1 if m + 1 < count else 0
        u, v = float(ring[n, 0] - ring[m, 0]), float(ring[n, 1] - ring[m, 1])
        length = np.sqrt(u * u + v * v)
        right[m, 0], right[m, 1] = v / length, -u / length  # the surface is on the left
    for m in range(count):
        u, v = right[m, 0] + right[m - 1, 0], right[m, 1] + right[m - 1, 1]
        far = 2.0 * OUTWARD / max(u * u + v * v, 0.5)  # a miter of at most 2.8
        moved[m, 0] = np.int32(np.floor(ring[m, 0] + far * u + 0.5))
        moved[m, 1] = np.int32(np.floor(ring[m, 1] + far * v + 0.5))
    out, kept = np.empty_like(moved), 0
    for m in range(count):
        if moved[m, 0] != moved[m - 1, 0] or moved[m, 1] != moved[m - 1, 1]:
            out[kept] = moved[m]
            kept += 1
    return out[:kept] if kept > 2 else moved


@kernel
def _outline(edges, least_area):  # type: ignore[no-untyped-def]
    """Rings of the surfaces that edges (E, 4) bound, moved outward: an outer ring, then its holes.

    Returns vertices (M, 2), where each ring stops (R,), and their signed areas (R,)."""
    vertices, stops = _stitch(edges)
    owner = _owners(vertices, stops, least_area)
    out = np.empty((vertices.shape[0], 2), np.int32)
    ends, areas = np.empty(stops.shape[0], np.int64), np.empty(stops.shape[0])
    places = np.arange(stops.shape[0])
    num, rings = 0, 0
    for n in np.argsort(2 * owner + (owner != places), kind="mergesort"):
        if owner[n] < 0:
            continue
        ring = outward(vertices[(stops[n - 1] if n else 0) : stops[n]])
        area = _shoelace(ring) / 2.0
        if owner[n] != n and area >= 0.0:  # a hole that closed
            continue
        out[num : num + ring.shape[0]] = ring
        num += ring.shape[0]
        ends[rings], areas[rings] = num, area
        rings += 1
    return out[:num].copy(), ends[:rings], areas[:rings]


def surfaces_of(edges: NDArray[np.int64], least_area: float) -> list[Outline]:
    """Outlines of at least `least_area` (1/8 voxel)^2 from boundary edges (E, 4)."""
    vertices, ends, areas = _outline(edges, least_area)
    outlines: list[Outline] = []
    for (begin, end), area in zip(
        itertools.pairwise([0, *ends.tolist()]), areas.tolist(), strict=True
    ):
        ring = vertices[begin:end]
        if area >= 0.0:
            outlines.append(Outline(ring, [], area))
        else:
            last = outlines[-1]
            outlines[-1] = Outline(last.outer, [*last.holes, ring], last.area + area)
    return outlines
