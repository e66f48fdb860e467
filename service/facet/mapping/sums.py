"""The sums of a voxel: exact integers of 64 bits, stored in as few bytes as they need.

A sum is low + 2^31 middle + 2^38 high. Low has 4 bytes, middle 1, and both are always there; high
has 4 that are touched first when a voxel holds a quarter of a million points, so that before its
pages take no memory."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from facet.mapping.kernel import kernel
from facet.mapping.settings import TICKS

# 0..9: n, sum x, y, z, sum xx, xy, xz, yy, yz, zz of the local ticks 0..1023
# 10..12: sum of the quantised unit vectors towards the sensor
MOMENTS = 10
SUMS = 13
LOW, MIDDLE = 31, 7  # bits
HALF = 1 << (LOW - 1)  # low is kept in [-HALF, HALF)
TOUCHED, DEEP = np.uint8(1), np.uint8(2)  # flags of a voxel: changed since settled; high is in use


@kernel(allocates=False)
def add_point(low, sign, x, y, z, view):  # type: ignore[no-untyped-def]
    """Add a point to the low parts (SUMS,) of a voxel. Whether they must be carried now."""
    n = low[0] + sign
    mx, my, mz = low[1] + sign * x, low[2] + sign * y, low[3] + sign * z
    xx, xy, xz = low[4] + sign * x * x, low[5] + sign * x * y, low[6] + sign * x * z
    yy, yz, zz = low[7] + sign * y * y, low[8] + sign * y * z, low[9] + sign * z * z
    vx, vy, vz = low[10] + sign * view[0], low[11] + sign * view[1], low[12] + sign * view[2]
    low[0], low[1], low[2], low[3] = n, mx, my, mz
    low[4], low[5], low[6], low[7], low[8], low[9] = xx, xy, xz, yy, yz, zz
    low[10], low[11], low[12] = vx, vy, vz
    bits = (n + HALF) | (mx + HALF) | (my + HALF) | (mz + HALF)
    bits |= (xx + HALF) | (xy + HALF) | (xz + HALF) | (yy + HALF) | (yz + HALF) | (zz + HALF)
    bits |= (vx + HALF) | (vy + HALF) | (vz + HALF)
    return bits >> LOW != 0


@kernel(allocates=False)
def carry(low, middle, high, flags, row):  # type: ignore[no-untyped-def]
    """Bring the low parts of a voxel back into their range."""
    for s in range(low.shape[1]):
        over = (np.int64(low[row, s]) + HALF) >> LOW
        low[row, s] -= over << LOW
        over += middle[row, s]
        beyond = (over + (1 << (MIDDLE - 1))) >> MIDDLE
        middle[row, s] = over - (beyond << MIDDLE)
        if beyond != 0:
            high[row, s] += beyond
            flags[row] |= DEEP


@kernel(allocates=False, inlined=True)
def read_sums(columns, row, out):  # type: ignore[no-untyped-def]
    """The sums of a voxel (SUMS,)."""
    for s in range(SUMS):
        out[s] = np.int64(columns.low[row, s]) + (np.int64(columns.middle[row, s]) << LOW)
    if columns.flags[row] & DEEP:
        for s in range(SUMS):
            out[s] += np.int64(columns.high[row, s]) << (LOW + MIDDLE)


@kernel(allocates=False)
def write_sums(columns, row, sums):  # type: ignore[no-untyped-def]
    """Make these (SUMS,) the sums of a voxel that has none."""
    for s in range(SUMS):
        over = (sums[s] + HALF) >> LOW
        columns.low[row, s] = sums[s] - (over << LOW)
        beyond = (over + (1 << (MIDDLE - 1))) >> MIDDLE
        columns.middle[row, s] = over - (beyond << MIDDLE)
        if beyond != 0:
            columns.high[row, s] = beyond
            columns.flags[row] |= DEEP


@kernel(allocates=False, inlined=True)
def count_points(columns, row):  # type: ignore[no-untyped-def]
    """How many points a voxel holds."""
    n = np.int64(columns.low[row, 0]) + (np.int64(columns.middle[row, 0]) << LOW)
    if columns.flags[row] & DEEP:
        n += np.int64(columns.high[row, 0]) << (LOW + MIDDLE)
    return n


def sums_of(columns: Any, rows: NDArray[Any]) -> NDArray[np.int64]:
    """(R, SUMS) sums of rows (R,)."""
    out = columns.low[rows].astype(np.int64)
    out += columns.middle[rows].astype(np.int64) << LOW
    deep = np.flatnonzero(columns.flags[rows] & DEEP)
    out[deep] += columns.high[rows[deep]].astype(np.int64) << (LOW + MIDDLE)
    return np.asarray(out)


@kernel(allocates=False, inlined=True)
def shift_moments(own, x, y, z, total):  # type: ignore[no-untyped-def]
    """Add moments (10,) to `total`, about a corner that lies x, y, z voxels before their own."""
    n, dx, dy, dz = own[0], TICKS * x, TICKS * y, TICKS * z
    total[0] += n
    total[1] += own[1] + n * dx
    total[2] += own[2] + n * dy
    total[3] += own[3] + n * dz
    total[4] += own[4] + 2 * dx * own[1] + n * dx * dx
    total[5] += own[5] + dx * own[2] + dy * own[1] + n * dx * dy
    total[6] += own[6] + dx * own[3] + dz * own[1] + n * dx * dz
    total[7] += own[7] + 2 * dy * own[2] + n * dy * dy
    total[8] += own[8] + dy * own[3] + dz * own[2] + n * dy * dz
    total[9] += own[9] + 2 * dz * own[3] + n * dz * dz
