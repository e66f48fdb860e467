"""What is known of tile-planes from update to update, when planes are asked whether they bend."""

from __future__ import annotations

import random

import numpy as np
import pytest

from facet.mapping.bends import Bends
from facet.mapping.mapper import Mapper
from mapping_logs import log


def updates_of_a_shuffled_log() -> None:
    """After every update the sums that are kept are those that would be summed anew."""
    whole = log("room-lidar3d")
    scans = list(whole.scans)
    random.Random(5).shuffle(scans)
    mapper = Mapper(whole.settings)
    for scan in scans[:12]:
        mapper.insert(scan)
        mapper.update()
        table, label = mapper._table, mapper._planes.label
        asked = np.ones(len(mapper._planes.occupation), np.bool_)
        origin = np.random.default_rng(3).integers(-500, 500, (len(asked), 3))
        anew = Bends(whole.settings, mapper._store, mapper._normals, mapper._patches, mapper._tiles)
        kept = mapper._bends._sums(table, label, asked, origin)
        np.testing.assert_array_equal(kept, anew._sums(table, label, asked, origin))
        assert kept[:, 0].sum() > 100


def test_what_is_kept_is_what_would_be_summed_anew() -> None:
    updates_of_a_shuffled_log()


def test_sums_that_are_never_forgotten_are_noticed(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(Bends, "forget", lambda self, tiles: None)
    with pytest.raises(AssertionError):
        updates_of_a_shuffled_log()
