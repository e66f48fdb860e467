"""Who sent a message, and whether it is an input."""

from __future__ import annotations

from dataclasses import replace

import pytest

from facet.sources.naming import (
    is_input,
    is_scan,
    is_static,
    names_of,
    pose_frame,
    robot_and_sensor,
    source_of,
)
from facet_protocol.messages import Envelope, Rule


@pytest.mark.parametrize(
    ("key", "names"),
    [
        ("facet/v1/map/robot/r1/scan/front", ("r1", "front")),
        ("facet/v1/map/robot/r1/pose/base_link", ("r1", "base_link")),
        ("facet/v1/map/robot/r1/tf_static", ("r1", "tf_static")),
        ("/velodyne/points 2", ("robot", "velodyne_points_2")),
        ("/7/velodyne/points", ("domain-7", "7_velodyne_points")),
        ("/\u06f81/scan", ("robot", "1_scan")),  # a digit, but none of an id
        ("../..", ("robot", "scan")),
    ],
)
def test_names_of_a_key(key: str, names: tuple[str, str]) -> None:
    assert robot_and_sensor(key) == names


def test_a_rule_names_the_robot() -> None:
    envelope = Envelope("/r7/points", "", "cdr", b"", rule=Rule("r7/**", robot="seven"))
    assert names_of(envelope) == ("seven", "r7_points")
    assert source_of(envelope) == "seven/r7_points"
    named = replace(envelope, rule=Rule("r7/**", sensor="lidar"))
    assert names_of(named) == ("robot", "lidar")


def test_a_pose_is_no_input_unless_something_says_of_what() -> None:
    """On /goal_pose it is where the robot should go."""
    pose = Envelope("/goal_pose", "geometry_msgs/msg/PoseStamped", "cdr", b"")
    assert not is_input(pose)
    assert pose_frame(pose) == ""
    ruled = replace(pose, rule=Rule("goal_pose", frame="base_link"))
    assert is_input(ruled)
    assert pose_frame(ruled) == "base_link"
    native = Envelope("facet/v1/m/robot/r/pose/lidar", "foxglove.PoseInFrame", "protobuf", b"")
    assert is_input(native)
    assert pose_frame(native) == "lidar"
    assert pose_frame(replace(native, key="facet/v1/m/robot/r/tf")) == ""


def test_what_facet_derived_is_no_input() -> None:
    cloud = Envelope("/facet/points", "foxglove.PointCloud", "protobuf", b"")
    tf = Envelope("/tf", "foxglove.FrameTransforms", "protobuf", b"")
    assert not is_scan(cloud)
    assert not is_input(cloud)
    assert is_input(tf)
    assert not is_input(replace(tf, is_derived=True))
    assert is_input(replace(tf, schema="tf2_msgs/msg/TFMessage", encoding="cdr"))
    assert not is_input(replace(tf, schema="sensor_msgs/msg/Image"))


def test_static_transforms_are_known_by_their_topic() -> None:
    keys = ["/tf_static", "/r1/tf_static", "/tf", "tf_static", "/tf_statics"]
    found = [is_static(Envelope(key, "", "cdr", b"")) for key in keys]
    assert found == [True, True, False, True, False]
