"""A file that knows how much of it is safely on the disk, and can be cut back to that."""

from __future__ import annotations

import errno
import os
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path


def open_new(path: Path) -> int:
    """The descriptor of a file that was not there."""
    return os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_CLOEXEC, 0o640)


def sync_directory(directory: Path) -> None:
    """The names in it survive a power cut."""
    fd = os.open(directory, os.O_RDONLY | os.O_DIRECTORY | os.O_CLOEXEC)
    try:
        os.fsync(fd)
    finally:
        os.close(fd)


class DurableFile:
    """Collects writes in memory; `sync` puts them on the disk, all or (after `abandon`) none.

    What the system is asked for goes through `write`, `sync_data` and `truncate`, so that a test
    can make any of them fail.
    """

    def __init__(
        self,
        path: Path,
        write: Callable[[int, memoryview], int] = os.write,
        sync_data: Callable[[int], None] = os.fdatasync,
        truncate: Callable[[int, int], None] = os.ftruncate,
        open_new: Callable[[Path], int] = open_new,
        sync_names: Callable[[Path], None] = sync_directory,
    ) -> None:
        """Raises OSError, and then there is no file."""
        self.path = path
        self.synced_bytes = 0  # an `abandon` leaves this much
        self._write, self._sync_data, self._truncate = write, sync_data, truncate
        self._pending = bytearray()
        self._written = 0
        self._fd = open_new(path)
        try:
            sync_names(path.parent)
        except OSError:
            self.abandon()
            raise

    def write(self, data: bytes) -> int:
        """Take bytes; nothing reaches the system yet."""
        self._pending += data
        return len(data)

    def tell(self) -> int:
        return self._written + len(self._pending)

    def flush(self) -> None:
        """Nothing: `sync` is what writes, so we never leave half a chunk."""

    def sync(self, waits: bool = True) -> None:
        """All that was written is on the disk when this returns; if it does not wait, with the
        system, which outlives this process but no power cut. Raises OSError."""
        data = memoryview(bytes(self._pending))
        while data:
            num_written = self._write(self._fd, data)
            if num_written <= 0:
                raise OSError(errno.EIO, "nothing could be written", str(self.path))
            self._written += num_written
            data = data[num_written:]
        self._pending.clear()
        if waits:
            self._sync_data(self._fd)
        self.synced_bytes = self._written

    def abandon(self) -> None:
        """Cut the file back to what was synced, and let it go; never raises."""
        with suppress(OSError):
            self._truncate(self._fd, self.synced_bytes)
            self._sync_data(self._fd)
        self._pending.clear()
        if self.synced_bytes == 0:
            with suppress(OSError):
                self.path.unlink()
        self.close()

    def close(self) -> None:
        if self._fd >= 0:
            fd, self._fd = self._fd, -1
            os.close(fd)
