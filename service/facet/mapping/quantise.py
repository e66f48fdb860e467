"""Where floats end: world points become integer ticks, once, by + - * / sqrt in a fixed order."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from facet.mapping.blocks import OFFSET, hash_key
from facet.mapping.kernel import kernel
from facet.mapping.settings import MapSettings
from facet_protocol.messages import Pose, Scan, ScanKind

VIEW = 127  # length of a quantised unit vector
BOUND = OFFSET - 64  # voxels; a map's half width is the smaller of this and 50 km
REASONS = ("stored", "nan", "inf", "too_near", "too_far", "out_of_bounds")


class Ticks(NamedTuple):
    """A scan's returns and empty beams in integers."""

    points: NDArray[np.int64]  # (N, 3) ticks, world
    views: NDArray[np.int16]  # (N, 3) unit vector towards the sensor, times 127
    beams: NDArray[np.int64]  # (M, 3) ticks, world: where the range of an empty beam ends
    sensor: NDArray[np.int64]  # (3,) ticks, world
    pose_hash: int  # 16 bits of the quantised pose; -1 for a scan that counts as many poses
    rejected: dict[str, int]


def rotation(pose: Pose) -> NDArray[np.float64]:
    """R_world_sensor (3, 3) from a unit quaternion xyzw, by + - * only."""
    x, y, z, w = (float(c) for c in pose.orientation_xyzw)
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
            [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
            [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
        ]
    )


@kernel
def _to_ticks(points, R, t, tick_m, near, far, bound_m, ticks, views, counts):  # type: ignore[no-untyped-def]
    """Fill ticks and views with the accepted points; counts by REASONS. Returns how many."""
    m = 0
    for i in range(points.shape[0]):
        x = np.float64(points[i, 0])
        y = np.float64(points[i, 1])
        z = np.float64(points[i, 2])
        if np.isnan(x) or np.isnan(y) or np.isnan(z):
            counts[1] += 1
            continue
        if np.isinf(x) or np.isinf(y) or np.isinf(z):
            counts[2] += 1
            continue
        wx = ((R[0, 0] * x + R[0, 1] * y) + R[0, 2] * z) + t[0]
        wy = ((R[1, 0] * x + R[1, 1] * y) + R[1, 2] * z) + t[1]
        wz = ((R[2, 0] * x + R[2, 1] * y) + R[2, 2] * z) + t[2]
        dx = t[0] - wx
        dy = t[1] - wy
        dz = t[2] - wz
        distance = np.sqrt((dx * dx + dy * dy) + dz * dz)
        if distance < near:
            counts[3] += 1
            continue
        if distance > far:
            counts[4] += 1
            continue
        if abs(wx) > bound_m or abs(wy) > bound_m or abs(wz) > bound_m:
            counts[5] += 1
            continue
        ticks[m, 0] = np.int64(np.floor(wx / tick_m))
        ticks[m, 1] = np.int64(np.floor(wy / tick_m))
        ticks[m, 2] = np.int64(np.floor(wz / tick_m))
        views[m, 0] = np.int16(np.floor(dx / distance * VIEW + 0.5))
        views[m, 1] = np.int16(np.floor(dy / distance * VIEW + 0.5))
        views[m, 2] = np.int16(np.floor(dz / distance * VIEW + 0.5))
        m += 1
    counts[0] += m
    return m


def quantise(scan: Scan, settings: MapSettings) -> Ticks:
    """A scan's points and empty beams in integer ticks; what cannot be mapped is counted."""
    tick_m = settings.tick_m
    bound_m = min(50_000.0, BOUND * settings.voxel_m)
    R = rotation(scan.pose)
    t = np.ascontiguousarray(scan.pose.position, dtype=np.float64)
    sensor = np.floor(t / tick_m).astype(np.int64)
    counts = np.zeros(len(REASONS), np.int64)
    if np.any(np.abs(t) > bound_m):
        none = np.empty((0, 3), np.int64)
        rejected = {"out_of_bounds": len(scan.points)} if len(scan.points) else {}
        return Ticks(none, np.empty((0, 3), np.int16), none, sensor, -1, rejected)

    def convert(
        rows: NDArray[np.float32], far: float, counts: NDArray[np.int64]
    ) -> tuple[NDArray[np.int64], NDArray[np.int16]]:
        ticks = np.empty((len(rows), 3), np.int64)
        views = np.empty((len(rows), 3), np.int16)
        rows = np.ascontiguousarray(rows, np.float32)  # as decoded it may be a strided view
        m = _to_ticks(rows, R, t, tick_m, settings.min_range_m, far, bound_m, ticks, views, counts)
        return ticks[:m], views[:m]

    points, views = convert(scan.points, settings.max_range_m, counts)
    beams, _ = convert(scan.no_return, settings.max_range_m, np.zeros_like(counts))
    rejected = {name: int(n) for name, n in zip(REASONS[1:], counts[1:], strict=True) if n}
    return Ticks(points, views, beams, sensor, _pose_hash(scan, sensor), rejected)


def _pose_hash(scan: Scan, sensor: NDArray[np.int64]) -> int:
    if scan.kind is not ScanKind.LINE:
        return -1
    turn = np.floor(scan.pose.orientation_xyzw * 65536.0 + 0.5).astype(np.int64)
    mixed = 0
    for part in (*sensor, *turn):
        mixed = int(hash_key((mixed * 31 + int(part)) & 0x7FFFFFFFFFFFFFFF))
    return mixed & 0xFFFF
