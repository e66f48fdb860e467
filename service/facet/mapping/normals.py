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
from numba import njit
from numpy.typing import NDArray

from facet.mapping.bits import box_mask, trailing_zeros
from facet.mapping.blocks import find, pack, unpack
from facet.mapping.eigen import eigenvalues, eigenvector
from facet.mapping.settings import STEPS, MapSettings
from facet.mapping.store import VoxelStore

EMPTY, VALID, ALIGNED, THICK, SPARSE, MIXED = range(6)
CLASS_NAMES = ("empty", "valid", "aligned", "thick", "sparse", "mixed")
UNIT = 256  # normals are integers: a unit vector times this
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
def _gather(blocks, observable, block, local, r, ax, ay, az, least, own, slab, sums):  # type: ignore[no-untyped-def]
    """Sum the votes of a region into sums: votes, weight, w x, y, z, w xx, xy, xz, yy, yz, zz,
    pose (0 unknown, -1 many). A voxel votes if its view direction times (ax, ay, az) is over
    `least` times the length of both, the length of (ax, ay, az) counted into `least`."""
    for s in range(12):
        sums[s] = 0
    x, y, z = local & 7, (local >> 3) & 7, local >> 6
    bi, bj, bk = unpack(blocks.keys[block])
    for dk in range((z - r) >> 3, ((z + r) >> 3) + 1):
        z0, z1 = max(0, z - r - 8 * dk), min(7, z + r - 8 * dk)
        for dj in range((y - r) >> 3, ((y + r) >> 3) + 1):
            y0, y1 = max(0, y - r - 8 * dj), min(7, y + r - 8 * dj)
            for di in range((x - r) >> 3, ((x + r) >> 3) + 1):
                if -1 <= di <= 1 and -1 <= dj <= 1 and -1 <= dk <= 1:
                    other = blocks.neighbours[block, (di + 1) + 3 * (dj + 1) + 9 * (dk + 1)]
                    if di == 0 and dj == 0 and dk == 0:
                        other = block
                else:
                    other = find(
                        blocks.table_keys, blocks.table_values, pack(bi + di, bj + dj, bk + dk)
                    )
                if other < 0:
                    continue
                x0, x1 = max(0, x - r - 8 * di), min(7, x + r - 8 * di)
                mask = box_mask(x0, x1, y0, y1)
                for oz in range(z0, z1 + 1):
                    word = blocks.occupied[other, oz] & mask
                    while word != np.uint64(0):
                        bit = np.int64(trailing_zeros(word))
                        word &= word - np.uint64(1)
                        seen = observable[blocks.rows[other, 64 * oz + bit]]
                        if (seen >> 31) & 1 and -np.inf < least < 0.0:  # its side needs a normal
                            continue
                        vx = ((seen >> 16) & 31) - 8
                        vy = ((seen >> 21) & 31) - 8
                        vz = ((seen >> 26) & 31) - 8
                        dot = ax * vx + ay * vy + az * vz
                        length2 = vx * vx + vy * vy + vz * vz
                        if least < 0.0:
                            if dot < 0.0 and dot * dot > least * least * length2:
                                continue
                        elif dot <= 0.0:
                            continue
                        w = (seen >> 12) & 15
                        cx = 8 * ((bit & 7) + 8 * di - x) + (seen & 15)
                        cy = 8 * ((bit >> 3) + 8 * dj - y) + ((seen >> 4) & 15)
                        cz = 8 * (oz + 8 * dk - z) + ((seen >> 8) & 15)
                        if abs(ax * cx + ay * cy + az * cz - own) > slab:
                            continue
                        sums[0] += 1
                        sums[1] += w
                        wx, wy, wz = w * cx, w * cy, w * cz
                        sums[2] += wx
                        sums[3] += wy
                        sums[4] += wz
                        sums[5] += wx * cx
                        sums[6] += wx * cy
                        sums[7] += wx * cz
                        sums[8] += wy * cy
                        sums[9] += wy * cz
                        sums[10] += wz * cz
                        pose = (seen >> 32) & 0x1FFFF
                        if pose == 0:
                            sums[11] = -1
                        elif sums[11] == 0:
                            sums[11] = pose
                        elif sums[11] != pose:
                            sums[11] = -1


@njit(cache=True, nogil=True)
def _covariance(sums):  # type: ignore[no-untyped-def]
    """(xx, yy, zz, xy, xz, yz) of the votes, population form (eq. 3), (1/8 voxel)^2."""
    w = float(sums[1])
    mx, my, mz = sums[2] / w, sums[3] / w, sums[4] / w
    return (
        sums[5] / w - mx * mx,
        sums[8] / w - my * my,
        sums[10] / w - mz * mz,
        sums[6] / w - mx * my,
        sums[7] / w - mx * mz,
        sums[9] / w - my * mz,
    )


@njit(cache=True, nogil=True)
def _shape(sums, floor2):  # type: ignore[no-untyped-def]
    """(lambda of eq. 18, tan gamma of eq. 9, third eigenvalue unfloored) with floored variances."""
    a, b, c, d, e, f = _covariance(sums)
    v1, v2, v3 = eigenvalues(a, b, c, d, e, f)
    s1, s2, s3 = max(v1, floor2), max(v2, floor2), max(v3, floor2)
    return s2 / np.sqrt(s1 * s3), 1.1547005383792515 * np.sqrt(s3 / np.sqrt(s1 * s2)), v3


@njit(cache=True, nogil=True)
def _step(sums, r, rule):  # type: ignore[no-untyped-def]
    """The next radius by eq. 16-20: at least one voxel up or down, at most double or half."""
    votes = min(sums[0], rule.growth.shape[0] - 1)
    growth = rule.growth[votes]
    shape = 1e-3
    if sums[0] >= 4:
        shape, _, _ = _shape(sums, rule.floor2)
    factor = 1.0 + rule.sigma_target / shape - rule.w_sigma + rule.w_points * (growth - 1.0)
    factor = min(2.0, max(0.5, factor))
    r_next = np.int64(np.floor(r * factor + 0.5))
    if r_next == r:
        r_next = r + 1 if factor > 1.0 else r - 1
    return min(rule.largest, max(1, r_next))


@njit(cache=True, nogil=True)
def _estimate(blocks, observable, block, local, rule, sums):  # type: ignore[no-untyped-def]
    """(class, nx, ny, nz, gamma in half degrees, at a border, reach) of one voxel."""
    seen = observable[blocks.rows[block, local]]
    if seen == 0:
        return EMPTY, 0, 0, 0, 0, False, 0
    vx = float(((seen >> 16) & 31) - 8)
    vy = float(((seen >> 21) & 31) - 8)
    vz = float(((seen >> 26) & 31) - 8)
    least = -0.5 * np.sqrt(vx * vx + vy * vy + vz * vz)  # cos 120 degrees
    mixed = ((seen >> 31) & 1) == 1
    if mixed:  # seen from opposite directions: any side may vote until a normal is known
        least = -np.inf
    r = rule.start
    reach = r
    visited = np.int64(0)
    while True:
        _gather(blocks, observable, block, local, r, vx, vy, vz, least, 0.0, np.inf, sums)
        visited |= np.int64(1) << r
        r_next = _step(sums, r, rule)
        if r_next == r or (visited >> r_next) & 1:
            break
        r = r_next
        reach = max(reach, r)
    if r_next < r:  # the smallest radius of the cycle
        r = r_next
        _gather(blocks, observable, block, local, r, vx, vy, vz, least, 0.0, np.inf, sums)
    if sums[0] < rule.sparse:
        return SPARSE, 0, 0, 0, 0, False, reach
    kind, nx, ny, nz, tan_gamma = _classify(sums, seen, rule)
    if kind == THICK and tan_gamma <= rule.tan_theta:  # beside a plane, not on it: a noise shell
        return kind, 0, 0, 0, 255, False, reach
    cx, cy, cz = seen & 15, (seen >> 4) & 15, (seen >> 8) & 15
    first = r  # the region that gives the first normal: smaller where the full one is thick
    while kind != ALIGNED:
        for _ in range(rule.passes):  # look again: its own side, by the normal, and its own slab
            own = nx * cx + ny * cy + nz * cz
            _gather(blocks, observable, block, local, r, nx, ny, nz, 0.0, own, rule.slab, sums)
            if sums[0] < rule.sparse:
                return SPARSE, 0, 0, 0, 0, False, reach
            kind, nx, ny, nz, tan_gamma = _classify(sums, seen, rule)
        first -= 1
        if kind == VALID or first < max(1, r - rule.shrink):
            break
        _gather(blocks, observable, block, local, first, vx, vy, vz, least, 0.0, np.inf, sums)
        if sums[0] < rule.least_first:
            break
        _, nx, ny, nz, _ = _classify(sums, seen, rule)
        kind = THICK
    if mixed and kind == VALID and nx * vx + ny * vy + nz * vz < 4.0:
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
    shape, tan_gamma, v3 = _shape(sums, rule.floor2)
    a, b, c, d, e, f = _covariance(sums)
    nx, ny, nz = eigenvector(a, b, c, d, e, f, v3)
    if nx * vx + ny * vy + nz * vz < 0.0:
        nx, ny, nz = -nx, -ny, -nz
    if shape < rule.epsilon or sums[11] > 0:
        return ALIGNED, nx, ny, nz, tan_gamma
    w = float(sums[1])  # the voxel itself must lie on the plane of its region: no noise shells
    own = nx * (cx - sums[2] / w) + ny * (cy - sums[3] / w) + nz * (cz - sums[4] / w)
    if tan_gamma > rule.tan_theta or abs(own) > rule.offset:
        return THICK, nx, ny, nz, tan_gamma
    return VALID, nx, ny, nz, tan_gamma


@njit(cache=True, nogil=True)
def _estimate_rows(blocks, columns, normals, rows, rule, changed):  # type: ignore[no-untyped-def]
    """Estimate rows (S,), write what they derive to, and mark those whose derived values changed."""
    sums = np.zeros(12, np.int64)
    for s in range(rows.shape[0]):
        row = rows[s]
        kind, nx, ny, nz, gamma, border, reach = _estimate(
            blocks, columns.observable, columns.block[row], columns.local[row], rule, sums
        )
        unit = normals.unit[row]
        changed[s] = (
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


def estimate(
    store: VoxelStore, normals: Normals, rows: NDArray[np.int32], rule: Rule
) -> NDArray[np.bool_]:
    """Estimate the normals of `rows` (S,) in place. Returns (S,) whether each of them changed."""
    changed = np.empty(len(rows), np.bool_)
    _estimate_rows(store.blocks, store.columns, normals, rows, rule, changed)
    return changed


@njit(cache=True, nogil=True)
def _stale(blocks, columns, reach, deepest, dirty_rows, dirty_mask, dirty_blocks, flags, out):  # type: ignore[no-untyped-def]
    """Rows whose region, as far as they looked, holds a dirty voxel. dirty_mask (B, 8) has a bit
    per dirty voxel; flags (V,) is scratch and comes back clear. Returns how many."""
    count = 0
    for d in range(dirty_rows.shape[0]):  # a dirty voxel is stale itself
        row = dirty_rows[d]
        flags[row] = True
        out[count] = row
        count += 1
    for q in range(dirty_blocks.shape[0]):
        source = dirty_blocks[q]
        bi, bj, bk = unpack(blocks.keys[source])
        for n in range(343):
            di, dj, dk = n % 7 - 3, (n // 7) % 7 - 3, n // 49 - 3
            gap = max(0, 8 * max(abs(di), abs(dj), abs(dk)) - 7)
            if gap <= 8:
                if di == 0 and dj == 0 and dk == 0:
                    target = source
                else:
                    target = blocks.neighbours[source, (di + 1) + 3 * (dj + 1) + 9 * (dk + 1)]
            else:
                if gap > deepest[1]:
                    continue
                key = pack(bi + di, bj + dj, bk + dk)
                target = find(blocks.table_keys, blocks.table_values, key)
            if target < 0 or deepest[2 + target] < gap:
                continue
            for tz in range(8):
                word = blocks.occupied[target, tz]
                while word != np.uint64(0):
                    bit = np.int64(trailing_zeros(word))
                    word &= word - np.uint64(1)
                    row = blocks.rows[target, 64 * tz + bit]
                    if flags[row]:
                        continue
                    r = np.int64(reach[row])
                    x = (bit & 7) + 8 * di
                    y = (bit >> 3) + 8 * dj
                    z = tz + 8 * dk
                    x0, x1, y0, y1 = max(0, x - r), min(7, x + r), max(0, y - r), min(7, y + r)
                    if x0 > x1 or y0 > y1:
                        continue
                    mask = box_mask(x0, x1, y0, y1)
                    for sz in range(max(0, z - r), min(7, z + r) + 1):
                        if dirty_mask[source, sz] & mask:
                            flags[row] = True
                            out[count] = row
                            count += 1
                            break
    for s in range(count):
        flags[out[s]] = False
    return count


@njit(cache=True, nogil=True)
def _mark(columns, rows, dirty_mask, block_flags, out):  # type: ignore[no-untyped-def]
    """Set the rows' bits in dirty_mask and list their blocks once. Returns how many blocks."""
    count = 0
    for d in range(rows.shape[0]):
        block, local = columns.block[rows[d]], columns.local[rows[d]]
        dirty_mask[block, local >> 6] |= np.uint64(1) << np.uint64(local & 63)
        if not block_flags[block]:
            block_flags[block] = True
            out[count] = block
            count += 1
    for q in range(count):
        block_flags[out[q]] = False
    return count


@njit(cache=True, nogil=True)
def _deepen(blocks, columns, rows, reach, deepest):  # type: ignore[no-untyped-def]
    """Refresh, for the rows' blocks, the largest reach of a block's voxels (deepest[2 + block])."""
    for s in range(rows.shape[0]):
        deepest[2 + columns.block[rows[s]]] = 0
    for s in range(rows.shape[0]):
        block = columns.block[rows[s]]
        if deepest[2 + block] > 0:
            continue
        largest = 0
        for local in range(512):
            row = blocks.rows[block, local]
            if row >= 0:
                largest = max(largest, np.int64(reach[row]))
        deepest[2 + block] = max(1, largest)
        deepest[1] = max(deepest[1], largest)


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
        _deepen(store.blocks, store.columns, stale, self.normals.reach, self._deepest)
        return stale, stale[changed]

    def stale(self, store: VoxelStore, dirty: NDArray[np.int32]) -> NDArray[np.int32]:
        """Rows (S,) whose region, as far as it was looked at, holds a dirty voxel."""
        out_blocks = np.empty(len(dirty), np.int32)
        count = _mark(store.columns, dirty, self._dirty_mask, self._block_flags, out_blocks)
        dirty_blocks = out_blocks[:count]
        out = np.empty(store.num_rows, np.int32)
        num = _stale(
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
