"""Compiles the mapper's loops before the first scan, so that no robot waits for a compiler."""

from __future__ import annotations

import numpy as np

from facet.mapping.mapper import Mapper
from facet.mapping.settings import MapSettings
from facet_protocol.messages import Pose, Scan, ScanKind

HALF_M = 1.5
STEP_M = 0.04


def warm_up(settings: MapSettings) -> None:
    """Map a small room once with every kind of scan, and forget it."""
    mapper = Mapper(settings)
    for sequence, kind in enumerate(ScanKind, start=1):
        mapper.insert(_scan(kind, sequence))
        mapper.update()
    mapper.points()
    mapper.digest()


def _scan(kind: ScanKind, sequence: int) -> Scan:
    grid = np.arange(-HALF_M, HALF_M, STEP_M)
    a, b = (axis.ravel() for axis in np.meshgrid(grid, grid))
    far = np.full_like(a, HALF_M)
    faces = [np.stack(axes, axis=1) for axes in ((a, b, -far), (a, far, b), (far, a, b))]
    return Scan(
        robot="none",
        sensor=kind.value,
        epoch=1,
        sequence=sequence,
        stamp_ns=sequence,
        frame_id="map",
        kind=kind,
        pose=Pose(np.zeros(3), np.array([0.0, 0.0, 0.0, 1.0])),
        points=np.concatenate(faces).astype(np.float32),
        no_return=np.array([[-2.0, 0.0, 0.0]], dtype=np.float32),
    )
