"""Tile-planes: patches grown together inside tiles of 64^3 voxels, cached by tile.

A tile-plane is a pure function of its tile's patches and of the scene's tolerance. Voxels name
their tile-plane, never the plane, so a merge of planes relabels nothing.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from facet.mapping.blocks import CENTRE, pack, pack_all, unpack, unpack_all
from facet.mapping.kernel import kernel
from facet.mapping.membership import collect, inherit, shell, sum_points
from facet.mapping.memory import Heap, Memory
from facet.mapping.merging import Limits, Nodes, merge_nodes
from facet.mapping.normals import UNIT, Normals
from facet.mapping.patches import PER_BLOCK, PatchField
from facet.mapping.settings import BLOCK, STEPS
from facet.mapping.store import VoxelStore
from facet.mapping.sums import MOMENTS

SIDE = 8  # blocks per tile edge


@dataclass(slots=True)
class Tile:
    """One tile and its tile-planes (T of them), in canonical order."""

    key: int
    blocks: NDArray[np.int32]  # of the tile, by ascending block key
    nodes: Nodes  # (T, ...) voxels, about the map's origin
    points: NDArray[np.int64]  # (T, 10) exact moments of pure voxels' points, tile corner; pure:
    # near its tile-plane, not at a border, and claimed by no plane at an angle
    total: NDArray[np.int64]  # (T,) points of all their voxels
    occupation: NDArray[np.int64]  # (T,) voxels, leftovers included
    rows: NDArray[np.int32]  # (M,) voxel rows of its tile-planes
    owner: NDArray[np.int16]  # (M,) their tile-plane, ascending
    corner: NDArray[np.bool_]  # (M,) only a claim on a corner voxel that belongs elsewhere
    pairs: NDArray[np.int64] = field(default_factory=lambda: np.zeros((0, 3), np.int64))
    # pairs: (own tile-plane, key of the other tile, its tile-plane), adjacent
    ids: NDArray[np.int64] = field(default_factory=lambda: np.zeros(0, np.int64))
    heritage: NDArray[np.int64] = field(default_factory=lambda: np.zeros((0, 3), np.int64))
    # ids: (T,) at the last update; heritage: (plane id then, tile-plane now, voxels they share)
    named: bool = False  # the heritage is that of its ids

    @property
    def num_planes(self) -> int:
        return len(self.nodes.votes)

    def rows_of(self, plane: int) -> NDArray[np.int32]:
        """Voxel rows of one of its tile-planes, a view."""
        low, high = np.searchsorted(self.owner, [plane, plane + 1])
        return self.rows[low:high]


@kernel
def _tile_nodes(block_keys, neighbours, patches, which, tile_key):  # type: ignore[no-untyped-def]
    """Nodes and candidate edges of a tile's patches, in order of block key and patch index."""
    count = 0
    first = np.full(512, -1, np.int64)
    ti, tj, tk = unpack(tile_key)
    place = np.empty(which.shape[0], np.int64)
    for q in range(which.shape[0]):
        i, j, k = unpack(block_keys[which[q]])
        place[q] = (i - 8 * ti) + 8 * (j - 8 * tj) + 64 * (k - 8 * tk)
        first[place[q]] = count
        count += patches.number[which[q]]
    votes = np.empty(count)
    mean = np.empty((count, 3))
    scatter = np.empty((count, 6))
    unit = np.empty((count, 3))
    t = 0
    num_edges = 0
    edges = np.empty((max(64, 64 * count), 2), np.int64)
    for q in range(which.shape[0]):
        block = which[q]
        i, j, k = unpack(block_keys[block])
        corner = (BLOCK * i, BLOCK * j, BLOCK * k)
        for p in range(patches.number[block]):
            v = float(patches.votes[block, p])
            votes[t] = v
            c = patches.centroid[block, p]
            for a in range(3):
                mean[t, a] = corner[a] + c[a] / (STEPS * v)
                unit[t, a] = patches.unit[block, p, a] / float(UNIT)
            s = 0
            for a in range(3):
                for b in range(a, 3):
                    total = patches.scatter[block, p, s] - float(c[a]) * c[b] / v
                    scatter[t, s] = total / (STEPS * STEPS)
                    s += 1
            t += 1
        for n in range(CENTRE, 27):
            di, dj, dk = n % 3 - 1, (n // 3) % 3 - 1, n // 9 - 1
            x, y, z = i - 8 * ti + di, j - 8 * tj + dj, k - 8 * tk + dk
            if not (0 <= x < 8 and 0 <= y < 8 and 0 <= z < 8):
                continue
            other = block if n == CENTRE else neighbours[block, n]
            if other < 0:
                continue
            start = first[x + 8 * y + 64 * z]
            for p in range(patches.number[block]):
                for o in range(patches.number[other]):
                    if n == CENTRE and o <= p:
                        continue
                    if num_edges == edges.shape[0]:
                        wider = np.empty((2 * num_edges, 2), np.int64)
                        wider[:num_edges] = edges
                        edges = wider
                    edges[num_edges, 0] = first[place[q]] + p
                    edges[num_edges, 1] = start + o
                    num_edges += 1
    return votes, mean, scatter, unit, edges[:num_edges]


@kernel
def _pairs(blocks, patches, plane_of_patch, tile_key, which, out):  # type: ignore[no-untyped-def]
    """Adjacent tile-planes, the smaller tile first, as own << 32 | place of the other tile among
    the 27 << 16 | other; with repetitions. How many, or -1 where `out` is too short."""
    count = 0
    ti, tj, tk = unpack(tile_key)
    for q in range(which.shape[0]):
        block = which[q]
        i, j, k = unpack(blocks.keys[block])
        last = np.int64(-1)
        for n in range(27):
            other = block if n == CENTRE else blocks.neighbours[block, n]
            if other < 0 or patches.number[other] == 0:
                continue
            x, y, z = i + n % 3 - 1, j + (n // 3) % 3 - 1, k + n // 9 - 1
            other_key = pack(x >> 3, y >> 3, z >> 3)
            if other_key < tile_key:
                continue
            place = ((x >> 3) - ti + 1) + 3 * ((y >> 3) - tj + 1) + 9 * ((z >> 3) - tk + 1)
            for p in range(patches.number[block]):
                for o in range(patches.number[other]):
                    a = np.int64(plane_of_patch[block, p])
                    b = np.int64(plane_of_patch[other, o])
                    if other_key == tile_key and a >= b:
                        continue
                    pair = (a << 32) | (place << 16) | b
                    if pair == last:
                        continue
                    if count == out.shape[0]:
                        return -1
                    out[count] = pair
                    last = pair
                    count += 1
    return count


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
        summed: NDArray[np.int32],
        dirty: NDArray[np.int32],
    ) -> tuple[list[int], list[int]]:
        """Bring the tiles up to date. All arguments after `limits` are blocks: patches changed,
        labels changed, point moments changed, centroids changed.

        Returns tile keys: (tile-planes grown again, voxels of tile-planes changed)."""
        self._admit(store)
        keys = store.blocks.keys
        if limits != self._limits:
            self._limits = limits
            regroup = sorted(self._blocks)
        else:
            regroup = [int(k) for k in np.unique(tile_keys_of(keys[regrouped]))]
        for key in regroup:
            self._grow(store, patches, key, limits)
        moved = np.unique(np.concatenate([regrouped, relabelled, dirty]))
        stale = spread(np.array(regroup, np.int64), keys[moved])
        changed = [int(k) for k in stale if int(k) in self.tiles]
        for key in changed:
            self._fill(store, patches, self.tiles[key])
        for key in np.union1d(changed, spread(np.zeros(0, np.int64), keys[summed])).tolist():
            if key in self.tiles:
                self._sum(store, normals, patches, self.tiles[key])
        for key in self._beside(regroup):
            self._pair(store, patches, self.tiles[key])
        return regroup, changed

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

    def _grow(self, store: VoxelStore, patches: PatchField, key: int, limits: Limits) -> None:
        tile = self.tiles[key]
        votes, mean, scatter, unit, edges = _tile_nodes(
            store.blocks.keys, store.blocks.neighbours, patches.patches, tile.blocks, key
        )
        roots, merged = merge_nodes(Nodes(votes, mean, scatter, unit), edges, limits)
        kept, index = np.unique(roots, return_inverse=True)
        tile.nodes = Nodes(*(np.ascontiguousarray(c[kept]) for c in merged))
        counts = patches.patches.number[tile.blocks]
        where = np.arange(PER_BLOCK)[None, :] < counts[:, None]
        plane_of_patch = np.zeros((len(tile.blocks), PER_BLOCK), np.int16)
        plane_of_patch[where] = index
        self.plane_of_patch[tile.blocks] = plane_of_patch

    def _fill(self, store: VoxelStore, patches: PatchField, tile: Tile) -> None:
        near = np.empty(1000, np.int32)
        near = near[: shell(store.blocks.table_keys, store.blocks.table_values, tile.key, near)]
        most = 2 * int(np.bitwise_count(store.blocks.occupied[near]).sum())
        rows, owner = np.empty(most, np.int32), np.empty(most, np.int16)
        corner = np.empty(most, np.bool_)
        count = collect(
            store.blocks, patches.patches, self.plane_of_patch, tile.key, near, rows, owner, corner
        )
        if len(self._scratch) < len(store.columns.block):
            self._scratch = np.zeros(len(store.columns.block), np.int16)
        counts = np.zeros((len(tile.ids), tile.num_planes), np.int64)
        order = np.argsort(owner[:count], kind="stable")
        new = rows[order], owner[order], corner[order]
        inherit(tile.rows, tile.owner, tile.corner, *new, self._scratch, counts)
        old, own = np.nonzero(counts)
        tile.heritage = np.stack([tile.ids[old], own, counts[old, own]], axis=1)
        tile.rows, tile.owner, tile.corner = new
        tile.named = False
        tile.occupation = np.bincount(tile.owner[~tile.corner], minlength=tile.num_planes).astype(
            np.int64
        )

    def _sum(self, store: VoxelStore, normals: Normals, patches: PatchField, tile: Tile) -> None:
        tile.points = np.zeros((tile.num_planes, MOMENTS), np.int64)
        tile.total = np.zeros(tile.num_planes, np.int64)
        sum_points(
            tile.rows, tile.owner, tile.corner, tile.key, store.blocks, store.columns,
            normals.border, patches.patches.second, tile.nodes, tile.points, tile.total,
        )  # fmt: skip

    def _beside(self, keys: list[int]) -> list[int]:
        """The tiles and their 26 neighbours, as far as they exist, ascending."""
        near: set[int] = set()
        for key in keys:
            i, j, k = unpack(key)
            near.update(
                pack(i + n % 3 - 1, j + (n // 3) % 3 - 1, k + n // 9 - 1) for n in range(27)
            )
        return sorted(near & self.tiles.keys())

    def _pair(self, store: VoxelStore, patches: PatchField, tile: Tile) -> None:
        room = 4096
        while True:
            out = np.empty(room, np.int64)
            count = _pairs(
                store.blocks, patches.patches, self.plane_of_patch, tile.key, tile.blocks, out
            )
            if count >= 0:
                break
            room *= 4
        pairs = np.unique(out[:count])
        place = (pairs >> 16) & 0xFFFF
        offset = np.stack([place % 3, (place // 3) % 3, place // 9], axis=1) - 1
        other = pack_all(np.array(unpack(tile.key)) + offset)
        tile.pairs = np.stack([pairs >> 32, other, pairs & 0xFFFF], axis=1)


def _empty_tile(key: int, blocks: NDArray[np.int32]) -> Tile:
    nodes = Nodes(np.zeros(0), np.zeros((0, 3)), np.zeros((0, 6)), np.zeros((0, 3)))
    return Tile(
        key, blocks, nodes, np.zeros((0, MOMENTS), np.int64),
        np.zeros(0, np.int64), np.zeros(0, np.int64),
        np.zeros(0, np.int32), np.zeros(0, np.int16), np.zeros(0, np.bool_),
    )  # fmt: skip
