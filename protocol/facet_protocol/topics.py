"""Key expressions: the names under which messages travel, which are also the topics of the log."""

from __future__ import annotations

import re
from dataclasses import dataclass

from facet_protocol.messages import ProtocolError

PREFIX = "facet/v1"

# Topics that only the log has; no Zenoh key starts with a slash.
CUT_TOPIC = "/facet/cut"
RESOLVED_TOPIC = "/facet/resolved"
CORRECTED_TOPIC = "/facet/corrected"
CONFLICT_TOPIC = "/facet/conflict"
_ERASE_TOPIC = "/facet/erase/"
UPDATE_TOPIC = "/facet/update"
EVENTS_TOPIC = "/facet/events"
SCENE_TOPIC = "/facet/scene"
POINTS_TOPIC = "/facet/points"
STATUS_TOPIC = "/facet/status"
LOSS_TOPIC = "/facet/loss"
TF_TOPIC = "/tf"

COMMANDS: dict[str, tuple[str, ...]] = {  # and the parameters that each takes
    "pause": (),
    "resume": (),
    "checkpoint": (),
    "export": ("format",),
    "erase": ("robot", "sensor", "epoch", "first", "last"),
    "record": (),
}

_ID = re.compile(r"[A-Za-z0-9_-]{1,64}")
_SCAN_KEY = re.compile(rf"{PREFIX}/([^/]+)/robot/([^/]+)/scan/([^/]+)")
_POSE_KEY = re.compile(rf"{PREFIX}/([^/]+)/robot/([^/]+)/(?:pose/([^/]+)|(tf|tf_static))")
_CORRECTION_KEY = re.compile(rf"{PREFIX}/([^/]+)/robot/([^/]+)/correction")


@dataclass(frozen=True, slots=True)
class ScanKey:
    map_id: str
    robot: str
    sensor: str


def check_id(value: str) -> str:
    """`value` itself when it is a legal id. Raises ProtocolError otherwise."""
    if _ID.fullmatch(value) is None:
        raise ProtocolError(f"id {value[:80]!r} is not [A-Za-z0-9_-]{{1,64}}", "bad_id")
    return value


def _key(map_id: str, tail: str) -> str:
    return f"{PREFIX}/{check_id(map_id)}/{tail}"


def scan_key(map_id: str, robot: str, sensor: str) -> str:
    return _key(map_id, f"robot/{check_id(robot)}/scan/{check_id(sensor)}")


def parse_scan_key(key: str) -> ScanKey:
    """Map, robot and sensor of a scan's key. Raises ProtocolError when it is not such a key."""
    match = _SCAN_KEY.fullmatch(key)
    if match is None:
        raise ProtocolError(f"{key[:200]!r} is not the key of a scan", "bad_key")
    map_id, robot, sensor = (check_id(part) for part in match.groups())
    return ScanKey(map_id, robot, sensor)


def scans_key(map_id: str) -> str:
    """Key expression of every scan of a map."""
    return _key(map_id, "robot/*/scan/*")


def pose_key(map_id: str, robot: str, frame: str) -> str:
    """Where a robot says where one of its frames is: poses apart from their scans."""
    return _key(map_id, f"robot/{check_id(robot)}/pose/{check_id(frame)}")


def transforms_key(map_id: str, robot: str, *, static: bool = False) -> str:
    """Where a robot's transforms go; the static ones hold for ever."""
    return _key(map_id, f"robot/{check_id(robot)}/{'tf_static' if static else 'tf'}")


def is_pose_key(key: str) -> bool:
    return _POSE_KEY.fullmatch(key) is not None


def parse_pose_key(key: str) -> tuple[str, str]:
    """(robot, frame), or (robot, "tf") of transforms. Raises ProtocolError when it is neither."""
    match = _POSE_KEY.fullmatch(key)
    if match is None:
        raise ProtocolError(f"{key[:200]!r} is not the key of a pose", "bad_key")
    map_id, robot, frame, transforms = match.groups()
    check_id(map_id)
    return check_id(robot), check_id(frame or transforms)


def poses_keys(map_id: str, *, static: bool = False) -> tuple[str, ...]:
    """Key expressions of all that says where robots' frames are; the static ones apart."""
    tails = ("tf_static",) if static else ("pose/*", "tf")
    return tuple(_key(map_id, f"robot/*/{tail}") for tail in tails)


def correction_key(map_id: str, robot: str) -> str:
    return _key(map_id, f"robot/{check_id(robot)}/correction")


def corrections_key(map_id: str) -> str:
    """Key expression of every robot's corrections."""
    return _key(map_id, "robot/*/correction")


def is_correction_key(key: str) -> bool:
    return _CORRECTION_KEY.fullmatch(key) is not None


def parse_correction_key(key: str) -> tuple[str, str]:
    """(map_id, robot) of a correction's key. Raises ProtocolError when it is not such a key."""
    match = _CORRECTION_KEY.fullmatch(key)
    if match is None:
        raise ProtocolError(f"{key[:200]!r} is not the key of a correction", "bad_key")
    return check_id(match.group(1)), check_id(match.group(2))


def erase_topic(robot: str) -> str:
    """Where the log keeps what was erased of a robot: no key leads there, only the command."""
    return f"{_ERASE_TOPIC}{check_id(robot)}"


def is_erase_topic(topic: str) -> bool:
    return topic.startswith(_ERASE_TOPIC)


def parse_erase_topic(topic: str) -> str:
    """The robot. Raises ProtocolError when it is not such a topic."""
    if not is_erase_topic(topic):
        raise ProtocolError(f"{topic[:200]!r} is not where erasures are kept", "bad_key")
    return check_id(topic.removeprefix(_ERASE_TOPIC))


def plane_key(map_id: str, plane_id: int) -> str:
    return _key(map_id, f"plane/{plane_id}")


def planes_key(map_id: str) -> str:
    """Key expression of every plane of a map."""
    return _key(map_id, "plane/*")


def events_key(map_id: str) -> str:
    return _key(map_id, "events")


def update_key(map_id: str) -> str:
    return _key(map_id, "update")


def points_key(map_id: str) -> str:
    return _key(map_id, "points")


def status_key(map_id: str) -> str:
    return _key(map_id, "status")


def snapshot_key(map_id: str) -> str:
    """Queryable; `?since=<revision>` asks for what changed since."""
    return _key(map_id, "snapshot")


def schema_key(map_id: str) -> str:
    """Queryable: the FileDescriptorSet."""
    return _key(map_id, "schema")


def alive_key(map_id: str) -> str:
    """Liveliness token: the service is there."""
    return _key(map_id, "alive")


def cmd_key(map_id: str, command: str) -> str:
    """Queryable of one command. Raises ProtocolError for a command that does not exist."""
    if command not in COMMANDS:
        raise ProtocolError(f"command {command!r} is not one of {', '.join(COMMANDS)}", "bad_key")
    return _key(map_id, f"cmd/{command}")


def pose_topic(robot: str) -> str:
    return f"/facet/pose/{check_id(robot)}"
