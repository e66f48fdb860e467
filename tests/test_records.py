"""Status, cuts, resolved poses, corrections, losses."""

from __future__ import annotations

from contextlib import suppress
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from examples import EXAMPLES
from facet_protocol import Correction, ProtocolError, ResolvedPose, Status
from facet_protocol.proto import service_pb2 as pb
from facet_protocol.records import (
    decode_corrected,
    decode_correction,
    decode_cut,
    decode_loss,
    decode_resolved,
    decode_status,
    encode_correction,
    encode_cut,
    encode_loss,
    encode_resolved,
    encode_status,
)

STATUS = EXAMPLES["facet.v1.Status"]
RESOLVED = EXAMPLES["facet.v1.ResolvedPose"]
CORRECTION = EXAMPLES["facet.v1.Correction"]
assert isinstance(STATUS, Status)
assert isinstance(RESOLVED, ResolvedPose)
assert isinstance(CORRECTION, Correction)


def test_status_does_not_depend_on_the_order_of_its_counters() -> None:
    turned = replace(STATUS, counters=dict(reversed(STATUS.counters.items())))
    assert encode_status(turned) == encode_status(STATUS)
    assert list(decode_status(encode_status(turned)).counters) == ["applied", "received"]


def test_a_health_that_does_not_exist_is_refused() -> None:
    with pytest.raises(ProtocolError, match="'GREAT' is not one of OK, DEGRADED, FAIL"):
        decode_status(encode_status(replace(STATUS, health="GREAT")))


def test_flat_records_come_back_equal() -> None:
    cut, loss = EXAMPLES["facet.v1.Cut"], EXAMPLES["facet.v1.Loss"]
    assert repr(decode_cut(encode_cut(cut))) == repr(cut)  # type: ignore[arg-type]
    assert repr(decode_loss(encode_loss(loss))) == repr(loss)  # type: ignore[arg-type]


def test_a_resolved_pose_keeps_its_bits() -> None:
    received = decode_resolved(encode_resolved(RESOLVED))
    assert received.pose.position.tobytes() == RESOLVED.pose.position.tobytes()
    assert received.pose.orientation_xyzw.tobytes() == RESOLVED.pose.orientation_xyzw.tobytes()


@given(st.binary(max_size=200))
def test_any_bytes_are_a_record_or_a_protocol_error(payload: bytes) -> None:
    for read in (decode_correction, decode_corrected):
        with suppress(ProtocolError):
            read(payload)


def test_a_correction_is_good_as_a_whole_or_not_at_all() -> None:
    message = pb.Correction.FromString(encode_correction(CORRECTION))
    message.poses.add(sensor="front", sequence=44).pose.position.extend([0.0, 0.0, np.nan])
    with pytest.raises(ProtocolError) as caught:
        decode_correction(message.SerializeToString())
    assert caught.value.reason == "bad_pose"
