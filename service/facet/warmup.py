"""Compiles the mapper's loops before the first scan, so that no robot waits for a compiler.

Most are there twice, for few blocks and for many: what the mapper does not meet here it compiles,
or reads from the compiler's cache, when a robot drives."""

from __future__ import annotations

import gc

import numpy as np
from numpy.typing import NDArray

from facet.mapping.mapper import Mapper
from facet.mapping.settings import BLOCK, MapSettings
from facet_protocol.messages import Pose, Scan, ScanKind

HALF = 30  # voxels from the middle of the room to its walls
WINDOW = 8  # voxels from the middle of a wall to the edge of its window
FLOOR = 1200  # voxels: how far the floor goes on, over more tiles than one thread looks at
STEP = 0.8  # voxels between points
SEEN = 8  # points in a voxel from which on one more changes little
BLOCKS = 24  # a side of the field of single voxels: more blocks than one thread looks at


def warm_up(settings: MapSettings) -> None:
    """Map a room once with every kind of scan, then much at once, little, and nothing; and forget
    it."""
    mapper, voxel_m = Mapper(settings), settings.voxel_m
    for sequence, kind in enumerate(ScanKind, start=1):
        mapper.insert(_scan(kind, sequence, _room() * voxel_m))
        mapper.update()
    along = np.zeros(3)
    for along[0] in range(0, FLOOR, 4 * HALF):
        mapper.insert(_scan(ScanKind.CLOUD, 1, _floor() * voxel_m, along * voxel_m))
    mapper.insert(_scan(ScanKind.CLOUD, 1, _field() * voxel_m))
    mapper.insert(_scan(ScanKind.CLOUD, 1, _bend() * voxel_m))
    mapper.update()
    little = _scan(ScanKind.CLOUD, 1, _rims() * voxel_m)
    for _ in range(SEEN):
        mapper.insert(little)
    mapper.update()
    mapper.insert(little)  # again, and it tells nothing new
    mapper.update()
    mapper.retract(little)
    mapper.update()
    mapper.update()
    mapper.points()
    mapper.counts()
    mapper.digest()
    del mapper
    if not gc.get_freeze_count():  # once a process: what a compiler leaves behind stays, and takes
        gc.collect()  # a twentieth of a second to look through
        gc.freeze()


def _grid(length: float, width: float) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    axes = [np.arange(-half, half, STEP) for half in (length / 2, width / 2)]
    a, b = (axis.ravel() for axis in np.meshgrid(*axes))
    return a, b


def _room() -> NDArray[np.float64]:
    """(N, 3) voxels: a floor and two walls, one with a window and what is seen through it."""
    a, b = _grid(2 * HALF, 2 * HALF)
    far = np.full_like(a, HALF)
    is_open = (abs(a) < WINDOW) & (abs(b) < WINDOW)
    behind = np.where(is_open, 2.0, 1.0)
    window = np.stack((a, far, b), axis=1) * behind[:, None]
    return np.concatenate([np.stack((a, b, -far), axis=1), window, np.stack((far, a, b), axis=1)])


def _floor() -> NDArray[np.float64]:
    a, b = _grid(4 * HALF, BLOCK)
    return np.stack((a, b, np.full_like(a, -HALF)), axis=1)


def _rims() -> NDArray[np.float64]:
    """Two edges of a table, and a part of what lies between."""
    a, b = _grid(8 * BLOCK, 2 * BLOCK)
    is_there = (abs(b) > 0.75 * BLOCK) | (abs(a) < BLOCK / 2)
    return np.stack((a, b, np.zeros_like(a)), axis=1)[is_there]


def _bend() -> NDArray[np.float64]:
    """(N, 3) voxels: two walls, under the floor, and a quarter of a circle between them."""
    a, b = _grid(2 * HALF, 2 * HALF)
    angle, radius, low = (a / HALF + 1.0) * np.pi / 4, HALF * 4 / 3, b - 3 * HALF
    arc = np.stack((radius * np.sin(angle), radius * np.cos(angle), low), axis=1)
    wall = np.stack((a - HALF, np.full_like(a, radius), low), axis=1)
    return np.concatenate([arc, wall, wall[:, [1, 0, 2]]])


def _field() -> NDArray[np.float64]:
    """A voxel in each of many blocks."""
    a, b = (axis.ravel() * BLOCK for axis in np.meshgrid(np.arange(BLOCKS), np.arange(BLOCKS)))
    return np.stack((a, b, np.full_like(a, 2 * HALF)), axis=1).astype(np.float64)


def _scan(
    kind: ScanKind,
    sequence: int,
    points: NDArray[np.float64],
    position: NDArray[np.float64] | None = None,
) -> Scan:
    where = np.zeros(3) if position is None else position.copy()
    return Scan(
        robot="none",
        sensor=kind.value,
        epoch=1,
        sequence=sequence,
        stamp_ns=sequence,
        frame_id="map",
        kind=kind,
        pose=Pose(where, np.array([0.0, 0.0, 0.0, 1.0])),
        points=points.astype(np.float32),
        no_return=np.array([[-2.0, 0.0, 0.0]], dtype=np.float32),
    )
