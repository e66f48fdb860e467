"""Patches grown together into the tile-planes of a tile, and which of these touch."""

from __future__ import annotations

import numpy as np
from numba import prange

from facet.mapping.blocks import CENTRE, pack, unpack
from facet.mapping.kernel import kernel
from facet.mapping.merging import Nodes, merge_all
from facet.mapping.normals import UNIT
from facet.mapping.settings import BLOCK, STEPS

LATELY = 4096


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
    edges = np.empty((max(64, 64 * count), 2), np.int32)
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
                        wider = np.empty((2 * num_edges, 2), np.int32)
                        wider[:num_edges] = edges
                        edges = wider
                    edges[num_edges, 0] = first[place[q]] + p
                    edges[num_edges, 1] = start + o
                    num_edges += 1
    return votes, mean, scatter, unit, edges[:num_edges]


@kernel
def _grow_tile(blocks, patches, which, tile_key, nodes, index, limit):  # type: ignore[no-untyped-def]
    """Merge the patches of a tile's blocks `which`. index (P,): the tile-plane of each patch; nodes
    (P, ...): statistics of the tile-planes. How many these are."""
    votes, mean, scatter, unit, edges = _tile_nodes(
        blocks.keys, blocks.neighbours, patches, which, tile_key
    )
    roots = merge_all(votes, mean, scatter, unit, edges, limit)
    number = np.empty(roots.shape[0], np.int64)
    count = 0
    for t in range(roots.shape[0]):
        if roots[t] == t:
            number[t] = count
            nodes.votes[count] = votes[t]
            nodes.mean[count], nodes.scatter[count] = mean[t], scatter[t]
            nodes.unit[count] = unit[t]
            count += 1
        index[t] = number[roots[t]]
    return count


@kernel(parallel=True)
def grow_tiles(blocks, patches, members, member_starts, tile_keys, first, nodes, index, limit):  # type: ignore[no-untyped-def]
    """`_grow_tile` for tiles: tile n's blocks begin at members[member_starts[n]], its patches at
    first[n]. Returns (N,) how many tile-planes each has."""
    counts = np.empty(tile_keys.shape[0], np.int64)
    for n in prange(tile_keys.shape[0]):
        low, high = first[n], first[n + 1]
        own = Nodes(
            nodes.votes[low:high], nodes.mean[low:high], nodes.scatter[low:high],
            nodes.unit[low:high],
        )  # fmt: skip
        which = members[member_starts[n] : member_starts[n + 1]]
        counts[n] = _grow_tile(blocks, patches, which, tile_keys[n], own, index[low:high], limit)
    return counts


@kernel
def _pairs(blocks, patches, plane_of_patch, tile_key, which, out):  # type: ignore[no-untyped-def]
    """Adjacent tile-planes, the smaller tile first, as own << 32 | place of the other tile among
    the 27 << 16 | other; with repetitions. How many, or -1 where `out` is too short."""
    count = 0
    lately = np.full(LATELY, -1, np.int64)  # found not long ago
    ti, tj, tk = unpack(tile_key)
    for q in range(which.shape[0]):
        block = which[q]
        i, j, k = unpack(blocks.keys[block])
        for n in range(27):
            other = block if n == CENTRE else blocks.neighbours[block, n]
            if other < 0 or patches.number[other] == 0:
                continue
            x, y, z = i + n % 3 - 1, j + (n // 3) % 3 - 1, k + n // 9 - 1
            other_key = pack(x >> 3, y >> 3, z >> 3)
            if other_key < tile_key or (other_key == tile_key and n < CENTRE):
                continue  # found from the other side
            place = ((x >> 3) - ti + 1) + 3 * ((y >> 3) - tj + 1) + 9 * ((z >> 3) - tk + 1)
            for p in range(patches.number[block]):
                for o in range(patches.number[other]):
                    a = np.int64(plane_of_patch[block, p])
                    b = np.int64(plane_of_patch[other, o])
                    if other_key == tile_key:
                        a, b = min(a, b), max(a, b)
                        if a == b:
                            continue
                    pair = (a << 32) | (place << 16) | b
                    slot = (31 * a + 7 * place + b) & (LATELY - 1)
                    if lately[slot] == pair:
                        continue
                    if count == out.shape[0]:
                        return -1
                    out[count] = lately[slot] = pair
                    count += 1
    return count


@kernel(parallel=True)
def pair_tiles(blocks, patches, plane_of_patch, members, member_starts, tile_keys, pairs, counts):  # type: ignore[no-untyped-def]
    """Adjacent tile-planes of tiles as `Tile.pairs`, into pairs (N, ROOM); counts (N,), -1 where
    the room is too short."""
    for n in prange(tile_keys.shape[0]):
        which = members[member_starts[n] : member_starts[n + 1]]
        found = np.empty(pairs.shape[1], np.int64)
        count = _pairs(blocks, patches, plane_of_patch, tile_keys[n], which, found)
        counts[n] = count
        if count > 0:
            own = np.unique(found[:count])
            counts[n] = own.shape[0]
            pairs[n, : own.shape[0]] = own
