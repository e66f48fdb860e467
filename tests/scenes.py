"""Scans with their truth for the tests: simulated ones, kept for the session, and real ones."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from facet.simulate import SCENES, SENSORS, Noise, Observer, Scene, Sensor, Simulation, Truth
from facet.simulate.drive import Drive
from facet.simulate.surfaces import Opening, TruthSurface, box, level_rectangle, room_walls, wall
from facet_protocol.messages import LineFan, Pose, Scan, ScanKind
from facet_protocol.scans import project

SHARED_DATA = Path(__file__).parents[2] / "shared" / "data"


@dataclass(frozen=True, eq=False)
class Driven:
    """A simulation that was run; its messages are LineFans for a LINE sensor."""

    simulation: Simulation
    scans: tuple[Scan, ...]
    messages: tuple[Scan | LineFan, ...]
    truth: Truth


def drive(
    scene: str | Scene, sensor: str | Sensor, *, noise: Noise | None = None, **options: Any
) -> Driven:
    """Run a simulation, casting each beam once."""
    simulation = Simulation(scene, sensor, noise=noise or Noise(), **options)
    observer = Observer(simulation)
    messages = []
    for index in range(len(simulation)):
        look = simulation.look(index)
        observer.watch(look)
        messages.append(simulation.message(look))
    scans = tuple(project(m, simulation.reach_m) if isinstance(m, LineFan) else m for m in messages)
    return Driven(simulation, scans, tuple(messages), observer.truth())


@cache
def driven(scene: str, sensor: str, num_scans: int, seed: int = 0) -> Driven:
    """A small drive through a scene ("room" or one of SCENES), made once a session."""
    made = room() if scene == "room" else SCENES[scene]()
    return drive(made, small(sensor), num_scans=num_scans, seed=seed)


def small(sensor: str) -> Sensor:
    """A sensor with few beams, so that many scans of it are a small test."""
    if sensor == "lidar3d":
        return SENSORS[sensor](rings=32, columns=256)
    if sensor == "depth":
        return SENSORS[sensor](width=80, height=60)
    return SENSORS[sensor]()


def room() -> Scene:
    """The smallest scene with something of everything: 5 x 4 x 2.5 m, a door, glass, a box."""
    openings = {
        "N": [Opening("door", 3.0, 3.9, 0.0, 2.1)],
        "S": [Opening("glass", 1.0, 2.6, 0.9, 2.1)],
    }
    size = (0.0, 5.0), (0.0, 4.0)
    surfaces = [
        level_rectangle("floor", *size, 0.0, looks_up=True),
        level_rectangle("ceiling", *size, 2.5, looks_up=False),
        *room_walls("room", *size, (0.0, 2.5), openings),
        *box("box", (4.0, 5.0), (0.0, 1.2), (0.0, 0.8), "WNT"),
    ]
    waypoints = [
        (1.0, 1.2, 0.0),
        (3.2, 1.3, 0.0),
        (3.4, 2.6, 0.0),
        (1.2, 2.8, 0.0),
        (0.9, 1.6, 0.0),
    ]
    return Scene("room", tuple(surfaces), Drive(np.array(waypoints))).moved(12.0, (-1.3, 0.7, 0.2))


def columns() -> Scene:
    """7 x 5 x 2.5 m with a round column and a pillar of six faces, each half a metre wide."""
    size = (0.0, 7.0), (0.0, 5.0)
    surfaces = [
        level_rectangle("floor", *size, 0.0, looks_up=True),
        level_rectangle("ceiling", *size, 2.5, looks_up=False),
        *room_walls("room", *size, (0.0, 2.5), {}),
        *prism("column", (2.2, 2.5), 0.6, 24, height=2.5, planar=False),
        *prism("pillar", (4.8, 2.5), 0.5, 6, height=2.5, planar=True),
    ]
    waypoints = [(1, 1, 0), (6, 0.9, 0), (6.1, 4.0, 0), (0.9, 4.1, 0), (0.8, 1.6, 0)]
    drive = Drive(np.array(waypoints, np.float64))
    return Scene("columns", tuple(surfaces), drive).moved(12.0, (-1.3, 0.7, 0.2))


def prism(
    name: str, centre: Sequence[float], radius: float, faces: int, *, height: float, planar: bool
) -> list[TruthSurface]:
    """The faces of an upright prism, seen from outside."""
    angle = np.linspace(0.3, 0.3 + 2.0 * np.pi, faces + 1)
    ring = np.asarray(centre) + radius * np.stack([np.cos(angle), np.sin(angle)], axis=1)
    corners = [(float(x), float(y)) for x, y in ring]
    return [
        wall(f"{name} {i}", corners[i], corners[i + 1], (0.0, height), planar=planar)
        for i in range(faces)
    ]


def recorded(name: str, limit: int | None = None) -> Iterator[Scan]:
    """Scans of ../shared/data/<name>.npz; skips the test when the file is not there."""
    path = SHARED_DATA / f"{name}.npz"
    if not path.exists():
        pytest.skip(f"no real recording {name}.npz beside the project")
    with np.load(path) as data:
        stamps, poses = data["stamp_ns"], data["T_world_sensor"]
        points, ends = data["points"], np.cumsum(data["lengths"])
    for k, (start, end) in enumerate(zip([0, *ends[:-1]], ends, strict=True)):
        if limit is not None and k >= limit:
            return
        pose = Pose(poses[k, :3, 3].copy(), quaternion_xyzw(poses[k, :3, :3]))
        yield Scan(
            "real", name, 1, k + 1, int(stamps[k]), "map", ScanKind.CLOUD, pose,
            points[start:end], np.empty((0, 3), dtype=np.float32),
        )  # fmt: skip


def quaternion_xyzw(R: NDArray[np.float64]) -> NDArray[np.float64]:
    """(4,) of a rotation matrix (3, 3): the largest component first (Shepperd 1978)."""
    squares = np.array([
        1 + R[0, 0] - R[1, 1] - R[2, 2],
        1 - R[0, 0] + R[1, 1] - R[2, 2],
        1 - R[0, 0] - R[1, 1] + R[2, 2],
        1 + R[0, 0] + R[1, 1] + R[2, 2],
    ])  # fmt: skip
    products = np.array([
        [squares[0], R[1, 0] + R[0, 1], R[2, 0] + R[0, 2], R[2, 1] - R[1, 2]],
        [R[1, 0] + R[0, 1], squares[1], R[2, 1] + R[1, 2], R[0, 2] - R[2, 0]],
        [R[2, 0] + R[0, 2], R[2, 1] + R[1, 2], squares[2], R[1, 0] - R[0, 1]],
        [R[2, 1] - R[1, 2], R[0, 2] - R[2, 0], R[1, 0] - R[0, 1], squares[3]],
    ])  # fmt: skip
    row = products[int(np.argmax(squares))]
    return np.asarray(row / np.linalg.norm(row))
