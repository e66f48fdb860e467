"""The table of all tile-planes: what the stages that run whole read.

Most tiles have the same tile-planes as at the last update: their rows are copied from its table."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from facet.mapping.blocks import pack
from facet.mapping.kernel import kernel
from facet.mapping.merging import Nodes
from facet.mapping.runs import starts_of
from facet.mapping.tile import Tile, empty_tile

_STEPS = np.array([pack(n % 3, n // 3 % 3, n // 9) for n in range(27)], np.int64)
_STEPS -= pack(1, 1, 1)  # from a tile's key to those round it


class Table(NamedTuple):
    """All tile-planes in canonical order: by tile key, then by their order in the tile."""

    tile_keys: NDArray[np.int64]  # (L,) ascending
    starts: NDArray[np.int64]  # (L + 1,) first node of each tile
    nodes: Nodes  # (T, ...)
    occupation: NDArray[np.int64]  # (T,) voxels
    edges: NDArray[np.int32]  # (E, 2) adjacent nodes, ascending
    points: NDArray[np.int64]  # (T, 10) exact moments of pure points about the tile corner
    total: NDArray[np.int64]  # (T,) points of all members
    tile_of: NDArray[np.int64]  # (T,) index into tile_keys


Part = tuple[NDArray[Any], ...]  # what a table has of a tile: nodes, then these
OCCUPATION, POINTS, TOTAL, PAIRS = range(len(Nodes._fields), len(Nodes._fields) + 4)


class Tabulator:
    """Makes tables, each from the one before."""

    def __init__(self) -> None:
        none = np.zeros(0, np.int64)
        self._keys, self._starts, self._pair_starts = none, starts_of(none), starts_of(none)
        self._near = np.zeros((0, len(_STEPS)), np.int64)  # by tile: places of those round it
        self._whole = _part_of(empty_tile(0, np.zeros(0, np.int32)))  # of all tiles
        self._parts: dict[int, tuple[int, Part]] = {}  # by key: place among the tiles, and its part

    def tabulate(self, tiles: dict[int, Tile]) -> Table:
        """The table of tiles, by key. An array that a tile had at the last call, too, must hold the
        same now."""
        keys = sorted(key for key, tile in tiles.items() if tile.num_planes)
        parts = [_part_of(tiles[key]) for key in keys]
        starts = starts_of([len(part[0]) for part in parts])
        pair_starts = starts_of([len(part[PAIRS]) for part in parts])
        runs = self._runs(keys, parts)
        whole = tuple(self._splice(c, parts, runs) for c in range(PAIRS + 1))
        self._find_near(np.array(keys, np.int64))
        self._starts, self._pair_starts, self._whole = starts, pair_starts, whole
        self._parts = {k: (n, part) for n, (k, part) in enumerate(zip(keys, parts, strict=True))}
        edges = np.empty((len(whole[PAIRS]), 2), np.int32)
        _number(whole[PAIRS], pair_starts, starts, self._near, edges)
        return Table(
            self._keys, starts, Nodes(*whole[:OCCUPATION]), whole[OCCUPATION], edges, whole[POINTS],
            whole[TOTAL], np.repeat(np.arange(len(keys)), np.diff(starts)),
        )  # fmt: skip

    def _runs(self, keys: list[int], parts: list[Part]) -> list[tuple[int, int, int]]:
        """(first, end, place of the first at the last call): tiles one behind the other that were
        so then, with the same parts; -1: a tile by itself whose part is new."""
        runs: list[tuple[int, int, int]] = []
        for n, (key, part) in enumerate(zip(keys, parts, strict=True)):
            place, old = self._parts.get(key, (-1, part))
            same = part[0] is old[0] and part[POINTS] is old[POINTS] and part[PAIRS] is old[PAIRS]
            if not same:
                place = -1
            first, _, before = runs[-1] if runs else (0, 0, -1)
            if place >= 0 and before >= 0 and place - before == n - first:
                runs[-1] = (first, n + 1, before)
            else:
                runs.append((n, n + 1, place))
        return runs

    def _splice(
        self, column: int, parts: list[Part], runs: list[tuple[int, int, int]]
    ) -> NDArray[Any]:
        """A column of the new table, from that of the old one."""
        old, starts = self._whole[column], self._pair_starts if column == PAIRS else self._starts
        pieces = [old[:0]]
        for first, end, place in runs:
            if place < 0:
                pieces.append(parts[first][column])
            else:
                pieces.append(old[starts[place] : starts[place + end - first]])
        return np.concatenate(pieces)

    def _find_near(self, keys: NDArray[np.int64]) -> None:
        if not np.array_equal(keys, self._keys):
            self._keys, self._near = keys, np.searchsorted(keys, keys[:, None] + _STEPS)


def tabulate(tiles: dict[int, Tile]) -> Table:
    """The table of tiles, by key."""
    return Tabulator().tabulate(tiles)


def _part_of(tile: Tile) -> Part:
    return *tile.nodes, tile.occupation, tile.points, tile.total, tile.pairs


@kernel(allocates=False)
def _number(pairs, pair_starts, starts, near, edges):  # type: ignore[no-untyped-def]
    """The pairs of tiles, as `Tile.pairs`, by the numbers of their tile-planes: edges (E, 2). near
    (L, 27): places of the tiles round each."""
    for n in range(near.shape[0]):
        for e in range(pair_starts[n], pair_starts[n + 1]):
            other = near[n, (pairs[e] >> 16) & 0xFFFF]
            edges[e, 0] = starts[n] + (pairs[e] >> 32)
            edges[e, 1] = starts[other] + (pairs[e] & 0xFFFF)
