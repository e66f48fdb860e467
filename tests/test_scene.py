"""What Foxglove is given to draw."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from foxglove_schemas_protobuf.LinePrimitive_pb2 import LinePrimitive
from foxglove_schemas_protobuf.Point3_pb2 import Point3
from foxglove_schemas_protobuf.PointCloud_pb2 import PointCloud
from foxglove_schemas_protobuf.SceneEntityDeletion_pb2 import SceneEntityDeletion
from foxglove_schemas_protobuf.SceneUpdate_pb2 import SceneUpdate

from examples import EXAMPLES, SCAN_KEY, STAMP_NS
from facet_protocol import Envelope, MapUpdate, TilePoints, decode_scan
from facet_protocol.messages import PlaneFrame
from facet_protocol.scene import encode_scene, encode_tiles_cloud

UPDATE = EXAMPLES["facet.v1.MapUpdate"]
TILE = EXAMPLES["facet.v1.TilePoints"]
assert isinstance(UPDATE, MapUpdate)
assert isinstance(TILE, TilePoints)


def test_outlines_are_loops_on_their_plane() -> None:
    schema, payload = encode_scene(UPDATE, "map")
    scene = SceneUpdate.FromString(payload)
    assert schema == "foxglove.SceneUpdate"
    assert [e.id for e in scene.entities] == ["plane/3", "plane/5"]
    entity, plane = scene.entities[0], UPDATE.changed[0]
    assert len(entity.lines) == 4  # two surfaces, two holes
    assert all(line.type == LinePrimitive.LINE_LOOP for line in entity.lines)
    vertices = np.array([[p.x, p.y, p.z] for line in entity.lines for p in line.points])
    np.testing.assert_allclose(vertices @ plane.normal, plane.d, atol=1e-9)
    assert entity.frame_id == "map"


def test_its_bytes_are_those_of_points_made_one_by_one() -> None:
    """They are written as bytes; a coordinate that is 0 is left out on the wire."""
    x, y, z = np.eye(3)
    flat = replace(UPDATE.changed[0], normal=z, d=0.0, frame=PlaneFrame(x, y, z, 0.00625))
    for plane in (*UPDATE.changed, flat):
        payload = encode_scene(replace(UPDATE, changed=(plane,)), "map")[1]
        scene = SceneUpdate.FromString(payload)
        rings = [r for s in plane.surfaces for r in (s.outer, *(h.ring for h in s.holes))]
        for line, ring in zip(scene.entities[0].lines, rings, strict=True):
            told = [(p.x, p.y, p.z) for p in line.points]
            assert told == [tuple(p) for p in plane.lift(ring).tolist()]
            del line.points[:]
            line.points.extend(Point3(x=x, y=y, z=z) for x, y, z in told)
        assert scene.SerializeToString(deterministic=True) == payload


def test_what_is_retired_is_deleted_and_a_snapshot_clears() -> None:
    scene = SceneUpdate.FromString(encode_scene(UPDATE, "map")[1])
    assert [d.id for d in scene.deletions] == ["plane/2", "plane/4"]
    snapshot = replace(UPDATE, base_revision=0, retired=(), events=())
    deletions = SceneUpdate.FromString(encode_scene(snapshot, "map")[1]).deletions
    assert [d.type for d in deletions] == [SceneEntityDeletion.ALL]


def test_tiles_are_a_cloud_that_we_read_ourselves() -> None:
    schema, payload = encode_tiles_cloud([TILE, TILE], STAMP_NS, "map")
    scan = decode_scan(Envelope(SCAN_KEY, schema, "protobuf", payload), "r", "s")
    assert scan.points.tolist() == np.concatenate([TILE.xyz(), TILE.xyz()]).tolist()
    rows = np.frombuffer(PointCloud.FromString(payload).data, "<i4").reshape(-1, 4)
    assert rows[:, 3].tolist() == [3, 0, 3, 0]
    empty = encode_tiles_cloud([], STAMP_NS, "map")[1]
    assert len(PointCloud.FromString(empty).data) == 0
