"""Two hashes: of the state, integers only, and of what is derived from it, floats by their bits."""

from __future__ import annotations

import hashlib
from collections.abc import Iterable, Mapping
from typing import Any, NamedTuple

import numpy as np

from facet.mapping.blocks import pack_all
from facet.mapping.freespace import FreeSpace
from facet.mapping.store import VoxelStore
from facet_protocol.messages import Plane

REMAINDER = ("voxels", "aligned", "thick", "sparse", "discarded")


class Digest(NamedTuple):
    """Hex digests. `state` is equal on every machine, `derived` on the same build and processor."""

    state: str
    derived: str


def state_digest(store: VoxelStore, free: FreeSpace) -> str:
    """Hash of every occupied voxel's moments and every passed cell, in order of their keys."""
    rows = store.occupied_rows()
    keys = pack_all(store.voxel_keys(rows))
    order = np.argsort(keys)
    rows = rows[order]
    h = hashlib.sha256()
    h.update(keys[order].astype("<i8").tobytes())
    h.update(store.moments(rows).astype("<i8").tobytes())
    h.update(store.views(rows).astype("<i8").tobytes())
    h.update(store.columns.poses[rows].astype("<i8").tobytes())
    cells, counts = free.cells()
    h.update(cells.astype("<i8").tobytes())
    h.update(counts.astype("<i8").tobytes())
    return h.hexdigest()


def derived_digest(planes: Iterable[Mapping[str, Any]], counts: Mapping[str, int]) -> str:
    """Hash of planes and remainder as `model.json` has them: computed from the map or the file.

    Reads n, d, sigma_N, facing, class, rings and hole kinds, and the remainder's counts. Ids and
    the order of planes do not enter."""
    h = hashlib.sha256()
    for record in sorted(_plane_bytes(plane) for plane in planes):
        h.update(record)
    h.update(repr([int(counts[name]) for name in REMAINDER]).encode())
    return h.hexdigest()


def _floats(values: Any) -> bytes:
    return (np.asarray(values, dtype="<f8") + 0.0).tobytes()  # -0.0 is 0.0


def _ring(values: Any) -> bytes:
    return len(values).to_bytes(4, "little") + _floats(values)


def _plane_bytes(plane: Mapping[str, Any]) -> bytes:
    parts = [
        _floats(plane["normal"]),
        _floats([plane["d"], plane["sigma_n_m"]]),
        str(plane["facing"]).encode(),
        str(plane["class"]).encode(),
    ]
    surfaces = []
    for surface in plane["surfaces"]:
        holes = sorted(str(h["kind"]).encode() + _ring(h["ring"]) for h in surface["holes"])
        surfaces.append(_ring(surface["outer"]) + b"".join(holes))
    return b"|".join([*parts, *sorted(surfaces)])


def model_planes(planes: Iterable[Plane]) -> list[dict[str, Any]]:
    """What `derived_digest` reads of planes, by the names of `model.json`."""
    return [
        {
            "normal": plane.normal,
            "d": plane.d,
            "sigma_n_m": plane.sigma_n_m,
            "facing": plane.facing,
            "class": plane.plane_class.value,
            "surfaces": [
                {
                    "outer": plane.lift(surface.outer),
                    "holes": [
                        {"kind": hole.kind.value, "ring": plane.lift(hole.ring)}
                        for hole in surface.holes
                    ],
                }
                for surface in plane.surfaces
            ],
        }
        for plane in planes
    ]
