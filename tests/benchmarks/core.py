"""The core at sensor rate, each figure against its target; every section in a process of its own.

`core.py [--quick] [SECTION ...]`: insert, paper, replay run on one core; updates, standstill and
memory on all.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
import tempfile
from collections.abc import Callable
from dataclasses import asdict
from pathlib import Path
from typing import Any

from benchmarks import growth, rates
from benchmarks.charts import ratios
from benchmarks.figures import Figure, name_of, report
from facet.mapping.settings import MapSettings
from facet.warmup import warm_up

Section = Callable[[bool], tuple[list[Figure], dict[str, Any]]]
ONE_CORE: dict[str, Section] = {
    "insert": rates.insert,
    "whole_insert": rates.whole_insert,
    "replay": rates.replay,
    "paper": rates.papers,
}
ALL_CORES: dict[str, Section] = {
    "updates": growth.updates,
    "standstill": growth.standstill,
    "memory": growth.memory,
}
LIMIT_S = 600.0


def run(name: str, quick: bool) -> tuple[list[Figure], dict[str, Any]]:
    """One section in a child, on one core where it says so."""
    one = name in ONE_CORE
    environment = {**os.environ, **({"NUMBA_NUM_THREADS": "1"} if one else {})}
    with tempfile.TemporaryDirectory(prefix="facet-core-") as folder:
        path = Path(folder) / "section.json"
        command = [sys.executable, __file__, "--child", name, str(path), str(int(quick))]
        subprocess.run(command, check=True, env=environment, timeout=LIMIT_S)
        found = json.loads(path.read_text(encoding="utf-8"))
    return [Figure(**figure) for figure in found["figures"]], found["details"]


def child(name: str, path: Path, quick: bool) -> None:
    if name in ONE_CORE:
        os.sched_setaffinity(0, {max(os.sched_getaffinity(0))})
    warm_up(MapSettings())
    figures, details = (ONE_CORE | ALL_CORES)[name](quick)
    content = {"figures": [asdict(f) for f in figures], "details": details}
    path.write_text(json.dumps(content, default=float), encoding="utf-8")


def main(arguments: list[str]) -> None:
    quick = "--quick" in arguments
    chosen = [a for a in arguments if a != "--quick"] or [*ONE_CORE, *ALL_CORES]
    figures: list[Figure] = []
    details: dict[str, Any] = {"quick": quick, "one_core": list(ONE_CORE)}
    for name in chosen:
        own, found = run(name, quick)
        figures += own
        details |= found
    report(name_of("core", quick), "The core at sensor rate", figures, details)
    ratios(name_of("core", quick), "the core, each figure over its target", figures)


if __name__ == "__main__":
    if sys.argv[1:2] == ["--child"]:
        child(sys.argv[2], Path(sys.argv[3]), sys.argv[4] == "1")
    else:
        main(sys.argv[1:])
