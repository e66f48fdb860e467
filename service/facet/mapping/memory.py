"""Where columns live: zeroed arrays that grow. The core only asks; the shell may hand it memory
that goes to disk when it is cold.

What was never written must cost nothing, so a column's empty value is zero, or is written when its
row comes into use; then the room that a column has in reserve is free."""

from __future__ import annotations

from typing import Any, Protocol, TypeVar

import numpy as np
from numpy.typing import NDArray

Column = NDArray[Any]
C = TypeVar("C", bound=tuple[Any, ...])


class Memory(Protocol):
    """Room for columns."""

    def grown(self, column: Column, used: int, capacity: int) -> Column:
        """A column (capacity, ...) with the first `used` rows of `column`, zeros behind them. The
        old one is not to be used again."""

    def rest(self) -> None:
        """An update has ended: what was not needed lately may go."""


class Heap:
    """Plain memory. What was not written yet takes none."""

    def grown(self, column: Column, used: int, capacity: int) -> Column:
        """A copy, see `Memory`."""
        out = np.zeros((capacity, *column.shape[1:]), column.dtype)
        out[:used] = column[:used]
        return out

    def rest(self) -> None:
        """Nothing goes."""


def grow_all(memory: Memory, columns: C, used: int, capacity: int) -> C:
    """The same named tuple of columns, each grown."""
    return type(columns)(*(memory.grown(c, used, capacity) for c in columns))
