"""Boundary of the alpha complex of grid points, by rolling a disc round every point.

A directed edge p -> q is on the boundary where the disc of radius alpha through both, on the right
of the edge, holds no point (Edelsbrunner, Kirkpatrick & Seidel 1983: p and q are alpha-exposed).
That depends on points within 2 alpha of p alone, so a tile with that halo gives exactly the edges
of the whole. The squared radius is chosen so that no three grid points lie on one such circle
(settings.ALPHA2): there are no ties, and angles in float64 decide every test rightly.
"""

from __future__ import annotations

import math

import numpy as np
from numba import prange
from numpy.typing import NDArray

from facet.mapping.bits import trailing_zeros
from facet.mapping.kernel import kernel
from facet.mapping.settings import ALPHA2

CELLS = 64  # cells of a (u, v) tile's edge; a cell is one voxel, 8 x 8 grid points, one word
HALO = 11  # cells: a point within 2 alpha is at most so far away
SIDE = CELLS + 2 * HALO  # cells of a window's edge: a tile with its halo
WIDE = 8 * HALO + 7  # largest coordinate difference between points of cells so far apart
FEW = 16  # tiles that are not worth waking other threads for
_FULL = 2.0 * math.pi
_SLACK = 1e-6  # radians that a span is longer than it must be


def _arcs() -> NDArray[np.float64]:
    """By (dv, du) + WIDE: where the arc of disc centres that hold the point begins, where it ends
    (both in [0, 2 pi)) and how long it is (negative: out of reach)."""
    d = np.arange(-WIDE, WIDE + 1, dtype=np.float64)
    dv, du = np.meshgrid(d, d, indexing="ij")
    distance2 = du * du + dv * dv
    inside = (distance2 > 0) & (distance2 < 4 * ALPHA2)
    half = np.arccos(np.where(inside, np.sqrt(distance2) / (2.0 * math.sqrt(ALPHA2)), 0.0))
    middle = np.arctan2(dv, du)
    begin, end = (np.mod(middle + side * half, _FULL) for side in (-1.0, 1.0))
    return np.stack([begin, end, np.where(inside, 2.0 * half, -1.0)], axis=-1)


def _cells(arcs: NDArray[np.float64]) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
    """The cells round a cell, nearest first, as (dv, du); and of each where the arcs of all points
    that it may hold begin, and how long they are together."""
    c = np.arange(-HALO, HALO + 1)
    cv, cu = (a.ravel() for a in np.meshgrid(c, c, indexing="ij"))
    gap = [np.maximum(8 * np.abs(cell) - 7, 0) for cell in (cv, cu)]
    near = gap[0] ** 2 + gap[1] ** 2 < 4 * ALPHA2
    order = np.argsort((cv**2 + cu**2)[near], kind="stable")
    around = np.stack([cv[near], cu[near]], axis=1)[order].astype(np.int64)
    spans = np.empty((len(around), 2))
    for span, (dv, du) in zip(spans, around.tolist(), strict=True):
        v, u = 8 * dv + WIDE, 8 * du + WIDE
        own = arcs[v - 7 : v + 8, u - 7 : u + 8].reshape(-1, 3)
        own = own[own[:, 2] > 0.0]
        middle = math.atan2(dv, du) - math.pi
        begin = np.mod(own[:, 0] + own[:, 2] / 2.0 - middle, _FULL) - own[:, 2] / 2.0
        low, high = float(begin.min()), float((begin + own[:, 2]).max())
        span[:] = (middle + low - _SLACK) % _FULL, high - low + 2.0 * _SLACK
    return around, spans


_ARCS = _arcs()
_AROUND, _SPANS = _cells(_ARCS)


@kernel(allocates=False)
def _ahead(angle, start):  # type: ignore[no-untyped-def]
    """From one angle on to another, both in [0, 2 pi): how far it is, in [0, 2 pi)."""
    return angle - start if angle >= start else angle - start + _FULL


@kernel(allocates=False)
def _cut(gaps, ends, count, begin, end, length, q):  # type: ignore[no-untyped-def]
    """Take the open arc from `begin` to `end` out of the gaps (start, length); ends holds the
    points that bound each gap. Returns how many gaps are left."""
    if count < 0:  # the first point: the rest of the circle is the only gap
        gaps[0, 0], gaps[0, 1] = end, _FULL - length
        ends[0, 0], ends[0, 1] = q, q
        return 1
    g = 0
    while g < count:
        start, own = gaps[g, 0], gaps[g, 1]
        first = _ahead(begin, start)  # where the arc begins, from the start of the gap
        last = first + length
        over = last - _FULL  # how far the arc reaches round into the gap
        if first >= own:  # it begins behind the gap
            if over >= own:
                count -= 1
                gaps[g, 0], gaps[g, 1] = gaps[count, 0], gaps[count, 1]
                ends[g, 0], ends[g, 1] = ends[count, 0], ends[count, 1]
                continue
            if over > 0.0:
                gaps[g, 0], gaps[g, 1], ends[g, 0] = end, own - over, q
        elif last >= own:  # it begins in the gap and ends behind it
            if over > 0.0:
                gaps[g, 0], gaps[g, 1], ends[g, 0] = end, first - over, q
            else:
                gaps[g, 1] = first
            ends[g, 1] = q
        else:
            gaps[count, 0], gaps[count, 1] = end, own - last
            ends[count, 0], ends[count, 1] = q, ends[g, 1]
            gaps[g, 1], ends[g, 1] = first, q
            count += 1
        g += 1
    return count


@kernel(allocates=False)
def _surrounded(window, row, column):  # type: ignore[no-untyped-def]
    """Whether the eight cells round a cell all hold points. Then no point in it is on the boundary:
    whichever way the disc lies, it swallows one of these cells whole."""
    for dv in range(-1, 2):
        for du in range(-1, 2):
            if window[row + dv, column + du] == np.uint64(0):
                return False
    return True


@kernel
def mark_changes(old, new, near):  # type: ignore[no-untyped-def]
    """Mark in near (SIDE, SIDE) the cells, of a tile and of its halo, whose points may have other
    edges now that the tile's cells are `new`, not `old`. Whether there are any.

    What a cell holds matters to nobody while all its neighbours hold points, before and after: a
    disc that touches it swallows one of them whole, so it is not empty either way."""
    rows = np.zeros((CELLS, SIDE), np.bool_)
    found = False
    for row in range(CELLS):
        for column in range(CELLS):
            if old[row, column] == new[row, column]:
                continue
            inside = 0 < row < CELLS - 1 and 0 < column < CELLS - 1
            if inside and _surrounded(old, row, column) and _surrounded(new, row, column):
                continue
            rows[row, column : column + 2 * HALO + 1] = True
            found = True
    if found:
        for row in range(CELLS):
            if rows[row].any():
                for k in range(row, row + 2 * HALO + 1):
                    near[k] |= rows[row]
    return found


@kernel(allocates=False)
def _roll(window, wanted, arcs, around, spans, gaps, ends, edges):  # type: ignore[no-untyped-def]
    """Edges (u, v, u', v') that start in the wanted cells (CELLS, CELLS) of the window's middle
    tile, grid units from the tile's corner. Returns how many, or -1 where `edges` is too short.
    gaps, ends (64, 2): room."""
    num = 0
    for row in range(CELLS):
        for column in range(CELLS):
            word = window[row + HALO, column + HALO]
            if word == np.uint64(0) or not wanted[row, column]:
                continue
            if _surrounded(window, row + HALO, column + HALO):
                continue
            while word != np.uint64(0):
                bit = np.int64(trailing_zeros(word))
                word &= word - np.uint64(1)
                pu, pv = bit & 7, bit >> 3
                count = _exposed(
                    window, row + HALO, column + HALO, pu, pv, arcs, around, spans, gaps, ends
                )
                if num + count > edges.shape[0]:
                    return -1
                for g in range(count):
                    q = ends[g, 1]
                    u, v = 8 * column + pu, 8 * row + pv
                    edges[num, 0], edges[num, 1] = u, v
                    edges[num, 2] = u + (q & 1023) - WIDE
                    edges[num, 3] = v + (q >> 10) - WIDE
                    num += 1
    return num


@kernel(allocates=False)
def _apart(gaps, count, begin, length):  # type: ignore[no-untyped-def]
    """Whether an arc meets none of the gaps."""
    for g in range(count):
        first = _ahead(begin, gaps[g, 0])
        if first < gaps[g, 1] or first + length > _FULL:
            return False
    return True


@kernel(allocates=False)
def _exposed(window, row, column, pu, pv, arcs, around, spans, gaps, ends):  # type: ignore[no-untyped-def]
    """Find the gaps between the arcs of all points that the disc round (pu, pv) of a cell meets.
    How many there are."""
    count = -1
    for a in range(around.shape[0]):
        dv, du = around[a, 0], around[a, 1]
        near = window[row + dv, column + du]
        if near == np.uint64(0) or (count > 0 and _apart(gaps, count, spans[a, 0], spans[a, 1])):
            continue
        while near != np.uint64(0):
            b = np.int64(trailing_zeros(near))
            near &= near - np.uint64(1)
            x = 8 * du + (b & 7) - pu + WIDE
            y = 8 * dv + (b >> 3) - pv + WIDE
            length = arcs[y, x, 2]
            if length > 0.0:
                q = (y << 10) + x
                count = _cut(gaps, ends, count, arcs[y, x, 0], arcs[y, x, 1], length, q)
                if count == 0:
                    return 0
    return max(count, 0)


@kernel(parallel=True)
def _roll_all(windows, wanted, arcs, around, spans, edges, counts):  # type: ignore[no-untyped-def]
    for n in prange(windows.shape[0]):
        gaps, ends = np.empty((64, 2)), np.empty((64, 2), np.int64)
        counts[n] = _roll(windows[n], wanted[n], arcs, around, spans, gaps, ends, edges[n])


@kernel
def _roll_some(windows, wanted, arcs, around, spans, edges, counts):  # type: ignore[no-untyped-def]
    gaps, ends = np.empty((64, 2)), np.empty((64, 2), np.int64)
    for n in range(windows.shape[0]):
        counts[n] = _roll(windows[n], wanted[n], arcs, around, spans, gaps, ends, edges[n])


def boundary_edges(
    windows: NDArray[np.uint64], wanted: NDArray[np.bool_] | None = None
) -> list[NDArray[np.int32]]:
    """For each window (N, ..) of cells its edges (E, 4): (u, v, u', v') that start in the wanted
    cells of the middle; all of them by default.

    windows: (N, SIDE, SIDE) words, a bit u + 8 v for each grid point of a cell, rows by v; wanted:
    (N, CELLS, CELLS)."""
    if wanted is None:
        wanted = np.ones((len(windows), CELLS, CELLS), np.bool_)
    room = 1024
    while True:
        edges = np.empty((len(windows), room, 4), np.int32)
        counts = np.empty(len(windows), np.int64)
        roll = _roll_some if len(windows) < FEW else _roll_all
        roll(windows, wanted, _ARCS, _AROUND, _SPANS, edges, counts)
        if not (counts < 0).any():
            return [own[:count].copy() for own, count in zip(edges, counts, strict=True)]
        room *= 4
