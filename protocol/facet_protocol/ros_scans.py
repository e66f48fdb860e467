"""sensor_msgs/PointCloud2 and LaserScan: points in the sensor's frame, in every legal layout."""

from __future__ import annotations

from itertools import pairwise
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from facet_protocol.cdr import CdrReader
from facet_protocol.messages import IDENTITY, Envelope, ProtocolError, Scan, ScanKind
from facet_protocol.projection import MAX_ANGLE, count_ignored, project_fan
from facet_protocol.ros import Header, read_header
from facet_protocol.ros_definitions import LASER_SCAN, POINT_CLOUD

_CODES = ("", "i1", "u1", "i2", "u2", "i4", "u4", "f4", "f8")  # PointField.datatype
_AXES = ("f4", "f8")
_FIELD_BYTES = 4 + 4 + 1 + 4  # the least that a PointField takes
_NONE = np.empty((0, 3), dtype=np.float32)


class _Field(NamedTuple):
    name: str
    offset: int
    datatype: int
    num: int


class _Shape(NamedTuple):
    height: int
    width: int
    point_step: int
    row_step: int


def decode_ros_scan(envelope: Envelope, robot: str, sensor: str, reach_m: float) -> Scan:
    """The scan in `envelope`, its pose the identity: a caller places it.

    Raises ProtocolError: malformed, bad_length, bad_layout, bad_stamp, unknown_schema. Points of a
    PointCloud2 may be a view of the payload; ranges of a LaserScan outside of its limits are left
    out and counted (too_near, too_far).
    """
    reader = CdrReader(envelope.payload, envelope.schema)
    ignored: dict[str, int] = {}
    if envelope.schema == POINT_CLOUD:
        header, points, no_return = _read_cloud(reader)
        kind = ScanKind.CLOUD
    elif envelope.schema == LASER_SCAN:
        header, points, no_return, ignored = _read_fan(reader, reach_m)
        kind = ScanKind.LINE
    else:
        raise ProtocolError(f"{envelope.schema[:80]!r} is not a scan of ROS", "unknown_schema")
    return Scan(
        robot=robot,
        sensor=sensor,
        epoch=envelope.epoch,
        sequence=envelope.sequence,
        stamp_ns=header.stamp_ns,
        frame_id=header.frame_id,
        kind=kind,
        pose=IDENTITY,
        points=points,
        no_return=no_return,
        ignored=ignored,
        has_pose=False,
    )


def _read_cloud(
    reader: CdrReader,
) -> tuple[Header, NDArray[np.float32], NDArray[np.float32]]:
    header = read_header(reader)
    height, width = (int(n) for n in reader.numbers("2I"))
    fields = [_read_field(reader) for _ in range(reader.count(_FIELD_BYTES))]
    (is_bigendian,) = reader.numbers("B")
    point_step, row_step = (int(n) for n in reader.numbers("2I"))
    data = reader.octets()
    reader.numbers("B")  # is_dense: a cloud that says so may hold NaN all the same
    reader.end()
    shape = _Shape(height, width, point_step, row_step)
    _check_shape(shape, len(data))
    if len(data) == 0:
        return header, _NONE, _NONE
    dtype = _row_dtype(fields, ">" if is_bigendian else "<", point_step)
    return header, *_read_points(shape, dtype, data)


def _read_field(reader: CdrReader) -> _Field:
    name = reader.string()
    (offset,) = reader.numbers("I")
    (datatype,) = reader.numbers("B")
    (count,) = reader.numbers("I")
    return _Field(name, int(offset), int(datatype), int(count))


def _refuse(text: str) -> ProtocolError:
    return ProtocolError(f"{POINT_CLOUD}: {text}", "bad_layout")


def _check_shape(shape: _Shape, num_bytes: int) -> None:
    height, width, point_step, row_step = shape
    if height * width == 0 and num_bytes == 0:
        return
    if point_step == 0 or row_step < width * point_step:
        raise _refuse(f"row_step {row_step} is less than width {width} x point_step {point_step}")
    if point_step > num_bytes:  # of rows without a point, too
        raise _refuse(f"point_step {point_step} is more than the {num_bytes} bytes there are")
    if height * row_step != num_bytes:
        raise _refuse(f"{num_bytes} bytes, height {height} x row_step {row_step} says otherwise")


def _row_dtype(fields: list[_Field], order: str, point_step: int) -> np.dtype[np.void]:
    """One point as a structured type: x, y, z, and `no_return` where there is one."""
    wanted = [f for f in fields if f.name in ("x", "y", "z", "no_return")]
    if sorted(f.name for f in wanted if f.name != "no_return") != ["x", "y", "z"]:
        raise _refuse(f"fields {[f.name[:40] for f in fields][:20]}, expected x, y, z once each")
    codes = [_code(field, point_step) for field in wanted]
    spans = sorted((f.offset, f.offset + int(c[1])) for f, c in zip(wanted, codes, strict=True))
    if any(a_end > b for (_, a_end), (b, _) in pairwise(spans)):
        raise _refuse(f"fields overlap: bytes {spans}")
    return np.dtype(
        {
            "names": [field.name for field in wanted],
            "formats": [order + code for code in codes],
            "offsets": [field.offset for field in wanted],
            "itemsize": point_step,
        }
    )


def _code(field: _Field, point_step: int) -> str:
    code = _CODES[field.datatype] if field.datatype < len(_CODES) else ""
    expected = ("u1",) if field.name == "no_return" else _AXES
    if code not in expected or field.num > 1:
        text = f"datatype {field.datatype} x {field.num}, expected one of {', '.join(expected)}"
        raise _refuse(f"field {field.name!r} has {text}")
    end = field.offset + int(code[1])
    if end > point_step:
        raise _refuse(f"field {field.name!r} ends at byte {end} of point_step {point_step}")
    return code


def _read_points(
    shape: _Shape, dtype: np.dtype[np.void], data: memoryview
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """(returns, ends of empty beams), each (N, 3) m."""
    strides = (shape.row_step, shape.point_step)
    rows: NDArray[np.void] = np.ndarray((shape.height, shape.width), dtype, data, 0, strides)
    points = _as_one_view(rows, shape, data)
    if points is None:
        points = np.empty((shape.height * shape.width, 3), dtype=np.float32)
        with np.errstate(over="ignore", invalid="ignore"):  # beyond float32: the map counts it
            for k, axis in enumerate("xyz"):
                points[:, k] = rows[axis].reshape(-1)
    if "no_return" in (dtype.names or ()):
        empty = rows["no_return"].reshape(-1) != 0
        return points[~empty], points[empty]
    return points, _NONE


def _as_one_view(
    rows: NDArray[np.void], shape: _Shape, data: memoryview
) -> NDArray[np.float32] | None:
    """(N, 3) without a copy, where x, y, z are this machine's float32 in a regular order."""
    fields: Any = rows.dtype.fields
    (xt, x), (yt, y), (zt, z) = (fields[axis][:2] for axis in "xyz")
    if not (xt == yt == zt == np.dtype("f4")) or y - x != z - y:
        return None
    if shape.height > 1 and shape.row_step != shape.width * shape.point_step:
        return None
    size = shape.height * shape.width
    return np.ndarray((size, 3), np.float32, data, x, (shape.point_step, y - x))


def _read_fan(
    reader: CdrReader, reach_m: float
) -> tuple[Header, NDArray[np.float32], NDArray[np.float32], dict[str, int]]:
    header = read_header(reader)
    start, _, step, _, _, low, high = (float(n) for n in reader.numbers("7f"))
    with np.errstate(invalid="ignore"):  # a signalling NaN is a NaN
        ranges = reader.floats().astype(np.float64)
    reader.floats()  # intensities
    reader.end()
    end = start + max(0, ranges.size - 1) * step
    if not (abs(start) <= MAX_ANGLE and abs(end) <= MAX_ANGLE):
        text = f"{ranges.size} beams from {start} rad by {step} rad"
        raise ProtocolError(f"{LASER_SCAN}: {text}", "bad_layout")
    ignored = _leave_out(ranges, low, high)
    points, no_return = project_fan(start, end, ranges, reach_m)
    return header, points, no_return, ignored


def _leave_out(ranges: NDArray[np.float64], low: float, high: float) -> dict[str, int]:
    """Make NaN of what lies outside of the limits, and count all that says nothing (REP 117: -inf
    is too near, +inf came back empty). Limits that are none do not limit."""
    near = np.isneginf(ranges) | ((ranges > 0.0) & (ranges < low))
    far = (ranges > high) & np.isfinite(ranges) if high > 0.0 else np.zeros(ranges.size, bool)
    counts = {"too_near": int(near.sum()), "too_far": int(far.sum())}
    ignored = {reason: num for reason, num in counts.items() if num}
    ranges[near] = 1.0  # counted already
    ranges[far] = 1.0
    ignored.update(count_ignored(ranges))
    ranges[near | far] = np.nan
    return ignored
