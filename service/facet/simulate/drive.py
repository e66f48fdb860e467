"""A smooth trajectory through waypoints on the floor: where the robot was, which way it looked."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Float = NDArray[np.float64]
_STEP_M = 0.01


@dataclass(frozen=True, slots=True, eq=False)
class Drive:
    """Waypoints joined by straight lines, then smoothed along the way by a Gaussian."""

    waypoints: Float  # (K, 3) m, world, on the floor
    smooth_m: float = 0.25  # its standard deviation

    def moved(self, R_world_scene: Float, shift: Float) -> Drive:
        return Drive(self.waypoints @ R_world_scene.T + shift, self.smooth_m)

    def path(self) -> Float:
        """(P, 3) m, about 1 cm apart before smoothing."""
        length = _arc_length(self.waypoints)
        steps = np.linspace(0.0, length[-1], max(2, int(length[-1] / _STEP_M) + 1))
        path = _interpolate(steps, length, self.waypoints)
        half = int(4.0 * self.smooth_m / _STEP_M)
        kernel = np.exp(-0.5 * (np.arange(-half, half + 1) * _STEP_M / self.smooth_m) ** 2)
        kernel /= kernel.sum()
        padded = np.pad(path, ((half, half), (0, 0)), mode="edge")
        return np.stack([np.convolve(padded[:, c], kernel, "valid") for c in range(3)], axis=1)

    def sample(self, spacing_m: float) -> tuple[Float, Float]:
        """Positions (N, 3) m and headings (N,) rad, `spacing_m` apart along the smooth path."""
        path = self.path()
        length = _arc_length(path)
        steps = np.arange(0.0, length[-1], spacing_m)
        heading = np.unwrap(np.arctan2(np.gradient(path[:, 1]), np.gradient(path[:, 0])))
        return _interpolate(steps, length, path), np.interp(steps, length, heading)

    @property
    def length_m(self) -> float:
        return float(_arc_length(self.path())[-1])


def _arc_length(path: Float) -> Float:
    """(P,) m, from the first vertex."""
    edges = np.linalg.norm(np.diff(path, axis=0), axis=1)
    return np.concatenate([[0.0], np.cumsum(edges)])


def _interpolate(steps: Float, length: Float, path: Float) -> Float:
    return np.stack([np.interp(steps, length, path[:, c]) for c in range(3)], axis=1)
