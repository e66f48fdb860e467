"""The log: raw bytes to MCAP, durable before they are applied; files roll by size and age."""

from __future__ import annotations

import errno
import fcntl
import logging
import os
import re
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path

from facet.sinks.durable_file import DurableFile
from facet.sinks.log_file import ChannelName, LogFile
from facet_protocol.codec import Message
from facet_protocol.messages import Envelope

logger = logging.getLogger(__name__)

MAX_CHANNELS = 10_000  # of MCAP's 65,535: every start of a publisher takes one
MIN_FREE_BYTES = 1 << 30  # kept for others, where nothing else is asked for: this much,
MIN_FREE_SHARE = 0.02  # or this share of the disk, if that is more
_FILE = re.compile(r"(?P<map>.+)-(?P<stamp>\d{8}T\d{6}Z)-(?P<number>\d+)\.mcap")
ACKNOWLEDGED = {
    "durable": "on the disk: survives a power cut",
    "fast": "with the system: survives the end of the service, no power cut",
}


@dataclass(frozen=True, slots=True)
class LogPosition:
    """The end of a commit: everything before it is durable, or was handed on all the same."""

    file: str  # name
    offset: int  # bytes; a record begins here
    channels: tuple[ChannelName, ...]  # defined before it, number 1 first


class Recorder:
    """Writes envelopes to a folder of MCAP files. One thread at a time may use it.

    `write` collects; what it took is durable, in order, when `commit` returns. When `commit`
    raises OSError the file is cut back to its last good chunk and closed, what was not durable is
    kept, and the next `commit` tries again in a new file. `is_fast` does not wait for the disk:
    what was committed survives the end of this process, but no power cut.
    """

    def __init__(
        self,
        directory: Path,
        name: str,
        metadata: Mapping[str, str],
        *,
        compression: str = "lz4",
        max_file_bytes: int = 1 << 30,
        max_file_ns: int = 3600 * 10**9,
        min_free_bytes: int | None = 0,
        is_fast: bool = False,
        clock: Callable[[], int],
        age_clock: Callable[[], int] = time.monotonic_ns,
        open_file: Callable[[Path], DurableFile] = DurableFile,
    ) -> None:
        self.paths: list[Path] = []
        self.committed_bytes = 0
        self._directory, self._name, self._metadata = directory, name, dict(metadata)
        self._compression = compression
        self._max_file_bytes, self._max_file_ns = max_file_bytes, max_file_ns
        self._min_free_bytes, self._is_fast = min_free_bytes, is_fast
        self._clock, self._age_clock, self._open_file = clock, age_clock, open_file
        self._log: LogFile | None = None
        self._born_ns = 0
        self._uncommitted: list[Envelope] = []
        self._log_time_ns = 0
        self._position = LogPosition("", 0, ())
        directory.mkdir(mode=0o750, parents=True, exist_ok=True)

    def write(self, envelope: Envelope, message: Message | None = None) -> None:
        """Take one message for the next commit."""
        self._uncommitted.append(envelope)

    def commit(self) -> list[Envelope]:
        """Make all that was taken durable, and return it. Raises OSError, keeping it."""
        if not self._uncommitted:
            return []
        try:
            self._check_free()
            if self._log is None:
                self._log = self._open()
            log = self._log
            for envelope in self._uncommitted:
                self._add(log, envelope)
            log.sync()
        except OSError:
            self._abandon()
            raise
        self.committed_bytes += sum(len(e.payload) for e in self._uncommitted)
        durable, self._uncommitted = self._uncommitted, []
        self._move_on(log)
        self._roll_if_due()
        return durable

    @property
    def directory(self) -> Path:
        return self._directory

    @property
    def position(self) -> LogPosition:
        """Where the last commit ended."""
        return self._position

    def forget(self) -> list[Envelope]:
        """Give back what could not be made durable: the caller counts it as lost."""
        lost, self._uncommitted = self._uncommitted, []
        return lost

    def roll(self) -> None:
        """Finish the file in progress; the next message starts a new one. Raises OSError."""
        log, self._log = self._log, None
        if log is None:
            return
        try:
            log.finish()
        except OSError:
            log.abandon()
            raise

    def close(self) -> None:
        """Commit what is left and finish the file. Raises OSError. A second call does nothing."""
        self.commit()
        self.roll()

    def _open(self) -> LogFile:
        self._born_ns, self._log_time_ns = self._age_clock(), 0
        path = self._directory / self._next_name()
        log = LogFile(self._open_file(path), self._metadata, self._compression, not self._is_fast)
        self.paths.append(path)
        return log

    def _next_name(self) -> str:
        """A name after all that are there, also where the clock was put back since."""
        known = [_parts(path.name, self._name) for path in log_files(self._directory, self._name)]
        stamp = datetime.fromtimestamp(self._clock() // 10**9, tz=UTC).strftime("%Y%m%dT%H%M%SZ")
        last = max((number for _, number in known), default=0)
        stamp = max([stamp, *(text for text, _ in known)])
        return f"{self._name}-{stamp}-{last + 1:06d}.mcap"

    def _move_on(self, log: LogFile) -> None:
        names = self._position.channels
        if self._position.file != log.path.name or len(names) != log.num_channels:
            names = tuple(log.channel_names)
        self._position = LogPosition(log.path.name, log.num_bytes, names)

    def _add(self, log: LogFile, envelope: Envelope) -> None:
        self._log_time_ns = max(self._log_time_ns, envelope.received_ns)  # never goes back
        log.add(envelope, self._log_time_ns)

    def _abandon(self) -> None:
        log, self._log = self._log, None
        if log is not None:
            log.abandon()
            if not log.path.exists():  # nothing in it was durable
                self.paths.remove(log.path)

    def _roll_if_due(self) -> None:
        log = self._log
        if log is None:
            return
        is_old = self._age_clock() - self._born_ns >= self._max_file_ns
        is_full = log.num_bytes >= self._max_file_bytes or log.num_channels >= MAX_CHANNELS
        if is_full or is_old:
            try:
                self.roll()
            except OSError as error:  # its messages are durable; the next commit meets the disk
                logger.warning("%s has no summary: %s", log.path.name, error)

    def free_bytes(self) -> int:
        """What the disk still has room for; 0 when it does not say."""
        try:
            disk = os.statvfs(self._directory)
        except OSError:
            return 0
        return disk.f_bavail * disk.f_frsize

    def _check_free(self) -> None:
        wanted = self._min_free()
        if wanted and self.free_bytes() - self._num_uncommitted() < wanted:
            text = f"less than {wanted >> 20} MiB free (record.min_free_bytes)"
            raise OSError(errno.ENOSPC, text, str(self._directory))

    def _num_uncommitted(self) -> int:
        return sum(len(envelope.payload) for envelope in self._uncommitted)

    def _min_free(self) -> int:
        if self._min_free_bytes is not None:
            return self._min_free_bytes
        disk = os.statvfs(self._directory)
        return max(MIN_FREE_BYTES, int(MIN_FREE_SHARE * disk.f_blocks * disk.f_frsize))


def maps_in(directory: Path) -> set[str]:
    """The maps whose logs lie in a folder."""
    found = (_FILE.fullmatch(path.name) for path in directory.glob("*.mcap"))
    return {match["map"] for match in found if match}


def log_files(directory: Path, name: str) -> list[Path]:
    """The log of the map `name`, oldest first."""
    found = [path for path in directory.glob("*.mcap") if _parts(path.name, name)[1]]
    return sorted(found, key=lambda path: _parts(path.name, name))


def _parts(file: str, name: str) -> tuple[str, int]:
    """(stamp, number) of a log file's name; ("", 0) of another file's."""
    match = _FILE.fullmatch(file)
    if match is None or match["map"] != name:
        return "", 0
    return match["stamp"], int(match["number"])


@contextmanager
def single_writer(directory: Path) -> Iterator[None]:
    """Holds the folder: a second service that wants it raises BlockingIOError at once."""
    directory.mkdir(mode=0o750, parents=True, exist_ok=True)
    with (directory / ".lock").open("w") as lock:
        try:
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError as error:
            text = "another service writes its log here: stop it, or give --record another folder"
            raise BlockingIOError(error.errno, text, str(directory)) from error
        yield
