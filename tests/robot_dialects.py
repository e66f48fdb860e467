"""One robot in every dialect: the scans of a small room, their poses apart from them."""

from __future__ import annotations

import struct
import zlib
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
import zenoh
import zenoh.ext

import ros_messages as ros
from facet_protocol import attachment, topics
from facet_protocol.codec import encode
from facet_protocol.messages import Pose, Scan, StampedPose, StampedTransform, Transforms
from rig import room_scan

HASH = "RIHS01_9198cabf7da3796ae6fe19c4cb3bdd3525492988c70522628af5daa124bae2b5"
STILL = Pose(np.zeros(3), np.array([0.0, 0.0, 0.0, 1.0]))
CLOUD, TF = "sensor_msgs/msg/PointCloud2", "tf2_msgs/msg/TFMessage"


def static_chain() -> Any:
    """map <- odom and base <- lidar; what moves lies between."""
    return ros.transforms(
        ros.transform(0, "map", "odom", STILL), ros.transform(0, "base", "lidar", STILL)
    )


def moving(scan: Scan) -> Any:
    return ros.transforms(ros.transform(scan.stamp_ns, "odom", "base", scan.pose))


def cloud(scan: Scan) -> Any:
    return ros.cloud(scan.stamp_ns, "lidar", scan.points)


@dataclass(frozen=True)
class Put:
    """One sample: what a robot puts on a key."""

    key: str
    payload: bytes
    encoding: str = "zenoh/bytes"
    attachment: bytes | None = None


def rmw_attachment(sequence: int, stamp_ns: int, *, named: bool = True) -> bytes:
    """As rmw_zenoh serialises it; `named`: with the names of its values."""
    names = [b"\x0fsequence_number", b"\x10source_timestamp", b"\x0asource_gid"]
    values = [struct.pack("<q", sequence), struct.pack("<q", stamp_ns), b"\x10" + b"g" * 16]
    return b"".join(n * named + v for n, v in zip(names, values, strict=True))


GID_EPOCH = zlib.crc32(b"g" * 16)


def dds_name(schema: str) -> str:
    package, _, name = schema.split("/")
    return f"{package}::msg::dds_::{name}_"


def rmw_zenoh(scan: Scan) -> list[Put]:
    """A"""
    mark = rmw_attachment(scan.sequence, scan.stamp_ns)
    return [
        Put(f"0/points/{dds_name(CLOUD)}/{HASH}", ros.cdr(cloud(scan)), attachment=mark),
        Put(f"0/tf/{dds_name(TF)}/{HASH}", ros.cdr(moving(scan)), attachment=mark),
    ]


def bridge(scan: Scan) -> list[Put]:
    """B"""
    return [Put("r1/points", ros.cdr(cloud(scan))), Put("r1/tf", ros.cdr(moving(scan)))]


def tagged(scan: Scan) -> list[Put]:
    """C"""
    return [
        Put("rt/points", ros.cdr(cloud(scan)), f"application/cdr;{CLOUD}"),
        Put("rt/tf", ros.cdr(moving(scan), False), f"application/cdr;{TF}"),
    ]


def sensor_cloud(scan: Scan) -> bytes:
    """foxglove.PointCloud in the sensor's own frame."""
    nowhere = Scan(
        **{name: getattr(scan, name) for name in scan.__dataclass_fields__}
        | {"frame_id": "lidar", "pose": STILL}
    )
    return encode(nowhere)[1]


def protobuf(scan: Scan) -> list[Put]:
    """D"""
    transform = StampedTransform(scan.stamp_ns, "odom", "base", scan.pose)
    kind = "application/protobuf;foxglove"
    return [
        Put("yard/points", sensor_cloud(scan), f"{kind}.PointCloud"),
        Put("yard/tf", encode(Transforms((transform,)))[1], f"{kind}.FrameTransforms"),
    ]


def ruled(scan: Scan) -> list[Put]:
    """E: a cloud wrapped in another message, and a pose that does not say of what."""
    inner = sensor_cloud(scan)
    wrapped = b"\x0a\x03abc\x12" + _varint(len(inner)) + inner
    pose = encode(StampedPose(scan.stamp_ns, "odom", scan.pose))[1]
    return [Put("odd/sensor/7", wrapped), Put("odd/pose", pose)]


def _varint(number: int) -> bytes:
    out = b""
    while number > 0x7F:
        out, number = out + bytes([number & 0x7F | 0x80]), number >> 7
    return out + bytes([number])


def native(scan: Scan) -> list[Put]:
    """Facet's own keys, the pose apart."""
    mark = attachment.pack(5, scan.sequence, scan.stamp_ns)
    kind = "application/protobuf;foxglove"
    pose = encode(StampedPose(scan.stamp_ns, "odom", scan.pose))[1]
    return [
        Put(topics.scan_key("map", "r1", "lidar"), sensor_cloud(scan), f"{kind}.PointCloud", mark),
        Put(topics.pose_key("map", "r1", "base"), pose, f"{kind}.PoseInFrame"),
    ]


DIALECTS = {
    "rmw_zenoh": rmw_zenoh,
    "bridge": bridge,
    "tagged": tagged,
    "protobuf": protobuf,
    "ruled": ruled,
    "native": native,
}
STATIC: dict[str, Put] = {
    "rmw_zenoh": Put(f"0/tf_static/{dds_name(TF)}/{HASH}", ros.cdr(static_chain())),
    "bridge": Put("r1/tf_static", ros.cdr(static_chain())),
    "tagged": Put("rt/tf_static", ros.cdr(static_chain()), f"application/cdr;{TF}"),
}
_CHAIN = Transforms(
    (StampedTransform(0, "map", "odom", STILL), StampedTransform(0, "base", "lidar", STILL))
)
for _name, _key in (
    ("protobuf", "yard/tf_static"),
    ("ruled", "odd/tf_static"),
    ("native", topics.transforms_key("map", "r1", static=True)),
):
    STATIC[_name] = Put(_key, encode(_CHAIN)[1], "application/protobuf;foxglove.FrameTransforms")

RULES = [
    {"key": "odd/sensor/*", "type": "foxglove.PointCloud", "envelope_field": 2},
    {"key": "odd/pose", "type": "foxglove.PoseInFrame", "frame": "base"},
]


def tokens() -> list[str]:
    """What a bridge says of the keys it publishes."""
    types = {"r1/points": CLOUD, "r1/tf": TF, "r1/tf_static": TF}
    names = {key.replace("/", "§"): kind.replace("/", "§") for key, kind in types.items()}
    return [f"@/f00d/@ros2_lv/MP/{key}/{kind}/::10,5:1:::" for key, kind in names.items()]


def publish_static(session: zenoh.Session, put: Put) -> Any:
    """Transient local: who comes late gets it too."""
    publisher = zenoh.ext.declare_advanced_publisher(
        session,
        put.key,
        cache=zenoh.ext.CacheConfig(max_samples=4),
        publisher_detection=True,
    )
    publisher.put(put.payload, encoding=put.encoding)
    return publisher


def scans(num: int) -> Iterator[Scan]:
    return (room_scan(k) for k in range(1, num + 1))
