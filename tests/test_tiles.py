"""Tiles of 64 voxels: which blocks are whose, and who is told."""

from __future__ import annotations

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from facet.mapping.blocks import pack, pack_all, unpack
from facet.mapping.mapper import Mapper
from facet.mapping.table import tabulate
from facet.mapping.tiles import spread, tile_keys_of
from mapping_logs import cloud, log, mapped, wall

index = st.integers(-9000, 9000)
blocks = st.lists(st.tuples(index, index, index), min_size=1, max_size=20)


@settings(deadline=None)
@given(blocks)
def test_a_block_lies_in_one_tile(many: list[tuple[int, int, int]]) -> None:
    keys = pack_all(np.array(many, np.int64))
    expected = [pack(i // 8, j // 8, k // 8) for i, j, k in many]
    assert tile_keys_of(keys).tolist() == expected


@settings(deadline=None)
@given(blocks, blocks)
def test_what_moved_is_told_to_all_tiles_that_may_name_it(
    tiles: list[tuple[int, int, int]], many: list[tuple[int, int, int]]
) -> None:
    told = {pack(*t) for t in tiles}
    expected = set(told)
    for i, j, k in many:
        for n in range(27):
            near = i + n % 3 - 1, j + n // 3 % 3 - 1, k + n // 9 - 1
            expected.add(pack(*(c // 8 for c in near)))
    found = spread(np.array(sorted(told), np.int64), pack_all(np.array(many, np.int64)))
    assert found.tolist() == sorted(expected)


def test_nothing_moved_tells_nobody() -> None:
    assert spread(np.array([5], np.int64), np.zeros(0, np.int64)).tolist() == [5]


def test_only_tiles_near_a_change_are_told() -> None:
    rng = np.random.default_rng(0)
    mapper = mapped([cloud(wall(rng, 150_000, (16.0, 3.0), 0.005), at=(0.0, 8.0, 1.5))])
    whole = len(mapper._tiles.tiles)
    mapper.insert(cloud(np.array([[2.03, 1.0, 1.0]] * 3), at=(0.0, 1.0, 1.5), sequence=2))
    mapper.update()
    assert 0 < len(mapper.changed_tiles) < whole
    assert all(abs(t[1] * 3.2 + 1.6 - 1.0) < 3.2 for t in mapper.changed_tiles)


def test_changed_tiles_are_those_whose_voxels_show_otherwise() -> None:
    whole = log("room-depth")
    mapper = mapped(whole.scans[:8], whole.settings)

    def shown() -> dict[tuple[int, int, int], tuple[bytes, bytes]]:
        return {p.tile: (p.centroids.tobytes(), p.plane_ids.tobytes()) for p in mapper.points()}

    for scan in whole.scans[8:]:
        before = shown()
        mapper.insert(scan)
        mapper.update()
        after = shown()
        moved = {tile for tile in after if after[tile] != before.get(tile)}
        assert moved <= set(mapper.changed_tiles)
        some = mapper.points(mapper.changed_tiles)
        assert [p.tile for p in some] == mapper.changed_tiles
        assert all(after[p.tile] == (p.centroids.tobytes(), p.plane_ids.tobytes()) for p in some)


def test_adjacent_tile_planes_are_listed_once() -> None:
    whole = log("room-lidar3d")
    tiles = mapped(whole.scans, whole.settings)._tiles.tiles
    held = sorted((t for t in tiles.values() if t.num_planes), key=lambda t: t.key)
    tile_of, edges = tabulate(tiles).tile_of, tabulate(tiles).edges
    assert len(edges) > len(tile_of)
    assert len(np.unique(edges, axis=0)) == len(edges)
    assert np.all(edges[:, 0] < edges[:, 1])
    for one, other in tile_of[edges].tolist():
        gap = np.abs(np.subtract(unpack(held[other].key), unpack(held[one].key)))
        assert gap.max() <= 1


def stamped(mapper: Mapper) -> dict[int, bytes]:
    """The voxels of all tile-planes and their centroids, by stamp."""
    told, seen = dict[int, bytes](), mapper._store.columns.observable
    for tile in mapper._tiles.tiles.values():
        for stamp, low, high in zip(tile.stamps, tile.starts, tile.starts[1:], strict=False):
            own = tile.rows[low:high], seen[tile.rows[low:high]], tile.corner[low:high]
            told[int(stamp)] = b"".join(column.tobytes() for column in own)
    return told


def test_a_stamp_stays_with_the_same_voxels_alone() -> None:
    whole = log("room-depth")
    mapper = mapped(whole.scans[:8], whole.settings)
    kept = 0
    for scan in whole.scans[8:]:
        before = stamped(mapper)
        mapper.insert(scan)
        mapper.update()
        after = stamped(mapper)
        assert len(after) == sum(tile.num_planes for tile in mapper._tiles.tiles.values())
        assert all(before.get(stamp, held) == held for stamp, held in after.items())
        kept += len(before.keys() & after.keys())
    assert kept > 0
