from google.protobuf.internal import containers as _containers
from google.protobuf.internal import enum_type_wrapper as _enum_type_wrapper
from google.protobuf import descriptor as _descriptor
from google.protobuf import message as _message
from collections.abc import Iterable as _Iterable, Mapping as _Mapping
from typing import ClassVar as _ClassVar, Optional as _Optional, Union as _Union

DESCRIPTOR: _descriptor.FileDescriptor

class PlaneClass(int, metaclass=_enum_type_wrapper.EnumTypeWrapper):
    __slots__ = ()
    PLANE_CLASS_UNSPECIFIED: _ClassVar[PlaneClass]
    PLANE_CLASS_FLOOR: _ClassVar[PlaneClass]
    PLANE_CLASS_CEILING: _ClassVar[PlaneClass]
    PLANE_CLASS_WALL: _ClassVar[PlaneClass]
    PLANE_CLASS_OTHER: _ClassVar[PlaneClass]

class HoleKind(int, metaclass=_enum_type_wrapper.EnumTypeWrapper):
    __slots__ = ()
    HOLE_KIND_UNSPECIFIED: _ClassVar[HoleKind]
    HOLE_KIND_OPENING: _ClassVar[HoleKind]
    HOLE_KIND_UNOBSERVED: _ClassVar[HoleKind]

class EventKind(int, metaclass=_enum_type_wrapper.EnumTypeWrapper):
    __slots__ = ()
    EVENT_KIND_UNSPECIFIED: _ClassVar[EventKind]
    EVENT_KIND_CREATED: _ClassVar[EventKind]
    EVENT_KIND_UPDATED: _ClassVar[EventKind]
    EVENT_KIND_MERGED: _ClassVar[EventKind]
    EVENT_KIND_SPLIT: _ClassVar[EventKind]
    EVENT_KIND_RETIRED: _ClassVar[EventKind]
PLANE_CLASS_UNSPECIFIED: PlaneClass
PLANE_CLASS_FLOOR: PlaneClass
PLANE_CLASS_CEILING: PlaneClass
PLANE_CLASS_WALL: PlaneClass
PLANE_CLASS_OTHER: PlaneClass
HOLE_KIND_UNSPECIFIED: HoleKind
HOLE_KIND_OPENING: HoleKind
HOLE_KIND_UNOBSERVED: HoleKind
EVENT_KIND_UNSPECIFIED: EventKind
EVENT_KIND_CREATED: EventKind
EVENT_KIND_UPDATED: EventKind
EVENT_KIND_MERGED: EventKind
EVENT_KIND_SPLIT: EventKind
EVENT_KIND_RETIRED: EventKind

class PlaneFrame(_message.Message):
    __slots__ = ("axis_u", "axis_v", "axis_n", "step_m")
    AXIS_U_FIELD_NUMBER: _ClassVar[int]
    AXIS_V_FIELD_NUMBER: _ClassVar[int]
    AXIS_N_FIELD_NUMBER: _ClassVar[int]
    STEP_M_FIELD_NUMBER: _ClassVar[int]
    axis_u: _containers.RepeatedScalarFieldContainer[float]
    axis_v: _containers.RepeatedScalarFieldContainer[float]
    axis_n: _containers.RepeatedScalarFieldContainer[float]
    step_m: float
    def __init__(self, axis_u: _Optional[_Iterable[float]] = ..., axis_v: _Optional[_Iterable[float]] = ..., axis_n: _Optional[_Iterable[float]] = ..., step_m: _Optional[float] = ...) -> None: ...

class Hole(_message.Message):
    __slots__ = ("kind", "ring")
    KIND_FIELD_NUMBER: _ClassVar[int]
    RING_FIELD_NUMBER: _ClassVar[int]
    kind: HoleKind
    ring: _containers.RepeatedScalarFieldContainer[int]
    def __init__(self, kind: _Optional[_Union[HoleKind, str]] = ..., ring: _Optional[_Iterable[int]] = ...) -> None: ...

class Surface(_message.Message):
    __slots__ = ("id", "area_m2", "outer", "holes")
    ID_FIELD_NUMBER: _ClassVar[int]
    AREA_M2_FIELD_NUMBER: _ClassVar[int]
    OUTER_FIELD_NUMBER: _ClassVar[int]
    HOLES_FIELD_NUMBER: _ClassVar[int]
    id: int
    area_m2: float
    outer: _containers.RepeatedScalarFieldContainer[int]
    holes: _containers.RepeatedCompositeFieldContainer[Hole]
    def __init__(self, id: _Optional[int] = ..., area_m2: _Optional[float] = ..., outer: _Optional[_Iterable[int]] = ..., holes: _Optional[_Iterable[_Union[Hole, _Mapping]]] = ...) -> None: ...

class Plane(_message.Message):
    __slots__ = ("id", "revision", "plane_class", "normal", "d", "facing", "sigma_n_m", "thickness_angle_deg", "covariance", "num_points", "num_voxels", "centroid", "rms_m", "frame", "surfaces", "first_seen_ns", "last_seen_ns", "robots")
    ID_FIELD_NUMBER: _ClassVar[int]
    REVISION_FIELD_NUMBER: _ClassVar[int]
    PLANE_CLASS_FIELD_NUMBER: _ClassVar[int]
    NORMAL_FIELD_NUMBER: _ClassVar[int]
    D_FIELD_NUMBER: _ClassVar[int]
    FACING_FIELD_NUMBER: _ClassVar[int]
    SIGMA_N_M_FIELD_NUMBER: _ClassVar[int]
    THICKNESS_ANGLE_DEG_FIELD_NUMBER: _ClassVar[int]
    COVARIANCE_FIELD_NUMBER: _ClassVar[int]
    NUM_POINTS_FIELD_NUMBER: _ClassVar[int]
    NUM_VOXELS_FIELD_NUMBER: _ClassVar[int]
    CENTROID_FIELD_NUMBER: _ClassVar[int]
    RMS_M_FIELD_NUMBER: _ClassVar[int]
    FRAME_FIELD_NUMBER: _ClassVar[int]
    SURFACES_FIELD_NUMBER: _ClassVar[int]
    FIRST_SEEN_NS_FIELD_NUMBER: _ClassVar[int]
    LAST_SEEN_NS_FIELD_NUMBER: _ClassVar[int]
    ROBOTS_FIELD_NUMBER: _ClassVar[int]
    id: int
    revision: int
    plane_class: PlaneClass
    normal: _containers.RepeatedScalarFieldContainer[float]
    d: float
    facing: int
    sigma_n_m: float
    thickness_angle_deg: float
    covariance: _containers.RepeatedScalarFieldContainer[float]
    num_points: int
    num_voxels: int
    centroid: _containers.RepeatedScalarFieldContainer[float]
    rms_m: float
    frame: PlaneFrame
    surfaces: _containers.RepeatedCompositeFieldContainer[Surface]
    first_seen_ns: int
    last_seen_ns: int
    robots: _containers.RepeatedScalarFieldContainer[str]
    def __init__(self, id: _Optional[int] = ..., revision: _Optional[int] = ..., plane_class: _Optional[_Union[PlaneClass, str]] = ..., normal: _Optional[_Iterable[float]] = ..., d: _Optional[float] = ..., facing: _Optional[int] = ..., sigma_n_m: _Optional[float] = ..., thickness_angle_deg: _Optional[float] = ..., covariance: _Optional[_Iterable[float]] = ..., num_points: _Optional[int] = ..., num_voxels: _Optional[int] = ..., centroid: _Optional[_Iterable[float]] = ..., rms_m: _Optional[float] = ..., frame: _Optional[_Union[PlaneFrame, _Mapping]] = ..., surfaces: _Optional[_Iterable[_Union[Surface, _Mapping]]] = ..., first_seen_ns: _Optional[int] = ..., last_seen_ns: _Optional[int] = ..., robots: _Optional[_Iterable[str]] = ...) -> None: ...

class Event(_message.Message):
    __slots__ = ("number", "kind", "plane_id", "other_id", "revision", "stamp_ns")
    NUMBER_FIELD_NUMBER: _ClassVar[int]
    KIND_FIELD_NUMBER: _ClassVar[int]
    PLANE_ID_FIELD_NUMBER: _ClassVar[int]
    OTHER_ID_FIELD_NUMBER: _ClassVar[int]
    REVISION_FIELD_NUMBER: _ClassVar[int]
    STAMP_NS_FIELD_NUMBER: _ClassVar[int]
    number: int
    kind: EventKind
    plane_id: int
    other_id: int
    revision: int
    stamp_ns: int
    def __init__(self, number: _Optional[int] = ..., kind: _Optional[_Union[EventKind, str]] = ..., plane_id: _Optional[int] = ..., other_id: _Optional[int] = ..., revision: _Optional[int] = ..., stamp_ns: _Optional[int] = ...) -> None: ...

class Events(_message.Message):
    __slots__ = ("map_id", "events")
    MAP_ID_FIELD_NUMBER: _ClassVar[int]
    EVENTS_FIELD_NUMBER: _ClassVar[int]
    map_id: str
    events: _containers.RepeatedCompositeFieldContainer[Event]
    def __init__(self, map_id: _Optional[str] = ..., events: _Optional[_Iterable[_Union[Event, _Mapping]]] = ...) -> None: ...

class Tombstone(_message.Message):
    __slots__ = ("plane_id", "subsumed_by")
    PLANE_ID_FIELD_NUMBER: _ClassVar[int]
    SUBSUMED_BY_FIELD_NUMBER: _ClassVar[int]
    plane_id: int
    subsumed_by: int
    def __init__(self, plane_id: _Optional[int] = ..., subsumed_by: _Optional[int] = ...) -> None: ...

class MapUpdate(_message.Message):
    __slots__ = ("map_id", "revision", "base_revision", "stamp_ns", "changed", "retired", "events")
    MAP_ID_FIELD_NUMBER: _ClassVar[int]
    REVISION_FIELD_NUMBER: _ClassVar[int]
    BASE_REVISION_FIELD_NUMBER: _ClassVar[int]
    STAMP_NS_FIELD_NUMBER: _ClassVar[int]
    CHANGED_FIELD_NUMBER: _ClassVar[int]
    RETIRED_FIELD_NUMBER: _ClassVar[int]
    EVENTS_FIELD_NUMBER: _ClassVar[int]
    map_id: str
    revision: int
    base_revision: int
    stamp_ns: int
    changed: _containers.RepeatedCompositeFieldContainer[Plane]
    retired: _containers.RepeatedCompositeFieldContainer[Tombstone]
    events: _containers.RepeatedCompositeFieldContainer[Event]
    def __init__(self, map_id: _Optional[str] = ..., revision: _Optional[int] = ..., base_revision: _Optional[int] = ..., stamp_ns: _Optional[int] = ..., changed: _Optional[_Iterable[_Union[Plane, _Mapping]]] = ..., retired: _Optional[_Iterable[_Union[Tombstone, _Mapping]]] = ..., events: _Optional[_Iterable[_Union[Event, _Mapping]]] = ...) -> None: ...

class TilePoints(_message.Message):
    __slots__ = ("tile", "voxel_m", "centroids", "plane_ids")
    TILE_FIELD_NUMBER: _ClassVar[int]
    VOXEL_M_FIELD_NUMBER: _ClassVar[int]
    CENTROIDS_FIELD_NUMBER: _ClassVar[int]
    PLANE_IDS_FIELD_NUMBER: _ClassVar[int]
    tile: _containers.RepeatedScalarFieldContainer[int]
    voxel_m: float
    centroids: bytes
    plane_ids: bytes
    def __init__(self, tile: _Optional[_Iterable[int]] = ..., voxel_m: _Optional[float] = ..., centroids: _Optional[bytes] = ..., plane_ids: _Optional[bytes] = ...) -> None: ...
