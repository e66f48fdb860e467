"""Scans: foxglove.PointCloud and LaserScan both ways, with the pose inside; those of ROS 2 in."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from foxglove_schemas_protobuf.LaserScan_pb2 import LaserScan
from foxglove_schemas_protobuf.PointCloud_pb2 import PointCloud

from facet_protocol.cloud import DATA_FIELD, pack_points, read_layout, read_points, split_beams
from facet_protocol.messages import (
    IDENTITY,
    Envelope,
    LineFan,
    Pose,
    ProtocolError,
    Scan,
    ScanKind,
)
from facet_protocol.poses import pose_message, pose_of
from facet_protocol.projection import MAX_ANGLE, count_ignored, project_fan
from facet_protocol.ros_definitions import ROS_SCANS
from facet_protocol.ros_scans import decode_ros_scan
from facet_protocol.wire import split_bytes_field, split_doubles_field, stamp_of, timestamp_of

CLOUD_SCHEMA = "foxglove.PointCloud"
FAN_SCHEMA = "foxglove.LaserScan"
SCAN_SCHEMAS = (CLOUD_SCHEMA, FAN_SCHEMA, *ROS_SCANS)
RANGES_FIELD = LaserScan.RANGES_FIELD_NUMBER
REACH_M = 8.0  # how far a line beam that came back empty counts as free, unless the map says so


class _Head(NamedTuple):
    stamp_ns: int
    frame_id: str
    pose: Pose
    renormalised: bool
    has_pose: bool = True


def _head(
    message: PointCloud | LaserScan, envelope: Envelope, frame_id: str | None, pose_required: bool
) -> _Head:
    """Stamp, frame and pose, checked; the stamp is the envelope's where the message has none."""
    if frame_id is not None and message.frame_id != frame_id:
        text = f"frame_id is {message.frame_id[:80]!r}, expected {frame_id!r}"
        raise ProtocolError(f"{envelope.schema}: {text}", "wrong_frame")
    has_stamp = message.HasField("timestamp")
    stamp_ns = stamp_of(message.timestamp) if has_stamp else envelope.stamp_ns
    if message.HasField("pose"):
        return _Head(stamp_ns, message.frame_id, *pose_of(message.pose))
    if pose_required:
        raise ProtocolError(f"{envelope.schema}: no pose", "bad_pose")
    return _Head(stamp_ns, message.frame_id, IDENTITY, False, has_pose=False)


def decode_scan(
    envelope: Envelope,
    robot: str,
    sensor: str,
    reach_m: float = REACH_M,
    *,
    frame_id: str | None = None,
    pose_required: bool = True,
) -> Scan:
    """The scan in `envelope`; its points may be a view of the payload (see `read_points`).

    Raises ProtocolError: malformed, bad_layout, bad_pose, bad_quaternion, bad_stamp, wrong_frame
    (when `frame_id` is given and differs), bad_length, unknown_schema. With `pose_required` False a
    scan without a pose, as ROS has them all, is taken at its own frame's origin, for a caller that
    will place it.
    """
    kind = (envelope.schema, envelope.encoding)
    if kind == (CLOUD_SCHEMA, "protobuf"):
        return _decode_cloud(envelope, robot, sensor, frame_id, pose_required)
    if kind == (FAN_SCHEMA, "protobuf"):
        fan, head = _decode_fan(envelope, robot, sensor, frame_id, pose_required)
        return project(fan, reach_m, head.renormalised, head.has_pose)
    if envelope.schema in ROS_SCANS and envelope.encoding == "cdr":
        if pose_required:
            raise ProtocolError(f"{envelope.schema}: no pose", "bad_pose")
        return decode_ros_scan(envelope, robot, sensor, reach_m)
    text = f"schema {envelope.schema[:80]!r} in encoding {envelope.encoding[:20]!r}"
    raise ProtocolError(f"{text} is not a scan", "unknown_schema")


def _decode_cloud(
    envelope: Envelope, robot: str, sensor: str, frame_id: str | None, pose_required: bool
) -> Scan:
    message, data = split_bytes_field(PointCloud, envelope.payload, DATA_FIELD)
    head = _head(message, envelope, frame_id, pose_required)
    layout = read_layout(message, len(data))
    points, no_return = split_beams(layout, data, read_points(layout, data))
    return Scan(
        robot=robot,
        sensor=sensor,
        epoch=envelope.epoch,
        sequence=envelope.sequence,
        stamp_ns=head.stamp_ns,
        frame_id=head.frame_id,
        kind=ScanKind.CLOUD,
        pose=head.pose,
        points=points,
        no_return=no_return,
        renormalised=head.renormalised,
        has_pose=head.has_pose,
    )


def _decode_fan(
    envelope: Envelope, robot: str, sensor: str, frame_id: str | None, pose_required: bool
) -> tuple[LineFan, _Head]:
    message, ranges = split_doubles_field(LaserScan, envelope.payload, RANGES_FIELD)
    if ranges is None:
        ranges = np.fromiter(message.ranges, np.float64, len(message.ranges))
    head = _head(message, envelope, frame_id, pose_required)
    start, end = message.start_angle, message.end_angle
    if not (abs(start) <= MAX_ANGLE and abs(end) <= MAX_ANGLE):
        raise ProtocolError(f"foxglove.LaserScan: angles {start} to {end} rad", "bad_layout")
    fan = LineFan(
        robot=robot,
        sensor=sensor,
        epoch=envelope.epoch,
        sequence=envelope.sequence,
        stamp_ns=head.stamp_ns,
        frame_id=head.frame_id,
        pose=head.pose,
        start_angle=start,
        end_angle=end,
        ranges=ranges,
    )
    return fan, head


def project(
    fan: LineFan, reach_m: float = REACH_M, renormalised: bool = False, has_pose: bool = True
) -> Scan:
    """The fan as points in the sensor's x-y plane."""
    points, no_return = project_fan(fan.start_angle, fan.end_angle, fan.ranges, reach_m)
    is_whole = len(points) + len(no_return) == len(fan.ranges)
    return Scan(
        robot=fan.robot,
        sensor=fan.sensor,
        epoch=fan.epoch,
        sequence=fan.sequence,
        stamp_ns=fan.stamp_ns,
        frame_id=fan.frame_id,
        kind=ScanKind.LINE,
        pose=fan.pose,
        points=points,
        no_return=no_return,
        ignored={} if is_whole else count_ignored(fan.ranges),
        renormalised=renormalised,
        has_pose=has_pose,
    )


def encode_cloud(scan: Scan) -> bytes:
    """foxglove.PointCloud. A projected line scan has no way back: encode its LineFan instead."""
    if scan.kind is not ScanKind.CLOUD:
        raise ProtocolError("a line scan is encoded from its LineFan", "unknown_schema")
    stride, fields, data = pack_points(scan.points, scan.no_return)
    return PointCloud(
        timestamp=timestamp_of(scan.stamp_ns),
        frame_id=scan.frame_id,
        pose=pose_message(scan.pose),
        point_stride=stride,
        fields=fields,
        data=data,
    ).SerializeToString(deterministic=True)


def encode_fan(fan: LineFan) -> bytes:
    return LaserScan(
        timestamp=timestamp_of(fan.stamp_ns),
        frame_id=fan.frame_id,
        pose=pose_message(fan.pose),
        start_angle=float(fan.start_angle),
        end_angle=float(fan.end_angle),
        ranges=np.asarray(fan.ranges, dtype=np.float64).tolist(),
    ).SerializeToString(deterministic=True)


def encode_scan(scan: Scan | LineFan) -> tuple[str, bytes]:
    """(schema, payload)."""
    if isinstance(scan, LineFan):
        return FAN_SCHEMA, encode_fan(scan)
    return CLOUD_SCHEMA, encode_cloud(scan)
