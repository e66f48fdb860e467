"""Scans of a scene along its drive: beams cast, noise added. The same seed, the same scans."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from facet.simulate.raycast import Faces
from facet.simulate.scenes import SCENES, Scene
from facet.simulate.sensors import SENSORS, Sensor, about_z, multiply, rotation
from facet_protocol.messages import LineFan, Pose, Scan, ScanKind
from facet_protocol.scans import REACH_M, project

Float = NDArray[np.float64]
START_NS = 1_700_000_000_000_000_000
_PATH_PRECISION = 1e-9


@dataclass(frozen=True, slots=True)
class Noise:
    """Standard deviations. Beams leave from the true pose; the message carries the noisy one."""

    range_m: float = 0.012  # along the beam
    pose_m: float = 0.008  # each axis of the reported position
    heading_deg: float = 0.0  # of the reported heading


@dataclass(frozen=True, slots=True, eq=False)
class Look:
    """One true look at the scene, before noise: scan `index` of the drive."""

    index: int
    stamp_ns: int
    position: Float  # (3,) m, of the sensor, world
    orientation_xyzw: Float  # (4,) sensor to world
    beams: Float  # (N, 3) unit, sensor frame
    directions: Float  # (N, 3) unit, world
    ranges: Float  # (N,) m, inf where nothing came back
    faces: NDArray[np.int32]  # (N,) surface of the scene; below 0: none, or glass


class Simulation:
    """A scene, a sensor and a seed. Scan k is the same whatever was made before it."""

    def __init__(
        self,
        scene: str | Scene,
        sensor: str | Sensor,
        *,
        seed: int = 0,
        noise: Noise = Noise(),
        num_scans: int | None = None,
        max_points: int | None = None,
        duration_s: float | None = None,
        speed_mps: float | None = None,
        rate_hz: float | None = None,
        reach_m: float = REACH_M,
        robot: str = "sim",
    ) -> None:
        """`num_scans`, or what `max_points` allows, are spread over the whole drive.

        Without either the sensor's rate and speed say how many; `duration_s` ends the drive early.
        Empty beams of a CLOUD end at `reach_m`; those of a LINE are told as +inf.
        """
        self.scene = SCENES[scene]() if isinstance(scene, str) else scene
        self.sensor = SENSORS[sensor]() if isinstance(sensor, str) else sensor
        self.seed, self.noise, self.reach_m, self.robot = seed, noise, reach_m, robot
        self.faces = Faces(self.scene.surfaces)
        rate = rate_hz or self.sensor.rate_hz
        spacing = (speed_mps or self.sensor.speed_mps) / rate
        if max_points is not None:
            allowed = max(1, max_points // len(self.sensor.beams))
            num_scans = allowed if num_scans is None else min(num_scans, allowed)
        if num_scans is not None:
            spacing = self.scene.drive.length_m / num_scans * (1.0 + _PATH_PRECISION)
        self.positions, self.headings = self.scene.drive.sample(spacing)  # (S, 3) m, (S,) rad
        if duration_s is not None:
            count = max(1, int(duration_s * rate))
            self.positions, self.headings = self.positions[:count], self.headings[:count]
        self.period_ns = round(1e9 / rate)

    def __len__(self) -> int:
        return len(self.positions)

    def look(self, index: int) -> Look:
        """What the sensor truly meets at scan `index`."""
        sensor = self.sensor
        orientation = multiply(about_z(self.headings[index]), sensor.mount_xyzw)
        position = self.positions[index] + np.array([0.0, 0.0, sensor.height_m])
        beams = sensor.beams
        if sensor.spin:
            phase = 2.0 * np.pi * self._generator(index, 1).random()
            beams = beams @ rotation(about_z(phase)).T
        directions = beams @ rotation(orientation).T
        ranges, faces = self.faces.cast(position, directions)
        far = np.isfinite(ranges) & (ranges > sensor.max_range_m)
        ranges[far], faces[far] = np.inf, -1
        stamp_ns = START_NS + index * self.period_ns
        return Look(index, stamp_ns, position, orientation, beams, directions, ranges, faces)

    def measure(self, look: Look) -> tuple[Pose, Float]:
        """The reported pose, and the ranges (N,) m: +inf came back empty, NaN too near."""
        rng = self._generator(look.index, 0)
        shift = rng.normal(0.0, self.noise.pose_m, 3)
        turn = rng.normal(0.0, np.radians(self.noise.heading_deg))
        ranges = look.ranges + rng.normal(0.0, self.noise.range_m, len(look.ranges))
        ranges[look.ranges < self.sensor.min_range_m] = np.nan
        orientation = multiply(about_z(turn), look.orientation_xyzw)
        return Pose(look.position + shift, orientation), ranges

    def messages(self) -> Iterator[Scan | LineFan]:
        """What the robot would publish: a LineFan for a LINE sensor, else a Scan."""
        for index in range(len(self)):
            yield self.message(self.look(index))

    def message(self, look: Look) -> Scan | LineFan:
        pose, ranges = self.measure(look)
        if self.sensor.kind is ScanKind.LINE:
            return LineFan(
                self.robot, self.sensor.name, 1, look.index + 1, look.stamp_ns, "map", pose,
                *self.sensor.angles, ranges,
            )  # fmt: skip
        hit, empty = np.isfinite(ranges), np.isposinf(ranges)
        points = look.beams[hit] * ranges[hit, None]
        ends = look.beams[empty & self.sensor.says_empty] * self.reach_m
        return Scan(
            self.robot, self.sensor.name, 1, look.index + 1, look.stamp_ns, "map",
            ScanKind.CLOUD, pose, points.astype(np.float32), ends.astype(np.float32),
        )  # fmt: skip

    def scans(self) -> Iterator[Scan]:
        """The same, with every fan projected as its reader would."""
        for message in self.messages():
            yield project(message, self.reach_m) if isinstance(message, LineFan) else message

    def _generator(self, index: int, stream: int) -> np.random.Generator:
        sequence = np.random.SeedSequence(self.seed, spawn_key=(index, stream))
        return np.random.Generator(np.random.PCG64(sequence))


def simulate(
    scene: str | Scene,
    sensor: str | Sensor,
    *,
    seed: int = 0,
    range_noise_m: float = 0.012,
    pose_noise_m: float = 0.008,
    heading_noise_deg: float = 0.0,
    num_scans: int | None = None,
    max_points: int | None = None,
    duration_s: float | None = None,
    speed_mps: float | None = None,
    rate_hz: float | None = None,
    reach_m: float = REACH_M,
) -> Iterator[Scan]:
    """Scans of a scene; see Simulation for what the options mean."""
    return Simulation(
        scene,
        sensor,
        seed=seed,
        noise=Noise(range_noise_m, pose_noise_m, heading_noise_deg),
        num_scans=num_scans,
        max_points=max_points,
        duration_s=duration_s,
        speed_mps=speed_mps,
        rate_hz=rate_hz,
        reach_m=reach_m,
    ).scans()
