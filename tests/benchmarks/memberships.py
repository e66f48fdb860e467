"""Any mapper's planes as the scorer wants them: from the voxels that belong to each.

The rule is Facet's own, whoever found the planes: a least-squares fit, an outline by the boundary
of the alpha complex of the voxels in the plane, holes told apart by Facet's free space.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from facet.mapping.contours import make_frame, round_normal
from facet.mapping.freespace import FreeSpace
from facet.mapping.openings import hole_kind, probes, samples
from facet.mapping.pivot import CELLS, HALO, SIDE, boundary_edges
from facet.mapping.rings import Outline, surfaces_of
from facet.mapping.settings import STEPS, MapSettings
from facet_protocol.messages import PlaneFrame

Float = NDArray[np.float64]
LEVEL = np.cos(np.radians(15.0))


def model_of_labels(
    labels: NDArray[np.int32],
    centroids: Float,
    normals: Float,
    free: FreeSpace,
    settings: MapSettings,
) -> dict[str, Any]:
    """model.json's planes of `labels` (V,), -1: none. Normals (V, 3) point to the sensor."""
    order = np.argsort(labels, kind="stable")
    starts = np.flatnonzero(np.diff(labels[order], prepend=-2))
    planes = []
    for rows in np.split(order, starts[1:]):
        if labels[rows[0]] >= 0 and len(rows) >= 3:
            entry = _plane(len(planes) + 1, centroids[rows], normals[rows], free, settings)
            if entry["surfaces"]:
                planes.append(entry)
    return {"format": "facet-model", "version": 1, "planes": planes}


def _plane(
    number: int, points: Float, normals: Float, free: FreeSpace, settings: MapSettings
) -> dict[str, Any]:
    middle = points.mean(axis=0)
    axes = np.linalg.svd(points - middle, full_matrices=False)[2]
    inside = axes[2] if float((normals @ axes[2]).sum()) >= 0.0 else -axes[2]
    offset = float(inside @ middle)
    frame = make_frame(round_normal(inside), settings.voxel_m)
    least = settings.min_surface_m2 / frame.step_m**2
    surfaces = [
        _surface(outline, frame, inside, offset, free, settings)
        for outline in _outlines(points, frame, least)
    ]
    level = "floor" if inside[2] > 0 else "ceiling"
    return {
        "id": number,
        "class": level if abs(inside[2]) >= LEVEL else "wall",
        "normal": inside.tolist(),
        "d": offset,
        "facing": 1,
        "surfaces": surfaces,
    }


def _surface(
    outline: Outline,
    frame: PlaneFrame,
    inside: Float,
    offset: float,
    free: FreeSpace,
    settings: MapSettings,
) -> dict[str, Any]:
    holes = [
        (hole_kind(probes(samples(hole), frame, inside, offset, settings), free, settings), hole)
        for hole in outline.holes
    ]
    return {
        "outer": _lift(outline.outer, frame, inside, offset),
        "holes": [
            {"kind": kind.value, "ring": _lift(ring, frame, inside, offset)} for kind, ring in holes
        ],
    }


def _lift(
    ring: NDArray[np.int32], frame: PlaneFrame, inside: Float, offset: float
) -> list[list[float]]:
    """World coordinates, along the frame's axis onto the plane."""
    uv = ring * frame.step_m
    flat = uv[:, :1] * frame.axis_u + uv[:, 1:] * frame.axis_v
    up = (offset - flat @ inside) / float(frame.axis_n @ inside)
    lifted: list[list[float]] = (flat + up[:, None] * frame.axis_n).tolist()
    return lifted


def _outlines(points: Float, frame: PlaneFrame, least: float) -> list[Outline]:
    """Drawn in one grid of cells as wide as the plane, rolled over tile by tile."""
    uv = np.stack([points @ frame.axis_u, points @ frame.axis_v], axis=1) / frame.step_m
    grid = np.floor(uv + 0.5).astype(np.int64)
    low = grid.min(axis=0) // (CELLS * STEPS)
    count = grid.max(axis=0) // (CELLS * STEPS) - low + 1
    local = grid - low * CELLS * STEPS
    cells = np.zeros((count[1] * CELLS + 2 * HALO, count[0] * CELLS + 2 * HALO), np.uint64)
    bits = np.uint64(1) << ((local[:, 0] & 7) + 8 * (local[:, 1] & 7)).astype(np.uint64)
    np.bitwise_or.at(cells, (HALO + (local[:, 1] >> 3), HALO + (local[:, 0] >> 3)), bits)
    places = [(u, v) for v in range(count[1]) for u in range(count[0])]
    windows = np.stack(
        [cells[CELLS * v :, CELLS * u :][:SIDE, :SIDE] for u, v in places]
    )  # (N, SIDE, SIDE)
    edges = [
        own + np.tile((low + place) * CELLS * STEPS, 2)
        for place, own in zip(np.array(places), boundary_edges(windows), strict=True)
    ]
    return surfaces_of(np.concatenate(edges).astype(np.int64), least)
