"""A map as plain arrays, and back: what a checkpoint keeps.

Frozen are the integers that the log made, the normals (the one stage that is dear to derive), and
what depends on when the map was updated: ids, revisions, sightings. The rest is derived again.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from facet.mapping.mapper import Mapper
from facet.mapping.memory import Memory, copied
from facet.mapping.normals import Normals
from facet.mapping.planes import FREE
from facet.mapping.settings import MapSettings
from facet.mapping.witness import Sighting

Arrays = Mapping[str, NDArray[Any]]


def freeze(mapper: Mapper) -> dict[str, NDArray[Any]]:
    """Copies of all that the map is, as of its last update; call it right after one.

    Raises ValueError where scans were inserted since."""
    store, tiles = mapper._store, mapper._tiles.tiles
    waiting = len(store.touched.rows)
    if waiting:
        raise ValueError(f"{waiting} voxels wait for an update")
    rows, keys = store.num_rows, sorted(tiles)
    arrays = {f"voxel/{name}": column for name, column in store.freeze().items()}
    normals = mapper._normals.normals._asdict()
    arrays.update((f"normal/{name}", copied(mapper.memory, c, rows)) for name, c in normals.items())
    arrays["block/keys"] = store.blocks.keys[: store.num_blocks].copy()
    arrays["free/keys"], arrays["free/counts"] = mapper._free.freeze()
    arrays["tile/keys"] = np.array(keys, np.int64)
    none = [np.zeros(0, np.int64)]
    arrays["tile/sizes"] = np.array([len(tiles[key].ids) for key in keys], np.int64)
    arrays["tile/ids"] = np.concatenate(none + [tiles[key].ids for key in keys])
    arrays["history"] = np.frombuffer(json.dumps(_history(mapper)).encode(), np.uint8)
    return arrays


def thaw(
    arrays: Arrays, settings: MapSettings, map_id: str, memory: Memory | None = None
) -> Mapper:
    """The map that was frozen: the same digest, ids and future updates.

    Raises ValueError where the arrays do not fit together."""
    mapper = Mapper(settings, map_id, memory)
    try:
        mapper._store.restore(_part(arrays, "voxel/"), arrays["block/keys"])
        mapper._normals.restore(mapper._store, Normals(**_part(arrays, "normal/")))
        mapper._free.restore(arrays["free/keys"], arrays["free/counts"])
        _derive(mapper, arrays, json.loads(arrays["history"].tobytes()))
    except (KeyError, TypeError, IndexError, AttributeError) as error:
        raise ValueError(f"a map lacks or mistakes {error}") from error
    return mapper


def _part(arrays: Arrays, of: str) -> dict[str, NDArray[Any]]:
    return {name.removeprefix(of): a for name, a in arrays.items() if name.startswith(of)}


def _history(mapper: Mapper) -> dict[str, Any]:
    """What only the course of events tells."""
    planes = mapper._describer.planes
    return {
        "revision": mapper.revision,
        "stamp_ns": mapper._stamp_ns,
        "identity": mapper._identity.freeze(),
        "census": mapper._census.freeze(),
        "seen": [[k, s.first_ns, s.last_ns, sorted(s.robots)] for k, s in mapper._witness.items()],
        "planes": [[p.id, p.revision, [s.id for s in p.surfaces]] for p in planes],
        "next_surface": mapper._describer.next_surface,
    }


def _derive(mapper: Mapper, arrays: Arrays, history: dict[str, Any]) -> None:
    """Derive what was not kept, under the ids that were."""
    mapper.revision, mapper._stamp_ns = int(history["revision"]), int(history["stamp_ns"])
    mapper._census.restore(history["census"])
    mapper._witness.restore(
        {int(k): Sighting(int(a), int(b), set(robots)) for k, a, b, robots in history["seen"]}
    )
    blocks = np.arange(mapper._store.num_blocks, dtype=np.int32)
    rows = np.arange(mapper._store.num_rows, dtype=np.int32)
    grouped = mapper.group(blocks, rows, mapper._store.touched)
    ids = _plane_ids(mapper, len(grouped.points.total), arrays)
    mapper._identity.restore(history["identity"], ids)
    mapper.outline(ids, grouped)
    mapper.changed_tiles = []
    described = {
        int(plane_id): (int(revision), [int(i) for i in surfaces])
        for plane_id, revision, surfaces in history["planes"]
    }
    mapper._describer.restore(described, int(history["next_surface"]))


def _plane_ids(mapper: Mapper, count: int, arrays: Arrays) -> NDArray[np.int64]:
    """(K,) ids of the `count` planes, from those of their tile-planes."""
    tiles = mapper._tiles.tiles
    keys = [int(k) for k in arrays["tile/keys"]]
    sizes = [tiles[k].num_planes for k in keys] if keys == sorted(tiles) else None
    if sizes is None or sizes != arrays["tile/sizes"].tolist():
        raise ValueError("its tiles are not those of its voxels")
    label, kept = mapper._planes.label, np.asarray(arrays["tile/ids"], np.int64)
    ids = np.zeros(count, np.int64)
    on = label != FREE
    ids[label[on]] = kept[on]
    if not np.array_equal(np.where(on, ids[label] if len(ids) else 0, 0), kept):
        raise ValueError("its plane ids are not those of its planes")
    if len(np.unique(ids)) != len(ids) or np.any(ids <= 0):
        raise ValueError("two planes have one id")
    return ids
