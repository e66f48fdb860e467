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
    SPARSE,
    THICK,
    UNIT,
    VALID,
    WIDER,
    estimate,
    make_rule,
)
from facet.mapping.bits import trailing_zeros
from facet.mapping.blocks import row_at
from facet.mapping.halo import LISTS, Halo, gather, make_halos
from facet.mapping.kernel import kernel
from facet.mapping.memory import Heap, Memory, grow_all
from facet.mapping.region import COLUMNS, MOST, SUMS
from facet.mapping.settings import MapSettings
from facet.mapping.staleness import find_candidates, find_stale, mark_dirty
from facet.mapping.store import VoxelStore

CLASS_NAMES = ("empty", "valid", "aligned", "thick", "sparse", "mixed")
SAME, CHANGED = 0, 1  # what became of a voxel, or WIDER
NARROW, WIDE = 4, 8  # voxels that the first and the second halo of a block reach beyond it
SHARES = 16  # parts that the blocks are dealt out to; threads take them


class Normals(NamedTuple):
    """What is derived at each voxel, by row (V,)."""

    unit: NDArray[np.int16]  # (V, 3) normal towards the sensor, times UNIT
    kind: NDArray[np.uint8]  # EMPTY .. MIXED
    thickness: NDArray[np.uint8]  # thickness angle gamma (eq. 9), half degrees
    border: NDArray[np.bool_]  # at a border of its surface, where points of others mix in
    reach: NDArray[np.uint8]  # largest radius that was looked at, voxels


@kernel
def _estimate_row(halo, margin, observable, normals, row, local, rule, scratch):  # type: ignore[no-untyped-def]
    """Estimate one row and write it. SAME, CHANGED, or WIDER where nothing was written."""
    seen = observable[row]
    kind, nx, ny, nz, gamma, border, reach = estimate(halo, margin, local, seen, rule, scratch)
    if kind == WIDER:
        return WIDER
    unit = normals.unit[row]
    changed = (
        normals.kind[row] != kind
        or normals.thickness[row] != gamma
        or normals.border[row] != border
        or unit[0] != nx
        or unit[1] != ny
        or unit[2] != nz
    )
    normals.kind[row] = kind
    normals.thickness[row] = gamma
    normals.border[row] = border
    normals.reach[row] = reach
    unit[0], unit[1], unit[2] = nx, ny, nz
    return CHANGED if changed else SAME


@kernel
def _estimate_block(blocks, observable, normals, block, stale, rule, halo, scratch):  # type: ignore[no-untyped-def]
    """Estimate the voxels of a block whose bit is set in stale (8,), which comes back clear.
    Whether any changed. Few need to look far: the wider halos are gathered for them alone."""
    turned = False
    for margin in (min(NARROW, rule.largest), min(WIDE, rule.largest), rule.largest):
        left = np.uint64(0)
        gather(blocks, observable, block, margin, halo)
        for z in range(8):
            word = stale[z]
            while word != np.uint64(0):
                bit = np.int64(trailing_zeros(word))
                word &= word - np.uint64(1)
                local = 64 * z + bit
                row = row_at(blocks, block, local)
                became = _estimate_row(halo, margin, observable, normals, row, local, rule, scratch)
                if became != WIDER:
                    stale[z] &= ~(np.uint64(1) << np.uint64(bit))
                    turned |= became == CHANGED
            left |= stale[z]
        if left == np.uint64(0):
            break
    return turned


@kernel
def _deepest(blocks, reach, block):  # type: ignore[no-untyped-def]
    """The largest reach of a block's voxels."""
    largest = np.uint8(0)
    for local in range(512):
        row = row_at(blocks, block, local)
        if row >= 0:
            largest = max(largest, reach[row])
    return largest


@kernel(parallel=True)
def _refresh(blocks, columns, normals, deepest, dirty, which, rule, halos, counts, turned):  # type: ignore[no-untyped-def]
    """Estimate again what is stale in the blocks `which` (C,); counts (C,) says how many voxels,
    turned (C,) whether any of them changed.

    Every voxel depends on observables alone and writes its own place: threads change nothing."""
    shares = halos.rows.shape[0]
    for share in prange(shares):
        halo = Halo(halos.listed[share], halos.rows[share], halos.first[share], halos.near[share])
        scratch = (
            np.empty((LISTS, MOST + 16), np.int32),  # 16: columns start on different cache sets
            np.empty((COLUMNS, MOST + 16), np.int32),
            np.zeros(SUMS, np.int64),
        )
        stale = np.zeros(8, np.uint64)
        start = share * which.shape[0] // shares  # blocks beside one another share cache lines
        for q in range(start, (share + 1) * which.shape[0] // shares):
            block = which[q]
            counts[q] = find_stale(
                blocks, dirty, normals.reach, block, deepest[1 + block], rule.start,
                halo.near, halo.rows, stale,
            )  # fmt: skip
            turned[q] = False
            if counts[q] > 0:
                turned[q] = _estimate_block(
                    blocks, columns.observable, normals, block, stale, rule, halo, scratch
                )
                deepest[1 + block] = _deepest(blocks, normals.reach, block)


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
        self._flags = np.zeros(0, np.bool_)
        self._halos = make_halos(SHARES)

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

    def update(self, store: VoxelStore, dirty: NDArray[np.int32]) -> tuple[int, NDArray[np.int32]]:
        """Re-estimate what `dirty` rows (D,) made stale.

        Returns (number of stale voxels, blocks in which a derived value changed)."""
        self._fit(store)
        near = np.empty(store.num_blocks, np.int32)
        sources = near[: mark_dirty(store.columns, dirty, self._dirty, self._flags, near)].copy()
        which = self._candidates(store, sources)
        counts, turned = np.empty(len(which), np.int32), np.empty(len(which), np.bool_)
        _refresh(
            store.blocks, store.columns, self.normals, self._deepest, self._dirty, which,
            self._rule, self._halos, counts, turned,
        )  # fmt: skip
        self._dirty[sources] = 0
        self._deepest[0] = self._deepest[1:].max(initial=0)
        return int(counts.sum()), which[turned]

    def _candidates(self, store: VoxelStore, sources: NDArray[np.int32]) -> NDArray[np.int32]:
        """Blocks (C,) that may hold stale voxels, those with dirty ones being `sources`."""
        near = np.empty(store.num_blocks, np.int32)
        return near[: find_candidates(store.blocks, self._deepest, sources, self._flags, near)]

    def _fit(self, store: VoxelStore) -> None:
        rows, blocks = len(store.columns.block), len(store.blocks.keys)
        if len(self.normals.kind) < rows:
            self.normals = grow_all(self._memory, self.normals, self._num_rows, rows)
        if len(self._dirty) < blocks:
            grown, used = self._memory.grown, self._num_blocks
            self._deepest = grown(self._deepest, 1 + used, 1 + blocks)
            self._dirty = grown(self._dirty, 0, blocks)
            self._flags = grown(self._flags, 0, blocks)
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
