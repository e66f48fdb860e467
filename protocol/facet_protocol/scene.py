"""The map as Foxglove draws it: outlines of planes, and voxels as a cloud. Output only."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np
from foxglove_schemas_protobuf.Color_pb2 import Color
from foxglove_schemas_protobuf.KeyValuePair_pb2 import KeyValuePair
from foxglove_schemas_protobuf.LinePrimitive_pb2 import LinePrimitive
from foxglove_schemas_protobuf.PackedElementField_pb2 import PackedElementField
from foxglove_schemas_protobuf.PointCloud_pb2 import PointCloud
from foxglove_schemas_protobuf.SceneEntity_pb2 import SceneEntity
from foxglove_schemas_protobuf.SceneEntityDeletion_pb2 import SceneEntityDeletion
from foxglove_schemas_protobuf.SceneUpdate_pb2 import SceneUpdate
from numpy.typing import NDArray

from facet_protocol.messages import IDENTITY, HoleKind, MapUpdate, Plane, PlaneClass, TilePoints
from facet_protocol.poses import pose_message
from facet_protocol.wire import timestamp_of

SCENE_SCHEMA = "foxglove.SceneUpdate"
OUTLINE_PX = 2.0

RGBA = tuple[float, float, float, float]
CLASS_COLOURS: dict[PlaneClass, RGBA] = {
    PlaneClass.FLOOR: (0.35, 0.60, 0.35, 1.0),
    PlaneClass.CEILING: (0.55, 0.55, 0.70, 1.0),
    PlaneClass.WALL: (0.85, 0.55, 0.25, 1.0),
    PlaneClass.OTHER: (0.60, 0.40, 0.65, 1.0),
}
HOLE_COLOURS: dict[HoleKind, RGBA] = {
    HoleKind.OPENING: (0.20, 0.70, 0.90, 1.0),
    HoleKind.UNOBSERVED: (0.50, 0.50, 0.50, 1.0),
}
_POINTS = LinePrimitive.DESCRIPTOR.fields_by_name["points"].number
_POINT_SIZE = 27  # bytes of a Point3: x, y, z, each a tag and a float64
_POINT = np.dtype(
    [
        ("field", "u1"), ("size", "u1"),
        ("x_field", "u1"), ("x", "<f8"), ("y_field", "u1"), ("y", "<f8"),
        ("z_field", "u1"), ("z", "<f8"),
    ]
)  # fmt: skip
_IDENTITY = pose_message(IDENTITY)


def _points_field(xyz: NDArray[np.float64]) -> bytes:
    """The points (N, 3) of a LinePrimitive as they are on the wire: a scene has ten thousand, and
    to make as many messages one by one takes ten times as long as to read them from here."""
    rows = np.empty(len(xyz), _POINT)
    rows["field"], rows["size"] = _POINTS << 3 | 2, _POINT_SIZE  # 2: length-delimited
    for number, axis in enumerate("xyz", start=1):
        rows[f"{axis}_field"], rows[axis] = number << 3 | 1, xyz[:, number - 1]  # 1: 64 bits
    return rows.tobytes()


def _loop(plane: Plane, ring: NDArray[np.int32], rgba: RGBA) -> LinePrimitive:
    r, g, b, a = rgba
    line = LinePrimitive(
        type=LinePrimitive.LINE_LOOP,
        pose=_IDENTITY,
        thickness=OUTLINE_PX,
        scale_invariant=True,
        color=Color(r=r, g=g, b=b, a=a),
    )
    line.MergeFromString(_points_field(plane.lift(ring)))
    return line


def _entity(plane: Plane, stamp_ns: int, frame_id: str) -> SceneEntity:
    lines = []
    for surface in plane.surfaces:
        lines.append(_loop(plane, surface.outer, CLASS_COLOURS[plane.plane_class]))
        lines += [_loop(plane, hole.ring, HOLE_COLOURS[hole.kind]) for hole in surface.holes]
    area_m2 = sum(surface.area_m2 for surface in plane.surfaces)
    return SceneEntity(
        timestamp=timestamp_of(stamp_ns),
        frame_id=frame_id,
        id=f"plane/{plane.id}",
        lines=lines,
        metadata=[
            KeyValuePair(key="class", value=str(plane.plane_class)),
            KeyValuePair(key="area_m2", value=f"{area_m2:.2f}"),
            KeyValuePair(key="sigma_n_m", value=f"{plane.sigma_n_m:.4f}"),
        ],
    )


def encode_scene(update: MapUpdate, frame_id: str) -> tuple[str, bytes]:
    """foxglove.SceneUpdate (schema, payload): an entity per plane; a snapshot clears first."""
    stamp = timestamp_of(update.stamp_ns)
    if update.base_revision == 0:
        deletions = [SceneEntityDeletion(timestamp=stamp, type=SceneEntityDeletion.ALL)]
    else:
        deletions = [
            SceneEntityDeletion(
                timestamp=stamp, type=SceneEntityDeletion.MATCHING_ID, id=f"plane/{t.plane_id}"
            )
            for t in update.retired
        ]
    entities = [_entity(plane, update.stamp_ns, frame_id) for plane in update.changed]
    message = SceneUpdate(deletions=deletions, entities=entities)
    return SCENE_SCHEMA, message.SerializeToString(deterministic=True)


def encode_tiles_cloud(
    tiles: Iterable[TilePoints], stamp_ns: int, frame_id: str
) -> tuple[str, bytes]:
    """foxglove.PointCloud (schema, payload) of voxel centroids in the world, with plane ids."""
    tiles = list(tiles)
    num = sum(len(t.plane_ids) for t in tiles)
    rows = np.zeros(num, dtype=[("xyz", "<f4", (3,)), ("plane_id", "<i4")])
    start = 0
    for tile in tiles:
        end = start + len(tile.plane_ids)
        rows["xyz"][start:end] = tile.xyz()
        rows["plane_id"][start:end] = tile.plane_ids
        start = end
    fields = [
        PackedElementField(name=name, offset=4 * k, type=PackedElementField.FLOAT32)
        for k, name in enumerate("xyz")
    ]
    fields.append(PackedElementField(name="plane_id", offset=12, type=PackedElementField.INT32))
    message = PointCloud(
        timestamp=timestamp_of(stamp_ns),
        frame_id=frame_id,
        pose=_IDENTITY,
        point_stride=16,
        fields=fields,
        data=rows.tobytes(),
    )
    return "foxglove.PointCloud", message.SerializeToString(deterministic=True)
