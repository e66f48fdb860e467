"""`facet config`: every setting there is, in the form of the file that sets it."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Annotated, Any

import typer

from facet.config import MappingSection, Section, load_config, remarks

COLUMN = 40  # where remarks begin


def config(
    file: Annotated[
        Path | None, typer.Argument(metavar="FILE.toml", help="Settings; the defaults otherwise.")
    ] = None,
) -> None:
    """Print all settings as TOML. Each with its meaning, its unit and its bounds.

    \b
    facet config > facet.toml        # to begin with; a file need only hold what differs
    facet config facet.toml          # what a file comes to, with the defaults it leaves
    facet run --config facet.toml

    What stands in a comment holds where nothing is said. Exit code 78: the file has a mistake.
    """
    for line in toml_of(load_config(file)):
        typer.echo(line)


def toml_of(section: Section, name: str = "") -> Iterator[str]:
    """The lines of a file that says what the section does: its keys first, then its tables."""
    tables = []
    if name:
        yield f"\n[{name}]"
    for key, value in section:
        if isinstance(value, Section):
            tables.append((f"{name}.{key}" if name else key, value))
        elif value and isinstance(value, tuple) and isinstance(value[0], Section):
            tables += [(f"[{name}.{key}]", table) for table in value]
        else:
            yield _line(key, value, remarks(type(section), key), _unsaid(section, key))
    for title, table in tables:
        yield from toml_of(table, title)


def _unsaid(section: Section, key: str) -> Any:
    """What holds where the section says nothing, if there is such a thing."""
    from facet.mapping.settings import MapSettings

    return MapSettings().as_dict().get(key) if isinstance(section, MappingSection) else None


def _line(key: str, value: Any, remark: str, unsaid: Any) -> str:
    if value is None or key == "rules":  # without any: an empty list would exclude the tables
        said = f"# {key} =" + ("" if unsaid is None else f" {_literal(unsaid)}")
    else:
        said = f"{key} = {_literal(value)}"
    return f"{said:{COLUMN - 1}} # {remark}" if remark else said


def _literal(value: Any) -> str:
    """JSON's literals of these are TOML's."""
    return json.dumps(value if isinstance(value, bool | int | float | tuple) else str(value))
