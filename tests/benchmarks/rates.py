"""One core: points a second into the store, free space, replay, the paper's largest set.

Stages are timed apart, scan by scan, in a map that has seen the place before (mapped) and in one
that has not (exploring).
"""

from __future__ import annotations

import itertools
import tempfile
import time
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks import buildings, paper
from benchmarks.buildings import LIDAR_130K, Looks
from benchmarks.figures import Figure, at_least, at_most
from facet.commands.replay import replay_log
from facet.commands.simulate import envelope_of
from facet.config import load_config
from facet.mapping.freespace import FreeSpace
from facet.mapping.mapper import Mapper
from facet.mapping.quantise import quantise
from facet.mapping.settings import MapSettings
from facet.mapping.store import VoxelStore
from facet.simulate import Noise, Simulation
from facet.sinks.log_file import write_recording

PASSES = 4
Detail = dict[str, Any]


def insert(quick: bool) -> tuple[list[Figure], Detail]:
    """Quantise and store, without free space; then free space alone."""
    few = 10 if quick else 1
    cases = (
        ("361", buildings.line(400 // few), 3.0, None),
        ("32 k", buildings.office(100 // few), 8.0, None),
        ("130 k", buildings.office(30 // few, **LIDAR_130K), 10.0, 8.0),
    )
    figures: list[Figure] = []
    details: Detail = {}
    for name, looks, least, most_ms in cases:
        passes = _passes(looks)
        rates = [points / (quantised + stored) * 1e-6 for points, quantised, stored, _ in passes]
        free_ms = np.median([row[3] for row in passes[1:]], axis=0) * 1e3
        explored, quantised, stored, _ = passes[0].sum(axis=1)
        exploring = float(explored / (quantised + stored) * 1e-6)  # as a whole: the store grows
        mapped = float(np.median(rates[1:]))
        figures += [
            at_least(f"insert, scans of {name}, mapped, M points/s", mapped, least),
            at_least(f"insert, scans of {name}, exploring, M points/s", exploring, least),
        ]
        free = f"free space of one scan of {name}, mapped"
        typical = float(np.median(free_ms))
        figures.append(
            at_most(free, typical, most_ms, "ms") if most_ms else Figure(f"{free}, ms", typical)
        )
        details[name] = {
            "points": float(np.median(passes[0][0])),
            "quantise_ms": [float(np.median(row[1]) * 1e3) for row in passes],
            "store_ms": [float(np.median(row[2]) * 1e3) for row in passes],
            "free_ms": [float(np.median(row[3]) * 1e3) for row in passes],
        }
    return figures, {"insert": details}


def _passes(looks: Looks) -> list[np.ndarray[Any, np.dtype[np.float64]]]:
    """By pass (4, S): points, seconds of quantise, store and free space of each scan."""
    settings, store, free = MapSettings(), VoxelStore(), FreeSpace()
    passes = []
    for draw in range(PASSES):
        rows = []
        for scan in list(looks.scans(draw=draw)):
            marks = [time.perf_counter()]
            ticks = quantise([scan], settings)
            marks.append(time.perf_counter())
            store.insert(ticks)
            marks.append(time.perf_counter())
            free.insert(ticks)
            marks.append(time.perf_counter())
            rows.append((len(ticks.points), *np.diff(marks)))
        store.settle()
        passes.append(np.array(rows).T)
    return passes


def replay(quick: bool) -> tuple[list[Figure], Detail]:
    """`facet replay LOG --update-every 5` of a line scanner and of a lidar."""
    figures, details = [], {}
    for sensor, least, seconds in (("pushbroom", 50.0, 120.0), ("lidar3d", 5.0, 30.0)):
        duration = seconds / 10 if quick else seconds
        with tempfile.TemporaryDirectory(prefix="facet-replay-") as folder:
            log = Path(folder) / "log.mcap"
            simulation = Simulation(
                "office", sensor, noise=Noise(0.012, 0.008), duration_s=duration
            )
            write_recording(log, (envelope_of(m, "map") for m in simulation.messages()), {}, "lz4")
            runs = [replay_log([log], load_config(None), update_every="5") for _ in range(5)]
        speeds = sorted(duration / run.wall_s for run in runs)
        name = f"replay, {sensor}, {simulation.sensor.rate_hz:g} Hz, times real time"
        figures.append(at_least(name, speeds[2], least))
        details[sensor] = {"speeds": speeds, "log_s": duration}
    return figures, {"replay": details}


def papers(quick: bool) -> tuple[list[Figure], Detail]:
    """The paper's 85,000 points, from points to contours, warm."""
    case = next(c for c in paper.CASES if c.scene == "hall85k")
    driven = paper.drive_case(case)
    runs = [paper.map_case(case, driven.scans) for _ in range(3 if quick else 7)]
    seconds = sorted(run.seconds for run in runs)
    middle = float(np.median(seconds))
    stages = {
        name: float(np.median([run.stage_ms[name] for run in runs])) for name in runs[0].stage_ms
    }
    figure = at_most("the paper's 85 k points, points to contours", middle, 0.5, "s")
    return [figure], {"paper": {"seconds": seconds, "stage_ms": stages}}


def whole_insert(quick: bool) -> tuple[list[Figure], Detail]:
    """Mapper.insert as the service calls it: all that a scan costs before any update."""
    figures = []
    for name, looks in (("361", buildings.line(400)), ("32 k", buildings.office(100))):
        mapper = Mapper()
        scans = list(itertools.islice(looks.scans(), 10 if quick else None))
        for scan in scans:
            mapper.insert(scan)
        rates = []
        for scan in scans:
            started = time.perf_counter()
            mapper.insert(scan)
            rates.append(len(scan.points) / (time.perf_counter() - started) * 1e-6)
        what = f"Mapper.insert, scans of {name}, with free space, M points/s"
        figures.append(Figure(what, float(np.median(rates))))
    return figures, {}
