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


def fit_planes(
    weight: NDArray[np.float64],
    centroid: NDArray[np.float64],
    scatter: NDArray[np.float64],
    mean_normal: NDArray[np.float64],
    tick_m: float,
) -> list[Fit]:
    """Fits through `weight` (K,) points with `centroid` (K, 3) m and `scatter` (K, 6) m^2 about it.

    `mean_normal` (K, 3), any length, tells the side they were seen from."""
    inside, spreads = np.empty((len(weight), 3)), np.empty((len(weight), 3))
    for k, own in enumerate(scatter):
        low, nx, ny, nz, middle, high = smallest(own)
        inside[k] = nx, ny, nz
        if float(inside[k] @ mean_normal[k]) < 0.0:
            inside[k] = -inside[k]
        spreads[k] = high, middle, low
    x, y, z = (inside * centroid).T
    offset = (x + y) + z
    variances = np.maximum(spreads, 0.0) / weight[:, None]
    flipped = offset < -tick_m  # nearer to the origin than a tick the inside sign stays
    normal = np.where(flipped[:, None], -inside, inside)
    tangential = np.sqrt(np.sqrt(np.maximum(variances[:, 0] * variances[:, 1], 1e-24)))
    sigma = np.sqrt(variances[:, 2])
    slope = 2.0 * sigma / (math.sqrt(3.0) * tangential)
    covariance = _covariance(weight, normal, centroid, scatter, variances)
    return [
        Fit(
            inside=inside[k].copy(),
            offset_m=own,
            normal=normal[k].copy(),
            d=abs(own) if flipped[k] else max(own, 0.0),
            facing=-1 if flipped[k] else 1,
            sigma_n_m=float(sigma[k]),
            thickness_angle_deg=math.degrees(math.atan(slope[k])),
            covariance=covariance[k].copy(),
            plane_class=_classify(inside[k]),
        )
        for k, own in enumerate(offset.tolist())
    ]


def _classify(inside: NDArray[np.float64]) -> PlaneClass:
    if abs(inside[2]) >= _LEVEL:
        return PlaneClass.FLOOR if inside[2] > 0 else PlaneClass.CEILING
    return PlaneClass.WALL if abs(inside[2]) <= _UPRIGHT else PlaneClass.OTHER


def _covariance(
    weight: NDArray[np.float64],
    normal: NDArray[np.float64],
    centroid: NDArray[np.float64],
    scatter: NDArray[np.float64],
    variances: NDArray[np.float64],
) -> NDArray[np.float64]:
    """(K, 4, 4) of (normal, d), first order: the normal tilts about the two principal directions in
    the plane with variance sigma_N^2 / (N sigma_i^2)."""
    full = scatter[:, [0, 1, 2, 1, 3, 4, 2, 4, 5]].reshape(-1, 3, 3) / weight[:, None, None]
    tangent = np.eye(3) - normal[:, :, None] * normal[:, None, :]
    spread = tangent @ full @ tangent
    noise = variances[:, 2] / weight
    tilt = noise[:, None, None] * np.linalg.pinv(spread, rcond=1e-9, hermitian=True)
    across = (-tilt @ centroid[:, :, None])[:, :, 0]  # d = normal . centroid: it moves against the
    # tilt's lever arm
    covariance = np.empty((len(weight), 4, 4))
    covariance[:, :3, :3] = tilt
    covariance[:, :3, 3] = covariance[:, 3, :3] = -across
    own = centroid[:, None, :] @ tilt @ centroid[:, :, None]
    covariance[:, 3, 3] = noise + own[:, 0, 0]
    return covariance
