"""Options that several commands share, and the mapper they ask for."""

from __future__ import annotations

import json
import logging
from collections.abc import Callable, Mapping
from functools import cache
from typing import TYPE_CHECKING, Annotated, Any

import typer

from facet.commands.terminal import err, said_if_slow
from facet.config import Config, ConfigError

if TYPE_CHECKING:
    from facet.mapping.mapper import Mapper
    from facet.mapping.memory import Memory
    from facet.mapping.settings import MapSettings

logger = logging.getLogger(__name__)

VoxelOption = Annotated[
    float | None,
    typer.Option(
        "--voxel",
        help="Voxel edge, 0.005 to 1 m. Gaps under ten voxels close.",
        show_default="0.05; replay: the log's",
    ),
]
ThetaOption = Annotated[
    float | None,
    typer.Option(
        "--theta",
        help="Largest thickness angle of a normal, 1 to 45 degrees.",
        show_default="15; replay: the log's",
    ),
]
DetailOption = Annotated[
    float | None,
    typer.Option(
        "--detail-level",
        help="Share of the voxels that planes must hold, 0.5 to 1.",
        show_default="0.98; replay: the log's",
    ),
]
FrameOption = Annotated[
    str | None, typer.Option(help="Frame that poses lead to.", show_default="the log's, else map")
]

RejectJumpsOption = Annotated[
    bool | None,
    typer.Option(
        "--reject-jumps/--accept-jumps",
        help="Refuse scans whose pose jumps (5 m or 90 degrees at once), not only flag them.",
    ),
]
StrictOption = Annotated[
    bool | None,
    typer.Option(
        "--strict/--no-strict",
        help="Refuse the scans of a second publisher under one name, not only raise the alarm.",
    ),
]


def make_mapper(config: Config, recorded: Mapping[str, Any] | None = None) -> Mapper:
    """A mapper with the settings of a log it repeats, and over them those that were given."""
    from facet.mapping.mapper import Mapper
    from facet.mapping.settings import MapSettings

    known = MapSettings().as_dict()
    unknown = sorted(set(recorded or {}) - set(known))
    if unknown:  # of a log that another version wrote
        logger.warning("settings of the log that this version does not have: %s", unknown)
    repeated = {name: value for name, value in (recorded or {}).items() if name in known}
    try:
        settings = MapSettings(**{**repeated, **config.mapping.given()})
    except (TypeError, ValueError) as error:
        raise ConfigError(str(error)) from error
    return Mapper(settings, config.map.id, _memory(config))


@cache
def load_loops(settings: MapSettings, say: Callable[[str], object] = err.print) -> None:
    """The mapper's compiled loops, once a process: from the cache in a second, else it is said
    that they have to be compiled."""
    from facet.warmup import warm_up

    with said_if_slow("compiling the mapper's loops, once: this takes a minute or two", say):
        warm_up(settings)


def _memory(config: Config) -> Memory:
    """Room for the map's columns."""
    from facet.paging import MIB, PagedMemory, plain_memory

    limit = config.memory.max_ram_mb
    if limit is None:
        return plain_memory()
    return PagedMemory(config.record.directory, limit * MIB)


def recorded_settings(head: Mapping[str, str]) -> dict[str, Any]:
    """The mapper's settings that a log was made with; none for a log that does not say."""
    try:
        settings = json.loads(head.get("settings", "{}"))
    except ValueError:
        return {}
    return settings if isinstance(settings, dict) else {}


def robots_overrides(reject_jumps: bool | None, strict: bool | None) -> dict[str, Any]:
    """The two as keys of the configuration."""
    return {"robots.reject_jumps": reject_jumps, "robots.strict": strict}


def mapping_overrides(
    voxel: float | None, theta: float | None, detail_level: float | None
) -> dict[str, Any]:
    """The three as keys of the configuration."""
    return {
        "mapping.voxel_m": voxel,
        "mapping.theta_deg": theta,
        "mapping.detail_level": detail_level,
    }
