"""Local normals by the paper's adaptive cubic region (eq. 1-25), at every occupied voxel.

A region is the cube of half-side r voxels round the voxel; each occupied voxel seen from the same
side votes at its rounded centroid with weight min(points, 8). The radius follows the sign of the
paper's stationarity condition (eq. 22) from `start_radius` until it repeats: the fixed point that
eq. 16 approaches, without its dependence on the order of points (method.md 4.1, design 3.2).
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numba import njit, prange
from numpy.typing import NDArray

from facet.mapping.eigen import eigenvector
from facet.mapping.region import (
    COLUMNS,
    MOST,
    SUMS,
    collect,
    covariance,
    shape,
    within,
    within_slab,
)
from facet.mapping.settings import STEPS, MapSettings
from facet.mapping.staleness import deepen, find_stale, mark_dirty
from facet.mapping.store import VoxelStore

EMPTY, VALID, ALIGNED, THICK, SPARSE, MIXED = range(6)
CLASS_NAMES = ("empty", "valid", "aligned", "thick", "sparse", "mixed")
UNIT = 256  # normals are integers: a unit vector times this
CHUNK = 512  # voxels that a thread takes at a time
MIN_VOTES = 4  # fewer votes than this say nothing


class Normals(NamedTuple):
    """What is derived at each voxel, by row (V,)."""

    unit: NDArray[np.int16]  # (V, 3) normal towards the sensor, times UNIT
    kind: NDArray[np.uint8]  # EMPTY .. MIXED
    thickness: NDArray[np.uint8]  # thickness angle gamma (eq. 9), half degrees
    border: NDArray[np.bool_]  # at a border of its surface, where points of others mix in
    reach: NDArray[np.uint8]  # largest radius that was looked at, voxels


class Rule(NamedTuple):
    """The method's constants as the kernel wants them."""

    sigma_target: float  # w_sigma * Lambda
    w_sigma: float
    w_points: float
    growth: NDArray[np.float64]  # R_N / R (eq. 19) by number of votes, clamped
    floor2: float  # squared sigma floor, (1/8 voxel)^2
    tan_theta: float
    epsilon: float
    offset: float  # 1/8 voxels, of a voxel from the plane of its own region
    border: float  # 1/8 voxels per voxel of radius, in the plane, from the centroid of the region
    slab: float  # 1/8 voxels, half width of the slab that votes in the second look
    passes: int
    shrink: int
    least_first: int
    start: int
    largest: int
    sparse: int


def make_rule(settings: MapSettings) -> Rule:
    """Tabulate eq. 19-20; eq. 25 gives the weights from epsilon and Lambda."""
    w_sigma = settings.gain * settings.epsilon / settings.lambda_target
    counts = np.arange(4 * settings.n_max + 1)
    few = (settings.n_0 - counts) / (settings.n_0 - settings.n_min)
    many = -(counts - settings.n_0) / (settings.n_max - settings.n_0)
    alpha = np.clip(
        np.where(counts < settings.n_0, few, many), -settings.alpha_clip, settings.alpha_clip
    )
    growth = settings.tan_base ** np.tan(settings.tan_slope * math.pi / 2 * alpha)
    return Rule(
        sigma_target=w_sigma * settings.lambda_target,
        w_sigma=w_sigma,
        w_points=settings.gain - w_sigma,
        growth=growth,
        floor2=(settings.sigma_floor * STEPS) ** 2,
        tan_theta=math.tan(math.radians(settings.theta_deg)),
        epsilon=settings.epsilon,
        offset=settings.own_offset * STEPS,
        border=settings.border * STEPS,
        slab=settings.slab * STEPS,
        passes=settings.passes,
        shrink=settings.shrink,
        least_first=settings.least_first,
        start=settings.start_radius,
        largest=settings.max_radius,
        sparse=MIN_VOTES,
    )


@njit(cache=True, nogil=True)
def _step(sums, r, rule):  # type: ignore[no-untyped-def]
    """The next radius by eq. 16-20: at least one voxel up or down, at most double or half."""
    votes = min(sums[0], rule.growth.shape[0] - 1)
    growth = rule.growth[votes]
    ratio = 1e-3
    if sums[0] >= 4:
        ratio, _, _ = shape(sums, rule.floor2)
    factor = 1.0 + rule.sigma_target / ratio - rule.w_sigma + rule.w_points * (growth - 1.0)
    factor = min(2.0, max(0.5, factor))
    r_next = np.int64(np.floor(r * factor + 0.5))
    if r_next == r:
        r_next = r + 1 if factor > 1.0 else r - 1
    return min(rule.largest, max(1, r_next))


@njit(cache=True, nogil=True)
def _find_radius(blocks, observable, block, local, view, least, rule, votes, shells, sums):  # type: ignore[no-untyped-def]
    """Follow the radius until it repeats; of a cycle the smallest. (radius, reach, votes): reach is
    the largest radius that was looked at, and so far `votes` are listed."""
    r = rule.start
    reach = r
    count = collect(blocks, observable, block, local, r, view, least, votes, shells)
    visited = np.int64(0)
    while True:
        within(shells, r, sums)
        visited |= np.int64(1) << r
        r_next = _step(sums, r, rule)
        if r_next == r or (visited >> r_next) & 1:
            return min(r, r_next), reach, count
        r = r_next
        if r > reach:
            reach = r
            count = collect(blocks, observable, block, local, r, view, least, votes, shells)


@njit(cache=True, nogil=True)
def _estimate(blocks, observable, block, local, rule, votes, shells, sums):  # type: ignore[no-untyped-def]
    """(class, nx, ny, nz, gamma in half degrees, at a border, reach) of one voxel."""
    seen = observable[blocks.rows[block, local]]
    if seen == 0:
        return EMPTY, 0, 0, 0, 0, False, 0
    view = (
        float(((seen >> 16) & 31) - 8),
        float(((seen >> 21) & 31) - 8),
        float(((seen >> 26) & 31) - 8),
    )
    least = -0.5 * np.sqrt(view[0] * view[0] + view[1] * view[1] + view[2] * view[2])  # cos 120 deg
    mixed = ((seen >> 31) & 1) == 1
    if mixed:  # seen from opposite directions: any side may vote until a normal is known
        least = -np.inf
    r, reach, count = _find_radius(
        blocks, observable, block, local, view, least, rule, votes, shells, sums
    )
    within(shells, r, sums)
    if sums[0] < rule.sparse:
        return SPARSE, 0, 0, 0, 0, False, reach
    kind, nx, ny, nz, tan_gamma = _classify(sums, seen, rule)
    if kind == THICK and tan_gamma <= rule.tan_theta:  # beside a plane, not on it: a noise shell
        return kind, 0, 0, 0, 255, False, reach
    cx, cy, cz = seen & 15, (seen >> 4) & 15, (seen >> 8) & 15
    first = r  # the region that gives the first normal: smaller where the full one is thick
    while kind != ALIGNED:
        passes = 1 if kind == VALID else rule.passes
        for _ in range(passes):  # look again: its own side, by the normal, and its own slab
            own = nx * cx + ny * cy + nz * cz
            within_slab(votes, count, r, nx, ny, nz, own, rule.slab, sums)
            if sums[0] < rule.sparse:
                return SPARSE, 0, 0, 0, 0, False, reach
            kind, nx, ny, nz, tan_gamma = _classify(sums, seen, rule)
        first -= 1
        if kind == VALID or first < max(1, r - rule.shrink):
            break
        within(shells, first, sums)
        if sums[0] < rule.least_first:
            break
        _, nx, ny, nz, _ = _classify(sums, seen, rule)
        kind = THICK
    if mixed and kind == VALID and nx * view[0] + ny * view[1] + nz * view[2] < 4.0:
        kind = MIXED  # both sides of a thin thing, not one side from two directions
    half_degrees = np.int64(np.floor(np.arctan(tan_gamma) * 114.59155902616465 + 0.5))
    return (
        kind,
        np.int64(np.floor(nx * UNIT + 0.5)),
        np.int64(np.floor(ny * UNIT + 0.5)),
        np.int64(np.floor(nz * UNIT + 0.5)),
        half_degrees,
        _at_border(sums, seen, r, nx, ny, nz, rule),
        reach,
    )


@njit(cache=True, nogil=True)
def _at_border(sums, seen, r, nx, ny, nz, rule):  # type: ignore[no-untyped-def]
    """Whether the votes lie to one side of the voxel, in the plane."""
    w = float(sums[1])
    dx = sums[2] / w - (seen & 15)
    dy = sums[3] / w - ((seen >> 4) & 15)
    dz = sums[4] / w - ((seen >> 8) & 15)
    along = nx * dx + ny * dy + nz * dz
    return (dx * dx + dy * dy + dz * dz) - along * along > (rule.border * r) ** 2


@njit(cache=True, nogil=True)
def _classify(sums, seen, rule):  # type: ignore[no-untyped-def]
    """(class, normal towards the view, tan gamma) of the voxel with observable `seen`."""
    cx, cy, cz = seen & 15, (seen >> 4) & 15, (seen >> 8) & 15
    vx, vy, vz = ((seen >> 16) & 31) - 8, ((seen >> 21) & 31) - 8, ((seen >> 26) & 31) - 8
    ratio, tan_gamma, v3 = shape(sums, rule.floor2)
    a, b, c, d, e, f = covariance(sums)
    nx, ny, nz = eigenvector(a, b, c, d, e, f, v3)
    if nx * vx + ny * vy + nz * vz < 0.0:
        nx, ny, nz = -nx, -ny, -nz
    if ratio < rule.epsilon or sums[11] > 0:
        return ALIGNED, nx, ny, nz, tan_gamma
    w = float(sums[1])  # the voxel itself must lie on the plane of its region: no noise shells
    own = nx * (cx - sums[2] / w) + ny * (cy - sums[3] / w) + nz * (cz - sums[4] / w)
    if tan_gamma > rule.tan_theta or abs(own) > rule.offset:
        return THICK, nx, ny, nz, tan_gamma
    return VALID, nx, ny, nz, tan_gamma


@njit(cache=True, nogil=True, parallel=True)
def _estimate_rows(blocks, columns, normals, rows, rule, changed):  # type: ignore[no-untyped-def]
    """Estimate rows (S,), write what they derive to, and mark those whose derived values changed.

    Every row depends on observables alone and writes its own place: threads change nothing."""
    chunks = (rows.shape[0] + CHUNK - 1) // CHUNK
    for chunk in prange(chunks):
        votes = np.empty((MOST, COLUMNS))
        shells = np.zeros((rule.largest + 1, SUMS), np.int64)
        sums = np.zeros(SUMS, np.int64)
        for s in range(chunk * CHUNK, min(rows.shape[0], (chunk + 1) * CHUNK)):
            changed[s] = _estimate_row(blocks, columns, normals, rows[s], rule, votes, shells, sums)


@njit(cache=True, nogil=True)
def _estimate_row(blocks, columns, normals, row, rule, votes, shells, sums):  # type: ignore[no-untyped-def]
    """Estimate one row and write it. Whether anything changed."""
    kind, nx, ny, nz, gamma, border, reach = _estimate(
        blocks,
        columns.observable,
        columns.block[row],
        columns.local[row],
        rule,
        votes,
        shells,
        sums,
    )
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
    return changed


def estimate(
    store: VoxelStore, normals: Normals, rows: NDArray[np.int32], rule: Rule
) -> NDArray[np.bool_]:
    """Estimate the normals of `rows` (S,) in place. Returns (S,) whether each of them changed."""
    changed = np.empty(len(rows), np.bool_)
    _estimate_rows(store.blocks, store.columns, normals, rows, rule, changed)
    return changed


class NormalField:
    """Normals of all voxels, kept true to the store by re-estimating the stale ones only."""

    def __init__(self, settings: MapSettings) -> None:
        self._rule = make_rule(settings)
        self.normals = Normals(
            np.zeros((0, 3), np.int16),
            np.zeros(0, np.uint8),
            np.zeros(0, np.uint8),
            np.zeros(0, np.bool_),
            np.zeros(0, np.uint8),
        )
        self._flags = np.zeros(0, np.bool_)
        self._deepest = np.zeros(2, np.int32)  # [unused, largest of all, by block ...]
        self._dirty_mask = np.zeros((0, 8), np.uint64)
        self._block_flags = np.zeros(0, np.bool_)

    def update(
        self, store: VoxelStore, dirty: NDArray[np.int32]
    ) -> tuple[NDArray[np.int32], NDArray[np.int32]]:
        """Re-estimate what `dirty` rows (D,) made stale.

        Returns (stale rows (S,), rows whose derived values changed (C,))."""
        self._fit(store)
        stale = self.stale(store, dirty)
        changed = estimate(store, self.normals, stale, self._rule)
        deepen(store.blocks, store.columns, stale, self.normals.reach, self._deepest)
        return stale, stale[changed]

    def stale(self, store: VoxelStore, dirty: NDArray[np.int32]) -> NDArray[np.int32]:
        """Rows (S,) whose region, as far as it was looked at, holds a dirty voxel."""
        out_blocks = np.empty(len(dirty), np.int32)
        count = mark_dirty(store.columns, dirty, self._dirty_mask, self._block_flags, out_blocks)
        dirty_blocks = out_blocks[:count]
        out = np.empty(store.num_rows, np.int32)
        num = find_stale(
            store.blocks, store.columns, self.normals.reach, self._deepest, dirty,
            self._dirty_mask, dirty_blocks, self._flags, out,
        )  # fmt: skip
        self._dirty_mask[dirty_blocks] = 0
        return out[:num].copy()

    def _fit(self, store: VoxelStore) -> None:
        rows, blocks = len(store.columns.block), len(store.blocks.keys)
        if len(self._flags) < rows:
            more = rows - len(self._flags)
            self.normals = Normals(
                *(
                    np.concatenate([c, np.zeros((more, *c.shape[1:]), c.dtype)])
                    for c in self.normals
                )
            )
            self._flags = np.zeros(rows, np.bool_)
        if len(self._dirty_mask) < blocks:
            more = blocks - len(self._dirty_mask)
            self._deepest = np.concatenate([self._deepest, np.zeros(more, np.int32)])
            self._dirty_mask = np.zeros((blocks, 8), np.uint64)
            self._block_flags = np.zeros(blocks, np.bool_)


__all__ = ["CLASS_NAMES", "NormalField", "Normals", "Rule", "estimate", "make_rule"]
