"""Who claims a voxel: its own patch, the patch a leftover joins, and a second one at corners.

A leftover (thick, aligned, mixed) joins the neighbouring patch whose plane it lies on and shares
its fate. A voxel at a corner lies on two planes: the second may use it as a vertex too.
"""

from __future__ import annotations

import numpy as np
from numba import njit

from facet.mapping.blocks import CENTRE

LEFTOVER_REACH = 8  # voxels between a leftover and the box of the patch it joins
CORNER_COS = 0.8  # planes that share a corner voxel differ by more than 37 degrees


@njit(cache=True, nogil=True)
def _candidates(blocks, patches, block, codes, planes, boxes):  # type: ignore[no-untyped-def]
    """Patches of a block and its 26 neighbours: label, plane (unit normal, offset, weight of its
    size) and box, in eighths from the block's own corner. Returns how many."""
    count = 0
    for n in range(27):
        other = block if n == CENTRE else blocks.neighbours[block, n]
        if other < 0:
            continue
        shift = (64 * (n % 3 - 1), 64 * ((n // 3) % 3 - 1), 64 * (n // 9 - 1))
        for p in range(patches.number[other]):
            if count == codes.shape[0]:
                return count
            unit, votes = patches.unit[other, p], float(patches.votes[other, p])
            ux, uy, uz = float(unit[0]), float(unit[1]), float(unit[2])
            length = np.sqrt(ux * ux + uy * uy + uz * uz)
            offset = 0.0
            for a in range(3):
                planes[count, a] = unit[a] / length
                middle = patches.centroid[other, p, a] / votes + shift[a]
                offset += planes[count, a] * middle
                boxes[count, a] = 8 * np.int64(patches.box[other, p, a]) + shift[a]
                boxes[count, a + 3] = 8 * np.int64(patches.box[other, p, a + 3]) + 8 + shift[a]
            planes[count, 3] = offset
            planes[count, 4] = 1.0 / (1.0 + votes)
            codes[count] = 16 * n + p
            count += 1
    return count


@njit(cache=True, nogil=True)
def _nearest(planes, boxes, count, local, seen, tolerance, avoid):  # type: ignore[no-untyped-def]
    """Candidate that suits a voxel best, none within 37 degrees of candidate `avoid`; -1: none.
    It must face the voxel's sensor, its plane must be near, and so must its box."""
    c0 = 8 * (local & 7) + (seen & 15)
    c1 = 8 * ((local >> 3) & 7) + ((seen >> 4) & 15)
    c2 = 8 * (local >> 6) + ((seen >> 8) & 15)
    v0, v1, v2 = ((seen >> 16) & 31) - 8, ((seen >> 21) & 31) - 8, ((seen >> 26) & 31) - 8
    mixed = ((seen >> 31) & 1) == 1
    best, best_cost = -1, np.inf
    for q in range(count):
        u = planes[q]
        w = abs(u[0] * c0 + u[1] * c1 + u[2] * c2 - u[3])
        if w > tolerance:
            continue
        if avoid < 0:
            if not mixed and u[0] * v0 + u[1] * v1 + u[2] * v2 <= 0.0:
                continue
        else:  # whoever claims a corner need not be seen from the same side
            o = planes[avoid]
            if u[0] * o[0] + u[1] * o[1] + u[2] * o[2] > CORNER_COS:
                continue
        box = boxes[q]
        gap = max(0, box[0] - c0, c0 - box[3], box[1] - c1, c1 - box[4], box[2] - c2, c2 - box[5])
        if gap > 8 * LEFTOVER_REACH:
            continue
        cost = (w / tolerance) ** 2 + (gap / (8.0 * LEFTOVER_REACH)) ** 2 + u[4]
        if cost < best_cost:
            best, best_cost = q, cost
    return best


@njit(cache=True, nogil=True)
def _flat(planes, count):  # type: ignore[no-untyped-def]
    """Whether all candidates look the same way: then there is no corner."""
    for q in range(1, count):
        if (
            planes[q, 0] * planes[0, 0] + planes[q, 1] * planes[0, 1] + planes[q, 2] * planes[0, 2]
            < 0.98
        ):
            return False
    return True


@njit(cache=True, nogil=True)
def label_blocks(blocks, observable, patches, which, grouping, changed):  # type: ignore[no-untyped-def]
    """Label every voxel of the blocks `which` again; mark the blocks where a label changed."""
    most = 27 * patches.votes.shape[1]
    codes = np.empty(most, np.int16)
    planes = np.empty((most, 5))
    boxes = np.empty((most, 6), np.int64)
    for q in range(which.shape[0]):
        block = which[q]
        count = _candidates(blocks, patches, block, codes, planes, boxes)
        flat = _flat(planes, count)
        for local in range(512):
            row = blocks.rows[block, local]
            if row < 0:
                continue
            seen = observable[row]
            label, second = -1, -1
            if seen != 0:
                own = -1
                if patches.member[row] >= 0:
                    label = 16 * CENTRE + patches.member[row]
                    for o in range(count):
                        if codes[o] == label:
                            own = o
                else:
                    own = _nearest(planes, boxes, count, local, seen, grouping.leftover, -1)
                    if own >= 0:
                        label = codes[own]
                if own >= 0 and not flat:
                    other = _nearest(planes, boxes, count, local, seen, grouping.leftover, own)
                    if other >= 0:
                        second = codes[other]
            if patches.label[row] != label or patches.second[row] != second:
                patches.label[row] = label
                patches.second[row] = second
                changed[q] = True
