"""The values that cross Facet's boundaries: scans in, planes and updates out. No wire format."""

from __future__ import annotations

from dataclasses import dataclass, field
from enum import StrEnum

import numpy as np
from numpy.typing import NDArray


class ProtocolError(ValueError):
    """Bytes, or a value, that break the protocol. `reason` is the counter it is counted under."""

    def __init__(self, message: str, reason: str = "malformed") -> None:
        super().__init__(message)
        self.reason = reason


@dataclass(frozen=True, slots=True)
class Rule:
    """What a setting says about the messages of some keys; "" and 0 say nothing."""

    key: str  # key expression: * is one chunk, ** any number of them
    schema: str = ""  # where the message does not name its own
    robot: str = ""
    sensor: str = ""
    frame: str = ""  # of a scan: the frame of its points; of a pose: the frame it is the pose of
    envelope_field: int = 0  # the message is this field of another protobuf message


@dataclass(frozen=True, slots=True, eq=False)
class Envelope:
    """One message as it travelled: what the recorder writes and `decode` reads."""

    key: str  # Zenoh key, also the MCAP topic
    schema: str  # "foxglove.PointCloud", "facet.v1.MapUpdate", ...
    encoding: str  # "protobuf" | "cdr"
    payload: bytes | memoryview  # exactly as it travelled
    stamp_ns: int = 0  # the source's stamp; 0 means none
    epoch: int = 0  # a new one at each start of the publisher
    sequence: int = 0  # from 1; 0 means none
    received_ns: int = 0  # our clock, at the door
    rule: Rule | None = None  # what the settings say about its key
    is_derived: bool = False  # Facet itself wrote it: no input

    def owned(self) -> Envelope:
        """With a payload of its own: a view would keep all that it is a part of."""
        if isinstance(self.payload, bytes):
            return self
        return Envelope(
            self.key, self.schema, self.encoding, bytes(self.payload), self.stamp_ns, self.epoch,
            self.sequence, self.received_ns, self.rule, self.is_derived,
        )  # fmt: skip


@dataclass(frozen=True, slots=True, eq=False)
class Pose:
    """A rigid transform, sensor to world unless the field's name says otherwise."""

    position: NDArray[np.float64]  # (3,) m
    orientation_xyzw: NDArray[np.float64]  # (4,) unit quaternion

    def rotation(self) -> NDArray[np.float64]:
        """R_target_source (3, 3), by + - * alone: the same bits on every machine."""
        x, y, z, w = (float(c) for c in self.orientation_xyzw)
        return np.array(
            [
                [1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y - z * w), 2.0 * (x * z + y * w)],
                [2.0 * (x * y + z * w), 1.0 - 2.0 * (x * x + z * z), 2.0 * (y * z - x * w)],
                [2.0 * (x * z - y * w), 2.0 * (y * z + x * w), 1.0 - 2.0 * (x * x + y * y)],
            ]
        )


IDENTITY = Pose(np.zeros(3), np.array([0.0, 0.0, 0.0, 1.0]))  # of what is given in its own frame
IDENTITY.position.flags.writeable = IDENTITY.orientation_xyzw.flags.writeable = False


class ScanKind(StrEnum):
    LINE = "line"  # one flat fan of beams: a single such scan never makes a plane
    CLOUD = "cloud"  # points in three dimensions


@dataclass(frozen=True, slots=True, eq=False)
class Scan:
    """A resolved scan: points with the pose they were taken from."""

    robot: str
    sensor: str
    epoch: int
    sequence: int
    stamp_ns: int
    frame_id: str  # frame of `pose`: the map's
    kind: ScanKind
    pose: Pose  # T_world_sensor
    points: NDArray[np.float32]  # (N, 3) m, sensor frame; returns, may hold non-finite rows
    no_return: NDArray[np.float32]  # (M, 3) m, sensor frame; where the range of an empty beam ends
    ignored: dict[str, int] = field(default_factory=dict)  # beams left out at decode, by reason
    renormalised: bool = False  # the quaternion as received was off by 1e-9 to 1e-3
    has_pose: bool = True  # False: `pose` is the identity, for none was sent

    @property
    def source(self) -> str:
        return f"{self.robot}/{self.sensor}"

    @property
    def is_placed(self) -> bool:
        """Its pose was sent with it, and says more than that the points are in their own frame."""
        p, q = self.pose.position.tolist(), self.pose.orientation_xyzw.tolist()
        return self.has_pose and (any(p) or any(q[:3]))


@dataclass(frozen=True, slots=True, eq=False)
class LineFan:
    """A flat scan as a range finder measures it, before projection."""

    robot: str
    sensor: str
    epoch: int
    sequence: int
    stamp_ns: int  # of the first ray
    frame_id: str
    pose: Pose  # T_world_sensor
    start_angle: float  # rad, from +x counter-clockwise in the sensor's x-y plane
    end_angle: float  # rad, of the last beam
    ranges: NDArray[np.float64]  # (N,) m; +inf: came back empty; NaN: says nothing

    @property
    def source(self) -> str:
        return f"{self.robot}/{self.sensor}"


@dataclass(frozen=True, slots=True, eq=False)
class StampedPose:
    """Where something was: a pose in a frame at a time."""

    stamp_ns: int
    frame_id: str
    pose: Pose


@dataclass(frozen=True, slots=True, eq=False)
class StampedTransform:
    stamp_ns: int
    parent_frame_id: str
    child_frame_id: str
    pose: Pose  # T_parent_child


@dataclass(frozen=True, slots=True, eq=False)
class Transforms:
    transforms: tuple[StampedTransform, ...]
    refused: tuple[str, ...] = ()  # reasons of those that were left out at decode


@dataclass(frozen=True, slots=True, eq=False)
class ResolvedPose:
    """The pose a scan was applied with, where pose and scan came apart."""

    robot: str
    sensor: str
    epoch: int
    sequence: int
    stamp_ns: int
    frame_id: str
    pose: Pose  # T_world_sensor


@dataclass(frozen=True, slots=True, eq=False)
class CorrectedPose:
    sensor: str
    epoch: int  # of the scan; 0 where it has none: the epoch that its sensor is in
    sequence: int
    pose: Pose  # the new T_world_sensor


@dataclass(frozen=True, slots=True, eq=False)
class Correction:
    """A batch of new poses for scans already sent: all applied in one update, or none."""

    robot: str
    poses: tuple[CorrectedPose, ...]


@dataclass(frozen=True, slots=True, eq=False)
class Corrected:
    """What became of a correction, known by the numbers of its own message."""

    robot: str
    epoch: int
    sequence: int
    stamp_ns: int
    num_scans: int
    reason: str = ""  # why none of it was applied; "": all of it was


@dataclass(frozen=True, slots=True, eq=False)
class Conflict:
    """Two different scans under one number: that with the smaller SHA-256 is in the map."""

    robot: str
    sensor: str
    epoch: int
    sequence: int
    stamp_ns: int  # of the one that came last
    kept: bytes  # (32,) SHA-256 of the payload that is in the map
    left_out: bytes  # (32,) of the other
    replaced: bool  # the one that came last is kept: the other was taken out again


@dataclass(frozen=True, slots=True, eq=False)
class Erase:
    """Take a robot's scans out of the map: those that came before, as if they never had."""

    robot: str
    sensor: str = ""  # "": each of its own
    epoch: int = 0  # 0: every one
    first: int = 0  # sequence
    last: int = 0  # inclusive; 0: no end


class PlaneClass(StrEnum):
    FLOOR = "floor"
    CEILING = "ceiling"
    WALL = "wall"
    OTHER = "other"


class HoleKind(StrEnum):
    OPENING = "opening"  # beams went through: a door, a window, glass
    UNOBSERVED = "unobserved"  # nothing looked there: the shadow of a cupboard


class EventKind(StrEnum):
    CREATED = "created"
    UPDATED = "updated"
    MERGED = "merged"
    SPLIT = "split"
    RETIRED = "retired"


@dataclass(frozen=True, slots=True, eq=False)
class PlaneFrame:
    """Integer coordinates of a plane's contours: (u, v) in `step_m` along two orthonormal axes.

    A vertex (u, v) lies at u*step_m*axis_u + v*step_m*axis_v, moved along axis_n onto the plane.
    axis_u x axis_v = axis_n, and axis_n points to the side from which the plane was seen.
    """

    axis_u: NDArray[np.float64]  # (3,) unit
    axis_v: NDArray[np.float64]  # (3,) unit
    axis_n: NDArray[np.float64]  # (3,) unit
    step_m: float


@dataclass(frozen=True, slots=True, eq=False)
class Hole:
    kind: HoleKind
    ring: NDArray[np.int32]  # (M, 2) frame units, clockwise seen from the facing side


@dataclass(frozen=True, slots=True, eq=False)
class Surface:
    id: int
    area_m2: float
    outer: NDArray[np.int32]  # (M, 2) frame units, counter-clockwise seen from the facing side
    holes: tuple[Hole, ...]


@dataclass(frozen=True, slots=True, eq=False)
class Plane:
    """One unbounded, one-sided plane with its bounded surfaces: normal . x = d, d >= 0 (eq. 6)."""

    id: int
    revision: int
    plane_class: PlaneClass
    normal: NDArray[np.float64]  # (3,) unit, world
    d: float  # m
    facing: int  # 1: seen from the side of +normal; -1: from the side of -normal
    sigma_n_m: float  # standard deviation of the points along the normal
    thickness_angle_deg: float  # eq. 9 of the plane's points
    covariance: NDArray[np.float64]  # (4, 4) of (normal, d)
    num_points: int
    num_voxels: int  # occupation
    centroid: NDArray[np.float64]  # (3,) m, world
    rms_m: float
    frame: PlaneFrame
    surfaces: tuple[Surface, ...]
    first_seen_ns: int
    last_seen_ns: int
    robots: tuple[str, ...]

    def lift(self, ring: NDArray[np.int32]) -> NDArray[np.float64]:
        """World coordinates (M, 3) m of frame vertices (M, 2), on the plane."""
        f = self.frame
        uv = ring.astype(np.float64) * f.step_m
        p = uv[:, :1] * f.axis_u + uv[:, 1:] * f.axis_v
        slope = float(f.axis_n @ self.normal)
        return np.asarray(p + ((self.d - p @ self.normal) / slope)[:, None] * f.axis_n)


@dataclass(frozen=True, slots=True, eq=False)
class Event:
    number: int  # counted from 1, never reused
    kind: EventKind
    plane_id: int
    other_id: int  # merged: subsumed by this one; split: the plane it came from; else 0
    revision: int  # of the map
    stamp_ns: int


@dataclass(frozen=True, slots=True, eq=False)
class Tombstone:
    plane_id: int
    subsumed_by: int  # 0: none


@dataclass(frozen=True, slots=True, eq=False)
class MapUpdate:
    """What one update changed. `base_revision` 0 means a snapshot: everything, from nothing."""

    map_id: str
    revision: int
    base_revision: int
    stamp_ns: int  # newest scan applied
    changed: tuple[Plane, ...]  # ascending id
    retired: tuple[Tombstone, ...]  # ascending id
    events: tuple[Event, ...]


@dataclass(frozen=True, slots=True, eq=False)
class TilePoints:
    """The voxels of one tile (64 a side), for display. Empty arrays: the tile is empty now."""

    tile: tuple[int, int, int]
    voxel_m: float
    centroids: NDArray[np.uint16]  # (V, 3) 1/8 voxel from the tile's corner
    plane_ids: NDArray[np.int32]  # (V,) 0: on no plane

    def xyz(self) -> NDArray[np.float32]:
        """(V, 3) m, world."""
        corner = np.array(self.tile, dtype=np.float64) * (64.0 * self.voxel_m)
        return np.asarray(self.centroids * (self.voxel_m / 8.0) + corner, dtype=np.float32)


@dataclass(frozen=True, slots=True, eq=False)
class Cut:
    """Where an update ended: the last scan applied before it, by source."""

    revision: int
    robot: str
    sensor: str
    epoch: int
    sequence: int
    stamp_ns: int
    num_scans: int  # scans applied since the previous cut


@dataclass(frozen=True, slots=True, eq=False)
class Status:
    """The service's account of itself, at 1 Hz. Counters only grow."""

    map_id: str
    revision: int
    stamp_ns: int
    health: str  # "OK" | "DEGRADED" | "FAIL"
    counters: dict[str, int] = field(
        default_factory=dict
    )  # received, recorded, applied, rejected.<reason>, ...
    gauges: dict[str, float] = field(
        default_factory=dict
    )  # queue_msgs, queue_bytes, voxels, planes, rss_mb, ...
    stage_ms: dict[str, float] = field(
        default_factory=dict
    )  # insert, normals, patches, planes, contours, ...


@dataclass(frozen=True, slots=True, eq=False)
class Events:
    """Events of one map, ascending by number."""

    map_id: str
    events: tuple[Event, ...]


@dataclass(frozen=True, slots=True, eq=False)
class Loss:
    """Scans that never arrived, or were shed: a gap in one source's sequence numbers."""

    robot: str
    sensor: str
    epoch: int
    first_sequence: int
    count: int
    reason: str  # "lost_upstream", "shed_overload", ...
    stamp_ns: int
