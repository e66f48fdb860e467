"""PointCloud2 in every legal layout, LaserScan with its limits; what is inconsistent is refused."""

from __future__ import annotations

import math
from contextlib import suppress
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

import ros_messages as ros
from facet_protocol import Envelope, ProtocolError, Scan, ScanKind, decode_scan
from ros_messages import FLOAT32, FLOAT64, field

POINTS = np.arange(36, dtype=np.float32).reshape(12, 3) / 7.0
POINTS[5] = np.nan


def envelope(message: Any, little_endian: bool = True) -> Envelope:
    return Envelope(
        "/lidar", message.__msgtype__, "cdr", ros.cdr(message, little_endian), epoch=3, sequence=9
    )


def read(message: Any, little_endian: bool = True) -> Scan:
    return decode_scan(envelope(message, little_endian), "r1", "lidar", 8.0, pose_required=False)


def refusal(message: Any) -> tuple[str, str]:
    with pytest.raises(ProtocolError) as caught:
        read(message)
    return caught.value.reason, str(caught.value)


def lay_out(
    order: list[str], datatype: int, big: bool, gaps: list[int], height: int, row_padding: int
) -> Any:
    """POINTS in rows of a layout: fields in `order`, each after so many bytes of padding."""
    size = 4 if datatype == FLOAT32 else 8
    offsets, at = {}, 0
    for axis, gap in zip(order, gaps, strict=True):
        offsets[axis] = at + gap
        at += gap + size
    width, code = len(POINTS) // height, f"{'>' if big else '<'}f{size}"
    row_step = width * at + row_padding
    data = np.full(height * row_step, 0xAB, np.uint8)
    for k, point in enumerate(POINTS):
        start = k // width * row_step + k % width * at
        for axis, value in zip("xyz", point, strict=True):
            raw = np.array(value, code).tobytes()
            begin = start + offsets[axis]
            data[begin : begin + size] = np.frombuffer(raw, np.uint8)
    return ros.cloud(
        10**18,
        "lidar",
        POINTS,
        height=height,
        width=width,
        fields=[field(axis, offsets[axis], datatype) for axis in order],
        is_bigendian=big,
        point_step=at,
        row_step=row_step,
        data=data,
        is_dense=False,
    )


@given(
    order=st.permutations(["x", "y", "z"]),
    datatype=st.sampled_from([FLOAT32, FLOAT64]),
    big=st.booleans(),
    gaps=st.lists(st.integers(0, 9), min_size=3, max_size=3),
    height=st.sampled_from([1, 2, 3, 12]),
    row_padding=st.integers(0, 17),
    little_endian=st.booleans(),
)
def test_every_legal_layout_gives_the_same_points(little_endian: bool, **layout: Any) -> None:
    scan = read(lay_out(**layout), little_endian)
    np.testing.assert_array_equal(scan.points, POINTS)
    assert (scan.frame_id, scan.stamp_ns, scan.kind) == ("lidar", 10**18, ScanKind.CLOUD)
    assert (scan.source, scan.epoch, scan.sequence) == ("r1/lidar", 3, 9)


def test_plain_points_are_a_view_of_the_payload() -> None:
    scan = read(ros.cloud(0, "lidar", POINTS))
    assert scan.points.base is not None
    assert not scan.points.flags.owndata
    np.testing.assert_array_equal(scan.points, POINTS)


def test_other_fields_do_not_matter() -> None:
    fields = [field(a, 4 * k) for k, a in enumerate("xyz")]
    fields += [field("intensity", 400, 1, 7), field("x2", 0, 77)]
    np.testing.assert_array_equal(read(ros.cloud(0, "l", POINTS, fields=fields)).points, POINTS)


def test_an_empty_cloud_is_a_scan_without_points() -> None:
    assert len(read(ros.cloud(0, "l", POINTS[:0], point_step=0)).points) == 0


def test_empty_beams_of_a_cloud() -> None:
    rows = np.zeros(3, [("xyz", "<f4", 3), ("no_return", "u1")])
    rows["xyz"] = POINTS[:3]
    rows["no_return"][1] = 1
    fields = [*(field(a, 4 * k) for k, a in enumerate("xyz")), field("no_return", 12, 2)]
    data = np.frombuffer(rows.tobytes(), np.uint8)
    other = {"fields": fields, "point_step": 13, "row_step": 39, "data": data}
    scan = read(ros.cloud(0, "l", POINTS[:3], **other))
    np.testing.assert_array_equal(scan.points, POINTS[[0, 2]])
    np.testing.assert_array_equal(scan.no_return, POINTS[[1]])


@pytest.mark.parametrize(
    ("other", "text"),
    [
        ({"point_step": 0}, "width 12 x point_step 0"),
        ({"width": 0, "point_step": 2**32 - 1}, "point_step 4294967295 is more than the 144"),
        ({"row_step": 143}, "row_step 143 is less than width 12 x point_step 12"),
        ({"row_step": 145}, "144 bytes, height 1 x row_step 145"),
        ({"height": 2}, "144 bytes, height 2 x row_step 144"),
        ({"width": 2**32 - 1, "height": 2**32 - 1}, "width 4294967295 x point_step 12"),
        ({"height": 0}, "144 bytes, height 0"),
        ({"fields": [field("x", 0), field("y", 4)]}, "['x', 'y'], expected x, y, z"),
        ({"fields": [field(a, 0) for a in "xyz"]}, "overlap"),
        ({"fields": [field(a, 4 * k, 5) for k, a in enumerate("xyz")]}, "datatype 5"),
        ({"fields": [field(a, 4 * k, 200) for k, a in enumerate("xyz")]}, "datatype 200"),
        ({"fields": [field(a, 4 * k, 7, 3) for k, a in enumerate("xyz")]}, "7 x 3"),
        ({"fields": [field(a, 4 * k + 4) for k, a in enumerate("xyz")]}, "byte 16 of point_step"),
        ({"fields": [field(a, 2**32 - 9 - k) for k, a in enumerate("xyz")]}, "of point_step 12"),
    ],
)
def test_what_is_inconsistent_is_refused_with_its_numbers(other: dict[str, Any], text: str) -> None:
    reason, said = refusal(ros.cloud(0, "lidar", POINTS, **other))
    assert reason == "bad_layout"
    assert text in said


def test_a_fan_is_projected_like_any_other() -> None:
    ranges = [1.0, 2.0, math.inf, math.nan, 0.05, 31.0, -math.inf, 0.0, 30.0]
    scan = read(ros.fan(0, "laser", ranges))
    assert scan.kind is ScanKind.LINE
    np.testing.assert_allclose(np.linalg.norm(scan.points, axis=1), [1.0, 2.0, 30.0], rtol=1e-6)
    np.testing.assert_allclose(np.linalg.norm(scan.no_return, axis=1), [8.0], rtol=1e-6)
    angles = np.arctan2(scan.points[:, 1], scan.points[:, 0])
    np.testing.assert_allclose(angles, [-1.0, -0.75, 1.0], atol=1e-6)
    assert scan.ignored == {"too_near": 2, "too_far": 1, "nan": 1, "not_positive": 1}
    assert len(scan.points) + len(scan.no_return) + sum(scan.ignored.values()) == len(ranges)


def test_limits_that_are_none_do_not_limit() -> None:
    scan = read(ros.fan(0, "laser", [0.01, 500.0], range_min=0.0, range_max=0.0))
    assert len(scan.points) == 2


def test_angles_that_are_none_are_refused() -> None:
    assert refusal(ros.fan(0, "laser", [1.0] * 9, angle_increment=math.nan))[0] == "bad_layout"
    assert refusal(ros.fan(0, "laser", [1.0] * 9, angle_min=1e9))[0] == "bad_layout"


MESSAGES = [ros.cloud(5, "lidar", POINTS), ros.fan(5, "laser", range(9))]


@pytest.mark.parametrize("message", MESSAGES)
@pytest.mark.parametrize("little_endian", [True, False])
def test_every_truncation_is_refused(message: Any, little_endian: bool) -> None:
    whole = envelope(message, little_endian)
    for end in range(len(whole.payload)):
        with pytest.raises(ProtocolError):
            decode_scan(replace(whole, payload=whole.payload[:end]), "r", "s", pose_required=False)


@pytest.mark.parametrize("message", MESSAGES)
@given(data=st.data())
def test_any_bytes_give_a_scan_or_a_protocol_error(message: Any, data: st.DataObject) -> None:
    whole = envelope(message)
    payload = bytearray(whole.payload)
    for _ in range(data.draw(st.integers(1, 6))):
        payload[data.draw(st.integers(0, len(payload) - 1))] = data.draw(st.integers(0, 255))
    with suppress(ProtocolError):
        decode_scan(replace(whole, payload=bytes(payload)), "r", "s", pose_required=False)


def test_a_scan_of_ros_has_no_pose() -> None:
    with pytest.raises(ProtocolError) as caught:
        decode_scan(envelope(MESSAGES[0]), "r", "s")
    assert caught.value.reason == "bad_pose"
