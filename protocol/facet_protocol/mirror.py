"""MapMirror: folds a snapshot and the updates after it into the same map. What a client keeps."""

from __future__ import annotations

from facet_protocol.messages import MapUpdate, Plane, ProtocolError


class MapMirror:
    """The planes of one map as a client knows them. Not thread-safe: one owner."""

    def __init__(self, map_id: str = "") -> None:
        self.map_id = map_id  # "": taken from the first update
        self.planes: dict[int, Plane] = {}
        self.revision = 0
        self.stamp_ns = 0

    def apply(self, update: MapUpdate) -> bool:
        """Fold one update in. False: a gap before it, ask for a snapshot since `.revision`.

        A snapshot (base 0) replaces everything, also with an older map: the service began anew. An
        update that is already known changes nothing. Raises ProtocolError for another map's.
        """
        if self.map_id not in ("", update.map_id):
            text = f"an update of map {update.map_id!r} in the mirror of {self.map_id!r}"
            raise ProtocolError(text, "wrong_map")
        if update.base_revision > self.revision:
            return False
        if update.base_revision == 0:
            self.planes.clear()
        elif update.revision <= self.revision:
            return True
        self.planes.update((plane.id, plane) for plane in update.changed)
        for tombstone in update.retired:
            self.planes.pop(tombstone.plane_id, None)
        self.map_id = update.map_id
        self.revision = update.revision
        self.stamp_ns = update.stamp_ns
        return True

    def snapshot(self) -> MapUpdate:
        """Everything, in the order of ids: encodes to the bytes of the mapper's own snapshot."""
        return MapUpdate(
            map_id=self.map_id,
            revision=self.revision,
            base_revision=0,
            stamp_ns=self.stamp_ns,
            changed=tuple(self.planes[i] for i in sorted(self.planes)),
            retired=(),
            events=(),
        )
