"""Normals of all voxels, kept true to the store: only what a change can reach is estimated."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numba import prange
from numpy.typing import NDArray

from facet.mapping.adaptive import (
    ALIGNED,
    EMPTY,
    MIXED,
    OPEN,
    SPARSE,
    THICK,
    UNIT,
    VALID,
    estimate,
    make_rule,
)
from facet.mapping.blocks import list_voxels
from facet.mapping.halo import gather, make_halos
from facet.mapping.kernel import kernel
from facet.mapping.memory import Heap, Memory, grow_all, sparse
from facet.mapping.principal import ABREAST, analyse_all, put, solve, take_over
from facet.mapping.runs import dealt
from facet.mapping.settings import MapSettings
from facet.mapping.staleness import ASKED, RINGS, find_candidates, find_stale, mark_dirty
from facet.mapping.store import Dirty, VoxelStore
from facet.mapping.traces import (
    KNOWN,
    LOOK,
    SCRATCH,
    amend,
    begin,
    fetch,
    find_records,
    forget,
    keep,
    list_changes,
    make_traces,
    recall,
)

CLASS_NAMES = ("empty", "valid", "aligned", "thick", "sparse", "mixed")
MARGINS = (5, 8, 12)  # voxels that the halos of a block reach beyond it, one after the other
SHARES = 16  # parts that the blocks are dealt out to; threads take them
RUN = 16  # blocks, beside one another in memory, that fall to the same share


class Normals(NamedTuple):
    """What is derived at each voxel, by row (V,)."""

    unit: NDArray[np.int16]  # (V, 3) normal towards the sensor, times UNIT
    kind: NDArray[np.uint8]  # EMPTY .. MIXED
    thickness: NDArray[np.uint8]  # thickness angle gamma (eq. 9), half degrees
    border: NDArray[np.bool_]  # at a border of its surface, where points of others mix in
    reach: NDArray[np.uint8]  # largest radius that was looked at, voxels


@kernel(allocates=False)
def _write(normals, rows, number, found):  # type: ignore[no-untyped-def]
    """Write what was found of the voxels rows[:number]; of one that is OPEN, nothing was. Whether
    any is another now than before."""
    changed = False
    for v in range(number):
        row, new, unit = rows[v], found[v], normals.unit[rows[v]]
        if new[0] == OPEN:
            continue
        changed |= normals.kind[row] != new[0]
        changed |= unit[0] != new[1] or unit[1] != new[2] or unit[2] != new[3]
        changed |= normals.thickness[row] != new[4]
        changed |= normals.border[row] != new[5]
        normals.kind[row], normals.thickness[row] = new[0], new[4]
        unit[0], unit[1], unit[2] = new[1], new[2], new[3]
        normals.border[row], normals.reach[row] = new[5], new[6]
    return changed


@kernel(allocates=False)
def _estimate_block(  # type: ignore[no-untyped-def]
    blocks, observable, normals, block, stale, dirty, num_changes, rule, halo, traces, share,
    scratch, looks
):  # fmt: skip
    """Estimate the voxels of a block whose bit is set in stale (8,). Whether any changed. Those
    that want sums wait until all `looks` do: then these are fetched side by side. The halo is
    gathered when the first is, and again, wider, when one looks farther.

    dirty (8,): bits of its dirty voxels; num_changes: dirty voxels round it, -1: too many."""
    listed, found, opened = scratch.listed, scratch.found, scratch.open
    rows, places, words, starts = listed[0], listed[1], listed[2], listed[3]
    number = list_voxels(blocks, block, stale, rows, places)
    for v in range(number):
        words[v] = observable[rows[v]]
        found[v, 0] = OPEN
    if num_changes >= 0:
        find_records(traces, share, rows, number, starts)
    for n in range(len(looks)):
        opened[1, n] = n
    margin, num_open = 0, 0
    for v in range(number):
        look = looks[opened[1, num_open]]
        if _begin(dirty, num_changes, rule, traces, share, v, scratch, look):
            at = halo, margin, places[v], words[v], rule
            opened[0, num_open] = v
            num_open += _estimate(at, num_changes, traces, share, v, scratch, look)
        while num_open == len(looks) or (v == number - 1 and num_open > 0):
            margin = _fetch_all(
                blocks, observable, block, margin, rule, halo, num_open, scratch, looks
            )
            num_left = 0
            for n in range(num_open):
                own, place = opened[0, n], opened[1, n]
                opened[1, n] = opened[1, num_left]
                opened[0, num_left], opened[1, num_left] = own, place
                at = halo, margin, places[own], words[own], rule
                num_left += _estimate(at, num_changes, traces, share, own, scratch, looks[place])
            num_open = num_left
    return _write(normals, rows, number, found)


@kernel(allocates=False, inlined=True)
def _begin(dirty, num_changes, rule, traces, share, v, scratch, look):  # type: ignore[no-untyped-def]
    """Begin to look at a voxel of the block. Whether it can have changed."""
    state, listed = look.state, scratch.listed
    row, local, seen, start = listed[0, v], listed[1, v], listed[2, v], listed[3, v]
    begin(rule.start, state)
    is_new = (dirty[local >> 6] >> np.uint64(local & 63)) & np.uint64(1) == 1
    if is_new or num_changes < 0:
        return True
    is_whole = recall(traces, share, row, start, look)
    is_other = amend(scratch.changes, num_changes, local, seen, rule, look)
    one_line = seen >> 32 != 0  # asks for more than sums
    if is_whole and not (is_other or one_line):
        return False
    analyse_all(look.kept, state[KNOWN], rule.floor2, look.principal)
    return True


@kernel(allocates=False, inlined=True)
def _estimate(at, num_changes, traces, share, v, scratch, look):  # type: ignore[no-untyped-def]
    """Estimate a voxel of the block, and keep its sums. Whether it is still open."""
    row, start, found = scratch.listed[0, v], scratch.listed[3, v], scratch.found[v]
    kind, nx, ny, nz, gamma, border, reach = estimate(at, look)
    found[0], found[1], found[2], found[3] = kind, nx, ny, nz
    found[4], found[5], found[6] = gamma, border, reach
    if kind == OPEN:
        return True
    if num_changes < 0:
        forget(traces, share, row)
    else:
        keep(traces, share, row, start, look)
    return False


@kernel(allocates=False)
def _fetch_all(  # type: ignore[no-untyped-def]
    blocks, observable, block, margin, rule, halo, num_open, scratch, looks
):  # fmt: skip
    """Fetch what looks want, and find what it says, of all side by side. The margin of the halo."""
    opened, listed = scratch.open, scratch.listed
    for n in range(num_open):
        v, look, e = opened[0, n], looks[opened[1, n]], np.int64(-1)
        while e < 0:
            e = fetch((halo, margin, listed[1, v], listed[2, v], rule), look)
            if e < 0:
                margin = _wider(margin, rule.largest)
                gather(blocks, observable, block, margin, halo)
        put(look.kept[e], n, scratch.principal)
        opened[2, n] = e
    solve(num_open, rule.floor2, scratch.principal)
    for n in range(num_open):
        take_over(scratch.principal, n, looks[opened[1, n]].principal, opened[2, n])
    return margin


@kernel(allocates=False)
def _wider(margin, largest):  # type: ignore[no-untyped-def]
    """The margin of the next halo."""
    for wider in MARGINS:
        if margin < wider:
            return min(np.int64(wider), largest)
    return largest


@kernel(allocates=False)
def _deepest(blocks, reach, block, listed):  # type: ignore[no-untyped-def]
    """The largest reach of a block's voxels."""
    rows, largest = listed[0], np.uint8(0)
    for v in range(list_voxels(blocks, block, blocks.occupied[block], rows, listed[1])):
        largest = max(largest, reach[rows[v]])
    return largest


@kernel(parallel=True)
def _refresh(  # type: ignore[no-untyped-def]
    blocks, columns, normals, deepest, dirty, changes, which, rules, halos, scratches, traces,
    looks, counts, turned,
):  # fmt: skip
    """Estimate again what is stale in the blocks `which` (C,); counts (C,) says how many voxels,
    turned (C,) whether any of them changed. dirty: (B, 8) bits of dirty voxels; changes: these as
    rows, observables before, and lists by block (`mark_dirty`).

    Every voxel depends on observables alone and writes its own place: threads change nothing. A
    block always falls to the same share: the traces of its voxels lie there."""
    for turn in prange(halos.shape[0]):
        share = dealt(turn, halos.shape[0])
        halo, scratch, rule = halos[share], scratches[share], rules[0]
        stale = np.zeros(8, np.uint64)
        for q in range(which.shape[0]):
            block = which[q]
            if (block // RUN) % halos.shape[0] != share:
                continue
            counts[q] = find_stale(
                blocks, dirty, normals.reach, block, deepest[1 + block], rule.start,
                halo.near, halo.rows, scratch.listed, stale,
            )  # fmt: skip
            turned[q] = False
            if counts[q] > 0:
                blocks_out = (max(rule.start, deepest[1 + block]) + 7) >> 3
                num = list_changes(
                    blocks, columns, dirty, changes, halo.near, blocks_out, scratch.changes
                )
                turned[q] = _estimate_block(
                    blocks, columns.observable, normals, block, stale, dirty[block], num, rule,
                    halo, traces, share, scratch, looks[share],
                )  # fmt: skip
                deepest[1 + block] = _deepest(blocks, normals.reach, block, scratch.listed)


class NormalField:
    """Normals of all voxels, kept true to the store by re-estimating the stale ones only."""

    def __init__(self, settings: MapSettings, memory: Memory | None = None) -> None:
        self._memory = memory or Heap()
        self._num_rows = self._num_blocks = 0
        self._rule = make_rule(settings)
        self.normals = Normals(
            np.zeros((0, 3), np.int16),
            np.zeros(0, np.uint8),
            np.zeros(0, np.uint8),
            np.zeros(0, np.bool_),
            np.zeros(0, np.uint8),
        )
        self._deepest = np.zeros(1, np.uint8)  # largest reach of all, then by block
        self._dirty = np.zeros((0, 8), np.uint64)
        self._first = np.zeros(0, np.int32)  # dirty voxels by block, see mark_dirty
        self._flags = np.zeros(0, np.bool_)
        self._asked = np.empty((RINGS, ASKED), np.int64)
        self._halos, self._scratches = make_halos(SHARES), sparse(SHARES, SCRATCH)
        self._looks = sparse(SHARES * ABREAST, LOOK).reshape(SHARES, ABREAST)
        self._traces = make_traces(SHARES)

    def restore(self, store: VoxelStore, normals: Normals) -> None:
        """Take over what was derived of all voxels of a store. Raises ValueError for misfits."""
        columns: tuple[NDArray[Any], ...] = tuple(normals)
        empty: tuple[NDArray[Any], ...] = tuple(self.normals)
        for name, old, new in zip(Normals._fields, empty, columns, strict=True):
            if new.shape != (store.num_rows, *old.shape[1:]) or new.dtype != old.dtype:
                raise ValueError(f"{name} is {new.dtype} {new.shape}, for {store.num_rows} voxels")
        self._fit(store)
        fitted: tuple[NDArray[Any], ...] = tuple(self.normals)
        for own, column in zip(fitted, columns, strict=True):
            own[: store.num_rows] = column
        np.maximum.at(self._deepest, store.columns.block[: store.num_rows] + 1, normals.reach)
        self._deepest[0] = normals.reach.max(initial=0)

    def update(self, store: VoxelStore, dirty: Dirty) -> tuple[int, NDArray[np.int32]]:
        """Re-estimate what `dirty` voxels made stale.

        Returns (number of stale voxels, blocks in which a derived value changed)."""
        self._fit(store)
        near = np.empty(store.num_blocks, np.int32)
        changes = *dirty, self._first, np.empty(len(dirty.rows), np.int32)
        count = mark_dirty(store.columns, dirty.rows, self._dirty, *changes[2:], near)
        sources = near[:count].copy()
        which = self._candidates(store, sources)
        counts, turned = np.empty(len(which), np.int32), np.empty(len(which), np.bool_)
        _refresh(
            store.blocks, store.columns, self.normals, self._deepest, self._dirty, changes, which,
            self._rule, self._halos, self._scratches, self._traces, self._looks, counts, turned,
        )  # fmt: skip
        self._dirty[sources] = 0
        self._first[sources] = 0
        self._deepest[0] = self._deepest[1:].max(initial=0)
        return int(counts.sum()), which[turned]

    def _candidates(self, store: VoxelStore, sources: NDArray[np.int32]) -> NDArray[np.int32]:
        """Blocks (C,) that may hold stale voxels, those with dirty ones being `sources`."""
        near = np.empty(store.num_blocks, np.int32)
        room = self._flags, self._asked, near
        return near[: find_candidates(store.blocks, self._deepest, sources, *room)]

    def _fit(self, store: VoxelStore) -> None:
        rows, blocks = len(store.columns.block), len(store.blocks.keys)
        if len(self.normals.kind) < rows:
            self.normals = grow_all(self._memory, self.normals, self._num_rows, rows)
            slot = self._memory.grown(self._traces.slot, self._num_rows, rows)
            self._traces = self._traces._replace(slot=slot)
        if len(self._dirty) < blocks:
            grown, used = self._memory.grown, self._num_blocks
            self._deepest = grown(self._deepest, 1 + used, 1 + blocks)
            self._dirty = grown(self._dirty, 0, blocks)
            self._flags = grown(self._flags, 0, blocks)
            self._first = grown(self._first, 0, blocks)
        self._num_rows, self._num_blocks = store.num_rows, store.num_blocks


__all__ = [
    "ALIGNED",
    "CLASS_NAMES",
    "EMPTY",
    "MIXED",
    "SPARSE",
    "THICK",
    "UNIT",
    "VALID",
    "NormalField",
    "Normals",
]
