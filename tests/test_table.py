"""The table of tile-planes, made from the one before, is the one made anew."""

from __future__ import annotations

import numpy as np

from facet.mapping.mapper import Mapper
from facet.mapping.table import Table, Tabulator, tabulate
from mapping_logs import log


def is_same(one: Table, two: Table) -> bool:
    columns = zip((*one.nodes, *one[3:]), (*two.nodes, *two[3:]), strict=True)
    keys = np.array_equal(one.tile_keys, two.tile_keys)
    return keys and all(np.array_equal(a, b) and a.dtype == b.dtype for a, b in columns)


def test_tables_of_a_growing_map() -> None:
    whole, grown = log("room-lidar3d"), 0
    mapper, tabulator = Mapper(whole.settings), Tabulator()
    for scan in whole.scans:
        mapper.insert(scan)
        mapper.update()
        table = tabulator.tabulate(mapper._tiles.tiles)
        assert is_same(table, tabulate(mapper._tiles.tiles))
        assert is_same(table, mapper._table)
        grown = max(grown, len(table.edges))
    assert grown > 1000
    for scan in whole.scans[: len(whole.scans) // 2]:  # tiles and tile-planes go
        mapper.retract(scan)
        mapper.update()
        assert is_same(mapper._table, tabulate(mapper._tiles.tiles))
    assert len(mapper._table.edges) < grown


def test_tables_of_other_tiles() -> None:
    """Any of the tiles may be there, or not; some have other arrays with the same numbers."""
    whole = log("room-lidar3d")
    mapper = Mapper(whole.settings)
    for scan in whole.scans[:4]:
        mapper.insert(scan)
    mapper.update()
    tiles, tabulator, rng = mapper._tiles.tiles, Tabulator(), np.random.default_rng(0)
    before, changes = tabulator.tabulate(tiles), 0
    for _ in range(10):
        for tile in tiles.values():
            if rng.random() < 0.3:
                tile.points = rng.permutation(tile.points)
            if rng.random() < 0.3:
                tile.total = tile.total.copy()
        table = tabulator.tabulate(tiles)
        assert is_same(table, tabulate(tiles))
        changes += not is_same(table, before)
        before = table
    assert changes > 5
    none = tabulator.tabulate({})
    assert is_same(none, tabulate({}))
    assert len(none.total) == len(none.edges) == 0
    assert is_same(tabulator.tabulate(tiles), before)
