"""Ids that last: planes keep theirs by the voxels they share with the update before."""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from facet_protocol.messages import Event, EventKind, Tombstone

NO_PLANE = 0


class Heritage(NamedTuple):
    """Voxels that planes of now (by index) share with planes of the last update (by id)."""

    old_id: NDArray[np.int64]  # (N,)
    plane: NDArray[np.int64]  # (N,)
    voxels: NDArray[np.int64]  # (N,)


class Lineage(NamedTuple):
    """What became of the planes: ids by index, and what happened."""

    ids: NDArray[np.int64]  # (K,)
    created: dict[int, int]  # new id: the plane it split from, or 0
    retired: tuple[Tombstone, ...]


class Identity:
    """Counts ids and never uses one again. The larger part keeps the id, in merges and splits."""

    def __init__(self) -> None:
        self._next = 1
        self._alive: set[int] = set()
        self._events = 0

    def freeze(self) -> dict[str, int]:
        """Where counting stands, as JSON."""
        return {"next": self._next, "events": self._events}

    def restore(self, frozen: Mapping[str, int], ids: NDArray[np.int64]) -> None:
        """Go on from `freeze`, with these ids (K,) alive. Raises ValueError for one to come."""
        self._next, self._events = int(frozen["next"]), int(frozen["events"])
        if ids.max(initial=0) >= self._next:
            raise ValueError(f"plane {ids.max()} is there, and the next one would be {self._next}")
        self._alive = set(ids.tolist())

    def assign(self, count: int, heritage: Heritage) -> Lineage:
        """Ids for `count` planes, given what they share with those of the last update."""
        shared = _add_up(heritage)
        ids = np.zeros(count, np.int64)
        taken: dict[int, int] = {}
        for _, old, plane in shared:
            if old in self._alive and old not in taken and not ids[plane]:
                ids[plane] = old
                taken[old] = plane
        created: dict[int, int] = {}
        for plane in np.flatnonzero(ids == 0).tolist():
            ids[plane] = self._next
            parents = [old for _, old, p in shared if p == plane and old in self._alive]
            created[self._next] = parents[0] if parents else 0
            self._next += 1
        retired = []
        for old in sorted(self._alive - taken.keys()):
            heirs = [int(ids[p]) for _, o, p in shared if o == old]
            retired.append(Tombstone(old, heirs[0] if heirs else 0))
        self._alive = set(ids.tolist())
        return Lineage(ids, created, tuple(retired))

    def events(
        self, lineage: Lineage, updated: list[int], revision: int, stamp_ns: int
    ) -> tuple[Event, ...]:
        """Numbered events: retired and merged planes, new ones, updated ones, each by id."""
        kinds: list[tuple[EventKind, int, int]] = []
        for stone in lineage.retired:
            kind = EventKind.MERGED if stone.subsumed_by else EventKind.RETIRED
            kinds.append((kind, stone.plane_id, stone.subsumed_by))
        for plane_id, parent in sorted(lineage.created.items()):
            kinds.append((EventKind.SPLIT if parent else EventKind.CREATED, plane_id, parent))
        kinds.extend((EventKind.UPDATED, i, 0) for i in updated if i not in lineage.created)
        events = []
        for kind, plane_id, other in kinds:
            self._events += 1
            events.append(Event(self._events, kind, plane_id, other, revision, stamp_ns))
        return tuple(events)


def _add_up(heritage: Heritage) -> list[tuple[int, int, int]]:
    """(-voxels, old id, plane), most shared first."""
    on = heritage.old_id != NO_PLANE
    pairs = heritage.old_id[on] << 32 | heritage.plane[on]
    unique, index = np.unique(pairs, return_inverse=True)
    voxels = np.bincount(index, heritage.voxels[on], minlength=len(unique)).astype(np.int64)
    order = np.lexsort((unique, -voxels))
    shared = -voxels[order], unique[order] >> 32, unique[order] & 0xFFFFFFFF
    return list(zip(*(column.tolist() for column in shared), strict=True))
