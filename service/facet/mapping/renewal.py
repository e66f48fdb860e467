"""Bringing the members and points of tiles up to date."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from facet.mapping.membership import (
    SHELL,
    Held,
    Runs,
    find_shells,
    gather_members,
)
from facet.mapping.merging import Nodes
from facet.mapping.runs import deal, starts_of
from facet.mapping.store import Touched
from facet.mapping.sums import MOMENTS, SUMS
from facet.mapping.tally import Tally, catch_up, tally_points
from facet.mapping.tile import Tile

News = tuple[NDArray[np.uint32], NDArray[np.int64]]  # place (V,) of a voxel among the touched, plus
# 1, and what the sums of these were
_NOTHING = np.zeros((0, SUMS), np.int64)


class Renewal:
    """Renews tiles, and stamps the tile-planes that hold other voxels than before."""

    def __init__(self) -> None:
        self._stamp = 0
        self._news = np.zeros(0, np.uint32)  # (V,) place of a voxel among the touched, plus 1

    def renew(
        self,
        tiles: list[Tile],
        seen: list[Tile],
        into: dict[int, NDArray[np.int16]],
        changed: set[int],
        sources: tuple[Any, ...],
        patches: Any,
        plane_of_patch: NDArray[np.int16],
        flags: NDArray[np.uint8],
        touched: Touched,
    ) -> None:
        """Find the members of the tile-planes of tiles, what these inherit, and sum their points.

        seen: other tiles, where nothing but the points of their members can have changed; into: by
        tile key what its old tile-planes became, where they are new; changed: keys of those where
        voxels may be on other tile-planes; sources: (blocks, columns, border, second)."""
        news = self._tell(touched, len(sources[1].block))
        if touched.before is None:
            tiles, seen = sorted(tiles + seen, key=lambda tile: tile.key), []
        if seen:
            _catch_up(seen, sources, flags, news)
        if tiles:
            self._renew(
                tiles, into, changed, sources, patches, plane_of_patch, flags, news,
                touched.before is None,
            )  # fmt: skip
        self._news[touched.rows] = 0

    def _renew(
        self,
        tiles: list[Tile],
        into: dict[int, NDArray[np.int16]],
        changed: set[int],
        sources: tuple[Any, ...],
        patches: Any,
        plane_of_patch: NDArray[np.int16],
        flags: NDArray[np.uint8],
        news: News,
        anew: bool,
    ) -> None:
        blocks, columns = sources[:2]
        tile_keys = np.array([tile.key for tile in tiles], np.int64)
        became = [into[t.key] if t.key in into else _as_before(t) for t in tiles]
        old = [len(own) for own in became]
        new = [tile.num_planes for tile in tiles]
        num_counts = [a * b for a, b in zip(old, new, strict=True)]
        table = np.stack([starts_of(old), [*new, 0], starts_of(num_counts)], axis=1)
        counts = np.zeros(table[-1, 2], np.int64)
        all_into = np.concatenate(became)
        near, room = np.empty((len(tiles), SHELL), np.int32), np.empty(len(tiles), np.int64)
        members = np.concatenate([tile.blocks for tile in tiles])
        ends = starts_of([len(tile.blocks) for tile in tiles])
        find_shells(blocks, flags, tile_keys, members, ends, near, room)
        room += [len(tile.rows) for tile in tiles]
        before, held = _held(tiles), _room(room)
        parts = deal(starts_of(room))
        gather_members(
            blocks, columns.local, patches, plane_of_patch, flags, tile_keys, near, parts,
            before, all_into, table, counts, held,
        )  # fmt: skip
        was, tally = _tallied(tiles), _untallied(sum(new))
        nodes = Nodes(*(np.concatenate(c) for c in zip(*(t.nodes for t in tiles), strict=True)))
        same, origin = np.empty(sum(new), np.bool_), np.empty(sum(new), np.int64)
        spans = np.stack([starts_of(old), starts_of(new)], axis=1)
        tally_points(
            *sources, flags, nodes, tile_keys, parts, before, held, spans, all_into,
            *news, anew, was, tally, same, origin,
        )  # fmt: skip
        stamps = self._stamps(tiles, same, origin)
        starts = starts_of(new).tolist()
        for n, (tile, low, high) in enumerate(zip(tiles, starts, starts[1:], strict=False)):
            if tile.key in changed:
                own = counts[table[n, 2] : table[n + 1, 2]].reshape(old[n], new[n])
                _bequeath(tile, own)
            _give(tile, held, n, stamps, tally, slice(low, high))

    def _tell(self, touched: Touched, capacity: int) -> News:
        """Where the touched voxels are found among their sums before, and these."""
        if len(self._news) < capacity:
            self._news = np.zeros(capacity, np.uint32)
        if touched.before is None:
            return self._news, _NOTHING
        self._news[touched.rows] = np.arange(1, 1 + len(touched.rows))
        return self._news, touched.before

    def _stamps(
        self, tiles: list[Tile], same: NDArray[np.bool_], origin: NDArray[np.int64]
    ) -> NDArray[np.int64]:
        """(T,) stamps of tile-planes: new ones where they are not the `same` as at their origin."""
        stamps = np.arange(self._stamp, self._stamp + len(same))
        self._stamp += len(same)
        stamps[same] = np.concatenate([tile.stamps for tile in tiles])[origin[same]]
        return stamps


def _catch_up(tiles: list[Tile], sources: Any, flags: NDArray[np.uint8], news: News) -> None:
    """Add what came to the members of tiles."""
    tally, keys = _tallied(tiles), np.array([tile.key for tile in tiles], np.int64)
    starts = starts_of([tile.num_planes for tile in tiles])
    catch_up(*sources[:2], flags, keys, _held(tiles), starts, *news, tally)
    for tile, low, high in zip(tiles, starts.tolist(), starts[1:].tolist(), strict=False):
        tile.points, tile.total = tally.points[low:high].copy(), tally.total[low:high].copy()


def _as_before(tile: Tile) -> NDArray[np.int16]:
    return np.arange(tile.num_planes, dtype=np.int16)


def _held(tiles: list[Tile]) -> Held:
    """The members that tiles have."""
    runs = Runs(*(np.concatenate(c) for c in zip(*(tile.runs for tile in tiles), strict=True)))
    ends = starts_of([len(tile.runs.block) for tile in tiles])
    rows, state = (np.concatenate([getattr(t, name) for t in tiles]) for name in ("rows", "state"))
    return Held(
        rows, state, *runs, starts_of(runs.size), np.zeros(0, np.int64), ends[:-1], ends[1:]
    )


def _room(room: NDArray[np.int64]) -> Held:
    """Room for the members of tiles, as many as there can be (N,)."""
    ends = starts_of(room)
    size = int(ends[-1])
    return Held(
        np.empty(size, np.int32), np.empty(size, np.int8), np.empty(size, np.int32),
        np.empty(size, np.int16), np.empty(size, np.int16), np.empty(size, np.float32),
        np.empty(size, np.int64), np.empty(size, np.int64), ends[:-1].copy(), ends[1:].copy(),
    )  # fmt: skip


def _tallied(tiles: list[Tile]) -> Tally:
    """What is known of the tile-planes that tiles had."""
    return Tally(*(np.concatenate([getattr(t, name) for t in tiles]) for name in Tally._fields))


def _untallied(count: int) -> Tally:
    return Tally(
        np.zeros((count, MOMENTS), np.int64), np.zeros(count, np.int64), np.zeros(count, np.int64),
        np.empty((count, 5)), np.empty((count, 4)),
    )  # fmt: skip


def _bequeath(tile: Tile, counts: NDArray[np.int64]) -> None:
    """Note what the tile-planes of a tile inherit: voxels (O, T) that went from each to each."""
    old, own = np.nonzero(counts)
    tile.heritage = np.stack([tile.ids[old], own, counts[old, own]], axis=1)
    tile.named = False
    if not tile.num_planes:
        tile.ids = np.zeros(0, np.int64)  # nobody will name it


def _give(
    tile: Tile, held: Held, n: int, stamps: NDArray[np.int64], tally: Tally, own: slice
) -> None:
    """Give a tile what was found of it and of its `own` tile-planes."""
    first, last = int(held.first[n]), int(held.last[n])
    runs = slice(first, last)
    tile.runs = Runs(
        held.block[runs].copy(), held.plane[runs].copy(), held.size[runs].copy(),
        held.margin[runs].copy(),
    )  # fmt: skip
    end = first + int(tile.runs.size.sum())
    tile.rows, tile.state = held.rows[first:end].copy(), held.state[first:end].copy()
    tile.stamps, tile.points = stamps[own].copy(), tally.points[own].copy()
    tile.total, tile.occupation = tally.total[own].copy(), tally.occupation[own].copy()
    tile.facing, tile.planes = tally.facing[own].copy(), tally.planes[own].copy()
