"""Who sent a message, and whether it is an input: read from its key, its schema and the rules."""

from __future__ import annotations

import re
from functools import lru_cache
from typing import NamedTuple

from facet_protocol import topics
from facet_protocol.messages import Envelope, ProtocolError
from facet_protocol.ros_definitions import ROS_POSES, ROS_TRANSFORMS
from facet_protocol.scans import SCAN_SCHEMAS

CORRECTION = "@correction"  # in place of a sensor's name: no sensor has this sign in its own
FOREIGN_ROBOT = "robot"  # who drove, where the topic does not say
TRANSFORM_SCHEMAS = (*ROS_TRANSFORMS, "foxglove.FrameTransform", "foxglove.FrameTransforms")
POSE_SCHEMAS = (*ROS_POSES, "foxglove.PoseInFrame")  # of what, only a rule or the key says

_DOMAIN = re.compile(r"/([0-9]+)/")


@lru_cache(maxsize=1024)  # asked several times for each message, of few keys
def robot_and_sensor(key: str) -> tuple[str, str]:
    """(robot, sensor) of an input's key; of a topic from elsewhere, names made of the topic."""
    try:
        if topics.is_pose_key(key):
            return topics.parse_pose_key(key)
        if topics.is_correction_key(key):
            return topics.parse_correction_key(key)[1], CORRECTION
        if topics.is_erase_topic(key):
            return topics.parse_erase_topic(key), CORRECTION
        names = topics.parse_scan_key(key)
    except ProtocolError:
        sensor = re.sub(r"[^A-Za-z0-9_-]+", "_", key).strip("_")[:64] or "scan"
        domain = _DOMAIN.match(key)  # of ROS: a topic's name never starts with a digit
        return f"domain-{domain.group(1)}"[:64] if domain else FOREIGN_ROBOT, sensor
    return names.robot, names.sensor


def names_of(envelope: Envelope) -> tuple[str, str]:
    """(robot, sensor) of an input, as a rule names them, else its key."""
    robot, sensor = robot_and_sensor(envelope.key)
    rule = envelope.rule
    if rule is None:
        return robot, sensor
    return rule.robot or robot, rule.sensor or sensor


def source_of(origin: Envelope | str) -> str:
    """The same as one word, `robot/sensor`: the name a source is counted under."""
    if isinstance(origin, str):
        return _nature(origin, "").source
    return "/".join(names_of(origin)) if origin.rule else _nature(origin.key, "").source


class _Nature(NamedTuple):
    """What key and schema of a message say."""

    source: str
    is_correction: bool
    is_scan: bool
    is_own: bool  # what Facet itself derived, in its own log


@lru_cache(maxsize=4096)  # likewise
def _nature(key: str, schema: str) -> _Nature:
    is_correction = topics.is_correction_key(key) or topics.is_erase_topic(key)
    is_own = key.startswith("/facet/")
    is_scan = schema in SCAN_SCHEMAS and not is_own and not is_correction
    return _Nature("/".join(robot_and_sensor(key)), is_correction, is_scan, is_own)


def is_scan(envelope: Envelope) -> bool:
    """Whether it is a scan: our own points (`/facet/points`) are clouds too, but no scans."""
    return _nature(envelope.key, envelope.schema).is_scan and not envelope.is_derived


def is_correction(envelope: Envelope) -> bool:
    """Whether it moves scans that came before, or takes them out."""
    return _nature(envelope.key, envelope.schema).is_correction


def is_input(envelope: Envelope) -> bool:
    """Whether the map is made of it: a scan, or what says where its sensor is, or was."""
    nature = _nature(envelope.key, envelope.schema)
    if nature.is_correction:
        return True
    if envelope.is_derived or nature.is_own:
        return False
    if nature.is_scan:
        return True
    if envelope.schema in TRANSFORM_SCHEMAS:
        return True
    return envelope.schema in POSE_SCHEMAS and bool(pose_frame(envelope))


def pose_frame(envelope: Envelope) -> str:
    """The frame that a pose is the pose of; "" when neither a rule nor the key says it: a pose may
    be a goal as well, and is not guessed to be the robot's."""
    if envelope.rule is not None and envelope.rule.frame:
        return envelope.rule.frame
    if topics.is_pose_key(envelope.key):
        _, name = topics.parse_pose_key(envelope.key)
        return name if envelope.key.endswith(f"/pose/{name}") else ""  # transforms name their own
    return ""


def is_static(envelope: Envelope) -> bool:
    """Whether its transforms hold for ever: what ROS sends on tf_static."""
    return envelope.key.rpartition("/")[2] == "tf_static"
