"""Scans found again in the log: whole or in progress, in many files, after a checkpoint."""

from __future__ import annotations

from pathlib import Path

import pytest

from facet.past import Number, Past, at_once, definitions_of
from facet.sinks.log_file import write_recording
from facet.sinks.recorder import Recorder
from facet.sources.recording import Recording
from facet_protocol.messages import Envelope, ProtocolError
from rig import room

SOURCE = "r1/lidar"


def numbers(*sequences: int) -> list[Number]:
    return [Number(SOURCE, 5, k) for k in sequences]


def sequences(past: Past, *wanted: int) -> list[int]:
    found = past.read(numbers(*wanted))
    return [e.sequence for k in numbers(*wanted) for e in found.get(k, [])]


def recorded(folder: Path, scans: list[Envelope], segment_bytes: int) -> tuple[Past, Recorder]:
    """Committed one by one; the last file is in progress."""
    clock = iter(range(10**9, 10**18, 10**9))
    recorder = Recorder(folder, "map", {}, max_file_bytes=200_000, clock=lambda: next(clock))
    past = Past(segment_bytes=segment_bytes)
    for scan in scans:
        before = recorder.position
        recorder.write(scan)
        recorder.commit()
        after = recorder.position
        start = before.offset if before.file == after.file else 0
        past.note(folder / after.file, start, after.offset, [scan])
        channels = after.channels
        past.define(folder / after.file, lambda channels=channels: definitions_of(channels))
    return past, recorder


@pytest.mark.parametrize("segment_bytes", [1, 90_000, 1 << 20])
def test_every_scan_is_found_in_files_of_any_size(tmp_path: Path, segment_bytes: int) -> None:
    scans = room(12)
    past, recorder = recorded(tmp_path, [*scans[::2], *scans[1::2]], segment_bytes)
    assert len(recorder.paths) > 2
    again = Past()
    again.thaw(past.freeze(), tmp_path)
    for one in (past, again):  # the second knows no definitions of the file in progress
        for k, scan in enumerate(scans, 1):
            (found,) = one.read(numbers(k))[Number(SOURCE, 5, k)]
            assert found.payload == scan.payload
            assert (found.key, found.stamp_ns) == (scan.key, scan.stamp_ns)
        assert sequences(one, 1, 7, 12) == [1, 7, 12]
        assert sequences(one, 13) == []
        assert one.read([Number(SOURCE, 6, 1), Number("r2/lidar", 5, 1)]) == {}


def test_what_a_replay_has_read(tmp_path: Path) -> None:
    scans = room(3)
    write_recording(tmp_path / "a.mcap", [*scans, scans[0]], {})
    past = Past()
    reading = iter(Recording([tmp_path], None, past.note_read))
    assert sequences(past, 1) == []
    assert len(list(reading)) == 4
    assert sequences(past, 1, 2, 3) == [1, 1, 2, 3]  # both: the first may have been a bad one


def test_too_much_at_once_and_what_cannot_be_read(tmp_path: Path) -> None:
    scans = room(3)
    write_recording(tmp_path / "a.mcap", scans, {})
    past = Past(max_bytes=2 * len(scans[0].payload))
    list(Recording([tmp_path], None, past.note_read))
    with pytest.raises(ProtocolError, match="correct fewer") as caught:
        past.read(numbers(1, 2, 3))
    assert caught.value.reason == "too_large"
    assert isinstance(at_once(past)(numbers(1, 2, 3)).exception(), ProtocolError)
    (tmp_path / "a.mcap").unlink()
    assert isinstance(at_once(past)(numbers(1)).exception(), FileNotFoundError)


def test_it_stops_reading_when_it_is_closed(tmp_path: Path) -> None:
    write_recording(tmp_path / "a.mcap", room(3), {})
    past = Past()
    list(Recording([tmp_path], None, past.note_read))
    past.close()
    with pytest.raises(OSError, match="the service stops"):
        past.read(numbers(1))
