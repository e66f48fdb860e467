"""The map is a pure function of the log: any order, any batching, undone as if never done."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from facet.mapping.mapper import Mapper
from facet.mapping.settings import MapSettings
from facet_protocol.maps import encode_update
from facet_protocol.mirror import MapMirror
from mapping_logs import LOGS, folds, keeps_order, log, mapped, stream, truth_of, undoes

every_log = pytest.mark.parametrize("name", LOGS)


@every_log
@pytest.mark.parametrize("seed", [1, 2])
def test_any_order_gives_the_same_map(name: str, seed: int) -> None:
    keeps_order(log(name), every=0, seed=seed, expected=truth_of(name)).check_invariants()


@every_log
@pytest.mark.parametrize("every", [3, 7])
def test_any_batching_gives_the_same_map(name: str, every: int) -> None:
    mapper = keeps_order(log(name), every=every, seed=3 + every, expected=truth_of(name))
    mapper.check_invariants()


@every_log
def test_an_update_after_each_scan_of_a_shuffled_log_gives_the_same_map(name: str) -> None:
    keeps_order(log(name), every=1, seed=5, expected=truth_of(name)).check_invariants()


@every_log
def test_scans_put_in_together_are_as_each_alone(name: str) -> None:
    whole = log(name).shuffled(8)
    mapper, alone = Mapper(whole.settings), Mapper(whole.settings)
    for start in range(0, len(whole.scans), 7):
        some = whole.scans[start : start + 7]
        assert mapper.insert_all(some) == [alone.insert(scan) for scan in some]
    mapper.update()
    assert mapper.digest() == truth_of(name)
    mapper.check_invariants()


@every_log
def test_beams_followed_beside_change_nothing(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("facet.mapping.mapper.MANY", 1)
    whole = log(name).shuffled(9)
    mapper = Mapper(whole.settings)
    for scan in whole.scans:
        mapper.insert(scan)
        mapper.insert(whole.scans[0])
        mapper.retract(whole.scans[0])
    mapper.update()
    assert mapper.digest() == truth_of(name)


@every_log
@pytest.mark.parametrize("seed", [11, 12])
def test_what_was_taken_out_was_never_there(name: str, seed: int) -> None:
    undoes(log(name), seed=seed).check_invariants()


@every_log
def test_everything_taken_out_leaves_an_empty_map(name: str) -> None:
    whole = log(name)
    mapper = mapped(whole.scans, whole.settings)
    for scan in whole.shuffled(4).scans:
        mapper.retract(scan)
    update = mapper.update()
    assert mapper.digest() == Mapper(whole.settings).digest()
    assert mapper.snapshot().changed == ()
    assert len(update.retired) > 0
    mapper.check_invariants()


@pytest.mark.parametrize("name", ["room-lidar3d", "room-pushbroom"])
def test_a_corrected_pose_is_as_if_sent_so_at_once(name: str) -> None:
    whole = log(name)
    rng = np.random.default_rng(6)
    moved = []
    for scan in whole.scans:
        position = scan.pose.position + rng.normal(0.0, 0.05, 3)
        moved.append(replace(scan, pose=replace(scan.pose, position=position)))
    mapper = mapped(moved, whole.settings, every=4)
    for wrong, right in zip(moved, whole.scans, strict=True):
        mapper.retract(wrong)
        mapper.insert(right)
    mapper.update()
    assert mapper.digest() == truth_of(name)
    mapper.check_invariants()


@every_log
def test_updates_fold_into_the_snapshot(name: str) -> None:
    folds(log(name), every=3)


def test_updates_fold_into_the_snapshot_while_scans_come_and_go() -> None:
    whole, rng = log("room-lidar3d"), np.random.default_rng(9)
    mapper, mirror, there = Mapper(whole.settings), MapMirror(), []
    for scan in whole.scans:
        mapper.insert(scan)
        there.append(scan)
        if rng.random() < 0.4:
            mapper.retract(there.pop(rng.integers(len(there))))
        assert mirror.apply(mapper.update())
        assert encode_update(mirror.snapshot()) == encode_update(mapper.snapshot())
    mapper.check_invariants()


@pytest.mark.parametrize("name", ["room-depth", "room-pushbroom"])
def test_two_runs_give_equal_updates_byte_for_byte(name: str) -> None:
    whole = log(name)
    one, two = (stream(whole.scans, whole.settings, every=4) for _ in range(2))
    assert [encode_update(u) for u in one] == [encode_update(u) for u in two]


def test_an_update_of_nothing_changes_nothing() -> None:
    whole = log("room-lidar3d")
    mapper = mapped(whole.scans, whole.settings)
    before = mapper.digest()
    update = mapper.update()
    assert (update.changed, update.retired, update.events) == ((), (), ())
    assert update.revision == update.base_revision + 1
    assert mapper.digest() == before
    assert mapper.changed_tiles == []


def test_moving_everything_by_whole_tiles_changes_nothing() -> None:
    """method.md 10.10, as the design supersedes it. Voxels of 1/16 m make the shift exact."""
    settings = MapSettings(voxel_m=0.0625)
    scans = log("room-lidar3d").scans
    shift = np.array([3.0, -5.0, 2.0]) * 64 * settings.voxel_m
    far = [replace(s, pose=replace(s.pose, position=s.pose.position + shift)) for s in scans]
    here, there = mapped(scans, settings), mapped(far, settings)
    one, two = here.counts(), there.counts()
    assert replace(one, points_rejected={}) == replace(two, points_rejected={})
    told, moved = here.report(), there.report()
    assert moved.average_two_sigma_m == pytest.approx(told.average_two_sigma_m, abs=1e-9)
    assert replace(moved, average_two_sigma_m=0.0) == replace(told, average_two_sigma_m=0.0)
    planes = zip(here.snapshot().changed, there.snapshot().changed, strict=True)
    for p, q in planes:
        assert (p.num_points, p.num_voxels, p.plane_class) == (
            q.num_points, q.num_voxels, q.plane_class,
        )  # fmt: skip
        normal = p.normal * p.facing
        np.testing.assert_allclose(q.normal * q.facing, normal, atol=1e-9)
        np.testing.assert_allclose(q.centroid, p.centroid + shift, atol=1e-9)
        assert q.d * q.facing == pytest.approx(p.d * p.facing + float(normal @ shift), abs=1e-7)
        area, again = (sum(s.area_m2 for s in plane.surfaces) for plane in (p, q))
        assert again == pytest.approx(area, rel=0.05, abs=0.1)  # vertices are rounded anew
    there.check_invariants()
