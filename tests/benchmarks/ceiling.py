"""Where the time goes: each stage beside the least that this machine could need for it.

`ceiling.py [--quick]` measures the machine, maps a building at once, updates a mapped one, and
writes PROFILE.md beside this file. (Not `profile.py`: Python's own profiler has that name.)
"""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any, NamedTuple

import numba
import numpy as np
from scipy.spatial import cKDTree

from benchmarks import buildings, growth, inside
from benchmarks.figures import Figure, name_of, report
from benchmarks.machine import ceilings
from facet.mapping.mapper import Mapper
from facet.mapping.quantise import quantise
from facet.mapping.settings import MapSettings
from facet.pipeline import Stopwatch
from facet.warmup import warm_up
from facet_protocol.messages import Scan

PAGE = Path(__file__).with_name("PROFILE.md")
RUNS = 3
SAMPLE = 20_000
UPDATES = 30


class Cost(NamedTuple):
    """What a stage must do at least, a unit; what the code does beside it is above the floor."""

    unit: str
    why: str
    bytes: float = 0.0  # streamed, read and written
    lines: float = 0.0  # cache lines fetched from anywhere in the map
    moments: float = 0.0  # values summed into ten moments, all of an array
    picked: float = 0.0  # the same, of the set bits of a mask
    roots: float = 0.0  # divisions with a square root


COSTS = {
    "quantise": Cost(
        "points", "12 B in, 24 + 6 B out; a root, six divisions", bytes=42, moments=1, roots=4
    ),
    "store": Cost("points", "the ticks; ten moments", bytes=30, moments=1),
    "store rows": Cost("voxel runs", "its place, two lines of moments and views", lines=3),
    "free space": Cost(
        "cells passed", "a counter; a line holds four on the way", bytes=4, lines=0.25, moments=1
    ),
    "settle": Cost(
        "touched voxels", "two lines of moments and views; the rounding", 16, 2, 1, roots=2
    ),
    "normals": Cost("votes", "each voxel of a region, for its radius and its slab", picked=2),
    "normals of voxels": Cost(
        "stale voxels", "observable in, normal out; an eigenvector", 24, 1, 20, roots=4
    ),
    "patches": Cost(
        "stale voxels", "observable, normal, label; moments of a patch", 40, 1, picked=10, roots=1
    ),
    "tiles": Cost("relabelled voxels", "label, owner; moments of a tile-plane", 24, 1, picked=10),
    "planes": Cost("tile-planes", "moments, neighbours, an eigenvector", 400, 4, 100, roots=20),
    "contours": Cost("relabelled voxels", "projected and drawn once", 12, 1, 1),
    "rings": Cost("ring vertices", "a disc of 2 alpha rolled round each", picked=314),
}
PARTS = {
    "store": ("store", "store rows"),
    "normals": ("normals", "normals of voxels"),
    "contours": ("contours", "rings"),
}
INSERT = ("quantise", "store", "free space")  # on one thread
ORDER = (*INSERT, "settle", "normals", "patches", "tiles", "planes", "contours")
KINDS = {
    "bytes": ("streamed, read and written", "GB/s", 1e-9),
    "lines": ("cache lines at random", "M/s", 1e-6),
    "moments": ("values summed into ten moments, in cache", "M/s", 1e-6),
    "picked": ("the same, picked by the bits of masks", "M/s", 1e-6),
    "roots": ("divisions with a square root", "M/s", 1e-6),
}


class Row(NamedTuple):
    stage: str
    measured_ms: float
    floor_ms: float
    bound: str
    work: str


def whole(quick: bool) -> tuple[dict[str, float], dict[str, float]]:
    """Milliseconds by stage of a map made at once, medians, and its units."""
    looks = buildings.office(30 if quick else 100)
    filler, scans = Mapper(), list[Scan]()
    for scan in growth.all_copies(looks):
        if inside.num_voxels(filler) >= (60_000 if quick else 1_000_000):
            break
        filler.insert(scan)
        scans.append(scan)
    runs = []
    for _ in range(RUNS):
        mapper, stages = Mapper(), _insert(scans)
        for scan in scans:
            mapper.insert(scan)
        stopwatch = Stopwatch()
        mapper.update(stopwatch)
        runs.append({**stages, **stopwatch.stage_ms})
    voxels = inside.num_voxels(mapper)
    units = _insert_units(mapper, scans)
    units |= {
        "touched voxels": voxels,
        "stale voxels": voxels,
        "relabelled voxels": voxels,
        "votes": voxels * _votes(mapper),
        "tile-planes": mapper.work["tile_planes"],
        "ring vertices": _ring_vertices(mapper),
    }
    return {name: float(np.median([r[name] for r in runs])) for name in runs[0]}, units


def update(quick: bool) -> tuple[dict[str, float], dict[str, float]]:
    """The same of one update after a 32 k scan in a mapped building."""
    near, mapper = buildings.stretch(2.0), Mapper()
    growth.grow(mapper, 60_000 if quick else growth.SMALL, buildings.office(30 if quick else 100))
    growth.ripen(mapper, near)
    mapper.update()
    runs, work, scans = [], [], []
    for k in range(5 if quick else UPDATES):
        scans.append(near.scan(k % len(near), draw=40_000 + k))
        mapper.insert(scans[-1])
        stopwatch = Stopwatch()
        mapper.update(stopwatch)
        runs.append(dict(stopwatch.stage_ms))
        work.append(dict(mapper.work))
    middle = {name: float(np.median([w[name] for w in work])) for name in work[0]}
    stages = {name: float(np.median([r[name] for r in runs])) for name in runs[0]}
    inserted = _insert(scans)
    units = {name: value / len(scans) for name, value in _insert_units(mapper, scans).items()}
    per_block = inside.num_voxels(mapper) / max(1, inside.num_blocks(mapper))
    units |= {
        "touched voxels": middle["touched_voxels"],
        "stale voxels": middle["stale_voxels"],
        "relabelled voxels": middle["blocks_relabelled"] * per_block,
        "votes": middle["stale_voxels"] * _votes(mapper),
        "tile-planes": middle["tile_planes"],
        "ring vertices": _ring_vertices(mapper)
        * middle["outline_tiles"]
        / max(1, inside.outline_tiles(mapper)),
    }
    return {**{k: v / len(scans) for k, v in inserted.items()}, **stages}, units


def _insert(scans: list[Scan]) -> dict[str, float]:
    """Milliseconds of all scans by stage, in a map that has seen them before."""
    settings, fresh = MapSettings(), Mapper()
    store, free = inside.parts(fresh)
    total = dict.fromkeys(INSERT, 0.0)
    for turn in range(2):
        for scan in scans:
            stopwatch = Stopwatch()
            ticks = quantise([scan], settings)
            stopwatch("quantise")
            store.insert(ticks)
            stopwatch("store")
            free.insert(ticks)
            stopwatch("free space")
            for name, ms in stopwatch.stage_ms.items():
                total[name] += ms * turn
    return total


def _insert_units(mapper: Mapper, scans: list[Scan]) -> dict[str, float]:
    points, runs, fresh = 0, 0, Mapper()
    for scan in scans:
        ticks = quantise([scan], mapper.settings)
        fresh.insert(scan)
        points += len(ticks.points)
        runs += 1 + int(np.any(np.diff(np.asarray(ticks.points) >> 10, axis=0), axis=1).sum())
    return {"points": points, "voxel runs": runs, "cells passed": inside.cells_passed(fresh)}


def _votes(mapper: Mapper) -> float:
    """Mean number of voxels in the largest region that a normal looked at."""
    centroids, _ = inside.centroids(mapper)
    radii = inside.radii(mapper)[: len(centroids)]
    chosen = np.random.default_rng(0).choice(len(centroids), min(SAMPLE, len(centroids)))
    tree, total = cKDTree(centroids), 0
    for radius in np.unique(radii[chosen]):
        own = chosen[radii[chosen] == radius]
        reach = (float(radius) + 0.5) * mapper.settings.voxel_m
        total += int(
            tree.query_ball_point(centroids[own], reach, p=np.inf, return_length=True).sum()
        )
    return total / len(chosen)


def _ring_vertices(mapper: Mapper) -> int:
    surfaces = [s for plane in mapper.snapshot().changed for s in plane.surfaces]
    return sum(len(s.outer) + sum(len(h.ring) for h in s.holes) for s in surfaces)


def rows_of(
    measured: dict[str, float],
    units: dict[str, float],
    one: dict[str, float],
    all_threads: dict[str, float],
) -> list[Row]:
    rows = []
    for stage in ORDER:
        ceiling = one if stage in INSERT else all_threads
        need = dict.fromkeys(KINDS, 0.0)
        for part in PARTS.get(stage, (stage,)):
            for kind in KINDS:
                need[kind] += getattr(COSTS[part], kind) * units[COSTS[part].unit]
        floors = {kind: 1e3 * need[kind] / ceiling[kind] for kind in KINDS}
        bound = max(floors, key=lambda kind: floors[kind])
        cost = COSTS[stage]
        work = f"{units[cost.unit]:,.0f} {cost.unit}"
        rows.append(Row(stage, measured[stage], floors[bound], bound, work))
    others = sorted(set(measured) - set(ORDER))
    return rows + [Row(stage, measured[stage], 0.0, "", "not counted") for stage in others]


def page(
    machine: dict[str, dict[str, float]], tables: dict[str, list[Row]], threads: int, quick: bool
) -> str:
    lines = [
        "# Where the time goes",
        "",
        "Written by `make bench NAME=ceiling`; figures of the machine it ran on."
        + (" **A smoke run: maps are small.**" if quick else ""),
        "The floor of a stage is the largest of five times: for the bytes it must stream, the",
        "cache lines it must fetch from anywhere, the values it must sum and the roots it must",
        "take, each as fast as a plain loop does nothing else here. It is a lower bound: sorting,",
        f"branching and growing are not in it. Insert is given one thread, the rest {threads}.",
        "",
        "| ceiling | one thread | all threads |",
        "|---|---|---|",
    ]
    for kind, (what, unit, scale) in KINDS.items():
        one, whole_machine = (machine[k][kind] * scale for k in ("one", "all"))
        lines.append(f"| {what} | {one:,.1f} {unit} | {whole_machine:,.1f} {unit} |")
    for title, rows in tables.items():
        total = sum(row.measured_ms for row in rows)
        lines += ["", f"## {title}", "", f"{total:,.1f} ms in all.", ""]
        lines += ["| stage | ms | share | floor, ms | times the floor | bound by | work |"]
        lines += ["|---|---|---|---|---|---|---|"]
        for row in rows:
            times = f"{row.measured_ms / row.floor_ms:,.1f}" if row.floor_ms else ""
            floor = f"{row.floor_ms:,.2f}" if row.floor_ms else ""
            lines.append(
                f"| {row.stage} | {row.measured_ms:,.2f} | {row.measured_ms / total:.0%} "
                f"| {floor} | {times} | {row.bound} | {row.work} |"
            )
    lines += ["", "## What is counted", ""]
    lines += ["| stage | unit | bytes | lines | values | picked | roots | |"]
    lines += ["|---|---|---|---|---|---|---|---|"]
    lines += [
        f"| {name} | {c.unit} | {' | '.join(f'{getattr(c, kind):g}' for kind in KINDS)} | {c.why} |"
        for name, c in COSTS.items()
    ]
    return "\n".join(lines) + "\n"


def main(arguments: list[str]) -> None:
    quick = "--quick" in arguments
    warm_up(MapSettings())
    threads = numba.get_num_threads()
    machine = {"one": ceilings(1, quick), "all": ceilings(threads, quick)}
    tables: dict[str, list[Row]] = {}
    figures: list[Figure] = []
    for title, measure in (("A whole map at once", whole), ("One update", update)):
        measured, units = measure(quick)
        name = f"{title}: {units['stale voxels']:,.0f} stale voxels, {units['points']:,.0f} points"
        tables[name] = rows_of(measured, units, machine["one"], machine["all"])
        for row in tables[name]:
            factor = row.measured_ms / row.floor_ms if row.floor_ms else float("nan")
            text = f"{row.measured_ms:,.2f} ms, {factor:.1f} x the floor ({row.bound})"
            figures.append(Figure(f"{title}: {row.stage}", text))
    if not quick:
        PAGE.write_text(page(machine, tables, threads, quick), encoding="utf-8")
    details: dict[str, Any] = {"machine": machine, "quick": quick}
    details["tables"] = {k: [r._asdict() for r in rows] for k, rows in tables.items()}
    report(name_of("ceiling", quick), "Where the time goes", figures, details)


if __name__ == "__main__":
    main(sys.argv[1:])
