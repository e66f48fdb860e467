"""Who claims a voxel: its own patch, the patch a leftover joins, and a second one at corners.

A leftover (thick, aligned, mixed) joins the neighbouring patch whose plane it lies on and shares
its fate. A voxel at a corner lies on two planes: the second may use it as a vertex too.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numba import prange
from numpy.typing import NDArray

from facet.mapping.blocks import CENTRE, Blocks, list_rows, list_voxels
from facet.mapping.candidates import (
    HIGH,
    LOW,
    NX,
    NY,
    NZ,
    OFFSET,
    WEIGHT,
    cosine,
    distance,
    far_candidates,
    near_candidates,
    place_of,
)
from facet.mapping.kernel import kernel
from facet.mapping.runs import dealt
from facet.mapping.settings import PER_BLOCK, VOXELS
from facet.mapping.unsettled import MOST, list_news, was_label

LEFTOVER_REACH = 8  # voxels between a leftover and the box of the patch it joins
CLAIM_REACH = 2  # voxels between a corner voxel and the box of a patch that claims it too
PARALLEL_COS = 0.98
CHUNK = 16  # blocks that a thread takes at a time
FEW = 128  # blocks that are not worth waking other threads for
BESIDE_COS = 0.91  # a patch so near to a voxel's own is neither at an angle to it (CORNER_COS) nor
# parallel to one that is (PARALLEL_COS): 36.9 and 11.5 degrees
CORNER_COS = 0.8  # planes that share a corner voxel differ by more than 37 degrees
FLAT_COS = 0.95  # planes that all are so near to one differ by less from one another
OFF = 11  # distance of the voxel in turn from the plane
FACTS = 12
NEAR, FAR = 27 * PER_BLOCK, 125 * PER_BLOCK  # patches of a block and those beside it; and of those
# two away
CODES = 27 * 16  # 16 x neighbour + index of a patch there
CLAIMS = np.dtype(  # scratch of one thread: patches that may claim the voxels of a block, N near
    # ones, C with those two blocks away; and the V voxels
    [
        ("codes", np.int16, (FAR,)),  # (C,)
        ("columns", np.float64, (FACTS, FAR)),  # (FACTS, C) eighths, from the corner of the
        # block that asks
        ("of_code", np.int16, (CODES,)),  # which of the near ones has a code, -1: none
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
        ("again", np.int8, (VOXELS,)),  # whether they are labelled again
        ("news", np.float64, (OFFSET + 1, MOST)),  # planes that changed near the block, before and
        # now
        ("new_codes", np.int16, (MOST,)),  # of those of them that are near, as they are now
        ("new", np.int64, (MOST,)),  # which candidates these are
        ("is_new", np.int8, (NEAR,)),  # (N,) likewise
    ],
    align=True,
)


@kernel(allocates=False)
def is_own(border, second, row):  # type: ignore[no-untyped-def]
    """Whether a voxel holds no points of another surface: it lies at no border (V,), and no plane
    at an angle claims it, second (V,)."""
    return not (border[row] or second[row] >= 0)


@kernel(allocates=False)
def _list(blocks, observable, member, block, with_empty, found):  # type: ignore[no-untyped-def]
    """List the voxels of a block, those that are empty now too if `with_empty`. How many."""
    if with_empty:
        count = list_rows(blocks, block, found.row, found.place)
    else:
        count = list_voxels(blocks, block, blocks.occupied[block], found.row, found.place)
    for v in range(count):
        found.seen[v] = observable[found.row[v]]
    for v in range(count):
        found.member[v] = member[found.row[v]]
    return count


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
def _cost(columns, q, gap, tolerance):  # type: ignore[no-untyped-def]
    off = columns[OFF, q] / tolerance
    return off**2 + (gap / (8.0 * LEFTOVER_REACH)) ** 2 + columns[WEIGHT, q]


@kernel(allocates=False)
def _joining(columns, q, c, seen, tolerance):  # type: ignore[no-untyped-def]
    """What it costs a leftover at c to join a near candidate; inf: it cannot. That must face the
    voxel's sensor, its plane must be near, and so must its box."""
    if columns[OFF, q] > tolerance:
        return np.inf
    gap = _gap(columns, q, c)
    if gap > 8 * LEFTOVER_REACH:
        return np.inf
    v0, v1, v2 = ((seen >> 16) & 31) - 8, ((seen >> 21) & 31) - 8, ((seen >> 26) & 31) - 8
    faces = columns[NX, q] * v0 + columns[NY, q] * v1 + columns[NZ, q] * v2
    mixed = ((seen >> 31) & 1) == 1
    if not mixed and faces <= 0.0:
        return np.inf
    return _cost(columns, q, gap, tolerance)


@kernel(allocates=False)
def _join(columns, near, c, seen, tolerance):  # type: ignore[no-untyped-def]
    """Near candidate that a leftover at c joins, -1: none."""
    best, best_cost = -1, np.inf
    for q in range(near):
        cost = _joining(columns, q, c, seen, tolerance)
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
            number += cosine(columns, q, columns, o) >= PARALLEL_COS
        found.num_parallel[q] = number
    x, y, z = _ways(columns, q, c)
    length = x * x + y * y + z * z
    for p in range(found.num_parallel[q]):
        o = parallel[p]
        ox, oy, oz = _ways(columns, o, c)
        dot = x * ox + y * oy + z * oz
        lengths = length * (ox * ox + oy * oy + oz * oz)
        if dot < 0.0 and dot * dot > 0.5 * lengths and distance(columns, o, c) <= tolerance:
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
            number += cosine(columns, q, columns, own) <= CORNER_COS
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
        if cosine(columns, q, columns, 0) < FLAT_COS:
            return False
    return True


@kernel(allocates=False)
def _joins_another(found, num_new, own, c, seen, tolerance):  # type: ignore[no-untyped-def]
    """Whether a leftover at c, of the candidate `own` (-1: of none), may join a new one instead."""
    columns, last = found.columns, np.inf
    if own >= 0:
        columns[OFF, own] = distance(columns, own, c)
        last = _joining(columns, own, c, seen, tolerance)
    for n in range(num_new):
        q = found.new[n]
        columns[OFF, q] = distance(columns, q, c)
        cost = _joining(columns, q, c, seen, tolerance)
        if cost <= last and cost < np.inf:
            return True
    return False


@kernel(allocates=False)
def _is_claimed_anew(found, num_news, own, c, tolerance):  # type: ignore[no-untyped-def]
    """Whether another patch may claim the voxel at c, of the candidate `own`, than before: one that
    changed, or with the help of one."""
    for n in range(num_news):
        angled = cosine(found.columns, own, found.news, n) <= BESIDE_COS
        if angled and distance(found.news, n, c) <= tolerance:
            return True
    return False


@kernel(allocates=False)
def _find_unsettled(patches, number, num_news, num_codes, tolerance, found):  # type: ignore[no-untyped-def]
    """Mark in found.again those of a block's voxels, `number`, whose label may be another now that
    patches changed (`list_news`). How many."""
    num_new, asked = 0, 0
    found.is_new[:] = 0
    for n in range(num_codes):
        q = np.int64(found.of_code[found.new_codes[n]])
        if q >= 0:
            found.new[num_new], found.is_new[q] = q, 1
            num_new += 1
    for v in range(number):
        label, seen = np.int64(patches.label[found.row[v]]), found.seen[v]
        again = label < -1
        if not again and num_news > 0:
            c, own = place_of(found.place[v], seen), np.int64(-1)
            if label >= 0:
                own = np.int64(found.of_code[label])
                again = own < 0 or found.is_new[own] != 0
            if not again and found.member[v] < 0:
                again = _joins_another(found, num_new, own, c, seen, tolerance)
            if not again and own >= 0:
                again = _is_claimed_anew(found, num_news, own, c, tolerance)
        found.again[v] = again
        asked += again
    return asked


@kernel(parallel=True)
def _label_all(  # type: ignore[no-untyped-def]
    blocks, observable, patches, which, regrouped, changes, tolerance, scratches, changed
):
    step = scratches.shape[0] * CHUNK
    for turn in prange(scratches.shape[0]):
        share = dealt(turn, scratches.shape[0])
        for start in range(share * CHUNK, which.shape[0], step):
            stop = min(which.shape[0], start + CHUNK)
            _label_some(
                blocks, observable, patches, which, regrouped, start, stop, changes, tolerance,
                scratches[share], changed,
            )  # fmt: skip


@kernel(allocates=False)
def _label_some(  # type: ignore[no-untyped-def]
    blocks, observable, patches, which, regrouped, start, stop, changes, tolerance, found, changed
):
    for q in range(start, stop):
        changed[q] = _label_block(
            blocks, observable, patches, which[q], regrouped[q], changes, tolerance, found
        )


def label_blocks(
    blocks: Blocks,
    observable: NDArray[np.int64],
    patches: Any,
    which: NDArray[np.int32],
    regrouped: NDArray[np.bool_],
    changes: Any,
    tolerance: float,
    scratches: NDArray[np.void],
    changed: NDArray[np.bool_],
) -> None:
    """Label the unsettled voxels of the blocks `which` (Q,) again, which only the `regrouped` (Q,)
    have, and those that a change of patches near by matters to; mark in `changed` (Q,) the blocks
    where a label changed. changes: see `list_news`; scratches: CLAIMS, one a share of the work.

    Reads the patches of the next blocks, and notes in patches.far where it had to ask those two
    away (taken back only when a whole block is asked at once); every block writes its own voxels:
    threads change nothing."""
    sources = blocks, observable, patches, which, regrouped
    if len(which) < FEW:
        _label_some(*sources, 0, len(which), changes, tolerance, scratches[0], changed)
    else:
        _label_all(*sources, changes, tolerance, scratches, changed)


@kernel(allocates=False)
def _label_block(  # type: ignore[no-untyped-def]
    blocks, observable, patches, block, regrouped, changes, tolerance, found
):
    """Label the voxels of one block that may have another label now. Whether one has."""
    num_news, num_codes = list_news(blocks, patches, block, changes, tolerance, found)
    if num_news == 0 and not regrouped:
        return False
    number = asked = _list(blocks, observable, patches.member, block, regrouped, found)
    near = count = near_candidates(blocks, patches, block, tolerance, found)
    if num_news < 0:
        found.again[:number] = 1
    else:
        asked = _find_unsettled(patches, number, num_news, num_codes, tolerance, found)
    if asked == 0:
        return False
    columns, far = found.columns, False
    flat = _flat(columns, near)
    for v in range(number):
        if not found.again[v]:
            continue
        seen, member = found.seen[v], found.member[v]
        label, second, own = -1, -1, -1
        if seen != 0:
            c = place_of(found.place[v], seen)
            if member < 0 or not flat:
                for q in range(near):
                    columns[OFF, q] = distance(columns, q, c)
            if member >= 0:
                label = np.int64(16 * CENTRE + member)
                own = np.int64(found.of_code[label])
            else:
                own = _join(columns, near, c, seen, tolerance)
                if own >= 0:
                    label = np.int64(found.codes[own])
            if own >= 0 and not flat:
                other, alone = _claim(found, near, count, c, tolerance, own)
                if alone and not far:
                    far = True
                    count = far_candidates(blocks, patches, block, tolerance, near, found)
                    other, alone = _claim(found, near, count, c, tolerance, own)
                if other >= 0:
                    second = np.int64(found.codes[other])
        found.label[v], found.second[v] = label, second
    patches.far[block] = far or (asked < number and patches.far[block])
    changed = False
    for v in range(number):
        if found.again[v]:
            row, label, second = found.row[v], found.label[v], found.second[v]
            changed |= was_label(patches.label[row]) != label or patches.second[row] != second
            patches.label[row], patches.second[row] = label, second
    return changed
