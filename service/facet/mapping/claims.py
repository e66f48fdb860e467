"""Who claims a voxel: its own patch, the patch a leftover joins, and a second one at corners.

A leftover (thick, aligned, mixed) joins the neighbouring patch whose plane it lies on and shares
its fate. A voxel at a corner lies on two planes: the second may use it as a vertex too.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numba import prange
from numpy.typing import NDArray

from facet.mapping.blocks import CENTRE, Blocks, find, list_rows, pack, unpack
from facet.mapping.kernel import kernel
from facet.mapping.runs import dealt
from facet.mapping.settings import PER_BLOCK, VOXELS

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
OFF = 11  # distance of the voxel in turn from the plane
FACTS = 12
NEAR, FAR = 27 * PER_BLOCK, 125 * PER_BLOCK  # patches of a block and those beside it; and of those
# two away
CLAIMS = np.dtype(  # scratch of one thread: patches that may claim the voxels of a block, N near
    # ones, C with those two blocks away; and the V voxels
    [
        ("codes", np.int16, (FAR,)),  # (C,) 16 * neighbour + index
        ("columns", np.float64, (FACTS, FAR)),  # (FACTS, C) eighths, from the corner of the
        # block that asks
        ("own", np.int64, (PER_BLOCK,)),  # which of them is the block's own patch, -1: none
        ("angled", np.int16, (NEAR, NEAR)),  # (N, N) for each the near ones at an angle to it
        ("num_angled", np.int64, (NEAR,)),  # (N,) how many these are, -1: not looked up yet
        ("parallel", np.int16, (NEAR, FAR)),  # (N, C) for each near one those parallel to it
        ("num_parallel", np.int64, (NEAR,)),  # (N,) likewise
        ("waiting", np.int64, (NEAR,)),  # those that need another jamb
        ("costs", np.float64, (NEAR,)),  # of these
        ("places", np.int64, (125, 5)),  # of the blocks that are asked
        ("row", np.int64, (VOXELS,)),  # (V,)
        ("place", np.int64, (VOXELS,)),
        ("seen", np.int64, (VOXELS,)),  # observables
        ("member", np.int64, (VOXELS,)),
        ("label", np.int64, (VOXELS,)),
        ("second", np.int64, (VOXELS,)),
    ],
    align=True,
)


@kernel(allocates=False)
def _list(blocks, observable, member, block, found):  # type: ignore[no-untyped-def]
    """List the voxels of a block. How many."""
    count = list_rows(blocks, block, found.row, found.place)
    for v in range(count):
        found.seen[v] = observable[found.row[v]]
    for v in range(count):
        found.member[v] = member[found.row[v]]
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


@kernel(allocates=False)
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
        found.num_angled[q] = found.num_parallel[q] = -1
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
    found.num_parallel[:count] = -1
    return _add_candidates(patches, places, num, tolerance, count, found)


@kernel(allocates=False)
def _place(local, seen):  # type: ignore[no-untyped-def]
    """A voxel's rounded centroid, eighths from the block corner."""
    return (
        float(8 * (local & 7) + (seen & 15)),
        float(8 * ((local >> 3) & 7) + ((seen >> 4) & 15)),
        float(8 * (local >> 6) + ((seen >> 8) & 15)),
    )


@kernel(allocates=False)
def _off(columns, q, c):  # type: ignore[no-untyped-def]
    """Distance of a place from the plane of a candidate."""
    return abs(
        columns[NX, q] * c[0] + columns[NY, q] * c[1] + columns[NZ, q] * c[2] - columns[OFFSET, q]
    )


@kernel(allocates=False)
def _way(columns, q, axis, x):  # type: ignore[no-untyped-def]
    """Signed way along an axis from x to the box of a candidate."""
    ahead, behind = columns[LOW + axis, q] - x, columns[HIGH + axis, q] - x
    return (ahead if ahead > 0.0 else 0.0) + (behind if behind < 0.0 else 0.0)


@kernel(allocates=False)
def _ways(columns, q, c):  # type: ignore[no-untyped-def]
    return _way(columns, q, 0, c[0]), _way(columns, q, 1, c[1]), _way(columns, q, 2, c[2])


@kernel(allocates=False)
def _gap(columns, q, c):  # type: ignore[no-untyped-def]
    """Chebyshev distance of a place from the box of a candidate."""
    x, y, z = _ways(columns, q, c)
    return max(abs(x), abs(y), abs(z))


@kernel(allocates=False)
def _dot(columns, q, o):  # type: ignore[no-untyped-def]
    return (
        columns[NX, q] * columns[NX, o]
        + columns[NY, q] * columns[NY, o]
        + columns[NZ, q] * columns[NZ, o]
    )


@kernel(allocates=False)
def _cost(columns, q, gap, tolerance):  # type: ignore[no-untyped-def]
    off = columns[OFF, q] / tolerance
    return off**2 + (gap / (8.0 * LEFTOVER_REACH)) ** 2 + columns[WEIGHT, q]


@kernel(allocates=False)
def _join(columns, near, c, seen, tolerance):  # type: ignore[no-untyped-def]
    """Near candidate that a leftover at c joins, -1: none. It must face the voxel's sensor, its
    plane must be near, and so must its box."""
    v0, v1, v2 = ((seen >> 16) & 31) - 8, ((seen >> 21) & 31) - 8, ((seen >> 26) & 31) - 8
    mixed = ((seen >> 31) & 1) == 1
    best, best_cost = -1, np.inf
    for q in range(near):
        if columns[OFF, q] > tolerance:
            continue
        gap = _gap(columns, q, c)
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
def _bridged(found, count, q, c, tolerance):  # type: ignore[no-untyped-def]
    """Whether c lies between candidate q and another, of all `count`, of the same plane: on a
    threshold. (What is its own is none: the way to itself is no way back.)"""
    columns, parallel = found.columns, found.parallel[q]
    if found.num_parallel[q] < 0:
        number = 0
        for o in range(count):
            parallel[number] = o
            number += _dot(columns, q, o) >= PARALLEL_COS
        found.num_parallel[q] = number
    x, y, z = _ways(columns, q, c)
    length = x * x + y * y + z * z
    for p in range(found.num_parallel[q]):
        o = parallel[p]
        ox, oy, oz = _ways(columns, o, c)
        dot = x * ox + y * oy + z * oz
        lengths = length * (ox * ox + oy * oy + oz * oz)
        if dot < 0.0 and dot * dot > 0.5 * lengths and _off(columns, o, c) <= tolerance:
            return True
    return False


@kernel(allocates=False)
def _claim(found, near, count, c, tolerance, own):  # type: ignore[no-untyped-def]
    """Candidate of the first `near`, at an angle to `own`, that claims the voxel at c for the least
    cost: as a corner, or as a threshold with the help of any of the `count`.

    Returns (candidate, -1: none; whether a better one was left out for want of the other jamb)."""
    columns, angled = found.columns, found.angled[own]
    if found.num_angled[own] < 0:
        number = 0
        for q in range(near):
            angled[number] = q
            number += _dot(columns, q, own) <= CORNER_COS
        found.num_angled[own] = number
    best, best_cost, num_waiting = -1, np.inf, 0
    for a in range(found.num_angled[own]):
        q = np.int64(angled[a])
        if columns[OFF, q] > tolerance:
            continue
        gap = _gap(columns, q, c)
        cost = _cost(columns, q, gap, tolerance)
        if gap > 8 * CLAIM_REACH:
            found.waiting[num_waiting], found.costs[num_waiting] = q, cost
            num_waiting += 1
        elif cost < best_cost:
            best, best_cost = q, cost
    alone = False
    for w in range(num_waiting):  # the dear question last, and only where it can win
        q, cost = found.waiting[w], found.costs[w]
        if cost > best_cost or (cost == best_cost and q > best):
            continue
        if _bridged(found, count, q, c, tolerance):
            best, best_cost = q, cost
        else:
            alone = True
    return best, alone


@kernel(allocates=False)
def _flat(columns, count):  # type: ignore[no-untyped-def]
    """Whether all candidates look the same way: then there is no corner."""
    for q in range(1, count):  # noqa: SIM110 numba has no all() of a generator
        if _dot(columns, q, 0) < FLAT_COS:
            return False
    return True


@kernel(parallel=True)
def _label_all(blocks, observable, patches, which, tolerance, scratches, changed):  # type: ignore[no-untyped-def]
    step = scratches.shape[0] * CHUNK
    for turn in prange(scratches.shape[0]):
        share = dealt(turn, scratches.shape[0])
        for start in range(share * CHUNK, which.shape[0], step):
            stop = min(which.shape[0], start + CHUNK)
            _label_some(
                blocks, observable, patches, which, start, stop, tolerance, scratches[share],
                changed,
            )  # fmt: skip


@kernel(allocates=False)
def _label_some(  # type: ignore[no-untyped-def]
    blocks, observable, patches, which, start, stop, tolerance, found, changed
):
    for q in range(start, stop):
        changed[q] = _label_block(blocks, observable, patches, which[q], tolerance, found)


def label_blocks(
    blocks: Blocks,
    observable: NDArray[np.int64],
    patches: Any,
    which: NDArray[np.int32],
    tolerance: float,
    scratches: NDArray[np.void],
    changed: NDArray[np.bool_],
) -> None:
    """Label every voxel of the blocks `which` (Q,) again; mark in `changed` (Q,) those where a
    label changed. scratches: CLAIMS, one a share of the work.

    Reads the patches of the next blocks, and notes in patches.far where it had to ask those two
    away; every block writes its own voxels: threads change nothing."""
    sources = blocks, observable, patches, which
    if len(which) < FEW:
        _label_some(*sources, 0, len(which), tolerance, scratches[0], changed)
    else:
        _label_all(*sources, tolerance, scratches, changed)


@kernel(allocates=False)
def _label_block(blocks, observable, patches, block, tolerance, found):  # type: ignore[no-untyped-def]
    """Label the voxels of one block. Whether a label changed."""
    near = count = _near_candidates(blocks, patches, block, tolerance, found)
    columns, far = found.columns, False
    flat = _flat(columns, near)
    number = _list(blocks, observable, patches.member, block, found)
    for v in range(number):
        seen, member = found.seen[v], found.member[v]
        label, second, own = -1, -1, -1
        if seen != 0:
            c = _place(found.place[v], seen)
            if member < 0 or not flat:
                for q in range(near):
                    columns[OFF, q] = _off(columns, q, c)
            if member >= 0:
                label, own = 16 * CENTRE + member, found.own[member]
            else:
                own = _join(columns, near, c, seen, tolerance)
                if own >= 0:
                    label = np.int64(found.codes[own])
            if own >= 0 and not flat:
                other, alone = _claim(found, near, count, c, tolerance, own)
                if alone and not far:
                    far = True
                    count = _far_candidates(blocks, patches, block, tolerance, near, found)
                    other, alone = _claim(found, near, count, c, tolerance, own)
                if other >= 0:
                    second = np.int64(found.codes[other])
        found.label[v], found.second[v] = label, second
    patches.far[block] = far
    changed = False
    for v in range(number):
        row, label, second = found.row[v], found.label[v], found.second[v]
        changed |= patches.label[row] != label or patches.second[row] != second
        patches.label[row], patches.second[row] = label, second
    return changed
