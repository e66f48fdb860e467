"""Planes that are none: strips too narrow to have a normal, and strips of something curved.

On a plane the members' normals do not depend on where they are; along a curved wall, or over a
bevelled edge, they turn steadily. Whatever turns goes to the remainder (design 3.4).
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

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
def _add_members(rows, owner, corner, plane_of, voxels, observable, unit, pure, origin, sums):  # type: ignore[no-untyped-def]
    """Add a tile's pure members to the sums (K, SUMS) of their planes; plane_of (T,), -1: none."""
    x = np.empty(3, np.int64)
    for m in range(rows.shape[0]):
        k = plane_of[owner[m]]
        if k < 0 or corner[m] or not pure[m]:
            continue
        seen = observable[rows[m]]
        u = unit[rows[m]]
        own = sums[k]
        own[0] += 1
        s = 4
        for a in range(3):
            x[a] = STEPS * voxels[m, a] + ((seen >> (4 * a)) & 15) - origin[k, a]
        for a in range(3):
            own[1 + a] += x[a]
            own[10 + a] += u[a]
            for b in range(a, 3):
                own[s] += x[a] * x[b]
                s += 1
            for b in range(3):
                own[13 + 3 * a + b] += u[a] * x[b]


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
            rows = tile.rows
            pure = (patches.member[rows] >= 0) & ~normals.border[rows]
            pure &= patches.second[rows] < 0
            _add_members(
                rows, tile.owner, tile.corner, own, self._store.voxel_keys(rows),
                self._store.columns.observable, normals.unit, pure, origin, sums,
            )  # fmt: skip
        return sums
