"""The text that goes into a log describes what others understand by the name."""

from __future__ import annotations

import pytest
from rosbags.typesys import get_types_from_msg

from facet_protocol.codec import schema_text
from facet_protocol.ros_definitions import ROS_SCHEMAS, ros_schema
from ros_messages import STORE


@pytest.mark.parametrize("schema", ROS_SCHEMAS)
def test_rosbags_reads_our_text_as_its_own_types(schema: str) -> None:
    encoding, text = schema_text(schema)
    assert encoding == "ros2msg"
    types = get_types_from_msg(text.decode(), schema)
    assert schema in types
    for name, (_, fields) in types.items():
        expected = [(field, kind) for field, kind in STORE.fielddefs[name][1]]
        assert list(fields) == expected, name


@pytest.mark.parametrize(
    "name",
    [
        "sensor_msgs/msg/PointCloud2",
        "sensor_msgs/PointCloud2",
        "sensor_msgs::msg::dds_::PointCloud2_",
    ],
)
def test_every_spelling_of_a_type(name: str) -> None:
    assert ros_schema(name) == "sensor_msgs/msg/PointCloud2"
    assert ros_schema("foxglove.PointCloud") == "foxglove.PointCloud"
