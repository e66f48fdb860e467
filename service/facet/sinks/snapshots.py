"""The map for late joiners: everything, or what changed since a revision. Any thread may ask."""

from __future__ import annotations

import threading

from facet_protocol.messages import Envelope, MapUpdate, Plane, TilePoints, Tombstone

MAX_TOMBSTONES = 10_000  # a client further behind than these gets everything


class Snapshots:
    """Folds every update; `since` answers a client that has seen a gap."""

    def __init__(self, map_id: str) -> None:
        self._lock = threading.Lock()
        self._map_id = map_id
        self._planes: dict[int, tuple[int, Plane]] = {}  # id -> (revision it came with, plane)
        self._retired: dict[int, tuple[int, Tombstone]] = {}
        self._forgotten = 0  # tombstones up to this revision are gone
        self._revision = 0
        self._stamp_ns = 0
        self._tiles: dict[tuple[int, int, int], tuple[Envelope, TilePoints]] = {}

    @property
    def num_planes(self) -> int:
        return len(self._planes)

    def apply_tile(self, envelope: Envelope, tile: TilePoints) -> None:
        """The newest points of one tile; an empty one is forgotten."""
        with self._lock:
            self._tiles.pop(tile.tile, None)
            if len(tile.plane_ids):
                self._tiles[tile.tile] = (envelope, tile)

    def tiles(self) -> list[tuple[Envelope, TilePoints]]:
        """Every tile that has points, as last sent."""
        with self._lock:
            return [self._tiles[tile] for tile in sorted(self._tiles)]

    def apply(self, update: MapUpdate) -> None:
        """Updates come in order and without gaps: from the one who makes them."""
        with self._lock:
            self._revision, self._stamp_ns = update.revision, update.stamp_ns
            if update.base_revision == 0:  # what went before it is not known
                self._forgotten = update.revision
            for plane in update.changed:
                self._planes[plane.id] = (update.revision, plane)
                self._retired.pop(plane.id, None)
            for tombstone in update.retired:
                self._planes.pop(tombstone.plane_id, None)
                self._retired[tombstone.plane_id] = (update.revision, tombstone)
            while len(self._retired) > MAX_TOMBSTONES:
                revision, _ = self._retired.pop(next(iter(self._retired)))
                self._forgotten = max(self._forgotten, revision)

    def since(self, revision: int) -> MapUpdate:
        """What changed after `revision`; everything (base 0) when that is too long ago."""
        with self._lock:
            known = self._forgotten <= revision <= self._revision
            base = revision if known else 0
            changed = (plane for r, plane in self._planes.values() if r > base)
            retired = (tombstone for r, tombstone in self._retired.values() if base and r > base)
            return MapUpdate(
                map_id=self._map_id,
                revision=self._revision,
                base_revision=base,
                stamp_ns=self._stamp_ns,
                changed=tuple(sorted(changed, key=lambda plane: plane.id)),
                retired=tuple(sorted(retired, key=lambda tombstone: tombstone.plane_id)),
                events=(),
            )
