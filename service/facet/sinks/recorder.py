"""The log: raw bytes to MCAP, durable before they are applied; files roll by size and age."""

from __future__ import annotations

import errno
import fcntl
import itertools
import os
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from datetime import UTC, datetime
from pathlib import Path

from facet.sinks.durable_file import DurableFile
from facet.sinks.log_file import LogFile
from facet_protocol.codec import Message
from facet_protocol.messages import Envelope

MAX_CHANNELS = 10_000  # of MCAP's 65,535: every start of a publisher takes one


class Recorder:
    """Writes envelopes to a folder of MCAP files. One thread at a time may use it.

    `write` collects; what it took is durable, in order, when `commit` returns. When `commit`
    raises OSError the file is cut back to its last good chunk and closed, what was not durable is
    kept, and the next `commit` tries again in a new file.
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
        min_free_bytes: int = 0,
        clock: Callable[[], int],
        open_file: Callable[[Path], DurableFile] = DurableFile,
    ) -> None:
        self.paths: list[Path] = []
        self.committed_bytes = 0
        self._directory, self._name, self._metadata = directory, name, dict(metadata)
        self._compression = compression
        self._max_file_bytes, self._max_file_ns = max_file_bytes, max_file_ns
        self._min_free_bytes = min_free_bytes
        self._clock, self._open_file = clock, open_file
        self._log: LogFile | None = None
        self._born_ns = 0
        self._uncommitted: list[Envelope] = []
        self._log_time_ns = 0
        self._numbers = itertools.count(1)
        directory.mkdir(parents=True, exist_ok=True)

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
        self._roll_if_due()
        return durable

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
        self._born_ns = self._clock()
        stamp = datetime.fromtimestamp(self._born_ns // 10**9, tz=UTC).strftime("%Y%m%dT%H%M%SZ")
        path = self._directory / f"{self._name}-{stamp}-{next(self._numbers):03d}.mcap"
        while path.exists():
            path = self._directory / f"{self._name}-{stamp}-{next(self._numbers):03d}.mcap"
        log = LogFile(self._open_file(path), self._metadata, self._compression)
        self.paths.append(path)
        return log

    def _add(self, log: LogFile, envelope: Envelope) -> None:
        self._log_time_ns = max(self._log_time_ns, envelope.received_ns)  # never goes back
        log.add(envelope, self._log_time_ns)

    def _abandon(self) -> None:
        log, self._log = self._log, None
        if log is not None:
            log.abandon()

    def _roll_if_due(self) -> None:
        log = self._log
        if log is None:
            return
        age_ns = self._clock() - self._born_ns
        is_full = log.num_bytes >= self._max_file_bytes or log.num_channels >= MAX_CHANNELS
        if is_full or age_ns >= self._max_file_ns:
            self.roll()

    def free_bytes(self) -> int:
        """What the disk still has room for; 0 when it does not say."""
        try:
            disk = os.statvfs(self._directory)
        except OSError:
            return 0
        return disk.f_bavail * disk.f_frsize

    def _check_free(self) -> None:
        if self._min_free_bytes and self.free_bytes() < self._min_free_bytes:
            text = f"less than {self._min_free_bytes >> 20} MiB free"
            raise OSError(errno.ENOSPC, text, str(self._directory))


@contextmanager
def single_writer(directory: Path) -> Iterator[None]:
    """Holds the folder: a second service that wants it raises BlockingIOError at once."""
    directory.mkdir(parents=True, exist_ok=True)
    with (directory / ".lock").open("w") as lock:
        try:
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError as error:
            text = "another service writes its log here"
            raise BlockingIOError(error.errno, text, str(directory)) from error
        yield
