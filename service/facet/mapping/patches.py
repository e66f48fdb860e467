"""Patches: inside a block, valid voxels with like normals and offsets; leftovers join a neighbour.

Grouping reads observables only (rounded centroids, one vote a voxel, rounded normals). Beside it a
patch carries the spread of its members' points as a rung.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numba import prange
from numpy.typing import NDArray

from facet.mapping.blocks import list_rows, list_voxels, row_at
from facet.mapping.candidates import HALF, OFFSET_STEP
from facet.mapping.claims import CLAIMS, label_blocks
from facet.mapping.kernel import kernel
from facet.mapping.memory import Heap, Memory, sparse
from facet.mapping.normals import VALID, Normals
from facet.mapping.rungs import FIRST_RUNG, LIMITS, RUNG_STEP, RUNGS, read_rungs
from facet.mapping.runs import SHARES, dealt
from facet.mapping.settings import PER_BLOCK, STEPS, VOXELS, MapSettings
from facet.mapping.store import VoxelStore
from facet.mapping.unsettled import WAS, find_dependents, unsettle

NORMAL_STEPS = 128.0  # the normal of a patch, as labels see it, is rounded to so many of one
FEW = 512  # blocks that are not worth waking other threads for


class Patches(NamedTuple):
    """Patches by block and index (B, PER_BLOCK, ...), and labels by voxel row (V,)."""

    number: NDArray[np.int8]  # (B,) patches of a block
    votes: NDArray[np.int16]  # member voxels
    centroid: NDArray[np.int32]  # (.., 3) sum of rounded centroids, 1/8 voxel from the block corner
    scatter: NDArray[np.int32]  # (.., 6) sum of their products xx, xy, xz, yy, yz, zz
    unit: NDArray[np.int32]  # (.., 3) sum of the members' normals, times UNIT
    box: NDArray[np.int8]  # (.., 6) least and largest local x, y, z of the members
    plane: NDArray[np.int16]  # (.., 5) as the labels of voxels see it, see _round_plane
    rung: NDArray[np.int8]  # of sigma_N
    counted: NDArray[np.int16]  # votes that stand in the histogram of rungs
    far: NDArray[np.bool_]  # (B,) the block's labels may depend on patches two blocks away, not one
    member: NDArray[np.int8]  # (V,) index of the patch that a valid voxel belongs to, -1: none
    label: NDArray[np.int16]  # (V,) 16 * neighbour + index: the patch that a voxel goes with, -1:
    # none; less by UNSETTLED between grouping and labelling
    second: NDArray[np.int16]  # (V,) another patch, at an angle, that claims a corner voxel


class Grouping(NamedTuple):
    """Tolerances, from theta and the voxel alone."""

    cos_angle: float
    offset: float  # 1/8 voxels, of a member from its patch
    leftover: float  # 1/8 voxels, of a leftover from its patch


def empty_patches() -> Patches:
    shape = (0, PER_BLOCK)
    return Patches(
        number=np.zeros(0, np.int8),
        votes=np.zeros(shape, np.int16),
        centroid=np.zeros((*shape, 3), np.int32),
        scatter=np.zeros((*shape, 6), np.int32),
        unit=np.zeros((*shape, 3), np.int32),
        box=np.zeros((*shape, 6), np.int8),
        plane=np.zeros((*shape, 5), np.int16),
        rung=np.zeros(shape, np.int8),
        counted=np.zeros(shape, np.int16),
        far=np.zeros(0, np.bool_),
        member=np.zeros(0, np.int8),
        label=np.zeros(0, np.int16),
        second=np.zeros(0, np.int16),
    )


GROUP = (
    np.dtype(  # scratch of one thread: patches of a block by index, sums in eighths from its corner
        [
            ("votes", np.int64, (PER_BLOCK,)),
            ("centroid", np.int64, (PER_BLOCK, 3)),
            ("scatter", np.int64, (PER_BLOCK, 6)),
            ("unit", np.int64, (PER_BLOCK, 3)),
            ("box", np.int64, (PER_BLOCK, 6)),
            ("label", np.int64, (VOXELS,)),  # by place, -1: none
            ("rows", np.int64, (VOXELS,)),
            ("places", np.int64, (VOXELS,)),
            ("order", np.int32, (VOXELS,)),
        ],
        align=True,
    )
)


@kernel(allocates=False)
def _join(own, count, c, n, grouping):  # type: ignore[no-untyped-def]
    """Index of the patch that takes a voxel at c (eighths) with normal n; -1: none."""
    votes, centroid, unit = own.votes, own.centroid, own.unit
    size = np.sqrt(float(n[0] * n[0] + n[1] * n[1] + n[2] * n[2]))
    best, best_cost = -1, 2.0
    for p in range(count):
        ux, uy, uz = float(unit[p, 0]), float(unit[p, 1]), float(unit[p, 2])
        length = np.sqrt(ux * ux + uy * uy + uz * uz)
        cos = (ux * n[0] + uy * n[1] + uz * n[2]) / (length * size)
        if cos < grouping.cos_angle:
            continue
        v = float(votes[p])
        dx, dy, dz = c[0] - centroid[p, 0] / v, c[1] - centroid[p, 1] / v, c[2] - centroid[p, 2] / v
        w = (ux * dx + uy * dy + uz * dz) / length
        if abs(w) > grouping.offset:
            continue
        cost = (1.0 - cos) / (1.0 - grouping.cos_angle) + (w / grouping.offset) ** 2
        if cost < best_cost:
            best, best_cost = p, cost
    return best


@kernel
def _group(blocks, observable, normals, block, grouping, own):  # type: ignore[no-untyped-def]
    """Group a block's valid voxels, best thickness angle first. Returns how many patches."""
    votes, centroid, scatter, unit, box = own.votes, own.centroid, own.scatter, own.unit, own.box
    label, rows, places, order = own.label, own.rows, own.places, own.order
    votes[:] = 0
    centroid[:] = 0
    scatter[:] = 0
    unit[:] = 0
    num = 0
    for v in range(list_voxels(blocks, block, blocks.occupied[block], rows, places)):
        order[num] = (np.int32(normals.thickness[rows[v]]) << 9) | places[v]
        num += normals.kind[rows[v]] == VALID
    ordered = np.sort(order[:num])
    label[:] = -1
    count = 0
    for o in range(num):
        local = ordered[o] & 511
        row = row_at(blocks, block, local)
        seen = observable[row]
        x, y, z = local & 7, (local >> 3) & 7, local >> 6
        c = 8 * x + (seen & 15), 8 * y + ((seen >> 4) & 15), 8 * z + ((seen >> 8) & 15)
        u = normals.unit[row]
        n = np.int64(u[0]), np.int64(u[1]), np.int64(u[2])
        p = _join(own, count, c, n, grouping)
        if p < 0:
            if count == PER_BLOCK:
                continue
            p = count
            count += 1
            box[p, :3] = 8
            box[p, 3:] = -1
        label[local] = p
        votes[p] += 1
        s = 0
        for a in range(3):
            centroid[p, a] += c[a]
            unit[p, a] += n[a]
            for b in range(a, 3):
                scatter[p, s] += c[a] * c[b]
                s += 1
        box[p, 0], box[p, 1], box[p, 2] = min(box[p, 0], x), min(box[p, 1], y), min(box[p, 2], z)
        box[p, 3], box[p, 4], box[p, 5] = max(box[p, 3], x), max(box[p, 4], y), max(box[p, 5], z)
    return count


@kernel(allocates=False)
def _round_plane(votes, centroid, unit, plane):  # type: ignore[no-untyped-def]
    """A patch as the labels of voxels see it: its normal in NORMAL_STEPS, its offset from the
    middle of the block in OFFSET_STEP, and the bit length of its votes. Most changes of its members
    leave it as it is. Writes plane (5,); whether it is another now."""
    u = unit[0], unit[1], unit[2]
    scale = NORMAL_STEPS / np.sqrt(float(u[0] * u[0] + u[1] * u[1] + u[2] * u[2]))
    x, y, z = np.rint(u[0] * scale), np.rint(u[1] * scale), np.rint(u[2] * scale)
    along = (
        x * (centroid[0] / votes - HALF)
        + y * (centroid[1] / votes - HALF)
        + z * (centroid[2] / votes - HALF)
    ) / np.sqrt(x * x + y * y + z * z)
    size = 0
    while votes >> size:
        size += 1
    changed = False
    for a, value in enumerate((x, y, z, np.rint(along / OFFSET_STEP), float(size))):
        changed |= plane[a] != value
        plane[a] = np.int16(value)
    return changed


@kernel(allocates=False)
def _store(blocks, patches, block, count, own, was):  # type: ignore[no-untyped-def]
    """Write a block's grouping, and to `was` what labels saw of the last. Whether anything of it
    is another now."""
    votes, centroid, scatter, unit, box = own.votes, own.centroid, own.scatter, own.unit, own.box
    label, rows, places = own.label, own.rows, own.places
    was.number = patches.number[block]
    changed, others = was.number != count, np.int64(0)
    patches.number[block] = count
    for p in range(max(count, was.number)):
        for a in range(5):
            was.plane[p, a] = patches.plane[block, p, a]
        other = (p < count) != (p < was.number)
        if p >= count:
            others |= np.int64(other) << p
            continue
        changed |= patches.votes[block, p] != votes[p]
        patches.votes[block, p] = votes[p]
        for a in range(3):
            changed |= patches.centroid[block, p, a] != centroid[p, a]
            changed |= patches.unit[block, p, a] != unit[p, a]
            patches.centroid[block, p, a] = centroid[p, a]
            patches.unit[block, p, a] = unit[p, a]
        for a in range(6):
            changed |= patches.scatter[block, p, a] != scatter[p, a]
            other |= patches.box[block, p, a] != box[p, a]
            patches.scatter[block, p, a] = scatter[p, a]
            patches.box[block, p, a] = box[p, a]
        other |= _round_plane(votes[p], centroid[p], unit[p], patches.plane[block, p])
        others |= np.int64(other) << p
    was.other = others
    for v in range(list_rows(blocks, block, rows, places)):
        row, member = rows[v], label[places[v]]
        if patches.member[row] != member:
            changed = True
            patches.member[row] = member
            unsettle(patches.label, rows[v : v + 1])
    return changed or others != 0


@kernel
def _group_some(  # type: ignore[no-untyped-def]
    blocks, observable, normals, patches, which, start, stop, grouping, own, changed, was
):
    for q in range(start, stop):
        count = _group(blocks, observable, normals, which[q], grouping, own)
        changed[q] = _store(blocks, patches, which[q], count, own, was[q])


@kernel(parallel=True)
def _group_all(  # type: ignore[no-untyped-def]
    blocks, observable, normals, patches, which, grouping, scratches, changed, was
):
    size = (which.shape[0] + SHARES - 1) // SHARES  # blocks beside one another share cache lines
    for turn in prange(SHARES):
        share = dealt(turn, SHARES)
        start, stop = share * size, min(which.shape[0], (share + 1) * size)
        _group_some(
            blocks, observable, normals, patches, which, start, stop, grouping, scratches[share],
            changed, was,
        )  # fmt: skip


class PatchField:
    """Patches of all blocks, kept true by grouping dirty blocks again."""

    def __init__(self, settings: MapSettings, memory: Memory | None = None) -> None:
        self._memory = memory or Heap()
        self._num_rows = self._num_blocks = 0
        self._grouping = Grouping(
            cos_angle=math.cos(math.radians(settings.patch_angle_deg)),
            offset=settings.patch_offset * STEPS,
            leftover=settings.leftover_offset * STEPS,
        )
        self.patches = empty_patches()
        self.histogram = np.zeros(RUNGS, np.int64)  # voxels by the rung of their patch
        self._flags = np.zeros(0, np.bool_)
        self._first = np.zeros(0, np.int32)  # changes near a block, see find_dependents
        self._groups, self._claims = sparse(SHARES, GROUP), sparse(SHARES, CLAIMS)

    def update(
        self,
        store: VoxelStore,
        normals: Normals,
        turned: NDArray[np.int32],
        dirty: NDArray[np.int32],
        seen: NDArray[np.int32],
    ) -> tuple[NDArray[np.int32], NDArray[np.int32]]:
        """Group the blocks `turned` again (normals or observables changed), label again what that
        makes stale and the rows `dirty` (observables changed), and sum the points of the blocks
        `seen`.

        Returns blocks: (patches changed), (labels changed)."""
        self._fit(store)
        changed, was = np.empty(len(turned), np.bool_), np.empty(len(turned), WAS)
        sources = store.blocks, store.columns.observable, normals, self.patches
        if len(turned) < FEW:
            scratch = self._groups[0]
            _group_some(*sources, turned, 0, len(turned), self._grouping, scratch, changed, was)
        else:
            _group_all(*sources, turned, self._grouping, self._groups, changed, was)
        unsettle(self.patches.label, dirty)
        relabelled = self._label(store, turned, was)
        other = np.union1d(seen, np.union1d(turned, relabelled))
        read_rungs(store.blocks, store.columns, normals.border, self.patches, other, self.histogram)
        return turned[changed], relabelled

    def _label(
        self, store: VoxelStore, turned: NDArray[np.int32], was: NDArray[np.void]
    ) -> NDArray[np.int32]:
        """Label again what changed in the blocks `turned`, `was` (Q,) being what they were before.
        Returns the blocks where a label changed."""
        near = np.empty(store.num_blocks, np.int32)
        links = np.empty((2, 125 * int(np.count_nonzero(was["other"]))), np.int32)
        changes = turned, was, self._first, links
        count = find_dependents(
            store.blocks, self.patches.far, turned, was, self._flags, self._first, links, near
        )
        near, relabelled = np.sort(near[:count]), np.empty(count, np.bool_)
        regrouped = np.zeros(store.num_blocks, np.bool_)
        regrouped[turned] = True
        label_blocks(
            store.blocks, store.columns.observable, self.patches, near, regrouped[near], changes,
            self._grouping.leftover, self._claims, relabelled,
        )  # fmt: skip
        self._first[near] = 0
        return near[relabelled]

    def sigma(self) -> float:
        """Noise of the scene, ticks: the median over member voxels of their patch's rung."""
        total = int(self.histogram.sum())
        if total == 0:
            return FIRST_RUNG
        rung = int(np.searchsorted(np.cumsum(self.histogram), (total + 1) // 2))
        return float(np.sqrt(LIMITS[rung] / RUNG_STEP))

    def _fit(self, store: VoxelStore) -> None:
        blocks, rows = len(store.blocks.keys), len(store.columns.block)
        if len(self._flags) < blocks:
            self._flags = np.zeros(blocks, np.bool_)
            self._first = np.zeros(blocks, np.int32)
        columns = {}
        for name, column in self.patches._asdict().items():
            by_voxel = name in ("member", "label", "second")
            capacity, used = (rows, self._num_rows) if by_voxel else (blocks, self._num_blocks)
            if len(column) < capacity:
                column = self._memory.grown(column, used, capacity)
            if by_voxel:
                column[used : store.num_rows] = -1
            columns[name] = column
        self.patches = Patches(**columns)
        self._num_rows, self._num_blocks = store.num_rows, store.num_blocks
