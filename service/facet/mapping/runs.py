"""Things of different sizes that lie one after another in one array: runs."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from facet.mapping.kernel import kernel

SHARES = 16  # parts that runs are dealt out in; threads take them


@kernel(allocates=False)
def dealt(turn, count):  # type: ignore[no-untyped-def]
    """Which of `count` parts is done in a turn: every other one first. A thread takes the turns of
    its half; what lies side by side, and is as dear, goes to both."""
    half = (count + 1) // 2
    return 2 * turn if turn < half else 2 * (turn - half) + 1


def starts_of(sizes: Any) -> NDArray[np.int64]:
    """(N + 1,) where runs of these sizes (N,) begin, and where the last ends."""
    return np.concatenate([[0], np.cumsum(sizes, dtype=np.int64)]).astype(np.int64)


def deal(starts: NDArray[np.int64]) -> NDArray[np.int64]:
    """(SHARES + 1,) the run that each part begins with, when parts are about as long; starts
    (N + 1,)."""
    parts = np.searchsorted(starts, np.linspace(0, starts[-1], SHARES + 1))
    parts[-1] = len(starts) - 1
    return np.asarray(parts, np.int64)
