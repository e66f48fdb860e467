"""Rates and costs of the core: insert, normals, the map by stage, updates of a growing map."""

from __future__ import annotations

import sys
import time
from typing import Any

import numpy as np

from benchmarks.figures import Figure, at_most, report
from facet.commands.terminal import table
from facet.mapping.mapper import Mapper
from facet.mapping.settings import MapSettings
from facet.pipeline import Stopwatch
from facet.simulate import Noise, Simulation
from facet.warmup import warm_up
from facet_protocol.messages import Scan

NUM_SCANS = 300  # of the whole drive through the office
GROWING_S = 15.0  # of the drive at its own rate, one update a scan
MARKS = (10, 30, 70, 100, 149)
WORK = ("stale_voxels", "blocks_regrouped", "tiles_regrouped", "outline_tiles", "planes_changed")


def whole(scans: list[Scan]) -> tuple[list[Figure], dict[str, Any]]:
    """Everything once: insert all, derive all."""
    mapper = Mapper()
    started = time.perf_counter()
    for scan in scans:
        mapper.insert(scan)
    insert_s = time.perf_counter() - started
    stopwatch = Stopwatch()
    mapper.update(stopwatch)
    counts, stages = mapper.counts(), dict(stopwatch.stage_ms)
    figures = [
        Figure("insert, M points/s", counts.points_in / insert_s / 1e6),
        Figure("insert, ms a scan", 1e3 * insert_s / len(scans)),
        Figure("normals, thousand voxels/s", counts.voxels / stages["normals"]),
        Figure(f"derive {counts.voxels:,} voxels at once, s", sum(stages.values()) * 1e-3),
        *(Figure(f"  {stage}, ms", ms) for stage, ms in stages.items()),
    ]
    return figures, {"voxels": counts.voxels, "points": counts.points_in, "stage_ms": stages}


def growing(scans: list[Scan]) -> tuple[list[Figure], list[dict[str, Any]]]:
    """An update after each scan: time and work as the map grows."""
    mapper, costs = Mapper(), []
    for scan in scans:
        started = time.perf_counter()
        mapper.insert(scan)
        stopwatch = Stopwatch()
        mapper.update(stopwatch)
        total_ms = (time.perf_counter() - started) * 1e3
        costs.append({"ms": total_ms, "stage_ms": dict(stopwatch.stage_ms), **mapper.work})
        costs[-1]["voxels"] = mapper.counts().voxels
    rows = []
    for k in (mark for mark in MARKS if mark < len(costs)):
        near = costs[max(0, k - 5) : k + 5]
        mean = {key: float(np.mean([c[key] for c in near])) for key in ("ms", "voxels", *WORK)}
        rows.append((k, round(mean["voxels"]), mean["ms"], *(mean[w] for w in WORK)))
    table("a growing map, means of ten updates", ("scan", "voxels", "ms", *WORK), rows)
    early, late = costs[20:40], costs[-20:]
    share = float(np.mean([c["stale_voxels"] / c["voxels"] for c in late]))
    figures = [
        Figure("update after scans 20 to 40, ms", float(np.mean([c["ms"] for c in early]))),
        Figure(
            f"update after the last of {len(costs)}, ms", float(np.mean([c["ms"] for c in late]))
        ),
        at_most("stale share of the map, last scans", share, 0.25),
    ]
    return figures, costs


def main(arguments: list[str]) -> None:
    """`speed.py [--quick]`."""
    quick = "--quick" in arguments
    warm_up(MapSettings())
    noise = Noise(0.012, 0.008)
    num_scans, growing_s = (30, 3.0) if quick else (NUM_SCANS, GROWING_S)
    scans = list(Simulation("office", "lidar3d", noise=noise, num_scans=num_scans).scans())
    figures, derived = whole(scans)
    del scans
    drive = Simulation("office", "lidar3d", noise=noise, duration_s=growing_s)
    grown, costs = growing(list(drive.scans()))
    report("speed", "Speed of the core", figures + grown, {"whole": derived, "growing": costs})


if __name__ == "__main__":
    main(sys.argv[1:])
