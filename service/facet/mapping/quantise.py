"""Where floats end: world points become integer ticks, once, by + - * / sqrt in a fixed order."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from facet.mapping.blocks import OFFSET, hash_key
from facet.mapping.kernel import kernel
from facet.mapping.runs import starts_of
from facet.mapping.settings import MapSettings
from facet_protocol.messages import Scan, ScanKind

VIEW = 127  # length of a quantised unit vector
BOUND = OFFSET - 64  # voxels; a map's half width is the smaller of this and 50 km
LARGEST = (1 << 63) - 1
REASONS = ("stored", "nan", "inf", "too_near", "too_far", "out_of_bounds")


class Ticks(NamedTuple):
    """The returns and empty beams of scans (S of them) in integers, one scan after another."""

    points: NDArray[np.int64]  # (N, 3) ticks, world
    views: NDArray[np.int16]  # (N, 3) unit vector towards the sensor, times 127
    starts: NDArray[np.int64]  # (S + 1,) where the points of each scan begin
    beams: NDArray[np.int64]  # (M, 3) ticks, world: where the range of an empty beam ends
    beam_starts: NDArray[np.int64]  # (S + 1,) likewise
    sensors: NDArray[np.int64]  # (S, 3) ticks, world
    pose_hashes: NDArray[np.int64]  # (S,) 16 bits of the quantised pose; -1 for a scan that counts
    # as many poses
    rejected: tuple[dict[str, int], ...]  # of each scan


@kernel(allocates=False)
def rotate(turn, R):  # type: ignore[no-untyped-def]
    """R_world_sensor (3, 3) from a unit quaternion xyzw, by + - * only."""
    x, y, z, w = turn[0], turn[1], turn[2], turn[3]
    R[0, 0], R[0, 1], R[0, 2] = 1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)
    R[1, 0], R[1, 1], R[1, 2] = 2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)
    R[2, 0], R[2, 1], R[2, 2] = 2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)


@kernel(allocates=False)
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


@kernel(allocates=False)
def _all_to_ticks(  # type: ignore[no-untyped-def]
    points, starts, positions, turns, tick_m, near, far, bound_m, R, ticks, views, counts, kept
):  # fmt: skip
    """`_to_ticks` of scans (S,), whose points begin at starts (S + 1,). Where the accepted ones of
    each begin: kept (S + 1,); counts (S, REASONS). R (3, 3): room."""
    kept[0] = 0
    for s in range(positions.shape[0]):
        own, at, first = points[starts[s] : starts[s + 1]], positions[s], kept[s]
        kept[s + 1] = first
        if abs(at[0]) > bound_m or abs(at[1]) > bound_m or abs(at[2]) > bound_m:
            counts[s, 5] += own.shape[0]
            continue
        rotate(turns[s], R)
        kept[s + 1] += _to_ticks(
            own, R, at, tick_m, near, far, bound_m, ticks[first:], views[first:], counts[s]
        )


@kernel(allocates=False)
def _hash_poses(sensors, turns, hashes):  # type: ignore[no-untyped-def]
    """16 bits of each pose (S,), of its sensor in ticks and its quaternion, rounded."""
    for s in range(hashes.shape[0]):
        mixed = np.int64(0)
        for a in range(3):
            mixed = hash_key((mixed * 31 + sensors[s, a]) & LARGEST)
        for a in range(4):
            turn = np.int64(np.floor(turns[s, a] * 65536.0 + 0.5))
            mixed = hash_key((mixed * 31 + turn) & LARGEST)
        hashes[s] = mixed & 0xFFFF


def quantise(scans: Sequence[Scan], settings: MapSettings) -> Ticks:
    """The points and empty beams of scans in integer ticks; what cannot be mapped is counted."""
    tick_m = settings.tick_m
    bound_m = min(50_000.0, BOUND * settings.voxel_m)
    positions = np.array([scan.pose.position for scan in scans], np.float64)
    turns = np.array([scan.pose.orientation_xyzw for scan in scans], np.float64)
    sensors = np.floor(positions / tick_m).astype(np.int64)

    def convert(clouds: list[NDArray[np.float32]]) -> _Converted:
        starts = starts_of([len(rows) for rows in clouds])
        ticks, views = np.empty((starts[-1], 3), np.int64), np.empty((starts[-1], 3), np.int16)
        counts, kept = np.zeros((len(scans), len(REASONS)), np.int64), np.empty_like(starts)
        _all_to_ticks(
            _one_array(clouds), starts, positions, turns, tick_m, settings.min_range_m,
            settings.max_range_m, bound_m, np.empty((3, 3)), ticks, views, counts, kept,
        )  # fmt: skip
        return _Converted(ticks[: kept[-1]], views[: kept[-1]], kept, counts)

    found = convert([scan.points for scan in scans])
    beams = convert([scan.no_return for scan in scans])
    hashes = np.empty(len(scans), np.int64)
    _hash_poses(sensors, turns, hashes)
    hashes[[scan.kind is not ScanKind.LINE for scan in scans]] = -1
    rejected = tuple(
        {name: n for name, n in zip(REASONS[1:], own[1:], strict=True) if n}
        for own in found.counts.tolist()
    )
    return Ticks(
        found.ticks, found.views, found.starts, beams.ticks, beams.starts, sensors, hashes, rejected
    )


class _Converted(NamedTuple):
    ticks: NDArray[np.int64]
    views: NDArray[np.int16]
    starts: NDArray[np.int64]
    counts: NDArray[np.int64]


def _one_array(clouds: list[NDArray[np.float32]]) -> NDArray[np.float32]:
    """Clouds one after another; a single one, that may be a strided view as decoded, is not copied
    where it need not be."""
    if len(clouds) == 1:
        return np.ascontiguousarray(clouds[0], np.float32)
    return np.concatenate([_NO_POINTS, *clouds], dtype=np.float32)


_NO_POINTS = np.zeros((0, 3), np.float32)
