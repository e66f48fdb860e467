"""What the settings say of robots, as sources and the pipeline want it."""

from __future__ import annotations

import json
from collections.abc import Mapping

from facet.admission import Admission
from facet.config import Config, ConfigError, RobotsSection
from facet.past import Past
from facet.sources.dialects import Dialects, key_pattern
from facet.status import Account
from facet_protocol.messages import ProtocolError, Rule


def dialects_of(robots: RobotsSection) -> Dialects:
    """The dialect table with the rules of the settings. Raises ConfigError."""
    rules = [
        Rule(r.key.removeprefix("/"), r.type, r.robot, r.sensor, r.frame, r.envelope_field)
        for r in robots.rules
    ]
    try:
        for key in robots.keys:
            key_pattern(key)
        return Dialects(rules)
    except ProtocolError as error:
        raise ConfigError(f"robots: {error}; allowed are a/b, a/*, a/**") from error


def admission_of(
    config: Config,
    account: Account,
    reach_m: float,
    *,
    logged: bool = False,
    past: Past | None = None,
) -> Admission:
    """What turns messages into scans, bounded as the settings say; `logged`, `past`: see there."""
    return Admission(
        account,
        config.map.frame,
        reach_m,
        wait_ns=int(config.robots.wait_s * 1e9),
        wait_bytes=config.robots.wait_bytes,
        logged=logged,
        past=past or Past(dialects_of(config.robots)),
        reject_jumps=config.robots.reject_jumps,
        strict=config.robots.strict,
    )


def recorded_robots(head: Mapping[str, str]) -> RobotsSection:
    """The settings that a log was recorded with; the defaults when it does not say."""
    try:
        return RobotsSection.model_validate(json.loads(head.get("config", "{}")).get("robots", {}))
    except (ValueError, AttributeError):
        return RobotsSection()


def says_poses(head: Mapping[str, str]) -> bool:
    """Whether a log holds the poses that were found for its scans."""
    return head.get("resolved") == "logged"
