"""What the service says, as envelopes: its log and its clients get the same bytes."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence

from facet.sinks import Message
from facet_protocol import topics
from facet_protocol.codec import encode
from facet_protocol.messages import (
    Cut,
    Envelope,
    Events,
    Loss,
    MapUpdate,
    Plane,
    Scan,
    StampedPose,
    StampedTransform,
    Status,
    TilePoints,
    Tombstone,
    Transforms,
)
from facet_protocol.scene import encode_scene

SCENE_EVERY_NS = 10**9  # of stamps: Foxglove's picture of the planes may be a second old
Addressed = tuple[Envelope, Message | None]  # None: a picture of another message


class Outgoing:
    """Encodes messages and gives them their topic and time.

    `clock_ns` None takes the log's own time, so that two replays write the same bytes.
    """

    def __init__(
        self, map_id: str, frame_id: str, clock_ns: Callable[[], int] | None = None
    ) -> None:
        self._map_id, self._frame_id, self._clock_ns = map_id, frame_id, clock_ns
        self._scene_changed: dict[int, Plane] = {}
        self._scene_retired: dict[int, Tombstone] = {}
        self._scene_ns = 0
        self._last: MapUpdate | None = None

    def address(self, topic: str, message: Message, stamp_ns: int, log_time_ns: int) -> Addressed:
        """One message with its topic, as it travels."""
        schema, payload = encode(message)
        return self._envelope(topic, schema, payload, stamp_ns, log_time_ns), message

    def update(
        self, update: MapUpdate, cuts: Sequence[Cut], log_time_ns: int
    ) -> Iterator[Addressed]:
        """The cut, the update, its events, and now and then the scene."""
        for cut in cuts:
            yield self.address(topics.CUT_TOPIC, cut, cut.stamp_ns, log_time_ns)
        yield self.address(topics.UPDATE_TOPIC, update, update.stamp_ns, log_time_ns)
        if update.events:
            events = Events(self._map_id, update.events)
            yield self.address(topics.EVENTS_TOPIC, events, update.stamp_ns, log_time_ns)
        self._keep_for_scene(update)
        if update.stamp_ns - self._scene_ns >= SCENE_EVERY_NS:
            yield from self._scene(update, log_time_ns)

    def finish(self, log_time_ns: int) -> Iterator[Addressed]:
        """The scene as it is at the end."""
        if self._last is not None:
            yield from self._scene(self._last, log_time_ns)

    def poses(self, scans: Iterable[Scan], log_time_ns: int) -> Iterator[Addressed]:
        """Where each robot is, and each sensor's frame: both Foxglove and Rerun draw them."""
        by_source = sorted(scans, key=lambda scan: scan.source)
        newest = {scan.robot: scan for scan in sorted(by_source, key=lambda scan: scan.stamp_ns)}
        for robot, scan in sorted(newest.items()):
            pose = StampedPose(scan.stamp_ns, self._frame_id, scan.pose)
            yield self.address(topics.pose_topic(robot), pose, scan.stamp_ns, log_time_ns)
        transforms = [
            StampedTransform(scan.stamp_ns, self._frame_id, scan.source, scan.pose)
            for scan in by_source
        ]
        if transforms:
            stamp_ns = max(t.stamp_ns for t in transforms)
            message = Transforms(tuple(transforms))
            yield self.address(topics.TF_TOPIC, message, stamp_ns, log_time_ns)

    def points(self, tiles: Iterable[TilePoints], log_time_ns: int) -> Iterator[Addressed]:
        """Voxels for display, tile by tile."""
        for tile in tiles:
            yield self.address(topics.points_key(self._map_id), tile, log_time_ns, log_time_ns)

    def status(self, status: Status) -> Addressed:
        return self.address(topics.STATUS_TOPIC, status, status.stamp_ns, status.stamp_ns)

    def loss(self, loss: Loss) -> Addressed:
        return self.address(topics.LOSS_TOPIC, loss, loss.stamp_ns, loss.stamp_ns)

    def remember(self, snapshot: MapUpdate) -> None:
        """The next scene shows all of it: a log that goes on in a new file."""
        self._keep_for_scene(snapshot)

    def snapshot(self, snapshot: MapUpdate, log_time_ns: int) -> Addressed:
        """Everything, for those who follow and may have seen another map."""
        return self.address(topics.UPDATE_TOPIC, snapshot, snapshot.stamp_ns, log_time_ns)

    def _keep_for_scene(self, update: MapUpdate) -> None:
        self._last = update
        for plane in update.changed:
            self._scene_changed[plane.id] = plane
            self._scene_retired.pop(plane.id, None)
        for tombstone in update.retired:
            self._scene_retired[tombstone.plane_id] = tombstone
            self._scene_changed.pop(tombstone.plane_id, None)

    def _scene(self, update: MapUpdate, log_time_ns: int) -> Iterator[Addressed]:
        changed, self._scene_changed = self._scene_changed, {}
        retired, self._scene_retired = self._scene_retired, {}
        self._scene_ns = update.stamp_ns
        if not changed and not retired:
            return
        scene = MapUpdate(
            map_id=update.map_id,
            revision=update.revision,
            base_revision=max(update.base_revision, 1),  # a delta: a snapshot would clear the rest
            stamp_ns=update.stamp_ns,
            changed=tuple(changed[i] for i in sorted(changed)),
            retired=tuple(retired[i] for i in sorted(retired)),
            events=(),
        )
        schema, payload = encode_scene(scene, self._frame_id)
        stamp_ns = update.stamp_ns
        yield self._envelope(topics.SCENE_TOPIC, schema, payload, stamp_ns, log_time_ns), None

    def _envelope(
        self, topic: str, schema: str, payload: bytes, stamp_ns: int, log_time_ns: int
    ) -> Envelope:
        return Envelope(
            key=topic,
            schema=schema,
            encoding="protobuf",
            payload=payload,
            stamp_ns=max(stamp_ns, 0),
            received_ns=self._clock_ns() if self._clock_ns else log_time_ns,
        )
