"""The figures that a user sees, against least squares and Monte-Carlo."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from facet.mapping.eigen import eigenvalues
from facet.mapping.fitting import Fit, fit_planes
from facet_protocol.messages import PlaneClass

TICK = 0.05 / 1024
UPPER = np.triu_indices(3)


def fit(points: NDArray[np.float64], seen_from: object) -> Fit:
    """The fit of points (N, 3) m seen from the side of `seen_from` (3,)."""
    mean = points.mean(0)
    scatter = ((points - mean).T @ (points - mean))[UPPER]
    side = np.asarray(seen_from, float)
    return fit_planes(np.array([len(points)]), mean[None], scatter[None], side[None], TICK)[0]


def patch(
    seed: int, normal: object, offset: float, count: int = 400, sigma: float = 0.01
) -> NDArray[np.float64]:
    """Points of 3 x 2 m of the plane normal . x = offset, noise along the normal."""
    rng = np.random.default_rng(seed)
    n = np.asarray(normal, float) / np.linalg.norm(normal)
    u = np.cross(n, [0.31, 0.52, 0.79])
    u /= np.linalg.norm(u)
    v = np.cross(n, u)
    a, b = rng.uniform(-1.5, 1.5, count), rng.uniform(-1.0, 1.0, count)
    w = offset + rng.normal(0.0, sigma, count)
    return a[:, None] * u + b[:, None] * v + w[:, None] * n + 0.7 * u - 0.4 * v


vectors = st.lists(st.floats(-1, 1), min_size=3, max_size=3).filter(
    lambda v: np.linalg.norm(v) > 0.1
)


@settings(deadline=None)
@given(vectors, st.floats(-20, 20), st.sampled_from([-1.0, 1.0]))
def test_d_is_never_negative_and_facing_keeps_the_side(
    normal: list[float], offset: float, side: float
) -> None:
    towards = side * np.array(normal) / np.linalg.norm(normal)
    found = fit(patch(1, normal, offset), towards)
    assert found.d >= 0.0
    assert found.facing in (-1, 1)
    assert float(found.inside @ towards) > 0.99
    np.testing.assert_array_equal(found.normal * found.facing, found.inside)
    if abs(offset) > 0.1:
        assert float(found.normal @ np.array(normal)) * offset > 0.0  # away from the origin
        assert found.d == pytest.approx(abs(offset), abs=0.01)
        assert found.offset_m == pytest.approx(found.d * found.facing, abs=1e-9)


def test_the_fit_is_least_squares() -> None:
    points = patch(2, [0.3, -0.8, 0.5], 4.0)
    values, axes = np.linalg.eigh(np.cov(points.T, bias=True))
    found = fit(points, [0.3, -0.8, 0.5])
    assert abs(found.normal @ axes[:, 0]) > 1.0 - 1e-12
    assert found.sigma_n_m == pytest.approx(np.sqrt(values[0]), rel=1e-6)
    assert found.d == pytest.approx(abs(points.mean(0) @ axes[:, 0]), abs=1e-9)


@pytest.mark.parametrize("shift", [-0.9, -0.1, 0.0, 0.1, 0.9, 30.0])
def test_near_the_origin_the_inside_sign_stays(shift: float) -> None:
    """A floor at z = 0 would flip with every scan."""
    found = fit(patch(3, [0, 0, 1], shift * TICK, sigma=0.0), [0, 0, 1])
    assert found.facing == 1
    assert found.d == pytest.approx(max(0.0, shift) * TICK, abs=1e-9)
    assert fit(patch(3, [0, 0, 1], -2 * TICK, sigma=0.0), [0, 0, 1]).facing == -1


def test_the_thickness_angle_of_method_10_2() -> None:
    n = 50
    scatter = np.array([1.0, 0.0, 0.0, 1.0, 0.0, 0.01]) * n
    centroid, side = np.array([[0.0, 0.0, 3.0]]), np.array([[0.0, 0.0, 1.0]])
    (found,) = fit_planes(np.array([n]), centroid, scatter[None], side, TICK)
    assert found.thickness_angle_deg == pytest.approx(6.5868, abs=5e-5)
    s1, s2, s3 = np.sqrt(np.array(eigenvalues(1.0, 1.0, 0.01, 0.0, 0.0, 0.0)))
    assert (s2 / s3) / (s1 / s2) == pytest.approx(10.0)  # lambda, eq. 18


def test_equally_spaced_points_as_method_10_1() -> None:
    """(11): N + 1 = 6 values, R = 3."""
    values = np.linspace(-3.0, 3.0, 6)
    variance = eigenvalues(np.mean(values**2), 0.0, 0.0, 0.0, 0.0, 0.0)[0]
    assert np.sqrt(variance) == pytest.approx(2.049390, abs=1e-6)
    assert np.sqrt(3 * 5 / (5 + 2)) * np.sqrt(variance) == pytest.approx(3.0)  # (12)


def test_the_covariance_is_that_of_many_fits() -> None:
    """Monte-Carlo: the same places, other noise."""
    rng = np.random.default_rng(4)
    clean = patch(5, [0.2, 0.9, 0.3], 3.0, count=60, sigma=0.0)
    n = np.array([0.2, 0.9, 0.3]) / np.linalg.norm([0.2, 0.9, 0.3])
    fits = [fit(clean + rng.normal(0.0, 0.02, len(clean))[:, None] * n, n) for _ in range(4000)]
    sample = np.array([[*f.normal, f.d] for f in fits])
    measured = np.cov(sample.T)
    told = np.mean([f.covariance for f in fits], axis=0)
    scale = np.sqrt(np.outer(np.diag(measured), np.diag(measured)))
    np.testing.assert_allclose(told / scale, measured / scale, atol=0.12)


@settings(deadline=None)
@given(vectors, st.floats(-9, 9))
def test_a_covariance_is_symmetric_and_moves_no_unit_normal_along_itself(
    normal: list[float], offset: float
) -> None:
    found = fit(patch(6, normal, offset), normal)
    c = found.covariance
    np.testing.assert_allclose(c, c.T, atol=0)
    assert np.linalg.eigvalsh(c).min() >= -1e-12 * np.trace(c)
    assert np.abs(c[:3, :3] @ found.normal).max() <= 1e-9 * np.trace(c)


def test_more_points_say_more() -> None:
    few, many = (
        fit(patch(7, [1, 0, 0], 2.0, 100), [1, 0, 0]),
        fit(patch(7, [1, 0, 0], 2.0, 10_000), [1, 0, 0]),
    )
    assert many.covariance[3, 3] == pytest.approx(few.covariance[3, 3] / 100, rel=0.5)


@pytest.mark.parametrize(
    ("inside", "expected"),
    [
        ([0, 0, 1], PlaneClass.FLOOR),
        ([0, 0, -1], PlaneClass.CEILING),
        ([1, 0, 0], PlaneClass.WALL),
        ([0.3, -0.95, 0.1], PlaneClass.WALL),
        ([1, 0, 1], PlaneClass.OTHER),
        ([0, np.sin(0.25), np.cos(0.25)], PlaneClass.FLOOR),
        ([0, np.sin(0.28), np.cos(0.28)], PlaneClass.OTHER),
        ([np.cos(0.25), 0, np.sin(0.25)], PlaneClass.WALL),
        ([np.cos(0.28), 0, -np.sin(0.28)], PlaneClass.OTHER),
    ],
)
@pytest.mark.parametrize("offset", [-3.0, 3.0])
def test_the_class_follows_the_side_it_was_seen_from(
    inside: list[float], expected: PlaneClass, offset: float
) -> None:
    assert fit(patch(8, inside, offset, sigma=0.0), inside).plane_class is expected


def test_a_line_of_points_breaks_nothing() -> None:
    found = fit(np.linspace(0, 1, 20)[:, None] * np.array([[1.0, 0.0, 0.0]]), [0, 0, 1])
    assert np.isfinite(found.covariance).all()
    assert np.isfinite([found.d, found.sigma_n_m, found.thickness_angle_deg]).all()
