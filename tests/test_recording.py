"""Recordings as a source: file order, cut-off files, and where a replay cuts its updates."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest
from mcap.writer import Writer

from facet.cuts import logged_cuts, timed_cuts
from facet.sinks.log_file import schema_text, write_recording
from facet.sources.mcap_damage import LogError
from facet.sources.naming import is_input
from facet.sources.recording import Recording, is_replayed, paced
from facet_protocol import topics
from facet_protocol.codec import encode
from facet_protocol.messages import Cut, Envelope
from rig import PERIOD_NS, room, unnumbered

TRANSFORMS = "foxglove.FrameTransforms"


def cut(revision: int, scan: Envelope) -> Envelope:
    message = Cut(revision, "r1", "lidar", scan.epoch, scan.sequence, scan.stamp_ns, 1)
    schema, payload = encode(message)
    return Envelope(topics.CUT_TOPIC, schema, "protobuf", payload, received_ns=scan.received_ns)


def sequences(batches: object) -> list[list[int]]:
    return [[e.sequence for e in batch] for batch in batches]  # type: ignore[attr-defined]


def test_file_order_and_not_log_time(tmp_path: Path) -> None:
    scans = room(4)
    shuffled = [scans[k] for k in (2, 0, 3, 1)]
    write_recording(tmp_path / "a.mcap", shuffled, {})
    assert [e.sequence for e in Recording([tmp_path / "a.mcap"])] == [3, 1, 4, 2]


def test_a_cut_off_file_gives_what_is_whole(tmp_path: Path) -> None:
    path = tmp_path / "a.mcap"
    write_recording(path, room(60), {}, compression="none")
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])
    recording = Recording([path])
    read = [e.sequence for e in recording]
    assert read == list(range(1, len(read) + 1))
    assert 20 <= len(read) < 31  # all but the chunk that is open
    assert recording.is_damaged
    assert recording.damage[path].lost_bytes > 0


def test_files_follow_each_other(tmp_path: Path) -> None:
    scans = room(4)
    write_recording(tmp_path / "b.mcap", scans[2:], {})
    write_recording(tmp_path / "a.mcap", scans[:2], {"map": "hall"})
    assert [e.sequence for e in Recording([tmp_path])] == [1, 2, 3, 4]
    assert Recording([tmp_path]).head() == {"map": "hall"}


def foreign_transforms(path: Path) -> Path:
    """A file that Foxglove's own library could have written: it says nothing of itself."""
    with path.open("wb") as file:
        writer = Writer(file)
        writer.start()
        schema = writer.register_schema(TRANSFORMS, *schema_text(TRANSFORMS))
        channel = writer.register_channel(topics.TF_TOPIC, "protobuf", schema)
        writer.add_message(channel, log_time=1, data=b"", publish_time=1)
        writer.finish()
    return path


@pytest.mark.parametrize("name", ["a.mcap", "z.mcap"])
def test_what_a_file_says_of_itself_holds_for_no_other(tmp_path: Path, name: str) -> None:
    """Transforms are Facet's own drawing in its own log, and an input in anyone else's."""
    write_recording(tmp_path / "m.mcap", room(1), {"map": "hall", "cuts": "logged"})
    foreign_transforms(tmp_path / name)
    recording = Recording([tmp_path])
    read = [(e.schema, is_input(e), recording.has_cuts) for e in recording]
    ours, theirs = ("foxglove.PointCloud", True, True), (TRANSFORMS, True, False)
    assert read == ([theirs, ours] if name < "m" else [ours, theirs])


def test_what_is_no_log_is_refused(tmp_path: Path) -> None:
    (tmp_path / "a.mcap").write_bytes(b"no log")
    with pytest.raises(LogError, match="not an MCAP file"):
        list(Recording([tmp_path]))
    with pytest.raises(LogError, match=r"no \.mcap file"):
        Recording([_empty(tmp_path / "empty")])


def _empty(path: Path) -> Path:
    path.mkdir()
    return path


def test_replay_reads_scans_and_cuts_only() -> None:
    scan = room(1)[0]
    own = replace(scan, key=topics.POINTS_TOPIC)
    update = replace(scan, key=topics.UPDATE_TOPIC, schema="facet.v1.MapUpdate")
    assert [is_replayed(e) for e in (scan, cut(1, scan), own, update)] == [True, True, False, False]


def test_cuts_are_where_the_log_says() -> None:
    """Scans recorded while an update was under way belong to the next one."""
    s = room(7)
    log = [s[0], s[1], s[2], cut(1, s[1]), s[3], s[4], cut(2, s[3]), s[5], s[6]]
    assert sequences(logged_cuts(log, lambda: True)) == [[1, 2], [3, 4], [5, 6, 7]]


def test_a_duplicate_after_the_cut_waits() -> None:
    s = room(3)
    log = [s[0], s[1], s[1], cut(1, s[1]), s[2]]
    assert sequences(logged_cuts(log, lambda: True)) == [[1, 2], [2, 3]]


def test_a_cut_of_two_sources_ends_at_the_later() -> None:
    a, b = room(3), room(3, robot="r2")
    schema, payload = encode(Cut(1, "r2", "lidar", 5, 1, b[0].stamp_ns, 1))
    second = Envelope(topics.CUT_TOPIC, schema, "protobuf", payload)
    log = [a[0], b[0], a[1], b[1], cut(1, a[1]), second]
    assert [len(batch) for batch in logged_cuts(log, lambda: True)] == [3, 1]


def test_a_log_without_cuts_is_cut_by_its_own_time() -> None:
    assert sequences(logged_cuts(room(5), lambda: False)) == [[1, 2], [3, 4], [5]]


@pytest.mark.parametrize(
    ("every_ns", "expected"),
    [(3 * PERIOD_NS, [[1, 2, 3], [4, 5]]), (0, [[1, 2, 3, 4, 5]])],
)
def test_cuts_by_time(every_ns: int, expected: list[list[int]]) -> None:
    log = [*room(5), cut(1, room(1)[0])]
    assert sequences(timed_cuts(log, every_ns)) == expected


def test_unnumbered_scans_are_cut_by_their_stamps() -> None:
    s = [unnumbered(e) for e in room(3)]
    batches = list(logged_cuts([*s, cut(1, s[1])], lambda: True))
    assert [len(batch) for batch in batches] == [2, 1]


def test_pace(monkeypatch: pytest.MonkeyPatch) -> None:
    now, slept = [0], []

    def sleep(seconds: float) -> None:
        slept.append(round(seconds, 6))
        now[0] += round(seconds * 1e9)

    assert len(list(paced(iter(room(3)), 2.0, lambda: now[0], sleep))) == 3
    assert slept == [0.05, 0.05]


@pytest.mark.parametrize(
    ("epoch", "read"),
    [("4294967295", 2**32 - 1), ("4294967296", 0), ("\u06f1", 0), ("1" * 5000, 0)],
)
def test_an_epoch_is_a_number_of_32_bits_or_none(tmp_path: Path, epoch: str, read: int) -> None:
    with (tmp_path / "a.mcap").open("wb") as file:
        writer = Writer(file)
        writer.start()
        channel = writer.register_channel("/scan", "json", 0, {"epoch": epoch})
        writer.add_message(channel, 1, b"{}", 1)
        writer.finish()
    assert [e.epoch for e in Recording([tmp_path / "a.mcap"])] == [read]
