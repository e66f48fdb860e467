"""What the benchmarks read of a mapper that it does not show: all of it here, and nowhere else."""

from __future__ import annotations

import ctypes
import sys
from typing import Any

import numpy as np
from numpy.typing import NDArray

from facet.mapping.freespace import FreeSpace
from facet.mapping.mapper import Mapper
from facet.mapping.settings import TICKS
from facet.mapping.store import VoxelStore
from facet_protocol.messages import Scan


def num_voxels(mapper: Mapper) -> int:
    """Voxels that ever held a point: what grows as memory does."""
    return int(mapper._store.num_rows)


def points_in_view(mapper: Mapper, scan: Scan) -> NDArray[np.int64]:
    """(W,) points of each voxel that a scan touches. Call it right after the scan's insert."""
    store = mapper._store
    return store.num_points(store.touched.rows)


def forget_touched(mapper: Mapper, scan: Scan) -> NDArray[np.int64]:
    """The same of a scan that is not to be in the map: inserted, looked at, and retracted."""
    mapper.insert(scan)
    counts = points_in_view(mapper, scan) - 1
    mapper.retract(scan)
    mapper.update()
    return counts


def radii(mapper: Mapper) -> NDArray[np.int64]:
    """(V,) largest radius, voxels, that the normal of each voxel looked at."""
    return np.asarray(mapper._normals.normals.reach[: num_voxels(mapper)], np.int64)


def centroids(mapper: Mapper) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Exact centroids (V, 3) m of the occupied voxels, and unit vectors (V, 3) to the sensor."""
    store, tick_m = mapper._store, mapper.settings.tick_m
    rows = store.occupied_rows()
    moments = store.moments(rows)
    n = moments[:, :1].astype(np.float64)
    local = moments[:, 1:4] / n + 0.5
    corner = store.voxel_keys(rows).astype(np.float64) * TICKS
    views = store.views(rows).astype(np.float64)
    views /= np.maximum(np.linalg.norm(views, axis=1, keepdims=True), 1e-9)
    return (corner + local) * tick_m, views


def free_space(mapper: Mapper) -> FreeSpace:
    """What tells an opening from what was not observed."""
    return mapper._free


def parts(mapper: Mapper) -> tuple[VoxelStore, FreeSpace]:
    """Its store and its free space, to be timed apart."""
    return mapper._store, mapper._free


def num_blocks(mapper: Mapper) -> int:
    return int(mapper._store.num_blocks)


def outline_tiles(mapper: Mapper) -> int:
    """(u, v) tiles of all planes."""
    return sum(len(contour.cells) for contour in mapper._contours.contours.values())


def cells_passed(mapper: Mapper) -> int:
    """How many times a beam passed a cell."""
    return int(mapper._free.cells()[1].sum(dtype=np.int64))


def free_bytes(mapper: Mapper) -> int:
    """Bytes of the free-space grid that are in use."""
    free = mapper._free
    share = free.num_blocks / max(1, len(free._counts))
    return int(sum(a.nbytes for a in _arrays(free)) * share)


def rss_bytes() -> int:
    """Resident memory, after what was freed has gone back to the system."""
    if sys.platform == "linux":
        ctypes.CDLL(None).malloc_trim(0)
    with open("/proc/self/statm", encoding="ascii") as f:
        return int(f.read().split()[1]) * 4096


def _arrays(thing: Any) -> list[NDArray[Any]]:
    found: list[NDArray[Any]] = []
    for value in vars(thing).values():
        if isinstance(value, np.ndarray):
            found.append(value)
        elif isinstance(value, tuple):
            found += [a for a in value if isinstance(a, np.ndarray)]
    return found
