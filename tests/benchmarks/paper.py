"""The paper's three sets, simulated: its report (Table 3) beside ours, what is discarded, the time.

The columns of the paper are those of Martin Nevado, Gomez Garcia-Bermejo and Zalama Casanova,
Robotics and Autonomous Systems 48 (2004) 131-143, Table 3 and the prose beside it; "?" where no
copy of that cell is at hand. Its scenes are not public: ours are of the same size and kind.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace

from benchmarks.figures import Figure, at_most, report
from facet.commands.terminal import table
from facet.mapping.mapper import Mapper
from facet.mapping.report import MapCounts, StageReport
from facet.mapping.settings import MapSettings
from facet.pipeline import Stopwatch
from facet.simulate import Noise
from facet.simulate.sensors import pushbroom
from facet.warmup import warm_up
from facet_protocol.messages import Scan
from scenes import Driven, drive
from scorer import Score, model_of, score


@dataclass(frozen=True)
class Published:
    """What the paper says of one of its sets."""

    name: str
    planes: tuple[str, str, str, str]
    cells: tuple[str, str, str, str]  # its report, stage by stage
    seconds: float
    discarded_percent: float


@dataclass(frozen=True)
class Case:
    """A scene as large as one of the paper's, and the settings it is mapped with."""

    scene: str
    num_beams: int  # of the whole drive; some meet glass and come back empty
    theta_deg: float
    detail_level: float
    voxel_m: (
        float  # about the point spacing, 1 to 1.5 points a voxel: "every voxel" = "every point"
    )
    beams: int  # of a scan, a full turn: along the drive and across it about as dense
    published: Published


NOISE = Noise(range_m=0.015, pose_m=0.008)
CASES = (
    Case(
        "corridor", 12_160, 9.0, 0.98, 0.10, 80,
        Published("corridor", ("?",) * 4,
                  ("aligned ?, thick 12.3 %", "2 sigma_n 4.0 cm", "min. occ. 20", "disc. 7.2 %"),
                  38.0, 7.2),
    ),
    Case(
        "hall", 16_050, 12.0, 0.98, 0.10, 100,
        Published("CARTIF hall", ("511", "172", "54", "38"),
                  ("aligned 11.6 %, thick 19.6 %", "2 sigma_n 5.0 cm",
                   "reached 98.1 %, min. occ. 39", "disc. 12.1 %"), 266.0, 12.1),
    ),
    Case(
        "hall85k", 90_200, 15.0, 0.99, 0.08, 180,
        Published("CMU Wean hall", ("582", "89", "23", "20"),
                  ("aligned 0.6 %, thick 32.9 %", "2 sigma_n 5.5 cm",
                   "reached 99 %, min. occ. 92", "disc. 10.02 %"), 682.0, 10.02),
    ),
)  # fmt: skip
LIMIT_S = 2.0


@dataclass(frozen=True)
class Mapped:
    mapper: Mapper
    report: StageReport
    counts: MapCounts
    seconds: float
    stage_ms: dict[str, float]


def drive_case(case: Case) -> Driven:
    """As many scans as `num_beams` allows, spread over the whole drive."""
    sensor = pushbroom(fan_deg=360.0, beams=case.beams)
    return drive(case.scene, sensor, noise=NOISE, max_points=case.num_beams)


def map_case(case: Case, scans: Sequence[Scan]) -> Mapped:
    """Points to contours, timed; kernels are compiled before."""
    settings = MapSettings(
        voxel_m=case.voxel_m, theta_deg=case.theta_deg, detail_level=case.detail_level
    )
    warm_up(settings)
    mapper, stopwatch = Mapper(settings), Stopwatch()
    started = time.perf_counter()
    for scan in scans:
        mapper.insert(scan)
    stopwatch("insert")
    mapper.update(stopwatch)
    seconds = time.perf_counter() - started
    return Mapped(mapper, mapper.report(), mapper.counts(), seconds, dict(stopwatch.stage_ms))


def show(case: Case, mapped: Mapped) -> None:
    """The four stages: ours, the paper's."""
    published, own = case.published, mapped.report.rows
    rows = [
        ("planes, ours", *own[1][1:]),
        (f"planes, {published.name}", *published.planes),
        ("report, ours", *own[2][1:]),
        (f"report, {published.name}", *published.cells),
    ]
    title = (
        f"{case.scene}: {mapped.counts.points_in:,} points, {mapped.counts.voxels:,} voxels of "
        f"{100 * case.voxel_m:g} cm, theta {case.theta_deg:g}, detail level {case.detail_level:g}"
    )
    table(title, own[0], rows)


def judge(case: Case, mapped: Mapped, scored: Score) -> list[Figure]:
    name, found, most = case.scene, mapped.report, case.published.discarded_percent
    paper_s = case.published.seconds
    surfaces = f"{scored.num_found} / {len(scored.surfaces)}"
    return [
        Figure(f"{name}: points", mapped.counts.points_in),
        Figure(f"{name}: points per voxel", mapped.counts.points_in / mapped.counts.voxels),
        at_most(f"{name}: discarded points", found.discarded_points_percent, most, "%"),
        Figure(f"{name}: discarded voxels, %", found.discarded_percent),
        at_most(f"{name}: points to contours (paper {paper_s:g} s)", mapped.seconds, LIMIT_S, "s"),
        Figure(f"{name}: surfaces found", surfaces),
        Figure(f"{name}: planes (truth {scored.truth_planes})", scored.planes),
        Figure(f"{name}: splits, merges", f"{len(scored.splits)}, {len(scored.merges)}"),
        Figure(f"{name}: area recall", scored.area_recall),
        Figure(f"{name}: area precision", scored.area_precision),
    ]


def main(arguments: list[str]) -> None:
    """`paper.py [--quick | SCENE [VOXEL_M]]`: one scene, another voxel."""
    if "--quick" in arguments:
        arguments = ["corridor"]
    chosen = [c for c in CASES if not arguments or c.scene == arguments[0]]
    if len(arguments) > 1:
        chosen = [replace(c, voxel_m=float(arguments[1])) for c in chosen]
    figures, details = [], {}
    for case in chosen:
        driven = drive_case(case)
        mapped = map_case(case, driven.scans)
        show(case, mapped)
        figures += judge(case, mapped, score(model_of(mapped.mapper.snapshot()), driven.truth))
        details[case.scene] = {
            "case": asdict(case),
            "report": mapped.report.as_dict(),
            "counts": mapped.counts.as_dict(),
            "seconds": mapped.seconds,
            "stage_ms": mapped.stage_ms,
        }
    report("paper", "The paper's sets", figures, {"noise": asdict(NOISE), "cases": details})


if __name__ == "__main__":
    main(sys.argv[1:])
