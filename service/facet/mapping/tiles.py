"""Tile-planes: patches grown together inside tiles of 64^3 voxels, cached by tile.

A tile-plane is a pure function of its tile's patches and of the scene's tolerance. Voxels name
their tile-plane, never the plane, so a merge of planes relabels nothing.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from facet.mapping.blocks import pack, pack_all, unpack, unpack_all
from facet.mapping.growth import grow_tiles, pair_tiles
from facet.mapping.kernel import kernel
from facet.mapping.membership import (
    SHELL,
    add_changes,
    collect_members,
    find_shells,
    inherit,
    list_abroad,
    sum_points,
)
from facet.mapping.memory import Heap, Memory
from facet.mapping.merging import Limits, Nodes
from facet.mapping.normals import Normals
from facet.mapping.patches import PER_BLOCK, PatchField
from facet.mapping.runs import deal, starts_of
from facet.mapping.store import Touched, VoxelStore
from facet.mapping.sums import MOMENTS

_NO_ROWS, _NO_KEYS = np.zeros(0, np.int32), np.zeros(0, np.int64)
_STEPS = np.array([pack(n % 3, n // 3 % 3, n // 9) for n in range(27)], np.int64)
_STEPS -= pack(1, 1, 1)  # from a tile's key to those round it


@dataclass(slots=True)
class Tile:
    """One tile and its tile-planes (T of them), in canonical order."""

    key: int
    blocks: NDArray[np.int32]  # of the tile, by ascending block key
    nodes: Nodes  # (T, ...) voxels, about the map's origin
    points: NDArray[np.int64]  # (T, 10) exact moments of pure voxels' points, tile corner; pure:
    # near its tile-plane, not at a border, and claimed by no plane at an angle
    total: NDArray[np.int64]  # (T,) points of all their voxels
    planes: NDArray[
        np.float64
    ]  # (T, 4) what their voxels are near: unit normal, offset, tile corner
    occupation: NDArray[np.int64]  # (T,) voxels, leftovers included
    rows: NDArray[np.int32]  # (M,) voxel rows of its tile-planes, one after another
    corner: NDArray[np.bool_]  # (M,) only a claim on a corner voxel that belongs elsewhere
    starts: NDArray[np.int64]  # (T + 1,) where the rows of each tile-plane begin
    pairs: NDArray[np.int64] = field(default_factory=lambda: np.zeros(0, np.int64))
    # pairs: adjacent tile-planes, own << 32 | place of the other tile among the 27 << 16 | other
    ids: NDArray[np.int64] = field(default_factory=lambda: np.zeros(0, np.int64))
    heritage: NDArray[np.int64] = field(default_factory=lambda: np.zeros((0, 3), np.int64))
    # ids: (T,) at the last update; heritage: (plane id then, tile-plane now, voxels they share)
    named: bool = False  # the heritage is that of its ids
    abroad: NDArray[np.int64] = field(default_factory=lambda: np.zeros(0, np.int64))
    # abroad: voxels that lie in other tiles, as row << 32 | plane id, at the last update

    @property
    def num_planes(self) -> int:
        return len(self.nodes.votes)

    def rows_of(self, plane: int) -> NDArray[np.int32]:
        """Voxel rows of one of its tile-planes, a view."""
        return self.rows[self.starts[plane] : self.starts[plane + 1]]

    def members_of(self, plane: int) -> NDArray[np.int32]:
        """Those of them that belong to no other, a copy."""
        part = slice(self.starts[plane], self.starts[plane + 1])
        return self.rows[part][~self.corner[part]]

    @property
    def owner(self) -> NDArray[np.int64]:
        """(M,) tile-plane of each row."""
        return np.repeat(np.arange(self.num_planes), np.diff(self.starts))


@kernel
def tile_keys_of(block_keys):  # type: ignore[no-untyped-def]
    """(B,) tile key of each block key."""
    out = np.empty(block_keys.shape[0], np.int64)
    for b in range(block_keys.shape[0]):
        i, j, k = unpack(block_keys[b])
        out[b] = pack(i >> 3, j >> 3, k >> 3)
    return out


def spread(tile_keys: NDArray[np.int64], block_keys: NDArray[np.int64]) -> NDArray[np.int64]:
    """Tiles that hold one of the blocks or a 26-neighbour of one, ascending."""
    if not len(block_keys):
        return tile_keys
    ijk = unpack_all(block_keys)
    corners = np.stack(np.meshgrid(*[[-1, 1]] * 3, indexing="ij"), -1).reshape(-1, 3)
    near = pack_all((ijk[:, None, :] + corners).reshape(-1, 3) >> 3)  # a tile is 8 blocks wide
    return np.union1d(tile_keys, near)


class TileField:
    """All tiles, each regrouped only when a patch of it, or the tolerance, changed."""

    def __init__(self, memory: Memory | None = None) -> None:
        self._memory = memory or Heap()
        self.tiles: dict[int, Tile] = {}
        self.plane_of_patch = np.zeros((0, PER_BLOCK), np.int16)  # (B, 12) tile-plane in its tile
        self._blocks: dict[int, list[int]] = {}
        self._num_blocks = 0
        self._limits: Limits | None = None
        self._scratch = np.zeros(0, np.int16)

    def update(
        self,
        store: VoxelStore,
        normals: Normals,
        patches: PatchField,
        limits: Limits,
        regrouped: NDArray[np.int32],
        relabelled: NDArray[np.int32],
        turned: NDArray[np.int32],
        moved: NDArray[np.int32],
        touched: Touched,
    ) -> tuple[list[int], list[int], set[int]]:
        """Bring the tiles up to date. The arguments after `limits` are blocks: patches changed,
        labels changed, normals or centroids changed, centroids changed; and voxels.

        Returns tile keys: (tile-planes grown again, voxels of tile-planes changed, these or their
        normals changed)."""
        self._admit(store)
        keys = store.blocks.keys
        if limits != self._limits:
            self._limits = limits
            regroup = sorted(self._blocks)
        else:
            regroup = [int(k) for k in np.unique(tile_keys_of(keys[regrouped]))]
        self._grow(store, patches, regroup, limits)
        others = np.unique(np.concatenate([regrouped, relabelled, moved]))
        changed = sorted(self._near(keys[others], np.array(regroup, np.int64)))
        self._fill(store, patches, changed)
        near = self._near(keys[np.unique(store.columns.block[touched.rows])])
        stirred = {*changed, *self._near(keys[turned])}
        anew = stirred | near if touched.before is None else stirred
        self._sum(store, normals, patches, sorted(anew))
        self._add(store, normals, patches, sorted(near - anew), touched)
        self._pair(store, patches, self._beside(regroup))
        return regroup, changed, stirred

    def name(
        self, tile_keys: NDArray[np.int64], starts: NDArray[np.int64], ids: NDArray[np.int64]
    ) -> list[int]:
        """Tell the tiles the plane ids (T,) of their tile-planes. Returns the tiles where they
        changed."""
        renamed = []
        for index, key in enumerate(tile_keys.tolist()):
            tile = self.tiles[key]
            own = ids[starts[index] : starts[index + 1]]
            same = np.array_equal(own, tile.ids)
            if same and tile.named:
                continue
            if not same:
                renamed.append(key)
            tile.ids, tile.named = own.copy(), True
            tile.heritage = np.stack([own, np.arange(len(own)), tile.occupation], axis=1)
        return renamed

    def renamed_abroad(self, store: VoxelStore, keys: set[int]) -> set[int]:
        """The tiles that hold voxels of these, whose voxels or plane ids changed, beyond them: as
        far as they go by other ids now."""
        lie_in = []
        for key in sorted(keys):
            tile = self.tiles[key]
            out = np.empty(len(tile.rows), np.int64)
            count = list_abroad(
                store.blocks, store.columns.block, key, tile.rows, tile.corner, tile.starts,
                tile.ids, out,
            )  # fmt: skip
            lie_in.append(np.setxor1d(out[:count], tile.abroad, assume_unique=True) >> 32)
            tile.abroad = out[:count].copy()
        rows = np.concatenate([np.zeros(0, np.int64), *lie_in])
        return set(tile_keys_of(store.blocks.keys[store.columns.block[rows]]).tolist())

    def _admit(self, store: VoxelStore) -> None:
        """Give new blocks to their tiles."""
        count = store.num_blocks
        if len(self.plane_of_patch) < count:
            self.plane_of_patch = self._memory.grown(
                self.plane_of_patch, self._num_blocks, len(store.blocks.keys)
            )
        new = np.arange(self._num_blocks, count)
        for block, key in zip(new, tile_keys_of(store.blocks.keys[new]), strict=True):
            self._blocks.setdefault(int(key), []).append(int(block))
        for key in {int(k) for k in tile_keys_of(store.blocks.keys[new])}:
            members = np.array(self._blocks[key], np.int32)
            members = members[np.argsort(store.blocks.keys[members])]
            self._blocks[key] = members.tolist()
            if key in self.tiles:
                self.tiles[key].blocks = members
            else:
                self.tiles[key] = _empty_tile(key, members)
        self._num_blocks = count

    def _near(
        self, block_keys: NDArray[np.int64], tile_keys: NDArray[np.int64] = _NO_KEYS
    ) -> set[int]:
        """The tiles, and those that hold one of the blocks or a neighbour of one."""
        return self.tiles.keys() & set(spread(tile_keys, block_keys).tolist())

    def _members(self, keys: list[int]) -> tuple[NDArray[np.int32], NDArray[np.int64]]:
        """Blocks of tiles, one tile after another, and where each begins (N + 1,)."""
        own = [self.tiles[key].blocks for key in keys]
        return np.concatenate([_NO_ROWS, *own]), starts_of([len(blocks) for blocks in own])

    def _grow(
        self, store: VoxelStore, patches: PatchField, keys: list[int], limits: Limits
    ) -> None:
        """Merge the patches of tiles into tile-planes."""
        members, member_starts = self._members(keys)
        number = patches.patches.number[members].astype(np.int64)
        first = starts_of(number)[member_starts]
        size = int(first[-1])
        nodes = Nodes(np.empty(size), np.empty((size, 3)), np.empty((size, 6)), np.empty((size, 3)))
        index = np.empty(size, np.int16)
        counts = grow_tiles(
            store.blocks, patches.patches, members, member_starts, np.array(keys, np.int64),
            first, nodes, index, limits,
        )  # fmt: skip
        for key, start, count in zip(keys, first.tolist(), counts.tolist(), strict=False):
            self.tiles[key].nodes = Nodes(*(c[start : start + count].copy() for c in nodes))
        plane_of_patch = np.zeros((len(members), PER_BLOCK), np.int16)
        plane_of_patch[np.arange(PER_BLOCK)[None, :] < number[:, None]] = index
        self.plane_of_patch[members] = plane_of_patch

    def _fill(self, store: VoxelStore, patches: PatchField, keys: list[int]) -> None:
        """Find the members of the tile-planes of tiles, and what these inherit."""
        tile_keys = np.array(keys, np.int64)
        near, num_near = np.empty((len(keys), SHELL), np.int32), np.empty(len(keys), np.int64)
        room = np.empty(len(keys), np.int64)
        find_shells(store.blocks, tile_keys, near, num_near, room)
        first = starts_of(room)
        rows, corner = np.empty(first[-1], np.int32), np.empty(first[-1], np.bool_)
        most = max((self.tiles[key].num_planes for key in keys), default=0)
        starts = np.empty((len(keys), most + 1), np.int64)
        collect_members(
            store.blocks, patches.patches, self.plane_of_patch, tile_keys, near, num_near, first,
            starts, rows, corner,
        )  # fmt: skip
        for key, start, own in zip(keys, first.tolist(), starts, strict=False):
            tile = self.tiles[key]
            own = own[: tile.num_planes + 1].copy()
            part = slice(start, start + int(own[-1]))
            self._take_over(store, tile, rows[part].copy(), corner[part].copy(), own)

    def _take_over(
        self,
        store: VoxelStore,
        tile: Tile,
        rows: NDArray[np.int32],
        corner: NDArray[np.bool_],
        starts: NDArray[np.int64],
    ) -> None:
        """Give a tile its new members."""
        if len(self._scratch) < len(store.columns.block):
            self._scratch = np.zeros(len(store.columns.block), np.int16)
        counts = np.zeros((len(tile.ids), tile.num_planes), np.int64)
        new = rows, corner, starts
        inherit((tile.rows, tile.corner, tile.starts), new, self._scratch, counts)
        old, own = np.nonzero(counts)
        tile.heritage = np.stack([tile.ids[old], own, counts[old, own]], axis=1)
        tile.rows, tile.corner, tile.starts = new
        tile.named = False
        if not tile.num_planes:
            tile.ids = _NO_KEYS  # nobody will name it
        claims = starts_of(corner)
        tile.occupation = np.diff(starts - claims[starts])

    def _sum(
        self, store: VoxelStore, normals: Normals, patches: PatchField, keys: list[int]
    ) -> None:
        """Sum the points of the tile-planes of tiles."""
        tiles = [self.tiles[key] for key in keys]
        if not tiles:
            return
        tile_keys = _tile_keys(tiles)
        nodes = Nodes(*(np.concatenate(c) for c in zip(*(t.nodes for t in tiles), strict=True)))
        starts = starts_of(np.concatenate([np.diff(tile.starts) for tile in tiles]))
        points, total = (
            np.empty((len(tile_keys), MOMENTS), np.int64),
            np.empty(len(tile_keys), np.int64),
        )
        planes = np.empty((len(points), 4))
        sum_points(
            np.concatenate([tile.rows for tile in tiles]),
            np.concatenate([tile.corner for tile in tiles]),
            starts, tile_keys, deal(starts), store.blocks, store.columns, normals.border,
            patches.patches.second, nodes, planes, points, total,
        )  # fmt: skip
        _hand_out(tiles, points, total, planes)

    def _add(
        self,
        store: VoxelStore,
        normals: Normals,
        patches: PatchField,
        keys: list[int],
        touched: Touched,
    ) -> None:
        """Add what came to the voxels of tiles where nothing else changed."""
        tiles = [self.tiles[key] for key in keys]
        if not tiles:
            return
        tile_keys = _tile_keys(tiles)
        first = np.full(store.num_blocks, -1, np.int32)
        for tile, start in zip(tiles, np.searchsorted(tile_keys, keys).tolist(), strict=True):
            first[tile.blocks] = start
        points = np.concatenate([tile.points for tile in tiles])
        total = np.concatenate([tile.total for tile in tiles])
        planes = np.concatenate([tile.planes for tile in tiles])
        add_changes(
            touched.rows, touched.before, first, store.blocks, store.columns, normals.border,
            patches.patches, self.plane_of_patch, tile_keys,
            planes, points, total,
        )  # fmt: skip
        _hand_out(tiles, points, total, planes)

    def _beside(self, keys: list[int]) -> list[int]:
        """The tiles and their 26 neighbours, as far as they exist, ascending."""
        near: set[int] = set()
        for key in keys:
            i, j, k = unpack(key)
            near.update(
                pack(i + n % 3 - 1, j + (n // 3) % 3 - 1, k + n // 9 - 1) for n in range(27)
            )
        return sorted(near & self.tiles.keys())

    def _pair(self, store: VoxelStore, patches: PatchField, keys: list[int]) -> None:
        """Find which tile-planes of tiles touch others."""
        members, member_starts = self._members(keys)
        tile_keys, counts = np.array(keys, np.int64), np.empty(len(keys), np.int64)
        room = 4096
        while True:
            pairs = np.empty((len(keys), room), np.int64)
            pair_tiles(
                store.blocks, patches.patches, self.plane_of_patch, members, member_starts,
                tile_keys, pairs, counts,
            )  # fmt: skip
            if not (counts < 0).any():
                break
            room *= 4
        for key, own, count in zip(keys, pairs, counts.tolist(), strict=True):
            self.tiles[key].pairs = own[:count].copy()


def edges_of(tiles: list[Tile], starts: NDArray[np.int64]) -> NDArray[np.int64]:
    """(E, 2) the adjacent tile-planes of all tiles, by ascending key, when those of tile n are
    numbered from starts[n] on."""
    keys = np.array([tile.key for tile in tiles], np.int64)
    near = np.searchsorted(keys, keys[:, None] + _STEPS)  # (N, 27) places of the tiles round each
    pairs = np.concatenate([tile.pairs for tile in tiles])
    own = np.repeat(np.arange(len(tiles)), [len(tile.pairs) for tile in tiles])
    other = near[own, (pairs >> 16) & 0xFFFF]
    return np.stack([starts[own] + (pairs >> 32), starts[other] + (pairs & 0xFFFF)], axis=1)


def _tile_keys(tiles: list[Tile]) -> NDArray[np.int64]:
    """(T,) keys of the tiles of tile-planes, one tile after another."""
    keys = np.array([tile.key for tile in tiles], np.int64)
    return np.repeat(keys, [tile.num_planes for tile in tiles])


def _hand_out(
    tiles: list[Tile],
    points: NDArray[np.int64],
    total: NDArray[np.int64],
    planes: NDArray[np.float64],
) -> None:
    """Give tiles the sums of their tile-planes, and what these are near."""
    starts = starts_of([tile.num_planes for tile in tiles]).tolist()
    for tile, low, high in zip(tiles, starts, starts[1:], strict=False):
        tile.points, tile.total = points[low:high].copy(), total[low:high].copy()
        tile.planes = planes[low:high].copy()


def _empty_tile(key: int, blocks: NDArray[np.int32]) -> Tile:
    nodes = Nodes(np.zeros(0), np.zeros((0, 3)), np.zeros((0, 6)), np.zeros((0, 3)))
    return Tile(
        key, blocks, nodes, np.zeros((0, MOMENTS), np.int64), np.zeros(0, np.int64),
        np.zeros((0, 4)), np.zeros(0, np.int64),
        np.zeros(0, np.int32), np.zeros(0, np.bool_), np.zeros(1, np.int64),
    )  # fmt: skip
