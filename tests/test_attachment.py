"""What travels beside a scan: our 24 bytes, and what ROS 2 sends."""

import struct
from contextlib import suppress

import pytest
from hypothesis import given
from hypothesis import strategies as st

from facet_protocol import ProtocolError
from facet_protocol.attachment import SIZE, Attachment, pack, unpack, unpack_ros


def test_bytes_are_those_of_the_wire() -> None:
    assert pack(1, 2, -1) == b"FCT1" + b"\1\0\0\0" + b"\2" + b"\0" * 7 + b"\xff" * 8


@given(
    epoch=st.integers(0, 2**32 - 1),
    sequence=st.integers(0, 2**64 - 1),
    stamp_ns=st.integers(-(2**63), 2**63 - 1),
)
def test_round_trip(epoch: int, sequence: int, stamp_ns: int) -> None:
    data = pack(epoch, sequence, stamp_ns)
    assert len(data) == SIZE
    assert unpack(data) == unpack(memoryview(data)) == Attachment(epoch, sequence, stamp_ns)


@pytest.mark.parametrize("values", [(-1, 0, 0), (2**32, 0, 0), (0, 2**64, 0), (0, 0, 2**63)])
def test_values_that_do_not_fit_are_refused(values: tuple[int, int, int]) -> None:
    with pytest.raises(ProtocolError, match="does not fit"):
        pack(*values)


@given(st.binary(max_size=40))
def test_any_bytes_give_an_attachment_or_a_protocol_error(data: bytes) -> None:
    with suppress(ProtocolError):
        attachment = unpack(data)
        assert pack(attachment.epoch, attachment.sequence, attachment.stamp_ns) == data


@pytest.mark.parametrize("data", [b"", b"FCT1", b"FCT2" + b"\0" * 20, b"FCT1" + b"\0" * 21])
def test_other_bytes_are_refused(data: bytes) -> None:
    with pytest.raises(ProtocolError) as caught:
        unpack(data)
    assert caught.value.reason == "bad_attachment"


GID = bytes(range(16))
NAMES = (b"\x0fsequence_number", b"\x10source_timestamp", b"\x0asource_gid")


@pytest.mark.parametrize("named", [True, False])
@pytest.mark.parametrize("length", [b"\x10", b""])
def test_every_layout_of_rmw_zenoh(named: bool, length: bytes) -> None:
    values = [struct.pack("<q", 7), struct.pack("<q", 10**18), length + GID]
    data = b"".join(n * named + v for n, v in zip(NAMES, values, strict=True))
    mark = unpack_ros(data)
    assert (mark.sequence, mark.stamp_ns) == (7, 10**18)
    assert mark.epoch == unpack_ros(data).epoch > 0
    other = unpack_ros(data[:-1] + b"x")
    assert other.epoch != mark.epoch  # another publisher


@given(st.binary(max_size=90))
def test_other_bytes_are_not_rmw_zenohs(data: bytes) -> None:
    with suppress(ProtocolError):
        assert unpack_ros(data).sequence >= 0


def test_a_negative_sequence_is_refused() -> None:
    with pytest.raises(ProtocolError, match="-1 is below 0"):
        unpack_ros(struct.pack("<qq", -1, 0) + GID)
