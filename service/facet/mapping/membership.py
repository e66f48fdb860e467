"""Which voxels belong to which tile-plane, and what they belonged to before.

The members of a tile-plane lie block by block: those in one block are a run. Only runs in blocks
where something changed are collected again; the others go over to the tile-plane that their old one
became, as they are."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import prange
from numpy.typing import NDArray

from facet.mapping.bits import population
from facet.mapping.blocks import CENTRE, list_voxels, unpack
from facet.mapping.kernel import kernel
from facet.mapping.settings import VOXELS

SHELL = 1000  # places of blocks in a tile and in the shell round it
PURE, MIXED, CLAIMED = range(3)  # what a member is to its tile-plane
COLLECT, LOOK, MOVED, TOUCHED = 1, 2, 4, 8  # flags of a block: labels, or tile-planes of patches,
# changed; borders, claims or centroids; centroids; sums of points
NEW = -1  # a run that was not there before; below: OTHER - r, the run r with other members
OTHER = -2


class Runs(NamedTuple):
    """The runs of tiles, R of them: by tile-plane of a tile, then by block key."""

    block: NDArray[np.int32]  # (R,)
    plane: NDArray[np.int16]  # (R,) tile-plane in its tile
    size: NDArray[np.int16]  # (R,) members
    margin: NDArray[np.float32]  # (R,) voxels that its tile-plane may move before a member's
    # state can change


class Held(NamedTuple):
    """Members of N tiles, as the kernels take them."""

    rows: NDArray[np.int32]  # (M,) voxel rows, run by run
    state: NDArray[np.int8]  # (M,) PURE, MIXED or CLAIMED
    block: NDArray[np.int32]  # (R,) and so on: see `Runs`
    plane: NDArray[np.int16]
    size: NDArray[np.int16]
    margin: NDArray[np.float32]
    start: NDArray[np.int64]  # (R,) where the rows of each run begin
    old: NDArray[np.int64]  # (R,) the run that each was before, NEW: none, or OTHER
    first: NDArray[np.int64]  # (N,) first run of each tile
    last: NDArray[np.int64]  # (N,) the run behind its last


class Listed(NamedTuple):
    """The runs of a tile, by block; of new ones also the members. There is room for all."""

    rows: NDArray[np.int32]
    state: NDArray[np.int8]
    block: NDArray[np.int32]
    plane: NDArray[np.int16]
    size: NDArray[np.int16]
    start: NDArray[np.int64]  # in the rows here, or in the old ones
    old: NDArray[np.int64]


class Chain(NamedTuple):
    """What runs a tile had, R of them, by block."""

    head: NDArray[np.int64]  # (SHELL,) the first of a block, -1: none
    link: NDArray[np.int64]  # (R,) the next, -1: none
    kept: NDArray[np.bool_]  # (R,) went over whole
    first: int  # number of the tile's first run


@kernel(allocates=False)
def _collect(blocks, patches, plane_of_patch, tile_key, block, listed, members):  # type: ignore[no-untyped-def]
    """Voxels of a block whose patch, own or claiming, lies in the tile. How many. listed (4,
    VOXELS): room."""
    rows, owner, claimed = members
    ti, tj, tk = unpack(tile_key)
    i, j, k = unpack(blocks.keys[block])
    voxels, labels = listed[0], listed[2:]
    number = list_voxels(blocks, block, blocks.occupied[block], voxels, listed[1])
    for v in range(number):
        labels[0, v], labels[1, v] = patches.label[voxels[v]], patches.second[voxels[v]]
    count = 0
    for v in range(number):
        for claim in range(2):
            label = labels[claim, v]
            if label < 0:
                continue
            n = label >> 4
            x, y, z = i + n % 3 - 1, j + (n // 3) % 3 - 1, k + n // 9 - 1
            if x >> 3 != ti or y >> 3 != tj or z >> 3 != tk:
                continue
            other = block if n == CENTRE else blocks.neighbours[block, n]
            rows[count] = voxels[v]
            owner[count] = plane_of_patch[other, label & 15]
            claimed[count] = claim == 1
            count += 1
    return count


@kernel(allocates=False)
def _shell(blocks, flags, tile_key, members, near):  # type: ignore[no-untyped-def]
    """Blocks of a tile, `members`, and those round them into near (SHELL,), by ascending key, -1
    where there is none. Returns how many members can be in those that are flagged."""
    ti, tj, tk = unpack(tile_key)
    near[:] = -1
    for q in range(members.shape[0]):
        block = members[q]
        i, j, k = unpack(blocks.keys[block])
        x, y, z = i - 8 * ti, j - 8 * tj, k - 8 * tk
        place = 100 * (x + 1) + 10 * (y + 1) + z + 1
        near[place] = block
        if 0 < x < 7 and 0 < y < 7 and 0 < z < 7:
            continue
        for n in range(27):
            if n != CENTRE and blocks.neighbours[block, n] >= 0:
                at = place + 100 * (n % 3 - 1) + 10 * (n // 3 % 3 - 1) + n // 9 - 1
                near[at] = blocks.neighbours[block, n]
    room = np.int64(0)
    for place in range(SHELL):
        if near[place] >= 0 and flags[near[place]] & COLLECT:
            for z in range(8):
                room += 2 * np.int64(population(blocks.occupied[near[place], z]))
    return room


@kernel(allocates=False)
def find_shells(blocks, flags, tile_keys, members, member_starts, near, room):  # type: ignore[no-untyped-def]
    """For each tile, whose blocks begin at members[member_starts[n]], the blocks that may hold its
    members, near (N, SHELL), and room (N,): as many as there can be in flagged ones."""
    for n in range(tile_keys.shape[0]):
        which = members[member_starts[n] : member_starts[n + 1]]
        room[n] = _shell(blocks, flags, tile_keys[n], which, near[n])


@kernel
def _match(patches, plane_of_patch, before, members, num_old, num_new, into):  # type: ignore[no-untyped-def]
    """into (O,): the tile-plane that each old one of a tile became, -1: none. Each has the most
    votes of the other's patches."""
    votes = np.zeros((num_old, num_new), np.int64)
    for q in range(members.shape[0]):
        block = members[q]
        for p in range(patches.number[block]):
            if 0 <= before[q, p] < num_old:
                votes[before[q, p], plane_of_patch[block, p]] += patches.votes[block, p]
    into[:] = -1
    for old in range(num_old):
        best = 0
        for new in range(num_new):
            if votes[old, new] > votes[old, best]:
                best = new
        alone = num_new > 0 and votes[old, best] > 0
        for other in range(num_old * alone):
            alone &= other == old or votes[other, best] < votes[old, best]
        if alone:
            into[old] = best


@kernel
def follow_planes(  # type: ignore[no-untyped-def]
    blocks, patches, plane_of_patch, before, members, member_starts, first, counts, into, flags
):
    """What the old tile-planes of tiles became: those of tile n from into[first[n]] on, -1: none.
    Flags the blocks round those with a patch that did not go there.

    before: (Q, 12) tile-planes of the patches of the blocks `members` (Q,), those of tile n from
    member_starts[n] on; counts: (N,) tile-planes of each tile now."""
    for n in range(counts.shape[0]):
        low, high = member_starts[n], member_starts[n + 1]
        own = into[first[n] : first[n + 1]]
        num_old = own.shape[0]
        _match(
            patches, plane_of_patch, before[low:high], members[low:high], num_old, counts[n], own
        )
        for q in range(low, high):
            block = members[q]
            same = True
            for p in range(patches.number[block]):
                old = before[q, p]
                same &= 0 <= old < num_old and own[old] == plane_of_patch[block, p]
            for place in range(27 * (not same)):
                other = block if place == CENTRE else blocks.neighbours[block, place]
                if other >= 0:
                    flags[other] |= COLLECT


@kernel
def _chain(blocks, tile_key, before, first, last):  # type: ignore[no-untyped-def]
    """By place in the shell (SHELL,) the first of the runs that a block had, (R,) the next one of
    each; and whether it is there still: not yet."""
    ti, tj, tk = unpack(tile_key)
    head, link = np.full(SHELL, -1, np.int64), np.empty(last - first, np.int64)
    for r in range(last - 1, first - 1, -1):
        i, j, k = unpack(blocks.keys[before.block[r]])
        place = ((i - 8 * ti + 1) * 10 + (j - 8 * tj + 1)) * 10 + (k - 8 * tk + 1)
        link[r - first] = head[place]
        head[place] = r
    return Chain(head, link, np.zeros(last - first, np.bool_), first)


@kernel(allocates=False)
def _take_over(before, r, plane, chain, listed, run, counts):  # type: ignore[no-untyped-def]
    """List a run as what an old one is now, and count its voxels."""
    start, stay = before.start[r], 0
    for m in range(start, start + before.size[r]):
        stay += before.state[m] != CLAIMED
    counts[before.plane[r], plane] += stay
    chain.kept[r - chain.first] = True
    listed.block[run], listed.plane[run] = before.block[r], plane
    listed.size[run], listed.start[run], listed.old[run] = before.size[r], start, r


@kernel(allocates=False)
def _split(members, count, block, listed, num, end):  # type: ignore[no-untyped-def]
    """List the members of a block as new runs, one for each tile-plane, whose rows begin at `end`.
    Returns (runs, rows) that are listed now."""
    rows, owner, claimed = members
    for m in range(count):
        plane = owner[m]
        if plane < 0:
            continue
        start = end
        for other in range(m, count):
            if owner[other] == plane:
                listed.rows[end] = rows[other]
                listed.state[end] = CLAIMED if claimed[other] else PURE
                owner[other] = -1
                end += 1
        listed.block[num], listed.plane[num] = block, plane
        listed.size[num], listed.start[num], listed.old[num] = end - start, start, NEW
        num += 1
    return num, end


@kernel(allocates=False)
def _same_run(before, r, listed, run):  # type: ignore[no-untyped-def]
    """Whether an old run held just the members of a new one."""
    if before.size[r] != listed.size[run]:
        return False
    at, start = before.start[r], listed.start[run]
    for m in range(before.size[r]):
        if before.rows[at + m] != listed.rows[start + m]:
            return False
        if (before.state[at + m] == CLAIMED) != (listed.state[start + m] == CLAIMED):
            return False
    return True


@kernel(allocates=False)
def _recognise(before, place, chain, into, listed, begin, num, counts):  # type: ignore[no-untyped-def]
    """Find what runs of a block, listed from `begin` to `num`, were before."""
    for run in range(begin, num):
        plane = listed.plane[run]
        r = chain.head[place]
        while r >= 0:
            if into[before.plane[r]] == plane:
                if _same_run(before, r, listed, run):
                    _take_over(before, r, plane, chain, listed, run, counts)
                else:
                    listed.old[run] = OTHER - r
                break
            r = chain.link[r - chain.first]


@kernel(allocates=False)
def _inherit(before, place, chain, local, listed, begin, num, was, counts):  # type: ignore[no-untyped-def]
    """Count the voxels that went from runs of a block that are no more to new ones; was (VOXELS,)
    stays 0."""
    r = chain.head[place]
    while r >= 0:
        if not chain.kept[r - chain.first]:
            for m in range(before.start[r], before.start[r] + before.size[r]):
                if before.state[m] != CLAIMED:
                    was[local[before.rows[m]]] = before.plane[r] + 1
        r = chain.link[r - chain.first]
    for run in range(begin, num):
        if listed.old[run] <= NEW:
            for m in range(listed.start[run], listed.start[run] + listed.size[run]):
                old = was[local[listed.rows[m]]]
                if old > 0 and listed.state[m] != CLAIMED:
                    counts[old - 1, listed.plane[run]] += 1
    was[:] = 0


@kernel
def _list_runs(  # type: ignore[no-untyped-def]
    blocks, local, patches, plane_of_patch, flags, tile_key, near, before, chain, into, counts,
    listed
):  # fmt: skip
    """List the runs of a tile by block. How many."""
    room = 2 * VOXELS
    members = np.empty(room, np.int32), np.empty(room, np.int16), np.empty(room, np.bool_)
    was, voxels = np.zeros(VOXELS, np.int16), np.empty((4, VOXELS), np.int64)
    num, end = 0, 0
    for place in range(SHELL):
        block = near[place]
        if block < 0:
            continue
        if not flags[block] & COLLECT:
            r = chain.head[place]
            while r >= 0:
                plane = into[before.plane[r]]
                _take_over(before, r, plane, chain, listed, num, counts)
                num += 1
                r = chain.link[r - chain.first]
            continue
        begin = num
        count = _collect(blocks, patches, plane_of_patch, tile_key, block, voxels, members)
        num, end = _split(members, count, block, listed, num, end)
        _recognise(before, place, chain, into, listed, begin, num, counts)
        _inherit(before, place, chain, local, listed, begin, num, was, counts)
    return num


@kernel
def _sort(listed, num, num_planes, before, held, n):  # type: ignore[no-untyped-def]
    """Put the runs of tile n in order of their tile-planes."""
    first = held.first[n]
    held.last[n] = first + num
    num_runs, num_rows = np.zeros(num_planes + 1, np.int64), np.zeros(num_planes + 1, np.int64)
    for run in range(num):
        num_runs[listed.plane[run] + 1] += 1
        num_rows[listed.plane[run] + 1] += listed.size[run]
    for t in range(1, num_planes + 1):
        num_runs[t] += num_runs[t - 1]
        num_rows[t] += num_rows[t - 1]
    for run in range(num):
        t, size, at = listed.plane[run], np.int64(listed.size[run]), listed.start[run]
        r, start = first + num_runs[t], first + num_rows[t]
        held.block[r], held.plane[r], held.size[r] = listed.block[run], t, size
        held.start[r], held.old[r] = start, listed.old[run]
        if listed.old[run] <= NEW:
            for m in range(size):
                held.rows[start + m] = listed.rows[at + m]
                held.state[start + m] = listed.state[at + m]
        else:
            held.margin[r] = before.margin[listed.old[run]]
            for m in range(size):
                held.rows[start + m] = before.rows[at + m]
                held.state[start + m] = before.state[at + m]
        num_runs[t], num_rows[t] = num_runs[t] + 1, num_rows[t] + size


@kernel(parallel=True)
def gather_members(  # type: ignore[no-untyped-def]
    blocks, local, patches, plane_of_patch, flags, tile_keys, near, parts, before, into, planes,
    counts, held
):  # fmt: skip
    """The members of tiles (N,), who were `before`, into `held`: the runs and rows of tile n from
    held.first[n] on. near: (N, SHELL) blocks; parts: tiles that each thread begins with.

    planes: (N + 1, 3) where a tile's old tile-planes begin in into (O,), what these became, -1:
    nothing; how many it has now; and where its counts begin, (old, new): voxels that went."""
    for part in prange(parts.shape[0] - 1):
        for n in range(parts[part], parts[part + 1]):
            room = held.last[n] - held.first[n]
            listed = Listed(
                np.empty(room, np.int32), np.empty(room, np.int8), np.empty(room, np.int32),
                np.empty(room, np.int16), np.empty(room, np.int16), np.empty(room, np.int64),
                np.empty(room, np.int64),
            )  # fmt: skip
            own = into[planes[n, 0] : planes[n + 1, 0]]
            went = counts[planes[n, 2] : planes[n + 1, 2]].reshape(own.shape[0], planes[n, 1])
            chain = _chain(blocks, tile_keys[n], before, before.first[n], before.last[n])
            num = _list_runs(
                blocks, local, patches, plane_of_patch, flags, tile_keys[n], near[n], before, chain,
                own, went, listed,
            )  # fmt: skip
            _sort(listed, num, planes[n, 1], before, held, n)


@kernel(allocates=False)
def list_abroad(blocks, tile_key, rows, state, runs, ids, out):  # type: ignore[no-untyped-def]
    """Members of a tile's tile-planes that lie in other tiles, with the plane ids (T,) that they go
    by, as row << 32 | id. How many."""
    ti, tj, tk = unpack(tile_key)
    count, start = 0, 0
    for r in range(runs.block.shape[0]):
        begin, start = start, start + runs.size[r]
        i, j, k = unpack(blocks.keys[runs.block[r]])
        if i >> 3 == ti and j >> 3 == tj and k >> 3 == tk:
            continue
        for m in range(begin, start):
            if state[m] != CLAIMED:
                out[count] = (np.int64(rows[m]) << 32) | ids[runs.plane[r]]
                count += 1
    return count
