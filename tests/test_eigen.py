"""Principal variances and directions against LAPACK."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from facet.mapping.eigen import eigenvalues, eigenvector, smallest

Matrix = NDArray[np.float64]


def parts(m: Matrix) -> tuple[float, ...]:
    return m[0, 0], m[1, 1], m[2, 2], m[0, 1], m[0, 2], m[1, 2]


def turned(values: tuple[float, float, float], rng: np.random.Generator) -> Matrix:
    q, _ = np.linalg.qr(rng.normal(size=(3, 3)))
    m = q @ np.diag(values) @ q.T
    return (m + m.T) / 2.0


def cases() -> list[Matrix]:
    rng = np.random.default_rng(0)
    shapes = [
        (1.0, 1.0, 1e-4), (1.0, 0.5, 1e-6), (3.0, 2.0, 1.0), (1.0, 1e-3, 1e-3), (1e6, 4e5, 1e-2),
        (1e-6, 5e-7, 1e-9), (2.0, 2.0, 2.0), (1.0, 1.0, 0.0), (1.0, 0.0, 0.0),
    ]  # fmt: skip
    many = [turned(shape, rng) for shape in shapes for _ in range(30)]
    spread = rng.normal(size=(200, 3, 3))
    return [
        *many,
        *(a @ a.T for a in spread),
        np.zeros((3, 3)),
        np.eye(3),
        np.diag([3.0, 1.0, 2.0]),
    ]


@pytest.mark.parametrize("chunk", range(4))
def test_eigenvalues_are_lapacks(chunk: int) -> None:
    for m in cases()[chunk::4]:
        expected = np.linalg.eigvalsh(m)[::-1]
        scale = max(1e-300, abs(expected[0]))
        found = np.array(eigenvalues(*parts(m)))
        np.testing.assert_allclose(found / scale, expected / scale, atol=2e-8)
        assert found.sum() == pytest.approx(np.trace(m), rel=1e-12, abs=1e-300)


def test_the_direction_of_a_plane_is_lapacks() -> None:
    rng = np.random.default_rng(1)
    for third in (0.0, 1e-6, 1e-3, 0.1):
        for _ in range(100):
            m = turned((1.0, 0.4, third), rng)
            values, vectors = np.linalg.eigh(m)
            found = np.array(eigenvector(*parts(m), values[0]))
            assert abs(np.linalg.norm(found) - 1.0) < 1e-12
            assert abs(found @ vectors[:, 0]) > 1.0 - 1e-12


def test_the_residual_is_small_where_the_eigenvalue_is_simple() -> None:
    rng = np.random.default_rng(2)
    for _ in range(200):
        m = turned((5.0, 2.0, 0.01), rng)
        for value in eigenvalues(*parts(m)):
            n = np.array(eigenvector(*parts(m), value))
            assert np.abs(m @ n - value * n).max() < 1e-6


@pytest.mark.parametrize("m", [np.eye(3), np.zeros((3, 3)), 7.0 * np.eye(3)])
def test_no_clear_direction_gives_an_upright_one(m: Matrix) -> None:
    assert eigenvector(*parts(m), m[0, 0]) == (0.0, 0.0, 1.0)


def test_smallest_reads_a_scatter() -> None:
    rng = np.random.default_rng(3)
    x = rng.normal(size=(500, 3)) * [3.0, 1.0, 0.05]
    m = (x - x.mean(0)).T @ (x - x.mean(0))
    scatter = m[[0, 0, 0, 1, 1, 2], [0, 1, 2, 1, 2, 2]]
    low, nx, ny, nz, middle, high = smallest(scatter)
    values, vectors = np.linalg.eigh(m)
    np.testing.assert_allclose([low, middle, high], values, rtol=1e-6)
    assert abs(np.array([nx, ny, nz]) @ vectors[:, 0]) > 1.0 - 1e-9
