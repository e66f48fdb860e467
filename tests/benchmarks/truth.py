"""A simulated office against its exact truth: two sensors, the whole drive, default settings. One
draw of the noise is judged; what others give stands beside it."""

from __future__ import annotations

import sys
import time
from dataclasses import dataclass
from typing import Any

import numpy as np

from benchmarks.figures import Figure, at_least, at_most, none_of, report
from facet.commands.terminal import out, table
from facet.mapping.mapper import Mapper
from facet.mapping.settings import MapSettings
from facet.pipeline import Stopwatch
from facet.simulate import Noise, Observer, Simulation, Truth
from facet.warmup import warm_up
from facet_protocol.messages import LineFan
from facet_protocol.scans import project
from scorer import Score, model_of, score

SMALL_M2 = 1.0  # surfaces under it may be off by 2 degrees
SHOWN = {
    "area recall": "recall",
    "area precision": "precision",
    "angle, worst": "deg",
    "angle, worst under 1 m2": "deg, small",
    "offset, worst": "mm",
    "planes": "planes",
    "splits": "splits",
    "curved area on planes": "curved m2",
}
DRAWS = 5  # of the noise; the first is judged


@dataclass(frozen=True)
class Case:
    sensor: str
    noise: Noise
    least_recall: float


CASES = (
    Case("lidar3d", Noise(0.012, 0.008), 0.98),
    Case("pushbroom", Noise(0.015, 0.008), 0.97),
)
ALSO = Case("depth", Noise(0.012, 0.008), 0.97)  # nobody asked: judged as the others are


def map_drive(simulation: Simulation) -> tuple[Mapper, Truth, dict[str, float]]:
    """Every beam is cast once, no scan is kept. Times in seconds, by stage."""
    settings = MapSettings()
    warm_up(settings)
    mapper, observer, insert_s = Mapper(settings), Observer(simulation), 0.0
    for index in range(len(simulation)):
        look = simulation.look(index)
        observer.watch(look)
        message = simulation.message(look)
        scan = project(message, simulation.reach_m) if isinstance(message, LineFan) else message
        started = time.perf_counter()
        mapper.insert(scan)
        insert_s += time.perf_counter() - started
    stopwatch = Stopwatch()
    mapper.update(stopwatch)
    stages = {stage: ms * 1e-3 for stage, ms in stopwatch.stage_ms.items()}
    return mapper, observer.truth(), {"insert": insert_s, **stages}


def judge(case: Case, scored: Score) -> list[Figure]:
    found = [s for s in scored.surfaces if s.found]
    angles = np.array([s.angle_deg for s in found])
    offsets = 1e3 * np.abs([s.offset_m for s in found])
    large = np.array([s.seen_m2 >= SMALL_M2 for s in found])
    sides = f"{len(scored.thin_walls)} thin walls with a face lost"
    figures = [
        none_of(f"of {len(scored.surfaces)} surfaces, not found", scored.missing),
        at_least("area recall", scored.area_recall, case.least_recall),
        at_least("area precision", scored.area_precision, 0.99),
        at_most("angle, median", float(np.median(angles)), 0.1, "deg"),
        at_most("angle, worst", float(np.max(angles[large])), 1.0, "deg"),
        at_most("angle, worst under 1 m2", float(np.max(angles[~large], initial=0)), 2.0, "deg"),
        at_most("offset, median", float(np.median(offsets)), 1.0, "mm"),
        at_most("offset, worst", float(np.max(offsets)), 5.0, "mm"),
        at_most("planes", scored.planes, len(scored.surfaces), "surfaces"),
        Figure("planes, if all coplanar surfaces were one", scored.truth_planes),
        none_of("splits", scored.splits),
        none_of("merges", [" + ".join(pair) for pair in scored.merges]),
        none_of(f"of {sides}", [" | ".join(pair) for pair in scored.thin_walls_lost]),
        at_least(f"of {len(scored.openings)} openings, found", scored.openings_found, 0.95),
        Figure("openings that are none", scored.openings_false),
        at_most("curved area on planes", scored.curved_m2, 0.05, "m2"),
    ]
    return [Figure(f"{case.sensor}: {f.what}", f.value, f.target, f.met) for f in figures]


def other_draws(case: Case) -> list[dict[str, Any]]:
    """What came out with other noise, one entry for each draw."""
    found: list[dict[str, Any]] = []
    for seed in range(1, DRAWS):
        mapper, truth, _ = map_drive(Simulation("office", case.sensor, noise=case.noise, seed=seed))
        scored = score(model_of(mapper.snapshot()), truth)
        values = {f.what.removeprefix(f"{case.sensor}: "): f.value for f in judge(case, scored)}
        own = {"draw": seed, **{short: values[name] for name, short in SHOWN.items()}}
        found.append(own | {"missed": ", ".join(scored.missing)})
    return found


def main(arguments: list[str]) -> None:
    """`truth.py [--quick | SENSOR [NUM_SCANS]]`: one sensor, fewer scans, one draw of the noise."""
    is_whole = not arguments
    if "--quick" in arguments:
        arguments = ["lidar3d", "200"]
    figures: list[Figure] = []
    details: dict[str, Any] = {}
    for case in (c for c in (*CASES, ALSO) if not arguments or c.sensor == arguments[0]):
        num_scans = int(arguments[1]) if len(arguments) > 1 else None
        simulation = Simulation("office", case.sensor, noise=case.noise, num_scans=num_scans)
        mapper, truth, seconds = map_drive(simulation)
        scored, counts = score(model_of(mapper.snapshot()), truth), mapper.counts()
        title = f"office, {case.sensor}: {counts.scans:,} scans, {counts.points_in:,} points"
        out.print(f"{title}, {counts.voxels:,} voxels\n{scored.table()}\n")
        figures += judge(case, scored)
        update_s = sum(seconds.values()) - seconds["insert"]
        figures += [
            Figure(
                f"{case.sensor}: insert, M points/s", counts.points_in / seconds["insert"] / 1e6
            ),
            Figure(f"{case.sensor}: derive it all, s", update_s),
            Figure(f"{case.sensor}: discarded points, %", mapper.report().discarded_points_percent),
        ]
        others = other_draws(case) if is_whole else []
        if others:
            rows = [own.values() for own in others]
            table(f"{case.sensor}: other draws of the noise", others[0], rows)
        details[case.sensor] = {
            "noise": {"range_m": case.noise.range_m, "pose_m": case.noise.pose_m},
            "settings": mapper.settings.as_dict(),
            "counts": counts.as_dict(),
            "seconds": seconds,
            "table": scored.table(),
            "worst": [vars(s) for s in sorted(scored.surfaces, key=lambda s: -s.angle_deg)[:8]],
            "other draws": others,
        }
    report("truth", "Against the truth", figures, {"cases": details})


if __name__ == "__main__":
    main(sys.argv[1:])
