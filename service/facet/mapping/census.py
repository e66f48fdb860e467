"""Counting: scans and points at the door, voxels by their fate; and voxels for display."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from facet.mapping.blocks import CENTRE, list_voxels, unpack
from facet.mapping.kernel import kernel
from facet.mapping.normals import ALIGNED, MIXED, SPARSE, THICK, VALID, Normals
from facet.mapping.patches import Patches
from facet.mapping.quantise import Ticks
from facet.mapping.report import MapCounts
from facet.mapping.settings import VOXELS
from facet.mapping.store import VoxelStore
from facet.mapping.tiles import TileField
from facet_protocol.messages import Scan, TilePoints


class Census:
    """Counters of what was inserted and not retracted."""

    def __init__(self) -> None:
        self._scans = 0
        self._points_in = 0
        self._points_stored = 0
        self._rejected: dict[str, int] = {}

    def count(self, scans: Sequence[Scan], ticks: Ticks, sign: int) -> None:
        """Account for scans inserted (1) or retracted (-1): every point stored or rejected."""
        self._scans += sign * len(scans)
        self._points_in += sign * sum(len(scan.points) for scan in scans)
        self._points_stored += sign * len(ticks.points)
        for rejected in ticks.rejected:
            for reason, number in rejected.items():
                self._rejected[reason] = self._rejected.get(reason, 0) + sign * number

    def freeze(self) -> dict[str, Any]:
        """What was counted, as JSON."""
        return {
            "scans": self._scans,
            "points_in": self._points_in,
            "points_stored": self._points_stored,
            "rejected": self._rejected,
        }

    def restore(self, frozen: Mapping[str, Any]) -> None:
        """Go on from `freeze`."""
        self._scans, self._points_in = int(frozen["scans"]), int(frozen["points_in"])
        self._points_stored = int(frozen["points_stored"])
        self._rejected = {str(k): int(n) for k, n in frozen["rejected"].items()}

    def take(
        self, store: VoxelStore, normals: Normals, tiles: TileField, sigma_m: float
    ) -> MapCounts:
        """All counts, as of the last update."""
        rows = np.flatnonzero(store.columns.observable[: store.num_rows])  # as last settled
        kinds = np.bincount(normals.kind[rows], minlength=6)
        placed = np.zeros(max(store.num_rows, 1), np.bool_)
        for tile in tiles.tiles.values():
            on = (tile.ids[tile.owner] != 0) & ~tile.corner
            placed[tile.rows[on]] = True
        off = rows[~placed[rows]]
        return MapCounts(
            scans=self._scans,
            points_in=self._points_in,
            points_stored=self._points_stored,
            points_rejected={k: n for k, n in sorted(self._rejected.items()) if n},
            voxels=len(rows),
            valid=int(kinds[VALID]),
            aligned=int(kinds[ALIGNED]),
            thick=int(kinds[THICK]),
            sparse=int(kinds[SPARSE]),
            mixed=int(kinds[MIXED]),
            discarded=len(off),
            discarded_points=int(store.num_points(off).sum()),
            sigma_n_m=sigma_m,
        )


@kernel
def _fill(blocks, observable, label, id_of_patch, which, tile, centroids, ids):  # type: ignore[no-untyped-def]
    rows, places = np.empty(VOXELS, np.int64), np.empty(VOXELS, np.int64)
    count = 0
    for q in range(which.shape[0]):
        block = which[q]
        i, j, k = unpack(blocks.keys[block])
        x, y, z = 64 * (i - 8 * tile[0]), 64 * (j - 8 * tile[1]), 64 * (k - 8 * tile[2])
        for v in range(list_voxels(blocks, block, blocks.occupied[block], rows, places)):
            row, place = rows[v], places[v]
            seen = observable[row]
            centroids[count, 0] = x + 8 * (place & 7) + (seen & 15)
            centroids[count, 1] = y + 8 * ((place >> 3) & 7) + ((seen >> 4) & 15)
            centroids[count, 2] = z + 8 * (place >> 6) + ((seen >> 8) & 15)
            ids[count] = 0
            own = label[row]
            if own >= 0:
                n = own >> 4
                other = block if n == CENTRE else blocks.neighbours[block, n]
                ids[count] = id_of_patch[other, own & 15]
            count += 1


def _ids_of_patches(tiles: TileField) -> NDArray[np.int32]:
    """(B, PER_BLOCK) plane id of each patch, 0: none."""
    ids = np.zeros(tiles.plane_of_patch.shape, np.int32)
    for tile in tiles.tiles.values():
        if len(tile.ids):
            own = np.minimum(tiles.plane_of_patch[tile.blocks], len(tile.ids) - 1)
            ids[tile.blocks] = tile.ids[own]
    return ids


def tile_points(
    store: VoxelStore, patches: Patches, tiles: TileField, keys: list[int], voxel_m: float
) -> list[TilePoints]:
    """The voxels of tiles with their plane ids."""
    id_of_patch = _ids_of_patches(tiles)
    out = []
    for key in keys:
        tile = tiles.tiles.get(key)
        which = tile.blocks if tile is not None else np.zeros(0, np.int32)
        count = int(np.bitwise_count(store.blocks.occupied[which]).sum())
        centroids, ids = np.empty((count, 3), np.uint16), np.empty(count, np.int32)
        index = unpack(key)
        _fill(
            store.blocks, store.columns.observable, patches.label, id_of_patch, which, index,
            centroids, ids,
        )  # fmt: skip
        out.append(TilePoints(index, voxel_m, centroids, ids))
    return out
