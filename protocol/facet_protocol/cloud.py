"""The layout of a PointCloud's bytes: where x, y, z are, checked, and views without a copy."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from foxglove_schemas_protobuf.PackedElementField_pb2 import PackedElementField
from foxglove_schemas_protobuf.PointCloud_pb2 import PointCloud
from numpy.typing import NDArray

from facet_protocol.messages import ProtocolError

DATA_FIELD = PointCloud.DATA_FIELD_NUMBER

_DTYPES: Mapping[int, np.dtype[np.generic]] = {
    PackedElementField.UINT8: np.dtype("u1"),
    PackedElementField.INT8: np.dtype("i1"),
    PackedElementField.UINT16: np.dtype("<u2"),
    PackedElementField.INT16: np.dtype("<i2"),
    PackedElementField.UINT32: np.dtype("<u4"),
    PackedElementField.INT32: np.dtype("<i4"),
    PackedElementField.FLOAT32: np.dtype("<f4"),
    PackedElementField.FLOAT64: np.dtype("<f8"),
}
_FLOAT32 = _DTYPES[PackedElementField.FLOAT32]


@dataclass(frozen=True, slots=True)
class Column:
    """One field of every point: bytes [offset, offset + dtype.itemsize) of a row."""

    dtype: np.dtype[np.generic]
    offset: int


@dataclass(frozen=True, slots=True)
class Layout:
    num_points: int
    point_stride: int
    columns: dict[str, Column]


def _refuse(message: str) -> ProtocolError:
    return ProtocolError(f"foxglove.PointCloud: {message}", "bad_layout")


def read_layout(cloud: PointCloud, num_bytes: int) -> Layout:
    """Layout of `num_bytes` of points. Raises ProtocolError (bad_layout) naming the numbers."""
    stride = cloud.point_stride
    if stride == 0 or num_bytes % stride:
        raise _refuse(f"{num_bytes} bytes are not rows of point_stride {stride}")
    columns: dict[str, Column] = {}
    for field in cloud.fields:
        dtype = _DTYPES.get(field.type)
        if dtype is None:
            raise _refuse(f"field {field.name[:40]!r} has unknown type {field.type}")
        if field.offset + dtype.itemsize > stride:
            end = f"offset {field.offset} + {dtype.itemsize} bytes"
            raise _refuse(f"field {field.name[:40]!r} at {end} passes point_stride {stride}")
        if field.name in columns:
            raise _refuse(f"two fields named {field.name[:40]!r}")
        columns[field.name] = Column(dtype, field.offset)
    _check_axes(columns)
    return Layout(num_bytes // stride, stride, columns)


def _check_axes(columns: Mapping[str, Column]) -> None:
    axes = sorted((columns[a].offset, a) for a in "xyz" if a in columns)
    if len(axes) < 2:
        raise _refuse(f"at least two of x, y, z are needed, found {[a for _, a in axes]}")
    for (low, a), (high, b) in pairwise(axes):
        if low + columns[a].dtype.itemsize > high:
            raise _refuse(f"fields {a!r} at {low} and {b!r} at {high} overlap")
    beams = columns.get("no_return")
    if beams is not None and beams.dtype != np.dtype("u1"):
        raise _refuse(f"field 'no_return' is {beams.dtype.name}, expected uint8")


def read_column(layout: Layout, data: memoryview, name: str) -> NDArray[np.generic]:
    """(N,) view of one field in `data`."""
    column = layout.columns[name]
    if layout.num_points == 0:  # an offset into no bytes is an error to numpy
        return np.empty(0, dtype=column.dtype)
    return np.ndarray(
        (layout.num_points,), column.dtype, data, column.offset, (layout.point_stride,)
    )


def read_points(layout: Layout, data: memoryview) -> NDArray[np.float32]:
    """(N, 3) float32: a read-only, strided, perhaps unaligned view of `data` where x, y, z are
    float32 and evenly spaced in the row; converted otherwise. A missing axis is 0."""
    columns = layout.columns
    axes = [columns.get(a) for a in "xyz"]
    if layout.num_points and all(c is not None and c.dtype == _FLOAT32 for c in axes):
        x, y, z = (columns[a].offset for a in "xyz")
        if y - x == z - y:
            strides = (layout.point_stride, y - x)
            return np.ndarray((layout.num_points, 3), np.float32, data, x, strides)
    points = np.zeros((layout.num_points, 3), dtype=np.float32)
    with np.errstate(over="ignore", invalid="ignore"):  # beyond float32: inf, counted by the map
        for k, name in enumerate("xyz"):
            if name in columns:
                points[:, k] = read_column(layout, data, name)
    return points


def split_beams(
    layout: Layout, data: memoryview, points: NDArray[np.float32]
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """(returns, ends of empty beams) by the field `no_return`, where the cloud has one."""
    if "no_return" in layout.columns:
        empty = read_column(layout, data, "no_return") != 0
        if empty.any():
            return points[~empty], points[empty]
    return points, np.empty((0, 3), dtype=np.float32)


def pack_points(
    points: NDArray[np.float32], no_return: NDArray[np.float32]
) -> tuple[int, list[PackedElementField], bytes]:
    """(point_stride, fields, data): x, y, z float32, and uint8 no_return when there are any."""
    fields = [
        PackedElementField(name=name, offset=4 * k, type=PackedElementField.FLOAT32)
        for k, name in enumerate("xyz")
    ]
    if len(no_return) == 0:
        return 12, fields, np.asarray(points, dtype="<f4").tobytes()
    rows = np.zeros(len(points) + len(no_return), dtype=[("xyz", "<f4", (3,)), ("empty", "u1")])
    rows["xyz"][: len(points)] = points
    rows["xyz"][len(points) :] = no_return
    rows["empty"][len(points) :] = 1
    fields.append(PackedElementField(name="no_return", offset=12, type=PackedElementField.UINT8))
    return 13, fields, rows.tobytes()
