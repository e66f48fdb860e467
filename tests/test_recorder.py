"""The recorder: what is committed can be read, whatever happens to the file afterwards."""

from __future__ import annotations

import errno
import os
from collections.abc import Iterator
from pathlib import Path

import pytest

from facet.sinks.durable_file import DurableFile
from facet.sinks.log_file import write_recording
from facet.sinks.recorder import Recorder, single_writer
from facet.sources.mcap_damage import LogError
from facet.sources.mcap_stream import McapStream
from facet.sources.recording import Recording
from facet_protocol.messages import Envelope

KEY = "facet/v1/map/robot/r1/scan/front"
SECOND = 10**9


def envelope(sequence: int, *, epoch: int = 7, size: int = 500, received_ns: int = 0) -> Envelope:
    return Envelope(
        key=KEY,
        schema="foxglove.PointCloud",
        encoding="protobuf",
        payload=os.urandom(size),
        stamp_ns=sequence * 1000,
        epoch=epoch,
        sequence=sequence,
        received_ns=received_ns or SECOND + sequence,
    )


def recorder(directory: Path, **options: object) -> Recorder:
    return Recorder(directory, "map", {"cuts": "logged"}, clock=lambda: SECOND, **options)  # type: ignore[arg-type]


def same(a: Envelope, b: Envelope) -> bool:
    return (a.key, a.schema, a.encoding, a.stamp_ns, a.epoch, a.sequence, bytes(a.payload)) == (
        b.key,
        b.schema,
        b.encoding,
        b.stamp_ns,
        b.epoch,
        b.sequence,
        bytes(b.payload),
    )


def test_everything_comes_back_as_it_travelled(tmp_path: Path) -> None:
    sent = [envelope(1), envelope(2), envelope(1, epoch=8), envelope((5 << 32) + 3, epoch=8)]
    log = recorder(tmp_path)
    for message in sent:
        log.write(message)
    assert [m.sequence for m in log.commit()] == [m.sequence for m in sent]
    log.close()
    log.close()
    recording = Recording([tmp_path])
    assert all(same(a, b) for a, b in zip(recording, sent, strict=True))
    assert not recording.is_damaged
    assert recording.has_cuts


def test_a_new_epoch_opens_a_new_channel(tmp_path: Path) -> None:
    log = recorder(tmp_path)
    for message in (envelope(1), envelope(2), envelope(1, epoch=8)):
        log.write(message)
    log.close()
    stream = McapStream(log.paths[0])
    epochs = {m.channel.id: m.channel.metadata["epoch"] for m in stream.messages()}
    assert epochs == {1: "7", 2: "8"}


def test_what_is_committed_survives_a_crash(tmp_path: Path) -> None:
    """The file as it lies on the disk after every commit, without anything being finished."""
    log = recorder(tmp_path)
    sent = [envelope(k) for k in range(1, 41)]
    for k, message in enumerate(sent, start=1):
        log.write(message)
        if k % 4 == 0:
            log.commit()
            recording = Recording([tmp_path])
            assert sum(1 for _ in recording) == k
            assert recording.is_damaged  # no footer yet
    log.close()


def test_cut_anywhere_every_whole_chunk_is_read(tmp_path: Path) -> None:
    log = recorder(tmp_path)
    ends = {}
    for k in range(1, 13):
        log.write(envelope(k, size=60))
        log.commit()
        ends[log.paths[0].stat().st_size] = k
    log.close()
    whole = log.paths[0].read_bytes()
    cut_file = tmp_path / "cut" / "cut.mcap"
    cut_file.parent.mkdir()
    for length in range(8, len(whole), 7):
        cut_file.write_bytes(whole[:length])
        stream = McapStream(cut_file)
        sequences = [m.sequence for m in stream.messages()]
        committed = max((k for end, k in ends.items() if end <= length), default=0)
        assert sequences == list(range(1, len(sequences) + 1))
        assert len(sequences) >= committed
        assert stream.damage


@pytest.mark.parametrize("where", ["write", "sync_data"])
def test_a_failing_disk_loses_nothing(tmp_path: Path, where: str) -> None:
    """One failure in the middle: the file is cut back, what was not durable goes to the next."""
    fail = iter([False, False, True, *[False] * 100])

    def breaking(call: object) -> object:
        def wrapped(*args: object) -> object:
            if next(fail):
                raise OSError(errno.ENOSPC, "No space left on device")
            return call(*args)  # type: ignore[operator]

        return wrapped

    calls = {"write": os.write, "sync_data": os.fdatasync}
    options = {where: breaking(calls[where])}
    log = recorder(tmp_path, open_file=lambda path: DurableFile(path, **options))  # type: ignore[arg-type]
    durable: list[int] = []
    failures = 0
    for k in range(1, 21):
        log.write(envelope(k))
        try:
            durable += [m.sequence for m in log.commit()]
        except OSError:
            failures += 1
    log.close()
    assert failures == 1
    assert durable == list(range(1, 21))
    assert len(log.paths) == 2
    assert [m.sequence for m in Recording(log.paths)] == durable


def test_a_full_disk_is_refused_before_it_is_full(tmp_path: Path) -> None:
    log = recorder(tmp_path, min_free_bytes=1 << 60)
    log.write(envelope(1))
    with pytest.raises(OSError, match="free"):
        log.commit()
    assert [m.sequence for m in log.forget()] == [1]


def test_files_roll_by_size(tmp_path: Path) -> None:
    log = recorder(tmp_path, max_file_bytes=2000)
    for k in range(1, 21):
        log.write(envelope(k))
        log.commit()
    log.close()
    assert len(log.paths) > 3
    recording = Recording(log.paths)
    assert [m.sequence for m in recording] == list(range(1, 21))
    assert not recording.is_damaged


def test_log_time_never_goes_back(tmp_path: Path) -> None:
    log = recorder(tmp_path)
    for k, received_ns in enumerate([100, 300, 200, 400], start=1):
        log.write(envelope(k, received_ns=received_ns))
    log.close()
    assert [m.received_ns for m in Recording(log.paths)] == [100, 300, 300, 400]


def test_a_flipped_bit_is_damage_and_never_a_message(tmp_path: Path) -> None:
    path = tmp_path / "a.mcap"
    write_recording(path, (envelope(k, size=40) for k in range(1, 5)), {})
    whole = path.read_bytes()
    good = [bytes(m.payload) for m in McapStream(path).messages()]
    for at in range(0, len(whole), 11):
        path.write_bytes(whole[:at] + bytes([whole[at] ^ 0x10]) + whole[at + 1 :])
        stream = McapStream(path)
        try:
            read = [bytes(m.payload) for m in stream.messages()]
        except LogError:
            continue
        assert read in (good, [])
        assert read == good or stream.damage


def test_one_writer_a_folder(tmp_path: Path) -> None:
    refused = pytest.raises(BlockingIOError, match="another service")
    with single_writer(tmp_path), refused, single_writer(tmp_path):
        pass


def test_an_interrupted_recording_leaves_nothing(tmp_path: Path) -> None:
    def broken() -> Iterator[Envelope]:
        yield envelope(1)
        raise RuntimeError("stopped")

    with pytest.raises(RuntimeError):
        write_recording(tmp_path / "a.mcap", broken(), {})
    assert list(tmp_path.iterdir()) == []
