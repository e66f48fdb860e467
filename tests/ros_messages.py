"""ROS 2 messages and recordings as `rosbags` writes them: an implementation that is not ours."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np
from rosbags.rosbag2 import StoragePlugin, Writer
from rosbags.typesys import Stores, get_typestore

from facet_protocol.messages import Pose

STORE = get_typestore(Stores.ROS2_HUMBLE)
T = STORE.types
FLOAT32, FLOAT64 = 7, 8


def header(stamp_ns: int, frame_id: str) -> Any:
    seconds, nanos = divmod(stamp_ns, 10**9)
    stamp = T["builtin_interfaces/msg/Time"](sec=seconds, nanosec=nanos)
    return T["std_msgs/msg/Header"](stamp=stamp, frame_id=frame_id)


def field(name: str, offset: int, datatype: int = FLOAT32, count: int = 1) -> Any:
    return T["sensor_msgs/msg/PointField"](name=name, offset=offset, datatype=datatype, count=count)


def cloud(stamp_ns: int, frame_id: str, points: np.ndarray[Any, Any], **other: Any) -> Any:
    """A PointCloud2 of (N, 3) float32; `other` values replace those of the message."""
    values = {
        "header": header(stamp_ns, frame_id),
        "height": 1,
        "width": len(points),
        "fields": [field(axis, 4 * k) for k, axis in enumerate("xyz")],
        "is_bigendian": False,
        "point_step": 12,
        "row_step": 12 * len(points),
        "data": np.frombuffer(np.asarray(points, "<f4").tobytes(), np.uint8),
        "is_dense": True,
    }
    return T["sensor_msgs/msg/PointCloud2"](**{**values, **other})


def fan(stamp_ns: int, frame_id: str, ranges: Iterable[float], **other: Any) -> Any:
    ranges = np.array(list(ranges), np.float32)
    values = {
        "header": header(stamp_ns, frame_id),
        "angle_min": -1.0,
        "angle_max": 1.0,
        "angle_increment": 2.0 / max(1, len(ranges) - 1),
        "time_increment": 0.0,
        "scan_time": 0.1,
        "range_min": 0.1,
        "range_max": 30.0,
        "ranges": ranges,
        "intensities": np.zeros(0, np.float32),
    }
    return T["sensor_msgs/msg/LaserScan"](**{**values, **other})


def vector(kind: str, xyz: Iterable[float]) -> Any:
    x, y, z = (float(c) for c in xyz)
    return T[f"geometry_msgs/msg/{kind}"](x=x, y=y, z=z)


def quaternion(pose: Pose) -> Any:
    x, y, z, w = (float(c) for c in pose.orientation_xyzw)
    return T["geometry_msgs/msg/Quaternion"](x=x, y=y, z=z, w=w)


def transform(stamp_ns: int, parent: str, child: str, pose: Pose) -> Any:
    rigid = T["geometry_msgs/msg/Transform"](
        translation=vector("Vector3", pose.position), rotation=quaternion(pose)
    )
    kind = T["geometry_msgs/msg/TransformStamped"]
    return kind(header=header(stamp_ns, parent), child_frame_id=child, transform=rigid)


def transforms(*parts: Any) -> Any:
    return T["tf2_msgs/msg/TFMessage"](transforms=list(parts))


def pose_message(pose: Pose) -> Any:
    kind = T["geometry_msgs/msg/Pose"]
    return kind(position=vector("Point", pose.position), orientation=quaternion(pose))


def with_covariance(pose: Pose) -> Any:
    kind = T["geometry_msgs/msg/PoseWithCovariance"]
    return kind(pose=pose_message(pose), covariance=np.arange(36.0))


def odometry(stamp_ns: int, parent: str, child: str, pose: Pose) -> Any:
    zero = vector("Vector3", (0, 0, 0))
    twist = T["geometry_msgs/msg/TwistWithCovariance"](
        twist=T["geometry_msgs/msg/Twist"](linear=zero, angular=zero), covariance=np.zeros(36)
    )
    kind = T["nav_msgs/msg/Odometry"]
    parts = {"header": header(stamp_ns, parent), "child_frame_id": child}
    return kind(**parts, pose=with_covariance(pose), twist=twist)


def stamped_pose(stamp_ns: int, frame_id: str, pose: Pose) -> Any:
    kind = T["geometry_msgs/msg/PoseStamped"]
    return kind(header=header(stamp_ns, frame_id), pose=pose_message(pose))


def covariant_pose(stamp_ns: int, frame_id: str, pose: Pose) -> Any:
    kind = T["geometry_msgs/msg/PoseWithCovarianceStamped"]
    return kind(header=header(stamp_ns, frame_id), pose=with_covariance(pose))


def cdr(message: Any, little_endian: bool = True) -> bytes:
    return bytes(STORE.serialize_cdr(message, message.__msgtype__, little_endian=little_endian))


def write_bag(folder: Path, messages: Iterable[tuple[str, int, Any]]) -> Path:
    """A rosbag2 recording (MCAP) of (topic, receipt in ns, message); the path of its file."""
    with Writer(folder, version=9, storage_plugin=StoragePlugin.MCAP) as bag:
        connections: dict[str, Any] = {}
        for topic, received_ns, message in messages:
            if topic not in connections:
                kind = message.__msgtype__
                connections[topic] = bag.add_connection(topic, kind, typestore=STORE)
            bag.write(connections[topic], received_ns, cdr(message))
    (path,) = folder.glob("*.mcap")
    return path
