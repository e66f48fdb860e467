"""Tile-planes: patches grown together inside tiles of 64^3 voxels, cached by tile.

A tile-plane is a pure function of its tile's patches and of the scene's tolerance. Voxels name
their tile-plane, never the plane, so a merge of planes relabels nothing.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from facet.mapping.blocks import pack, unpack
from facet.mapping.growth import grow_tiles, pair_tiles
from facet.mapping.kernel import kernel
from facet.mapping.membership import COLLECT, LOOK, MOVED, TOUCHED, follow_planes, list_abroad
from facet.mapping.memory import Heap, Memory
from facet.mapping.merging import Limits, Nodes
from facet.mapping.normals import Normals
from facet.mapping.patches import PatchField
from facet.mapping.renewal import Renewal
from facet.mapping.runs import starts_of
from facet.mapping.settings import PER_BLOCK
from facet.mapping.store import Touched, VoxelStore
from facet.mapping.tile import Tile, empty_tile

_NO_ROWS, _NO_KEYS = np.zeros(0, np.int32), np.zeros(0, np.int64)
NO_PLANE = -1  # where a block has no such patch


@kernel
def tile_keys_of(block_keys):  # type: ignore[no-untyped-def]
    """(B,) tile key of each block key."""
    out = np.empty(block_keys.shape[0], np.int64)
    for b in range(block_keys.shape[0]):
        i, j, k = unpack(block_keys[b])
        out[b] = pack(i >> 3, j >> 3, k >> 3)
    return out


@kernel(allocates=False)
def _tiles_near(block_keys, out):  # type: ignore[no-untyped-def]
    """Keys of tiles that hold one of the blocks (B,) or a 26-neighbour of one, again and again,
    into out (8 B,). How many."""
    count = 0
    for b in range(block_keys.shape[0]):
        i, j, k = unpack(block_keys[b])
        for x in range((i - 1) >> 3, ((i + 1) >> 3) + 1):  # a tile is 8 blocks wide
            for y in range((j - 1) >> 3, ((j + 1) >> 3) + 1):
                for z in range((k - 1) >> 3, ((k + 1) >> 3) + 1):
                    out[count] = pack(x, y, z)
                    count += 1
    return count


def spread(tile_keys: NDArray[np.int64], block_keys: NDArray[np.int64]) -> NDArray[np.int64]:
    """The tiles, and those that hold one of the blocks or a 26-neighbour of one, ascending."""
    near = np.empty(8 * len(block_keys), np.int64)
    return np.union1d(tile_keys, near[: _tiles_near(block_keys, near)])


class TileField:
    """All tiles, each regrouped only when a patch of it, or the tolerance, changed."""

    def __init__(self, memory: Memory | None = None) -> None:
        self._memory = memory or Heap()
        self.tiles: dict[int, Tile] = {}
        self.plane_of_patch = np.zeros((0, PER_BLOCK), np.int16)  # (B, 12) in its tile
        self._blocks: dict[int, list[int]] = {}
        self._num_blocks = 0
        self._limits: Limits | None = None
        self._renewal = Renewal()

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
        seen: NDArray[np.int32],
        touched: Touched,
    ) -> tuple[list[int], list[int], set[int]]:
        """Bring the tiles up to date. The arguments after `limits` are blocks: patches changed,
        labels changed, normals or centroids changed, centroids changed, sums of points changed;
        and voxels whose sums did.

        Returns tile keys: (tile-planes grown again, voxels of tile-planes changed, these or their
        normals changed)."""
        self._admit(store)
        keys = store.blocks.keys
        if limits != self._limits:
            self._limits = limits
            regroup = sorted(self._blocks)
        else:
            regroup = [int(k) for k in np.unique(tile_keys_of(keys[regrouped]))]
        flags = _flag(store, relabelled, turned, moved, seen)
        into, replaced = self._grow(store, patches, regroup, limits, flags)
        others = np.unique(np.concatenate([regrouped, relabelled, moved]))
        changed = sorted(self._near(keys[others], np.array(regroup, np.int64)))
        near = self._near(keys[seen])
        stirred = {*changed, *self._near(keys[turned])}
        renewed, only_seen = ([self.tiles[k] for k in sorted(t)] for t in (stirred, near - stirred))
        sources = store.blocks, store.columns, normals.border, patches.patches.second
        self._renewal.renew(
            renewed, only_seen, into, set(changed), sources, patches.patches, self.plane_of_patch,
            flags, touched,
        )  # fmt: skip
        self._pair(store, patches, sorted(self._near(keys[replaced])))
        return regroup, changed, stirred

    def name(
        self, tile_keys: NDArray[np.int64], starts: NDArray[np.int64], ids: NDArray[np.int64]
    ) -> list[int]:
        """Tell the tiles the plane ids (T,) of their tile-planes. Returns the tiles where they
        changed."""
        tiles = [self.tiles[key] for key in tile_keys.tolist()]
        counts = np.diff(starts).tolist()
        alike = [len(tile.ids) == count for tile, count in zip(tiles, counts, strict=True)]
        none = np.full(max(counts, default=0), NO_PLANE)
        before = [t.ids if a else none[:c] for t, a, c in zip(tiles, alike, counts, strict=True)]
        differs = np.concatenate([none[:0], *before]) != ids
        renamed = np.logical_or.reduceat(differs, starts[:-1]) if tiles else differs
        named = np.array([tile.named for tile in tiles], np.bool_)
        for index in np.flatnonzero(renamed | ~named).tolist():
            tile, own = tiles[index], ids[starts[index] : starts[index + 1]]
            tile.ids, tile.named = own.copy(), True
            tile.heritage = np.stack([own, np.arange(len(own)), tile.occupation], axis=1)
        return [int(key) for key in tile_keys[renamed]]

    def renamed_abroad(self, store: VoxelStore, keys: set[int]) -> set[int]:
        """The tiles that hold voxels of these, whose voxels or plane ids changed, beyond them: as
        far as they go by other ids now."""
        lie_in = []
        for key in sorted(keys):
            tile = self.tiles[key]
            out = np.empty(len(tile.rows), np.int64)
            count = list_abroad(store.blocks, key, tile.rows, tile.state, tile.runs, tile.ids, out)
            if not np.array_equal(out[:count], tile.abroad):
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
                self.tiles[key] = empty_tile(key, members)
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
        self,
        store: VoxelStore,
        patches: PatchField,
        keys: list[int],
        limits: Limits,
        flags: NDArray[np.uint8],
    ) -> tuple[dict[int, NDArray[np.int16]], NDArray[np.int32]]:
        """Merge the patches of tiles into tile-planes. Flags blocks whose voxels may be on others.

        Returns by tile what its old tile-planes became (O,), and the blocks whose patches are on
        other ones."""
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
        old = starts_of([self.tiles[key].num_planes for key in keys])
        for key, start, count in zip(keys, first.tolist(), counts.tolist(), strict=False):
            self.tiles[key].nodes = Nodes(*(c[start : start + count].copy() for c in nodes))
        before = self.plane_of_patch[members]
        plane_of_patch = np.full((len(members), PER_BLOCK), NO_PLANE, np.int16)
        plane_of_patch[np.arange(PER_BLOCK)[None, :] < number[:, None]] = index
        self.plane_of_patch[members] = plane_of_patch
        into = np.empty(old[-1], np.int16)
        follow_planes(
            store.blocks, patches.patches, self.plane_of_patch, before, members, member_starts,
            old, counts, into, flags,
        )  # fmt: skip
        became = dict(zip(keys, np.split(into, old[1:-1]), strict=True)) if keys else {}
        return became, members[np.any(before != plane_of_patch, axis=1)]

    def _pair(self, store: VoxelStore, patches: PatchField, keys: list[int]) -> None:
        """Find which tile-planes of tiles touch others."""
        members, member_starts = self._members(keys)
        tile_keys, counts = np.array(keys, np.int64), np.empty(len(keys), np.int64)
        room = 1 << 14
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


def _flag(
    store: VoxelStore,
    relabelled: NDArray[np.int32],
    turned: NDArray[np.int32],
    moved: NDArray[np.int32],
    seen: NDArray[np.int32],
) -> NDArray[np.uint8]:
    """(B,) what changed in blocks."""
    flags = np.zeros(len(store.blocks.keys), np.uint8)
    flags[seen] |= TOUCHED
    flags[turned] |= LOOK
    flags[relabelled] |= COLLECT | LOOK
    flags[moved] |= LOOK | MOVED
    return flags
