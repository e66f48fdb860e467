"""Every schema in one table: what it carries, how it is encoded and decoded, its descriptor."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cache
from typing import Any

from foxglove_schemas_protobuf.FrameTransform_pb2 import FrameTransform
from foxglove_schemas_protobuf.FrameTransforms_pb2 import FrameTransforms
from foxglove_schemas_protobuf.LaserScan_pb2 import LaserScan
from foxglove_schemas_protobuf.PointCloud_pb2 import PointCloud
from foxglove_schemas_protobuf.PoseInFrame_pb2 import PoseInFrame
from foxglove_schemas_protobuf.SceneUpdate_pb2 import SceneUpdate
from google.protobuf.descriptor import FileDescriptor
from google.protobuf.descriptor_pb2 import FileDescriptorSet
from google.protobuf.message import Message as Protobuf

from facet_protocol import maps, poses, records, scans
from facet_protocol.messages import (
    Conflict,
    Corrected,
    Correction,
    Cut,
    Envelope,
    Erase,
    Events,
    LineFan,
    Loss,
    MapUpdate,
    Plane,
    ProtocolError,
    ResolvedPose,
    Scan,
    StampedPose,
    StampedTransform,
    Status,
    TilePoints,
    Transforms,
)
from facet_protocol.proto import map_pb2, service_pb2
from facet_protocol.ros import decode_ros_pose
from facet_protocol.ros_definitions import ROS_SCHEMAS, definition
from facet_protocol.topics import parse_scan_key

Message = (
    Scan
    | LineFan
    | StampedPose
    | StampedTransform
    | Transforms
    | MapUpdate
    | Plane
    | Events
    | TilePoints
    | Status
    | Cut
    | ResolvedPose
    | Correction
    | Corrected
    | Conflict
    | Erase
    | Loss
)


@dataclass(frozen=True, slots=True)
class Schema:
    """One row: `encode` takes a `value_type`; `decode` may give another (a LineFan comes back as
    a Scan)."""

    value_type: type[Any]
    encode: Callable[[Any], bytes]
    decode: Callable[[Envelope], Message]
    protobuf: type[Protobuf]

    @property
    def descriptor(self) -> bytes:
        """FileDescriptorSet with everything it imports, as MCAP wants it."""
        return descriptor_set(self.protobuf.DESCRIPTOR.full_name)


def _decode_scan(envelope: Envelope) -> Scan:
    key = parse_scan_key(envelope.key)
    return scans.decode_scan(envelope, key.robot, key.sensor)


def _row(
    value_type: type[Any],
    encode: Callable[[Any], bytes],
    decode: Callable[[bytes | memoryview], Message],
    protobuf: type[Protobuf],
) -> Schema:
    return Schema(value_type, encode, lambda envelope: decode(envelope.payload), protobuf)


SCHEMAS: dict[str, Schema] = {
    "foxglove.PointCloud": Schema(Scan, scans.encode_cloud, _decode_scan, PointCloud),
    "foxglove.LaserScan": Schema(LineFan, scans.encode_fan, _decode_scan, LaserScan),
    "foxglove.PoseInFrame": _row(
        StampedPose, poses.encode_stamped_pose, poses.decode_stamped_pose, PoseInFrame
    ),
    "foxglove.FrameTransform": _row(
        StampedTransform, poses.encode_transform, poses.decode_transform, FrameTransform
    ),
    "foxglove.FrameTransforms": _row(
        Transforms, poses.encode_transforms, poses.decode_transforms, FrameTransforms
    ),
    "facet.v1.MapUpdate": _row(
        MapUpdate, maps.encode_update, maps.decode_update, map_pb2.MapUpdate
    ),
    "facet.v1.Plane": _row(Plane, maps.encode_plane, maps.decode_plane, map_pb2.Plane),
    "facet.v1.Events": _row(Events, maps.encode_events, maps.decode_events, map_pb2.Events),
    "facet.v1.TilePoints": _row(TilePoints, maps.encode_tile, maps.decode_tile, map_pb2.TilePoints),
    "facet.v1.Status": _row(
        Status, records.encode_status, records.decode_status, service_pb2.Status
    ),
    "facet.v1.Cut": _row(Cut, records.encode_cut, records.decode_cut, service_pb2.Cut),
    "facet.v1.ResolvedPose": _row(
        ResolvedPose, records.encode_resolved, records.decode_resolved, service_pb2.ResolvedPose
    ),
    "facet.v1.Correction": _row(
        Correction, records.encode_correction, records.decode_correction, service_pb2.Correction
    ),
    "facet.v1.Corrected": _row(
        Corrected, records.encode_corrected, records.decode_corrected, service_pb2.Corrected
    ),
    "facet.v1.Conflict": _row(
        Conflict, records.encode_conflict, records.decode_conflict, service_pb2.Conflict
    ),
    "facet.v1.Erase": _row(Erase, records.encode_erase, records.decode_erase, service_pb2.Erase),
    "facet.v1.Loss": _row(Loss, records.encode_loss, records.decode_loss, service_pb2.Loss),
}

_BY_TYPE = {row.value_type: name for name, row in SCHEMAS.items()}
_OUTPUT_ONLY: dict[str, type[Protobuf]] = {"foxglove.SceneUpdate": SceneUpdate}


def encode(message: Message) -> tuple[str, bytes]:
    """(schema, payload). The same value gives the same bytes."""
    name = _BY_TYPE[type(message)]
    return name, SCHEMAS[name].encode(message)


def decode(envelope: Envelope) -> Message:
    """The value in `envelope`. Raises ProtocolError, and nothing else, whatever the bytes.

    A scan takes robot and sensor from a native key, and the default reach; `decode_scan` is told.
    Scans of ROS have no pose: they are for `decode_scan` alone.
    """
    if envelope.encoding == "cdr":
        return decode_ros_pose(envelope)
    row = SCHEMAS.get(envelope.schema)
    if row is None or envelope.encoding != "protobuf":
        text = f"schema {envelope.schema[:80]!r} in encoding {envelope.encoding[:20]!r}"
        raise ProtocolError(f"{text} is unknown", "unknown_schema")
    return row.decode(envelope)


def _file_set(*roots: type[Protobuf]) -> bytes:
    """FileDescriptorSet of the files of `roots`, each after the files that it imports."""
    result, seen = FileDescriptorSet(), set[str]()

    def add(file: FileDescriptor) -> None:
        if file.name in seen:
            return
        seen.add(file.name)
        for dependency in file.dependencies:
            add(dependency)
        file.CopyToProto(result.file.add())

    for root in roots:
        add(root.DESCRIPTOR.file)  # type: ignore[arg-type]  # upb's class is the same to us
    return result.SerializeToString(deterministic=True)


@cache
def descriptor_set(schema: str) -> bytes:
    """FileDescriptorSet bytes of any schema we write. Raises ProtocolError when it is not ours."""
    if schema in SCHEMAS:
        return _file_set(SCHEMAS[schema].protobuf)
    if schema in _OUTPUT_ONLY:
        return _file_set(_OUTPUT_ONLY[schema])
    raise ProtocolError(f"schema {schema[:80]!r} is unknown", "unknown_schema")


def schema_text(schema: str) -> tuple[str, bytes]:
    """(encoding, data) of a schema as MCAP wants it. Raises ProtocolError when it is not known."""
    if schema in ROS_SCHEMAS:
        return "ros2msg", definition(schema).encode()
    return "protobuf", descriptor_set(schema)


def facet_descriptors() -> bytes:
    """FileDescriptorSet of everything under facet.v1: what the queryable `schema` answers."""
    return _file_set(map_pb2.MapUpdate, service_pb2.Status)
