"""The recorder on a disk that loses power or fails: what was acknowledged can be read, always.

G2: at every call to the system the power goes; what was not synced is gone, cut at a sector, or
written in part and out of order. G3: every n-th call fails, once or from then on.
"""

from __future__ import annotations

import errno
import os
import random
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import pytest

from facet.sinks import durable_file, recorder
from facet.sinks.durable_file import DurableFile
from facet.sinks.recorder import Recorder
from facet.sources.recording import Recording
from facet_protocol.messages import Envelope

SECTOR = 512
KEY = "facet/v1/map/robot/r1/scan/front"


def envelopes(num: int) -> list[Envelope]:
    rng = random.Random(4)
    return [
        Envelope(
            key=KEY,
            schema="foxglove.PointCloud",
            encoding="protobuf",
            payload=rng.randbytes(rng.randrange(50, 900)),
            epoch=3,
            sequence=k,
            received_ns=10**9 + k,
        )
        for k in range(1, num + 1)
    ]


def run(
    folder: Path, sent: list[Envelope], disk: dict[str, Any], on_ack: Callable[[list[int]], None]
) -> int:
    """Record in commits of four, with a new file now and then; how many commits failed."""
    clock = iter(range(10**9, 10**18, 10**9))
    log = Recorder(
        folder,
        "map",
        {"map": "map"},
        max_file_bytes=20_000,
        clock=lambda: next(clock),
        open_file=lambda path: DurableFile(path, **disk),
    )
    failures = 0
    for k in range(0, len(sent), 4):
        for envelope in sent[k : k + 4]:
            log.write(envelope)
        try:
            on_ack([e.sequence for e in log.commit()])
        except OSError:
            failures += 1
    for _ in range(2):
        try:
            on_ack([e.sequence for e in log.commit()])
            log.roll()
        except OSError:
            failures += 1
    return failures


def check(folder: Path, sent: list[Envelope], acknowledged: set[int]) -> list[int]:
    """What can be read: all that was acknowledged, and nothing that was not sent."""
    payloads = {e.sequence: e.payload for e in sent}
    read = []
    for envelope in Recording([folder]) if list(folder.glob("*.mcap")) else []:
        assert bytes(envelope.payload) == payloads[envelope.sequence], "a wrong message"
        assert (envelope.key, envelope.epoch) == (KEY, 3)
        read.append(envelope.sequence)
    lost = acknowledged - set(read)
    assert not lost, f"{len(lost)} acknowledged messages cannot be read"
    return read


@dataclass
class Content:
    """A file as the system knows it, and as the disk does."""

    now: bytearray = field(default_factory=bytearray)
    synced: bytes = b""
    writes: list[tuple[int, bytes]] = field(default_factory=list)  # since it was synced
    is_named: bool = False


class Power:
    """Notes every call, and what had been acknowledged by then."""

    def __init__(self) -> None:
        self.calls: list[tuple[Any, ...]] = []
        self._paths: dict[int, Path] = {}

    @property
    def disk(self) -> dict[str, Any]:
        return {
            "write": self._write,
            "sync_data": lambda fd: self.calls.append(("sync", self._paths[fd])),
            "truncate": lambda fd, size: self.calls.append(("truncate", self._paths[fd], size)),
            "open_new": self._open,
            "sync_names": lambda folder: self.calls.append(("names",)),
        }

    def _open(self, path: Path) -> int:
        fd = durable_file.open_new(path)
        self._paths[fd] = path
        self.calls.append(("open", path))
        return fd

    def _write(self, fd: int, data: memoryview) -> int:
        self.calls.append(("write", self._paths[fd], bytes(data)))
        return os.write(fd, data)

    def acknowledge(self, sequences: list[int]) -> None:
        self.calls.append(("ack", sequences))


def replayed(calls: list[tuple[Any, ...]]) -> tuple[dict[Path, Content], set[int]]:
    """(files, acknowledged) after these calls."""
    files: dict[Path, Content] = {}
    acknowledged: set[int] = set()
    for what, *arguments in calls:
        if what == "ack":
            acknowledged.update(arguments[0])
        elif what == "names":
            for content in files.values():
                content.is_named = True
        elif what == "open":
            files[arguments[0]] = Content()
        elif what == "write":
            content = files[arguments[0]]
            content.writes.append((len(content.now), arguments[1]))
            content.now += arguments[1]
        elif what == "sync":
            content = files[arguments[0]]
            content.synced, content.writes = bytes(content.now), []
    return files, acknowledged


def torn(content: Content, rng: random.Random, mode: str) -> bytes:
    """What the disk may hold when the power goes."""
    if mode == "drop":
        return content.synced
    data = bytearray(content.synced)
    sectors = [
        (at + k, written[k : k + SECTOR])
        for at, written in content.writes
        for k in range(0, len(written), SECTOR)
    ]
    if mode == "tear":  # in order, up to somewhere
        kept = sectors[: rng.randrange(len(sectors) + 1)]
    else:
        kept = [sector for sector in sectors if rng.random() < 0.5]
        rng.shuffle(kept)
    for at, piece in kept:
        data.extend(bytes(max(0, at + len(piece) - len(data))))
        data[at : at + len(piece)] = piece
    return bytes(data)


def cut_power_everywhere(folder: Path, num: int, tries: dict[str, int]) -> int:
    """How many states of the disk were read."""
    power, sent = Power(), envelopes(num)
    run(folder / "run", sent, power.disk, power.acknowledge)
    states = 0
    for end in range(1, len(power.calls) + 1):
        files, acknowledged = replayed(power.calls[:end])
        for mode, times in tries.items():
            for number in range(times):
                rng = random.Random(f"{end} {mode} {number}")
                after = folder / "after"
                after.mkdir(exist_ok=True)
                for old in after.iterdir():
                    old.unlink()
                for path, content in files.items():
                    if content.is_named or rng.random() < 0.5:
                        (after / path.name).write_bytes(torn(content, rng, mode))
                check(after, sent, acknowledged)
                states += 1
    return states


def test_power_cut_at_every_call(tmp_path: Path) -> None:
    assert cut_power_everywhere(tmp_path, 60, {"drop": 1, "tear": 2, "reorder": 2}) > 200


@pytest.mark.slow
def test_power_cut_at_every_call_of_a_long_run(tmp_path: Path) -> None:
    states = cut_power_everywhere(tmp_path, 200, {"drop": 1, "tear": 6, "reorder": 6})
    assert states >= 2000


def test_the_fake_power_cut_is_one(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A recorder that does not wait for the disk loses what it acknowledged."""
    monkeypatch.setattr(
        recorder, "LogFile", lambda file, data, kind, waits: LOG_FILE(file, data, kind, False)
    )
    with pytest.raises(AssertionError, match="acknowledged messages cannot be read"):
        cut_power_everywhere(tmp_path, 40, {"drop": 1})


LOG_FILE = recorder.LogFile


class Failing:
    """The disk, whose n-th call fails."""

    def __init__(self, nth: int, how: str) -> None:
        self.num_calls = 0
        self._nth, self._how = nth, how

    def _is_bad(self) -> bool:
        self.num_calls += 1
        late = self._how.endswith("for ever") and self.num_calls > self._nth > 0
        return self.num_calls == self._nth or late

    def _raise(self) -> None:
        code = errno.EIO if self._how.startswith("EIO") else errno.ENOSPC
        raise OSError(code, os.strerror(code))

    def _wrap(self, call: Callable[..., Any]) -> Callable[..., Any]:
        def wrapped(*arguments: Any) -> Any:
            if self._is_bad() and self._how != "short write":
                self._raise()
            return call(*arguments)

        return wrapped

    def _write(self, fd: int, data: memoryview) -> int:
        if not self._is_bad():
            return os.write(fd, data)
        half = os.write(fd, data[: len(data) // 2 + 1])
        if self._how != "short write":
            self._raise()
        return half

    @property
    def disk(self) -> dict[str, Any]:
        return {
            "write": self._write,
            "sync_data": self._wrap(lambda fd: None),
            "truncate": self._wrap(os.ftruncate),
            "open_new": self._wrap(durable_file.open_new),
            "sync_names": self._wrap(lambda folder: None),
        }


HOWS = ("ENOSPC once", "EIO once", "ENOSPC for ever", "EIO for ever", "short write")


def fail_everywhere(folder: Path, num: int, step: int = 1) -> int:
    """How many runs failed somewhere."""
    sent = envelopes(num)
    counting = Failing(0, "")
    run(folder / "whole", sent, counting.disk, lambda sequences: None)
    runs = 0
    for how in HOWS:
        for nth in range(1, counting.num_calls + 1, step):
            runs += 1
            case = folder / f"{how}-{nth}"
            acknowledged: set[int] = set()
            failures = run(case, sent, Failing(nth, how).disk, acknowledged.update)
            read = check(case, sent, acknowledged)
            if how == "short write":
                assert failures == 0
            if not how.endswith("for ever"):
                assert acknowledged == {e.sequence for e in sent}, "it did not go on"
                assert read == sorted(read), "out of order"
                assert len(set(read)) == len(read), "what was cut off is still there"
            for path in case.iterdir():
                path.unlink()
    return runs


def test_every_call_fails_in_turn(tmp_path: Path) -> None:
    assert fail_everywhere(tmp_path, 80) > 200


@pytest.mark.slow
def test_every_call_of_a_long_run_fails_in_turn(tmp_path: Path) -> None:
    assert fail_everywhere(tmp_path, 500) > 1000


def test_without_cutting_back_what_failed_is_still_there(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The mutant that this file must kill: a failed write is left in the log."""

    def close_only(self: DurableFile) -> None:
        self.close()

    monkeypatch.setattr(DurableFile, "abandon", close_only)
    with pytest.raises(AssertionError, match=r"still there|out of order|cannot be read"):
        fail_everywhere(tmp_path, 40)


def test_a_file_that_cannot_be_named_is_not_left_behind(tmp_path: Path) -> None:
    def fail(folder: Path) -> None:
        raise OSError(errno.EIO, "no")

    before = set(os.listdir("/proc/self/fd"))
    with pytest.raises(OSError, match="no"):
        DurableFile(tmp_path / "a", sync_names=fail)
    assert list(tmp_path.iterdir()) == []
    assert set(os.listdir("/proc/self/fd")) == before


def test_fast_does_not_wait_for_the_disk(tmp_path: Path) -> None:
    syncs: list[int] = []
    log = Recorder(
        tmp_path,
        "map",
        {},
        is_fast=True,
        clock=lambda: 10**9,
        open_file=lambda path: DurableFile(path, sync_data=syncs.append),
    )
    for envelope in envelopes(8):
        log.write(envelope)
        assert [e.sequence for e in log.commit()] == [envelope.sequence]
        assert sum(1 for _ in Recording([tmp_path])) == envelope.sequence  # it is with the system
    log.close()
    assert syncs == []


def test_files_roll_by_age_on_a_clock_that_is_never_set(tmp_path: Path) -> None:
    age = [0]
    wall = iter([5 * 10**9, 86400 * 10**9, 10**9, 2 * 10**9])
    log = Recorder(
        tmp_path,
        "map",
        {"map": "map"},
        max_file_ns=60 * 10**9,
        clock=lambda: next(wall),
        age_clock=lambda: age[0],
    )
    for envelope in envelopes(9):
        log.write(envelope)
        log.commit()
        age[0] += 25 * 10**9
    log.close()
    assert len(log.paths) == 3
    assert log.paths == sorted(log.paths)  # also where the wall clock was put back
    assert [e.sequence for e in Recording([tmp_path])] == list(range(1, 10))
    for path, num in zip(log.paths, (4, 4, 1), strict=True):
        alone = Recording([path])
        assert alone.head() == {"map": "map"}
        assert len(list(alone)) == num
        assert not alone.is_damaged


def test_room_is_left_to_others_by_default(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """1 GiB, or 2 % of a large disk; and what is being written counts."""
    disk = os.statvfs(tmp_path)

    class Disk:
        f_frsize, f_blocks = 4096, 250_000_000  # 1 TB: 20 GB are kept
        f_bavail = 5_000_010

    log = Recorder(tmp_path, "map", {}, min_free_bytes=None, clock=lambda: 10**9)
    monkeypatch.setattr(os, "statvfs", lambda path: Disk)
    log.write(envelopes(1)[0])
    log.commit()
    Disk.f_bavail = 5_000_000
    log.write(envelopes(2)[1])
    with pytest.raises(OSError, match="less than 19531 MiB free"):
        log.commit()
    monkeypatch.setattr(os, "statvfs", lambda path: disk)
    assert [e.sequence for e in log.forget()] == [2]
