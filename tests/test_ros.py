"""Poses and transforms of ROS 2, as `rosbags` serialises them."""

from __future__ import annotations

from contextlib import suppress
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

import ros_messages as ros
from examples import POSE, STAMP_NS
from facet_protocol import Envelope, ProtocolError, StampedPose, StampedTransform, Transforms
from facet_protocol.codec import decode
from facet_protocol.messages import Pose

NAN = Pose(np.array([np.nan, 0.0, 0.0]), POSE.orientation_xyzw)
UNSET = Pose(np.zeros(3), np.zeros(4))
MESSAGES = {
    "Odometry": ros.odometry(STAMP_NS, "odom", "base", POSE),
    "PoseStamped": ros.stamped_pose(STAMP_NS, "map", POSE),
    "PoseWithCovarianceStamped": ros.covariant_pose(STAMP_NS, "map", POSE),
    "TransformStamped": ros.transform(STAMP_NS, "/odom", "/base", POSE),
    "TFMessage": ros.transforms(
        ros.transform(STAMP_NS, "map", "odom", POSE), ros.transform(STAMP_NS, "odom", "base", POSE)
    ),
}
each = pytest.mark.parametrize("name", MESSAGES)
orders = pytest.mark.parametrize("little_endian", [True, False])


def envelope(message: Any, little_endian: bool = True) -> Envelope:
    return Envelope("/x", message.__msgtype__, "cdr", ros.cdr(message, little_endian))


def assert_same(pose: Pose, expected: Pose = POSE) -> None:
    assert pose.position.tobytes() == expected.position.tobytes()
    assert pose.orientation_xyzw.tobytes() == expected.orientation_xyzw.tobytes()


@each
@orders
def test_every_bit_of_a_pose_arrives(name: str, little_endian: bool) -> None:
    value = decode(envelope(MESSAGES[name], little_endian))
    if isinstance(value, StampedPose):
        assert (value.stamp_ns, value.frame_id) == (STAMP_NS, "map")
        assert_same(value.pose)
        return
    first = value.transforms[0] if isinstance(value, Transforms) else value
    assert isinstance(first, StampedTransform)
    frames = ("map", "odom") if isinstance(value, Transforms) else ("odom", "base")
    assert (first.stamp_ns, first.parent_frame_id, first.child_frame_id) == (STAMP_NS, *frames)
    assert_same(first.pose)


@each
@orders
def test_every_truncation_is_refused(name: str, little_endian: bool) -> None:
    whole = envelope(MESSAGES[name], little_endian)
    for end in range(len(whole.payload)):
        with pytest.raises(ProtocolError):
            decode(replace(whole, payload=whole.payload[:end]))


@each
@given(data=st.data())
def test_any_bytes_give_a_message_or_a_protocol_error(name: str, data: st.DataObject) -> None:
    whole = envelope(MESSAGES[name])
    payload = bytearray(whole.payload)
    for _ in range(data.draw(st.integers(1, 6))):
        payload[data.draw(st.integers(0, len(payload) - 1))] = data.draw(st.integers(0, 255))
    with suppress(ProtocolError):
        decode(replace(whole, payload=bytes(payload)))


def test_one_bad_transform_does_not_cost_the_others() -> None:
    parts = [
        ros.transform(STAMP_NS, "base", "arm", UNSET),
        ros.transform(STAMP_NS, "map", "odom", POSE),
        ros.transform(STAMP_NS, "odom", "base", NAN),
        ros.transform(STAMP_NS, "odom", "odom", POSE),
    ]
    value = decode(envelope(ros.transforms(*parts)))
    assert isinstance(value, Transforms)
    assert [t.child_frame_id for t in value.transforms] == ["odom"]
    assert value.refused == ("bad_quaternion", "bad_pose", "wrong_frame")


@pytest.mark.parametrize(
    ("message", "reason"),
    [
        (ros.odometry(STAMP_NS, "odom", "", POSE), "wrong_frame"),
        (ros.odometry(STAMP_NS, "odom", "base", NAN), "bad_pose"),
        (ros.transform(STAMP_NS, "odom", "base", UNSET), "bad_quaternion"),
        (ros.stamped_pose(STAMP_NS, "map", NAN), "bad_pose"),
    ],
)
def test_what_is_refused(message: Any, reason: str) -> None:
    with pytest.raises(ProtocolError) as caught:
        decode(envelope(message))
    assert caught.value.reason == reason


def test_nanoseconds_of_a_stamp_are_checked() -> None:
    message = ros.stamped_pose(STAMP_NS, "map", POSE)
    message.header.stamp.nanosec = 1_000_000_000
    with pytest.raises(ProtocolError) as caught:
        decode(envelope(message))
    assert caught.value.reason == "bad_stamp"
