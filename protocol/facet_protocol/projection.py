"""A flat fan of ranges to points. Only + - * and rounding: the same bits on every machine."""

from __future__ import annotations

from functools import lru_cache

import numpy as np
from numpy.typing import ArrayLike, NDArray

Floats = NDArray[np.float64]

# pi/2 as two parts of 33 bits, so that k * part is exact for |k| < 2^20, and a tail
# (Cody & Waite 1980; the constants and the kernels below are those of fdlibm, k_sin.c and k_cos.c).
_TWO_OVER_PI = 6.36619772367581382433e-01
_HALF_PI = (1.57079632673412561417e00, 6.07710050630396597660e-11, 2.02226624879595063154e-21)
_SIN = (
    -1.66666666666666324348e-01,
    8.33333333332248946124e-03,
    -1.98412698298579493134e-04,
    2.75573137070700676789e-06,
    -2.50507602534068634195e-08,
    1.58969099521155010221e-10,
)
_COS = (
    4.16666666666666019037e-02,
    -1.38888888888741095749e-03,
    2.48015872894767294178e-05,
    -2.75573143513906633035e-07,
    2.08757232129817482790e-09,
    -1.13596475577881948265e-11,
)

LARGEST = float(np.finfo(np.float32).max)  # m; a longer range becomes inf: the map counts it
KEPT_BEAMS = 4096  # directions of larger fans are not kept

MAX_ANGLE = 1000.0  # rad; what sin_cos is accurate for, and more than any scanner turns


def _horner(coefficients: tuple[float, ...], z: Floats) -> Floats:
    result = np.full_like(z, coefficients[-1])
    for coefficient in coefficients[-2::-1]:
        result = result * z + coefficient
    return result


def sin_cos(angles: ArrayLike) -> tuple[Floats, Floats]:
    """Sine and cosine of `angles` (rad, |angle| <= MAX_ANGLE), to within 1e-15 near a few turns."""
    a = np.asarray(angles, dtype=np.float64)
    k = np.rint(a * _TWO_OVER_PI)
    r = ((a - k * _HALF_PI[0]) - k * _HALF_PI[1]) - k * _HALF_PI[2]  # |r| <= pi/4
    z = r * r
    sin_r = r + r * z * _horner(_SIN, z)
    cos_r = (1.0 - 0.5 * z) + z * z * _horner(_COS, z)
    quadrant = k.astype(np.int64) & 3
    swap = (quadrant & 1) == 1
    sine = np.where(swap, cos_r, sin_r)
    cosine = np.where(swap, sin_r, cos_r)
    return (
        np.where(quadrant >= 2, -sine, sine),
        np.where((quadrant == 1) | (quadrant == 2), -cosine, cosine),
    )


def fan_angles(start_angle: float, end_angle: float, num: int) -> Floats:
    """(num,) rad, spread evenly from start to end, both included."""
    step = (end_angle - start_angle) / (num - 1) if num > 1 else 0.0
    return start_angle + np.arange(num, dtype=np.float64) * step


def fan_directions(start_angle: float, end_angle: float, num: int) -> tuple[Floats, Floats]:
    """Sine and cosine (num,) of `fan_angles`. A scanner's fans are all alike: they are kept."""
    if num <= KEPT_BEAMS:
        return _kept_directions(start_angle, end_angle, num)
    return sin_cos(fan_angles(start_angle, end_angle, num))


@lru_cache(maxsize=16)
def _kept_directions(start_angle: float, end_angle: float, num: int) -> tuple[Floats, Floats]:
    sine, cosine = sin_cos(fan_angles(start_angle, end_angle, num))
    sine.flags.writeable = cosine.flags.writeable = False
    return sine, cosine


def project_fan(
    start_angle: float, end_angle: float, ranges: ArrayLike, reach_m: float
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Points (N, 3) of the beams that hit and ends (M, 3) of those that came back empty, in metres.

    Sensor frame: beams lie in x-y, angles counter-clockwise from +x. A range of +inf came back
    empty and is free as far as `reach_m`; NaN and ranges <= 0 say nothing (see `count_ignored`).
    """
    r = np.asarray(ranges, dtype=np.float64)
    sine, cosine = fan_directions(start_angle, end_angle, r.size)
    hit = (r > 0.0) & (r <= LARGEST)
    if np.count_nonzero(hit) == r.size:  # as most are
        return _ends(cosine, sine, r), np.zeros((0, 3), np.float32)
    hits, empty = ((r > 0.0) & (r < np.inf)).nonzero()[0], (r == np.inf).nonzero()[0]
    reach = np.full(len(empty), float(reach_m))
    with np.errstate(over="ignore"):
        points = _ends(cosine[hits], sine[hits], r[hits])
        return points, _ends(cosine[empty], sine[empty], reach)


def _ends(cosine: Floats, sine: Floats, ranges: Floats) -> NDArray[np.float32]:
    ends = np.zeros((ranges.size, 3), dtype=np.float32)
    ends[:, 0] = ranges * cosine
    ends[:, 1] = ranges * sine
    return ends


def count_ignored(ranges: ArrayLike) -> dict[str, int]:
    """How many beams `project_fan` leaves out, by reason; reasons with none are absent."""
    r = np.asarray(ranges, dtype=np.float64)
    counts = {"nan": int(np.isnan(r).sum()), "not_positive": int((r <= 0.0).sum())}
    return {reason: count for reason, count in counts.items() if count}
