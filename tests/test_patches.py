"""The noise of the scene, by a ladder that moves now and then."""

from __future__ import annotations

import numpy as np
import pytest

from facet.mapping.mapper import Mapper
from facet.mapping.rungs import LIMITS
from facet.mapping.settings import TICKS
from mapping_logs import cloud, log, mapped, wall


def noisy(sigma: float) -> Mapper:
    points = wall(np.random.default_rng(0), 120_000, (3.0, 2.5), sigma)
    return mapped([cloud(points, at=(0.0, 2.0, 1.5))])


@pytest.mark.parametrize("sigma", [0.003, 0.006, 0.012])
def test_sigma_is_that_of_the_points(sigma: float) -> None:
    """Within a rung of 20 %, and what patches of few voxels cost."""
    assert noisy(sigma).counts().sigma_n_m == pytest.approx(sigma, rel=0.35)


def test_sigma_of_an_empty_map_is_the_lowest_rung() -> None:
    assert 0.0 < Mapper()._patches.sigma() / TICKS < 0.05


def test_sigma_stands_on_a_ladder() -> None:
    steps = np.sqrt(LIMITS)
    np.testing.assert_allclose(steps[1:] / steps[:-1], steps[1] / steps[0])
    told = {noisy(s)._patches.sigma() for s in (0.006, 0.00601, 0.00602)}
    assert len(told) == 1


def test_the_histogram_of_rungs_comes_back_to_nothing() -> None:
    whole = log("room-depth")
    mapper = mapped(whole.scans, whole.settings, every=3)
    assert mapper._patches.histogram.sum() > 0
    assert mapper._patches.histogram.min() >= 0
    for scan in whole.scans:
        mapper.retract(scan)
    mapper.update()
    assert not mapper._patches.histogram.any()


def test_members_of_a_patch_have_like_normals() -> None:
    whole = log("room-lidar3d")
    mapper = mapped(whole.scans, whole.settings)
    store, patches, unit = mapper._store, mapper._patches.patches, mapper._normals.normals.unit
    rows = store.occupied_rows()
    rows = rows[patches.member[rows] >= 0]
    mean = patches.unit[store.columns.block[rows], patches.member[rows]].astype(float)
    own = unit[rows].astype(float)
    cos = (mean * own).sum(1) / np.linalg.norm(mean, axis=1) / np.linalg.norm(own, axis=1)
    assert np.degrees(np.arccos(np.clip(cos, -1, 1))).max() < 2.5 * whole.settings.patch_angle_deg
    votes = patches.votes[store.columns.block[rows], patches.member[rows]]
    assert votes.min() >= 1
