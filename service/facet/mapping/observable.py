"""What of a voxel the later stages see: its sums, rounded into one word."""

from __future__ import annotations

import numpy as np

from facet.mapping.kernel import kernel
from facet.mapping.quantise import VIEW
from facet.mapping.settings import TICKS

SETTLED = 64  # from so many points on a centroid is rounded to 1/4 voxel: it moves half as often


@kernel(allocates=False)
def _coarse(component):  # type: ignore[no-untyped-def]
    """A component of a direction, in eighths: 1, 4 or 7 with its sign. The sign is what tells the
    side of a surface; the rest mostly drifts with the sensor."""
    size = abs(component)
    eighths = np.int64(1)
    if size >= 0.6875:
        eighths = np.int64(7)
    elif size >= 0.3125:
        eighths = np.int64(4)
    return eighths if component >= 0.0 else -eighths


@kernel(allocates=False)
def observe(moments, views, poses):  # type: ignore[no-untyped-def]
    """A voxel's observable, 49 bits: centroid in eighths (4, 4, 4), from SETTLED points on in
    quarters; votes min(n, 8) (4); direction towards the sensor, `_coarse` (5, 5, 5); mixed (1);
    pose hash + 1 of its only pose (17). What only drifts as points come in is rounded coarsely:
    each change makes some sixty neighbours stale."""
    n = moments[0]
    if n == 0:
        return np.int64(0)
    word = np.int64(0)
    coarse = 2 if n >= SETTLED else 1
    for axis in range(3):  # round half up, to 1/8 voxel, or to 1/4
        eighths = (moments[1 + axis] * 16 + n * TICKS * coarse) // (2 * n * TICKS * coarse)
        word |= (eighths * coarse) << (4 * axis)
    word |= min(n, 8) << 12
    vx, vy, vz = float(views[0]), float(views[1]), float(views[2])
    length = np.sqrt((vx * vx + vy * vy) + vz * vz)
    if length > 0.0:
        word |= (_coarse(vx / length) + 8) << 16
        word |= (_coarse(vy / length) + 8) << 21
        word |= (_coarse(vz / length) + 8) << 26
    else:
        word |= (8 << 16) | (8 << 21) | (8 << 26)
    if length < 0.5 * VIEW * n:  # seen from both sides
        word |= np.int64(1) << 31
    if poses[0] == n and n * poses[2] == poses[1] * poses[1]:
        word |= (poses[1] // n + 1) << 32
    return word
