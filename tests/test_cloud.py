"""Every legal layout of a PointCloud gives the same points; what is inconsistent is refused."""

from __future__ import annotations

import numpy as np
import pytest
from foxglove_schemas_protobuf.PackedElementField_pb2 import PackedElementField
from foxglove_schemas_protobuf.PointCloud_pb2 import PointCloud
from hypothesis import given
from hypothesis import strategies as st

from examples import POSE, SCAN_KEY
from facet_protocol import Envelope, ProtocolError, Scan, decode_scan
from facet_protocol.poses import pose_message

XYZ = np.array([[1, 2, 3], [-4, 5, -6], [7, 8, 9]], dtype=np.float64)
NAMES = {
    "u1": PackedElementField.UINT8,
    "i1": PackedElementField.INT8,
    "<u2": PackedElementField.UINT16,
    "<i2": PackedElementField.INT16,
    "<u4": PackedElementField.UINT32,
    "<i4": PackedElementField.INT32,
    "<f4": PackedElementField.FLOAT32,
    "<f8": PackedElementField.FLOAT64,
}
Field = tuple[str, str, int]  # name, dtype, offset


def cloud(fields: list[Field], stride: int, rows: dict[str, object], num: int = 3) -> bytes:
    """A PointCloud whose rows are laid out by hand."""
    names, formats, offsets = zip(*fields, strict=True)
    spec = {"names": names, "formats": formats, "offsets": offsets, "itemsize": stride}
    data = np.zeros(num, dtype=np.dtype(spec))  # type: ignore[call-overload]
    for name, values in rows.items():
        data[name] = values
    return message(fields, stride, data.tobytes())


def message(fields: list[Field], stride: int, data: bytes) -> bytes:
    packed = [PackedElementField(name=n, type=NAMES[t], offset=o) for n, t, o in fields]
    return PointCloud(
        frame_id="map", pose=pose_message(POSE), point_stride=stride, fields=packed, data=data
    ).SerializeToString()


def decoded(payload: bytes) -> Scan:
    return decode_scan(Envelope(SCAN_KEY, "foxglove.PointCloud", "protobuf", payload), "r", "s")


def axes(dtype: str, *offsets: int) -> list[Field]:
    return [(name, dtype, offset) for name, offset in zip("xyz", offsets, strict=True)]


XYZ_ROWS: dict[str, object] = {"x": XYZ[:, 0], "y": XYZ[:, 1], "z": XYZ[:, 2]}


@pytest.mark.parametrize(
    ("fields", "stride"),
    [
        pytest.param(axes("<f4", 0, 4, 8), 12, id="tight"),
        pytest.param(axes("<f4", 0, 4, 8), 16, id="padded"),
        pytest.param(axes("<f4", 5, 9, 13), 21, id="odd"),
        pytest.param(axes("<f4", 0, 8, 16), 20, id="spread"),
        pytest.param(axes("<f4", 8, 4, 0), 12, id="reversed"),
        pytest.param(axes("<f4", 0, 12, 4), 16, id="out of order"),
        pytest.param(axes("<f8", 0, 8, 16), 24, id="float64"),
        pytest.param(axes("<i2", 0, 2, 4), 6, id="int16"),
        pytest.param(axes("i1", 0, 1, 2), 3, id="int8"),
        pytest.param(axes("<i4", 4, 8, 12), 16, id="int32"),
        pytest.param(
            [("x", "<f4", 0), ("y", "<f8", 4), ("z", "<i2", 12), ("i", "u1", 14)], 15, id="mixed"
        ),
    ],
)
def test_every_legal_layout_gives_the_same_points(fields: list[Field], stride: int) -> None:
    scan = decoded(cloud(fields, stride, XYZ_ROWS))
    assert scan.points.dtype == np.float32
    assert scan.points.tolist() == XYZ.tolist()
    assert scan.no_return.shape == (0, 3)


@pytest.mark.parametrize(("stride", "offsets"), [(12, (0, 4, 8)), (21, (5, 9, 13))])
def test_float32_is_a_view_of_the_payload(stride: int, offsets: tuple[int, ...]) -> None:
    payload = bytearray(cloud(axes("<f4", *offsets), stride, XYZ_ROWS))
    view = memoryview(payload)
    scan = decode_scan(Envelope(SCAN_KEY, "foxglove.PointCloud", "protobuf", view), "r", "s")
    assert np.shares_memory(scan.points, np.frombuffer(payload, np.uint8))


@given(
    order=st.permutations(["x", "y", "z", "intensity", "ring"]),
    types=st.lists(st.sampled_from(["<f4", "<f8", "<i2", "i1", "<i4"]), min_size=5, max_size=5),
    gaps=st.lists(st.integers(0, 5), min_size=6, max_size=6),
)
def test_any_order_types_and_gaps(order: list[str], types: list[str], gaps: list[int]) -> None:
    fields: list[Field] = []
    offset = 0
    for name, dtype, gap in zip(order, types, gaps, strict=False):
        fields.append((name, dtype, offset + gap))
        offset += gap + np.dtype(dtype).itemsize
    scan = decoded(cloud(fields, offset + gaps[-1], XYZ_ROWS))
    assert scan.points.tolist() == XYZ.tolist()


def test_a_missing_axis_is_zero() -> None:
    fields: list[Field] = [("x", "<f4", 0), ("y", "<f4", 4)]
    scan = decoded(cloud(fields, 8, {"x": XYZ[:, 0], "y": XYZ[:, 1]}))
    assert scan.points.tolist() == (XYZ * [1, 1, 0]).tolist()


def test_no_points_are_an_empty_scan() -> None:
    scan = decoded(message(axes("<f4", 0, 4, 8), 12, b""))
    assert scan.points.shape == scan.no_return.shape == (0, 3)


def test_rows_that_did_not_return_are_beams_and_never_points() -> None:
    fields = [*axes("<f4", 0, 4, 8), ("no_return", "u1", 12)]
    scan = decoded(cloud(fields, 13, {**XYZ_ROWS, "no_return": [0, 1, 255]}))
    assert scan.points.tolist() == XYZ[:1].tolist()
    assert scan.no_return.tolist() == XYZ[1:].tolist()


def test_a_float64_beyond_float32_is_infinite_and_quiet() -> None:
    scan = decoded(cloud(axes("<f8", 0, 8, 16), 24, {"x": [1e300, 0, 0]}))
    assert np.isinf(scan.points[0, 0])


@pytest.mark.parametrize(
    ("fields", "stride", "num_bytes", "says"),
    [
        (axes("<f4", 0, 4, 8), 0, 12, "12 bytes are not rows of point_stride 0"),
        (axes("<f4", 0, 4, 8), 12, 13, "13 bytes are not rows of point_stride 12"),
        (axes("<f4", 0, 4, 9), 12, 12, "offset 9 [+] 4 bytes passes point_stride 12"),
        (axes("<f4", 0, 4, 2**32 - 1), 12, 12, "passes point_stride 12"),
        (axes("<f4", 0, 4, 7), 12, 12, "'y' at 4 and 'z' at 7 overlap"),
        (axes("<f4", 0, 4, 8)[:1], 12, 12, r"at least two of x, y, z are needed, found \['x'\]"),
        ([], 12, 12, "at least two of x, y, z"),
        ([*axes("<f4", 0, 4, 8), ("x", "<f4", 12)], 16, 16, "two fields named 'x'"),
        ([*axes("<f4", 0, 4, 8), ("no_return", "<f4", 12)], 16, 16, "float32, expected uint8"),
    ],
)
def test_an_inconsistent_layout_is_refused_with_its_numbers(
    fields: list[Field], stride: int, num_bytes: int, says: str
) -> None:
    with pytest.raises(ProtocolError, match=says) as caught:
        decoded(message(fields, stride, b"\0" * num_bytes))
    assert caught.value.reason == "bad_layout"


def test_an_unknown_type_is_refused() -> None:
    field = PackedElementField(name="x", type=PackedElementField.UNKNOWN)
    payload = PointCloud(pose=pose_message(POSE), point_stride=4, fields=[field])
    with pytest.raises(ProtocolError, match="'x' has unknown type 0"):
        decoded(payload.SerializeToString())
