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


def probes(
    ring: NDArray[np.int32],
    frame: PlaneFrame,
    normal: NDArray[np.float64],
    offset_m: float,
    settings: MapSettings,
) -> NDArray[np.int64]:
    """(3 N, 3) ticks: samples of a hole before, on and behind the plane normal . x = offset_m."""
    uv = _samples(ring, PITCH) * frame.step_m
    flat = uv[:, :1] * frame.axis_u + uv[:, 1:] * frame.axis_v
    lift = (offset_m - flat @ normal) / float(frame.axis_n @ normal)
    on_plane = flat + lift[:, None] * frame.axis_n
    step = CELL * settings.voxel_m * normal
    points = np.concatenate([on_plane + step, on_plane, on_plane - step])
    return np.floor(points / (settings.voxel_m / TICKS)).astype(np.int64)


def hole_kind(probe: NDArray[np.int64], free: FreeSpace, settings: MapSettings) -> HoleKind:
    """OPENING where enough of the hole was passed before, on and behind the plane alike."""
    if not len(probe):
        return HoleKind.UNOBSERVED
    through = free.passed(probe, settings.passed_beams).reshape(3, -1).all(axis=0)
    enough = float(through.mean()) >= settings.opening_share
    return HoleKind.OPENING if enough else HoleKind.UNOBSERVED
