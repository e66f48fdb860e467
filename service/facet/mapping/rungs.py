"""The noise of patches: sigma_N of their points, rounded to a ladder of rungs 20 % apart.

The rung is what others see of it; the scene's own sigma is the median over voxels.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numba import prange
from numpy.typing import NDArray

from facet.mapping.blocks import CENTRE, Blocks, list_voxels
from facet.mapping.claims import is_own
from facet.mapping.eigen import smallest
from facet.mapping.kernel import kernel
from facet.mapping.runs import SHARES, dealt
from facet.mapping.settings import VOXELS
from facet.mapping.sums import MOMENTS, SUMS, count_points, read_sums, shift_moments

RUNGS = 40
RUNG_STEP = 1.2  # a rung is 20 % wide
FIRST_RUNG = 0.02 * 1024  # ticks: the lowest rung ends here (1 mm at 5 cm voxels)
LIMITS = (FIRST_RUNG * RUNG_STEP ** np.arange(RUNGS)) ** 2  # where rungs end, ticks^2
FEW = 512  # blocks that are not worth waking other threads for
PURE_SHARE = 4  # one point in so many must be pure for the rung to be read from these alone


@kernel(allocates=False)
def _list_members(blocks, border, patches, block, members):  # type: ignore[no-untyped-def]
    """List the voxels that go with a patch of their own block, as members (4, VOXELS): row, place
    in the block, patch, and whether they are pure: not at a border, and claimed by no plane at an
    angle. How many."""
    rows, places, owners, are_pure = members[0], members[1], members[2], members[3]
    count = 0
    for v in range(list_voxels(blocks, block, blocks.occupied[block], rows, places)):
        row = rows[v]
        label = np.int64(patches.label[row])
        rows[count], places[count], owners[count] = row, places[v], label & 15
        are_pure[count] = is_own(border, patches.second, row)
        count += label >> 4 == CENTRE
    return count


@kernel(allocates=False)
def _fetch(columns, members, count):  # type: ignore[no-untyped-def]
    """Look at the sums of all members, one look-up at a time: they do not wait for one another, as
    they would one voxel after the other. What is returned says nothing."""
    seen = np.int64(0)
    for v in range(count):
        row = members[0, v]
        seen |= columns.low[row, 0] | columns.low[row, SUMS - 1]
    for v in range(count):
        row = members[0, v]
        seen |= columns.middle[row, 0] | columns.flags[row]
    return seen


@kernel(allocates=False)
def _add_points(columns, members, count, all_of_them, m, total, sums):  # type: ignore[no-untyped-def]
    """Sum the members' point moments about the block corner into m (P, 10): of all, or
    only of pure ones. Count the points of all members in total (P,)."""
    m[:] = 0
    total[:] = 0
    for v in range(count):
        row, place, p = members[0, v], members[1, v], members[2, v]
        if all_of_them or members[3, v]:
            read_sums(columns, row, sums)
            shift_moments(sums, place & 7, (place >> 3) & 7, place >> 6, m[p])
            total[p] += sums[0]
        else:
            total[p] += count_points(columns, row)


@kernel(allocates=False)
def _variance(m, spread):  # type: ignore[no-untyped-def]
    """Smallest principal variance of point moments; spread (6,): room."""
    n = float(m[0])
    s = 0
    for a in range(3):
        for b in range(a, 3):
            spread[s] = m[4 + s] / n - (m[1 + a] / n) * (m[1 + b] / n)
            s += 1
    return smallest(spread)[0]


@kernel
def _read_some(blocks, columns, border, patches, which, start, stop, histogram):  # type: ignore[no-untyped-def]
    """The rungs of the patches of blocks, by their points' moments. Corner voxels hold points of
    two planes: they are left out where enough others are there."""
    per_block = patches.votes.shape[1]
    pure = np.empty((per_block, MOMENTS), np.int64)
    whole = np.empty((per_block, MOMENTS), np.int64)
    total = np.empty(per_block, np.int64)
    sums, spread = np.empty(SUMS, np.int64), np.empty(6)
    members = np.empty((4, VOXELS + 16), np.int64)  # 16: columns start on different cache sets
    for q in range(start, stop):
        block = which[q]
        number = _list_members(blocks, border, patches, block, members)
        members[0, VOXELS] = _fetch(columns, members, number)
        _add_points(columns, members, number, False, pure, total, sums)
        count = np.int64(patches.number[block])
        if np.any(PURE_SHARE * pure[:count, 0] < total[:count]):
            _add_points(columns, members, number, True, whole, total, sums)
        for p in range(per_block):
            votes = patches.counted[block, p]
            if votes > 0:
                histogram[patches.rung[block, p]] -= votes
            patches.counted[block, p] = 0
            if p >= count:
                continue
            variance = _variance(
                pure[p] if PURE_SHARE * pure[p, 0] >= total[p] else whole[p], spread
            )
            rung = 0
            while rung < RUNGS - 1 and variance > LIMITS[rung]:
                rung += 1
            patches.rung[block, p] = rung
            patches.counted[block, p] = patches.votes[block, p]
            histogram[rung] += patches.votes[block, p]


@kernel(parallel=True)
def _read_all(blocks, columns, border, patches, which, histograms):  # type: ignore[no-untyped-def]
    size = (which.shape[0] + SHARES - 1) // SHARES
    for turn in prange(SHARES):
        share = dealt(turn, SHARES)
        start, stop = share * size, min(which.shape[0], (share + 1) * size)
        _read_some(blocks, columns, border, patches, which, start, stop, histograms[share])


def read_rungs(
    blocks: Blocks,
    columns: Any,
    border: NDArray[np.bool_],
    patches: Any,
    which: NDArray[np.int32],
    histogram: NDArray[np.int64],
) -> None:
    """Read the rungs of the patches of the blocks `which` (Q,) again, and change by it the
    histogram (RUNGS,) of voxels by the rung of their patch."""
    if len(which) < FEW:
        _read_some(blocks, columns, border, patches, which, 0, len(which), histogram)
    else:
        histograms = np.zeros((SHARES, RUNGS), np.int64)
        _read_all(blocks, columns, border, patches, which, histograms)
        histogram += histograms.sum(axis=0)
