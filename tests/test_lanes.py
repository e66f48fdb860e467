"""Numbers side by side, one operation at a time, against arrays."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from numba import njit
from numpy.typing import NDArray

from facet.mapping.lanes import (
    LANES,
    QUARTERS,
    add_products,
    larger,
    load,
    load_part,
    no_sums,
    splat,
    store,
    total,
)

Column = NDArray[np.int16]
AT = 3  # columns need not begin at a full register
EDGES = np.array([0, 1, -1, 2, -2, 127, -128, 181, -181, 32767, -32768], np.int16)


def columns(seed: int) -> tuple[Column, Column]:
    """Two columns with more than LANES numbers from AT on, the smallest and largest among them."""
    rng = np.random.default_rng(seed)
    one, other = rng.integers(-200, 200, (2, AT + LANES + 2)).astype(np.int16)
    one[AT : AT + len(EDGES)] = rng.permutation(EDGES)
    other[AT : AT + 4] = rng.permutation(EDGES)[:4]
    return one, other


def operation(source: str) -> Callable[[Column, Column, Column], None]:
    """out[AT:AT + LANES] = what `source` makes of x and y."""
    space: dict[str, Any] = {"load": load, "store": store, "larger": larger, "splat": splat}
    lines = f"x, y = load(one, {AT}), load(other, {AT}); store(out, {AT}, {source})"
    exec(f"def own(one, other, out):\n    {lines}", space)
    compiled: Callable[[Column, Column, Column], None] = njit(space["own"])
    return compiled


@pytest.mark.parametrize(
    ("source", "plain"),
    [
        ("x + y", np.add),
        ("x - y", np.subtract),
        ("x * y", np.multiply),
        ("x & y", np.bitwise_and),
        ("x | y", np.bitwise_or),
        ("larger(x, y)", np.maximum),
        ("x < y", lambda x, y: -(x < y).astype(np.int16)),
        ("x <= y", lambda x, y: -(x <= y).astype(np.int16)),
        ("x > y", lambda x, y: -(x > y).astype(np.int16)),
        ("abs(x)", lambda x, y: np.abs(x)),
        ("x >> splat(3)", lambda x, y: x >> 3),
        ("splat(-7)", lambda x, y: np.full(LANES, -7, np.int16)),
    ],
)
def test_each_lane_is_as_if_alone(source: str, plain: Callable[[Column, Column], Column]) -> None:
    apply = operation(source)
    for seed in range(8):
        one, other = columns(seed)
        out = np.full(AT + LANES + 2, 99, np.int16)
        apply(one, other, out)
        span = slice(AT, AT + LANES)
        with np.errstate(over="ignore"):
            assert out[span].tolist() == plain(one[span], other[span]).tolist()
        assert (np.delete(out, np.r_[span]) == 99).all()  # and nothing beside them is written


@njit
def unpacked(packed: NDArray[np.int64], out: NDArray[np.int16]) -> None:
    for part in range(4):
        store(out[part], AT, load_part(packed, AT, 16 * part))


@njit
def moved(packed: NDArray[np.int64], out: NDArray[np.int64]) -> None:
    store(out, AT, load(packed, AT + 1))


def test_wide_numbers_are_moved_whole_and_read_in_parts() -> None:
    packed = np.random.default_rng(1).integers(-(2**63), 2**63 - 1, AT + LANES + 2)
    parts = packed.view(np.int16).reshape(-1, 4).T  # the lowest first
    out = np.full((4, AT + LANES + 2), 99, np.int16)
    unpacked(packed, out)
    assert (out[:, AT : AT + LANES] == parts[:, AT : AT + LANES]).all()
    wide = np.full(AT + QUARTERS + 2, 99)
    moved(packed, wide)
    assert wide.tolist() == [99] * AT + packed[AT + 1 : AT + 1 + QUARTERS].tolist() + [99] * 2


@njit
def product(one: Column, other: Column) -> int:
    sums = no_sums()
    for i in range(0, one.shape[0], LANES):
        sums = add_products(sums, load(one, i), load(other, i))
    return total(sums)


def test_products_are_summed_in_32_bits() -> None:
    rng = np.random.default_rng(0)
    for _ in range(8):
        one, other = rng.integers(-3000, 3000, (2, 12 * LANES)).astype(np.int16)
        assert product(one, other) == int(one.astype(np.int64) @ other.astype(np.int64))
