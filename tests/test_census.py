"""Every point is accounted for: stored, or rejected for a reason (P5)."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from facet.mapping.mapper import Mapper
from facet_protocol.messages import Scan
from mapping_logs import LOGS, cloud, log, mapped


def spoilt(scan: Scan, seed: int) -> Scan:
    """With rows that cannot be mapped."""
    rng = np.random.default_rng(seed)
    points = scan.points.copy()
    for value in (np.nan, np.inf, 0.001, 4e5):
        points[rng.integers(0, len(points), 20)] = value
    return replace(scan, points=points)


def balanced(mapper: Mapper, scans: list[Scan]) -> None:
    counts = mapper.counts()
    assert counts.scans == len(scans)
    assert counts.points_in == sum(len(s.points) for s in scans)
    assert counts.points_in == counts.points_stored + sum(counts.points_rejected.values())
    held = mapper._store.num_points(np.arange(mapper._store.num_rows))
    assert counts.points_stored == held.sum()
    assert all(n > 0 for n in counts.points_rejected.values())


@pytest.mark.parametrize("name", LOGS)
def test_points_are_conserved_also_after_a_retract(name: str) -> None:
    whole = log(name)
    scans = [spoilt(s, k) for k, s in enumerate(whole.scans)]
    mapper = mapped(scans, whole.settings)
    balanced(mapper, scans)
    assert {"nan", "inf", "too_near", "too_far"} <= mapper.counts().points_rejected.keys()
    while len(scans) > 2:
        mapper.retract(scans.pop(len(scans) // 2))
    mapper.update()
    balanced(mapper, scans)
    mapper.check_invariants()
    for scan in scans:
        mapper.retract(scan)
    mapper.update()
    empty = mapper.counts()
    assert (empty.scans, empty.points_in, empty.points_stored, empty.voxels) == (0, 0, 0, 0)
    assert empty.points_rejected == {}


def test_insert_tells_what_became_of_the_points() -> None:
    mapper = Mapper()
    rows = np.array([[1.0, 2.0, 3.0], [np.nan, 0, 0], [2.0, 2.0, 2.0], [0.001, 0, 0]])
    told = mapper.insert(cloud(rows))
    assert told.points_stored == 2
    assert told.rejected == {"nan": 1, "too_near": 1}


@pytest.mark.parametrize("name", LOGS)
def test_every_voxel_has_one_fate(name: str) -> None:
    whole = log(name)
    mapper = mapped(whole.scans, whole.settings)
    c = mapper.counts()
    assert c.valid + c.aligned + c.thick + c.sparse + c.mixed == c.voxels
    ids = np.concatenate([p.plane_ids for p in mapper.points()])
    assert len(ids) == c.voxels
    shown = dict(zip(*np.unique(ids, return_counts=True), strict=True))
    assert shown.pop(0, 0) == c.discarded
    assert shown == {p.id: p.num_voxels for p in mapper.snapshot().changed}
    assert c.discarded <= c.discarded_points <= c.points_stored


def test_voxels_are_shown_where_the_points_are() -> None:
    rng = np.random.default_rng(0)
    points = rng.uniform(-9.0, 9.0, (3000, 3))
    mapper = mapped([cloud(points, at=(20.0, 0.0, 0.0))])
    shown = np.concatenate([p.xyz() for p in mapper.points()])
    gap = np.abs(points[:, None, :] - shown[None, :, :]).max(axis=2)
    assert gap.min(axis=0).max() <= 0.05 * (1 + 1 / 16)
    assert gap.min(axis=1).max() <= 0.05 * (1 + 1 / 16)


def test_counts_are_there_between_insert_and_update() -> None:
    """A status is asked for at any time."""
    mapper = Mapper()
    mapper.insert(log("room-lidar3d").scans[0])
    assert mapper.counts().voxels == 0
    assert mapper.counts().points_stored > 0
    mapper.update()
    voxels = mapper.counts().voxels
    for scan in log("room-lidar3d").scans[1:]:
        mapper.insert(scan)
        assert mapper.counts().voxels == mapper.num_voxels == voxels
        mapper.report()
        mapper.digest()
        mapper.points()
    mapper.update()
    assert mapper.counts().voxels == mapper.num_voxels > voxels
