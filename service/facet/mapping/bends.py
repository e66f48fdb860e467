"""Planes that are none: strips too narrow to have a normal, and strips of something curved.

On a plane the members' normals do not depend on where they are; along a curved wall, or over a
bevelled edge, they turn steadily. Whatever turns goes to the remainder (design 3.4). At the edges
of a narrow plane points of the faces beyond turn the normals as well, mostly so that it seems to
bulge; so where a narrow strip has members enough they are asked whether they lie on an arc, too.

Nor is a strip a plane whose members lie along its two sides with nothing between: the rims of the
two faces of a free-standing wall.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from facet.mapping.blocks import unpack_all
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
ARC = 9  # n; sum s, ss, sss, ssss, h, hh, hs, hss: 1/8 voxels across, 1/64 voxels off the plane
ARC_WIDTH = 10.0  # voxels: a narrower strip
ARC_VOTES = 200  # of so many members at least is bent where its normals turn so that it
HOLLOWED_DEG = 10.5  # is hollow by this,
ASKED_DEG = 8.5  # or by this, or bulges by `bend_deg`, and they lie on an arc
ARC_DEG = 5.0  # that turns by this the same way
ARC_SIGMAS = 3.5  # surely
FULL = 0.45  # voxels for each that a strip spans: something lies between its sides
EMPTY = 0.8  # bimodality across a strip: 1 of two lines, 0.56 where it is filled evenly
GAP_WIDTH = 4.0  # voxels: a narrower strip has no place for that


@kernel(allocates=False)
def _is_pure(normals, patches, row):  # type: ignore[no-untyped-def]
    """Whether a voxel has a normal that no other surface turned."""
    return patches.member[row] >= 0 and not normals.border[row] and patches.second[row] < 0


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
def _add_heights(store, normals, patches, rows, plane_of, origin, axes, pure, sums):  # type: ignore[no-untyped-def]
    """Likewise add to sums (K, ARC) where members are across the strip, and how far off its plane.
    axes: (K, 6) unit vectors across it and along its normal; pure: (K,) of pure members alone."""
    blocks, columns = store
    for m in range(rows.shape[0]):
        row, k = rows[m], plane_of[m]
        if patches.member[row] < 0 or (pure[k] and not _is_pure(normals, patches, row)):
            continue
        x, y, z = centroid(blocks, columns, row)
        x, y, z = x - origin[k, 0], y - origin[k, 1], z - origin[k, 2]
        u = axes[k]
        s = np.int64(np.floor(u[0] * x + u[1] * y + u[2] * z + 0.5))
        h = np.int64(np.floor(8.0 * (u[3] * x + u[4] * y + u[5] * z) + 0.5))
        ss = s * s
        sums[k, 0] += 1
        sums[k, 1] += s
        sums[k, 2] += ss
        sums[k, 3] += ss * s
        sums[k, 4] += ss * ss
        sums[k, 5] += h
        sums[k, 6] += h * h
        sums[k, 7] += h * s
        sums[k, 8] += h * ss


class Kept(NamedTuple):
    """Sums of tile-planes as they were in a table."""

    tile_keys: NDArray[np.int64]  # (L,)
    starts: NDArray[np.int64]  # (L + 1,)
    sums: NDArray[np.int64]  # (T, SUMS), UNKNOWN where nobody asked


@kernel
def _spans(votes, scatter):  # type: ignore[no-untyped-def]
    """(K, 2) width and length of planes, voxels."""
    out = np.empty((votes.shape[0], 2))
    for k in range(votes.shape[0]):
        _, _, _, _, middle, largest = smallest(scatter[k])
        out[k, 0] = np.sqrt(12.0 * max(0.0, middle) / votes[k])
        out[k, 1] = np.sqrt(12.0 * max(0.0, largest) / votes[k])
    return out


@kernel
def _turns(sums):  # type: ignore[no-untyped-def]
    """(K, 2, 8) how much the members' normals turn over the width of a plane, and over its length:
    the angle, radians, positive where it bulges, the width, voxels, that direction and the plane's
    normal; all 0 where there is none."""
    out = np.zeros((sums.shape[0], 2, 8))
    mean, unit, xx, normal = np.empty(3), np.empty(3), np.empty(6), np.empty(3)
    for k in range(sums.shape[0]):
        own = sums[k]
        if own[0] == 0:
            continue
        n = float(own[0])
        s = 0
        for a in range(3):
            mean[a], unit[a] = own[1 + a] / n, own[10 + a] / n / UNIT
        for a in range(3):
            for b in range(a, 3):
                xx[s] = own[4 + s] / n - mean[a] * mean[b]
                s += 1
        _, normal[0], normal[1], normal[2], middle, largest = smallest(xx)
        side = normal[0] * unit[0] + normal[1] * unit[1] + normal[2] * unit[2]
        for way in range(2):
            variance = largest if way else middle
            if variance < 1.0:
                continue
            axis = eigenvector(xx[0], xx[3], xx[5], xx[1], xx[2], xx[4], variance)
            slope = 0.0
            for a in range(3):
                for b in range(3):
                    ux = own[13 + 3 * a + b] / n / UNIT - unit[a] * mean[b]
                    slope += axis[a] * ux * axis[b]
                out[k, way, 2 + a] = axis[a]
                out[k, way, 5 + a] = normal[a] if side >= 0.0 else -normal[a]
            width = np.sqrt(12.0 * variance)
            out[k, way, 0], out[k, way, 1] = slope / variance * width, width / STEPS
    return out


def _arc(own: NDArray[np.int64], width: float) -> tuple[float, float]:
    """(angle, radians, by which the parabola through the members turns over the width, positive
    where it bulges; its standard deviation)."""
    n = float(own[0])
    s, ss, sss, ssss, h, hh, hs, hss = own[1:] / n
    s2, h2, hs1 = ss - s * s, hh - h * h, hs - h * s
    s3, s4, hs2 = sss - ss * s, ssss - ss * ss, hss - h * ss
    own_s4 = s4 - s3 * s3 / s2
    bow = (hs2 - hs1 * s3 / s2) / own_s4
    rest = h2 - hs1 * hs1 / s2 - bow * bow * own_s4
    return -2.0 * bow * width, 2.0 * width * float(np.sqrt(max(rest, 0.0) / (n * own_s4)))


def _bimodality(own: NDArray[np.int64]) -> float:
    """Sarle's coefficient across the strip: (skewness^2 + 1) / kurtosis."""
    n = float(own[0])
    s, ss, sss, ssss = own[1:5] / n
    m2 = float(ss - s * s)
    m3 = float(sss - 3.0 * s * ss + 2.0 * s**3)
    m4 = float(ssss - 4.0 * s * sss + 6.0 * s * s * ss - 3.0 * s**4)
    return (m3 * m3 + m2**3) / (m4 * m2) if m2 > 0.0 else 0.0


def _axes(scatter: NDArray[np.float64]) -> NDArray[np.float64]:
    """(6,) unit vectors across a strip and along its normal."""
    _, nx, ny, nz, middle, _ = smallest(scatter)
    a, d, e, b, f, c = scatter
    return np.array([*eigenvector(a, b, c, d, e, f, middle), nx, ny, nz])


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
        widths, lengths = _spans(nodes.votes, nodes.scatter).T
        flat = widths >= self._settings.min_width
        strips = flat & (widths < self._settings.strip_width)
        origin = np.floor(nodes.mean * STEPS).astype(np.int64)
        sums = self._sums(table, label, strips, origin)
        limit = np.radians(self._settings.bend_deg)
        turns = _turns(sums)
        across, width, along = turns[:, 0, 0], turns[:, 0, 1], turns[:, 1, 0]
        judged = strips & (sums[:, 0] >= self._settings.n_min)
        narrow = (width < ARC_WIDTH) & (sums[:, 0] >= ARC_VOTES)
        low, high = (
            np.where(narrow, -np.radians(HOLLOWED_DEG), -limit),
            np.where(narrow, np.inf, limit),
        )
        straight = (np.abs(along) <= limit) & (low <= across) & (across <= high)
        flat &= straight | ~judged
        asked = (across < -np.radians(ASKED_DEG)) | (across > limit)
        pure = judged & straight & narrow & asked  # they may lie on an arc
        hollow = occupation < FULL * widths * lengths
        thin = strips & flat & ~pure & (widths >= GAP_WIDTH) & hollow
        axes = turns[:, 0, 2:].copy()
        for plane in np.flatnonzero(thin).tolist():
            axes[plane] = _axes(nodes.scatter[plane])
        heights = np.zeros((len(origin), ARC), np.int64)
        own = _nodes_of(label, pure | thin)
        rows, sizes = self._members(table, own)
        _add_heights(*self._voxels, rows, np.repeat(label[own], sizes), origin, axes, pure, heights)
        for plane in np.flatnonzero(pure).tolist():
            angle, deviation = _arc(heights[plane], float(width[plane]))
            least = max(np.radians(ARC_DEG), ARC_SIGMAS * deviation)
            flat[plane] = angle * np.sign(across[plane]) <= least
        numbers = np.full(len(flat) + 1, FREE)  # FREE finds the last one
        bent = np.flatnonzero(strips & ~flat)
        numbers[bent] = np.arange(len(bent))
        self.bent = numbers[label]
        for plane in np.flatnonzero(thin).tolist():
            flat[plane] = _bimodality(heights[plane]) < EMPTY
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
