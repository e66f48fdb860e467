"""Which voxels must be labelled again: those whose labels a change may touch.

A label depends on the voxel's observable, on the patch it is a member of, and on those patches near
by on whose plane it lies. Of these a member asks only patches at an angle to its own. So what
changes on a wall matters to the leftovers along it and to its corners: to one voxel in ten.
"""

from __future__ import annotations

import numpy as np

from facet.mapping.blocks import find, pack, unpack
from facet.mapping.candidates import set_plane
from facet.mapping.kernel import kernel
from facet.mapping.settings import PER_BLOCK

UNSETTLED = 1024  # taken off a label that is not true any more
MOST = 40  # planes that changed near a block; with more, all its voxels are asked again
WAS = np.dtype(  # what the patches of a block were, to labels, before they were grouped again
    [
        ("number", np.int64),
        ("other", np.int64),  # a bit for each that is another now
        ("plane", np.int16, (PER_BLOCK, 5)),
    ],
    align=True,
)


@kernel(allocates=False)
def unsettle(labels, rows):  # type: ignore[no-untyped-def]
    """The labels of rows are not true any more."""
    for q in range(rows.shape[0]):
        label = labels[rows[q]]
        if label >= -1:
            labels[rows[q]] = label - UNSETTLED


@kernel(allocates=False)
def was_label(label):  # type: ignore[no-untyped-def]
    """What a label was before it was unsettled."""
    return label if label >= -1 else label + UNSETTLED


@kernel(allocates=False)
def find_dependents(blocks, far, which, was, flags, first, links, out):  # type: ignore[no-untyped-def]
    """Blocks whose labels may depend on what changed in the blocks `which` (Q,): these, those
    beside one where a patch is another, and those two away from it that are `far` (B,), with or
    without a block between.

    flags (B,) stay false. Lists each block once, and in first (B,) and links (2, 125 Q) which of
    the Q it depends on: first is 1 + a place in links, 0: on none; there lie q and the next one's
    1 + place. Returns how many blocks."""
    count = num_links = 0
    for q in range(which.shape[0]):
        flags[which[q]] = True
        out[count] = which[q]
        count += 1
    for q in range(which.shape[0]):
        if was[q].other == 0:
            continue
        i, j, k = unpack(blocks.keys[which[q]])
        for n in range(125):
            di, dj, dk = n % 5 - 2, (n // 5) % 5 - 2, n // 25 - 2
            other = find(blocks.table_keys, blocks.table_values, pack(i + di, j + dj, k + dk))
            if other < 0 or (max(abs(di), abs(dj), abs(dk)) == 2 and not far[other]):
                continue
            if not flags[other]:
                flags[other] = True
                out[count] = other
                count += 1
            links[0, num_links], links[1, num_links] = q, first[other]
            num_links += 1
            first[other] = num_links
    for q in range(count):
        flags[out[q]] = False
    return count


@kernel(allocates=False)
def list_news(blocks, patches, block, changes, tolerance, found):  # type: ignore[no-untyped-def]
    """List in found.news the planes, before and now, of patches near a block that changed, and in
    found.new_codes those of them that are in it or beside it, as they are now. Returns the number
    of planes, -1: too many, and that of codes.

    changes: regrouped blocks (Q,), what their patches were, first and links (`find_dependents`)."""
    which, was, first, links = changes
    num, num_codes, link = 0, 0, first[block]
    i, j, k = unpack(blocks.keys[block])
    while link > 0:
        q = links[0, link - 1]
        link = links[1, link - 1]
        a, b, c = unpack(blocks.keys[which[q]])
        a, b, c = a - i, b - j, c - k
        code = 16 * ((a + 1) + 3 * (b + 1) + 9 * (c + 1))
        is_near = max(abs(a), abs(b), abs(c)) < 2
        number, before = np.int64(patches.number[which[q]]), was[q]
        for p in range(max(number, before.number)):
            if (before.other >> p) & 1 == 0:
                continue
            if num + 2 > MOST:
                return -1, 0
            if p < before.number:
                plane = before.plane[p]
                num += set_plane(found.news, num, plane, 64 * a, 64 * b, 64 * c) <= tolerance
            if p < number:
                plane = patches.plane[which[q], p]
                if set_plane(found.news, num, plane, 64 * a, 64 * b, 64 * c) <= tolerance:
                    num += 1
                    if is_near:
                        found.new_codes[num_codes] = code + p
                        num_codes += 1
    return num, num_codes
