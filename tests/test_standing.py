"""What an admission knows besides the map survives a checkpoint: frames, and scans that wait."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from facet.admission import Admission
from facet.placement import Admitted
from facet.status import Account
from facet_protocol import topics
from facet_protocol.codec import encode
from facet_protocol.messages import Envelope, Pose, StampedTransform, Transforms
from rig import PERIOD_NS, START_NS, room_scan, scan_envelope

NOWHERE = Path("nowhere")  # where the log would lie


def pose(x: float) -> Pose:
    return Pose(np.array([x, 0.25, 0.0]), np.array([0.0, 0.0, 0.6, 0.8]))


def tf(stamp_ns: int, parent: str, child: str, x: float, *, static: bool = False) -> Envelope:
    message = Transforms((StampedTransform(stamp_ns, parent, child, pose(x)),))
    schema, payload = encode(message)
    key = topics.transforms_key("map", "r1", static=static)
    return Envelope(key, schema, "protobuf", payload, stamp_ns=stamp_ns)


def lone_scan(number: int) -> Envelope:
    """In its sensor's frame."""
    return scan_envelope(replace(room_scan(number), frame_id="lidar"))


def admission() -> Admission:
    return Admission(Account(), "map", 8.0)


def again(one: Admission) -> Admission:
    """The same from its arrays, which a file could hold."""
    other = admission()
    other.thaw({name: np.array(array) for name, array in one.freeze().items()}, NOWHERE)
    return other


def told(admitted: list[Admitted]) -> list[tuple[Any, ...]]:
    return [
        (a.scan.sequence, a.scan.pose.position.tobytes(), a.scan.pose.orientation_xyzw.tobytes())
        for a in admitted
    ]


def stamp(number: float) -> int:
    return START_NS + int(number * PERIOD_NS)


def test_a_scan_that_waits_gets_its_pose_after_the_resume() -> None:
    one = admission()
    one.admit(tf(stamp(0), "base", "lidar", 0.5, static=True))
    one.admit(tf(stamp(0.5), "map", "base", 1.0))
    assert one.admit(lone_scan(1)) == []
    assert one.num_waiting == 1
    other = again(one)
    assert other.num_waiting == 1
    late = tf(stamp(1.5), "map", "base", 2.0)
    first, second = told(one.admit(late)), told(other.admit(late))
    assert len(first) == 1
    assert first == second
    assert other.num_waiting == 0


def test_what_was_heard_once_is_known_for_ever() -> None:
    """A static transform is not sent again."""
    one = admission()
    one.admit(tf(stamp(0), "base", "lidar", 0.5, static=True))
    for k in range(5):
        one.admit(tf(stamp(k), "map", "base", float(k)))
    other = again(again(one))
    scan = lone_scan(3)
    assert told(other.admit(scan)) == told(one.admit(scan)) != []
    assert one.freeze()["resolution"].tobytes() == other.freeze()["resolution"].tobytes()


def test_duplicates_are_known_also_of_what_waits() -> None:
    one = admission()
    one.admit(tf(stamp(0.5), "map", "lidar", 1.0))
    one.admit(lone_scan(1))
    other = again(one)
    assert other.admit(lone_scan(1)) == []
    assert other.num_waiting == 1


def test_nothing_is_frozen_of_one_that_knows_nothing() -> None:
    assert again(admission()).num_waiting == 0


@pytest.mark.parametrize("name", ["resolution", "lengths", "samples", "ledger", "payload_bytes"])
def test_what_lacks_is_refused(name: str) -> None:
    one = admission()
    one.admit(tf(stamp(0.5), "map", "lidar", 1.0))
    one.admit(lone_scan(1))
    frozen = one.freeze()
    admission().thaw(frozen, NOWHERE)
    with pytest.raises((KeyError, ValueError, TypeError)):
        admission().thaw({k: v for k, v in frozen.items() if k != name}, NOWHERE)
    with pytest.raises((KeyError, ValueError, TypeError)):
        admission().thaw({**frozen, name: frozen[name][:0]}, NOWHERE)
