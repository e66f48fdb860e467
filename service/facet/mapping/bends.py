"""Planes that are none: strips too narrow to have a normal, and strips of something curved.

A curved wall, or a round column, comes as strips side by side, each turned against the next about
the line between them, and within each the members' normals turn on the same way. Whatever turns
goes to the remainder (design 3.4). Neither alone says so: at the edges of a narrow plane points of
the faces beyond turn the normals of its members as much, and the faces of a bay stand at an angle.

Nor is a strip a plane whose members lie along its two sides with nothing between: the rims of the
two faces of a free-standing wall.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from facet.mapping.blocks import unpack_all
from facet.mapping.claims import is_own
from facet.mapping.eigen import eigenvector, smallest
from facet.mapping.kernel import kernel
from facet.mapping.merging import Nodes
from facet.mapping.normals import UNIT, NormalField
from facet.mapping.patches import PatchField
from facet.mapping.planes import FREE
from facet.mapping.settings import STEPS, TILE, MapSettings
from facet.mapping.store import VoxelStore, centroid
from facet.mapping.table import Table
from facet.mapping.tiles import TileField

SUMS = 22  # n; sum x (3), xx (6); sum u (3), u x (9): x in 1/8 voxels, u normals times UNIT
UNKNOWN = -1
ACROSS = 5  # n; sum s, ss, sss, ssss: 1/8 voxels across a strip
STEADY = 0.4  # of the angle to the next strip: by so much at least the normals in a strip turn
DRAWN = 0.25  # likewise where the next one is bent
APART = 0.15  # chord of an angle: two strips that stand at a smaller one are one, split by noise
PARALLEL = 0.95  # cosine: of the line between two strips and the length of one
BESIDE = 0.3  # of the longer one's length: by so much at most two strips are shifted along it
ALIKE = 0.3  # of a strip's members: the next one has as many at least
FULL = 0.45  # voxels for each that a strip spans: something lies between its sides
EMPTY = 0.8  # bimodality across a strip: 1 of two lines, 0.56 where it is filled evenly
GAP_WIDTH = 4.0  # voxels: a narrower strip has no place for that


@kernel(allocates=False)
def _is_pure(normals, patches, row):  # type: ignore[no-untyped-def]
    """Whether a voxel has a normal that no other surface turned."""
    return patches.member[row] >= 0 and is_own(normals.border, patches.second, row)


@kernel
def _add_members(store, normals, patches, rows, plane_of, origin, sums):  # type: ignore[no-untyped-def]
    """Add pure members, rows (M,) of the tile-planes plane_of (M,), to the sums (K, SUMS) of
    these, about `origin` (K, 3), 1/8 voxels."""
    blocks, columns = store
    x = np.empty(3, np.int64)
    for m in range(rows.shape[0]):
        row, k = rows[m], plane_of[m]
        if not _is_pure(normals, patches, row):
            continue
        x[0], x[1], x[2] = centroid(blocks, columns, row)
        sums[k, 0] += 1
        s = 4
        for a in range(3):
            x[a] -= origin[k, a]
        for a in range(3):
            sums[k, 1 + a] += x[a]
            sums[k, 10 + a] += normals.unit[row, a]
            for b in range(a, 3):
                sums[k, s] += x[a] * x[b]
                s += 1
            for b in range(3):
                sums[k, 13 + 3 * a + b] += normals.unit[row, a] * x[b]


@kernel
def _pool(sums, corner, nodes, label, origin, out):  # type: ignore[no-untyped-def]
    """Add the sums (T, SUMS) of the tile-planes `nodes`, about their `corner` (T, 3), to those of
    their planes, out (K, SUMS), about `origin` (K, 3)."""
    d = np.empty(3, np.int64)
    for at in range(nodes.shape[0]):
        t = nodes[at]
        k, own = label[t], sums[t]
        n = own[0]
        out[k, 0] += n
        for a in range(3):
            d[a] = corner[t, a] - origin[k, a]
        s = 4
        for a in range(3):
            out[k, 1 + a] += own[1 + a] + n * d[a]
            out[k, 10 + a] += own[10 + a]
            for b in range(a, 3):
                out[k, s] += own[s] + d[a] * own[1 + b] + d[b] * own[1 + a] + n * d[a] * d[b]
                s += 1
            for b in range(3):
                out[k, 13 + 3 * a + b] += own[13 + 3 * a + b] + own[10 + a] * d[b]


@kernel(allocates=False)
def _copy_sums(old, old_starts, place, starts, sums):  # type: ignore[no-untyped-def]
    """The sums (T, SUMS) of tiles that lay at a place (L,) among the old ones; else UNKNOWN."""
    for n in range(place.shape[0]):
        for t in range(starts[n], starts[n + 1]):
            if place[n] == UNKNOWN:
                sums[t, 0] = UNKNOWN
                continue
            from_t = old_starts[place[n]] + t - starts[n]
            for s in range(SUMS):
                sums[t, s] = old[from_t, s]


@kernel(allocates=False)
def _add_places(store, patches, rows, plane_of, origin, across, sums):  # type: ignore[no-untyped-def]
    """Likewise add to sums (K, ACROSS) where members with a normal are across the strip."""
    blocks, columns = store
    for m in range(rows.shape[0]):
        row, k = rows[m], plane_of[m]
        if patches.member[row] < 0:
            continue
        x, y, z = centroid(blocks, columns, row)
        x, y, z = x - origin[k, 0], y - origin[k, 1], z - origin[k, 2]
        to = across[k]
        s = np.int64(np.floor(to[0] * x + to[1] * y + to[2] * z + 0.5))
        ss = s * s
        sums[k, 0] += 1
        sums[k, 1] += s
        sums[k, 2] += ss
        sums[k, 3] += ss * s
        sums[k, 4] += ss * ss


class Kept(NamedTuple):
    """Sums of tile-planes as they were in a table."""

    tile_keys: NDArray[np.int64]  # (L,)
    starts: NDArray[np.int64]  # (L + 1,)
    sums: NDArray[np.int64]  # (T, SUMS), UNKNOWN where nobody asked


class Spans(NamedTuple):
    """How far K planes reach."""

    width: NDArray[np.float64]  # (K,) voxels
    length: NDArray[np.float64]  # (K,) voxels
    across: NDArray[np.float64]  # (K, 3) unit, along the width
    along: NDArray[np.float64]  # (K, 3) unit, along the length


@kernel
def _spans(votes, scatter):  # type: ignore[no-untyped-def]
    """Spans of planes."""
    count = votes.shape[0]
    width, length = np.empty(count), np.empty(count)
    across, along = np.empty((count, 3)), np.empty((count, 3))
    for k in range(count):
        a, b, c, d, e, f = scatter[k]
        _, _, _, _, middle, largest = smallest(scatter[k])
        width[k] = np.sqrt(12.0 * max(0.0, middle) / votes[k])
        length[k] = np.sqrt(12.0 * max(0.0, largest) / votes[k])
        across[k, 0], across[k, 1], across[k, 2] = eigenvector(a, d, f, b, c, e, middle)
        along[k, 0], along[k, 1], along[k, 2] = eigenvector(a, d, f, b, c, e, largest)
    return Spans(width, length, across, along)


@kernel
def _turns(sums, least):  # type: ignore[no-untyped-def]
    """(K,) how much the normals of pure members turn over the width of a plane, radians, positive
    where it bulges; 0 where there are fewer than `least`."""
    out = np.zeros(sums.shape[0])
    mean, unit, xx = np.empty(3), np.empty(3), np.empty(6)
    for k in range(sums.shape[0]):
        own = sums[k]
        if own[0] < least:
            continue
        n = float(own[0])
        s = 0
        for a in range(3):
            mean[a], unit[a] = own[1 + a] / n, own[10 + a] / n / UNIT
        for a in range(3):
            for b in range(a, 3):
                xx[s] = own[4 + s] / n - mean[a] * mean[b]
                s += 1
        _, _, _, _, middle, _ = smallest(xx)
        if middle < 1.0:
            continue
        axis = eigenvector(xx[0], xx[3], xx[5], xx[1], xx[2], xx[4], middle)
        slope = 0.0
        for a in range(3):
            for b in range(3):
                ux = own[13 + 3 * a + b] / n / UNIT - unit[a] * mean[b]
                slope += axis[a] * ux * axis[b]
        out[k] = slope / middle * np.sqrt(12.0 * middle)
    return out


@kernel(allocates=False)
def _goes_on(nodes, spans, turn, p, q, share):  # type: ignore[no-untyped-def]
    """Whether a strip p, whose normals turn by `turn`, goes on in a strip q, turning by that share
    of the angle between them."""
    u, v, d, along = nodes.unit[p], nodes.unit[q], nodes.mean, spans.along[p]
    a = np.sqrt(u[0] * u[0] + u[1] * u[1] + u[2] * u[2])
    b = np.sqrt(v[0] * v[0] + v[1] * v[1] + v[2] * v[2])
    x, y, z = v[0] / b - u[0] / a, v[1] / b - u[1] / a, v[2] / b - u[2] / a
    i, j, k = u[1] * v[2] - u[2] * v[1], u[2] * v[0] - u[0] * v[2], u[0] * v[1] - u[1] * v[0]
    dx, dy, dz = d[q, 0] - d[p, 0], d[q, 1] - d[p, 1], d[q, 2] - d[p, 2]
    chord = np.sqrt(x * x + y * y + z * z)
    shifted = abs(dx * along[0] + dy * along[1] + dz * along[2])
    is_parallel = abs(i * along[0] + j * along[1] + k * along[2]) >= PARALLEL * np.sqrt(
        i * i + j * j + k * k
    )
    bulges = x * dx + y * dy + z * dz > 0.0
    return (
        nodes.votes[q] >= ALIKE * nodes.votes[p]
        and chord >= APART
        and is_parallel
        and shifted <= BESIDE * max(spans.length[p], spans.length[q])
        and (turn if bulges else -turn) >= share * chord
    )


@kernel
def _bent(pairs, nodes, spans, turns):  # type: ignore[no-untyped-def]
    """(K,) whether a strip goes on in one of those that it makes up pairs (E, 2) with, turning.
    Less of a turn is asked for beside one that is bent."""
    out = np.zeros(turns.shape[0], np.bool_)
    grows = True
    while grows:
        grows = False
        for e in range(pairs.shape[0]):
            for a in range(2):
                p, q = pairs[e, a], pairs[e, 1 - a]
                share = DRAWN if out[q] else STEADY
                if not out[p] and _goes_on(nodes, spans, turns[p], p, q, share):
                    out[p] = grows = True
    return out


def _bimodality(own: NDArray[np.int64]) -> float:
    """Sarle's coefficient across the strip: (skewness^2 + 1) / kurtosis."""
    n = float(own[0])
    s, ss, sss, ssss = own[1:5] / n
    m2 = float(ss - s * s)
    m3 = float(sss - 3.0 * s * ss + 2.0 * s**3)
    m4 = float(ssss - 4.0 * s * sss + 6.0 * s * s * ss - 3.0 * s**4)
    return (m3 * m3 + m2**3) / (m4 * m2) if m2 > 0.0 else 0.0


class Bends:
    """Judges planes by their members' normals."""

    def __init__(
        self,
        settings: MapSettings,
        store: VoxelStore,
        normals: NormalField,
        patches: PatchField,
        tiles: TileField,
    ) -> None:
        self._settings = settings
        self._store, self._normals, self._patches, self._tiles = store, normals, patches, tiles
        self._kept = Kept(
            np.zeros(0, np.int64), np.zeros(1, np.int64), np.zeros((0, SUMS), np.int64)
        )
        self._stirred: set[int] = set()
        self.bent = np.zeros(0, np.int64)  # (T,) bent strip of each tile-plane, FREE: none

    def forget(self, tiles: set[int]) -> None:
        """Members of these tiles, by their keys, or their normals, are not what they were."""
        self._stirred |= tiles

    def flat(
        self,
        table: Table,
        label: NDArray[np.int64],
        nodes: Nodes,
        occupation: NDArray[np.int64],
    ) -> NDArray[np.bool_]:
        """(K,) whether a plane is wide enough to be one and, if it is a strip, not bent.

        label: (T,) plane of each tile-plane of the table; nodes, occupation: of the K planes."""
        spans = _spans(nodes.votes, nodes.scatter)
        flat = spans.width >= self._settings.min_width
        strips = flat & (spans.width < self._settings.strip_width)
        origin = np.floor(nodes.mean * STEPS).astype(np.int64)
        pairs = _pairs(table.edges, label, strips)
        asked = np.zeros_like(strips)
        asked[pairs.ravel()] = True
        turns = _turns(self._sums(table, label, asked, origin), self._settings.n_min)
        flat &= ~_bent(pairs, nodes, spans, turns)
        numbers = np.full(len(flat) + 1, FREE)  # FREE finds the last one
        bent = np.flatnonzero(strips & ~flat)
        numbers[bent] = np.arange(len(bent))
        self.bent = numbers[label]
        hollow = occupation < FULL * spans.width * spans.length
        thin = strips & flat & (spans.width >= GAP_WIDTH) & hollow
        sums = np.zeros((len(flat), ACROSS), np.int64)
        own = _nodes_of(label, thin)
        rows, sizes = self._members(table, own)
        store, _, patches = self._voxels
        plane_of = np.repeat(label[own], sizes)
        _add_places(store, patches, rows, plane_of, origin, spans.across, sums)
        for plane in np.flatnonzero(thin).tolist():
            flat[plane] = _bimodality(sums[plane]) < EMPTY
        return np.asarray(flat)

    def _sums(
        self,
        table: Table,
        label: NDArray[np.int64],
        asked: NDArray[np.bool_],
        origin: NDArray[np.int64],
    ) -> NDArray[np.int64]:
        """(K, SUMS) of the pure members of the planes that are `asked` for (K,). What is known of
        tile-planes since an earlier update is not summed again."""
        corner = STEPS * TILE * unpack_all(table.tile_keys)[table.tile_of]
        kept = self._carry_over(table)
        nodes = _nodes_of(label, asked)
        new = nodes[kept.sums[nodes, 0] == UNKNOWN]
        rows, sizes = self._members(table, new)
        own = np.zeros((len(new), SUMS), np.int64)
        _add_members(*self._voxels, rows, np.repeat(np.arange(len(new)), sizes), corner[new], own)
        kept.sums[new] = own
        out = np.zeros((len(asked), SUMS), np.int64)
        _pool(kept.sums, corner, nodes, label, origin, out)
        return out

    def _carry_over(self, table: Table) -> Kept:
        """What is kept, in the order of a new table."""
        old, keys = self._kept, table.tile_keys
        kept = Kept(keys, table.starts, np.empty((len(table.total), SUMS), np.int64))
        stirred = np.isin(keys, np.fromiter(self._stirred, np.int64, len(self._stirred)))
        same = np.isin(keys, old.tile_keys) & ~stirred
        place = np.where(same, np.searchsorted(old.tile_keys, keys), UNKNOWN)
        _copy_sums(old.sums, old.starts, place, table.starts, kept.sums)
        self._kept = kept
        self._stirred.clear()
        return kept

    @property
    def _voxels(self) -> tuple[Any, ...]:
        """What is known of voxels, as the loops take it."""
        store = self._store.blocks, self._store.columns
        return store, self._normals.normals, self._patches.patches

    def _members(
        self, table: Table, nodes: NDArray[np.int64]
    ) -> tuple[NDArray[np.int32], list[int]]:
        """(M,) voxel rows of tile-planes, one after another, and how many each has."""
        at = table.tile_of[nodes]
        keys, numbers = table.tile_keys[at].tolist(), (nodes - table.starts[at]).tolist()
        own = [self._tiles.tiles[k].members_of(n) for k, n in zip(keys, numbers, strict=True)]
        return np.concatenate([np.zeros(0, np.int32), *own]), [len(rows) for rows in own]


def _nodes_of(label: NDArray[np.int64], asked: NDArray[np.bool_]) -> NDArray[np.int64]:
    """Tile-planes of the planes that are asked for (K,)."""
    held = np.flatnonzero(label >= 0)
    return held[asked[label[held]]]


@kernel
def _pairs(edges, label, asked):  # type: ignore[no-untyped-def]
    """(E, 2) planes that touch, of those that are asked for (K,): once for each edge (T, 2) of
    their tile-planes, label (T,)."""
    out, count = np.empty(edges.shape, np.int64), 0
    for e in range(edges.shape[0]):
        p, q = label[edges[e, 0]], label[edges[e, 1]]
        if p >= 0 and q >= 0 and p != q and asked[p] and asked[q]:
            out[count, 0], out[count, 1] = p, q
            count += 1
    return out[:count]
