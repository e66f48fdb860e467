"""A block of voxels and its surroundings, gathered once for all regions that start in the block.

The surroundings are kept as rows along x, one for each (y, z): a bit mask of the occupied voxels
and where in the gathered list the row starts. What a cubic region holds is then a handful of short
runs of that list. Of a wall across x it would be many, of a voxel each: then rows lie along y.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from facet.mapping.bits import population, trailing_zeros
from facet.mapping.blocks import find, pack, unpack
from facet.mapping.kernel import kernel
from facet.mapping.lanes import LANES, QUARTERS, load, store
from facet.mapping.memory import sparse
from facet.mapping.settings import BLOCK

WIDEST = 20  # voxels that a halo may reach beyond its block on each side
EDGE = BLOCK + 2 * WIDEST
SIDE_BLOCKS = 7  # blocks along an edge of the widest halo
MOST = 8192  # votes of a region that are looked at: w x x of so many stay below 2^31
# What is listed of a voxel, 16 bits each, in one number: x, y, z, view. x, y and z are 16 x its
# place from the corner of the halo + its centroid in it, 1/8 voxels; x has the weight of its vote
# from bit WEIGHT_IN_X on; the view is the observable's, and negative where that is of both sides
IN_X, IN_Y, IN_Z, IN_VIEW = 0, 16, 32, 48
WEIGHT_IN_X = 10


HALO = np.dtype(  # scratch of one thread: the surroundings of one block at a time
    [
        ("votes", np.int64, (EDGE**3 + LANES,)),  # of the occupied voxels, x fastest
        ("poses", np.int32, (EDGE**3,)),  # likewise, the high halves of their observables
        ("words", np.int32, (EDGE**3,)),  # likewise, the low halves
        ("places", np.int32, (EDGE**3,)),  # likewise, packed
        ("taken", np.int64, (MOST + LANES,)),  # of the votes those round one voxel
        ("along_y", np.int8, (1,)),  # whether rows are
        ("rows", np.uint64, (EDGE**2,)),  # a bit per x of the row (z, y), y fastest; or x for y
        ("first", np.int32, (EDGE**2,)),  # where the row starts in the list
        ("filled", np.uint64, (EDGE,)),  # a bit per y (or x) of the rows at z: it holds a voxel
        ("near", np.int32, (SIDE_BLOCKS**3,)),  # blocks, -1: none
    ],
    align=True,
)


def make_halos(count: int) -> NDArray[np.void]:
    """(count,) HALO: 2.3 MB each, of which only what is used gets memory."""
    return sparse(count, HALO)


@kernel(allocates=False)
def find_near(blocks, block, blocks_out, near):  # type: ignore[no-untyped-def]
    """Number the blocks up to `blocks_out` away into near, x fastest; -1: none."""
    bi, bj, bk = unpack(blocks.keys[block])
    n = 0
    for dk in range(-blocks_out, blocks_out + 1):
        for dj in range(-blocks_out, blocks_out + 1):
            for di in range(-blocks_out, blocks_out + 1):
                if di == 0 and dj == 0 and dk == 0:
                    near[n] = block
                elif -1 <= di <= 1 and -1 <= dj <= 1 and -1 <= dk <= 1:
                    near[n] = blocks.neighbours[block, (di + 1) + 3 * (dj + 1) + 9 * (dk + 1)]
                else:
                    key = pack(bi + di, bj + dj, bk + dk)
                    near[n] = find(blocks.table_keys, blocks.table_values, key)
                n += 1


@kernel(allocates=False)
def _transposed(word):  # type: ignore[no-untyped-def]
    """Bits x + 8 y as y + 8 x (Warren, Hacker's Delight, 7-3)."""
    t = (word ^ (word >> np.uint64(7))) & np.uint64(0x00AA00AA00AA00AA)
    word = word ^ t ^ (t << np.uint64(7))
    t = (word ^ (word >> np.uint64(14))) & np.uint64(0x0000CCCC0000CCCC)
    word = word ^ t ^ (t << np.uint64(14))
    t = (word ^ (word >> np.uint64(28))) & np.uint64(0x00000000F0F0F0F0)
    return word ^ t ^ (t << np.uint64(28))


@kernel(allocates=False)
def _is_across_x(bits):  # type: ignore[no-untyped-def]
    """Whether the voxels of a block, bits (8,), fill fewer rows along y than along x."""
    more = 0
    for z in range(8):
        other = _transposed(bits[z])
        for n in range(8):
            byte = np.uint64(255) << np.uint64(8 * n)
            more += (bits[z] & byte) != np.uint64(0)
            more -= (other & byte) != np.uint64(0)
    return more > 0


@kernel(allocates=False)
def fill_rows(masks, near, blocks_out, margin, along_y, rows):  # type: ignore[no-untyped-def]
    """Bits of masks (B, 8), voxels up to `margin` beyond the middle one of the blocks `near`, as
    rows along x: bit 0 lies at x = -margin. Or as rows along y, for each x."""
    width = 2 * blocks_out + 1
    edge = BLOCK + 2 * margin
    all_bits = (np.uint64(1) << np.uint64(edge)) - np.uint64(1)
    rows[: edge * edge] = np.uint64(0)
    for n in range(width * width * width):
        other = near[n]
        if other < 0:
            continue
        shift = BLOCK * (n % width - blocks_out) + margin
        y0 = BLOCK * ((n // width) % width - blocks_out) + margin  # of its first row
        if along_y:
            shift, y0 = y0, shift
        z0 = BLOCK * (n // (width * width) - blocks_out) + margin
        for z in range(max(0, -z0), min(BLOCK, edge - z0)):
            word = masks[other, z]
            if word == np.uint64(0):
                continue
            if along_y:
                word = _transposed(word)
            for y in range(max(0, -y0), min(BLOCK, edge - y0)):
                byte = (word >> np.uint64(8 * y)) & np.uint64(255)
                byte = byte << np.uint64(shift) if shift >= 0 else byte >> np.uint64(-shift)
                rows[(z0 + z) * edge + y0 + y] |= byte & all_bits


@kernel(allocates=False, inlined=True)
def _list_along_x(blocks, halo, near, width, y, z, margin, row, count):  # type: ignore[no-untyped-def]
    """List the voxels of a row along x, its bits: as words, for now, where their rows are found, 8
    lines + x. near: place in halo.near of the block at x, y of the middle one and z of the row.
    Returns how many there are now."""
    near += width * (y >> 3)
    inside, cell, start = 8 * (z & 7) + (y & 7), np.int64(-99), np.int64(0)
    while row != np.uint64(0):
        bit = np.int64(trailing_zeros(row))
        row &= row - np.uint64(1)
        x = bit - margin
        if x >> 3 != cell:  # into the next block
            cell = x >> 3
            start = 8 * np.int64(blocks.lines[halo.near[near + cell], inside])
        halo.words[count] = start + (x & 7)
        halo.places[count] = bit | ((y + margin) << 8) | ((z + margin) << 16)
        count += 1
    return count


@kernel(allocates=False, inlined=True)
def _list_along_y(blocks, halo, near, width, x, z, margin, row, count):  # type: ignore[no-untyped-def]
    """Likewise those of a row along y."""
    near += x >> 3
    while row != np.uint64(0):
        bit = np.int64(trailing_zeros(row))
        row &= row - np.uint64(1)
        y = bit - margin
        line = blocks.lines[halo.near[near + width * (y >> 3)], 8 * (z & 7) + (y & 7)]
        halo.words[count] = 8 * np.int64(line) + (x & 7)
        halo.places[count] = (x + margin) | (bit << 8) | ((z + margin) << 16)
        count += 1
    return count


@kernel(allocates=False)
def gather(blocks, observable, block, margin, halo):  # type: ignore[no-untyped-def]
    """List the occupied voxels up to `margin` (at most WIDEST) beyond a block."""
    blocks_out = (margin + 7) >> 3
    width = 2 * blocks_out + 1
    edge = BLOCK + 2 * margin
    along_y = _is_across_x(blocks.occupied[block])
    find_near(blocks, block, blocks_out, halo.near)
    fill_rows(blocks.occupied, halo.near, blocks_out, margin, along_y, halo.rows)
    words, poses, places = halo.words, halo.poses, halo.places
    halo.along_y[0] = along_y
    halo.filled[:edge] = np.uint64(0)
    count = 0
    for line in range(edge * edge):
        halo.first[line] = count
        row = halo.rows[line]
        if row == np.uint64(0):
            continue
        halo.filled[line // edge] |= np.uint64(1) << np.uint64(line % edge)
        u, z = line % edge - margin, line // edge - margin
        near = width * (width * ((z >> 3) + blocks_out) + blocks_out) + blocks_out
        if along_y:
            count = _list_along_y(blocks, halo, near, width, u, z, margin, row, count)
        else:
            count = _list_along_x(blocks, halo, near, width, u, z, margin, row, count)
    for i in range(count):  # one look-up at a time for all: they do not wait for one another
        words[i] = blocks.rows[words[i] >> 3, words[i] & 7] - 1
    for i in range(count):
        seen = observable[words[i]]
        words[i] = seen
        poses[i] = seen >> 32
    _spread(words, places, count, halo.votes)


@kernel(allocates=False)
def _spread(words, places, count, votes):  # type: ignore[no-untyped-def]
    """What votes say, from low halves of observables and packed places."""
    for i in range(count):
        word, place = np.int64(words[i]), np.int64(places[i])
        x = 16 * (place & 255) | (word & 15) | (((word >> 12) & 15) << WEIGHT_IN_X)
        y = 16 * ((place >> 8) & 255) | ((word >> 4) & 15)
        z = 16 * (place >> 16) | ((word >> 8) & 15)
        votes[i] = x | (y << IN_Y) | (z << IN_Z) | ((word >> 16) << IN_VIEW)


@kernel(allocates=False, inlined=True)
def rows_within(halo, margin, x, y, r):  # type: ignore[no-untyped-def]
    """Where a cube round a voxel x, y of the block lies at each z: rows a z has, the first of its
    rows, its first bit in a row, as many ones as it is wide, and ones for the bits before it."""
    if halo.along_y[0] != 0:
        x, y = y, x
    low = np.uint64(x + margin - r)
    cube = (np.uint64(1) << np.uint64(2 * r + 1)) - np.uint64(1)
    before = (np.uint64(1) << low) - np.uint64(1)
    return BLOCK + 2 * margin, y + margin - r, low, cube, before


@kernel(allocates=False)
def take(halo, margin, x, y, z, r):  # type: ignore[no-untyped-def]
    """Copy the votes within r (Chebyshev, at most `margin`) of the voxel x, y, z of the block, at
    most MOST, to halo.taken. Returns how many; what lies behind them means nothing."""
    edge, first_y, low, cube, before = rows_within(halo, margin, x, y, r)
    count = 0
    for k in range(z + margin - r, z + margin + r + 1):
        filled = (halo.filled[k] >> np.uint64(first_y)) & cube
        while filled != np.uint64(0):
            line = k * edge + first_y + np.int64(trailing_zeros(filled))
            filled &= filled - np.uint64(1)
            row = halo.rows[line]
            start = halo.first[line] + np.int64(population(row & before))
            number = np.int64(population((row >> low) & cube))
            if count + number > MOST:
                return count
            _copy(halo.votes, start, halo.taken, count)  # mostly all, without asking
            for i in range(2 * QUARTERS, number, 2 * QUARTERS):
                _copy(halo.votes, start + i, halo.taken, count + i)
            count += number
    return count


@kernel(allocates=False, inlined=True)
def _copy(source, start, target, at):  # type: ignore[no-untyped-def]
    """Copy 2 x QUARTERS votes."""
    one, other = load(source, start), load(source, start + QUARTERS)
    store(target, at, one)
    store(target, at + QUARTERS, other)
