"""From a plane's point moments to the figures that a user sees (eq. 4-10)."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from facet.mapping.eigen import smallest
from facet_protocol.messages import PlaneClass

_LEVEL = math.cos(math.radians(15.0))
_UPRIGHT = math.sin(math.radians(15.0))


class Fit(NamedTuple):
    """A least-squares plane. `inside` points to where it was seen from; (normal, d, facing) are
    the same plane with d >= 0 (eq. 6)."""

    inside: NDArray[np.float64]  # (3,)
    offset_m: float  # inside . x
    normal: NDArray[np.float64]  # (3,)
    d: float  # m
    facing: int
    sigma_n_m: float
    thickness_angle_deg: float
    covariance: NDArray[np.float64]  # (4, 4) of (normal, d)
    plane_class: PlaneClass


def fit_plane(
    weight: float,
    centroid: NDArray[np.float64],
    scatter: NDArray[np.float64],
    mean_normal: NDArray[np.float64],
    tick_m: float,
) -> Fit:
    """Fit through `weight` points with `centroid` (3,) m and `scatter` (6,) m^2 about it.

    `mean_normal` (3,), any length, tells the side it was seen from."""
    low, nx, ny, nz, middle, high = smallest(scatter)
    inside = np.array([nx, ny, nz])
    if float(inside @ mean_normal) < 0.0:
        inside = -inside
    offset = float((inside[0] * centroid[0] + inside[1] * centroid[1]) + inside[2] * centroid[2])
    variances = np.maximum([high, middle, low], 0.0) / weight
    flipped = offset < -tick_m  # nearer to the origin than a tick the inside sign stays
    normal = -inside if flipped else inside
    tangential = math.sqrt(math.sqrt(max(variances[0] * variances[1], 1e-24)))
    sigma = math.sqrt(variances[2])
    return Fit(
        inside=inside,
        offset_m=offset,
        normal=normal,
        d=abs(offset) if flipped else max(offset, 0.0),
        facing=-1 if flipped else 1,
        sigma_n_m=sigma,
        thickness_angle_deg=math.degrees(math.atan(2.0 * sigma / (math.sqrt(3.0) * tangential))),
        covariance=_covariance(weight, normal, centroid, scatter, variances),
        plane_class=_classify(inside),
    )


def _classify(inside: NDArray[np.float64]) -> PlaneClass:
    if abs(inside[2]) >= _LEVEL:
        return PlaneClass.FLOOR if inside[2] > 0 else PlaneClass.CEILING
    return PlaneClass.WALL if abs(inside[2]) <= _UPRIGHT else PlaneClass.OTHER


def _covariance(
    weight: float,
    normal: NDArray[np.float64],
    centroid: NDArray[np.float64],
    scatter: NDArray[np.float64],
    variances: NDArray[np.float64],
) -> NDArray[np.float64]:
    """Of (normal, d), first order: the normal tilts about the two principal directions in the plane
    with variance sigma_N^2 / (N sigma_i^2)."""
    full = scatter[[0, 1, 2, 1, 3, 4, 2, 4, 5]].reshape(3, 3) / weight
    tangent = np.eye(3) - np.outer(normal, normal)
    spread = tangent @ full @ tangent
    noise = variances[2] / weight
    tilt = noise * np.linalg.pinv(spread, rcond=1e-9, hermitian=True)
    across = -tilt @ centroid  # d = normal . centroid: it moves against the tilt's lever arm
    covariance = np.empty((4, 4))
    covariance[:3, :3] = tilt
    covariance[:3, 3] = covariance[3, :3] = -across
    covariance[3, 3] = noise + float(centroid @ tilt @ centroid)
    return covariance
