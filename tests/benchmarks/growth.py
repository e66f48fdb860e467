"""What an update costs in a small building and in a large one, at a standstill, and in memory."""

from __future__ import annotations

import gc
import time
from collections.abc import Iterator
from typing import Any

import numba
import numpy as np

from benchmarks import buildings, inside
from benchmarks.buildings import Looks
from benchmarks.figures import Figure, at_least, at_most
from benchmarks.machine import ceilings
from facet.commands.terminal import table
from facet.mapping.mapper import Mapper
from facet.pipeline import Stopwatch
from facet_protocol.messages import Scan

Detail = dict[str, Any]
RIPE = 200  # points a voxel in view, from which on a place counts as mapped
WHOLE = "planes"  # the stage that runs whole, over tile-planes
SMALL, LARGE = 500_000, 5_000_000  # voxels
MEASURED = 60  # scans, each followed by an update
STANDSTILL = 300
MEMORY_MARKS = (1.0, 2.0, 3.0, 4.0, 5.0)  # M voxels


def grow(mapper: Mapper, voxels: int, looks: Looks, sources: Iterator[Scan] | None = None) -> None:
    """Insert copies of the office until the map holds so many voxels; derive nothing."""
    for scan in sources or all_copies(looks):
        if inside.num_voxels(mapper) >= voxels:
            return
        mapper.insert(scan)


def all_copies(looks: Looks) -> Iterator[Scan]:
    copy = 0
    while True:
        yield from looks.scans(copy)
        copy += 1


def ripen(mapper: Mapper, near: Looks) -> float:
    """Drive the stretch until it is mapped. Returns the mean points of a voxel in view."""
    draw, probe = 0, near.scan(len(near) // 2, draw=10_000)
    while True:
        for scan in near.scans(draw=draw):
            mapper.insert(scan)
        draw += 1
        if draw % 8 == 0:
            mapper.update()
            seen = float(inside.forget_touched(mapper, probe).mean())
            if seen >= RIPE:
                return seen


def updates(quick: bool) -> tuple[list[Figure], Detail]:
    """The same scans into both maps in turn, an update after each."""
    sizes = (60_000, 180_000) if quick else (SMALL, LARGE)
    looks, near = buildings.office(30 if quick else 100), buildings.stretch(2.0)
    maps, ripe = [Mapper(), Mapper()], 0.0
    for mapper, size in zip(maps, sizes, strict=True):
        grow(mapper, size, looks)
        ripe = ripen(mapper, near)
        mapper.update()
    rows: list[list[Detail]] = [[], []]
    for k in range(10 if quick else MEASURED):
        scan = near.scan(k % len(near), draw=20_000 + k)
        for mapper, costs in zip(maps, rows, strict=True):
            costs.append(_cost(mapper, scan))
    voxels = [inside.num_voxels(mapper) for mapper in maps]
    _show(rows, voxels)
    return _judge(rows, voxels, ripe), {"updates": dict(zip(map(str, voxels), rows, strict=True))}


def _cost(mapper: Mapper, scan: Scan) -> Detail:
    """Milliseconds of one scan and its update, by stage, and the work counters."""
    started = time.perf_counter()
    mapper.insert(scan)
    insert_ms = (time.perf_counter() - started) * 1e3
    stopwatch, started = Stopwatch(), time.perf_counter()
    mapper.update(stopwatch)
    update_ms = (time.perf_counter() - started) * 1e3
    stages = dict(stopwatch.stage_ms)
    return {"insert": insert_ms, "update": update_ms, "stages": stages, "work": dict(mapper.work)}


def _show(rows: list[list[Detail]], voxels: list[int]) -> None:
    def middle(costs: list[Detail], part: str) -> dict[str, float]:
        return {k: float(np.median([c[part][k] for c in costs])) for k in costs[0][part]}

    heads = [f"{n / 1e6:.2g} M" for n in voxels]
    for part, title in (("stages", "stages of an update, ms, medians"), ("work", "its work")):
        small, large = (middle(costs, part) for costs in rows)
        table(title, ("", *heads), [(k, small[k], large[k]) for k in small])


def _judge(rows: list[list[Detail]], voxels: list[int], ripe: float) -> list[Figure]:
    local = [np.array([c["update"] - c["stages"].get(WHOLE, 0.0) for c in costs]) for costs in rows]
    totals = [np.array([c["update"] for c in costs]) for costs in rows]
    whole = np.array([c["stages"].get(WHOLE, 0.0) for c in rows[1]])
    sizes = [f"{n / 1e6:.2g} M voxels" for n in voxels]
    stale = np.median([c["work"]["stale_voxels"] for c in rows[1]])
    now = ceilings(numba.get_num_threads(), quick=False)  # a host's other guests may take a half
    return [
        Figure("this machine, now: streamed by all threads, GB/s", now["bytes"] / 1e9),
        Figure("the same: cache lines fetched at random, M/s", now["lines"] / 1e6),
        at_least("mean points of a voxel in view before", ripe, RIPE),
        Figure(f"update after a 32 k scan, {sizes[0]}, median, ms", float(np.median(totals[0]))),
        Figure(f"update after a 32 k scan, {sizes[1]}, median, ms", float(np.median(totals[1]))),
        at_most(
            f"the same, {sizes[1]} over {sizes[0]}, all but {WHOLE}, median of pairs",
            float(np.median(local[1] / local[0])), 1.2,
        ),
        at_most(f"stage {WHOLE}, {sizes[1]}", float(np.median(whole)), 15.0, "ms"),
        at_most(f"update, {sizes[1]}, p95", float(np.percentile(totals[1], 95)), 60.0, "ms"),
        Figure("stale voxels of such an update", float(stale)),
    ]  # fmt: skip


def standstill(quick: bool) -> tuple[list[Figure], Detail]:
    """The very same scan again and again; then a standing robot, whose every scan differs."""
    looks, near = buildings.office(30), buildings.stretch(2.0)
    mapper = Mapper()
    grow(mapper, 60_000 if quick else 300_000, looks)
    mapper.update()
    number, scan = 30 if quick else STANDSTILL, near.scan(0)
    same = [_cost(mapper, scan) for _ in range(number)]
    stands = [_cost(mapper, near.scan(0, draw=30_000 + k)) for k in range(number)]
    last = max(5, number // 10)
    ends = {name: costs[-last:] for name, costs in (("same", same), ("standing", stands))}
    ms = {name: float(np.median([c["update"] for c in end])) for name, end in ends.items()}
    stale = {
        name: float(np.median([c["work"]["stale_voxels"] for c in end]))
        for name, end in ends.items()
    }
    insert_ms = float(np.median([c["insert"] for c in ends["same"]]))
    figures = [
        Figure("the same scan: its first update, ms", same[0]["update"]),
        at_most(f"the same scan {number} times: update over insert", ms["same"] / insert_ms, 0.5),
        Figure(f"the same scan {number} times: update, ms", ms["same"]),
        Figure("  stale voxels", stale["same"]),
        Figure(f"a standing robot, {number} more scans: update, ms", ms["standing"]),
        Figure("  stale voxels", stale["standing"]),
        Figure("  insert, ms", insert_ms),
    ]
    series = {
        "same": [c["update"] for c in same], "standing": [c["update"] for c in stands]
    }  # fmt: skip
    return figures, {"standstill": series}


def memory(quick: bool) -> tuple[list[Figure], Detail]:
    """Resident memory as the map grows, all derived; its slope, without free space. The room for
    kept sums has a fixed size (100 MB): it is in use before the first mark."""
    marks = np.array((0.05, 0.1, 0.15, 0.2) if quick else MEMORY_MARKS) * 1e6
    looks, mapper = buildings.office(30 if quick else 100), Mapper()
    sources = all_copies(looks)
    mapper._normals._traces.entries[...] = 0  # of a fixed size: all of it from the start
    rows = []
    for mark in marks:
        grow(mapper, int(mark), looks, sources)
        mapper.update()
        gc.collect()
        rows.append((inside.num_voxels(mapper), inside.rss_bytes(), inside.free_bytes(mapper)))
    voxels, rss, free = np.array(rows, float).T
    slope = float(np.polyfit(voxels, rss - free, 1)[0])
    figures = [
        at_most("memory a voxel, slope, all but free space", slope, 160.0, "bytes"),
        Figure("free space a voxel, slope, bytes", float(np.polyfit(voxels, free, 1)[0])),
        Figure(f"resident at {voxels[-1] / 1e6:.2g} M voxels, MB", float(rss[-1] / 1e6)),
    ]
    return figures, {"memory": [list(map(int, row)) for row in rows]}
