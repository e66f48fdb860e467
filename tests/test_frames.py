"""Chains of transforms at a stamp: interpolated like scipy does, never extrapolated."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation, Slerp

from facet.frames import (
    MAX_EDGES,
    MAX_SAMPLES,
    Answer,
    Frames,
    Rank,
    Rigid,
    compose,
    inverse,
    pose_of,
    rigid_of,
    slerp,
)
from facet_protocol.messages import Pose, StampedTransform

MS = 1_000_000
GAP_NS = 500 * MS
seeds = st.integers(0, 2**32 - 1)


def random_pose(rng: np.random.Generator) -> Pose:
    return Pose(rng.uniform(-50.0, 50.0, 3), Rotation.random(rng=rng).as_quat())


def transform(stamp_ns: int, parent: str, child: str, pose: Pose) -> StampedTransform:
    return StampedTransform(stamp_ns, parent, child, pose)


def moved(x: float) -> Pose:
    return Pose(np.array([x, 0.0, 0.0]), np.array([0.0, 0.0, 0.0, 1.0]))


def matrix(rigid: Rigid) -> np.ndarray:
    result = np.eye(4)
    result[:3, :3] = Rotation.from_quat(rigid.rotation).as_matrix()
    result[:3, 3] = rigid.position
    return result


@given(seeds, st.floats(0.0, 1.0))
def test_slerp_is_scipys(seed: int, t: float) -> None:
    a, b = Rotation.random(2, rng=np.random.default_rng(seed)).as_quat()
    expected = Slerp([0.0, 1.0], Rotation.from_quat([a, b]))(t)
    mine = Rotation.from_quat(slerp(tuple(a), tuple(b), t))
    assert (mine.inv() * expected).magnitude() < 2e-8
    assert abs(np.linalg.norm(slerp(tuple(a), tuple(b), t)) - 1.0) < 1e-15


@given(seeds, st.floats(1e-9, 0.3), st.floats(0.0, 1.0))
def test_slerp_turns_at_a_constant_rate(seed: int, angle: float, t: float) -> None:
    """To 1e-14 rad, where the arc cosine that others use has lost half of its digits."""
    axis = np.random.default_rng(seed).normal(size=3)
    half = 0.5 * angle * axis / np.linalg.norm(axis)
    sine = np.sin(0.5 * angle) / (0.5 * angle)
    end = (*(half * sine), np.cos(0.5 * angle))
    part = slerp((0.0, 0.0, 0.0, 1.0), tuple(map(float, end)), t)
    turned = 2.0 * np.arctan2(np.linalg.norm(part[:3]), part[3])
    assert turned == pytest.approx(t * angle, abs=1e-14)


def test_slerp_ends_where_it_should_to_the_bit() -> None:
    a, b = (tuple(map(float, q)) for q in Rotation.random(2, rng=1).as_quat())
    assert slerp(a, b, 0.0) == a
    assert slerp(a, a, 0.3) == a
    ended = slerp(a, b, 1.0)
    assert ended in (b, tuple(-c for c in b))


@given(seeds)
def test_composition_is_that_of_matrices(seed: int) -> None:
    rng = np.random.default_rng(seed)
    a, b = rigid_of(random_pose(rng)), rigid_of(random_pose(rng))
    np.testing.assert_allclose(matrix(compose(a, b)), matrix(a) @ matrix(b), atol=1e-12)
    np.testing.assert_allclose(matrix(inverse(a)), np.linalg.inv(matrix(a)), atol=1e-12)


def test_the_identity_changes_no_bit() -> None:
    pose = random_pose(np.random.default_rng(3))
    nothing = rigid_of(moved(0.0))
    for rigid in (compose(rigid_of(pose), nothing), compose(nothing, rigid_of(pose))):
        same = pose_of(rigid)
        assert same.position.tobytes() == pose.position.tobytes()
        assert same.orientation_xyzw.tobytes() == pose.orientation_xyzw.tobytes()


def drive() -> Frames:
    """map <- odom <- base <- lidar; odom moves at 1 m/s between 1.0 s and 1.4 s."""
    frames = Frames(GAP_NS)
    frames.add(transform(0, "base", "lidar", moved(0.25)), Rank.STATIC, "/tf_static")
    frames.add(transform(0, "base", "camera", moved(0.5)), Rank.STATIC, "/other/tf_static")
    for k in range(5):
        stamp = 1000 * MS + k * 100 * MS
        frames.add(transform(stamp, "odom", "base", moved(0.1 * k)), Rank.TRANSFORM, "/tf")
        frames.add(transform(stamp, "map", "odom", moved(10.0)), Rank.TRANSFORM, "/tf")
    return frames


@pytest.mark.parametrize(("frame", "ahead"), [("lidar", 0.25), ("camera", 0.5), ("base", 0.0)])
def test_a_chain_is_followed_at_the_stamp(frame: str, ahead: float) -> None:
    found = drive().at("map", frame, 1234 * MS)
    assert isinstance(found, Rigid)
    assert found.position[0] == pytest.approx(10.234 + ahead, abs=1e-12)


def test_a_chain_is_followed_backwards_too() -> None:
    found = drive().at("lidar", "camera", 0)
    assert isinstance(found, Rigid)
    assert found.position == (0.25, 0.0, 0.0)


def test_nothing_is_extrapolated() -> None:
    frames = drive()
    assert frames.at("map", "lidar", 1400 * MS + 1) is Answer.WAIT
    assert frames.at("map", "lidar", 1000 * MS - 1) is Answer.TOO_OLD
    assert frames.at("map", "arm", 1200 * MS) is Answer.UNKNOWN
    assert isinstance(frames.at("map", "lidar", 1400 * MS), Rigid)
    frames.add(transform(1901 * MS, "odom", "base", moved(9.0)), Rank.TRANSFORM, "/tf")
    frames.add(transform(1900 * MS, "map", "odom", moved(10.0)), Rank.TRANSFORM, "/tf")
    assert frames.at("map", "lidar", 1600 * MS) is Answer.GAP


def test_of_two_topics_for_one_edge_one_counts() -> None:
    """Wheel odometry beside a filter's: mixed, they would make the robot shake."""
    frames = Frames(GAP_NS)
    assert frames.add(transform(0, "odom", "base", moved(1.0)), Rank.ODOMETRY, "/wheels") == ""
    told = transform(1, "odom", "base", moved(7.0))
    assert frames.add(told, Rank.ODOMETRY, "/filter") == "told_elsewhere"
    assert frames.add(transform(2, "odom", "base", moved(2.0)), Rank.TRANSFORM, "/tf") == ""
    assert frames.add(told, Rank.ODOMETRY, "/wheels") == "told_elsewhere"
    assert frames.at("odom", "base", 0) is Answer.TOO_OLD
    assert frames.at("odom", "base", 2) == rigid_of(moved(2.0))


def test_of_two_for_one_stamp_the_first_counts() -> None:
    frames = drive()
    again = transform(1200 * MS, "odom", "base", moved(5.0))
    assert frames.add(again, Rank.TRANSFORM, "/tf") == "same_stamp"
    found = frames.at("odom", "base", 1200 * MS)
    assert isinstance(found, Rigid)
    assert found.position[0] == pytest.approx(0.2)


def test_a_static_transform_is_replaced() -> None:
    frames = drive()
    frames.add(transform(5, "base", "lidar", moved(0.75)), Rank.STATIC, "/tf_static")
    assert frames.at("base", "lidar", 0) == rigid_of(moved(0.75))


def test_what_comes_out_of_order_is_sorted_in() -> None:
    frames = Frames(GAP_NS)
    for stamp in (300, 100, 200):
        pose = moved(stamp * 0.01)
        frames.add(transform(stamp * MS, "map", "base", pose), Rank.TRANSFORM, "/tf")
    found = frames.at("map", "base", 150 * MS)
    assert isinstance(found, Rigid)
    assert found.position[0] == pytest.approx(1.5)


def test_memory_is_bounded_and_a_wild_stamp_does_not_stay() -> None:
    frames = Frames(GAP_NS)
    frames.add(transform(2**62, "map", "base", moved(0.0)), Rank.TRANSFORM, "/tf")
    for k in range(MAX_SAMPLES):
        frames.add(transform(k * MS, "map", "base", moved(0.0)), Rank.TRANSFORM, "/tf")
    assert isinstance(frames.at("map", "base", 5 * MS), Rigid)
    assert frames.at("map", "base", 2**62) is Answer.WAIT
    for k in range(1, MAX_EDGES):
        assert not frames.add(transform(0, "base", f"f{k}", moved(0.0)), Rank.STATIC, "/s")
    assert frames.add(transform(0, "x", "y", moved(0.0)), Rank.STATIC, "/s") == "too_many_frames"
