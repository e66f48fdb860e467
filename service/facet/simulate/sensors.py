"""What the simulated sensors are: their beams, where they sit on the robot, how often they look."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from facet_protocol.messages import ScanKind
from facet_protocol.projection import fan_angles, sin_cos

Float = NDArray[np.float64]


@dataclass(frozen=True, slots=True, eq=False)
class Sensor:
    """A range sensor: unit beams in its own frame, and its place on the robot (x ahead, z up)."""

    name: str
    kind: ScanKind
    beams: Float  # (N, 3) unit, sensor frame
    height_m: float  # above the floor
    mount_xyzw: Float  # (4,) unit, sensor to robot
    rate_hz: float
    speed_mps: float  # how fast the robot drives with it
    min_range_m: float = 0.1
    max_range_m: float = 30.0
    says_empty: bool = True  # whether a beam that came back empty can be told from none
    spin: bool = False  # whether the beams start at another azimuth in each scan
    angles: tuple[float, float] = (0.0, 0.0)  # rad, first and last beam, of a LINE sensor


def pushbroom(
    *, fan_deg: float = 360.0, beams: int = 360, height_m: float = 1.0, rate_hz: float = 40.0
) -> Sensor:
    """A flat scanner standing upright across the way (paper, section 2): x left, y up, z ahead.

    `fan_deg` is centred on straight up: 180 is the paper's, 360 sees the floor under the robot too.
    """
    half = np.radians(fan_deg) / 2.0
    step = 2.0 * half / beams if fan_deg >= 360.0 else 0.0  # a full turn ends before it began
    start, end = float(np.pi / 2.0 - half), float(np.pi / 2.0 + half - step)
    sine, cosine = sin_cos(fan_angles(start, end, beams))
    return Sensor(
        name="pushbroom",
        kind=ScanKind.LINE,
        beams=np.stack([cosine, sine, np.zeros(beams)], axis=1),
        height_m=height_m,
        mount_xyzw=np.array([0.5, 0.5, 0.5, 0.5]),
        rate_hz=rate_hz,
        speed_mps=0.5,
        angles=(start, end),
    )


def lidar3d(
    *,
    rings: int = 32,
    columns: int = 1000,
    elevation_deg: tuple[float, float] = (-45.0, 52.0),
    height_m: float = 0.9,
    rate_hz: float = 10.0,
) -> Sensor:
    """A rotating many-beam scanner; one scan is one turn, already de-skewed."""
    azimuth = np.arange(columns) * (2.0 * np.pi / columns)
    elevation = np.radians(np.linspace(*elevation_deg, rings))
    az, el = (grid.ravel() for grid in np.meshgrid(azimuth, elevation, indexing="ij"))
    beams = np.stack([np.cos(el) * np.cos(az), np.cos(el) * np.sin(az), np.sin(el)], axis=1)
    return Sensor(
        name="lidar3d",
        kind=ScanKind.CLOUD,
        beams=beams,
        height_m=height_m,
        mount_xyzw=np.array([0.0, 0.0, 0.0, 1.0]),
        rate_hz=rate_hz,
        speed_mps=1.0,
        spin=True,
    )


def depth(
    *,
    width: int = 160,
    height: int = 120,
    hfov_deg: float = 70.0,
    height_m: float = 1.2,
    rate_hz: float = 10.0,
    says_empty: bool = False,
) -> Sensor:
    """A pinhole depth camera looking ahead: x right, y down, z ahead. Empty pixels say nothing."""
    focal = width / 2.0 / np.tan(np.radians(hfov_deg) / 2.0)
    column, row = np.meshgrid(np.arange(width) + 0.5, np.arange(height) + 0.5)
    x, y = (column.ravel() - width / 2.0) / focal, (row.ravel() - height / 2.0) / focal
    beams = np.stack([x, y, np.ones_like(x)], axis=1)
    return Sensor(
        name="depth",
        kind=ScanKind.CLOUD,
        beams=beams / np.linalg.norm(beams, axis=1, keepdims=True),
        height_m=height_m,
        mount_xyzw=np.array([-0.5, 0.5, -0.5, 0.5]),
        rate_hz=rate_hz,
        speed_mps=0.5,
        min_range_m=0.3,
        max_range_m=6.0,
        says_empty=says_empty,
    )


SENSORS: dict[str, Callable[..., Sensor]] = {
    "lidar3d": lidar3d,
    "pushbroom": pushbroom,
    "depth": depth,
}


def rotation(xyzw: Float) -> Float:
    """(3, 3) matrix of a unit quaternion."""
    x, y, z, w = xyzw
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
            [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
            [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
        ]
    )


def multiply(a_xyzw: Float, b_xyzw: Float) -> Float:
    """Hamilton product: first b, then a."""
    ax, ay, az, aw = a_xyzw
    bx, by, bz, bw = b_xyzw
    return np.array(
        [
            aw * bx + ax * bw + ay * bz - az * by,
            aw * by - ax * bz + ay * bw + az * bx,
            aw * bz + ax * by - ay * bx + az * bw,
            aw * bw - ax * bx - ay * by - az * bz,
        ]
    )


def about_z(angle: float) -> Float:
    """(4,) xyzw of a turn about z, rad."""
    return np.array([0.0, 0.0, np.sin(angle / 2.0), np.cos(angle / 2.0)])
