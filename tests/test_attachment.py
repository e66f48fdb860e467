"""The 24 bytes beside a scan."""

from contextlib import suppress

import pytest
from hypothesis import given
from hypothesis import strategies as st

from facet_protocol import ProtocolError
from facet_protocol.attachment import SIZE, Attachment, pack, unpack


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
