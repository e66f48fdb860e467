"""What sums say is the same taken alone and side by side, to the bit."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from facet.mapping.principal import (
    LAMBDA,
    NX,
    NY,
    NZ,
    PLACES,
    PRINCIPAL,
    TAN_GAMMA,
    XX,
    analyse,
    analyse_all,
)

FLOOR2 = 0.25


def sums_of(votes: NDArray[np.int64], weight: NDArray[np.int64]) -> NDArray[np.int32]:
    """Number, weight, and weighted sums of votes (N, 3) and of their products, and a key."""
    products = [(weight * votes[:, a] * votes[:, b]).sum() for a in range(3) for b in range(a, 3)]
    own = [len(votes), weight.sum(), *(weight[:, None] * votes).sum(0), *products, 0]
    return np.array(own, np.int32)


def kept(rng: np.random.Generator) -> NDArray[np.int32]:
    """Sums of tilted slabs, of a line, of one vote, and places that hold nothing."""
    rows = np.zeros((PLACES, 12), np.int32)
    for e in range(11):
        tilt = np.linalg.qr(rng.normal(size=(3, 3)))[0]
        votes = np.rint(rng.normal(size=(60, 3)) * [30.0, 20.0, 2.0] @ tilt).astype(np.int64)
        rows[e] = sums_of(votes, rng.integers(1, 9, 60))
    line = np.outer(np.arange(-5, 6), [3, 0, 0])
    rows[11] = sums_of(line, np.ones(11, np.int64))
    rows[12] = sums_of(np.array([[1, 2, 3]]), np.array([4]))
    return rows


@pytest.mark.parametrize("count", [1, 7, 8, 9, 13])
def test_side_by_side_is_as_one_by_one(count: int) -> None:
    rows = kept(np.random.default_rng(count))
    alone, together = np.zeros(PRINCIPAL), np.zeros(PRINCIPAL)
    for e in range(count):
        analyse(rows, e, FLOOR2, alone)
    analyse_all(rows, count, FLOOR2, together)
    for column in (LAMBDA, TAN_GAMMA, NX, NY, NZ):
        own = slice(column, column + count)
        assert alone[own].tobytes() == together[own].tobytes()


def test_they_are_lapacks() -> None:
    rows, principal = kept(np.random.default_rng(3)), np.zeros(PRINCIPAL)
    analyse_all(rows, 11, FLOOR2, principal)
    for e in range(11):
        w = float(rows[e, 1])
        mean, xx = rows[e, 2:5] / w, np.zeros((3, 3))
        xx[np.triu_indices(3)] = rows[e, 5:11] / w
        covariance = xx + np.triu(xx, 1).T - np.outer(mean, mean)
        values, vectors = np.linalg.eigh(covariance)
        low, middle, high = np.maximum(values, FLOOR2)
        assert principal[LAMBDA + e] == pytest.approx(middle / np.sqrt(high * low), rel=1e-9)
        gamma = np.sqrt(low / np.sqrt(high * middle)) * 2.0 / np.sqrt(3.0)
        assert principal[TAN_GAMMA + e] == pytest.approx(gamma, rel=1e-9)
        normal = principal[[NX + e, NY + e, NZ + e]]
        assert abs(normal @ vectors[:, 0]) == pytest.approx(1.0, abs=1e-9)
        assert principal[XX + e] == pytest.approx(covariance[0, 0])
