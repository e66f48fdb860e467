"""Stages 2 to 4 over tile-planes: the detail level, and what planes are made of."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from facet.mapping.mapper import Mapper
from facet.mapping.merging import limits
from facet.mapping.planes import detail_level, group_planes
from facet.mapping.settings import MapSettings
from facet.mapping.table import tabulate
from mapping_logs import log, mapped

UNBOUND = MapSettings(detail_level=0.98, min_area_m2=1e9)
counts = st.lists(st.integers(1, 10_000), min_size=1, max_size=40)


def test_the_detail_level_of_method_10_7() -> None:
    occupation = np.array([500, 300, 150, 30, 12, 5, 2, 1])
    for order in (np.arange(8), np.arange(8)[::-1], np.random.default_rng(0).permutation(8)):
        keep, least, reached = detail_level(occupation[order], UNBOUND)
        assert sorted(occupation[order][keep].tolist()) == [30, 150, 300, 500]
        assert least == 30
        assert reached == pytest.approx(0.98)


@settings(deadline=None)
@given(counts, st.floats(0.5, 1.0))
def test_the_kept_planes_are_the_fewest_that_reach_the_level(many: list[int], level: float) -> None:
    occupation = np.array(many)
    keep, least, reached = detail_level(occupation, replace(UNBOUND, detail_level=level))
    kept, total = occupation[keep], occupation.sum()
    assert reached == pytest.approx(kept.sum() / total)
    assert reached >= level - 1e-9
    assert least == kept.min()
    assert (occupation[~keep] < least).all()
    larger = occupation[occupation > least].sum()
    assert larger / total < level + 1e-9  # without the last size it would not be enough


@settings(deadline=None)
@given(counts)
def test_everything_is_kept_at_a_detail_level_of_one(many: list[int]) -> None:
    keep, least, reached = detail_level(np.array(many), replace(UNBOUND, detail_level=1.0))
    assert keep.all()
    assert (least, reached) == (min(many), 1.0)


@settings(deadline=None)
@given(counts)
def test_a_large_enough_plane_is_never_dropped(many: list[int]) -> None:
    """A new room drops nothing elsewhere: 0.25 m^2 are 100 voxels of 5 cm."""
    occupation = np.array(many)
    keep, least, _ = detail_level(occupation, MapSettings(detail_level=0.5))
    assert least <= 100
    assert keep[occupation >= 100].all()


def test_no_planes_have_no_detail() -> None:
    keep, least, reached = detail_level(np.zeros(0, np.int64), UNBOUND)
    assert (len(keep), least, reached) == (0, 0, 1.0)


def test_an_empty_table_groups_to_nothing() -> None:
    planes = group_planes(tabulate({}), limits(UNBOUND, 0.1), UNBOUND)
    assert len(planes.label) == len(planes.occupation) == 0


def room() -> Mapper:
    whole = log("room-lidar3d")
    return mapped(whole.scans, whole.settings)


def test_the_table_lists_tiles_in_order_of_their_keys() -> None:
    tiles = room()._tiles.tiles
    table = tabulate(tiles)
    mixed = tabulate(dict(sorted(tiles.items(), key=lambda item: -item[0])))
    assert table.tile_keys.tolist() == sorted(k for k, t in tiles.items() if t.num_planes)
    for a, b in zip(table, mixed, strict=True):
        for x, y in zip(
            a if isinstance(a, tuple) else [a], b if isinstance(b, tuple) else [b], strict=True
        ):
            np.testing.assert_array_equal(x, y)
    assert np.all(table.edges >= 0)
    assert np.all(table.edges < len(table.occupation))


def test_occupation_is_what_the_labels_say() -> None:
    mapper = room()
    planes, table = mapper._planes, mapper._table
    for plane, occupied in enumerate(planes.occupation.tolist()):
        assert occupied == table.occupation[planes.label == plane].sum()
    stages = planes.stages
    assert stages.seeds == len(planes.label)
    assert (
        stages.seeds >= stages.merged >= stages.detailed >= stages.final == len(planes.occupation)
    )
    assert 0.98 - 1e-9 <= stages.detail_reached <= 1.0
