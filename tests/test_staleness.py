"""Which blocks can hold something stale: against all pairs of blocks."""

from __future__ import annotations

import numpy as np
import pytest

from facet.mapping.blocks import unpack_all
from facet.mapping.settings import BLOCK, TICKS
from facet.mapping.staleness import ASKED, RINGS, find_candidates
from facet.mapping.store import VoxelStore
from mapping_logs import ticks_of_one

NO_BEAMS = np.zeros((0, 3), np.int64)


def store_of(blocks: np.ndarray) -> VoxelStore:
    """With one point in each of the blocks (B, 3)."""
    store, ticks = VoxelStore(), blocks * (BLOCK * TICKS) + 7
    views = np.zeros(blocks.shape, np.int16)
    store.insert(ticks_of_one(ticks, views, NO_BEAMS, np.zeros(3, np.int64), -1))
    store.settle()
    return store


@pytest.mark.parametrize("farthest", [0, 8, 9, 16, 17, 20])
@pytest.mark.parametrize("spread", [3, 9, 40])
def test_candidates_are_all_blocks_that_look_as_far(farthest: int, spread: int) -> None:
    """Spread over more than 16 blocks, too: there the places of those that were asked for meet."""
    rng = np.random.default_rng(farthest + spread)
    where = np.unique(rng.integers(-spread, spread, (400, 3)), axis=0).astype(np.int64)
    store = store_of(rng.permutation(where))
    num = store.num_blocks
    at = unpack_all(store.blocks.keys[:num])
    deepest = rng.integers(0, farthest + 1, 1 + num).astype(np.uint8)
    deepest[0] = deepest[1:].max()
    sources = rng.choice(num, 40, replace=False).astype(np.int32)
    room = np.zeros(num, np.bool_), np.empty((RINGS, ASKED), np.int64)
    for _ in range(2):  # what the last call asked for says nothing to the next
        out = np.empty(num, np.int32)
        count = find_candidates(store.blocks, deepest, sources, *room, out)
        gap = BLOCK * np.abs(at[:, None] - at[sources]).max(axis=2) - BLOCK + 1
        reached = (deepest[1:, None] >= gap) & (gap <= BLOCK * RINGS + 1)
        expected = np.flatnonzero((reached & (gap >= 1) | (gap < 1)).any(axis=1))
        assert sorted(out[:count].tolist()) == expected.tolist()
        assert not room[0].any()
        sources = sources[::-1].copy()
