"""Bad messages (F1-F18, F35): each is counted by its reason, said once, recorded as it came, and
leaves no trace in the map; the other robots go on."""

from __future__ import annotations

import hashlib
import logging
import time
import tracemalloc
from collections.abc import Callable
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from facet_protocol.codec import decode
from facet_protocol.messages import Conflict, Envelope, LineFan, Pose, ProtocolError
from facet_protocol.scans import encode_fan
from facet_protocol.topics import CONFLICT_TOPIC, scan_key
from fault_rig import (
    SOURCE,
    Line,
    around,
    changed,
    envelopes,
    left_out,
    lines,
    small_scan,
    with_rows,
)
from rig import START_NS, scan_envelope

Log = pytest.LogCaptureFixture
GOOD = scan_envelope(small_scan(5))
PAYLOAD = bytes(GOOD.payload)


def turned(*quaternion: float) -> Envelope:
    scan = small_scan(5)
    return scan_envelope(replace(scan, pose=Pose(scan.pose.position, np.array(quaternion))))


def moved(x: float) -> Envelope:
    scan = small_scan(5)
    return scan_envelope(
        replace(scan, pose=Pose(np.array([x, 0.0, 1.2]), scan.pose.orientation_xyzw))
    )


def framed(frame_id: str) -> Envelope:
    return scan_envelope(replace(small_scan(5), frame_id=frame_id))


def field(name: str, **values: Any) -> Callable[[Any], None]:
    """Spoil one field of a cloud's layout."""

    def change(message: Any) -> None:
        (wanted,) = (f for f in message.fields if f.name == name)
        for key, value in values.items():
            setattr(wanted, key, value)

    return change


def setting(name: str, value: Any) -> Callable[[Any], None]:
    return lambda message: setattr(message, name, value)


LEFT_OUT: dict[str, tuple[list[Envelope], str]] = {
    "F1-empty": ([replace(GOOD, payload=b"")], "malformed"),
    "F1-cut": ([replace(GOOD, payload=PAYLOAD[:n]) for n in (1, 9, 77, 600)], "malformed"),
    "F1-trailing": ([replace(GOOD, payload=PAYLOAD + b"\x07")], "malformed"),
    "F2-count": ([replace(GOOD, payload=PAYLOAD[:30] + b"\x2a\xff\xff\xff\xff\x07")], "malformed"),
    "F3-schema": ([replace(GOOD, schema="foxglove.PointCloud9")], "unknown_schema"),
    "F3-encoding": ([replace(GOOD, encoding="flatbuffer")], "unknown_schema"),
    "F5-stride-0": ([changed(setting("point_stride", 0))], "bad_layout"),
    "F5-ragged": ([changed(setting("point_stride", 13))], "bad_layout"),
    "F5-offset": ([changed(field("z", offset=9))], "bad_layout"),
    "F5-type": ([changed(field("x", type=0))], "bad_layout"),
    "F5-overlap": ([changed(field("y", offset=2))], "bad_layout"),
    "F10-nan": ([moved(float("nan"))], "bad_pose"),
    "F10-inf": ([moved(float("inf")), moved(-float("inf"))], "bad_pose"),
    "F12-zero": ([turned(0.0, 0.0, 0.0, 0.0)], "bad_quaternion"),
    "F12-off": ([turned(0.0, 0.0, 0.0, 1.0011)], "bad_quaternion"),
    "F13-unknown": ([framed("odom")], "wrong_frame"),
    "F13-none": ([framed("")], "wrong_frame"),
    "F16-nanos": ([changed(lambda m: setattr(m.timestamp, "nanos", 1_000_000_000))], "bad_stamp"),
}


@pytest.mark.parametrize("name", LEFT_OUT)
def test_left_out(name: str, tmp_path: Path, caplog: Log) -> None:
    bad, reason = LEFT_OUT[name]
    left_out(tmp_path, caplog, bad, reason)


def decode_every_prefix() -> None:
    """Each is a ProtocolError or a scan."""
    for length in range(len(PAYLOAD)):
        with suppress(ProtocolError):
            decode(replace(GOOD, payload=PAYLOAD[:length]))


@pytest.mark.slow
def test_f1_f2_the_decoder_is_quick() -> None:
    started = time.perf_counter()
    decode_every_prefix()
    assert (time.perf_counter() - started) / len(PAYLOAD) < 1e-3


def test_f1_f2_the_decoder_takes_little() -> None:
    tracemalloc.start()
    decode_every_prefix()
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert peak <= 2 * len(PAYLOAD) + (1 << 20)


POINTS: dict[str, tuple[list[list[float]], dict[str, int]]] = {
    "F6-nan": ([[np.nan, 1, 1], [1, np.nan, 1], [1, 1, np.nan]], {"nan": 3}),
    "F7-inf": ([[np.inf, 1, 1], [1, -np.inf, 1]], {"inf": 2}),
    "F8-near": ([[0, 0, 0], [0.001, 0, 0]], {"too_near": 2}),
    "F8-far": ([[900, 0, 0], [0, -5000, 0]], {"too_far": 2}),
    "F6-F8": ([[np.nan, 0, 0], [np.inf, 0, 0], [0, 0, 0]], {"nan": 1, "inf": 1, "too_near": 1}),
}


@pytest.mark.parametrize("name", POINTS)
def test_points_left_out(name: str, tmp_path: Path) -> None:
    """Those points alone: the rest of the scan is in the map as if they had never been."""
    rows, reasons = POINTS[name]
    clean = Line(tmp_path / "clean").take(around([GOOD]))
    spoiled = Line(tmp_path / "spoiled").take(around([scan_envelope(with_rows(rows))]))
    assert spoiled.state() == clean.state()
    account = spoiled.account
    for reason, num in reasons.items():
        assert account[f"points_rejected.{reason}[{SOURCE}]"] == num
    assert account.balance("r2/lidar").points_rejected == 0
    assert account.balance().points_rejected == sum(reasons.values())
    assert spoiled.num_points() == account["points_stored"]


def test_f7_no_return_of_a_line_scan(tmp_path: Path) -> None:
    """0, NaN and negative ranges say nothing; +inf is a beam that met nothing, and no point."""
    ranges = np.array([2.0, 0.0, np.nan, np.inf, -1.0, 2.5])
    pose = small_scan(1).pose
    fan = LineFan("r1", "line", 5, 1, START_NS, "map", pose, -1.0, 1.0, ranges)
    key = scan_key("map", "r1", "line")
    line = Line(tmp_path).take(
        [Envelope(key, "foxglove.LaserScan", "protobuf", encode_fan(fan), START_NS, 5, 1, START_NS)]
    )
    balance = line.account.balance("r1/line")
    assert (balance.points_in, balance.points_stored, balance.points_rejected) == (5, 2, 3)
    assert line.num_points() == 2


def test_f9_out_of_bounds_never_wraps(tmp_path: Path) -> None:
    """A robot beyond the map's bounds, by one voxel and by the 2^21 voxels at which keys wrap."""
    clean = Line(tmp_path / "clean").take(around([]))
    far = [moved(x) for x in (50_010.0, -50_010.0, 0.1 * 2**21, -0.1 * 2**21)]
    numbered = [replace(e, sequence=5 + k) for k, e in enumerate(far)]
    spoiled = Line(tmp_path / "spoiled").take(around(numbered))
    assert spoiled.state() == clean.state()
    assert spoiled.account[f"points_rejected.out_of_bounds[{SOURCE}]"] == 4 * 300


def test_f11_a_quaternion_a_little_off_is_renormalised(tmp_path: Path) -> None:
    line = Line(tmp_path).take(around([turned(0.0, 0.0, 0.0, 1.0 + 9e-4)]))
    assert line.account[f"renormalised[{SOURCE}]"] == line.account["renormalised"] == 1
    assert line.account.balance().rejected == 0
    assert line.state() == Line(tmp_path / "exact").take(around([GOOD])).state()


def test_f14_a_scan_waits_for_its_pose_and_then_no_longer(tmp_path: Path, caplog: Log) -> None:
    """In flight while it waits, bounded in stamps; then `no_pose`, and no trace in the map."""

    def poseless(message: Any) -> None:
        message.ClearField("pose")
        message.frame_id = "lidar"

    clean = Line(tmp_path / "clean").take(around([]))
    line = Line(tmp_path / "spoiled").take(around([changed(poseless)]))
    assert line.account.balance(SOURCE).in_flight == 1
    with caplog.at_level(logging.WARNING):
        line.finish()
    assert line.account[f"rejected.no_pose[{SOURCE}]"] == 1
    assert line.account.balance().in_flight == 0
    assert line.account.balance().is_exact
    assert len(lines(caplog, "no_pose")) == 1
    assert line.state() == clean.state()
    assert line.account["applied[r2/lidar]"] == 2


def oddly(tmp_path: Path, caplog: Log, odd: list[Envelope], name: str) -> Line:
    """Applied and yet counted, under the name of what is odd."""
    line = Line(tmp_path).take([*envelopes("r1", 1), *odd, *envelopes("r2", 1)])
    assert line.account[f"{name}[{SOURCE}]"] == line.account[name] == 1
    assert line.account["applied"] == 2 + len(odd)
    assert len(lines(caplog, name)) == 1
    return line


def stamped(stamp_ns: int) -> Envelope:
    return scan_envelope(replace(small_scan(5), stamp_ns=stamp_ns))


def at(x: float, turn_deg: float = 0.0, after_ms: float = 25.0, sequence: int = 5) -> Envelope:
    """A scan so long after the first of r1, so far from where that was taken."""
    half = np.radians(turn_deg) / 2.0
    pose = Pose(np.array([x, 0.0, 1.2]), np.array([0.0, 0.0, np.sin(half), np.cos(half)]))
    stamp_ns = small_scan(1).stamp_ns + int(after_ms * 1e6)
    return scan_envelope(replace(small_scan(sequence), pose=pose, stamp_ns=stamp_ns))


JUMPS = {
    "moved": at(5.01),
    "far": at(-400.0),
    "turned": at(0.0, 90.5),
    "back": at(0.0, 180.0),
    "earlier": at(5.01, after_ms=-25.0),
}
NO_JUMPS = {"less": at(4.99), "turned": at(0.0, 89.5), "later": at(400.0, after_ms=101.0)}


@pytest.mark.parametrize("name", JUMPS)
def test_f15_a_jump_is_flagged(name: str, tmp_path: Path, caplog: Log) -> None:
    """And applied, for it may be that the robot knows better now."""
    jump = JUMPS[name]
    line = Line(tmp_path).take([*envelopes("r1", 1), jump, *envelopes("r2", 1)])
    assert line.account[f"pose_jump[{SOURCE}]"] == line.account["pose_jump"] == 1
    assert line.account["applied"] == 3
    assert len(lines(caplog, "pose_jump")) == 1


@pytest.mark.parametrize("name", JUMPS)
def test_f15_a_jump_is_refused_where_that_is_asked_for(
    name: str, tmp_path: Path, caplog: Log
) -> None:
    """The scan that comes next is compared with the last good one, not with the refused."""
    left_out(tmp_path / "one", caplog, [JUMPS[name]], "pose_jump", reject_jumps=True)
    caplog.clear()
    twice = [JUMPS[name], at(0.5, after_ms=75.0, sequence=6)]
    line = Line(tmp_path / "two", reject_jumps=True).take(around(twice))
    assert line.account["rejected.pose_jump"] == 1
    assert line.account["applied[r1/lidar]"] == 3


@pytest.mark.parametrize("name", NO_JUMPS)
def test_f15_what_is_no_jump_is_neither(name: str, tmp_path: Path) -> None:
    for reject in (False, True):
        line = Line(tmp_path / str(reject), reject_jumps=reject).take(around([NO_JUMPS[name]]))
        assert line.account["pose_jump"] == line.account["rejected.pose_jump"] == 0
        assert line.account["applied"] == 5


def test_f15_a_robot_that_was_carried_away_is_heard_again(tmp_path: Path, caplog: Log) -> None:
    """What is refused is not compared with: after 0.1 s of stamps nothing is a jump any more."""
    there = [at(50.0, after_ms=25.0 * k, sequence=10 + k) for k in range(1, 9)]
    line = Line(tmp_path, reject_jumps=True).take([*envelopes("r1", 1), *there])
    assert line.account["rejected.pose_jump"] == 4
    assert line.account["applied"] == 5
    assert line.account["pose_jump"] == 0
    assert len(lines(caplog, "pose_jump")) == 1


@pytest.mark.parametrize("stamp_ns", [0, 10**17, START_NS + 3 * 10**9], ids=["0", "1973", "future"])
def test_f16_a_stamp_from_no_clock_is_counted(tmp_path: Path, caplog: Log, stamp_ns: int) -> None:
    """Nothing depends on it: the map takes scans as they are recorded."""
    odd = replace(stamped(stamp_ns), received_ns=START_NS)
    oddly(tmp_path, caplog, [odd], "bad_stamp")


def test_f17_stamps_out_of_order_give_the_same_map(tmp_path: Path, caplog: Log) -> None:
    late = scan_envelope(small_scan(2))
    line = oddly(tmp_path / "a", caplog, [scan_envelope(small_scan(7)), late], "out_of_order")
    sorted_ = Line(tmp_path / "b").take([*envelopes("r1", 1, 2, 7), *envelopes("r2", 1)])
    assert line.state() == sorted_.state()
    assert sorted_.account["out_of_order"] == 0


def rivals(sequence: int) -> tuple[Envelope, Envelope]:
    """Two scans of one number: that with the smaller hash first. One has fewer points, and some
    that are refused."""
    spoiled = with_rows([[np.nan, 0, 0], [900, 0, 0], [2, 1, 0]], sequence)
    pair = (scan_envelope(small_scan(sequence)), scan_envelope(spoiled))
    better, worse = sorted(pair, key=lambda e: hashlib.sha256(e.payload).digest())
    return better, worse


@pytest.mark.parametrize("sequence", range(3, 9))
def test_f18_of_two_scans_with_one_number_the_smaller_hash_wins(
    sequence: int, tmp_path: Path, caplog: Log
) -> None:
    """Whichever came first: the other is taken out again, or never gets in. Counters are those of
    the scans that are in the map, at every step (`Line.take` asserts the law)."""
    better, worse = rivals(sequence)
    clean = Line(tmp_path / "clean").take(around([better]))
    orders = {"a": [better, worse], "b": [worse, better], "c": [worse, better, worse, better]}
    for name, order in orders.items():
        caplog.clear()
        line = Line(tmp_path / name).take(around(order))
        assert line.state() == clean.state()
        account, expected = line.account, clean.account
        left = len(order) - 1
        assert account[f"conflict[{SOURCE}]"] + account[f"duplicate[{SOURCE}]"] == left
        assert account[f"conflict[{SOURCE}]"] == (2 if name == "c" else 1)
        for source in ("r1/lidar", "r2/lidar"):
            assert account[f"applied[{source}]"] == expected[f"applied[{source}]"]
            mine, theirs = account.balance(source), expected.balance(source)
            assert mine.is_exact
            assert mine.in_flight == 0
            assert (mine.points_in, mine.points_stored, mine.points_rejected) == (
                *(theirs.points_in, theirs.points_stored, theirs.points_rejected),
            )
        assert line.num_points() == account["points_stored"]
        assert len(lines(caplog, "conflict")) == 1
        kept = [decode(e) for e in line.log() if e.key == CONFLICT_TOPIC]
        digest = hashlib.sha256(better.payload).digest()
        assert [x.kept == digest for x in kept if isinstance(x, Conflict)] == (
            [True, True] if name == "c" else [True]
        )
        assert [bytes(e.payload) for e in around(order)] == line.recorded()


def test_f18_a_duplicate_is_applied_once(tmp_path: Path) -> None:
    clean = Line(tmp_path / "clean").take(around([GOOD]))
    twice = Line(tmp_path / "twice").take(around([GOOD, GOOD, GOOD]))
    assert twice.account[f"duplicate[{SOURCE}]"] == 2
    assert twice.state() == clean.state()
    assert twice.account.balance().is_exact


NAMES = (
    *("..", "../../x", "a b", "/etc/passwd", "x\x00y", "x" * 65, "x" * 300, "CON.txt", "r\u202e1"),
    *("a\nb", "*", "**", "$*", "#", "?", "r1?", "", "é", "r1;ls", "%2e%2e", "\\..\\", "~root"),
)


@pytest.mark.parametrize("name", NAMES, ids=range(len(NAMES)))
def test_f35_a_bad_name_is_refused(name: str, tmp_path: Path) -> None:
    clean = Line(tmp_path / "clean").take(around([]))
    bad = [
        replace(GOOD, key=f"facet/v1/map/robot/{name}/scan/lidar"),
        replace(GOOD, key=f"facet/v1/map/robot/r1/scan/{name}"),
    ]
    spoiled = Line(tmp_path / "spoiled").take(around(bad))
    assert spoiled.account.balance().rejected == 2
    assert spoiled.state() == clean.state()
