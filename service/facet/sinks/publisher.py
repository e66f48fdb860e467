"""The map over Zenoh: one thread, a bounded queue, the newest wins, and never a wait for anyone."""

from __future__ import annotations

import logging
import threading
from collections import deque
from collections.abc import Callable
from dataclasses import replace

import zenoh
import zenoh.ext

from facet.sinks.snapshots import Snapshots
from facet_protocol import topics
from facet_protocol.codec import Message, encode
from facet_protocol.messages import Envelope, Events, MapUpdate, Plane, Status, TilePoints

logger = logging.getLogger(__name__)

MAX_TILE_BYTES = 900_000  # a larger tile is thinned: points are for the eye
DROP = zenoh.CongestionControl.DROP


class Publisher:
    """A sink for updates, points and status. What does not fit in the queue is left out.

    Nothing is lost by that: a client sees the gap in the revisions and asks for a snapshot.
    """

    def __init__(
        self,
        session: zenoh.Session,
        map_id: str,
        snapshots: Snapshots,
        max_updates: int = 64,
        count: Callable[[str], None] = lambda name: None,
    ) -> None:
        self._session, self._map_id, self._snapshots = session, map_id, snapshots
        self._count = count
        self._changed = threading.Condition()
        self._updates: deque[tuple[Envelope, MapUpdate | Events]] = deque()
        self._max_updates = max_updates
        self._tiles: dict[tuple[int, int, int], tuple[Envelope, TilePoints]] = {}  # the newest
        self._status: bytes | None = None
        self._closed = False
        self._planes: dict[int, zenoh.ext.AdvancedPublisher] = {}
        self._alive = session.liveliness().declare_token(topics.alive_key(map_id))
        self._thread = threading.Thread(target=self._run, name="publisher", daemon=True)
        self._thread.start()

    def write(self, envelope: Envelope, message: Message | None) -> None:
        """Queue one message; returns at once."""
        if isinstance(message, MapUpdate):
            self._snapshots.apply(message)
        elif isinstance(message, TilePoints):
            self._snapshots.apply_tile(envelope, message)
        with self._changed:
            if isinstance(message, MapUpdate | Events):
                self._updates.append((envelope, message))
                if len(self._updates) > self._max_updates:
                    self._updates.popleft()
                    self._count("publisher_dropped")
            elif isinstance(message, TilePoints):
                self._tiles[message.tile] = (envelope, message)
            elif isinstance(message, Status):
                self._status = bytes(envelope.payload)
            else:
                return
            self._changed.notify()

    def close(self) -> None:
        """Send what is queued, as far as it goes in a second, and withdraw."""
        with self._changed:
            self._closed = True
            self._changed.notify()
        self._thread.join(timeout=1.0)
        self._alive.undeclare()

    def _run(self) -> None:
        while True:
            with self._changed:
                self._changed.wait_for(self._has_work)
                update = self._updates.popleft() if self._updates else None
                status, self._status = self._status, None
                tile = self._tiles.pop(next(iter(self._tiles))) if self._tiles else None
                if self._closed and update is None and status is None and tile is None:
                    return
            try:
                self._send(update, status, tile)
            except Exception:  # a sink's fault is its own; the map goes on without it
                logger.exception("publishing failed")
                self._count("publisher_failed")

    def _has_work(self) -> bool:
        return bool(self._closed or self._updates or self._tiles or self._status)

    def _send(
        self,
        update: tuple[Envelope, MapUpdate | Events] | None,
        status: bytes | None,
        tile: tuple[Envelope, TilePoints] | None,
    ) -> None:
        if status is not None:
            self._put(topics.status_key(self._map_id), "facet.v1.Status", status)
        if update is not None:
            envelope, message = update
            if isinstance(message, Events):
                key = topics.events_key(self._map_id)
            else:
                key = topics.update_key(self._map_id)
            self._put(key, envelope.schema, bytes(envelope.payload))
            if isinstance(message, MapUpdate):
                self._put_planes(message)
        if tile is not None:
            key, low = topics.points_key(self._map_id), zenoh.Priority.DATA_LOW
            self._put(key, tile[0].schema, tile_payload(*tile), low)

    def _put_planes(self, update: MapUpdate) -> None:
        for plane in update.changed:
            self._put_plane(plane)
        for tombstone in update.retired:
            publisher = self._planes.pop(tombstone.plane_id, None)
            if publisher is not None:
                publisher.delete()
                publisher.undeclare()

    def _put_plane(self, plane: Plane) -> None:
        publisher = self._planes.get(plane.id)
        if publisher is None:
            publisher = zenoh.ext.declare_advanced_publisher(
                self._session,
                topics.plane_key(self._map_id, plane.id),
                encoding=encoding_of("facet.v1.Plane"),
                congestion_control=DROP,
                cache=zenoh.ext.CacheConfig(max_samples=1),
                publisher_detection=True,
            )
            self._planes[plane.id] = publisher
        publisher.put(encode(plane)[1])

    def _put(
        self,
        key: str,
        schema: str,
        payload: bytes,
        priority: zenoh.Priority = zenoh.Priority.DATA,
    ) -> None:
        self._session.put(
            key,
            payload,
            encoding=encoding_of(schema),
            congestion_control=DROP,
            priority=priority,
        )


def encoding_of(schema: str) -> zenoh.Encoding:
    return zenoh.Encoding.APPLICATION_PROTOBUF.with_schema(schema)


def tile_payload(envelope: Envelope, tile: TilePoints) -> bytes:
    """The tile as it travels: a large one thinned to MAX_TILE_BYTES, ten bytes a voxel."""
    step = -(-len(tile.plane_ids) * 10 // MAX_TILE_BYTES)
    if step <= 1:
        return bytes(envelope.payload)
    thin = replace(tile, centroids=tile.centroids[::step], plane_ids=tile.plane_ids[::step])
    return encode(thin)[1]
