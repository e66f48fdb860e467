"""Buildings as large as wanted: the simulated office again and again, side by side and on floors.

What the sensor truly meets is cast once and kept in out/benchmarks; every copy and every pass has
a noise of its own.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from facet.simulate import Noise, Sensor, Simulation
from facet.simulate.sensors import lidar3d, pushbroom
from facet_protocol.messages import Pose, Scan, ScanKind

CACHE = Path(__file__).parents[2] / "out" / "benchmarks"
NOISE = Noise(0.012, 0.008)
PERIOD_NS = 100_000_000
STEP_M = (31.37, 23.11, 4.13)  # from copy to copy; no multiple of a voxel
ROW, FLOOR = 3, 6  # copies in a row, and on a floor
ROOM = slice(0, 12)  # looks of `stretch` are this close together: one room and what it sees

LIDAR_32K = {"rings": 32, "columns": 1000}
LIDAR_130K = {"rings": 64, "columns": 2032}
LINE_361 = {"fan_deg": 180.0, "beams": 361}


@dataclass(frozen=True, eq=False)
class Looks:
    """True looks of one drive: beams without noise."""

    kind: ScanKind
    positions: NDArray[np.float64]  # (S, 3) m
    orientations: NDArray[np.float64]  # (S, 4) xyzw
    beams: NDArray[np.float32]  # (S, N, 3) unit, sensor frame
    ranges: NDArray[np.float32]  # (S, N) m, inf: nothing came back
    reach_m: float

    def __len__(self) -> int:
        return len(self.positions)

    def scan(self, index: int, copy: int = 0, draw: int = 0, robot: str = "bench") -> Scan:
        """Look `index` in copy `copy` of the building; each `draw` has another noise."""
        rng = np.random.default_rng((index, copy, draw))
        shift = rng.normal(0.0, NOISE.pose_m, 3) + place(copy)
        ranges, beams = self.ranges[index], self.beams[index]
        hit = np.isfinite(ranges)
        noisy = ranges[hit] + rng.normal(0.0, NOISE.range_m, int(hit.sum())).astype(np.float32)
        sequence = 1 + index + len(self) * (draw + 1000 * copy)
        return Scan(
            robot, self.kind.value, 1, sequence, PERIOD_NS * sequence, "map", self.kind,
            Pose(self.positions[index] + shift, self.orientations[index]),
            beams[hit] * noisy[:, None], beams[~hit] * np.float32(self.reach_m),
        )  # fmt: skip

    def scans(self, copy: int = 0, draw: int = 0) -> Iterator[Scan]:
        return (self.scan(index, copy, draw) for index in range(len(self)))


def place(copy: int) -> NDArray[np.float64]:
    """(3,) m: where a copy of the building stands."""
    return np.array([copy % ROW, copy // ROW % (FLOOR // ROW), copy // FLOOR]) * STEP_M


def office(num_scans: int = 300, **lidar: int) -> Looks:
    """The whole drive through the office with a rotating scanner, 32,000 beams by default."""
    options = lidar or LIDAR_32K
    return _looks(f"office-{options['rings'] * options['columns']}", lidar3d(**options), num_scans)


def line(num_scans: int) -> Looks:
    """The first scans of a flat scanner of 361 beams at its own rate."""
    sensor = pushbroom(**LINE_361)  # type: ignore[arg-type]
    return _looks("line-361", sensor, None, duration_s=num_scans / sensor.rate_hz)


def stretch(seconds: float, **lidar: int) -> Looks:
    """The first seconds of the drive at the robot's own rate and speed: 10 Hz, 1 m/s."""
    options = lidar or LIDAR_32K
    name = f"stretch-{options['rings'] * options['columns']}"
    return _looks(name, lidar3d(**options), None, duration_s=seconds)


def _looks(name: str, sensor: Sensor, num_scans: int | None, **options: Any) -> Looks:
    simulation = Simulation("office", sensor, num_scans=num_scans, **options)
    path = CACHE / f"{name}-{len(simulation)}.npz"
    if not path.exists():
        CACHE.mkdir(parents=True, exist_ok=True)
        seen = [simulation.look(index) for index in range(len(simulation))]
        np.savez(
            path,
            positions=np.stack([look.position for look in seen]),
            orientations=np.stack([look.orientation_xyzw for look in seen]),
            beams=np.stack([look.beams for look in seen]).astype(np.float32),
            ranges=np.stack([look.ranges for look in seen]).astype(np.float32),
        )
    with np.load(path) as kept:
        return Looks(sensor.kind, *(kept[k] for k in _COLUMNS), simulation.reach_m)


_COLUMNS = ("positions", "orientations", "beams", "ranges")
