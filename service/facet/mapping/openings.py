"""What a hole is: an opening where beams went through the plane, else merely unobserved."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from facet.mapping.freespace import CELL, FreeSpace
from facet.mapping.kernel import kernel
from facet.mapping.rings import inside
from facet.mapping.settings import STEPS, TICKS, MapSettings
from facet_protocol.messages import HoleKind, PlaneFrame

PITCH = CELL * STEPS // 2  # grid units between samples of a hole: half a cell


@kernel
def _samples(ring, pitch):  # type: ignore[no-untyped-def]
    """(N, 2) points of the given pitch inside a ring."""
    low_u, high_u = ring[:, 0].min(), ring[:, 0].max()
    low_v, high_v = ring[:, 1].min(), ring[:, 1].max()
    nu = (high_u - low_u) // pitch + 1
    nv = (high_v - low_v) // pitch + 1
    out = np.empty((nu * nv, 2))
    count = 0
    for a in range(nu):
        for b in range(nv):
            u = low_u + (a + 0.5) * pitch
            v = low_v + (b + 0.5) * pitch
            if inside(ring, u, v):
                out[count, 0], out[count, 1] = u, v
                count += 1
    return out[:count]


@kernel
def _lift(uv, axis_u, axis_v, axis_n, normal, offset, step, tick):  # type: ignore[no-untyped-def]
    """(3, N, 3) ticks: points (N, 2) of a frame, metres, a step before, on and behind the plane."""
    out = np.empty((3, uv.shape[0], 3), np.int64)
    flat = np.empty(3)
    slope = axis_n[0] * normal[0] + axis_n[1] * normal[1] + axis_n[2] * normal[2]
    for n in range(uv.shape[0]):
        for a in range(3):
            flat[a] = uv[n, 0] * axis_u[a] + uv[n, 1] * axis_v[a]
        along = flat[0] * normal[0] + flat[1] * normal[1] + flat[2] * normal[2]
        lift = (offset - along) / slope
        for a in range(3):
            on_plane = flat[a] + lift * axis_n[a]
            for side in range(3):
                out[side, n, a] = np.floor((on_plane + (1 - side) * (step * normal[a])) / tick)
    return out


def samples(ring: NDArray[np.int32]) -> NDArray[np.float64]:
    """(N, 2) points in a hole, half a cell of free space apart, 1/8 voxel."""
    return np.asarray(_samples(ring, PITCH))


def probes(
    points: NDArray[np.float64],
    frame: PlaneFrame,
    normal: NDArray[np.float64],
    offset_m: float,
    settings: MapSettings,
) -> NDArray[np.int64]:
    """(3, N, 3) ticks: samples of a hole before, on and behind the plane normal . x = offset_m."""
    uv, axes = points * frame.step_m, (frame.axis_u, frame.axis_v, frame.axis_n)
    step_m, tick_m = CELL * settings.voxel_m, settings.voxel_m / TICKS
    return np.asarray(_lift(uv, *axes, normal, offset_m, step_m, tick_m))


def hole_kind(probe: NDArray[np.int64], free: FreeSpace, settings: MapSettings) -> HoleKind:
    """OPENING where enough of the hole was passed before, on and behind the plane alike."""
    number = probe.shape[1]
    if not number:
        return HoleKind.UNOBSERVED
    enough = free.passed_all(probe, settings.passed_beams) / number >= settings.opening_share
    return HoleKind.OPENING if enough else HoleKind.UNOBSERVED
