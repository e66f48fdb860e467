"""The map: scans in, updates out. `update` is the whole method, one stage a line."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from facet.mapping.bends import Bends
from facet.mapping.blocks import pack, unpack
from facet.mapping.census import Census, tile_points
from facet.mapping.contours import ContourField
from facet.mapping.describe import Describer, Figures, Told
from facet.mapping.digest import Digest, derived_digest, model_planes, state_digest
from facet.mapping.ends import Ends, find_ends
from facet.mapping.fitting import fit_planes
from facet.mapping.freespace import FreeSpace
from facet.mapping.identity import Heritage, Identity
from facet.mapping.invariants import check_invariants
from facet.mapping.memory import Heap, Memory
from facet.mapping.merging import limits
from facet.mapping.normals import NormalField
from facet.mapping.patches import PatchField
from facet.mapping.planes import FREE, PointFit, fit_points, group_planes
from facet.mapping.quantise import quantise
from facet.mapping.report import MapCounts, StageReport
from facet.mapping.settings import TICKS, MapSettings
from facet.mapping.store import Touched, VoxelStore
from facet.mapping.table import Tabulator
from facet.mapping.tiles import TileField
from facet.mapping.witness import Witness
from facet_protocol.messages import MapUpdate, Scan, TilePoints

Timer = Callable[[str], None]
TileIndex = tuple[int, int, int]
MANY = 4096  # points from which on their beams are followed beside, on another core
_BESIDE = ThreadPoolExecutor(1, "beams")


class Counted(NamedTuple):
    """What became of a scan's points, or had."""

    points_stored: int
    rejected: dict[str, int]


class Grouped(NamedTuple):
    """What became of blocks and tiles, and the planes' points."""

    regrouped: NDArray[np.int32]  # blocks: patches changed
    relabelled: NDArray[np.int32]  # blocks: labels changed
    grown: list[int]  # tiles: tile-planes grown again
    changed: list[int]  # tiles: their voxels changed
    points: PointFit
    ends: Ends


class Mapper:
    """The planar map of one place: a pure function of the scans inserted and not retracted.

    One owner, one thread; another follows the beams of many points, until the free space is asked
    for. `insert` and `retract` take scans, `update` derives what they changed; plane ids and events
    alone depend on when `update` is called (design 2)."""

    def __init__(
        self,
        settings: MapSettings | None = None,
        map_id: str = "map",
        memory: Memory | None = None,
    ) -> None:
        self.settings = settings or MapSettings()
        self.map_id = map_id
        self.revision = 0
        self.work: dict[str, int] = {}
        self.changed_tiles: list[TileIndex] = []
        self.memory = memory or Heap()
        self._store = VoxelStore(self.memory)
        self._space = FreeSpace(self.memory)
        self._beams: Future[None] | None = None  # being followed
        self._normals = NormalField(self.settings, self.memory)
        self._patches = PatchField(self.settings, self.memory)
        self._tiles = TileField(self.memory)
        self._bends = Bends(self.settings, self._store, self._normals, self._patches, self._tiles)
        self._contours = ContourField(self.settings)
        self._identity = Identity()
        self._describer = Describer(self.settings)
        self._witness = Witness()
        self._census = Census()
        self._told = Told.nothing()
        self._tabulator = Tabulator()
        self._table = self._tabulator.tabulate({})
        self._planes = group_planes(self._table, limits(self.settings, 0.0), self.settings)
        self._stamp_ns = 0

    def insert(self, scan: Scan) -> Counted:
        """Add a resolved scan. What cannot be mapped is counted, never lost in silence."""
        return self.insert_all((scan,))[0]

    def insert_all(self, scans: Sequence[Scan]) -> list[Counted]:
        """Add resolved scans, of whichever robots, all at once."""
        ticks = quantise(scans, self.settings)
        if len(ticks.points) >= MANY:
            self._beams = _BESIDE.submit(self._free.insert, ticks)
        else:
            self._free.insert(ticks)
        self._store.insert(ticks)
        self._witness.note(ticks, scans)
        self._census.count(scans, ticks, 1)
        self._stamp_ns = max(self._stamp_ns, *(scan.stamp_ns for scan in scans))
        return [*map(Counted, np.diff(ticks.starts).tolist(), ticks.rejected)]

    def retract(self, scan: Scan) -> Counted:
        """Take a scan out again, exactly as if it had never been there (design 3.7)."""
        ticks = quantise((scan,), self.settings)
        self._store.remove(ticks)
        self._free.remove(ticks)
        self._census.count((scan,), ticks, -1)
        return Counted(len(ticks.points), ticks.rejected[0])

    def update(self, timer: Timer | None = None) -> MapUpdate:
        """Derive everything that is stale. `timer` is told the name of each stage as it ends."""
        done = timer or (lambda stage: None)
        store = self._store
        touched = store.touched
        dirty = store.settle()
        done("settle")
        num_stale, turned = self._normals.update(store, dirty)
        done("normals")
        grouped = self.group(turned, dirty.rows, touched, done)
        lineage = self._identity.assign(len(grouped.points.total), self._heritage())
        updated = self.outline(lineage.ids, grouped, done)
        self.work = {
            "touched_voxels": len(touched.rows),
            "dirty_voxels": len(dirty.rows),
            "stale_voxels": num_stale,
            "blocks_regrouped": len(grouped.regrouped),
            "blocks_relabelled": len(grouped.relabelled),
            "tiles_regrouped": len(grouped.grown),
            "tiles_changed": len(grouped.changed),
            "tile_planes": len(self._planes.label),
            "outline_tiles": self._contours.rolled,
            "planes_changed": len(updated),
        }
        self.revision += 1
        self.memory.rest()
        return MapUpdate(
            map_id=self.map_id,
            revision=self.revision,
            base_revision=self.revision - 1,
            stamp_ns=self._stamp_ns,
            changed=tuple(self._describer[i] for i in updated),
            retired=lineage.retired,
            events=self._identity.events(lineage, updated, self.revision, self._stamp_ns),
        )

    def group(
        self,
        turned: NDArray[np.int32],
        dirty: NDArray[np.int32],
        touched: Touched,
        done: Timer = lambda stage: None,
    ) -> Grouped:
        """Planes from normals: group again what blocks with changed normals (`turned`), voxels with
        changed observables (rows `dirty`) and with changed moments (`touched`) make stale."""
        seen, moved = self._store.blocks_of(touched.rows), self._store.blocks_of(dirty)
        turned = np.union1d(turned, moved)
        regrouped, relabelled = self._patches.update(
            self._store, self._normals.normals, turned, dirty, seen
        )
        done("patches")
        limit = limits(self.settings, self._patches.sigma() / TICKS)
        grown, changed, stirred = self._tiles.update(
            self._store,
            self._normals.normals,
            self._patches,
            limit,
            regrouped,
            relabelled,
            turned,
            moved,
            seen,
            touched,
        )
        self._bends.forget(stirred)
        done("tiles")
        self._table = self._tabulator.tabulate(self._tiles.tiles)
        if stirred:  # else points came to the same voxels: what is grouped is as it was
            self._planes = group_planes(self._table, limit, self.settings, self._bends.flat)
        points = fit_points(self._table, self._planes, self.settings.voxel_m)
        ends = find_ends(self._table, self._planes, self._bends.bent, points, self.settings)
        done("planes")
        return Grouped(regrouped, relabelled, grown, changed, points, ends)

    def outline(
        self, ids: NDArray[np.int64], grouped: Grouped, done: Timer = lambda stage: None
    ) -> list[int]:
        """Figures and outlines of the planes, under their ids (K,). Returns those that changed."""
        changed = {*grouped.changed, *self._name(ids)}
        figures = self._figures(ids, grouped.points)
        done("identity")
        self._contours.update(
            self._store, self._tiles.tiles, changed,
            {i: own.fit.inside for i, own in figures.items()}, grouped.ends.by_tile(self._table),
        )  # fmt: skip
        done("contours")
        updated = self._describer.update(figures, self._contours.contours, self._free)
        done("describe")
        shown = changed | self._tiles.renamed_abroad(self._store, changed)
        self.changed_tiles = [unpack(key) for key in sorted(shown)]
        return updated

    def snapshot(self) -> MapUpdate:
        """Everything, as of the last update."""
        return MapUpdate(
            self.map_id, self.revision, 0, self._stamp_ns, tuple(self._describer.planes), (), ()
        )

    def points(self, tiles: Iterable[TileIndex] | None = None) -> list[TilePoints]:
        """The voxels of the tiles, or of all, as of the last update, for display."""
        keys = sorted(self._tiles.tiles) if tiles is None else [pack(*index) for index in tiles]
        return tile_points(
            self._store, self._patches.patches, self._tiles, keys, self.settings.voxel_m
        )

    @property
    def num_voxels(self) -> int:
        """Occupied voxels, as of the last update."""
        return self._store.num_voxels

    def counts(self) -> MapCounts:
        """What was counted, and what the voxels are, as of the last update: it looks at all."""
        return self._census.take(
            self._store, self._normals.normals, self._tiles, self._patches.sigma()
            / TICKS * self.settings.voxel_m,
        )  # fmt: skip

    def report(self) -> StageReport:
        """The four-stage report of the paper's Table 3."""
        stages, counts = self._planes.stages, self.counts()
        voxels, points = max(1, counts.voxels), max(1, counts.points_stored)
        return StageReport(
            planes=(stages.seeds, stages.merged, stages.detailed, stages.final),
            aligned_percent=100.0 * counts.aligned / voxels,
            thick_percent=100.0 * counts.thick / voxels,
            average_two_sigma_m=2.0 * stages.average_sigma * self.settings.voxel_m,
            detail_level_reached=stages.detail_reached,
            min_occupation=stages.min_occupation,
            discarded_percent=100.0 * counts.discarded / voxels,
            discarded_points_percent=100.0 * counts.discarded_points / points,
        )

    def digest(self) -> Digest:
        """Hashes of the state and of what is derived from it, as of the last update."""
        planes = model_planes(self._describer.planes)
        return Digest(
            state_digest(self._store, self._free),
            derived_digest(planes, self.counts().as_dict()),
        )

    def check_invariants(self) -> None:
        """Raise AssertionError unless the map is what a map must be (style 7.5). Slow."""
        check_invariants(self)

    @property
    def _free(self) -> FreeSpace:
        """The free space, when all beams are followed."""
        if self._beams is not None:
            self._beams.result()
            self._beams = None
        return self._space

    def _heritage(self) -> Heritage:
        """Voxels that the planes of this update share with those of the last."""
        own = [self._tiles.tiles[key].heritage for key in self._table.tile_keys.tolist()]
        old, tile_plane, voxels = np.concatenate([np.zeros((0, 3), np.int64), *own]).T
        first = np.repeat(self._table.starts[:-1], [len(shared) for shared in own])
        label = self._planes.label[first + tile_plane]
        on = label != FREE
        return Heritage(old[on], label[on], voxels[on])

    def _name(self, ids: NDArray[np.int64]) -> list[int]:
        """Hand the plane ids to the tiles. Returns the tiles that were renamed."""
        label = self._planes.label
        named = np.where(label == FREE, 0, ids[label] if len(ids) else 0)
        return self._tiles.name(self._table.tile_keys, self._table.starts, named)

    def _figures(self, ids: NDArray[np.int64], points: PointFit) -> dict[int, Figures]:
        """Figures of the planes: anew of those that changed, or were seen again."""
        planes, told = self._planes, self._told
        unit = planes.nodes.unit
        data = np.column_stack(
            [points.total, planes.occupation, points.weight, points.centroid, points.scatter, unit]
        )
        again = told.differ(ids, data)
        again[self._seen_planes()] = True
        fitted = points.weight[again], points.centroid[again], points.scatter[again], unit[again]
        fits = iter(fit_planes(*fitted, self.settings.tick_m))
        tiles = self._tiles_of(again)
        figures = {}
        for plane, plane_id in enumerate(ids.tolist()):
            if not again[plane]:
                figures[plane_id] = told.figures[plane_id]
                continue
            total, voxels = int(points.total[plane]), int(planes.occupation[plane])
            seen = self._witness.of(tiles[plane])
            figures[plane_id] = Figures(next(fits), total, voxels, points.centroid[plane], seen)
        self._told = Told(ids, data, figures)
        return figures

    def _tiles_of(self, wanted: NDArray[np.bool_]) -> dict[int, list[int]]:
        """The tiles that planes lie in, of those that are wanted (K,), ascending."""
        label, tile_of = self._planes.label, self._table.tile_of
        on = np.flatnonzero(label != FREE)
        on = on[wanted[label[on]]]
        plane, tile = np.divmod(np.unique(label[on] << 32 | tile_of[on]), 1 << 32)
        keys = self._table.tile_keys[tile].tolist()
        ends = np.searchsorted(plane, np.arange(len(wanted) + 1)).tolist()
        return {p: keys[ends[p] : ends[p + 1]] for p in np.flatnonzero(wanted).tolist()}

    def _seen_planes(self) -> NDArray[np.int64]:
        """Planes in tiles that were seen since the last update."""
        seen = np.isin(self._table.tile_keys, self._witness.fresh())
        label = self._planes.label[seen[self._table.tile_of]]
        return np.unique(label[label != FREE])
