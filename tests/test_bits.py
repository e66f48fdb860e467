"""Bit tricks against the plainest way."""

from __future__ import annotations

import itertools

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st
from numba import njit

from facet.mapping.bits import box_mask, trailing_zeros


@njit
def set_bits(word: np.uint64) -> list[int]:
    out = []
    while word != np.uint64(0):
        out.append(np.int64(trailing_zeros(word)))
        word &= word - np.uint64(1)
    return out


def test_every_box_of_an_8_by_8_slice() -> None:
    sides = [(a, b) for a in range(8) for b in range(a, 8)]
    for (x0, x1), (y0, y1) in itertools.product(sides, sides):
        plain = sum(1 << (x + 8 * y) for x in range(x0, x1 + 1) for y in range(y0, y1 + 1))
        assert int(box_mask(x0, x1, y0, y1)) == plain


@settings(deadline=None)
@given(st.integers(1, 2**64 - 1))
def test_bits_are_found_lowest_first(word: int) -> None:
    expected = [b for b in range(64) if word >> b & 1]
    assert list(set_bits(np.uint64(word))) == expected
