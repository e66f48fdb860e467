"""Which messages become scans, and under what name the others are counted."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from facet.admission import Admission
from facet.placement import Admitted
from facet.sources.naming import robot_and_sensor
from facet.status import Account
from facet_protocol.messages import Envelope, Pose
from rig import room, room_scan, scan_envelope, unnumbered


@pytest.fixture(autouse=True)
def _large_scans_too(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("facet.admission.FORESEEN_BYTES", 1 << 24)


def admit(*envelopes: Envelope) -> tuple[list[int], dict[str, int]]:
    """(numbers of what was admitted, what was counted): the same whether foreseen or not."""
    told = [_admit(envelopes, foreseen) for foreseen in (0, 1, len(envelopes))]
    assert told[0] == told[1] == told[2]
    return told[0]


def _admit(envelopes: tuple[Envelope, ...], foreseen: int) -> tuple[list[int], dict[str, int]]:
    account = Account()
    admission = Admission(account, "map", 8.0)
    admission.foresee(envelopes[:foreseen])
    outcomes = [one for envelope in envelopes for one in admission.admit(envelope)]
    assert not admission._foreseen
    counted = {n: v for n, v in account.counters().items() if "[" not in n}
    return [one.scan.sequence for one in outcomes if isinstance(one, Admitted)], counted


def test_every_scan_once() -> None:
    a, b, c = room(3)
    assert admit(a, b, a, c, b) == ([1, 2, 3], {"duplicate": 2})


def test_what_is_foreseen_is_not_read_again(monkeypatch: pytest.MonkeyPatch) -> None:
    envelopes = room(3)
    admission = Admission(Account(), "map", 8.0)
    admission.foresee(envelopes)
    monkeypatch.setattr(admission, "_read", None)
    outcomes = [one for envelope in envelopes for one in admission.admit(envelope)]
    assert [one.scan.sequence for one in outcomes if isinstance(one, Admitted)] == [1, 2, 3]


def test_no_more_is_foreseen_than_there_is_room_for(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("facet.admission.MOST_FORESEEN", 2)
    admission = Admission(Account(), "map", 8.0)
    admission.foresee(room(3))
    assert len(admission._foreseen) == 2
    monkeypatch.setattr("facet.admission.FORESEEN_BYTES", 10)
    admission = Admission(Account(), "map", 8.0)
    admission.foresee(room(3))
    assert not admission._foreseen


def test_what_cannot_be_foreseen_fails_in_its_turn(monkeypatch: pytest.MonkeyPatch) -> None:
    admission = Admission(Account(), "map", 8.0)
    (envelope,) = room(1)

    def fail(envelope: Envelope) -> None:
        raise MemoryError

    monkeypatch.setattr(admission, "_read", fail)
    admission.foresee([envelope])
    with pytest.raises(MemoryError):
        admission.admit(envelope)


def test_the_same_sequence_of_another_epoch_or_robot_is_another_scan() -> None:
    a = room(1)[0]
    assert admit(a, replace(a, epoch=6), room(1, "r2")[0]) == ([1, 1, 1], {})


def test_without_a_sequence_stamp_and_bytes_decide() -> None:
    a, b = (unnumbered(e) for e in room(2))
    other = replace(a, payload=scan_envelope(room_scan(9)).payload)
    assert len(admit(a, b, a, other)[0]) == 3


def test_what_is_no_good_scan_is_counted_by_reason() -> None:
    good = room(1)[0]
    scan = room_scan(2)
    elsewhere = scan_envelope(replace(scan, frame_id="sensor"))
    turned = Pose(scan.pose.position, np.array([0.0, 0.0, 0.0, 1.1]))
    admitted, counted = admit(
        replace(good, payload=b""),
        replace(good, schema="facet.v9.Scan"),
        elsewhere,
        scan_envelope(replace(scan, pose=turned)),
        good,
    )
    assert admitted == [1]
    assert counted == {
        "rejected.malformed": 1,
        "rejected.unknown_schema": 1,
        "rejected.wrong_frame": 1,
        "rejected.bad_quaternion": 1,
    }


def test_a_bad_name_is_refused_and_not_mended() -> None:
    good = room(1)[0]
    for robot in ("a b", "..", "x" * 65, "r\u202e1", "**"):
        admitted, counted = admit(replace(good, key=f"facet/v1/map/robot/{robot}/scan/lidar"))
        assert admitted == []
        assert list(counted) in (["rejected.bad_id"], ["rejected.bad_key"])


def test_a_bad_message_does_not_use_up_its_sequence() -> None:
    good = room(1)[0]
    assert admit(replace(good, payload=good.payload[:40]), good)[0] == [1]


def test_a_topic_from_elsewhere_gets_a_name() -> None:
    assert robot_and_sensor("facet/v1/map/robot/r1/scan/front") == ("r1", "front")
    assert robot_and_sensor("/velodyne/points 2") == ("robot", "velodyne_points_2")
    assert robot_and_sensor("../..") == ("robot", "scan")
