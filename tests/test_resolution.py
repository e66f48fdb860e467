"""Scans that wait for their pose: how long, in what order, and that a replay does the same."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from hypothesis import Phase, given, settings
from hypothesis import strategies as st

from facet.admission import Admission
from facet.cuts import logged_cuts
from facet.frames import Rank
from facet.outgoing import Outgoing
from facet.pipeline import Pipeline
from facet.resolution import Resolution, Settled
from facet.sources.naming import is_input
from facet.sources.recording import is_replayed
from facet.status import Account
from facet_protocol import topics
from facet_protocol.codec import encode
from facet_protocol.messages import (
    Envelope,
    MapUpdate,
    Pose,
    ResolvedPose,
    Scan,
    StampedTransform,
)
from rig import room_scan

MS = 1_000_000
WAIT_NS = 500 * MS


def at(x: float) -> Pose:
    return Pose(np.array([x, 0.0, 0.0]), np.array([0.0, 0.0, 0.0, 1.0]))


def lone(number: int, stamp_ms: int, robot: str = "r1", size: int = 10) -> tuple[Envelope, Scan]:
    """A scan in its sensor's frame."""
    scan = replace(
        room_scan(1, robot),
        **{"sequence": number, "stamp_ns": stamp_ms * MS, "frame_id": "lidar"},
        pose=at(0.0),
        points=np.ones((1, 3), np.float32),
    )
    key = topics.scan_key("map", robot, "lidar")
    return Envelope(key, "x", "cdr", bytes(size), scan.stamp_ns, 5, number), scan


class Rig:
    def __init__(self, max_bytes: int = 1 << 20, *, logged: bool = False) -> None:
        self.resolution = Resolution("map", WAIT_NS, max_bytes, logged=logged)
        self.settled: list[Settled] = []

    def hold(self, number: int, stamp_ms: int, **other: Any) -> None:
        self.settled += self.resolution.hold(*lone(number, stamp_ms, **other))

    def tell(self, stamp_ms: int, x: float, robot: str = "r1", rank: Rank = Rank.TRANSFORM) -> str:
        transform = StampedTransform(stamp_ms * MS, "map", "lidar", at(x))
        reason, settled = self.resolution.tell(robot, transform, rank, "/tf")
        self.settled += settled
        return reason

    def said(self) -> list[tuple[int, Any]]:
        """(sequence, x of the pose or the reason) of what was settled since it was asked."""
        settled, self.settled = self.settled, []
        return [
            (s.scan.sequence, s.error.reason if s.error else s.scan.pose.position[0])
            for s in settled
        ]


def test_a_scan_waits_for_the_pose_after_it() -> None:
    rig = Rig()
    rig.tell(1000, 1.0)
    rig.hold(1, 1050)
    rig.hold(2, 1100)
    assert rig.said() == []
    rig.tell(1100, 2.0)
    assert rig.said() == [(1, pytest.approx(1.5)), (2, 2.0)]
    rig.hold(3, 1075)
    assert rig.said() == [(3, pytest.approx(1.75))]


def test_a_placed_scan_is_in_the_frame_of_the_map() -> None:
    rig = Rig()
    rig.tell(0, 4.0, rank=Rank.STATIC)
    envelope, scan = lone(1, 1000)
    ahead = replace(scan, pose=at(0.5))
    (settled,) = rig.resolution.hold(envelope, ahead)
    assert settled.error is None
    assert (settled.scan.frame_id, settled.scan.pose.position[0]) == ("map", 4.5)
    assert settled.scan.points is scan.points


def test_a_scan_waits_so_long_in_stamps_and_no_longer() -> None:
    rig = Rig()
    rig.hold(1, 1000)
    rig.hold(2, 1500)
    assert rig.said() == []
    rig.hold(3, 1501)
    assert rig.said() == [(1, "no_pose")]
    rig.tell(2001, 0.0)
    assert rig.said() == [
        (2, "no_pose"),
    ]
    rig.tell(2002, 0.0)
    assert rig.said() == [(3, "no_pose")]


def test_the_error_says_what_is_missing() -> None:
    rig = Rig()
    rig.tell(5000, 0.0)
    rig.hold(1, 1000)
    rig.tell(5001, 0.0)
    (settled,) = rig.settled
    assert "frame_id 'lidar' at 1000000000 ns in 'map'" in str(settled.error)
    assert "its transforms begin later" in str(settled.error)


def test_the_stamps_of_another_robot_say_nothing() -> None:
    rig = Rig()
    rig.hold(1, 1000, robot="r1")
    rig.hold(2, 99_000, robot="r2")
    rig.tell(99_000, 7.0, robot="r2")
    assert rig.said() == [(2, 7.0)]
    rig.tell(1000, 3.0, robot="r1")
    assert rig.said() == [(1, 3.0)]


def test_one_wild_stamp_does_not_poison_what_follows() -> None:
    rig = Rig()
    rig.tell(2**53, 0.0)
    rig.tell(1000, 1.0)
    rig.hold(1, 1050)
    rig.tell(1100, 1.0)
    assert rig.said() == [(1, 1.0)]


def test_waiting_is_bounded_in_bytes() -> None:
    rig = Rig(max_bytes=100)
    for number in range(1, 8):
        rig.hold(number, 1000, size=30)
    assert rig.said() == [(number, "no_room_to_wait") for number in (1, 2, 3, 4)]
    assert len(rig.resolution) == 3
    rig.hold(8, 1000, size=500)
    assert [number for number, _ in rig.said()] == [5, 6, 7]
    assert len(rig.resolution) == 1  # a single one is never too many


def test_what_waits_at_the_end_is_refused() -> None:
    rig = Rig()
    rig.hold(1, 1000)
    assert [s.error.reason for s in rig.resolution.finish() if s.error] == ["no_pose"]
    assert len(rig.resolution) == 0


def resolved(number: int, stamp_ms: int, x: float) -> ResolvedPose:
    return ResolvedPose("r1", "lidar", 5, number, stamp_ms * MS, "map", at(x))


def test_the_log_decides_when_and_with_which_pose() -> None:
    rig = Rig(logged=True)
    rig.hold(1, 1000)
    rig.tell(1000, 1.0)
    rig.hold(2, 1000)
    assert rig.said() == []
    rig.settled += rig.resolution.confirm(resolved(2, 1000, 1.25))
    rig.settled += rig.resolution.confirm(resolved(1, 1000, 1.125))
    rig.settled += rig.resolution.confirm(resolved(1, 1000, 9.0))  # it is gone
    assert rig.said() == [(2, 1.25), (1, 1.125)]


def test_where_the_log_ends_what_was_found_counts() -> None:
    """The service was killed before it could write it down."""
    rig = Rig(logged=True)
    rig.hold(1, 1000)
    rig.hold(2, 1001)
    rig.tell(1000, 1.0)
    rig.settled += rig.resolution.go_live()
    assert rig.said() == [(1, 1.0)]
    rig.tell(1002, 3.0)
    assert rig.said() == [(2, pytest.approx(2.0))]
    late = Rig(logged=True)
    late.hold(1, 1000)
    late.tell(1000, 1.0)
    late.settled += late.resolution.finish()
    assert late.said() == [(1, 1.0)]


class CountingMapper:
    """Which scans each update holds, with their poses."""

    def __init__(self) -> None:
        self.updates: list[list[tuple[str, int, float]]] = []
        self.changed_tiles: list[Any] = []
        self._scans: list[tuple[str, int, float]] = []

    def insert_all(self, scans: Sequence[Scan]) -> list[Any]:
        self._scans += [(s.robot, s.sequence, float(s.pose.position[0])) for s in scans]
        return [SimpleNamespace(points_stored=len(s.points), rejected={}) for s in scans]

    def update(self, timer: Any) -> MapUpdate:
        self.updates.append(sorted(self._scans))
        self._scans = []
        number = len(self.updates)
        return MapUpdate("map", number, number - 1, 0, (), (), ())


class Log:
    """Inputs at once; what is derived from them some messages later, in order."""

    def __init__(self) -> None:
        self.envelopes: list[Envelope] = []
        self.waiting: list[Envelope] = []

    def write(self, envelope: Envelope, message: Any) -> None:
        if not isinstance(message, Scan):
            self.waiting.append(envelope)

    def close(self) -> None:
        pass

    def flush(self) -> None:
        self.envelopes += self.waiting
        self.waiting = []


def pipeline_of(mapper: CountingMapper, sinks: list[Any], *, logged: bool) -> Pipeline:
    account = Account()
    admission = Admission(account, "map", 8.0, wait_ns=WAIT_NS, logged=logged)
    return Pipeline(mapper, admission, account, sinks, Outgoing("map", "map"))  # type: ignore[arg-type]


def message(robot: str, number: int, kind: str, stamp_ms: int) -> Envelope:
    if kind == "pose":
        transform = StampedTransform(stamp_ms * MS, "map", "lidar", at(stamp_ms * 0.001))
        schema, payload = encode(transform)
        key = topics.transforms_key("map", robot)
        return Envelope(key, schema, "protobuf", payload, stamp_ms * MS)
    scan = lone(number, stamp_ms, robot)[1]
    if kind == "whole":
        scan = replace(scan, frame_id="map", pose=at(7.0))
    schema, payload = encode(scan)
    key = topics.scan_key("map", robot, "lidar" if kind == "lone" else "front")
    return Envelope(key, schema, "protobuf", payload, scan.stamp_ns, 5, number)


@given(st.data())
@settings(max_examples=150, deadline=None, phases=(Phase.explicit, Phase.generate))
def test_a_replay_puts_every_scan_into_the_update_that_had_it(data: st.DataObject) -> None:
    """Two robots; scans whole, or apart from poses that come late or never; updates and writing at
    any moment."""
    kinds = st.sampled_from(["lone", "lone", "pose", "pose", "whole", "update", "flush"])
    steps = data.draw(
        st.lists(st.tuples(kinds, st.sampled_from(["r1", "r2"])), min_size=20, max_size=60)
    )
    log, live = Log(), CountingMapper()
    pipeline = pipeline_of(live, [log], logged=False)
    inbox: list[Envelope] = []  # recorded, not yet taken by the mapper
    for number, (kind, robot) in enumerate(steps, start=1):
        if kind == "flush":
            log.flush()
        elif kind == "update":
            taken, inbox = inbox, []
            pipeline.insert(*taken)
            if pipeline.is_stale:
                pipeline.update()
        else:
            stamp_ms = 1000 + 20 * number + data.draw(st.integers(-300, 300))
            envelope = message(robot, number, kind, stamp_ms)
            log.envelopes.append(envelope)
            inbox.append(envelope)
    log.flush()
    again = CountingMapper()
    replay = pipeline_of(again, [], logged=True)
    for batch in logged_cuts(filter(is_replayed, log.envelopes), lambda: True):
        for envelope in batch:
            replay.insert(envelope)
        if batch.revision:
            replay.update()
    assert again.updates == live.updates
    assert all(is_input(e) for e in inbox)
