"""Where columns live: zeroed arrays that grow. The core only asks; the shell may hand it memory
whose cold pages go to disk.

What was never written must cost nothing, so a column's empty value is zero, or is written when its
row comes into use; then the room that a column has in reserve is free."""

from __future__ import annotations

import math
import mmap
from collections.abc import Iterator
from contextlib import suppress
from typing import Any, Protocol, TypeVar

import numpy as np
from numpy.typing import DTypeLike, NDArray

Column = NDArray[Any]
CHUNK = 1 << 20  # bytes that are looked at at a time
SMALL = 4 << 20  # bytes: two large pages
LARGE_PAGES = "MADV_HUGEPAGE"  # fewer of them are looked up
MOST = 1 << 30  # bytes that a column is promised beyond what it needs
C = TypeVar("C", bound=tuple[Any, ...])


class Memory(Protocol):
    """Room for columns."""

    growth: int  # how many times as long a full column becomes

    def grown(self, column: Column, used: int, capacity: int) -> Column:
        """A column (capacity, ...) with the first `used` rows of `column`, zeros behind them. The
        old one is not to be used again."""

    def rest(self) -> None:
        """An update has ended: what was not needed lately may go."""


class Heap:
    """Plain memory. What was not written yet takes none.

    Large columns are promised `reserve` times what they need: then they grow where they are. Where
    promises are counted, that is better 1."""

    growth = 4  # a copy is dearer than room that is not used

    def __init__(self, reserve: int = 1) -> None:
        self._reserve = reserve

    def grown(self, column: Column, used: int, capacity: int) -> Column:
        """The same memory where it was promised more, else a copy, see `Memory`: to copy a million
        voxels takes as long as some updates."""
        shape, own = (capacity, *column.shape[1:]), _room_of(column)
        count = math.prod(shape)
        if used and own is not None and own.nbytes >= count * column.itemsize:
            clear(column[used:])
            return np.frombuffer(own, column.dtype, count).reshape(shape)
        out = _promised(shape, column.dtype, self._reserve)
        for part in _written(column[:used]):  # a copy of zeros would take memory
            out[part] = column[part]
        return out

    def rest(self) -> None:
        """Nothing goes."""


def copied(memory: Memory, column: Column, used: int) -> Column:
    """A copy (used, ...) of the first rows of a column, in the same kind of memory."""
    out = memory.grown(np.zeros((0, *column.shape[1:]), column.dtype), 0, used)
    for part in _written(column[:used]):
        out[part] = column[part]
    return out


def sparse(count: int, dtype: DTypeLike) -> Column:
    """Zeros (count,) of which little will be written, in small pages: what is zeroed for each touch
    of large ones can cost more than what is done there."""
    return _mapped(count, np.dtype(dtype), "MADV_NOHUGEPAGE")


def _room_of(column: Column) -> memoryview | None:
    """All that was mapped for a column; None for one in other memory."""
    base: Any = column
    while isinstance(base, np.ndarray):
        base = base.base
    is_mapped = isinstance(base, memoryview) and isinstance(base.obj, mmap.mmap)
    return base if is_mapped else None


def _promised(shape: tuple[int, ...], dtype: np.dtype[Any], reserve: int) -> Column:
    """Zeros that take no memory until they are written. `np.zeros` writes them where it is given
    memory that was in use before."""
    count = math.prod(shape)
    num_bytes = count * dtype.itemsize
    if num_bytes < SMALL:
        return np.zeros(shape, dtype)
    with suppress(OSError):  # from a system that promises no more than it has
        times = max(1, min(reserve, MOST // num_bytes))
        return _mapped(times * count, dtype, LARGE_PAGES)[:count].reshape(shape)
    return _mapped(count, dtype, LARGE_PAGES).reshape(shape)


def _mapped(count: int, dtype: np.dtype[Any], advice: str) -> Column:
    room = mmap.mmap(-1, count * dtype.itemsize, mmap.MAP_PRIVATE | mmap.MAP_ANONYMOUS)
    if hasattr(mmap, advice):
        with suppress(OSError):  # from a system that has no such pages
            room.madvise(getattr(mmap, advice))
    return np.frombuffer(room, dtype)


def grow_all(memory: Memory, columns: C, used: int, capacity: int) -> C:
    """The same named tuple of columns, each grown."""
    return type(columns)(*(memory.grown(c, used, capacity) for c in columns))


def clear(column: Column) -> None:
    """Make a column zero without touching what is."""
    for part in _written(column):
        column[part] = 0


def _written(column: Column) -> Iterator[slice]:
    """The parts of a column that are not all zero."""
    step = max(1, CHUNK * len(column) // max(1, column.nbytes))
    for start in range(0, len(column), step):
        part = slice(start, min(start + step, len(column)))
        if column[start].any() or column[part].any():  # the first row alone mostly says so
            yield part
