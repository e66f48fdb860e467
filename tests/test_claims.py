"""Labels are asked again only where a change can matter: they must be as if all were."""

from __future__ import annotations

import math

import numpy as np
import pytest

from facet.mapping.claims import BESIDE_COS, CORNER_COS, PARALLEL_COS
from facet.mapping.mapper import Mapper
from facet.mapping.unsettled import UNSETTLED, WAS, unsettle, was_label
from mapping_logs import LOGS, Log, log


def check_labels(mapper: Mapper) -> int:
    """Label all voxels again: none may be another. Returns how many there are."""
    store, field = mapper._store, mapper._patches
    count, patches = store.num_rows, field.patches
    label, second = patches.label[:count].copy(), patches.second[:count].copy()
    far = patches.far.copy()
    blocks = np.arange(store.num_blocks, dtype=np.int32)
    unsettle(patches.label, np.arange(count))
    field._label(store, blocks, np.zeros(len(blocks), WAS))
    np.testing.assert_array_equal(patches.label[:count], label)
    np.testing.assert_array_equal(patches.second[:count], second)
    assert not np.any(patches.far & ~far)  # it may be told too much, not too little
    patches.far[:] = far
    return int(np.count_nonzero(label >= 0))


def goes_through(whole: Log, mapper: Mapper) -> None:
    """Scans come one at a time, some go and come again: an update for each."""
    rng = np.random.default_rng(3)
    num = 0
    for scan in whole.scans:
        mapper.insert(scan)
        mapper.update()
        num += check_labels(mapper)
        if rng.random() < 0.3:
            mapper.retract(scan)
            mapper.update()
            check_labels(mapper)
            mapper.insert(scan)
    assert num > 0


@pytest.mark.parametrize("name", LOGS)
def test_labels_are_as_if_all_were_asked_again(name: str) -> None:
    whole = log(name)
    goes_through(whole, Mapper(whole.settings))


def test_so_they_are_in_a_map_that_hardly_changes() -> None:
    """Few patches change at a time: most voxels near them are not asked."""
    whole = log("office-lidar3d")
    mapper = Mapper(whole.settings)
    for _ in range(8):
        mapper.insert_all(whole.scans)
    mapper.update()
    goes_through(whole, mapper)


def test_what_changed_beside_the_own_patch_can_neither_claim_nor_help() -> None:
    nearest = math.acos(CORNER_COS) - math.acos(PARALLEL_COS)
    assert math.cos(nearest) <= BESIDE_COS


def test_a_label_knows_what_it_was() -> None:
    labels = np.array([-1, 0, 431], np.int16)
    unsettle(labels, np.array([0, 2, 2]))
    assert labels.tolist() == [-1 - UNSETTLED, 0, 431 - UNSETTLED]
    assert [was_label(int(label)) for label in labels] == [-1, 0, 431]
