"""Planes that are none: strips too narrow to have a normal, and strips of something curved.

On a plane the members' normals do not depend on where they are; along a curved wall, or over a
bevelled edge, they turn steadily. Whatever turns goes to the remainder (design 3.4).
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from facet.mapping.blocks import unpack
from facet.mapping.eigen import eigenvector, smallest
from facet.mapping.kernel import kernel
from facet.mapping.merging import Nodes
from facet.mapping.normals import UNIT, NormalField
from facet.mapping.patches import PatchField
from facet.mapping.settings import STEPS, MapSettings
from facet.mapping.store import VoxelStore
from facet.mapping.tiles import TileField

SUMS = 22  # n; sum x (3), xx (6); sum u (3), u x (9): x in 1/8 voxels, u normals times UNIT


@kernel
def _add_members(store, normals, patches, rows, corner, starts, plane_of, origin, sums):  # type: ignore[no-untyped-def]
    """Add a tile's pure members to the sums (K, SUMS) of their planes; plane_of (T,), -1: none."""
    blocks, columns = store
    x = np.empty(3, np.int64)
    for plane in range(plane_of.shape[0]):
        k = plane_of[plane]
        for m in range(starts[plane], starts[plane + 1] if k >= 0 else 0):
            row = rows[m]
            if corner[m] or patches.member[row] < 0 or normals.border[row]:
                continue
            if patches.second[row] >= 0:
                continue
            seen, local = columns.observable[row], np.int64(columns.local[row])
            bi, bj, bk = unpack(blocks.keys[columns.block[row]])
            x[0] = STEPS * (8 * bi + (local & 7)) + (seen & 15) - origin[k, 0]
            x[1] = STEPS * (8 * bj + ((local >> 3) & 7)) + ((seen >> 4) & 15) - origin[k, 1]
            x[2] = STEPS * (8 * bk + (local >> 6)) + ((seen >> 8) & 15) - origin[k, 2]
            sums[k, 0] += 1
            s = 4
            for a in range(3):
                sums[k, 1 + a] += x[a]
                sums[k, 10 + a] += normals.unit[row, a]
                for b in range(a, 3):
                    sums[k, s] += x[a] * x[b]
                    s += 1
                for b in range(3):
                    sums[k, 13 + 3 * a + b] += normals.unit[row, a] * x[b]


def _turn(own: NDArray[np.int64]) -> float:
    """Largest angle, radians, by which the members' normals turn over the width or the length."""
    n = float(own[0])
    mean, unit = own[1:4] / n, own[10:13] / n / UNIT
    xx = own[4:10] / n - np.array([mean[a] * mean[b] for a in range(3) for b in range(a, 3)])
    ux = own[13:22].reshape(3, 3) / n / UNIT - np.outer(unit, mean)
    _, _, _, _, middle, largest = smallest(xx)
    most = 0.0
    for variance in (middle, largest):
        if variance < 1.0:
            continue
        axis = np.array(eigenvector(xx[0], xx[3], xx[5], xx[1], xx[2], xx[4], variance))
        slope = float(axis @ ux @ axis) / variance
        most = max(most, abs(slope) * float(np.sqrt(12.0 * variance)))
    return most


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

    def flat(
        self,
        tile_keys: NDArray[np.int64],
        starts: NDArray[np.int64],
        label: NDArray[np.int64],
        nodes: Nodes,
    ) -> NDArray[np.bool_]:
        """(K,) whether a plane is wide enough to be one and, if it is a strip, not bent.

        label: (T,) plane of each tile-plane, in the order of tile_keys and starts."""
        widths = np.array(
            [
                np.sqrt(12.0 * max(0.0, smallest(s)[4]) / v)
                for s, v in zip(nodes.scatter, nodes.votes, strict=True)
            ]
        )
        wide = widths >= self._settings.min_width
        strips = wide & (widths < self._settings.strip_width)
        sums = self._sum(tile_keys, starts, label, strips, nodes)
        limit = np.radians(self._settings.bend_deg)
        for plane in np.flatnonzero(strips & (sums[:, 0] >= self._settings.n_min)):
            wide[plane] = _turn(sums[plane]) <= limit
        return wide

    def _sum(
        self,
        tile_keys: NDArray[np.int64],
        starts: NDArray[np.int64],
        label: NDArray[np.int64],
        strips: NDArray[np.bool_],
        nodes: Nodes,
    ) -> NDArray[np.int64]:
        sums = np.zeros((len(strips), SUMS), np.int64)
        origin = np.floor(nodes.mean * STEPS).astype(np.int64)
        wanted = np.where(label >= 0, label, 0)
        plane_of = np.where((label >= 0) & strips[wanted], label, -1) if len(strips) else label
        normals, patches = self._normals.normals, self._patches.patches
        for index, key in enumerate(tile_keys.tolist()):
            own = plane_of[starts[index] : starts[index + 1]]
            if not (own >= 0).any():
                continue
            tile = self._tiles.tiles[key]
            _add_members(
                (self._store.blocks, self._store.columns), normals, patches, tile.rows, tile.corner,
                tile.starts, own, origin, sums,
            )  # fmt: skip
        return sums
