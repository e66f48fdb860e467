"""One example value per schema. A schema without one fails `test_codec`."""

from __future__ import annotations

from math import sqrt

import numpy as np

from facet_protocol.codec import Message, encode
from facet_protocol.messages import (
    Conflict,
    Corrected,
    CorrectedPose,
    Correction,
    Cut,
    Envelope,
    Erase,
    Event,
    EventKind,
    Events,
    Hole,
    HoleKind,
    LineFan,
    Loss,
    MapUpdate,
    Plane,
    PlaneClass,
    PlaneFrame,
    Pose,
    ResolvedPose,
    Scan,
    ScanKind,
    StampedPose,
    StampedTransform,
    Status,
    Surface,
    TilePoints,
    Tombstone,
    Transforms,
)

STAMP_NS = 1_750_000_000_123_456_789
SCAN_KEY = "facet/v1/office/robot/r1/scan/front"
POSE = Pose(np.array([1.5, -2.25, 0.1]), np.array([0.0, 0.0, sqrt(0.5), sqrt(0.5)]))

CLOUD = Scan(
    robot="r1",
    sensor="front",
    epoch=7,
    sequence=42,
    stamp_ns=STAMP_NS,
    frame_id="map",
    kind=ScanKind.CLOUD,
    pose=POSE,
    points=np.array([[1, 2, 3], [-4, 5.5, -6], [np.nan, 0, 0]], dtype=np.float32),
    no_return=np.array([[30, 0, 0], [0, 30, 1]], dtype=np.float32),
)

FAN = LineFan(
    robot="r1",
    sensor="front",
    epoch=7,
    sequence=43,
    stamp_ns=STAMP_NS,
    frame_id="map",
    pose=POSE,
    start_angle=-1.0,
    end_angle=1.0,
    ranges=np.array([2.0, np.inf, np.nan, 0.0, 3.5]),
)


def plane(number: int, d: float = 4.99) -> Plane:
    """A wall of 3 m x 2 m with a door and a shadow, seen from the side of -normal."""
    axis = np.eye(3)
    outer = np.array([[0, 0], [480, 0], [480, 320], [0, 320]], dtype=np.int32)
    door = np.array([[100, 0], [100, 300], [240, 300], [240, 0]], dtype=np.int32)
    shadow = np.array([[-300, 50], [-300, 90], [-360, 90]], dtype=np.int32)
    holes = (Hole(HoleKind.OPENING, door), Hole(HoleKind.UNOBSERVED, shadow))
    return Plane(
        id=number,
        revision=3,
        plane_class=PlaneClass.WALL,
        normal=np.array([1.0, -0.0, 1e-17]),
        d=d,
        facing=-1,
        sigma_n_m=0.011,
        thickness_angle_deg=4.1,
        covariance=np.arange(16.0).reshape(4, 4) / 3.0,
        num_points=48_211,
        num_voxels=3_920,
        centroid=np.array([4.99, 0.1, 1.2]),
        rms_m=0.010,
        frame=PlaneFrame(-axis[1], axis[2], -axis[0], 0.00625),
        surfaces=(Surface(7, 11.9, outer, holes), Surface(8, 0.05, outer[:3], ())),
        first_seen_ns=STAMP_NS - 5,
        last_seen_ns=STAMP_NS,
        robots=("r1", "r2"),
    )


CREATED = Event(11, EventKind.CREATED, 3, 0, 9, STAMP_NS)
MERGED = Event(12, EventKind.MERGED, 2, 3, 9, STAMP_NS)
TRANSFORM = StampedTransform(STAMP_NS, "map", "base", POSE)

EXAMPLES: dict[str, Message] = {
    "foxglove.PointCloud": CLOUD,
    "foxglove.LaserScan": FAN,
    "foxglove.PoseInFrame": StampedPose(STAMP_NS, "map", POSE),
    "foxglove.FrameTransform": TRANSFORM,
    "foxglove.FrameTransforms": Transforms((TRANSFORM, TRANSFORM)),
    "facet.v1.MapUpdate": MapUpdate(
        map_id="office",
        revision=9,
        base_revision=8,
        stamp_ns=STAMP_NS,
        changed=(plane(3), plane(5, d=0.0)),
        retired=(Tombstone(2, 3), Tombstone(4, 0)),
        events=(CREATED, MERGED),
    ),
    "facet.v1.Plane": plane(3),
    "facet.v1.Events": Events("office", (CREATED, MERGED)),
    "facet.v1.TilePoints": TilePoints(
        tile=(-1, 0, 3),
        voxel_m=0.05,
        centroids=np.array([[0, 1, 511], [2, 3, 4]], dtype=np.uint16),
        plane_ids=np.array([3, 0], dtype=np.int32),
    ),
    "facet.v1.Status": Status(
        map_id="office",
        revision=9,
        stamp_ns=STAMP_NS,
        health="OK",
        counters={"applied": 12, "received": 2**63},
        gauges={"queue_msgs": 1.0, "rss_mb": 312.5},
        stage_ms={"insert": 2.25},
    ),
    "facet.v1.Cut": Cut(9, "r1", "front", 7, 42, STAMP_NS, 3),
    "facet.v1.ResolvedPose": ResolvedPose("r1", "front", 7, 42, STAMP_NS, "map", POSE),
    "facet.v1.Correction": Correction("r1", (CorrectedPose("front", 7, 42, POSE),)),
    "facet.v1.Corrected": Corrected("r1", 7, 42, STAMP_NS, 1),
    "facet.v1.Conflict": Conflict(
        "r1", "front", 7, 42, STAMP_NS, bytes(32), bytes([255] * 32), True
    ),
    "facet.v1.Erase": Erase("r1", "front", 7, 40, 42),
    "facet.v1.Loss": Loss("r1", "front", 7, 43, 5, "lost_upstream", STAMP_NS),
}


def envelope(message: Message, key: str = SCAN_KEY) -> Envelope:
    """`message` as it would have travelled."""
    schema, payload = encode(message)
    return Envelope(key, schema, "protobuf", payload, epoch=7, sequence=42)
