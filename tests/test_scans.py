"""Scans in: heads, poses, frames, stamps; line scans and what they leave out."""

from __future__ import annotations

import struct
from dataclasses import replace

import numpy as np
import pytest
from foxglove_schemas_protobuf.LaserScan_pb2 import LaserScan
from foxglove_schemas_protobuf.PointCloud_pb2 import PointCloud

from examples import CLOUD, FAN, POSE, SCAN_KEY, envelope
from facet_protocol import Envelope, ProtocolError, Scan, ScanKind, decode_scan, encode_scan
from facet_protocol.codec import decode
from facet_protocol.poses import pose_message


def reason(payload: bytes, schema: str = "foxglove.LaserScan", **options: object) -> str:
    with pytest.raises(ProtocolError) as caught:
        decode_scan(Envelope(SCAN_KEY, schema, "protobuf", payload), "r", "s", **options)  # type: ignore[arg-type]
    return caught.value.reason


def test_a_cloud_comes_back_whole() -> None:
    scan = decode(envelope(CLOUD))
    assert isinstance(scan, Scan)
    assert scan.source == "r1/front"
    assert (scan.epoch, scan.sequence, scan.stamp_ns) == (7, 42, CLOUD.stamp_ns)
    assert (scan.frame_id, scan.kind) == ("map", ScanKind.CLOUD)
    assert scan.pose.orientation_xyzw.tobytes() == CLOUD.pose.orientation_xyzw.tobytes()
    assert scan.points.tobytes() == CLOUD.points.tobytes()
    assert scan.no_return.tobytes() == CLOUD.no_return.tobytes()
    assert not scan.renormalised


def test_a_cloud_without_empty_beams_has_twelve_bytes_a_point() -> None:
    _, payload = encode_scan(replace(CLOUD, no_return=CLOUD.no_return[:0]))
    message = PointCloud.FromString(payload)
    assert (message.point_stride, len(message.fields)) == (12, 3)
    assert encode_scan(CLOUD)[1] == encode_scan(CLOUD)[1]


def test_a_fan_is_projected_and_what_it_leaves_out_is_counted() -> None:
    scan = decode_scan(envelope(FAN), "r1", "front", reach_m=6.0)
    assert scan.kind is ScanKind.LINE
    assert len(scan.points) == 2
    np.testing.assert_allclose(np.linalg.norm(scan.no_return, axis=1), [6.0], rtol=1e-6)
    assert scan.ignored == {"nan": 1, "not_positive": 1}


def test_a_projected_line_has_no_way_back() -> None:
    scan = decode_scan(envelope(FAN), "r1", "front")
    with pytest.raises(ProtocolError, match="LineFan"):
        encode_scan(scan)


def test_a_quaternion_off_by_little_is_renormalised_and_said() -> None:
    off = replace(POSE, orientation_xyzw=POSE.orientation_xyzw * 1.0005)
    scan = decode_scan(envelope(replace(FAN, pose=off)), "r1", "front")
    assert scan.renormalised
    assert abs(np.linalg.norm(scan.pose.orientation_xyzw) - 1.0) < 1e-15


def test_bad_heads_are_refused_by_reason() -> None:
    pose = pose_message(POSE)
    assert reason(LaserScan(frame_id="map").SerializeToString()) == "bad_pose"
    good = LaserScan(frame_id="odom", pose=pose).SerializeToString()
    assert reason(good, frame_id="map") == "wrong_frame"
    assert reason(good[:-1]) == "malformed"
    assert reason(b"") == "malformed"
    assert reason(b"", "foxglove.PointCloud") == "malformed"
    assert reason(good, "foxglove.Grid") == "unknown_schema"
    pose.orientation.w += 0.01
    assert reason(LaserScan(pose=pose).SerializeToString()) == "bad_quaternion"
    pose.position.x = np.nan
    assert reason(LaserScan(pose=pose).SerializeToString()) == "bad_pose"
    pose.ClearField("orientation")
    pose.position.x = 0.0
    assert reason(LaserScan(pose=pose).SerializeToString()) == "bad_quaternion"


@pytest.mark.parametrize("angle", [np.nan, np.inf, 1e300, -1001.0])
def test_angles_that_no_scanner_has_are_refused(angle: float) -> None:
    message = LaserScan(pose=pose_message(POSE), start_angle=angle, ranges=[1.0])
    assert reason(message.SerializeToString()) == "bad_layout"


def _doubles(values: list[float], *, packed: bool) -> bytes:
    """Field 6 of a LaserScan as protobuf may write it."""
    each = [struct.pack("<d", value) for value in values]
    if packed:
        return bytes([6 << 3 | 2, 8 * len(each)]) + b"".join(each)
    return b"".join(bytes([6 << 3 | 1]) + one for one in each)


def test_ranges_may_be_written_in_pieces() -> None:
    bare = LaserScan(frame_id="map", pose=pose_message(POSE)).SerializeToString()
    whole = bare + _doubles([1.0, 2.0, np.inf], packed=True)
    pieces = _doubles([1.0], packed=True) + bare + _doubles([2.0, np.inf], packed=True)
    apart = bare + _doubles([1.0, 2.0, np.inf], packed=False)
    told = [decode_scan(Envelope("s", "foxglove.LaserScan", "protobuf", p), "r", "s")
            for p in (whole, pieces, apart)]  # fmt: skip
    for scan in told:
        assert (len(scan.points), len(scan.no_return)) == (2, 1)
        np.testing.assert_array_equal(scan.points, told[0].points)


def test_what_the_walk_does_not_follow_protobuf_reads() -> None:
    bare = LaserScan(frame_id="map", pose=pose_message(POSE)).SerializeToString()
    many = bare + _doubles([1.0] * 600, packed=False)
    group = bare + _doubles([1.0] * 600, packed=False) + bytes([15 << 3 | 3, 15 << 3 | 4])
    for payload in (many, group):
        scan = decode_scan(Envelope("s", "foxglove.LaserScan", "protobuf", payload), "r", "s")
        assert len(scan.points) == 600


def test_bytes_that_are_no_doubles_are_refused() -> None:
    bare = LaserScan(frame_id="map", pose=pose_message(POSE)).SerializeToString()
    assert reason(bare + bytes([6 << 3 | 2, 7]) + bytes(7)) == "malformed"


def test_a_scan_to_be_placed_later_needs_no_pose() -> None:
    payload = LaserScan(frame_id="laser", ranges=[1.0]).SerializeToString()
    bare = Envelope("scan", "foxglove.LaserScan", "protobuf", payload, stamp_ns=5)
    scan = decode_scan(bare, "r", "s", pose_required=False)
    assert scan.pose.orientation_xyzw.tolist() == [0.0, 0.0, 0.0, 1.0]
    assert (scan.frame_id, scan.stamp_ns) == ("laser", 5)


def test_a_key_that_names_no_robot_is_refused() -> None:
    with pytest.raises(ProtocolError) as caught:
        decode(replace(envelope(CLOUD), key="rt/points"))
    assert caught.value.reason == "bad_key"
