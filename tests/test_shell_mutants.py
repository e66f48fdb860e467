"""Broken shells that the laws must notice (G17): each is the shell with one promise taken out. The
core's own are in test_mutants.py."""

from __future__ import annotations

import errno
import os
from collections.abc import Callable
from pathlib import Path

import pytest

from facet.sinks.durable_file import DurableFile
from facet.sinks.log_file import write_recording
from facet.sinks.recorder import Recorder
from facet.sources import mcap_chunk, mcap_stream
from facet.sources.mcap_damage import LogError
from facet.sources.mcap_stream import McapStream
from facet.sources.recording import Recording
from facet.status import Account
from fault_rig import Line, around
from rig import room
from test_recorder import envelope

Patch = pytest.MonkeyPatch
Law = Callable[[Path], None]


def never_silently_wrong(folder: Path) -> None:
    """A flipped bit in a chunk is damage, or the messages are what was written."""
    path = folder / "flipped.mcap"
    write_recording(path, (envelope(k, size=300) for k in range(1, 5)), {}, compression="none")
    whole = path.read_bytes()
    good = [bytes(m.payload) for m in McapStream(path).messages()]
    for at in range(whole.index(good[0]), whole.rindex(good[-1]) + 300, 37):
        path.write_bytes(whole[:at] + bytes([whole[at] ^ 0x10]) + whole[at + 1 :])
        stream = McapStream(path)
        try:
            read = [bytes(m.payload) for m in stream.messages()]
        except LogError:
            continue
        assert read == good or stream.damage, f"byte {at}: wrong, and nothing said"
        assert set(read) <= set(good), f"byte {at}: a message that was never written"


def survives_a_power_cut(folder: Path) -> None:
    """What `commit` returned is readable from what was synced, at every commit."""
    synced: dict[Path, int] = {}

    def open_file(path: Path) -> DurableFile:
        return DurableFile(path, sync_data=lambda fd: note(path, fd))

    def note(path: Path, fd: int) -> None:
        synced[path] = os.fstat(fd).st_size

    log = Recorder(folder / "log", "map", {}, clock=lambda: 10**18, open_file=open_file)
    acknowledged = []
    for k in range(1, 11):
        log.write(envelope(k))
        acknowledged += [e.sequence for e in log.commit()]
        after = folder / "after"
        after.mkdir(exist_ok=True)
        for path in log.paths:
            (after / path.name).write_bytes(path.read_bytes()[: synced.get(path, 0)])
        assert [e.sequence for e in Recording([after])] == acknowledged
    log.close()


def cut_back_after_an_error(folder: Path) -> None:
    """A write that fails half way leaves no half chunk: the file ends where it was good."""
    fails = iter([False, False, True] + [False] * 50)

    def write(fd: int, data: memoryview) -> int:
        if next(fails):
            os.write(fd, data[: len(data) // 2])
            raise OSError(errno.ENOSPC, "No space left on device")
        return os.write(fd, data)

    log = Recorder(
        folder / "log",
        "map",
        {},
        clock=lambda: 10**18,
        open_file=lambda path: DurableFile(path, write=write),
    )
    good_bytes = []
    for k in range(1, 7):
        log.write(envelope(k))
        try:
            log.commit()
        except OSError:
            torn = log.paths[0].stat().st_size
            assert torn == good_bytes[-1], f"{torn} bytes where {good_bytes[-1]} are good"
            continue
        good_bytes.append(log.paths[-1].stat().st_size)
    log.close()
    assert [e.sequence for e in Recording(log.paths)] == [1, 2, 3, 4, 5, 6]


def everything_is_counted(folder: Path) -> None:
    """Good, bad and double messages: received = applied + rejected + left out."""
    good = room(2)
    line = Line(folder / "log").take(around([good[0], *good, good[1]]))
    balance = line.account.balance()
    assert balance.is_exact
    assert balance.in_flight == 0, f"{balance.in_flight} messages are unaccounted for"
    assert balance.points_stored == line.num_points()


LAWS = (never_silently_wrong, survives_a_power_cut, cut_back_after_an_error, everything_is_counted)


@pytest.mark.parametrize("law", LAWS)
def test_the_shell_keeps_the_laws(law: Law, tmp_path: Path) -> None:
    law(tmp_path)


def no_checksum(patch: Patch) -> None:
    """The chunk's CRC, and that of the data section, are not compared."""

    class Blind:
        @staticmethod
        def crc32(data: bytes, value: int = 0) -> AnyNumber:
            return AnyNumber(0)

    patch.setattr(mcap_chunk, "zlib", Blind)
    patch.setattr(mcap_stream, "zlib", Blind)


class AnyNumber(int):
    """Equal to all others."""

    def __eq__(self, other: object) -> bool:
        return True

    def __ne__(self, other: object) -> bool:
        return False

    __hash__ = int.__hash__


def no_fsync(patch: Patch) -> None:
    whole = DurableFile.sync
    patch.setattr(DurableFile, "sync", lambda self, waits=True: whole(self, waits=False))


def no_truncate(patch: Patch) -> None:
    def abandon(self: DurableFile) -> None:
        self._pending.clear()
        self.close()

    patch.setattr(DurableFile, "abandon", abandon)


def uncounted(name: str) -> Callable[[Patch], None]:
    def forget(patch: Patch) -> None:
        add = Account._add

        def adds(self: Account, counter: str, source: str, num: int) -> None:
            if counter != name:
                add(self, counter, source, num)

        patch.setattr(Account, "_add", adds)

    return forget


MUTANTS: dict[str, tuple[Callable[[Patch], None], Law, str]] = {
    "CRC": (no_checksum, never_silently_wrong, "byte"),
    "fsync": (no_fsync, survives_a_power_cut, r"\[\] == \[1\]"),
    "truncate": (no_truncate, cut_back_after_an_error, "are good"),
    "received": (uncounted("received"), everything_is_counted, "out of balance"),
    "applied": (uncounted("applied"), everything_is_counted, "out of balance"),
    "duplicate": (uncounted("duplicate"), everything_is_counted, "out of balance"),
    "points_stored": (uncounted("points_stored"), everything_is_counted, "out of balance"),
}


@pytest.mark.parametrize("name", MUTANTS)
def test_the_mutant_is_noticed(name: str, tmp_path: Path, monkeypatch: Patch) -> None:
    mutate, law, said = MUTANTS[name]
    mutate(monkeypatch)
    with pytest.raises(AssertionError, match=said):
        law(tmp_path)
