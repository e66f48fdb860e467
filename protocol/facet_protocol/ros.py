"""ROS 2 messages from CDR: scans, poses and transforms as the values of `messages`. Reading only.

Field order: sensor_msgs, nav_msgs, geometry_msgs and tf2_msgs of ROS 2 Humble to Kilted.
"""

from __future__ import annotations

from typing import NamedTuple

from facet_protocol import ros_definitions as names
from facet_protocol.cdr import CdrReader
from facet_protocol.messages import (
    Envelope,
    Pose,
    ProtocolError,
    StampedPose,
    StampedTransform,
    Transforms,
)
from facet_protocol.wire import check_pose, stamp_of_parts

_TRANSFORM_BYTES = 4 + 4 + 4 + 4 + 7 * 8  # the least that a TransformStamped takes


class Header(NamedTuple):
    stamp_ns: int
    frame_id: str


def read_header(reader: CdrReader) -> Header:
    """std_msgs/Header; a frame is named without the slash that ROS 1 put before it."""
    seconds, nanos = reader.numbers("iI")
    frame_id = reader.string().removeprefix("/")
    return Header(stamp_of_parts(int(seconds), int(nanos)), frame_id)


def _read_pose(reader: CdrReader) -> Pose:
    numbers = reader.numbers("7d")
    return check_pose(numbers[:3], numbers[3:])[0]


def _skip_covariance(reader: CdrReader) -> None:
    reader.numbers("36d")


def decode_stamped_pose(payload: bytes | memoryview, schema: str) -> StampedPose:
    """PoseStamped or PoseWithCovarianceStamped."""
    reader = CdrReader(payload, schema)
    header = read_header(reader)
    pose = _read_pose(reader)
    if schema == names.POSE_WITH_COVARIANCE:
        _skip_covariance(reader)
    reader.end()
    return StampedPose(header.stamp_ns, header.frame_id, pose)


def decode_odometry(payload: bytes | memoryview) -> StampedTransform:
    """nav_msgs/Odometry: its pose is that of the child frame. The twist is not used."""
    reader = CdrReader(payload, names.ODOMETRY)
    header = read_header(reader)
    child = reader.string().removeprefix("/")
    pose = _read_pose(reader)
    _skip_covariance(reader)
    reader.numbers("6d")
    _skip_covariance(reader)
    reader.end()
    return _transform(header, child, pose)


def _read_transform(reader: CdrReader) -> StampedTransform | ProtocolError:
    """TransformStamped; the error in it, when its bytes are whole and its values are not."""
    header = read_header(reader)
    child = reader.string().removeprefix("/")
    numbers = reader.numbers("7d")
    try:
        return _transform(header, child, check_pose(numbers[:3], numbers[3:])[0])
    except ProtocolError as error:
        return error


def _transform(header: Header, child: str, pose: Pose) -> StampedTransform:
    if not header.frame_id or not child or child == header.frame_id:
        text = f"a transform from {child[:80]!r} to {header.frame_id[:80]!r}"
        raise ProtocolError(text, "wrong_frame")
    return StampedTransform(header.stamp_ns, header.frame_id, child, pose)


def decode_transform(payload: bytes | memoryview) -> StampedTransform:
    """geometry_msgs/TransformStamped."""
    reader = CdrReader(payload, names.TRANSFORM)
    transform = _read_transform(reader)
    reader.end()
    if isinstance(transform, ProtocolError):
        raise transform
    return transform


def decode_transforms(payload: bytes | memoryview) -> Transforms:
    """tf2_msgs/TFMessage; what is no good transform is left out, and its reason kept: a joint that
    was never set does not cost the robot its pose."""
    reader = CdrReader(payload, names.TRANSFORMS)
    read = [_read_transform(reader) for _ in range(reader.count(_TRANSFORM_BYTES))]
    reader.end()
    good = tuple(t for t in read if isinstance(t, StampedTransform))
    refused = tuple(t.reason for t in read if isinstance(t, ProtocolError))
    return Transforms(good, refused)


def decode_ros_pose(envelope: Envelope) -> StampedPose | StampedTransform | Transforms:
    """Whatever says where something is. Raises ProtocolError, and nothing else."""
    schema, payload = envelope.schema, envelope.payload
    if schema == names.TRANSFORMS:
        return decode_transforms(payload)
    if schema == names.TRANSFORM:
        return decode_transform(payload)
    if schema == names.ODOMETRY:
        return decode_odometry(payload)
    if schema in names.ROS_POSES:
        return decode_stamped_pose(payload, schema)
    raise ProtocolError(f"{schema[:80]!r} says no pose", "unknown_schema")
