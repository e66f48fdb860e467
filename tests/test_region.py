"""Sums of the votes of a region, many at a time, against the definition, vote by vote."""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest
from numpy.typing import NDArray

from facet.mapping.adaptive import make_rule
from facet.mapping.blocks import pack
from facet.mapping.halo import WIDEST, gather, make_halos
from facet.mapping.quantise import quantise
from facet.mapping.region import SUMS, is_beside, is_one_pose, within, within_slab
from facet.mapping.settings import BLOCK, MapSettings
from facet.mapping.store import VoxelStore
from facet.mapping.traces import COUNT, LOOK, begin, list_votes
from mapping_logs import cloud

SETTINGS = MapSettings(voxel_m=0.0625)
Word = NDArray[np.int64]
RULE = make_rule(SETTINGS)[0]
VIEWS = np.array([-7, -4, -1, 1, 4, 7]) + 8
NORMALS = ([0, 0, 64], [37, -37, 37], [-45, 45, 1])


@cache
def place(across: int = 0) -> tuple[Word, Word, np.void]:
    """(N, 3) voxels round a block, (N,) what is seen of them, and the halo of that block: a full
    wall across an axis, a full floor and single voxels, seen from everywhere and with any
    centroid."""
    rng = np.random.default_rng(0)
    span = np.arange(-WIDEST, BLOCK + WIDEST)
    floor = np.stack(np.meshgrid(span, span, [3]), -1).reshape(-1, 3)
    wall = np.roll(np.stack(np.meshgrid([2], span, span), -1).reshape(-1, 3), across, axis=1)
    loose = rng.integers(-WIDEST, BLOCK + WIDEST, (2000, 3))
    voxels = np.unique(np.concatenate([floor, wall, loose]), axis=0)
    store = VoxelStore()
    store.insert(quantise([cloud((voxels + 0.5) * SETTINGS.voxel_m, at=(9.0, 9.0, 9.0))], SETTINGS))
    store.settle()
    rows = store.occupied_rows()
    words = np.zeros(len(rows), np.int64)
    for low, choice in ((0, np.arange(9)), (4, np.arange(9)), (8, np.arange(9))):
        words |= rng.choice(choice, len(rows)) << low
    words |= rng.integers(1, 9, len(rows)) << 12
    for low in (16, 21, 26):
        words |= rng.choice(VIEWS, len(rows)) << low
    words |= (rng.random(len(rows)) < 0.1).astype(np.int64) << 31
    words |= rng.choice([0, 7, 8], len(rows), p=[0.01, 0.98, 0.01]) << 32
    store.columns.observable[rows] = words
    keys = store.voxel_keys(rows)
    (block,) = np.flatnonzero(store.blocks.keys[: store.num_blocks] == pack(0, 0, 0))
    halo = make_halos(1)[0]
    gather(store.blocks, store.columns.observable, int(block), WIDEST, halo)
    assert halo["along_y"] == (across == 0)
    return keys, words, halo


def plain_sum(offset: Word, words: Word, counts: NDArray[np.bool_]) -> list[int]:
    """The sum of those votes that count."""
    offset, words = offset[counts], words[counts]
    c = 8 * offset + np.stack([words & 15, (words >> 4) & 15, (words >> 8) & 15], -1)
    w = (words >> 12) & 15
    products = [(w * c[:, a] * c[:, b]).sum() for a in range(3) for b in range(a, 3)]
    return [int(n) for n in (len(w), w.sum(), *(w[:, None] * c).sum(0), *products)]


def views_of(words: Word) -> Word:
    return np.stack([((words >> s) & 31) - 8 for s in (16, 21, 26)], -1)


def beside(seen: int, words: Word) -> NDArray[np.bool_]:
    """Votes of the voxel's side, by the angle between their views."""
    if (seen >> 31) & 1:
        return np.ones(len(words), np.bool_)
    own, views = views_of(np.array(seen)), views_of(words)
    dot = views @ own
    near = (dot >= 0) | (4 * dot * dot <= (views**2).sum(-1) * (own**2).sum())
    return np.asarray(near & ((words >> 31) & 1 == 0))


def listed(n: int, reach: int, across: int = 0) -> tuple[int, Word, np.recarray]:
    """(what is seen of the n-th voxel of the block, its place, votes round it)."""
    keys, words, halo = place(across)
    own = np.flatnonzero(((keys >= 0) & (keys < BLOCK)).all(1))[n]
    look = np.recarray(1, LOOK)[0]
    begin(reach, look.state)
    local = int(keys[own] @ [1, 8, 64])
    assert list_votes((halo, WIDEST, local, int(words[own]), RULE), look)
    return int(words[own]), keys[own], look


@pytest.mark.parametrize("across", [0, 1])
@pytest.mark.parametrize("reach", [1, 3, 4, 9, WIDEST])
def test_sums_are_those_of_the_definition(reach: int, across: int) -> None:
    """Whichever way the rows of the halo lie."""
    keys, words, _ = place(across)
    some = 0
    for n in range(0, 120, 8):
        seen, at, look = listed(n, reach, across)
        away = np.abs(keys - at).max(1)
        out = np.zeros(SUMS, np.int32)
        for r in range(1, reach + 1):
            within(look.votes, look.state[COUNT], r, out)
            counts = (away <= r) & beside(seen, words)
            assert out.tolist() == plain_sum(keys - at, words, counts), (n, r)
        own = np.array([seen & 15, (seen >> 4) & 15, (seen >> 8) & 15])
        off = 8 * (keys - at) + np.stack([words & 15, (words >> 4) & 15, (words >> 8) & 15], -1)
        for normal in NORMALS:
            middle = int(own @ normal)
            for half in (384.0, 511.5, 1e9):
                within_slab(look.votes, look.state[COUNT], reach, *normal, middle, half, out)
                inside = np.abs(off @ normal - middle) < half
                counts = (away <= reach) & inside & (views_of(words) @ normal > 0)
                assert out.tolist() == plain_sum(keys - at, words, counts), (n, normal, half)
                some += counts.sum()
    assert some > 100  # votes: else nothing was compared


def test_sides_are_those_of_the_single_votes() -> None:
    _, words, _ = place()
    for n in range(0, 40, 4):
        seen = listed(n, 3)[0]
        assert [is_beside(seen, int(w)) for w in words[:200]] == beside(seen, words[:200]).tolist()


@pytest.mark.parametrize("across", [0, 1])
@pytest.mark.parametrize("reach", [1, 3])
def test_one_pose_is_that_of_all_votes(reach: int, across: int) -> None:
    keys, words, _ = place(across)
    found = set()
    for n in range(120):
        seen, at, _ = listed(n, reach, across)
        poses = (words >> 32)[(np.abs(keys - at).max(1) <= reach) & beside(seen, words)]
        expected = len(set(poses.tolist())) == 1 and poses[0] != 0
        one = is_one_pose(place(across)[2], WIDEST, *at.tolist(), reach, seen)
        assert one == expected
        found.add(bool(one))
    assert found == {False, True}
