"""A file that knows how much of it is safely on the disk, and can be cut back to that."""

from __future__ import annotations

import os
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path


class DurableFile:
    """Collects writes in memory; `sync` puts them on the disk, all or (after `abandon`) none.

    What the system is asked for goes through `write`, `sync_data` and `truncate`, so that a test
    can make any of them fail.
    """

    def __init__(
        self,
        path: Path,
        write: Callable[[int, bytes], int] = os.write,
        sync_data: Callable[[int], None] = os.fdatasync,
        truncate: Callable[[int, int], None] = os.ftruncate,
    ) -> None:
        self.path = path
        self.synced_bytes = 0  # this much survives a power cut
        self._write, self._sync_data, self._truncate = write, sync_data, truncate
        self._pending = bytearray()
        self._written = 0
        self._fd = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_CLOEXEC, 0o640)
        sync_directory(path.parent)

    def write(self, data: bytes) -> int:
        """Take bytes; nothing reaches the system yet."""
        self._pending += data
        return len(data)

    def tell(self) -> int:
        return self._written + len(self._pending)

    def flush(self) -> None:
        """Nothing: `sync` is what writes, so we never leave half a chunk."""

    def sync(self) -> None:
        """All that was written is on the disk when this returns. Raises OSError."""
        view = memoryview(bytes(self._pending))
        while view:
            num_written = self._write(self._fd, bytes(view))
            self._written += num_written
            view = view[num_written:]
        self._pending.clear()
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


def sync_directory(directory: Path) -> None:
    """The names in it survive a power cut."""
    fd = os.open(directory, os.O_RDONLY | os.O_DIRECTORY | os.O_CLOEXEC)
    try:
        os.fsync(fd)
    finally:
        os.close(fd)
