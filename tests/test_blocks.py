"""Index arithmetic: keys and their inverse, the table from key to block, neighbours."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from facet.mapping.blocks import (
    CENTRE,
    OFFSET,
    find,
    hash_key,
    list_rows,
    list_voxels,
    pack,
    pack_all,
    put,
    rehash,
    unpack,
    unpack_all,
)
from facet.mapping.invariants import check_blocks
from facet.mapping.store import VoxelStore
from mapping_logs import ticks_of_one

index = st.integers(-OFFSET, OFFSET - 1)
triple = st.tuples(index, index, index)


@settings(deadline=None)
@given(triple)
def test_unpack_is_the_inverse_of_pack(ijk: tuple[int, int, int]) -> None:
    key = pack(*ijk)
    assert unpack(key) == ijk
    assert key >= 0


@settings(deadline=None)
@given(st.lists(triple, max_size=20))
def test_arrays_pack_as_single_indices_do(many: list[tuple[int, int, int]]) -> None:
    ijk = np.array(many, np.int64).reshape(-1, 3)
    keys = pack_all(ijk)
    assert keys.tolist() == [pack(*one) for one in many]
    np.testing.assert_array_equal(unpack_all(keys), ijk)


@settings(deadline=None)
@given(triple, triple)
def test_keys_sort_as_indices_do(a: tuple[int, int, int], b: tuple[int, int, int]) -> None:
    assert (pack(*a) < pack(*b)) == (a < b)


@settings(deadline=None)
@given(triple)
def test_a_hash_is_not_negative(ijk: tuple[int, int, int]) -> None:
    assert hash_key(pack(*ijk)) >= 0


@settings(deadline=None)
@given(st.sets(triple, max_size=60))
def test_the_table_finds_what_was_put_and_nothing_else(many: set[tuple[int, int, int]]) -> None:
    ordered = sorted(many)
    half = ordered[: len(ordered) // 2]
    keys = np.array([pack(*one) for one in half], np.int64)
    table = rehash(keys, len(keys), 128)
    for number, one in enumerate(ordered):
        known = number < len(half)
        assert find(*table, pack(*one)) == (number if known else -1)
    for number, one in enumerate(ordered[len(half) :], start=len(half)):
        put(*table, pack(*one), number)
    assert [find(*table, pack(*one)) for one in ordered] == list(range(len(ordered)))


def store_of(voxels: np.ndarray) -> VoxelStore:
    """A store with one point in the middle of each voxel (N, 3)."""
    store = VoxelStore()
    ticks = voxels.astype(np.int64) * 1024 + 512
    views = np.tile(np.array([127, 0, 0], np.int16), (len(ticks), 1))
    store.insert(ticks_of_one(ticks, views))
    return store


@pytest.mark.parametrize("shift", [0, -500_000, 900_000])
def test_a_block_has_27_different_neighbours(shift: int) -> None:
    cube = np.stack(np.meshgrid(*[np.arange(-1, 2)] * 3, indexing="ij"), -1).reshape(-1, 3)
    rng = np.random.default_rng(0)
    store = store_of(rng.permutation(cube) * 8 + shift)
    assert store.num_blocks == 27
    keys = store.blocks.keys[:27]
    middle = find(store.blocks.table_keys, store.blocks.table_values, pack(*[shift // 8] * 3))
    near = store.blocks.neighbours[middle].copy()
    assert near[CENTRE] in (-1, middle)
    near[CENTRE] = middle
    assert sorted(near.tolist()) == list(range(27))
    for n, block in enumerate(near.tolist()):
        offset = (n % 3 - 1, n // 3 % 3 - 1, n // 9 - 1)
        assert unpack(keys[block]) == tuple(shift // 8 + o for o in offset)


@settings(deadline=None)
@given(st.integers(0, 2**31), st.integers(1, 400))
def test_neighbour_links_agree_with_keys(seed: int, count: int) -> None:
    rng = np.random.default_rng(seed)
    check_blocks(store_of(rng.integers(-40, 40, (count, 3))))


def test_links_stay_true_while_the_store_grows() -> None:
    rng = np.random.default_rng(1)
    store = store_of(rng.integers(-300, 300, (20_000, 3)))
    assert store.num_blocks > 4096
    check_blocks(store)


def test_the_voxels_of_a_block_are_listed_by_their_places() -> None:
    rng = np.random.default_rng(2)
    store = store_of(rng.integers(-12, 12, (3000, 3)))
    blocks, c = store.blocks, store.columns
    rows, places = np.empty(512, np.int64), np.empty(512, np.int64)
    for block in range(store.num_blocks):
        own = np.flatnonzero(c.block[: store.num_rows] == block)
        expected = sorted(zip(c.local[own].tolist(), own.tolist(), strict=True))
        count = list_rows(blocks, block, rows, places)
        assert list(zip(places[:count].tolist(), rows[:count].tolist(), strict=True)) == expected
        bits = rng.integers(0, 1 << 63, 8).astype(np.uint64) & blocks.occupied[block]
        marked = [(p, r) for p, r in expected if (int(bits[p >> 6]) >> (p & 63)) & 1]
        count = list_voxels(blocks, block, bits, rows, places)
        assert list(zip(places[:count].tolist(), rows[:count].tolist(), strict=True)) == marked
