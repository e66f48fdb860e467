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
SPAN = math.isqrt(4 * ALPHA2)  # largest coordinate difference within 2 alpha
FEW = 16  # tiles that are not worth waking other threads for
_FULL = 2.0 * math.pi


def _tables() -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.int64]]:
    """By (dv, du) + SPAN: where the arc of disc centres that hold the point begins and how long it
    is (negative: out of reach). And the cells round a cell, nearest first, as (dv, du)."""
    d = np.arange(-SPAN, SPAN + 1, dtype=np.float64)
    dv, du = np.meshgrid(d, d, indexing="ij")
    distance2 = du * du + dv * dv
    inside = (distance2 > 0) & (distance2 < 4 * ALPHA2)
    half = np.arccos(np.where(inside, np.sqrt(distance2) / (2.0 * math.sqrt(ALPHA2)), 0.0))
    begin = np.mod(np.arctan2(dv, du) - half, _FULL)
    length = np.where(inside, 2.0 * half, -1.0)
    c = np.arange(-HALO, HALO + 1)
    cv, cu = (a.ravel() for a in np.meshgrid(c, c, indexing="ij"))
    gap = np.maximum(np.abs(cv) - 1, 0) ** 2 + np.maximum(np.abs(cu) - 1, 0) ** 2
    near = gap * 64 < 4 * ALPHA2
    order = np.argsort((cv**2 + cu**2)[near], kind="stable")
    return begin, length, np.stack([cv[near], cu[near]], axis=1)[order].astype(np.int64)


_BEGIN, _LENGTH, _AROUND = _tables()


@kernel
def _cut(gaps, ends, count, begin, length, q):  # type: ignore[no-untyped-def]
    """Take the open arc [begin, begin + length) out of the gaps (start, stop); ends holds the
    points that bound each gap. Returns how many gaps are left."""
    if count < 0:  # the first point: the rest of the circle is the only gap
        gaps[0, 0], gaps[0, 1] = begin + length, begin + _FULL
        ends[0, 0], ends[0, 1] = q, q
        return 1
    for turn in range(-1, 2):
        low = begin + turn * _FULL
        high = low + length
        g = 0
        while g < count:
            start, stop = gaps[g, 0], gaps[g, 1]
            if low >= stop or high <= start:
                g += 1
            elif low <= start and high >= stop:
                count -= 1
                gaps[g], ends[g] = gaps[count], ends[count]
            elif low <= start:
                gaps[g, 0], ends[g, 0] = high, q
                g += 1
            elif high >= stop:
                gaps[g, 1], ends[g, 1] = low, q
                g += 1
            else:
                gaps[count, 0], gaps[count, 1] = high, stop
                ends[count, 0], ends[count, 1] = q, ends[g, 1]
                gaps[g, 1], ends[g, 1] = low, q
                count += 1
                g += 1
    return count


@kernel
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


@kernel
def _roll(window, wanted, begin, length, around, edges):  # type: ignore[no-untyped-def]
    """Edges (u, v, u', v') that start in the wanted cells (CELLS, CELLS) of the window's middle
    tile, grid units from the tile's corner. Returns how many, or -1 where `edges` is too short."""
    gaps = np.empty((64, 2))
    ends = np.empty((64, 2), np.int64)
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
                count = -1
                for a in range(around.shape[0]):
                    dv, du = around[a, 0], around[a, 1]
                    near = window[row + HALO + dv, column + HALO + du]
                    while near != np.uint64(0):
                        b = np.int64(trailing_zeros(near))
                        near &= near - np.uint64(1)
                        x = 8 * du + (b & 7) - pu
                        y = 8 * dv + (b >> 3) - pv
                        if abs(x) > SPAN or abs(y) > SPAN:
                            continue
                        arc = length[y + SPAN, x + SPAN]
                        if arc > 0.0:
                            q = (y + SPAN) * 1024 + (x + SPAN)
                            count = _cut(gaps, ends, count, begin[y + SPAN, x + SPAN], arc, q)
                            if count == 0:
                                break
                    if count == 0:
                        break
                if num + max(count, 0) > edges.shape[0]:
                    return -1
                for g in range(max(count, 0)):
                    q = ends[g, 1]
                    u, v = 8 * column + pu, 8 * row + pv
                    edges[num, 0], edges[num, 1] = u, v
                    edges[num, 2] = u + (q & 1023) - SPAN
                    edges[num, 3] = v + (q >> 10) - SPAN
                    num += 1
    return num


@kernel(parallel=True)
def _roll_all(windows, wanted, begin, length, around, edges, counts):  # type: ignore[no-untyped-def]
    for n in prange(windows.shape[0]):
        counts[n] = _roll(windows[n], wanted[n], begin, length, around, edges[n])


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
        if len(windows) < FEW:
            for n in range(len(windows)):
                counts[n] = _roll(windows[n], wanted[n], _BEGIN, _LENGTH, _AROUND, edges[n])
        else:
            _roll_all(windows, wanted, _BEGIN, _LENGTH, _AROUND, edges, counts)
        if not (counts < 0).any():
            return [own[:count].copy() for own, count in zip(edges, counts, strict=True)]
        room *= 4
