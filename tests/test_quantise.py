"""World points become ticks once: floor, never towards zero; every point stored or counted."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from facet.mapping.quantise import BOUND, VIEW, quantise, rotate
from facet.mapping.settings import MapSettings
from facet_protocol.messages import Pose, Scan, ScanKind
from mapping_logs import cloud, log

SETTINGS = MapSettings(voxel_m=0.0625, min_range_m=0.5, max_range_m=100.0)
TICK = SETTINGS.tick_m  # 2^-14 m: exact
numbers = st.floats(width=32, allow_nan=True, allow_infinity=True)


def scan_of(points: object, at: tuple[float, float, float] = (0.0, 0.0, 0.0)) -> Scan:
    """A scan of sensor points (N, 3)."""
    rows = np.asarray(points, np.float32).reshape(-1, 3)
    return replace(cloud(np.zeros((0, 3)), at=at), points=rows)


def test_ticks_are_floors_also_below_zero() -> None:
    ticks = [[-1.5, 10_000.0, 10_000.0], [-0.25, 9_999.75, 20_000.0], [1.5, -20_000.5, 10_000.0]]
    found = quantise([scan_of(np.array(ticks) * TICK)], SETTINGS).points
    np.testing.assert_array_equal(found, np.floor(ticks).astype(int))
    assert found[0, 0] == -2
    assert found[0, 0] >> 10 == -1
    assert found[0, 0] & 1023 == 1022


@settings(deadline=None)
@given(hnp.arrays(np.float32, (7, 3), elements=st.floats(-70, 70, width=32)))
def test_ticks_agree_with_exact_floors(points: np.ndarray) -> None:
    """The pose is the identity and ticks are powers of two: nothing is rounded before."""
    ticks = quantise([scan_of(points)], SETTINGS)
    far = np.linalg.norm(points.astype(np.float64), axis=1)
    kept = points[(far >= 0.5) & (far <= 100.0)].astype(np.float64)
    np.testing.assert_array_equal(ticks.points, np.floor(kept / TICK).astype(np.int64))


@settings(deadline=None)
@given(hnp.arrays(np.float32, st.tuples(st.integers(0, 30), st.just(3)), elements=numbers))
def test_every_point_is_stored_or_rejected_for_one_reason(points: np.ndarray) -> None:
    ticks = quantise([scan_of(points)], SETTINGS)
    assert len(ticks.points) + sum(ticks.rejected[0].values()) == len(points)
    assert len(ticks.views) == len(ticks.points)
    assert all(n > 0 for n in ticks.rejected[0].values())


def test_the_reasons() -> None:
    nan, inf = np.nan, np.inf
    rows = [
        *([nan, 0, 1], [inf, nan, 1]), *([inf, 0, 1], [0, -inf, 1], [inf, inf, inf]),
        *([0.1, 0, 0], [0, 0, 0.49]), *([0, 0, 100.5],), *([1, 1, 1], [0, 0, 0.5], [0, 100, 0]),
    ]  # fmt: skip
    told = quantise([scan_of(rows)], SETTINGS)
    assert told.rejected[0] == {"nan": 2, "inf": 3, "too_near": 2, "too_far": 1}
    assert len(told.points) == 3


def test_the_border_of_the_map() -> None:
    small = MapSettings(voxel_m=0.005)
    bound = BOUND * small.voxel_m
    at = (bound - 1.0, 0.0, 0.0)
    told = quantise([scan_of([[0.9, 0, 0], [1.1, 0, 0], [-2.0, 0, 0]], at)], small)
    assert told.rejected[0] == {"out_of_bounds": 1}
    outside = quantise([scan_of([[0.9, 0, 0], [np.nan, 0, 0]], (0.0, bound + 1.0, 0.0))], small)
    assert outside.rejected[0] == {"out_of_bounds": 2}
    assert len(outside.points) == len(outside.beams) == 0


def test_views_point_back_to_the_sensor() -> None:
    rng = np.random.default_rng(0)
    at = np.array([3.0, -2.0, 1.0])
    points = rng.normal(size=(500, 3)) * 10.0
    told = quantise([cloud(points, at=tuple(at))], SETTINGS)
    back = at - (told.points + 0.5) * TICK
    exact = back / np.linalg.norm(back, axis=1, keepdims=True)
    assert np.abs(told.views / VIEW - exact).max() <= 0.5 / VIEW + 1e-3


def test_empty_beams_are_beams_and_never_points() -> None:
    ends = np.array([[8.0, 0.0, 1.0], [0.0, np.nan, 1.0], [0.0, 8.0, 1.0]])
    told = quantise([cloud(np.zeros((0, 3)), no_return=ends)], SETTINGS)
    assert len(told.points) == 0
    assert told.rejected[0] == {}
    np.testing.assert_array_equal(told.beams, np.floor(ends[[0, 2]] / TICK).astype(int))


def test_the_same_scan_gives_the_same_integers() -> None:
    for scan in log("room-lidar3d").scans[:2]:
        strided = np.repeat(scan.points, 2, axis=0)[::2]
        one, two = quantise([scan], SETTINGS), quantise([replace(scan, points=strided)], SETTINGS)
        for a, b in zip(one[:-1], two[:-1], strict=True):
            np.testing.assert_array_equal(a, b)
        assert one.pose_hashes == two.pose_hashes == -1


def test_several_scans_at_once_are_the_same_as_each_alone() -> None:
    """Those without points, too, and those out of bounds."""
    at = (BOUND * SETTINGS.voxel_m + 1.0, 0.0, 0.0)
    out_of_bounds, nothing = scan_of([[1, 2, 3], [np.nan, 0, 0]], at), scan_of(np.zeros((0, 3)))
    nan = scan_of([[np.nan, 0, 0], [3, 0, 0], [0.1, 0, 0]])
    lines = log("room-pushbroom").scans[:3]
    scans = [*lines, nothing, out_of_bounds, nan, *log("room-lidar3d").scans[:2], out_of_bounds]
    whole, each = quantise(scans, SETTINGS), [quantise([scan], SETTINGS) for scan in scans]
    for name in ("points", "views", "beams", "sensors", "pose_hashes"):
        own = np.concatenate([getattr(one, name) for one in each])
        np.testing.assert_array_equal(getattr(whole, name), own)
    assert np.diff(whole.starts).tolist() == [len(one.points) for one in each]
    assert np.diff(whole.beam_starts).tolist() == [len(one.beams) for one in each]
    assert whole.rejected == tuple(one.rejected[0] for one in each)


def test_points_alone_decide_their_ticks() -> None:
    """Not their neighbours in the scan, nor their order."""
    scan = log("room-lidar3d").scans[0]
    order = np.random.default_rng(0).permutation(len(scan.points))
    one = quantise([scan], SETTINGS)
    two = quantise([replace(scan, points=scan.points[order])], SETTINGS)
    rows = np.concatenate([one.points, one.views], axis=1)
    again = np.concatenate([two.points, two.views], axis=1)
    np.testing.assert_array_equal(rows[np.lexsort(rows.T)], again[np.lexsort(again.T)])


def test_line_scans_carry_a_hash_of_their_pose() -> None:
    line = replace(cloud(np.ones((3, 3))), kind=ScanKind.LINE)
    here = quantise([line], SETTINGS).pose_hashes[0]
    assert 0 <= here < 1 << 16
    assert quantise([replace(line, sequence=9, stamp_ns=77)], SETTINGS).pose_hashes[0] == here
    hashes = {here}
    for step in range(1, 40):
        pose = replace(line.pose, position=line.pose.position + 0.01 * step)
        hashes.add(quantise([replace(line, pose=pose)], SETTINGS).pose_hashes[0])
    assert len(hashes) >= 39
    turned = replace(line.pose, orientation_xyzw=np.array([0.0, 0.0, 0.1, np.sqrt(0.99)]))
    assert quantise([replace(line, pose=turned)], SETTINGS).pose_hashes[0] not in hashes


@settings(deadline=None)
@given(st.lists(st.floats(-1, 1), min_size=4, max_size=4).filter(lambda q: np.linalg.norm(q) > 0.1))
def test_a_rotation_is_orthonormal(q: list[float]) -> None:
    xyzw = np.array(q) / np.linalg.norm(q)
    R = np.empty((3, 3))
    rotate(xyzw, R)
    np.testing.assert_allclose(R @ R.T, np.eye(3), atol=1e-12)
    assert np.linalg.det(R) == pytest.approx(1.0)
    np.testing.assert_allclose(R, Pose(np.zeros(3), xyzw).rotation(), atol=0)
