"""Boundary edges to rings, rings to surfaces: outer rings with their holes."""

from __future__ import annotations

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


@kernel
def _vertex_key(u, v):  # type: ignore[no-untyped-def]
    return ((u + _SHIFT) << 32) | (v + _SHIFT)


@kernel
def _half(x, y):  # type: ignore[no-untyped-def]
    """0 for angles in [0, 180), 1 for [180, 360)."""
    return 0 if y > 0 or (y == 0 and x > 0) else 1


@kernel
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
    rings = []
    for chain in np.split(chained, ends[:-1]) if len(ends) else []:
        rings.extend(_simple_rings(edges[chain, :2], start[chain]))
    return sorted(rings, key=lambda ring: tuple(ring[0]))


def _simple_rings(ring: NDArray[np.int64], keys: NDArray[np.int64]) -> list[NDArray[np.int64]]:
    """A ring split where it comes back to a vertex, so that none touches itself. Signed areas add
    up to that of the whole. keys: (M,) of the vertices, ascending by (u, v)."""
    if len(np.unique(keys)) == len(keys):
        return [np.roll(ring, -int(np.argmin(keys)), axis=0)] if len(ring) > 2 else []
    rings, path = [], list[int]()
    place: dict[int, int] = {}
    for index, key in enumerate(keys.tolist()):
        if key in place:
            begin = place[key]
            rings.append(path[begin:])
            for dropped in path[begin:]:
                del place[int(keys[dropped])]
            path = path[:begin]
        place[key] = len(path)
        path.append(index)
    rings.append(path)
    simple = []
    for chain in rings:
        if len(chain) > 2:
            first = int(np.argmin(keys[chain]))
            simple.append(ring[np.roll(chain, -first)])
    return simple


def signed_area(ring: NDArray[np.int64] | NDArray[np.int32]) -> float:
    """Shoelace, positive counter-clockwise."""
    u, v = ring[:, 0].astype(np.int64), ring[:, 1].astype(np.int64)
    return float(np.sum(u * np.roll(v, -1) - np.roll(u, -1) * v)) / 2.0


@kernel
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
    outlines = []
    for (outer, _), own in zip(outers, holes, strict=True):
        grown = outward(outer)
        shrunk = [h for h in (outward(hole) for hole in own) if signed_area(h) < 0.0]
        if signed_area(outer) + sum(signed_area(hole) for hole in own) < least_area:
            continue  # rows of voxels round nothing
        area = signed_area(grown) + float(sum(signed_area(h) for h in shrunk))
        outlines.append(Outline(grown, shrunk, area))
    return outlines


def outward(ring: NDArray[np.int64]) -> NDArray[np.int32]:
    """Each vertex moved by OUTWARD away from the surface, along the mean of its edges' normals."""
    p = ring.astype(np.float64)
    step = np.roll(p, -1, axis=0) - p
    step /= np.hypot(step[:, 0], step[:, 1])[:, None]
    right = np.stack([step[:, 1], -step[:, 0]], axis=1)  # the surface is on the left
    mean = right + np.roll(right, 1, axis=0)
    norm2 = np.maximum(np.sum(mean * mean, axis=1), 0.5)  # a miter of at most 2.8
    moved = np.floor(p + OUTWARD * 2.0 * mean / norm2[:, None] + 0.5).astype(np.int32)
    keep = np.any(moved != np.roll(moved, 1, axis=0), axis=1)
    return np.asarray(moved[keep] if int(keep.sum()) > 2 else moved, dtype=np.int32)
