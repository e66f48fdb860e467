"""Who sent a message: robot and sensor, read from its key."""

from __future__ import annotations

import re

from facet_protocol.messages import Envelope, ProtocolError
from facet_protocol.scans import SCAN_SCHEMAS
from facet_protocol.topics import parse_scan_key

FOREIGN_ROBOT = "recording"  # who drove, where the topic does not say


def robot_and_sensor(key: str) -> tuple[str, str]:
    """(robot, sensor) of a scan's key; of a topic from elsewhere, a name made of the topic."""
    try:
        names = parse_scan_key(key)
    except ProtocolError:
        sensor = re.sub(r"[^A-Za-z0-9_-]+", "_", key).strip("_")[:64] or "scan"
        return FOREIGN_ROBOT, sensor
    return names.robot, names.sensor


def source_of(key: str) -> str:
    """The same as one word, `robot/sensor`: the name a source is counted under."""
    return "/".join(robot_and_sensor(key))


def is_scan(envelope: Envelope) -> bool:
    """Whether it is an input: our own points (`/facet/points`) are clouds too, but no scans."""
    return envelope.schema in SCAN_SCHEMAS and not envelope.key.startswith("/facet/")
