"""Cells of the (u, v) tiles of outlines: which points they hold, and what a change makes stale."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import prange
from numpy.typing import NDArray

from facet.mapping.blocks import unpack
from facet.mapping.kernel import kernel
from facet.mapping.pivot import CELLS, HALO, SIDE, mark_changes
from facet.mapping.settings import BLOCK, STEPS

SIZE = CELLS * STEPS  # grid units of a (u, v) tile's edge
PLACES = 64  # (u, v) tiles that a tile-plane falls into, at most
RIGHT, UP = 1 << 32, 1  # from the place of a (u, v) tile, tile_u * 2^32 + tile_v, to the next
AROUND = tuple(RIGHT * a + UP * b for b in (-1, 0, 1) for a in (-1, 0, 1))
_PARTS = (  # of a window, by row or column: where it begins and ends, and that in its own tile
    (0, HALO, CELLS - HALO),
    (HALO, HALO + CELLS, 0),
    (HALO + CELLS, SIDE, 0),
)


class Cells(NamedTuple):
    """The cells of a (u, v) tile that hold points."""

    places: NDArray[np.int16]  # (N,) column + CELLS * row, ascending
    words: NDArray[np.uint64]  # (N,) a bit u + 8 v for each grid point


class Share(NamedTuple):
    """What one tile-plane gives to its plane's outline."""

    corner: tuple[int, int]  # grid units, the least of its points
    points: NDArray[np.int16]  # (N, 2) grid units from the corner: a tile is 888 across
    places: list[int]  # of the (u, v) tiles that they fall into


@kernel(allocates=False)
def _project(rows, block, size, blocks, columns, axes, out):  # type: ignore[no-untyped-def]
    """(u, v) in grid units of the voxels of runs, into out (N, 2)."""
    m = 0
    for r in range(block.shape[0]):
        i, j, k = unpack(blocks.keys[block[r]])
        for _ in range(size[r]):
            seen, local = columns.observable[rows[m]], np.int64(columns.local[rows[m]])
            x = STEPS * (BLOCK * i + (local & 7)) + (seen & 15)
            y = STEPS * (BLOCK * j + ((local >> 3) & 7)) + ((seen >> 4) & 15)
            z = STEPS * (BLOCK * k + (local >> 6)) + ((seen >> 8) & 15)
            out[m, 0] = np.floor(x * axes[0, 0] + y * axes[0, 1] + z * axes[0, 2] + 0.5)
            out[m, 1] = np.floor(x * axes[1, 0] + y * axes[1, 1] + z * axes[1, 2] + 0.5)
            m += 1


@kernel(allocates=False)
def _share(uv, points, corner, places):  # type: ignore[no-untyped-def]
    """Points (N, 2) from their least corner, given as (N, 2) uv, and the places of the (u, v) tiles
    that they fall into, each once. Returns how many."""
    corner[0], corner[1] = uv[0, 0], uv[0, 1]
    count, last = 0, np.int64(-(2**62))
    for p in range(uv.shape[0]):
        corner[0], corner[1] = min(corner[0], uv[p, 0]), min(corner[1], uv[p, 1])
        key = (np.int64(uv[p, 0]) // SIZE) * RIGHT + np.int64(uv[p, 1]) // SIZE
        if key == last:
            continue
        last = key
        known = False
        for s in range(count):
            known |= places[s] == key
        if not known and count < PLACES:
            places[count] = key
            count += 1
    for p in range(uv.shape[0]):
        points[p, 0], points[p, 1] = uv[p, 0] - corner[0], uv[p, 1] - corner[1]
    return count


@kernel(parallel=True)
def share_all(  # type: ignore[no-untyped-def]
    rows, starts, block, size, run_starts, parts, blocks, columns, axes, points, corners, places,
    num_places
):  # fmt: skip
    """`_share` of S tile-planes, whose rows begin at starts (S + 1,) and whose runs at run_starts,
    in frames with axes (S, 2, 3). parts: tile-planes that each thread begins with."""
    for part in prange(parts.shape[0] - 1):
        for s in range(parts[part], parts[part + 1]):
            low, high = starts[s], starts[s + 1]
            runs = slice(run_starts[s], run_starts[s + 1])
            num_places[s] = 0
            if low < high:
                uv = np.empty((high - low, 2), np.int32)
                _project(rows[low:high], block[runs], size[runs], blocks, columns, axes[s], uv)
                num_places[s] = _share(uv, points[low:high], corners[s], places[s])


@kernel(allocates=False)
def _paint(points, corner, place, cells):  # type: ignore[no-untyped-def]
    """Set the bits of the points (N, 2), relative to a corner, that lie in a (u, v) tile."""
    tile_u, tile_v = _tile_at(place)
    left, low = corner[0] - SIZE * tile_u, corner[1] - SIZE * tile_v
    for p in range(points.shape[0]):
        u, v = left + points[p, 0], low + points[p, 1]
        if 0 <= u < SIZE and 0 <= v < SIZE:
            bit = np.uint64(1) << np.uint64((u & 7) + 8 * (v & 7))
            cells[v >> 3, u >> 3] |= bit


@kernel(allocates=False)
def _tile_at(place):  # type: ignore[no-untyped-def]
    """(tile_u, tile_v) of a place."""
    tile_u = (place + RIGHT // 2) // RIGHT
    return tile_u, place - tile_u * RIGHT


@kernel(allocates=False)
def _put(places, words, row, column, window):  # type: ignore[no-untyped-def]
    """Copy the cells of a tile that begins at (row, column) of a window, as far as they lie in
    it."""
    for n in range(places.shape[0]):
        r, c = row + (places[n] >> 6), column + (places[n] & 63)
        if 0 <= r < window.shape[0] and 0 <= c < window.shape[1]:
            window[r, c] = words[n]


@kernel(allocates=False)
def _any(marked, rows, columns):  # type: ignore[no-untyped-def]
    """Whether any of a part of the cells is marked."""
    for row in range(rows[0], rows[1]):
        for column in range(columns[0], columns[1]):
            if marked[row, column]:
                return True
    return False


@kernel(parallel=True)
def repaint(  # type: ignore[no-untyped-def]
    tiles, points, starts, corners, shares, share_starts, old_places, old_words, old_starts,
    places, words, counts, marked, touched
):  # fmt: skip
    """Draw (u, v) tiles (N,) again, of whose points those of tile n are of the shares from
    shares[share_starts[n]] on: their cells into places and words (N, CELLS^2), counts (N,) of them.

    Marks in marked (N, SIDE, SIDE) the cells whose edges may have changed since the tiles had the
    old cells, and in touched (N, 9) which of the tiles AROUND each these lie in."""
    for n in prange(tiles.shape[0]):
        cells = np.zeros((CELLS, CELLS), np.uint64)
        for at in range(share_starts[n], share_starts[n + 1]):
            s = shares[at]
            _paint(points[starts[s] : starts[s + 1]], corners[s], tiles[n], cells)
        before = slice(old_starts[n], old_starts[n + 1])
        old = np.zeros((CELLS, CELLS), np.uint64)
        _put(old_places[before], old_words[before], 0, 0, old)
        counts[n] = _list_cells(cells, places[n], words[n])
        _touch(old, cells, marked[n], touched[n])


@kernel
def _touch(old, cells, marked, touched):  # type: ignore[no-untyped-def]
    """Mark what may have other edges now, and which tiles that is in."""
    found = mark_changes(old, cells, marked)
    for part in range(9):
        touched[part] = found and _any(marked, _PARTS[part // 3], _PARTS[part % 3])


@kernel(allocates=False)
def _list_cells(cells, places, words):  # type: ignore[no-untyped-def]
    """List the cells that hold points. How many."""
    count = 0
    for row in range(CELLS):
        for column in range(CELLS):
            if cells[row, column] != np.uint64(0):
                places[count], words[count] = CELLS * row + column, cells[row, column]
                count += 1
    return count


def part_of(marked: NDArray[np.bool_], part: int, wanted: NDArray[np.bool_]) -> None:
    """Mark in the cells `wanted` (CELLS, CELLS) of a tile AROUND another what is marked of them
    (SIDE, SIDE)."""
    (top, bottom, row), (left, right, column) = _PARTS[part // 3], _PARTS[part % 3]
    own = wanted[row : row + bottom - top, column : column + right - left]
    own |= marked[top:bottom, left:right]


@kernel(allocates=False)
def _fill_window(places, words, starts, around, window):  # type: ignore[no-untyped-def]
    """Copy a tile and its halo into a window (SIDE, SIDE)."""
    window[:] = np.uint64(0)
    for part in range(9):
        n = around[part]
        if n >= 0:
            row, column = HALO + CELLS * (part // 3 - 1), HALO + CELLS * (part % 3 - 1)
            own = slice(starts[n], starts[n + 1])
            _put(places[own], words[own], row, column, window)


@kernel(parallel=True)
def fill_windows(places, words, starts, around, windows):  # type: ignore[no-untyped-def]
    """Copy tiles and their halos into windows (W, SIDE, SIDE). around: (W, 9) of the tiles AROUND
    each the number n, whose cells begin at starts[n], -1: it has none."""
    for w in prange(windows.shape[0]):
        _fill_window(places, words, starts, around[w], windows[w])


@kernel
def _replace(place, old, new, wanted, edges):  # type: ignore[no-untyped-def]
    """`replace_edges` of one tile. Returns how many edges it has, and whether these were all."""
    tile_u, tile_v = _tile_at(place)
    left, low = SIZE * tile_u, SIZE * tile_v
    keys = np.empty(old.shape[0] + new.shape[0], np.int64)
    num = 0
    for e in range(old.shape[0]):
        u, v = old[e, 0] - left, old[e, 1] - low
        if not wanted[v // STEPS, u // STEPS]:
            keys[num] = _edge_key(u, v, old[e, 2] - left, old[e, 3] - low)
            num += 1
    for e in range(new.shape[0]):
        keys[num] = _edge_key(new[e, 0], new[e, 1], new[e, 2], new[e, 3])
        num += 1
    keys = np.sort(keys[:num])
    same = num == old.shape[0]
    for e in range(num):
        edges[e, 0], edges[e, 1] = left + (keys[e] & 1023), low + ((keys[e] >> 10) & 1023)
        edges[e, 2] = left + ((keys[e] >> 20) & 0xFFFFF) - SIZE
        edges[e, 3] = low + (keys[e] >> 40) - SIZE
        for a in range(4 * same):
            same &= old[e, a] == edges[e, a]
    return num, same


@kernel
def replace_edges(tiles, old, old_starts, new, new_starts, wanted, edges, counts, same):  # type: ignore[no-untyped-def]
    """Edges (u, v, u', v') of (u, v) tiles (N,), in canonical order: the old ones that do not start
    in the `wanted` cells (N, CELLS, CELLS), and the new ones, which count from the tile's corner.
    Those of tile n begin where its old and new ones do together; counts (N,) of them, same (N,):
    whether they are as before."""
    for n in range(tiles.shape[0]):
        before = old[old_starts[n] : old_starts[n + 1]]
        found = new[new_starts[n] : new_starts[n + 1]]
        own = edges[old_starts[n] + new_starts[n] :]
        counts[n], same[n] = _replace(tiles[n], before, found, wanted[n], own)


@kernel(allocates=False)
def _edge_key(u, v, to_u, to_v):  # type: ignore[no-untyped-def]
    """Edges of a tile are in the order of these keys: by v', u', v, u."""
    return ((np.int64(to_v) + SIZE) << 40) | ((np.int64(to_u) + SIZE) << 20) | (v << 10) | u
