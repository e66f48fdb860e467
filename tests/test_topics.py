"""Key expressions and ids."""

import pytest

from facet_protocol import ProtocolError, topics


def test_keys_of_the_wire() -> None:
    assert topics.scan_key("m", "r", "s") == "facet/v1/m/robot/r/scan/s"
    assert topics.scans_key("m") == "facet/v1/m/robot/*/scan/*"
    assert topics.correction_key("m", "r") == "facet/v1/m/robot/r/correction"
    assert topics.corrections_key("m") == "facet/v1/m/robot/*/correction"
    assert topics.plane_key("m", 3) == "facet/v1/m/plane/3"
    assert topics.planes_key("m") == "facet/v1/m/plane/*"
    assert topics.cmd_key("m", "pause") == "facet/v1/m/cmd/pause"
    assert topics.pose_topic("r") == "/facet/pose/r"
    names = ("events", "update", "points", "status", "snapshot", "schema", "alive")
    for name in names:
        assert getattr(topics, f"{name}_key")("m") == f"facet/v1/m/{name}"


def test_keys_parse_back() -> None:
    assert topics.parse_scan_key(topics.scan_key("m", "r", "s")) == topics.ScanKey("m", "r", "s")
    assert topics.parse_correction_key(topics.correction_key("m", "r")) == ("m", "r")


@pytest.mark.parametrize("value", ["", "a/b", "a b", "é", "*", "$*", "x" * 65, "a\n"])
def test_bad_ids_are_refused(value: str) -> None:
    with pytest.raises(ProtocolError) as caught:
        topics.scan_key("m", value, "s")
    assert caught.value.reason == "bad_id"


@pytest.mark.parametrize(
    "key",
    [
        "",
        "facet/v1/m/robot/r/scan",
        "facet/v1/m/robot/r/scan/s/t",
        "facet/v2/m/robot/r/scan/s",
        "/facet/v1/m/robot/r/scan/s",
        "facet/v1/m/robot/r/scan/*",
        "facet/v1/m/robot/r/scan/s\n",
    ],
)
def test_other_keys_are_refused(key: str) -> None:
    with pytest.raises(ProtocolError):
        topics.parse_scan_key(key)
    with pytest.raises(ProtocolError):
        topics.parse_correction_key(key)


def test_a_command_that_does_not_exist_is_refused() -> None:
    with pytest.raises(ProtocolError, match="not one of pause"):
        topics.cmd_key("m", "fly")


def test_keys_of_poses() -> None:
    key = topics.pose_key("m", "r1", "base_link")
    assert key == "facet/v1/m/robot/r1/pose/base_link"
    assert topics.parse_pose_key(key) == ("r1", "base_link")
    static = topics.transforms_key("m", "r1", static=True)
    assert topics.parse_pose_key(static) == ("r1", "tf_static")
    assert topics.parse_pose_key(topics.transforms_key("m", "r1")) == ("r1", "tf")
    assert not topics.is_pose_key("facet/v1/m/robot/r1/pose")
    with pytest.raises(ProtocolError):
        topics.parse_pose_key("facet/v1/m/robot/r 1/tf")
    with pytest.raises(ProtocolError):
        topics.parse_pose_key("facet/v1/m/robot/r1/scan/front")
    assert topics.poses_keys("m") == ("facet/v1/m/robot/*/pose/*", "facet/v1/m/robot/*/tf")
    assert topics.poses_keys("m", static=True) == ("facet/v1/m/robot/*/tf_static",)
