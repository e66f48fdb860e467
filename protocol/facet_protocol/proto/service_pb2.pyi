from google.protobuf.internal import containers as _containers
from google.protobuf import descriptor as _descriptor
from google.protobuf import message as _message
from collections.abc import Iterable as _Iterable, Mapping as _Mapping
from typing import ClassVar as _ClassVar, Optional as _Optional, Union as _Union

DESCRIPTOR: _descriptor.FileDescriptor

class Pose(_message.Message):
    __slots__ = ("position", "orientation_xyzw")
    POSITION_FIELD_NUMBER: _ClassVar[int]
    ORIENTATION_XYZW_FIELD_NUMBER: _ClassVar[int]
    position: _containers.RepeatedScalarFieldContainer[float]
    orientation_xyzw: _containers.RepeatedScalarFieldContainer[float]
    def __init__(self, position: _Optional[_Iterable[float]] = ..., orientation_xyzw: _Optional[_Iterable[float]] = ...) -> None: ...

class Cut(_message.Message):
    __slots__ = ("revision", "robot", "sensor", "epoch", "sequence", "stamp_ns", "num_scans")
    REVISION_FIELD_NUMBER: _ClassVar[int]
    ROBOT_FIELD_NUMBER: _ClassVar[int]
    SENSOR_FIELD_NUMBER: _ClassVar[int]
    EPOCH_FIELD_NUMBER: _ClassVar[int]
    SEQUENCE_FIELD_NUMBER: _ClassVar[int]
    STAMP_NS_FIELD_NUMBER: _ClassVar[int]
    NUM_SCANS_FIELD_NUMBER: _ClassVar[int]
    revision: int
    robot: str
    sensor: str
    epoch: int
    sequence: int
    stamp_ns: int
    num_scans: int
    def __init__(self, revision: _Optional[int] = ..., robot: _Optional[str] = ..., sensor: _Optional[str] = ..., epoch: _Optional[int] = ..., sequence: _Optional[int] = ..., stamp_ns: _Optional[int] = ..., num_scans: _Optional[int] = ...) -> None: ...

class ResolvedPose(_message.Message):
    __slots__ = ("robot", "sensor", "epoch", "sequence", "stamp_ns", "frame_id", "pose")
    ROBOT_FIELD_NUMBER: _ClassVar[int]
    SENSOR_FIELD_NUMBER: _ClassVar[int]
    EPOCH_FIELD_NUMBER: _ClassVar[int]
    SEQUENCE_FIELD_NUMBER: _ClassVar[int]
    STAMP_NS_FIELD_NUMBER: _ClassVar[int]
    FRAME_ID_FIELD_NUMBER: _ClassVar[int]
    POSE_FIELD_NUMBER: _ClassVar[int]
    robot: str
    sensor: str
    epoch: int
    sequence: int
    stamp_ns: int
    frame_id: str
    pose: Pose
    def __init__(self, robot: _Optional[str] = ..., sensor: _Optional[str] = ..., epoch: _Optional[int] = ..., sequence: _Optional[int] = ..., stamp_ns: _Optional[int] = ..., frame_id: _Optional[str] = ..., pose: _Optional[_Union[Pose, _Mapping]] = ...) -> None: ...

class CorrectedPose(_message.Message):
    __slots__ = ("sensor", "epoch", "sequence", "pose")
    SENSOR_FIELD_NUMBER: _ClassVar[int]
    EPOCH_FIELD_NUMBER: _ClassVar[int]
    SEQUENCE_FIELD_NUMBER: _ClassVar[int]
    POSE_FIELD_NUMBER: _ClassVar[int]
    sensor: str
    epoch: int
    sequence: int
    pose: Pose
    def __init__(self, sensor: _Optional[str] = ..., epoch: _Optional[int] = ..., sequence: _Optional[int] = ..., pose: _Optional[_Union[Pose, _Mapping]] = ...) -> None: ...

class Correction(_message.Message):
    __slots__ = ("robot", "poses")
    ROBOT_FIELD_NUMBER: _ClassVar[int]
    POSES_FIELD_NUMBER: _ClassVar[int]
    robot: str
    poses: _containers.RepeatedCompositeFieldContainer[CorrectedPose]
    def __init__(self, robot: _Optional[str] = ..., poses: _Optional[_Iterable[_Union[CorrectedPose, _Mapping]]] = ...) -> None: ...

class Corrected(_message.Message):
    __slots__ = ("robot", "epoch", "sequence", "stamp_ns", "num_scans", "reason")
    ROBOT_FIELD_NUMBER: _ClassVar[int]
    EPOCH_FIELD_NUMBER: _ClassVar[int]
    SEQUENCE_FIELD_NUMBER: _ClassVar[int]
    STAMP_NS_FIELD_NUMBER: _ClassVar[int]
    NUM_SCANS_FIELD_NUMBER: _ClassVar[int]
    REASON_FIELD_NUMBER: _ClassVar[int]
    robot: str
    epoch: int
    sequence: int
    stamp_ns: int
    num_scans: int
    reason: str
    def __init__(self, robot: _Optional[str] = ..., epoch: _Optional[int] = ..., sequence: _Optional[int] = ..., stamp_ns: _Optional[int] = ..., num_scans: _Optional[int] = ..., reason: _Optional[str] = ...) -> None: ...

class Conflict(_message.Message):
    __slots__ = ("robot", "sensor", "epoch", "sequence", "stamp_ns", "kept", "left_out", "replaced")
    ROBOT_FIELD_NUMBER: _ClassVar[int]
    SENSOR_FIELD_NUMBER: _ClassVar[int]
    EPOCH_FIELD_NUMBER: _ClassVar[int]
    SEQUENCE_FIELD_NUMBER: _ClassVar[int]
    STAMP_NS_FIELD_NUMBER: _ClassVar[int]
    KEPT_FIELD_NUMBER: _ClassVar[int]
    LEFT_OUT_FIELD_NUMBER: _ClassVar[int]
    REPLACED_FIELD_NUMBER: _ClassVar[int]
    robot: str
    sensor: str
    epoch: int
    sequence: int
    stamp_ns: int
    kept: bytes
    left_out: bytes
    replaced: bool
    def __init__(self, robot: _Optional[str] = ..., sensor: _Optional[str] = ..., epoch: _Optional[int] = ..., sequence: _Optional[int] = ..., stamp_ns: _Optional[int] = ..., kept: _Optional[bytes] = ..., left_out: _Optional[bytes] = ..., replaced: _Optional[bool] = ...) -> None: ...

class Erase(_message.Message):
    __slots__ = ("robot", "sensor", "epoch", "first", "last")
    ROBOT_FIELD_NUMBER: _ClassVar[int]
    SENSOR_FIELD_NUMBER: _ClassVar[int]
    EPOCH_FIELD_NUMBER: _ClassVar[int]
    FIRST_FIELD_NUMBER: _ClassVar[int]
    LAST_FIELD_NUMBER: _ClassVar[int]
    robot: str
    sensor: str
    epoch: int
    first: int
    last: int
    def __init__(self, robot: _Optional[str] = ..., sensor: _Optional[str] = ..., epoch: _Optional[int] = ..., first: _Optional[int] = ..., last: _Optional[int] = ...) -> None: ...

class Loss(_message.Message):
    __slots__ = ("robot", "sensor", "epoch", "first_sequence", "count", "reason", "stamp_ns")
    ROBOT_FIELD_NUMBER: _ClassVar[int]
    SENSOR_FIELD_NUMBER: _ClassVar[int]
    EPOCH_FIELD_NUMBER: _ClassVar[int]
    FIRST_SEQUENCE_FIELD_NUMBER: _ClassVar[int]
    COUNT_FIELD_NUMBER: _ClassVar[int]
    REASON_FIELD_NUMBER: _ClassVar[int]
    STAMP_NS_FIELD_NUMBER: _ClassVar[int]
    robot: str
    sensor: str
    epoch: int
    first_sequence: int
    count: int
    reason: str
    stamp_ns: int
    def __init__(self, robot: _Optional[str] = ..., sensor: _Optional[str] = ..., epoch: _Optional[int] = ..., first_sequence: _Optional[int] = ..., count: _Optional[int] = ..., reason: _Optional[str] = ..., stamp_ns: _Optional[int] = ...) -> None: ...

class Status(_message.Message):
    __slots__ = ("map_id", "revision", "stamp_ns", "health", "counters", "gauges", "stage_ms")
    class CountersEntry(_message.Message):
        __slots__ = ("key", "value")
        KEY_FIELD_NUMBER: _ClassVar[int]
        VALUE_FIELD_NUMBER: _ClassVar[int]
        key: str
        value: int
        def __init__(self, key: _Optional[str] = ..., value: _Optional[int] = ...) -> None: ...
    class GaugesEntry(_message.Message):
        __slots__ = ("key", "value")
        KEY_FIELD_NUMBER: _ClassVar[int]
        VALUE_FIELD_NUMBER: _ClassVar[int]
        key: str
        value: float
        def __init__(self, key: _Optional[str] = ..., value: _Optional[float] = ...) -> None: ...
    class StageMsEntry(_message.Message):
        __slots__ = ("key", "value")
        KEY_FIELD_NUMBER: _ClassVar[int]
        VALUE_FIELD_NUMBER: _ClassVar[int]
        key: str
        value: float
        def __init__(self, key: _Optional[str] = ..., value: _Optional[float] = ...) -> None: ...
    MAP_ID_FIELD_NUMBER: _ClassVar[int]
    REVISION_FIELD_NUMBER: _ClassVar[int]
    STAMP_NS_FIELD_NUMBER: _ClassVar[int]
    HEALTH_FIELD_NUMBER: _ClassVar[int]
    COUNTERS_FIELD_NUMBER: _ClassVar[int]
    GAUGES_FIELD_NUMBER: _ClassVar[int]
    STAGE_MS_FIELD_NUMBER: _ClassVar[int]
    map_id: str
    revision: int
    stamp_ns: int
    health: str
    counters: _containers.ScalarMap[str, int]
    gauges: _containers.ScalarMap[str, float]
    stage_ms: _containers.ScalarMap[str, float]
    def __init__(self, map_id: _Optional[str] = ..., revision: _Optional[int] = ..., stamp_ns: _Optional[int] = ..., health: _Optional[str] = ..., counters: _Optional[_Mapping[str, int]] = ..., gauges: _Optional[_Mapping[str, float]] = ..., stage_ms: _Optional[_Mapping[str, float]] = ...) -> None: ...
