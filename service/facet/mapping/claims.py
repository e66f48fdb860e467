"""Who claims a voxel: its own patch, the patch a leftover joins, and a second one at corners.

A leftover (thick, aligned, mixed) joins the neighbouring patch whose plane it lies on and shares
its fate. A voxel at a corner lies on two planes: the second may use it as a vertex too.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numba import prange
from numpy.typing import NDArray

from facet.mapping.blocks import CENTRE, Blocks, find, pack, unpack
from facet.mapping.kernel import kernel
from facet.mapping.runs import dealt

LEFTOVER_REACH = 8  # voxels between a leftover and the box of the patch it joins
CLAIM_REACH = 2  # voxels between a corner voxel and the box of a patch that claims it too
PARALLEL_COS = 0.98
HALF = 32.0  # 1/8 voxels: half a block
OFFSET_STEP = 0.25  # 1/8 voxels: to so much the offset of a patch from there is rounded
CHUNK = 16  # blocks that a thread takes at a time
FEW = 128  # blocks that are not worth waking other threads for
CORNER_COS = 0.8  # planes that share a corner voxel differ by more than 37 degrees
FLAT_COS = 0.95  # planes that all are so near to one differ by less from one another
NX, NY, NZ, OFFSET, WEIGHT = range(5)  # a candidate's plane: unit normal, offset; of its size
LOW, HIGH = 5, 8  # its box: least and largest x, y, z
OFF, WAY = 11, 12  # of the voxel in turn: distance from the plane, signed way x, y, z to the box
COLUMNS = 15


class Candidates(NamedTuple):
    """Patches that may claim the voxels of a block, C of them; scratch of one thread."""

    codes: NDArray[np.int16]  # (C,) 16 * neighbour + index
    columns: NDArray[np.float64]  # (COLUMNS, C) eighths, from the corner of the block that asks
    own: NDArray[np.int64]  # (PER_BLOCK,) which of them is the block's own patch, -1: none
    angled: NDArray[np.int16]  # (N, N) for each the near ones that are at an angle to it
    num_angled: NDArray[np.int64]  # (N,) how many these are, -1: not looked up yet
    places: NDArray[np.int64]  # (125, 5) of the blocks that are asked


class Voxels(NamedTuple):
    """The voxels of a block, V of them; scratch of one thread."""

    local: NDArray[np.int64]  # (V,)
    row: NDArray[np.int64]
    seen: NDArray[np.int64]  # observables
    member: NDArray[np.int8]


@kernel
def _make_scratch(per_block):  # type: ignore[no-untyped-def]
    most, near = 125 * per_block, 27 * per_block
    found = Candidates(
        np.empty(most, np.int16), np.empty((COLUMNS, most)), np.empty(per_block, np.int64),
        np.empty((near, near), np.int16), np.empty(near, np.int64), np.empty((125, 5), np.int64),
    )  # fmt: skip
    voxels = Voxels(
        np.empty(512, np.int64), np.empty(512, np.int64), np.empty(512, np.int64),
        np.empty(512, np.int8),
    )  # fmt: skip
    return found, voxels


@kernel(allocates=False)
def _gather(blocks, observable, member, block, voxels):  # type: ignore[no-untyped-def]
    """List the voxels of a block. How many. One look-up at a time for all of them: they do not
    wait for one another."""
    count = 0
    for place in range(64):
        line = blocks.lines[block, place]
        if line == 0:
            continue
        for x in range(8):
            row = blocks.rows[line, x] - 1
            voxels.local[count] = 8 * place + x
            voxels.row[count] = row
            count += row >= 0
    for v in range(count):
        voxels.seen[v] = observable[voxels.row[v]]
    for v in range(count):
        voxels.member[v] = member[voxels.row[v]]
    return count


@kernel(allocates=False)
def _add_candidates(patches, places, num_places, tolerance, count, found):  # type: ignore[no-untyped-def]
    """Append the patches of blocks whose plane comes within `tolerance` of the block that asks.
    places (N, 5): block, code of its first patch, and blocks away along x, y, z. Returns how many
    there are now."""
    codes, columns = found.codes, found.columns
    for at in range(num_places):
        other = places[at, 0]
        sx, sy, sz = 64 * places[at, 2], 64 * places[at, 3], 64 * places[at, 4]
        for p in range(patches.number[other]):
            if count == codes.shape[0]:
                return count
            plane = patches.plane[other, p]
            ux, uy, uz = float(plane[0]), float(plane[1]), float(plane[2])
            one = 1.0 / np.sqrt(ux * ux + uy * uy + uz * uz)
            ux, uy, uz = ux * one, uy * one, uz * one
            offset = plane[3] * OFFSET_STEP + ux * (HALF + sx) + uy * (HALF + sy) + uz * (HALF + sz)
            beyond = abs(HALF * (ux + uy + uz) - offset) - HALF * (abs(ux) + abs(uy) + abs(uz))
            if beyond > tolerance:
                continue
            columns[NX, count], columns[NY, count], columns[NZ, count] = ux, uy, uz
            columns[OFFSET, count] = offset
            columns[WEIGHT, count] = 1.0 / (1 << plane[4])
            columns[LOW, count] = 8 * patches.box[other, p, 0] + sx
            columns[LOW + 1, count] = 8 * patches.box[other, p, 1] + sy
            columns[LOW + 2, count] = 8 * patches.box[other, p, 2] + sz
            columns[HIGH, count] = 8 * patches.box[other, p, 3] + 8 + sx
            columns[HIGH + 1, count] = 8 * patches.box[other, p, 4] + 8 + sy
            columns[HIGH + 2, count] = 8 * patches.box[other, p, 5] + 8 + sz
            codes[count] = places[at, 1] + p
            count += 1
    return count


@kernel
def _near_candidates(blocks, patches, block, tolerance, found):  # type: ignore[no-untyped-def]
    """Patches of a block and its 26 neighbours."""
    places, num = found.places, 0
    for n in range(27):
        other = block if n == CENTRE else np.int64(blocks.neighbours[block, n])
        if other >= 0:
            places[num, 0], places[num, 1] = other, 16 * n
            places[num, 2], places[num, 3], places[num, 4] = n % 3 - 1, n // 3 % 3 - 1, n // 9 - 1
            num += 1
    count = _add_candidates(patches, places, num, tolerance, 0, found)
    found.own[:] = -1
    for q in range(count):
        if found.codes[q] >> 4 == CENTRE:
            found.own[found.codes[q] & 15] = q
        found.num_angled[q] = -1
    return count


@kernel(allocates=False)
def _far_candidates(blocks, patches, block, tolerance, count, found):  # type: ignore[no-untyped-def]
    """Append the patches of the blocks two away: the other jamb of a door."""
    places, num = found.places, 0
    i, j, k = unpack(blocks.keys[block])
    for n in range(125):
        di, dj, dk = n % 5 - 2, (n // 5) % 5 - 2, n // 25 - 2
        if max(abs(di), abs(dj), abs(dk)) < 2:
            continue
        other = find(blocks.table_keys, blocks.table_values, pack(i + di, j + dj, k + dk))
        if other >= 0:
            places[num, 0], places[num, 1] = other, 0
            places[num, 2], places[num, 3], places[num, 4] = di, dj, dk
            num += 1
    return _add_candidates(patches, places, num, tolerance, count, found)


@kernel(allocates=False)
def _place(local, seen):  # type: ignore[no-untyped-def]
    """A voxel's rounded centroid, eighths from the block corner."""
    return (
        8 * (local & 7) + (seen & 15),
        8 * ((local >> 3) & 7) + ((seen >> 4) & 15),
        8 * (local >> 6) + ((seen >> 8) & 15),
    )


@kernel(allocates=False)
def _measure(columns, count, c):  # type: ignore[no-untyped-def]
    """How far a place is from the planes and boxes of the first `count` candidates."""
    x, y, z = float(c[0]), float(c[1]), float(c[2])
    for q in range(count):
        away = columns[NX, q] * x + columns[NY, q] * y + columns[NZ, q] * z - columns[OFFSET, q]
        columns[OFF, q] = abs(away)
    for q in range(count):
        ahead, behind = columns[LOW, q] - x, columns[HIGH, q] - x
        columns[WAY, q] = (ahead if ahead > 0.0 else 0.0) + (behind if behind < 0.0 else 0.0)
    for q in range(count):
        ahead, behind = columns[LOW + 1, q] - y, columns[HIGH + 1, q] - y
        columns[WAY + 1, q] = (ahead if ahead > 0.0 else 0.0) + (behind if behind < 0.0 else 0.0)
    for q in range(count):
        ahead, behind = columns[LOW + 2, q] - z, columns[HIGH + 2, q] - z
        columns[WAY + 2, q] = (ahead if ahead > 0.0 else 0.0) + (behind if behind < 0.0 else 0.0)


@kernel(allocates=False)
def _dot(columns, q, o):  # type: ignore[no-untyped-def]
    return (
        columns[NX, q] * columns[NX, o]
        + columns[NY, q] * columns[NY, o]
        + columns[NZ, q] * columns[NZ, o]
    )


@kernel(allocates=False)
def _gap(columns, q):  # type: ignore[no-untyped-def]
    """Chebyshev distance of the voxel in turn from a candidate's box."""
    return max(abs(columns[WAY, q]), abs(columns[WAY + 1, q]), abs(columns[WAY + 2, q]))


@kernel(allocates=False)
def _cost(columns, q, gap, tolerance):  # type: ignore[no-untyped-def]
    off = columns[OFF, q] / tolerance
    return off**2 + (gap / (8.0 * LEFTOVER_REACH)) ** 2 + columns[WEIGHT, q]


@kernel(allocates=False)
def _join(columns, count, seen, tolerance):  # type: ignore[no-untyped-def]
    """Candidate that a leftover joins, -1: none. It must face the voxel's sensor, its plane must
    be near, and so must its box."""
    v0, v1, v2 = ((seen >> 16) & 31) - 8, ((seen >> 21) & 31) - 8, ((seen >> 26) & 31) - 8
    mixed = ((seen >> 31) & 1) == 1
    best, best_cost = -1, np.inf
    for q in range(count):
        if columns[OFF, q] > tolerance:
            continue
        gap = _gap(columns, q)
        if gap > 8 * LEFTOVER_REACH:
            continue
        faces = columns[NX, q] * v0 + columns[NY, q] * v1 + columns[NZ, q] * v2
        if not mixed and faces <= 0.0:
            continue
        cost = _cost(columns, q, gap, tolerance)
        if cost < best_cost:
            best, best_cost = q, cost
    return best


@kernel(allocates=False)
def _bridged(columns, count, q, tolerance):  # type: ignore[no-untyped-def]
    """Whether the voxel in turn lies between candidate q and another of the same plane: on a
    threshold. (What is its own is none: the way to itself is no way back.)"""
    qx, qy, qz = columns[NX, q], columns[NY, q], columns[NZ, q]
    x, y, z = columns[WAY, q], columns[WAY + 1, q], columns[WAY + 2, q]
    length = x * x + y * y + z * z
    hits = 0
    for o in range(count):
        ox, oy, oz = columns[WAY, o], columns[WAY + 1, o], columns[WAY + 2, o]
        dot = x * ox + y * oy + z * oz
        lengths = length * (ox * ox + oy * oy + oz * oz)
        back = (dot < 0.0) & (dot * dot > 0.5 * lengths)
        cos = qx * columns[NX, o] + qy * columns[NY, o] + qz * columns[NZ, o]
        hits += np.int64(back & (cos >= PARALLEL_COS) & (columns[OFF, o] <= tolerance))
    return hits > 0


@kernel(allocates=False)
def _claim(found, near, count, tolerance, own):  # type: ignore[no-untyped-def]
    """Candidate of the first `near`, at an angle to `own`, that claims the voxel in turn at the
    least cost: as a corner, or as a threshold with the help of any of the `count`.

    Returns (candidate, -1: none; whether a better one was left out for want of the other jamb)."""
    columns, angled = found.columns, found.angled
    if found.num_angled[own] < 0:
        number = 0
        for q in range(near):
            if _dot(columns, q, own) <= CORNER_COS:
                angled[own, number] = q
                number += 1
        found.num_angled[own] = number
    best, best_cost = _best_corner(columns, angled[own], found.num_angled[own], tolerance)
    alone = False
    for a in range(found.num_angled[own]):
        q = angled[own, a]
        if columns[OFF, q] > tolerance:
            continue
        gap = _gap(columns, q)
        if gap <= 8 * CLAIM_REACH:
            continue
        cost = _cost(columns, q, gap, tolerance)
        if cost > best_cost or (cost == best_cost and q > best):
            continue
        if _bridged(columns, count, q, tolerance):
            best, best_cost = q, cost
        else:
            alone = True
    return best, alone


@kernel(allocates=False)
def _best_corner(columns, angled, number, tolerance):  # type: ignore[no-untyped-def]
    """(candidate, cost) of those beside the voxel in turn; (-1, infinity) where none is."""
    best, best_cost = -1, np.inf
    for a in range(number):
        q = angled[a]
        if columns[OFF, q] > tolerance:
            continue
        gap = _gap(columns, q)
        if gap > 8 * CLAIM_REACH:
            continue
        cost = _cost(columns, q, gap, tolerance)
        if cost < best_cost:
            best, best_cost = q, cost
    return best, best_cost


@kernel(allocates=False)
def _flat(columns, count):  # type: ignore[no-untyped-def]
    """Whether all candidates look the same way: then there is no corner."""
    for q in range(1, count):  # noqa: SIM110 numba has no all() of a generator
        if _dot(columns, q, 0) < FLAT_COS:
            return False
    return True


@kernel(parallel=True)
def _label_all(blocks, observable, patches, which, tolerance, changed):  # type: ignore[no-untyped-def]
    chunks = (which.shape[0] + CHUNK - 1) // CHUNK
    for turn in prange(chunks):
        chunk = dealt(turn, chunks)
        stop = min(which.shape[0], (chunk + 1) * CHUNK)
        _label_some(blocks, observable, patches, which, chunk * CHUNK, stop, tolerance, changed)


@kernel
def _label_some(blocks, observable, patches, which, start, stop, tolerance, changed):  # type: ignore[no-untyped-def]
    scratch = _make_scratch(patches.votes.shape[1])
    for q in range(start, stop):
        changed[q] = _label_block(blocks, observable, patches, which[q], tolerance, scratch)


def label_blocks(
    blocks: Blocks,
    observable: NDArray[np.int64],
    patches: Any,
    which: NDArray[np.int32],
    tolerance: float,
    changed: NDArray[np.bool_],
) -> None:
    """Label every voxel of the blocks `which` (Q,) again; mark in `changed` (Q,) those where a
    label changed.

    Reads the patches of the next blocks, and notes in patches.far where it had to ask those two
    away; every block writes its own voxels: threads change nothing."""
    if len(which) < FEW:
        _label_some(blocks, observable, patches, which, 0, len(which), tolerance, changed)
    else:
        _label_all(blocks, observable, patches, which, tolerance, changed)


@kernel
def _label_block(blocks, observable, patches, block, tolerance, scratch):  # type: ignore[no-untyped-def]
    """Label the voxels of one block. Whether a label changed."""
    found, voxels = scratch
    changed, far = False, False
    near = _near_candidates(blocks, patches, block, tolerance, found)
    count = near
    columns = found.columns
    flat = _flat(columns, near)
    for v in range(_gather(blocks, observable, patches.member, block, voxels)):
        seen, member = voxels.seen[v], voxels.member[v]
        label, second, own = -1, -1, -1
        if seen != 0:
            c = _place(voxels.local[v], seen)
            if member < 0 or not flat:
                _measure(columns, count, c)
            if member >= 0:
                label, own = 16 * CENTRE + member, found.own[member]
            else:
                own = _join(columns, near, seen, tolerance)
                if own >= 0:
                    label = found.codes[own]
            if own >= 0 and not flat:
                other, alone = _claim(found, near, count, tolerance, own)
                if alone and not far:
                    far = True
                    count = _far_candidates(blocks, patches, block, tolerance, near, found)
                    _measure(columns, count, c)
                    other, alone = _claim(found, near, count, tolerance, own)
                if other >= 0:
                    second = found.codes[other]
        row = voxels.row[v]
        if patches.label[row] != label or patches.second[row] != second:
            patches.label[row] = label
            patches.second[row] = second
            changed = True
    patches.far[block] = far
    return changed
