"""Who claims a voxel: its own patch, the patch a leftover joins, and a second one at corners.

A leftover (thick, aligned, mixed) joins the neighbouring patch whose plane it lies on and shares
its fate. A voxel at a corner lies on two planes: the second may use it as a vertex too.
"""

from __future__ import annotations

import numpy as np
from numba import prange

from facet.mapping.blocks import CENTRE, find, pack, unpack
from facet.mapping.kernel import kernel

LEFTOVER_REACH = 8  # voxels between a leftover and the box of the patch it joins
CLAIM_REACH = 2  # voxels between a corner voxel and the box of a patch that claims it too
PARALLEL_COS = 0.98
HALF = 32.0  # 1/8 voxels: half a block
CHUNK = 16  # blocks that a thread takes at a time
CORNER_COS = 0.8  # planes that share a corner voxel differ by more than 37 degrees


@kernel
def _add_candidates(patches, other, code, shift, tolerance, count, codes, planes, boxes):  # type: ignore[no-untyped-def]
    """Append the patches of block `other` whose plane comes within `tolerance` of the block that
    asks: label, plane (unit normal, offset, weight of its size) and box, in eighths from the corner
    of the block that asks. Returns how many there are now."""
    for p in range(patches.number[other]):
        if count == codes.shape[0]:
            break
        unit, votes = patches.unit[other, p], float(patches.votes[other, p])
        ux, uy, uz = float(unit[0]), float(unit[1]), float(unit[2])
        one = 1.0 / np.sqrt(ux * ux + uy * uy + uz * uz)
        ux, uy, uz = ux * one, uy * one, uz * one
        centroid, size = patches.centroid[other, p], 1.0 / votes
        offset = (
            ux * (centroid[0] * size + shift[0])
            + uy * (centroid[1] * size + shift[1])
            + uz * (centroid[2] * size + shift[2])
        )
        beyond = abs(HALF * (ux + uy + uz) - offset) - HALF * (abs(ux) + abs(uy) + abs(uz))
        if beyond > tolerance:
            continue
        planes[count, 0], planes[count, 1], planes[count, 2] = ux, uy, uz
        planes[count, 3] = offset
        planes[count, 4] = 1.0 / (1.0 + votes)
        for a in range(3):
            boxes[count, a] = 8 * np.int64(patches.box[other, p, a]) + shift[a]
            boxes[count, a + 3] = 8 * np.int64(patches.box[other, p, a + 3]) + 8 + shift[a]
        codes[count] = code + p
        count += 1
    return count


@kernel
def _near_candidates(blocks, patches, block, tolerance, codes, planes, boxes):  # type: ignore[no-untyped-def]
    """Patches of a block and its 26 neighbours."""
    count = 0
    for n in range(27):
        other = block if n == CENTRE else blocks.neighbours[block, n]
        if other >= 0:
            shift = (64 * (n % 3 - 1), 64 * ((n // 3) % 3 - 1), 64 * (n // 9 - 1))
            count = _add_candidates(
                patches, other, 16 * n, shift, tolerance, count, codes, planes, boxes
            )
    return count


@kernel
def _far_candidates(blocks, patches, block, tolerance, count, codes, planes, boxes):  # type: ignore[no-untyped-def]
    """Append the patches of the blocks two away: the other jamb of a door."""
    i, j, k = unpack(blocks.keys[block])
    for n in range(125):
        di, dj, dk = n % 5 - 2, (n // 5) % 5 - 2, n // 25 - 2
        if max(abs(di), abs(dj), abs(dk)) < 2:
            continue
        other = find(blocks.table_keys, blocks.table_values, pack(i + di, j + dj, k + dk))
        if other >= 0:
            shift = (64 * di, 64 * dj, 64 * dk)
            count = _add_candidates(
                patches, other, 0, shift, tolerance, count, codes, planes, boxes
            )
    return count


@kernel
def _place(local, seen):  # type: ignore[no-untyped-def]
    """A voxel's rounded centroid, eighths from the block corner."""
    return (
        8 * (local & 7) + (seen & 15),
        8 * ((local >> 3) & 7) + ((seen >> 4) & 15),
        8 * (local >> 6) + ((seen >> 8) & 15),
    )


@kernel
def _off(planes, q, c):  # type: ignore[no-untyped-def]
    """Distance of a place from a candidate's plane."""
    return abs(planes[q, 0] * c[0] + planes[q, 1] * c[1] + planes[q, 2] * c[2] - planes[q, 3])


@kernel
def _dot(planes, q, o):  # type: ignore[no-untyped-def]
    return planes[q, 0] * planes[o, 0] + planes[q, 1] * planes[o, 1] + planes[q, 2] * planes[o, 2]


@kernel
def _beside(boxes, q, c, axis):  # type: ignore[no-untyped-def]
    """Signed way from a place to a candidate's box along an axis; 0 within it."""
    if c[axis] < boxes[q, axis]:
        return boxes[q, axis] - c[axis]
    return min(0, boxes[q, axis + 3] - c[axis])


@kernel
def _gap(boxes, q, c):  # type: ignore[no-untyped-def]
    """Chebyshev distance of a place from a candidate's box."""
    return max(
        abs(_beside(boxes, q, c, 0)), abs(_beside(boxes, q, c, 1)), abs(_beside(boxes, q, c, 2))
    )


@kernel
def _join(planes, boxes, count, local, seen, tolerance):  # type: ignore[no-untyped-def]
    """Candidate that a leftover joins, -1: none. It must face the voxel's sensor, its plane must
    be near, and so must its box."""
    c = _place(local, seen)
    v0, v1, v2 = ((seen >> 16) & 31) - 8, ((seen >> 21) & 31) - 8, ((seen >> 26) & 31) - 8
    mixed = ((seen >> 31) & 1) == 1
    best, best_cost = -1, np.inf
    for q in range(count):
        w = _off(planes, q, c)
        if w > tolerance:
            continue
        if not mixed and planes[q, 0] * v0 + planes[q, 1] * v1 + planes[q, 2] * v2 <= 0.0:
            continue
        gap = _gap(boxes, q, c)
        if gap > 8 * LEFTOVER_REACH:
            continue
        cost = (w / tolerance) ** 2 + (gap / (8.0 * LEFTOVER_REACH)) ** 2 + planes[q, 4]
        if cost < best_cost:
            best, best_cost = q, cost
    return best


@kernel
def _bridged(planes, boxes, count, q, c, tolerance):  # type: ignore[no-untyped-def]
    """Whether a place lies between candidate q and another of the same plane: on a threshold."""
    x, y, z = _beside(boxes, q, c, 0), _beside(boxes, q, c, 1), _beside(boxes, q, c, 2)
    for o in range(count):
        if o == q or _dot(planes, q, o) < PARALLEL_COS or _off(planes, o, c) > tolerance:
            continue
        ox, oy, oz = _beside(boxes, o, c, 0), _beside(boxes, o, c, 1), _beside(boxes, o, c, 2)
        dot = float(x * ox + y * oy + z * oz)
        lengths = float(x * x + y * y + z * z) * float(ox * ox + oy * oy + oz * oz)
        if dot < 0.0 and dot * dot > 0.5 * lengths:
            return True
    return False


@kernel
def _claim(planes, boxes, near, count, c, tolerance, own):  # type: ignore[no-untyped-def]
    """Candidate of the first `near`, at an angle to `own`, that claims a place as a corner, or as
    a threshold with the help of any of the `count`.

    Returns (candidate, -1: none; whether one was left out for want of the other jamb)."""
    best, best_cost, alone = -1, np.inf, False
    for q in range(near):
        if _dot(planes, q, own) > CORNER_COS:
            continue
        w = _off(planes, q, c)
        if w > tolerance:
            continue
        gap = _gap(boxes, q, c)
        if gap > 8 * CLAIM_REACH and not _bridged(planes, boxes, count, q, c, tolerance):
            alone = True
            continue
        cost = (w / tolerance) ** 2 + (gap / (8.0 * LEFTOVER_REACH)) ** 2 + planes[q, 4]
        if cost < best_cost:
            best, best_cost = q, cost
    return best, alone


@kernel
def _flat(planes, count):  # type: ignore[no-untyped-def]
    """Whether all candidates look the same way: then there is no corner."""
    for q in range(1, count):  # noqa: SIM110 numba has no all() of a generator
        if _dot(planes, q, 0) < PARALLEL_COS:
            return False
    return True


@kernel(parallel=True)
def label_blocks(blocks, observable, patches, which, tolerance, changed):  # type: ignore[no-untyped-def]
    """Label every voxel of the blocks `which` again; mark the blocks where a label changed.

    Reads the patches of the next blocks, and notes in patches.far where it had to ask those two
    away; every block writes its own voxels: threads change nothing."""
    most = 125 * patches.votes.shape[1]
    chunks = (which.shape[0] + CHUNK - 1) // CHUNK
    for chunk in prange(chunks):
        codes = np.empty(most, np.int16)
        planes = np.empty((most, 5))
        boxes = np.empty((most, 6), np.int64)
        for q in range(chunk * CHUNK, min(which.shape[0], (chunk + 1) * CHUNK)):
            changed[q] = _label_block(
                blocks, observable, patches, which[q], tolerance, codes, planes, boxes
            )


@kernel
def _label_block(blocks, observable, patches, block, tolerance, codes, planes, boxes):  # type: ignore[no-untyped-def]
    """Label the voxels of one block. Whether a label changed."""
    changed, far = False, False
    near = _near_candidates(blocks, patches, block, tolerance, codes, planes, boxes)
    count = near
    flat = _flat(planes, near)
    for local in range(512):
        row = blocks.rows[block, local]
        if row < 0:
            continue
        seen = observable[row]
        label, second, own = -1, -1, -1
        if seen != 0:
            if patches.member[row] >= 0:
                label = 16 * CENTRE + patches.member[row]
                for o in range(near):
                    if codes[o] == label:
                        own = o
            else:
                own = _join(planes, boxes, near, local, seen, tolerance)
                if own >= 0:
                    label = codes[own]
        if own >= 0 and not flat:
            c = _place(local, seen)
            other, alone = _claim(planes, boxes, near, count, c, tolerance, own)
            if alone and not far:
                far = True
                count = _far_candidates(
                    blocks, patches, block, tolerance, near, codes, planes, boxes
                )
                other, alone = _claim(planes, boxes, near, count, c, tolerance, own)
            if other >= 0:
                second = codes[other]
        if patches.label[row] != label or patches.second[row] != second:
            patches.label[row] = label
            patches.second[row] = second
            changed = True
    patches.far[block] = far
    return changed
