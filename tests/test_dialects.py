"""The dialect table: the same answers for Zenoh keys and for the channels of a recording."""

from __future__ import annotations

import pytest

from facet.sources.dialects import Dialect, Dialects, key_pattern
from facet_protocol.messages import ProtocolError, Rule

CLOUD, TRANSFORMS = "sensor_msgs/msg/PointCloud2", "tf2_msgs/msg/TFMessage"
HASH = "RIHS01_9198cabf7da3796ae6fe19c4cb3bdd3525492988c70522628af5daa124bae2b5"
RMW = f"velodyne/points/sensor_msgs::msg::dds_::PointCloud2_/{HASH}"
TOKEN = "@/f00/@ros2_lv/MP/r1§points/sensor_msgs§msg§PointCloud2/::10,5:1:::"


def said(found: object) -> tuple[str, ...]:
    return tuple(found)[:4] if isinstance(found, tuple) else ()


@pytest.mark.parametrize(
    ("key", "encoding", "expected"),
    [
        (f"0/{RMW}", "", (Dialect.RMW_ZENOH, "/velodyne/points", CLOUD, "cdr")),
        (f"7/{RMW}", "zenoh/bytes", (Dialect.RMW_ZENOH, "/7/velodyne/points", CLOUD, "cdr")),
        (
            f"0/tf_static/tf2_msgs::msg::dds_::TFMessage_/{HASH}",
            "",
            (Dialect.RMW_ZENOH, "/tf_static", TRANSFORMS, "cdr"),
        ),
        (f"0/camera/sensor_msgs::msg::dds_::Image_/{HASH}", "", ()),
        (
            "rt/velodyne/points",
            f"application/cdr;{CLOUD}",
            (Dialect.TAGGED, "/velodyne/points", CLOUD, "cdr"),
        ),
        (
            "cloud",
            "application/cdr;sensor_msgs/PointCloud2",
            (Dialect.TAGGED, "cloud", CLOUD, "cdr"),
        ),
        ("cloud", "application/cdr;sensor_msgs/msg/Image", ()),
        ("cloud", "application/cdr", ()),
        (
            "cloud",
            "application/protobuf;foxglove.PointCloud",
            (Dialect.PROTOBUF, "cloud", "foxglove.PointCloud", "protobuf"),
        ),
        ("cloud", "zenoh/bytes", ()),
        (
            "facet/v1/m/robot/r/scan/s",
            "application/protobuf;foxglove.PointCloud",
            (
                Dialect.NATIVE,
                "facet/v1/m/robot/r/scan/s",
                "foxglove.PointCloud",
                "protobuf",
            ),
        ),
        ("odd/lidar", "zenoh/bytes", (Dialect.RULE, "odd/lidar", CLOUD, "cdr")),
        ("odd/fan", "", (Dialect.RULE, "odd/fan", "foxglove.LaserScan", "protobuf")),
    ],
)
def test_keys_and_encodings(key: str, encoding: str, expected: tuple[str, ...]) -> None:
    rules = [Rule("odd/lidar", schema=CLOUD), Rule("odd/$*an", schema="foxglove.LaserScan")]
    dialects = Dialects(rules)
    assert said(dialects.recognise(key, encoding)) == expected
    assert said(dialects.recognise(key, encoding)) == expected  # as remembered


def test_a_bridge_says_the_type_of_its_keys() -> None:
    dialects = Dialects()
    assert dialects.recognise("r1/points", "zenoh/bytes") is None
    dialects.learn(TOKEN)
    dialects.learn("@/f00/@ros2_lv/MP/nonsense")
    found = dialects.recognise("r1/points", "zenoh/bytes")
    assert said(found) == (Dialect.BRIDGE, "/r1/points", CLOUD, "cdr")
    dialects.forget(TOKEN)
    assert dialects.recognise("r1/points", "zenoh/bytes") is None


def test_a_rule_says_whose_a_known_message_is() -> None:
    rule = Rule("r7/**", robot="seven", frame="lidar")
    dialects = Dialects([rule])
    dialects.learn(TOKEN.replace("r1§", "r7§"))
    for key, encoding in (("r7/points", ""), ("rt/r7/points", f"application/cdr;{CLOUD}")):
        found = dialects.recognise(key, encoding)
        assert found is not None
        assert found.rule is rule


@pytest.mark.parametrize(
    ("topic", "schema", "encoding", "expected"),
    [
        ("/points", CLOUD, "cdr", (Dialect.TAGGED, "/points", CLOUD, "cdr")),
        ("/points", "sensor_msgs/PointCloud2", "cdr", (Dialect.TAGGED, "/points", CLOUD, "cdr")),
        ("/points", "sensor_msgs/PointCloud2", "ros1", ()),
        ("/image", "sensor_msgs/msg/Image", "cdr", ()),
        (
            "/tf",
            "foxglove.FrameTransforms",
            "protobuf",
            (Dialect.PROTOBUF, "/tf", "foxglove.FrameTransforms", "protobuf"),
        ),
        ("/odd", "", "", (Dialect.RULE, "/odd", CLOUD, "cdr")),
    ],
)
def test_channels_of_a_recording(
    topic: str, schema: str, encoding: str, expected: tuple[str, ...]
) -> None:
    dialects = Dialects([Rule("odd", schema=CLOUD)])
    assert said(dialects.recognise_channel(topic, schema, encoding)) == expected


def test_what_strangers_send_does_not_add_up() -> None:
    dialects = Dialects()
    for k in range(10_000):
        dialects.recognise(f"stranger/{k}", "")
        dialects.learn(TOKEN.replace("points", f"p{k}"))
    assert len(dialects._known) <= 4096
    assert len(dialects._types) <= 4096


@pytest.mark.parametrize(
    ("expression", "matches", "others"),
    [
        ("a/*/c", ["/a/b/c"], ["/a/c", "/a/b/b/c", "/a/b/cc"]),
        ("a/**", ["/a", "/a/b", "/a/b/c"], ["/b", "/ab"]),
        ("**/c", ["/c", "/a/c", "/a/b/c"], ["/cc", "/a/b"]),
        ("a/r$*/c", ["/a/r/c", "/a/r1/c"], ["/a/x/c", "/a/r/x/c"]),
        ("a.b", ["/a.b"], ["/axb"]),
    ],
)
def test_key_expressions(expression: str, matches: list[str], others: list[str]) -> None:
    pattern = key_pattern(expression)
    assert all(pattern.fullmatch(key) for key in matches)
    assert not any(pattern.fullmatch(key) for key in others)


@pytest.mark.parametrize("expression", ["", "/a", "a//b", "a/", "a*", "a/***"])
def test_what_is_no_key_expression(expression: str) -> None:
    with pytest.raises(ProtocolError):
        key_pattern(expression)
