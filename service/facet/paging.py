"""Bounded memory: the map's columns in files without a name, whose cold pages go to the disk.

The system's page cache does the paging. A column is a shared mapping of a file: giving its pages
back loses nothing, and what is touched again comes back unchanged, from the cache or the disk."""

from __future__ import annotations

import logging
import mmap
import os
import resource
import tempfile
import threading
import weakref
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from facet.mapping.memory import Column, Heap, clear

logger = logging.getLogger(__name__)

RESERVE = 16  # times what it needs, that a column is promised where that costs nothing
STRICT = "2"  # vm.overcommit_memory: promises are counted
SMALLEST = 1 << 18  # bytes: smaller columns stay in plain memory
MIB = 1 << 20


def resident_bytes() -> int:
    """Memory of this process that is not on the disk alone."""
    with open("/proc/self/statm", encoding="ascii") as file:
        return int(file.read().split()[1]) * mmap.PAGESIZE


def plain_memory() -> Heap:
    """Plain memory, in which large columns grow where they are, unless the system counts what it
    promises: a limit of addresses, or strict accounting."""
    is_counted = resource.getrlimit(resource.RLIMIT_AS)[0] != resource.RLIM_INFINITY
    with suppress(OSError):
        policy = Path("/proc/sys/vm/overcommit_memory").read_text(encoding="ascii")
        is_counted |= policy.strip() == STRICT
    return Heap(1 if is_counted else RESERVE)


@dataclass(slots=True)
class Region:
    """A column's file: open as long as its pages, which the column alone keeps alive."""

    fd: int
    pages: weakref.ref[mmap.mmap]


class PagedMemory:
    """Room for columns (`facet.mapping.memory.Memory`) of which no more than `max_bytes`, with all
    that the process holds besides, stay in memory from one update to the next.

    Where the disk is full, a column stays in plain memory, and a warning says so."""

    growth = 2  # room is taken from the disk, and nothing is copied

    def __init__(self, directory: Path, max_bytes: int) -> None:
        self._directory, self._max_bytes = directory, max_bytes
        self._regions: dict[int, Region] = {}  # by the address of the column
        self._heap, self._lock = Heap(), threading.Lock()
        self.times_given_back = 0

    def grown(self, column: Column, used: int, capacity: int) -> Column:
        """See `Memory`. Nothing is copied once a column has its file."""
        shape = (capacity, *column.shape[1:])
        num_bytes = int(np.prod(shape, dtype=np.int64)) * column.dtype.itemsize
        if num_bytes < SMALLEST:
            return self._heap.grown(column, used, capacity)
        with self._lock:  # beams are followed on a thread of their own
            self._regions = {k: r for k, r in self._regions.items() if r.pages() is not None}
            region = self._regions.pop(_address(column), None) if column.nbytes else None
            if region is not None and used:
                clear(column[used:])
            try:
                fd = os.dup(region.fd) if region is not None and used else self._file()
                out, pages = _mapped(fd, shape, column.dtype, num_bytes)
            except OSError as error:
                logger.warning(
                    "a column of the map stays in memory, %s: %s", self._directory, error
                )
                return self._heap.grown(column, used, capacity)
            if region is None:
                out[:used] = column[:used]
            self._regions[_address(out)] = Region(fd, weakref.ref(pages))
            return out

    def rest(self) -> None:
        """Give all pages back when the process holds too much: what is hot comes back at once."""
        if resident_bytes() > self._max_bytes:
            self.give_back()

    def give_back(self) -> None:
        """Let go of every page. Their content stays, in the page cache or on the disk."""
        self.times_given_back += 1
        for pages in self._alive():
            pages.madvise(mmap.MADV_DONTNEED)

    @property
    def file_bytes(self) -> int:
        """Length of all files, of which what was never written takes no memory."""
        return sum(map(len, self._alive()))

    def _alive(self) -> list[mmap.mmap]:
        found = (region.pages() for region in self._regions.values())
        return [pages for pages in found if pages is not None]

    def _file(self) -> int:
        self._directory.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=self._directory, prefix="facet-columns-") as file:
            return os.dup(file.fileno())


def _address(column: Column) -> int:
    return int(column.__array_interface__["data"][0])


def _mapped(
    fd: int, shape: tuple[int, ...], dtype: np.dtype[Any], num_bytes: int
) -> tuple[NDArray[Any], mmap.mmap]:
    """A file as an array, closed when that is gone. Its room on the disk is reserved: a full disk
    is an error here, and not a signal that kills when a page is touched. Raises OSError."""
    try:
        os.posix_fallocate(fd, 0, num_bytes)
        pages = mmap.mmap(fd, num_bytes)
    except OSError:
        os.close(fd)
        raise
    weakref.finalize(pages, os.close, fd)
    return np.frombuffer(pages, dtype).reshape(shape), pages
