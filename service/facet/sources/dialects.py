"""What a message is, and who sent it: one table for Zenoh keys and for the channels of a recording.

A  ROS 2 over rmw_zenoh   the key ends in the type and its hash
B  zenoh-bridge-ros2dds   a liveliness token names the type of a key
C  tagged CDR             the encoding names the type
D  protobuf               the encoding names a schema of Foxglove's
E  a rule                 the settings name the schema of a key, or whose it is
"""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence
from enum import StrEnum
from typing import NamedTuple

from facet_protocol.messages import ProtocolError, Rule
from facet_protocol.ros_definitions import ROS_SCHEMAS, ros_schema
from facet_protocol.topics import PREFIX

TOKENS_KEY = "@/*/@ros2_lv/MP/*/*/*"  # who publishes what: kept by the bridge as long as it does
MAX_KNOWN = 4096  # keys that are remembered; a stranger cannot make them grow for ever

_RMW_KEY = re.compile(r"([0-9]{1,4})/(.+)/(\w+::msg::dds_::\w+_)/([^/]+)")
_TOKEN = re.compile(r"@/[^/]+/@ros2_lv/MP/([^/]+)/([^/]+)/[^/]*")


class Dialect(StrEnum):
    """How a message says what it is."""

    NATIVE = "native"
    RMW_ZENOH = "rmw_zenoh"
    BRIDGE = "ros2dds bridge"
    TAGGED = "ROS 2"
    PROTOBUF = "Foxglove"
    RULE = "rule"


class Recognised(NamedTuple):
    """A message whose bytes can be read, before they are."""

    dialect: Dialect
    topic: str  # in the log: the Zenoh key, or the topic of ROS
    schema: str
    encoding: str
    rule: Rule | None


class Dialects:
    """The table. `recognise` may be called on any thread; `learn` and `forget` on one."""

    def __init__(self, rules: Sequence[Rule] = ()) -> None:
        self.rules = tuple(rules)
        self._matches = [(key_pattern(rule.key), rule) for rule in rules]
        self._types: dict[str, str] = {}  # key: schema, as its token says
        self._known: dict[tuple[str, ...], Recognised | None] = {}

    def learn(self, token: str) -> None:
        """A bridge says that it publishes a key."""
        match = _TOKEN.fullmatch(token)
        if match is not None and len(self._types) < MAX_KNOWN:
            key, kind = (part.replace("§", "/") for part in match.groups())
            self._types[key] = ros_schema(kind)
            self._known.clear()

    def forget(self, token: str) -> None:
        """A bridge does not publish a key any longer."""
        match = _TOKEN.fullmatch(token)
        if match is not None:
            self._types.pop(match.group(1).replace("§", "/"), None)
            self._known.clear()

    def recognise(self, key: str, encoding: str) -> Recognised | None:
        """A Zenoh sample by its key and its encoding; None: nothing that is read."""
        return self._remember((key, encoding), lambda: self._recognise(key, encoding))

    def recognise_channel(self, topic: str, schema: str, encoding: str) -> Recognised | None:
        """A channel of a recording; None: its schema is to be taken as it is written."""
        name = (topic, schema, encoding)
        return self._remember(name, lambda: self._recognise_channel(*name))

    def _remember(
        self, name: tuple[str, ...], find: Callable[[], Recognised | None]
    ) -> Recognised | None:
        if name not in self._known:
            if len(self._known) >= MAX_KNOWN:
                self._known.clear()
            self._known[name] = find()
        return self._known.get(name)

    def _recognise(self, key: str, encoding: str) -> Recognised | None:
        schema, kind = split_encoding(encoding)
        if key.startswith(f"{PREFIX}/"):
            return Recognised(Dialect.NATIVE, key, schema, kind, self.rule_of(key))
        match = _RMW_KEY.fullmatch(key)
        if match is not None:
            domain, name, dds_type, _ = match.groups()
            topic = f"/{name}" if int(domain) == 0 else f"/{int(domain)}/{name}"
            return self._cdr(Dialect.RMW_ZENOH, topic, ros_schema(dds_type))
        if key in self._types:
            return self._cdr(Dialect.BRIDGE, f"/{key}", self._types[key])
        if kind == "cdr" and schema:
            topic = f"/{key.removeprefix('rt/')}" if key.startswith("rt/") else key
            return self._cdr(Dialect.TAGGED, topic, ros_schema(schema))
        rule = self.rule_of(key)
        if kind == "protobuf" and schema.startswith("foxglove."):
            return Recognised(Dialect.PROTOBUF, key, schema, kind, rule)
        if rule is not None and rule.schema:
            schema = ros_schema(rule.schema)
            return Recognised(Dialect.RULE, key, schema, encoding_of(schema), rule)
        return None

    def _cdr(self, dialect: Dialect, topic: str, schema: str) -> Recognised | None:
        if schema not in ROS_SCHEMAS:
            return None
        return Recognised(dialect, topic, schema, "cdr", self.rule_of(topic))

    def _recognise_channel(self, topic: str, schema: str, encoding: str) -> Recognised | None:
        if topic.startswith(f"{PREFIX}/"):
            return Recognised(Dialect.NATIVE, topic, schema, encoding, self.rule_of(topic))
        rule = self.rule_of(topic)
        if encoding == "cdr" and ros_schema(schema) in ROS_SCHEMAS:
            return Recognised(Dialect.TAGGED, topic, ros_schema(schema), encoding, rule)
        if encoding == "protobuf" and schema.startswith("foxglove."):
            return Recognised(Dialect.PROTOBUF, topic, schema, encoding, rule)
        if rule is not None and rule.schema:
            schema = ros_schema(rule.schema)
            return Recognised(Dialect.RULE, topic, schema, encoding_of(schema), rule)
        return None

    def rule_of(self, topic: str) -> Rule | None:
        """The first rule whose key expression holds the key or topic."""
        key = f"/{topic.removeprefix('/')}"
        return next((rule for pattern, rule in self._matches if pattern.fullmatch(key)), None)


def split_encoding(text: str) -> tuple[str, str]:
    """(schema, encoding) of `application/protobuf;foxglove.PointCloud`."""
    kind, _, schema = text.partition(";")
    return schema, kind.removeprefix("application/")


def encoding_of(schema: str) -> str:
    return "cdr" if schema in ROS_SCHEMAS else "protobuf"


def key_pattern(expression: str) -> re.Pattern[str]:
    """Of a key expression: `*` is a chunk, `**` any number of them, `$*` any part of a chunk.

    Raises ProtocolError for what is none.
    """
    chunks = expression.split("/")
    if not all(chunks) or any("*" in c.replace("$*", "") and c not in ("*", "**") for c in chunks):
        raise ProtocolError(f"{expression!r} is no key expression", "bad_key")
    return re.compile("".join(map(_chunk_pattern, chunks)))


def _chunk_pattern(chunk: str) -> str:
    """Of one chunk with the slash before it."""
    if chunk == "**":
        return "(?:/[^/]+)*"
    if chunk == "*":
        return "/[^/]+"
    return "/" + "[^/]*".join(re.escape(part) for part in chunk.split("$*"))
