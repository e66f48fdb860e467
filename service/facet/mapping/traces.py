"""Sums that were taken round a voxel, kept from one estimate of its normal to the next.

An estimate asks for a handful of sums: of the votes within a radius, and of those among them that
lie in a slab across a normal. Each has a key that says which, and is a pure function of the
observables near by. Where two of a hundred and fifty votes changed, the kept sums are amended by
these two: the same integers as if all were summed again. What is not kept is summed, so nothing
depends on what is.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from facet.mapping.bits import population
from facet.mapping.halo import MOST, take
from facet.mapping.kernel import kernel
from facet.mapping.lanes import LANES
from facet.mapping.memory import sparse
from facet.mapping.principal import ABREAST, PLACES, PRINCIPAL, analyse
from facet.mapping.region import FACED, SUMS, face, is_beside, within, within_slab
from facet.mapping.settings import VOXELS

SLAB_UNIT = 64  # the normal across a slab is rounded: these integers are a unit vector times this
CUBE, SLAB, THIN_SLAB = range(3)  # what a key asks for
FARTHEST = 9  # (2 x 9 + 1)^3 votes are always listed whole; of wider regions nothing is kept
MOST_KEPT = 12  # sums of a voxel
PASSING = MOST_KEPT  # place of sums that are not kept, until the next are asked for
ENTRIES = 96 << 10  # sums of a share that are kept: those begun last
MOST_CHANGES = 256  # dirty voxels round a block; with more, summing all again is no slower
MOST_NEW = 8  # of these were empty: with more it is a frontier, where sums kept are not used again
STATE = 10  # numbers of the state of a look: sums at hand; a bit each of those asked for; radius up
# to which the votes are listed; how many these are; whether nothing asked for was dropped; the
# radius, the largest one until now and a bit each of those that were looked at; the key of the sums
# that are wanted; whether these are fetched at once
KNOWN, USED, LISTED, COUNT, WHOLE, RADIUS, REACH, VISITED, WANTED, ALONE = range(STATE)
POSES = -1  # wanted are no sums, but the poses in the halo
KEY = SUMS  # an entry: the sums, what they are of, and where those of a voxel begin, else 0:
OWNER, ROOM, NUMBER, IS_WHOLE = range(KEY + 1, KEY + 5)  # 1 + row; how many have room; how many
# there are; whether they are all that the last estimate asked for
ENTRY = IS_WHOLE + 1  # numbers of an entry: a cache line
_VOTE = 0xFFFF  # bits of an observable that a sum is made of: centroid and weight


class Traces(NamedTuple):
    """The sums of the voxels estimated last, by share: threads never write the same.

    A share is a ring. The sums of a voxel lie one behind the other; once the ring has come round
    they are overwritten from the first on, which says whose they are."""

    slot: NDArray[np.int32]  # (V,) 1 + where in its share a voxel's sums begin; 0: never had any
    entries: NDArray[np.int32]  # (S, ENTRIES, ENTRY) a sum, its key, and OWNER .. IS_WHOLE
    next: NDArray[np.int64]  # (S,) where the ring is written next


def make_traces(shares: int) -> Traces:
    """Room for shares x ENTRIES sums; what is not used takes no memory."""
    return Traces(
        np.zeros(0, np.int32),
        sparse(shares * ENTRIES * ENTRY, np.int32).reshape(shares, ENTRIES, ENTRY),
        np.zeros(shares, np.int64),
    )


LOOK = np.dtype(  # what an estimate of a voxel needs; a record goes from loop to loop as one
    # address, its arrays by themselves as half a dozen numbers each
    [
        ("votes", np.int16, (FACED, MOST + 5 * LANES)),  # round a voxel; columns start on
        # different cache sets
        ("kept", np.int32, (PLACES, KEY + 1)),  # sums at hand, each with its key
        ("principal", np.float64, (PRINCIPAL,)),  # what these say
        ("state", np.int64, (STATE,)),  # KNOWN .. ALONE
    ],
    align=True,
)
SCRATCH = np.dtype(  # what a thread needs of a block
    [
        ("principal", np.float64, (PRINCIPAL,)),  # what sums of several looks say
        ("open", np.int64, (3, ABREAST)),  # voxels that want sums, their looks, and places of these
        ("changes", np.int64, (5, MOST_CHANGES)),  # dirty voxels round a block: x, y, z from its
        # corner, observable before and now
        ("listed", np.int64, (4, VOXELS)),  # voxels of the block
        ("found", np.int16, (VOXELS, 7)),  # what was estimated of them
    ],
    align=True,
)


@kernel(allocates=False)
def slab_key(r, kind, nx, ny, nz):  # type: ignore[no-untyped-def]
    """The key of the votes within r and in the slab of a voxel across a normal. The key of a whole
    cube is r."""
    ix = np.int64(np.floor(nx * SLAB_UNIT + 0.5)) + SLAB_UNIT
    iy = np.int64(np.floor(ny * SLAB_UNIT + 0.5)) + SLAB_UNIT
    iz = np.int64(np.floor(nz * SLAB_UNIT + 0.5)) + SLAB_UNIT
    return r | (kind << 5) | (ix << 7) | (iy << 15) | (iz << 23)


@kernel(allocates=False)
def _read_key(key):  # type: ignore[no-untyped-def]
    """(radius, kind, normal times SLAB_UNIT)."""
    ix, iy, iz = (key >> 7) & 255, (key >> 15) & 255, key >> 23
    return key & 31, (key >> 5) & 3, ix - SLAB_UNIT, iy - SLAB_UNIT, iz - SLAB_UNIT


@kernel(allocates=False)
def list_votes(at, look):  # type: ignore[no-untyped-def]
    """List the votes within reach. Whether the halo is wide enough.

    at: halo, its margin, the voxel's place in the block, its observable, rule."""
    halo, margin, local, seen, _ = at
    votes, state, reach = look.votes, look.state, look.state[REACH]
    if state[LISTED] >= reach:
        return True
    if reach > margin:
        return False
    x, y, z = local & 7, (local >> 3) & 7, local >> 6
    count = take(halo, margin, x, y, z, reach)
    face(halo.taken, count, seen, x + margin, y + margin, z + margin, votes)
    state[LISTED], state[COUNT] = reach, count
    return True


@kernel(allocates=False)
def ask(at, key, look):  # type: ignore[no-untyped-def]
    """The place at hand of the sums that a key names, and of what they say. -1: they are wanted.
    Who is told so fetches them, and estimates the voxel again; where most are at hand already, that
    would take longer than to fetch one alone."""
    kept, state = look.kept, look.state
    for e in range(state[KNOWN]):
        if kept[e, KEY] == key:
            state[USED] |= 1 << e
            return e
    state[WANTED] = key
    if _find_place(state) != PASSING and not state[ALONE]:
        return -1
    e = fetch(at, look)  # those that are PASSING would not be there again
    if e >= 0:
        analyse(kept, e, at[4].floor2, look.principal)
    return e


@kernel(allocates=False)
def fetch(at, look):  # type: ignore[no-untyped-def]
    """Bring the sums that are wanted to hand. Their place; -1 where the halo is too narrow."""
    votes, kept, state = look.votes, look.kept, look.state
    key, e = state[WANTED], _find_place(state)
    if key == POSES:
        return PASSING if state[REACH] <= at[1] else -1
    if not list_votes(at, look):
        return -1
    if e == PASSING:
        state[WHOLE] = 0
    else:
        state[KNOWN] = max(state[KNOWN], e + 1)
        state[USED] |= 1 << e
    kept[e, KEY] = key
    r, kind, ix, iy, iz = _read_key(key)
    if kind == CUBE:
        within(votes, state[COUNT], r, kept[e])
    else:
        _, _, _, seen, rule = at
        own = ix * (seen & 15) + iy * ((seen >> 4) & 15) + iz * ((seen >> 8) & 15)
        half = rule.slab if kind == SLAB else rule.thin_slab
        within_slab(votes, state[COUNT], r, ix, iy, iz, own, half, kept[e])
    return e


@kernel(allocates=False)
def _find_place(state):  # type: ignore[no-untyped-def]
    """A place for sums that are not at hand: a free one, or of sums not asked for this time, or
    PASSING."""
    if state[REACH] > FARTHEST:
        return PASSING
    if state[KNOWN] < MOST_KEPT:
        return state[KNOWN]
    e = 0
    while e < MOST_KEPT and (state[USED] >> e) & 1:
        e += 1
    return e  # MOST_KEPT is PASSING


@kernel(allocates=False)
def begin(start, state):  # type: ignore[no-untyped-def]
    """Nothing is at hand; the first radius is `start`."""
    state[KNOWN] = state[USED] = state[LISTED] = state[VISITED] = state[ALONE] = 0
    state[WHOLE] = 1
    state[RADIUS] = state[REACH] = start


@kernel(allocates=False)
def find_records(traces, share, rows, count, starts):  # type: ignore[no-untyped-def]
    """Where the sums of each of the voxels rows[:count] begin, -1: it has none. One look-up at a
    time for all of them: they do not wait for one another."""
    for v in range(count):
        starts[v] = np.int64(traces.slot[rows[v]]) - 1
    for v in range(count):
        if not _is_record(traces, share, rows[v], starts[v]):
            starts[v] = -1


@kernel(allocates=False)
def _is_record(traces, share, row, start):  # type: ignore[no-untyped-def]
    """Whether the sums of a voxel that began there are not overwritten by now."""
    return start >= 0 and traces.entries[share, start, OWNER] == row + 1


@kernel(allocates=False)
def recall(traces, share, row, start, look):  # type: ignore[no-untyped-def]
    """Bring what is kept of a voxel, and began at `start`, to hand. Whether it is all that the last
    estimate asked for."""
    kept, state = look.kept, look.state
    if not _is_record(traces, share, row, start):
        return False
    entries = traces.entries[share]
    state[KNOWN], state[ALONE] = entries[start, NUMBER], 1
    for e in range(state[KNOWN]):
        for s in range(KEY + 1):
            kept[e, s] = entries[start + e, s]
    return entries[start, IS_WHOLE] == 1


@kernel(allocates=False)
def keep(traces, share, row, start, look):  # type: ignore[no-untyped-def]
    """Keep those sums at hand that were asked for, in place of those that began at `start`."""
    kept, state = look.kept, look.state
    number = 0
    for e in range(state[KNOWN]):
        number += (state[USED] >> e) & 1
    is_there = _is_record(traces, share, row, start)
    if not is_there or traces.entries[share, start, ROOM] < number:
        start = _begin_record(traces, share, row, number)
    entries = traces.entries[share]
    entries[start, NUMBER] = number
    entries[start, IS_WHOLE] = state[WHOLE]
    for e in range(state[KNOWN]):
        if (state[USED] >> e) & 1:
            for s in range(KEY + 1):
                entries[start, s] = kept[e, s]
            start += 1


@kernel(allocates=False)
def _begin_record(traces, share, row, number):  # type: ignore[no-untyped-def]
    """Room for the sums of a voxel, some more than now, in place of the oldest. Where it begins."""
    start, room = traces.next[share], min(number + 1, MOST_KEPT)
    if start + room > traces.entries.shape[1]:
        start = 0
    traces.next[share] = start + room
    for e in range(start, start + room):
        traces.entries[share, e, OWNER] = 0
    traces.entries[share, start, OWNER] = row + 1
    traces.entries[share, start, ROOM] = room
    traces.slot[row] = start + 1
    return start


@kernel(allocates=False)
def forget(traces, share, row):  # type: ignore[no-untyped-def]
    """Keep nothing of a voxel."""
    start = np.int64(traces.slot[row]) - 1
    if _is_record(traces, share, row, start):
        traces.entries[share, start, OWNER] = 0


@kernel(allocates=False)
def list_changes(blocks, columns, bits, dirty, near, blocks_out, changes):  # type: ignore[no-untyped-def]
    """List the dirty voxels of the blocks `near`, whose bits are set in bits (B, 8). How many, -1:
    too many, or too many new ones."""
    rows, before, first, following = dirty
    width = 2 * blocks_out + 1
    number = np.uint64(0)
    for n in range(width * width * width):
        if near[n] >= 0 and first[near[n]] > 0:
            for z in range(8):
                number += population(bits[near[n], z])
    if number > np.uint64(MOST_CHANGES):
        return -1
    count, num_new = 0, 0
    for n in range(width * width * width):
        if near[n] < 0:
            continue
        x0 = 8 * (n % width - blocks_out)
        y0 = 8 * ((n // width) % width - blocks_out)
        z0 = 8 * (n // (width * width) - blocks_out)
        d = first[near[n]]
        while d > 0:
            local = np.int64(columns.local[rows[d - 1]])
            changes[0, count] = x0 + (local & 7)
            changes[1, count] = y0 + ((local >> 3) & 7)
            changes[2, count] = z0 + (local >> 6)
            changes[3, count] = before[d - 1]
            changes[4, count] = columns.observable[rows[d - 1]]
            num_new += before[d - 1] == 0
            if num_new > MOST_NEW:
                return -1
            count += 1
            d = following[d - 1]
    return count


@kernel(allocates=False)
def amend(changes, num_changes, local, seen, rule, look):  # type: ignore[no-untyped-def]
    """Bring the sums at hand from what the changed voxels were to what they are. Whether any sum is
    another now."""
    kept, state = look.kept, look.state
    farthest = 0
    for e in range(state[KNOWN]):
        farthest = max(farthest, kept[e, KEY] & 31)
    x, y, z = local & 7, (local >> 3) & 7, local >> 6
    different = False
    for d in range(num_changes):
        dx, dy, dz = changes[0, d] - x, changes[1, d] - y, changes[2, d] - z
        distance = max(abs(dx), abs(dy), abs(dz))
        if distance > farthest:
            continue
        before, now = changes[3, d], changes[4, d]
        for e in range(state[KNOWN]):
            key = kept[e, KEY]
            if key & 31 < distance:
                continue
            was = _counts(dx, dy, dz, before, key, seen, rule)
            counts = _counts(dx, dy, dz, now, key, seen, rule)
            if was and counts and (before ^ now) & _VOTE == 0:
                continue
            if was:
                _add_vote(dx, dy, dz, before, -1, kept[e])
            if counts:
                _add_vote(dx, dy, dz, now, 1, kept[e])
            different |= was or counts
    return different


@kernel(allocates=False)
def _counts(dx, dy, dz, word, key, seen, rule):  # type: ignore[no-untyped-def]
    """Whether a vote at (dx, dy, dz) counts for a sum, if it is near enough."""
    if word == 0:
        return False
    _, kind, ix, iy, iz = _read_key(key)
    if kind == CUBE:
        return is_beside(seen, word)
    x = 8 * dx + (word & 15) - (seen & 15)
    y = 8 * dy + ((word >> 4) & 15) - ((seen >> 4) & 15)
    z = 8 * dz + ((word >> 8) & 15) - ((seen >> 8) & 15)
    vx, vy, vz = ((word >> 16) & 31) - 8, ((word >> 21) & 31) - 8, ((word >> 26) & 31) - 8
    half = rule.slab if kind == SLAB else rule.thin_slab
    return abs(ix * x + iy * y + iz * z) < half and ix * vx + iy * vy + iz * vz > 0


@kernel(allocates=False)
def _add_vote(dx, dy, dz, word, sign, sums):  # type: ignore[no-untyped-def]
    """Add a vote to sums, or take it out."""
    x, y, z = 8 * dx + (word & 15), 8 * dy + ((word >> 4) & 15), 8 * dz + ((word >> 8) & 15)
    w = sign * ((word >> 12) & 15)
    sums[0] += sign
    sums[1] += w
    sums[2] += w * x
    sums[3] += w * y
    sums[4] += w * z
    sums[5] += w * x * x
    sums[6] += w * x * y
    sums[7] += w * x * z
    sums[8] += w * y * y
    sums[9] += w * y * z
    sums[10] += w * z * z
