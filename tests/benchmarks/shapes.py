"""What is round and what is not: columns and curved faces, bays, pillars of many faces."""

from __future__ import annotations

import sys
from typing import Any

import numpy as np
import shapely

from benchmarks.figures import Figure, report
from benchmarks.truth import CASES, map_drive
from facet.commands.terminal import table
from facet.simulate import Scene, Simulation
from facet.simulate.drive import Drive
from facet.simulate.surfaces import TruthSurface, box, level_rectangle, room_walls, wall
from scenes import prism
from scorer import model_of, score

HEIGHT = 2.7
SIZE = (0.0, 14.0), (0.0, 10.0)
DRAWS = 2
WAYPOINTS = [
    (1, 1), (5, 1), (5, 4), (1.2, 5), (1.2, 8.8), (4.6, 9.1), (5, 6.6), (7, 6.6), (8.6, 6.6),
    (9, 9), (12.9, 9), (13.2, 5), (12.9, 1), (8.7, 1), (8.8, 3.2), (7, 3.2), (5.2, 2.2),
]  # fmt: skip
OUTLINE = [  # of a room with bays at 45, 30 and 45 degrees
    (0, 0), (3, 0), (3.57, -0.57), (4.57, -0.57), (5.14, 0), (9, 0), (9.5, -0.29), (10.2, -0.29),
    (10.7, 0), (14, 0), (14, 3), (14.35, 3.35), (14.35, 4.05), (14, 4.4), (14, 10), (0, 10),
]  # fmt: skip


def columns() -> Scene:
    """Round columns of 0.25 to 1.5 m, and two square pillars."""
    surfaces = [
        *_levels(),
        *room_walls("room", *SIZE, (0.0, HEIGHT), {}),
        *prism("round 25", (3, 3), 0.25, 24, height=HEIGHT, planar=False),
        *prism("round 40", (3, 7), 0.40, 24, height=HEIGHT, planar=False),
        *prism("round 80", (7, 5), 0.80, 24, height=HEIGHT, planar=False),
        *prism("round 150", (11, 5), 1.50, 36, height=HEIGHT, planar=False),
        *box("pillar 40", (6.8, 7.2), (8.0, 8.4), (0.0, HEIGHT), "SWNE"),
        *box("pillar 60", (6.7, 7.3), (1.2, 1.8), (0.0, HEIGHT), "SWNE"),
    ]
    return _driven("columns", surfaces)


def faces() -> Scene:
    """Bays, and pillars of six, eight and twelve faces."""
    surfaces = [
        *_levels(),
        *_walls(),
        *_pillar("six 30", (3, 3), 0.3, 6),
        *_pillar("six 50", (3, 7), 0.5, 6),
        *_pillar("eight 40", (7, 5), 0.4, 8),
        *_pillar("eight 60", (11, 5), 0.6, 8),
        *_pillar("twelve 40", (7, 8.3), 0.4, 12),
    ]
    return _driven("faces", surfaces)


def _levels() -> list[TruthSurface]:
    across, along = SIZE[0], (-1.0, 10.0)
    return [
        level_rectangle("floor", across, along, 0.0, looks_up=True),
        level_rectangle("ceiling", across, along, HEIGHT, looks_up=False),
    ]


def _walls() -> list[TruthSurface]:
    """Walked so that the room is on the right: the outline runs the other way."""
    corners = [(float(x), float(y)) for x, y in OUTLINE[::-1]]
    assert not shapely.LinearRing(corners).is_ccw
    ends = zip(corners, [*corners[1:], corners[0]], strict=True)
    return [wall(f"wall {i}", start, end, (0.0, HEIGHT)) for i, (start, end) in enumerate(ends)]


def _pillar(name: str, centre: tuple[float, float], side: float, number: int) -> list[TruthSurface]:
    radius = side / 2.0 / np.sin(np.pi / number)
    return prism(name, centre, float(radius), number, height=HEIGHT, planar=True)


def _driven(name: str, surfaces: list[TruthSurface]) -> Scene:
    drive = Drive(np.array([(x, y, 0.0) for x, y in WAYPOINTS]))
    return Scene(name, tuple(surfaces), drive).moved(12.0, (1.3, -2.1, 0.3))


def main(arguments: list[str]) -> None:
    """`shapes.py [--quick]`: one sensor, few scans."""
    quick = "--quick" in arguments
    figures: list[Figure] = []
    rows: list[tuple[Any, ...]] = []
    for case in CASES[: 1 if quick else None]:
        for scene in (columns(), faces()):
            for seed in range(1 if quick else DRAWS):
                num_scans = 60 if quick else None
                simulation = Simulation(
                    scene, case.sensor, noise=case.noise, seed=seed, num_scans=num_scans
                )
                mapper, truth, _ = map_drive(simulation)
                scored = score(model_of(mapper.snapshot()), truth)
                round_m2 = sum(s.seen_m2 for s in truth.surfaces if not s.planar)
                name = f"{scene.name}, {case.sensor}, draw {seed}"
                figures.append(
                    Figure(f"{name}: of {len(scored.surfaces)} faces, found", scored.num_found)
                )
                if round_m2:
                    what = f"{name}: of {round_m2:.0f} m2 round, on planes"
                    figures.append(Figure(what, scored.curved_m2))
                rows.append((name, ", ".join(scored.missing)))
    table("Faces not found", ("", "which"), rows)
    report("shapes", "What is round and what is not", figures, {})


if __name__ == "__main__":
    main(sys.argv[1:])
