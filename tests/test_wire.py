"""Parsing, poses, stamps, and the walk over a message's fields."""

import numpy as np
import pytest
from foxglove_schemas_protobuf.PointCloud_pb2 import PointCloud
from hypothesis import given
from hypothesis import strategies as st

from facet_protocol import ProtocolError
from facet_protocol.cloud import DATA_FIELD
from facet_protocol.wire import (
    MAX_TOP_FIELDS,
    check_pose,
    parse,
    split_bytes_field,
    stamp_of,
    timestamp_of,
)

Q = (0.0, 0.0, 0.0, 1.0)


def test_an_empty_payload_is_not_an_empty_message() -> None:
    with pytest.raises(ProtocolError, match="empty payload"):
        parse(PointCloud, b"")


def test_the_field_is_a_view_and_the_rest_is_parsed() -> None:
    payload = PointCloud(frame_id="map", data=b"abcdef").SerializeToString()
    message, data = split_bytes_field(PointCloud, payload, DATA_FIELD)
    assert (message.frame_id, message.data, bytes(data)) == ("map", b"", b"abcdef")
    assert data.obj is payload


def test_the_last_occurrence_counts_as_in_protobuf() -> None:
    parts = [PointCloud(frame_id="map"), PointCloud(data=b"first"), PointCloud(data=b"last")]
    payload = b"".join(part.SerializeToString() for part in parts)
    assert PointCloud.FromString(payload).data == b"last"
    assert bytes(split_bytes_field(PointCloud, payload, DATA_FIELD)[1]) == b"last"


def test_the_walk_is_bounded() -> None:
    payload = b"\x78\x01" * (MAX_TOP_FIELDS + 1)  # unknown field 15
    with pytest.raises(ProtocolError, match="more than"):
        split_bytes_field(PointCloud, payload, DATA_FIELD)
    split_bytes_field(PointCloud, payload[:-2], DATA_FIELD)


@given(st.binary(max_size=60))
def test_the_walk_agrees_with_protobuf(tail: bytes) -> None:
    payload = PointCloud(frame_id="map", point_stride=4).SerializeToString() + tail
    try:
        message, data = split_bytes_field(PointCloud, payload, DATA_FIELD)
    except ProtocolError:
        return  # groups are refused here though protobuf knows them
    whole = PointCloud.FromString(payload)
    assert bytes(data) == whole.data
    whole.ClearField("data")
    assert message.SerializeToString() == whole.SerializeToString()


def test_a_unit_quaternion_keeps_its_bits() -> None:
    q = np.array([0.1, -0.2, 0.3, 0.9])
    once, changed = check_pose((1.0, 2.0, 3.0), q / np.sqrt((q * q).sum()))
    again, still = check_pose(once.position, once.orientation_xyzw)
    assert not changed
    assert not still
    assert once.orientation_xyzw.tobytes() == again.orientation_xyzw.tobytes()


@given(st.lists(st.floats(-1.0, 1.0), min_size=4, max_size=4), st.floats(0.9991, 1.0009))
def test_a_norm_off_by_little_is_renormalised_once(q: list[float], norm: float) -> None:
    length = np.linalg.norm(q)
    if length < 1e-3:
        return
    off = [c / length * norm for c in q]
    pose, changed = check_pose((0.0, 0.0, 0.0), off)
    assert abs(np.linalg.norm(pose.orientation_xyzw) - 1.0) < 1e-14
    assert changed == (abs(norm - 1.0) > 1e-9) or abs(abs(norm - 1.0) - 1e-9) < 1e-14
    again, _ = check_pose((0.0, 0.0, 0.0), pose.orientation_xyzw)
    assert again.orientation_xyzw.tobytes() == pose.orientation_xyzw.tobytes()


@pytest.mark.parametrize("q", [(0, 0, 0, 0), (0, 0, 0, 1.0011), (0, 0, 0, 0.9989), (1e200,) * 4])
def test_a_norm_off_by_more_is_refused(q: tuple[float, ...]) -> None:
    with pytest.raises(ProtocolError) as caught:
        check_pose((0.0, 0.0, 0.0), q)
    assert caught.value.reason == "bad_quaternion"


@pytest.mark.parametrize(
    ("position", "q"),
    [
        ((np.nan, 0.0, 0.0), Q),
        ((0.0, np.inf, 0.0), Q),
        ((0.0, 0.0), Q),
        ((0.0, 0.0, 0.0), (0.0, 0.0, 0.0, np.nan)),
        ((0.0, 0.0, 0.0), (np.inf, 0.0, 0.0, 1.0)),
        ((0.0, 0.0, 0.0), Q[:3]),
    ],
)
def test_a_pose_that_is_not_finite_or_whole_is_refused(
    position: tuple[float, ...], q: tuple[float, ...]
) -> None:
    with pytest.raises(ProtocolError) as caught:
        check_pose(position, q)
    assert caught.value.reason == "bad_pose"


@given(st.integers(-(2**63), 2**63 - 1))
def test_stamps_round_trip_to_the_nanosecond(stamp_ns: int) -> None:
    assert stamp_of(timestamp_of(stamp_ns)) == stamp_ns


def test_stamps_that_are_none_are_refused() -> None:
    for seconds, nanos in [(2**62, 0), (-(2**62), 0), (0, -1), (0, 1_000_000_000)]:
        stamp = timestamp_of(0)
        stamp.seconds, stamp.nanos = seconds, nanos
        with pytest.raises(ProtocolError) as caught:
            stamp_of(stamp)
        assert caught.value.reason == "bad_stamp"
