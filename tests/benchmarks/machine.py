"""What this machine can do at best: a few plain loops, each the ceiling of one kind of work."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any

import numpy as np
from numba import njit, prange
from numpy.typing import NDArray

from facet.mapping.bits import trailing_zeros

WORDS = 1 << 25  # 256 MB: no cache holds it
LINE = 8  # words of a cache line
SMALL = 1 << 15  # words that the second cache holds
REPEATS = 7


@njit(nogil=True, parallel=True)
def _copy(source, target):  # type: ignore[no-untyped-def]
    for i in prange(source.shape[0]):
        target[i] = source[i] + 1


@njit(nogil=True, parallel=True)
def _gather(words, order, sums):  # type: ignore[no-untyped-def]
    """One word of each line, in an order no prefetcher follows."""
    half = order.shape[0] // sums.shape[0]
    for t in prange(sums.shape[0]):
        total = np.int64(0)
        for i in range(t * half, (t + 1) * half):
            total += words[order[i]]
        sums[t] = total


@njit(nogil=True, parallel=True)
def _moments(values, sums, rounds):  # type: ignore[no-untyped-def]
    """Ten multiply-adds a value in integers, as in a sum of moments; all in cache."""
    for t in prange(sums.shape[0]):
        for _ in range(rounds):
            a = b = c = d = e = np.int64(0)
            f = g = h = p = q = np.int64(0)
            for i in range(values.shape[0]):
                w = values[i]
                x, y, z = w & 15, (w >> 4) & 15, (w >> 8) & 15
                a += 1
                b += x
                c += y
                d += z
                e += x * x
                f += x * y
                g += x * z
                h += y * y
                p += y * z
                q += z * z
            sums[t] += a + b + c + d + e + f + g + h + p + q


@njit(nogil=True, parallel=True)
def _picked(masks, values, sums, rounds):  # type: ignore[no-untyped-def]
    """The same of the values whose bits are set, one by one, as in an occupied neighbourhood."""
    for t in prange(sums.shape[0]):
        for _ in range(rounds):
            a = b = c = d = e = np.int64(0)
            f = g = h = p = q = np.int64(0)
            for m in range(masks.shape[0]):
                word = masks[m]
                while word != np.uint64(0):
                    w = values[64 * m + np.int64(trailing_zeros(word))]
                    word &= word - np.uint64(1)
                    x, y, z = w & 15, (w >> 4) & 15, (w >> 8) & 15
                    a += 1
                    b += x
                    c += y
                    d += z
                    e += x * x
                    f += x * y
                    g += x * z
                    h += y * y
                    p += y * z
                    q += z * z
            sums[t] += a + b + c + d + e + f + g + h + p + q


@njit(nogil=True, parallel=True)
def _roots(values, sums, rounds):  # type: ignore[no-untyped-def]
    """A division and a square root a value, which nothing else can hide."""
    for t in prange(sums.shape[0]):
        for r in range(rounds):
            total = 0.0
            for i in range(values.shape[0]):
                total += np.sqrt(values[i] + r) / (values[i] + 1.0)
            sums[t] += total


def best_s(work: Callable[[], Any]) -> float:
    """The least of several runs, after one that warms up."""
    work()
    seconds = []
    for _ in range(REPEATS):
        started = time.perf_counter()
        work()
        seconds.append(time.perf_counter() - started)
    return min(seconds)


def ceilings(threads: int, quick: bool) -> dict[str, float]:
    """By name, a second, all threads together: bytes streamed (read and written), cache lines
    fetched at random, values summed into moments, the same picked by the bits of masks, divisions
    with a square root."""
    import numba

    numba.set_num_threads(threads)
    words = WORDS // 8 if quick else WORDS
    source, target = np.ones(words, np.int64), np.zeros(words, np.int64)
    order = np.random.default_rng(0).permutation(words // LINE) * LINE
    sums: NDArray[Any] = np.zeros(threads, np.int64)
    small = np.random.default_rng(1).integers(0, 1 << 12, SMALL)
    rounds, floats = 200, np.random.default_rng(2).random(SMALL)
    masks = np.full(SMALL // 64, 0x8421084210842108, np.uint64)  # one voxel in five
    real, num_bits = np.zeros(threads), 13 * len(masks)
    return {
        "bytes": 2.0 * source.nbytes / best_s(lambda: _copy(source, target)),
        "lines": len(order) / best_s(lambda: _gather(source, order, sums)),
        "moments": threads * rounds * SMALL / best_s(lambda: _moments(small, sums, rounds)),
        "picked": threads * rounds * num_bits / best_s(lambda: _picked(masks, small, sums, rounds)),
        "roots": threads * rounds * SMALL / best_s(lambda: _roots(floats, real, rounds)),
    }
