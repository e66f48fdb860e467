"""What the benchmarks share: a table of figures against their targets, and its JSON."""

from __future__ import annotations

import json
import os
import platform
import sys
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from facet.commands.terminal import out, table

FOLDER = Path(__file__).parents[2] / "out" / "figures"


@dataclass(frozen=True)
class Figure:
    """One measured number; `met` None: reported, without a target."""

    what: str
    value: float | int | str
    target: str = ""
    met: bool | None = None

    @property
    def verdict(self) -> str:
        return "" if self.met is None else "pass" if self.met else "FAIL"


def at_most(what: str, value: float, limit: float, unit: str = "") -> Figure:
    return Figure(what, value, f"<= {limit:g} {unit}".rstrip(), bool(value <= limit))


def at_least(what: str, value: float, limit: float, unit: str = "") -> Figure:
    return Figure(what, value, f">= {limit:g} {unit}".rstrip(), bool(value >= limit))


def none_of(what: str, items: Sequence[object]) -> Figure:
    """Passes when there are none; else says which."""
    return Figure(what, ", ".join(map(str, items)) or 0, "0", not items)


def report(name: str, title: str, figures: Sequence[Figure], details: dict[str, Any]) -> None:
    """Print the table and write out/figures/<name>.json."""
    rows = [(f.what, _text(f.value), f.target, f.verdict) for f in figures]
    table(title, ("figure", "value", "target", ""), rows)
    judged = [f for f in figures if f.met is not None]
    out.print(f"{sum(bool(f.met) for f in judged)} of {len(judged)} targets met\n")
    write(name, {"figures": [asdict(f) for f in figures], **details})


def write(name: str, content: dict[str, Any]) -> Path:
    """One JSON file, with the machine it was measured on."""
    FOLDER.mkdir(parents=True, exist_ok=True)
    path = FOLDER / f"{name}.json"
    machine = {
        "cpus": os.cpu_count(),
        "load": os.getloadavg(),
        "machine": platform.machine(),
        "python": platform.python_version(),
    }
    text = json.dumps({"name": name, "machine": machine, **content}, indent=1, default=str)
    path.write_text(text + "\n", encoding="utf-8")
    return path


def name_of(bench: str, quick: bool) -> str:
    """A smoke run does not overwrite what a full run found."""
    return f"{bench}-quick" if quick else bench


def skip(reason: str) -> None:
    """End the benchmark without a verdict."""
    out.print(f"skipped: {reason}")
    sys.exit(0)


def _text(value: float | int | str) -> str:
    if isinstance(value, float):
        return f"{value:.4g}" if abs(value) < 1e4 else f"{value:,.0f}"
    return f"{value:,}" if isinstance(value, int) else value
