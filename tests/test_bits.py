"""Bit tricks against the plainest way."""

from __future__ import annotations

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st
from numba import njit

from facet.mapping.bits import population, trailing_zeros


@njit
def set_bits(word: np.uint64) -> list[int]:
    out = []
    while word != np.uint64(0):
        out.append(np.int64(trailing_zeros(word)))
        word &= word - np.uint64(1)
    return out


@settings(deadline=None)
@given(st.integers(1, 2**64 - 1))
def test_bits_are_found_lowest_first(word: int) -> None:
    expected = [b for b in range(64) if word >> b & 1]
    assert list(set_bits(np.uint64(word))) == expected


@njit
def number_of_bits(word: np.uint64) -> int:
    return np.int64(population(word))


@settings(deadline=None)
@given(st.integers(0, 2**64 - 1))
def test_bits_are_counted(word: int) -> None:
    assert number_of_bits(np.uint64(word)) == word.bit_count()
