"""The points of tile-planes: summed anew only where a run, or what a member is to it, changed."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import prange
from numpy.typing import NDArray

from facet.mapping.blocks import unpack
from facet.mapping.claims import is_own
from facet.mapping.eigen import smallest
from facet.mapping.kernel import kernel
from facet.mapping.membership import CLAIMED, LOOK, MIXED, MOVED, NEW, OTHER, PURE, TOUCHED
from facet.mapping.merging import plane_of
from facet.mapping.settings import BLOCK, STEPS, TILE
from facet.mapping.sums import SUMS, count_points, read_sums, shift_moments

STRAY = 0.47  # voxels: a voxel whose centroid is so far off its tile-plane is not fitted to
RIMMED = (12.0, 40.0)  # voxels: a tile-plane of such a width may be tilted by its rim
SLIM = (2.5, 4.0)  # voxels: a tile-plane of such a width is nearly all rim, and the middle says no
# tilt; what is less wide was cut off by the tile's border
CORE = 0.3  # voxels: centroids so near say where it truly lies
ROUNDS = 4
FEW = 30  # voxels say nothing
SLACK = 1e-6  # voxels that a member is nearer to STRAY than it looks
SURE = 1.0  # voxels: the largest margin


class Tally(NamedTuple):
    """The sums of T tile-planes, tile by tile."""

    points: NDArray[np.int64]  # (T, 10) exact moments of PURE members' points, tile corner
    total: NDArray[np.int64]  # (T,) points of all that are not only claimed
    occupation: NDArray[np.int64]  # (T,) voxels that are not only claimed
    facing: NDArray[np.float64]  # (T, 5) unit normal, offset from the tile corner, width; voxels
    planes: NDArray[np.float64]  # (T, 4) unit normal and offset of what members are STRAY from


@kernel(allocates=False)
def _seen_from(nodes, t, tile_key, out):  # type: ignore[no-untyped-def]
    """Unit normal of a tile-plane, its offset from the corner of the tile and its width into out
    (5,), voxels. The width is 0 where it is too small to have one."""
    ti, tj, tk = unpack(tile_key)
    nx, ny, nz, _, across = plane_of(nodes.votes[t], nodes.scatter[t], nodes.unit[t])
    mean = nodes.mean[t]
    offset = nx * (mean[0] - TILE * ti) + ny * (mean[1] - TILE * tj) + nz * (mean[2] - TILE * tk)
    out[0], out[1], out[2], out[3] = nx, ny, nz, offset
    out[4] = np.sqrt(12.0 * max(0.0, across))


@kernel
def _sound(sources, held, span, tile_key):  # type: ignore[no-untyped-def]
    """(N, 3) centroids of the members of runs that hold no points of others, from the corner of the
    tile, 1/8 voxels."""
    blocks, columns, border, second = sources
    start, stop = _rows_of(held, span)
    out = np.empty((stop - start, 3), np.int32)
    count = 0
    for r in range(span[0], span[1]):
        corner = _corner(blocks, held.block[r], tile_key)
        for m in range(held.start[r], held.start[r] + held.size[r]):
            row = held.rows[m]
            if held.state[m] == CLAIMED or not is_own(border, second, row):
                continue
            local, seen = np.int64(columns.local[row]), columns.observable[row]
            out[count, 0] = STEPS * (corner[0] + (local & 7)) + (seen & 15)
            out[count, 1] = STEPS * (corner[1] + ((local >> 3) & 7)) + ((seen >> 4) & 15)
            out[count, 2] = STEPS * (corner[2] + (local >> 6)) + ((seen >> 8) & 15)
            count += 1
    return out[:count]


@kernel
def _settled(centroids, plane):  # type: ignore[no-untyped-def]
    """The plane (4,) moved to where most of the centroids (N, 3) lie. A rim that tilts it, or
    another surface close by, is left behind."""
    spread = np.empty(6)
    pure = centroids.shape[0]
    for _ in range(ROUNDS):
        nx, ny, nz, offset = plane
        n = 0
        x, y, z, xx, xy, xz, yy, yz, zz = 0, 0, 0, 0, 0, 0, 0, 0, 0
        for m in range(pure):
            a, b, c = (
                np.int64(centroids[m, 0]), np.int64(centroids[m, 1]), np.int64(centroids[m, 2]),
            )  # fmt: skip
            if abs((nx * a + ny * b + nz * c) / STEPS - offset) > CORE:
                continue
            n, x, y, z = n + 1, x + a, y + b, z + c
            xx, xy, xz = xx + a * a, xy + a * b, xz + a * c
            yy, yz, zz = yy + b * b, yz + b * c, zz + c * c
        if n < FEW or 2 * n < pure:
            break
        mx, my, mz = x / n, y / n, z / n
        spread[0], spread[1], spread[2] = xx - x * mx, xy - x * my, xz - x * mz
        spread[3], spread[4], spread[5] = yy - y * my, yz - y * mz, zz - z * mz
        _, ux, uy, uz, _, _ = smallest(spread)
        sign = 1.0 if ux * nx + uy * ny + uz * nz > 0.0 else -1.0
        ux, uy, uz = sign * ux, sign * uy, sign * uz
        plane = ux, uy, uz, (ux * mx + uy * my + uz * mz) / STEPS
    return plane


@kernel(allocates=False)
def _corner(blocks, block, tile_key):  # type: ignore[no-untyped-def]
    """Where a block begins in a tile, voxels."""
    ti, tj, tk = unpack(tile_key)
    i, j, k = unpack(blocks.keys[block])
    return BLOCK * i - TILE * ti, BLOCK * j - TILE * tj, BLOCK * k - TILE * tk


@kernel(allocates=False)
def _drift(corner, old, new):  # type: ignore[no-untyped-def]
    """How far a plane (4,) moved in a block, voxels, at most."""
    dx, dy, dz = new[0] - old[0], new[1] - old[1], new[2] - old[2]
    half = BLOCK / 2.0
    middle = dx * (corner[0] + half) + dy * (corner[1] + half) + dz * (corner[2] + half)
    reach = half * (abs(dx) + abs(dy) + abs(dz))
    return abs(middle - (new[3] - old[3])) + reach


@kernel(allocates=False)
def _change(sources, row, corner, sign, pure, tally, t, sums):  # type: ignore[no-untyped-def]
    """Add a voxel's points, times the sign, to a tile-plane: to `pure` ones or to all."""
    columns = sources[1]
    if not pure:
        tally.total[t] += sign * count_points(columns, row)
        return
    read_sums(columns, row, sums)
    sums *= sign
    _shift(columns, row, corner, sums, tally.points[t])


@kernel(allocates=False)
def _shift(columns, row, corner, sums, points):  # type: ignore[no-untyped-def]
    """Add a voxel's sums to points (10,) about the corner of the tile."""
    local = np.int64(columns.local[row])
    x, y, z = corner[0] + (local & 7), corner[1] + ((local >> 3) & 7), corner[2] + (local >> 6)
    shift_moments(sums, x, y, z, points)


@kernel(allocates=False)
def _is_slim(facing):  # type: ignore[no-untyped-def]
    return SLIM[0] <= facing[4] < SLIM[1]


@kernel(allocates=False)
def _look(sources, held, r, corner, plane, slim, tally, t, sums, fresh):  # type: ignore[no-untyped-def]
    """Find what the members of a run are to their tile-plane, `slim` or not, and change its PURE
    points by it: add them, where they are `fresh`. Sets the margin."""
    _, columns, border, second = sources
    margin = SURE
    for m in range(held.start[r], held.start[r] + held.size[r]):
        if held.state[m] == CLAIMED:
            continue
        row = held.rows[m]
        now = MIXED
        if slim or is_own(border, second, row):
            local, seen = np.int64(columns.local[row]), columns.observable[row]
            off = (
                plane[0] * (corner[0] + (local & 7) + (seen & 15) / STEPS)
                + plane[1] * (corner[1] + ((local >> 3) & 7) + ((seen >> 4) & 15) / STEPS)
                + plane[2] * (corner[2] + (local >> 6) + ((seen >> 8) & 15) / STEPS)
                - plane[3]
            )
            margin = min(margin, abs(abs(off) - STRAY))
            now = MIXED if abs(off) > STRAY else PURE
        was = MIXED if fresh else held.state[m]
        if now != was:
            _change(sources, row, corner, 1 if now == PURE else -1, True, tally, t, sums)
        held.state[m] = now
    held.margin[r] = margin


@kernel(allocates=False)
def _count(sources, held, r, tally, t, sums):  # type: ignore[no-untyped-def]
    """Add the points of a run's members to the total."""
    for m in range(held.start[r], held.start[r] + held.size[r]):
        if held.state[m] != CLAIMED:
            _change(sources, held.rows[m], (0, 0, 0), 1, False, tally, t, sums)


@kernel(allocates=False)
def _drop(sources, before, r, corner, tally, t, sums):  # type: ignore[no-untyped-def]
    """Take the points of a run that is no more out of its tile-plane."""
    for m in range(before.start[r], before.start[r] + before.size[r]):
        _leave(sources, before, m, corner, tally, t, sums)


@kernel(allocates=False)
def _leave(sources, before, m, corner, tally, t, sums):  # type: ignore[no-untyped-def]
    """Take the points of a member out of its tile-plane."""
    if before.state[m] == PURE:
        _change(sources, before.rows[m], corner, -1, True, tally, t, sums)
    if before.state[m] != CLAIMED:
        _change(sources, before.rows[m], corner, -1, False, tally, t, sums)


@kernel(allocates=False)
def _merge(sources, before, old, held, r, corner, tally, t, sums):  # type: ignore[no-untyped-def]
    """Take out of a tile-plane what a run lost against its old one, and count what it won, which is
    not PURE yet. Both have their members in order of their places in the block."""
    local = sources[1].local
    m, stop = before.start[old], before.start[old] + before.size[old]
    for at in range(held.start[r], held.start[r] + held.size[r]):
        key = _key(local, held, at)
        while m < stop and _key(local, before, m) < key:
            _leave(sources, before, m, corner, tally, t, sums)
            m += 1
        if m < stop and _key(local, before, m) == key:
            held.state[at] = before.state[m]
            m += 1
        elif held.state[at] != CLAIMED:
            held.state[at] = MIXED
            _change(sources, held.rows[at], corner, 1, False, tally, t, sums)
    while m < stop:
        _leave(sources, before, m, corner, tally, t, sums)
        m += 1


@kernel(allocates=False)
def _key(local, held, m):  # type: ignore[no-untyped-def]
    """By which the members of a run are in order."""
    return 2 * np.int64(local[held.rows[m]]) + (held.state[m] == CLAIMED)


@kernel(allocates=False)
def _catch_up(sources, before, r, corner, news, tally, t, sums):  # type: ignore[no-untyped-def]
    """Add what came to the voxels of an old run. news: (place (V,) in what follows, plus 1, and
    (Q, SUMS) what the sums were)."""
    place, earlier = news
    columns = sources[1]
    for m in range(before.start[r], before.start[r] + before.size[r]):
        q = np.int64(place[before.rows[m]]) - 1
        if q < 0 or before.state[m] == CLAIMED:
            continue
        read_sums(columns, before.rows[m], sums)
        sums -= earlier[q]
        tally.total[t] += sums[0]
        if before.state[m] == PURE:
            _shift(columns, before.rows[m], corner, sums, tally.points[t])


@kernel
def catch_up(blocks, columns, flags, tile_keys, before, first, place, earlier, tally):  # type: ignore[no-untyped-def]
    """Add what came to the voxels of tiles (N,), whose members are as `before`, to the sums of
    their tile-planes, those of tile n from first[n] on; place, earlier: see `tally_points`."""
    sources, sums = (blocks, columns), np.empty(SUMS, np.int64)
    for n in range(tile_keys.shape[0]):
        for r in range(before.first[n], before.last[n]):
            if flags[before.block[r]] & TOUCHED:
                corner = _corner(blocks, before.block[r], tile_keys[n])
                t = first[n] + before.plane[r]
                _catch_up(sources, before, r, corner, (place, earlier), tally, t, sums)


@kernel
def _begin(sources, flags, tile_key, before, span, held, own, into, news, anew, old, tally):  # type: ignore[no-untyped-def]
    """What a tile's old tile-planes, span (first, last) of `old`, held, as sums of those they
    became: without the runs that are no more, with what came to the others. Whether each tile-plane
    has lost a run (T,), and what it was (T,), -1: nothing."""
    lost, was = np.zeros(own[1] - own[0], np.bool_), np.full(own[1] - own[0], -1, np.int64)
    first, last = span[0], span[1]
    for o in range(first, last):
        if into[o] >= 0:
            t = own[0] + into[o]
            was[into[o]] = o
            if not anew:
                tally.points[t], tally.total[t] = old.points[o], old.total[o]
    stays = np.zeros(span[3] - span[2], np.bool_)
    for r in range(own[2], own[3]):
        if held.old[r] != NEW:
            known = held.old[r] if held.old[r] >= 0 else OTHER - held.old[r]
            stays[known - span[2]] = True
    sums = np.empty(SUMS, np.int64)
    for r in range(span[2], span[3]):
        o = first + before.plane[r]
        if into[o] < 0:
            continue
        lost[into[o]] |= not stays[r - span[2]]
        if anew:
            continue
        corner = _corner(sources[0], before.block[r], tile_key)
        t = own[0] + into[o]
        if flags[before.block[r]] & TOUCHED:
            _catch_up(sources, before, r, corner, news, tally, t, sums)
        if not stays[r - span[2]]:
            _drop(sources, before, r, corner, tally, t, sums)
    return lost, was


@kernel
def _finish(  # type: ignore[no-untyped-def]
    sources, flags, nodes, tile_key, before, held, span, t, o, lost, anew, old, tally
):
    """Bring the sums of a tile-plane up to date, which was o, -1: nothing, and has the runs `span`.
    Returns whether it holds the same voxels at the same places."""
    same, stirred = o >= 0 and not lost, o < 0 or lost
    for r in range(span[0], span[1]):
        flag = flags[held.block[r]]
        stirred |= held.old[r] <= NEW or flag & LOOK != 0
        same &= held.old[r] > NEW and flag & MOVED == 0
    f = tally.facing[t]
    _seen_from(nodes, t, tile_key, f)
    still = not stirred
    for a in range(5 * still):
        still &= f[a] == old.facing[o, a]
    plane = f[0], f[1], f[2], f[3]
    if still:
        plane = old.planes[o, 0], old.planes[o, 1], old.planes[o, 2], old.planes[o, 3]
    elif RIMMED[0] <= f[4] <= RIMMED[1]:
        plane = _settled(_sound(sources, held, span, tile_key), plane)
    tally.planes[t, 0], tally.planes[t, 1], tally.planes[t, 2], tally.planes[t, 3] = plane
    slim = _is_slim(f)
    moved, turned = o < 0, o >= 0 and slim != _is_slim(old.facing[o])
    for a in range(4 * (not moved)):
        moved |= tally.planes[t, a] != old.planes[o, a]
    sums = np.empty(SUMS, np.int64)
    for r in range(span[0], span[1]):
        corner = _corner(sources[0], held.block[r], tile_key)
        fresh = held.old[r] == NEW or anew
        other = held.old[r] <= OTHER and not fresh
        if other:
            _merge(sources, before, OTHER - held.old[r], held, r, corner, tally, t, sums)
        look = fresh or other or turned or flags[held.block[r]] & LOOK != 0
        if moved and not look:
            held.margin[r] -= np.float32(_drift(corner, old.planes[o], plane) + SLACK)
            look = held.margin[r] <= 0.0
        if look:
            if slim:  # each is compiled by itself: a third off where few are slim
                _look(sources, held, r, corner, plane, True, tally, t, sums, fresh)
            else:
                _look(sources, held, r, corner, plane, False, tally, t, sums, fresh)
        if fresh:
            _count(sources, held, r, tally, t, sums)
    start, stop = _rows_of(held, span)
    occupation = 0
    for m in range(start, stop):
        occupation += held.state[m] != CLAIMED
    tally.occupation[t] = occupation
    return same


@kernel(allocates=False)
def _rows_of(held, span):  # type: ignore[no-untyped-def]
    """Where the rows of runs that follow one another begin and end."""
    if span[0] == span[1]:
        return 0, 0
    last = span[1] - 1
    return held.start[span[0]], held.start[last] + held.size[last]


@kernel(parallel=True)
def tally_points(  # type: ignore[no-untyped-def]
    blocks, columns, border, second, flags, nodes, tile_keys, parts, before, held, planes, into,
    place, earlier, anew, old, tally, same, was
):  # fmt: skip
    """Sum the points of the tile-planes of tiles (N,) about the tile's corner, without those that
    hold points of others: STRAY from their tile-plane and, but for SLIM ones, at a border or
    claimed by a plane at an angle. A tile-plane neither narrow nor wide is settled first: the rim
    of a table's top tilts it.

    before, held: the members then and now; planes:
    (N + 1, 2) where a tile's old tile-planes begin, and its new ones; into: (O,) what the old ones
    became; place (V,): of touched voxels, plus 1, in their sums `earlier` (Q, SUMS); old: what was
    tallied; same, was (T,): whether a tile-plane holds the same
    voxels at the same places, and which one it was; anew: nothing is known of what was.
    Leftovers count as well: the tails of the noise lie in them, and without these a plane across
    the grid is bent by where the grid cuts it."""
    for part in prange(parts.shape[0] - 1):
        sources, news = (blocks, columns, border, second), (place, earlier)
        for n in range(parts[part], parts[part + 1]):
            first, last = planes[n, 1], planes[n + 1, 1]
            own = first, last, held.first[n], held.last[n]
            span = planes[n, 0], planes[n + 1, 0], before.first[n], before.last[n]
            lost, known = _begin(
                sources, flags, tile_keys[n], before, span, held, own, into, news, anew, old, tally
            )
            r = held.first[n]
            for t in range(first, last):
                begin = r
                while r < held.last[n] and held.plane[r] == t - first:
                    r += 1
                was[t] = known[t - first]
                same[t] = _finish(
                    sources, flags, nodes, tile_keys[n], before, held, (begin, r), t, was[t],
                    lost[t - first], anew, old, tally,
                )  # fmt: skip
