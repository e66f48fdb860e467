"""CDR against what `rosbags` writes: both byte orders, alignment, and counts that lie."""

from __future__ import annotations

import struct

import numpy as np
import pytest

import ros_messages as ros
from facet_protocol import ProtocolError
from facet_protocol.cdr import CdrReader
from facet_protocol.ros import read_header

orders = pytest.mark.parametrize("little_endian", [True, False])


@orders
def test_values_are_aligned_to_their_size(little_endian: bool) -> None:
    for name in ("", "a", "ab", "abc", "abcd", "lidar/é"):
        scan = ros.fan(1_500_000_000, name, [1.5, 2.5], range_max=9.5)
        reader = CdrReader(ros.cdr(scan, little_endian), "LaserScan")
        assert read_header(reader) == (1_500_000_000, name)
        assert reader.numbers("7f")[-1] == 9.5
        assert reader.floats().tolist() == [1.5, 2.5]
        assert len(reader.floats()) == 0
        reader.end()


@pytest.mark.parametrize("head", [b"", b"\0\1\0", b"\0\2\0\0abcd", b"\0\7\0\0abcd"])
def test_what_is_no_cdr_is_refused(head: bytes) -> None:
    with pytest.raises(ProtocolError) as caught:
        CdrReader(head, "x")
    assert caught.value.reason == "malformed"


@orders
def test_a_count_is_not_believed(little_endian: bool) -> None:
    payload = bytearray(ros.cdr(ros.fan(0, "abc", [1.0] * 8), little_endian))
    at = payload.index(struct.pack("<I" if little_endian else ">I", 8), 20)
    payload[at : at + 4] = b"\xff\xff\xff\xff"
    reader = CdrReader(payload, "LaserScan")
    read_header(reader)
    reader.numbers("7f")
    with pytest.raises(ProtocolError, match="4294967295 items of 4 bytes") as caught:
        reader.floats()
    assert caught.value.reason == "bad_length"


def test_padding_may_follow_and_no_more() -> None:
    payload = ros.cdr(ros.transforms())
    for extra in (0, 3, 7):
        reader = CdrReader(payload + bytes(extra), "x")
        assert reader.count(1) == 0
        reader.end()
    reader = CdrReader(payload + bytes(8), "x")
    reader.count(1)
    with pytest.raises(ProtocolError, match="8 bytes follow"):
        reader.end()


def test_octets_are_a_view() -> None:
    payload = np.frombuffer(b"\0\1\0\0" + struct.pack("<I", 3) + b"abc", np.uint8)
    view = CdrReader(memoryview(payload), "x").octets()
    assert bytes(view) == b"abc"
    assert np.shares_memory(np.frombuffer(view, np.uint8), payload)
