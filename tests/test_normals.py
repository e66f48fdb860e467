"""Local normals: the numbers of method.md 10, the truth of a wall, and what a line scan may say."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from facet.mapping.adaptive import make_rule
from facet.mapping.mapper import Mapper
from facet.mapping.normals import CLASS_NAMES
from facet.mapping.settings import MapSettings
from facet_protocol.messages import ScanKind
from mapping_logs import cloud, log, mapped, wall
from scenes import driven

PAPER = MapSettings(
    lambda_target=10.0, epsilon=0.5, tan_base=1.05, tan_slope=0.9, alpha_clip=1.10,
    n_min=12, n_0=40, n_max=120,
)  # fmt: skip


@pytest.mark.parametrize(("epsilon", "ratio"), [(0.5, 19.0), (10 / 21, 20.0), (0.3, 97 / 3)])
def test_weights_follow_from_epsilon(epsilon: float, ratio: float) -> None:
    """(25), method.md 10.3: epsilon = Lambda / (1 + w_N / w_sigma)."""
    (rule,) = make_rule(replace(PAPER, epsilon=epsilon))
    assert rule.w_points / rule.w_sigma == pytest.approx(ratio)
    assert 10.0 / (1.0 + rule.w_points / rule.w_sigma) == pytest.approx(epsilon)
    assert rule.sigma_target == pytest.approx(10.0 * rule.w_sigma)


def test_growth_by_number_of_votes() -> None:
    """(19), method.md 10.4: alpha = 1 at n_MIN, 0 at n_0, -1 at n_MAX; clamped, and falling."""
    growth = make_rule(PAPER)[0].growth
    assert growth[12] == pytest.approx(1.360768, abs=1e-6)
    assert growth[40] == pytest.approx(1.0, abs=1e-12)
    assert growth[120] == pytest.approx(0.734879, abs=1e-6)
    assert np.all(np.diff(growth) <= 0.0)
    assert np.isfinite(growth).all()
    limit = 1.05 ** math.tan(1.10 * 0.45 * math.pi)
    assert growth[0] == pytest.approx(limit)
    assert growth[-1] == pytest.approx(1.0 / limit)


@pytest.mark.parametrize("gain", [0.2, 0.5, 1.0])
@pytest.mark.parametrize(
    ("sigma", "density", "radius", "votes"),
    [(0.02, 60.0, 0.39479, 37.41), (0.02, 500.0, 0.19855, 78.85), (1e-9, 150.0, None, 23.95)],
)
def test_the_radius_settles_where_the_paper_says(
    gain: float, sigma: float, density: float, radius: float | None, votes: float
) -> None:
    """method.md 10.5: an ideal square patch; the sign of the step changes at the stated radius."""
    (rule,) = make_rule(replace(PAPER, gain=gain))

    def step(r: float) -> float:
        """R_next / R - 1 by (16) to (20)."""
        shape = r / math.sqrt(3.0) / sigma  # (18) with sigma1 = sigma2 = R / sqrt 3
        n = density * (2.0 * r) ** 2
        low = math.floor(n)
        growth = rule.growth[low] + (n - low) * (rule.growth[low + 1] - rule.growth[low])
        return rule.sigma_target / shape - rule.w_sigma + rule.w_points * (growth - 1.0)

    settled = radius or math.sqrt(votes / density) / 2.0
    assert density * (2.0 * settled) ** 2 == pytest.approx(votes, abs=0.01)
    assert step(0.99 * settled) > 0.0 > step(1.01 * settled)
    for factor in (0.5, 0.7, 0.9):
        assert step(factor * settled) > 0.0
    for factor in (1.1, 1.2):
        assert step(factor * settled) < 0.0


def normals_of(mapper: Mapper) -> tuple[list[str], NDArray[np.float64], NDArray[np.int64]]:
    """(class, normal (V, 3), voxel (V, 3)) of each occupied voxel."""
    store, normals = mapper._store, mapper._normals.normals
    rows = store.occupied_rows()
    kinds = [CLASS_NAMES[k] for k in normals.kind[rows]]
    return kinds, normals.unit[rows] / 256.0, store.voxel_keys(rows)


def test_normals_of_a_wall_point_to_the_sensor() -> None:
    points = wall(np.random.default_rng(0), 40_000, (3.0, 2.5), 0.01)
    for at, side in (((0.0, 2.0, 1.5), -1.0), ((4.0, 2.0, 1.5), 1.0)):
        mapper = mapped([cloud(points, at=at)])
        kinds, normals, _ = normals_of(mapper)
        valid = np.array(kinds) == "valid"
        assert valid.mean() > 0.7
        assert np.median(np.degrees(np.arccos(np.clip(side * normals[valid, 0], -1, 1)))) < 4.0
        mapper.check_invariants()


def test_a_flat_wall_without_noise_is_valid_too() -> None:
    """On perfectly flat data an adaptive threshold may degenerate."""
    mapper = mapped([cloud(wall(np.random.default_rng(1), 40_000, (3.0, 2.5)), at=(0.0, 2.0, 1.5))])
    kinds, normals, _ = normals_of(mapper)
    valid = np.array(kinds) == "valid"
    assert valid.mean() > 0.9
    assert np.abs(normals[valid] - [-1.0, 0.0, 0.0]).max() < 0.05


def test_a_lump_of_points_has_hardly_a_normal() -> None:
    """Thick: as far through as across. Dense, so that the regions stay small."""
    rng = np.random.default_rng(2)
    points = 2.0 + rng.uniform(-0.4, 0.4, (60_000, 3))
    kinds, _, _ = normals_of(mapped([cloud(points, at=(0.0, 0.0, 0.0))]))
    assert kinds.count("valid") < 0.2 * len(kinds)


def test_lonely_points_are_sparse() -> None:
    points = np.arange(30.0)[:, None] * [7.0, 5.0, 3.0] - 40.0
    kinds, _, _ = normals_of(mapped([cloud(points, at=(0.0, 0.0, 9.0))]))
    assert set(kinds) == {"sparse"}


def test_one_line_scan_says_nothing_about_normals() -> None:
    """method.md 10.9: an exactly flat set passes every test of planarity, with a wrong normal."""
    scans = driven("room", "pushbroom", 48).scans
    mapper = mapped(scans[:1])
    kinds, _, _ = normals_of(mapper)
    assert "valid" not in kinds
    assert kinds.count("aligned") > 0.5 * len(kinds)
    assert mapper.snapshot().changed == ()
    for again in range(2, 6):  # a robot that stands still learns no more
        mapper.insert(replace(scans[0], sequence=again, stamp_ns=scans[0].stamp_ns + again))
    mapper.update()
    assert "valid" not in normals_of(mapper)[0]
    assert mapper.snapshot().changed == ()
    mapper.check_invariants()


def test_a_wall_seen_by_one_line_scan_is_aligned() -> None:
    """A fan that runs along a straight wall."""
    y = np.linspace(-3.0, 3.0, 2000)
    points = np.stack([np.full(2000, 2.0), y, np.full(2000, 1.0)], axis=1)
    line = cloud(points, at=(0.0, 0.0, 1.0), kind=ScanKind.LINE)
    kinds, _, _ = normals_of(mapped([line]))
    assert set(kinds) <= {"aligned", "sparse"}
    assert kinds.count("aligned") > 0.9 * len(kinds)


def test_line_scans_from_many_poses_make_planes() -> None:
    scans = driven("room", "pushbroom", 120).scans
    assert all(s.kind is ScanKind.LINE for s in scans)
    mapper = mapped(scans, MapSettings(voxel_m=0.1))
    assert normals_of(mapper)[0].count("valid") > 0
    assert len(mapper.snapshot().changed) >= 3


def test_one_turn_of_a_many_beam_scanner_is_enough() -> None:
    """Points of a 3-D scan count as many poses."""
    mapper = mapped(driven("room", "lidar3d", 10).scans[:1], MapSettings(voxel_m=0.1))
    assert normals_of(mapper)[0].count("valid") > 0


def test_what_changed_lies_in_what_was_stale_and_that_near_what_was_dirty() -> None:
    """P8, on a growing map."""
    whole = log("room-lidar3d")
    mapper = mapped(whole.scans[:5], whole.settings)
    largest = whole.settings.max_radius
    for scan in whole.scans[5:]:
        before, seen = table(mapper), observables(mapper)
        mapper.insert(scan)
        mapper.update()
        after, now = table(mapper), observables(mapper)
        dirty = {v for v in now.keys() | seen.keys() if now.get(v) != seen.get(v)}
        changed = {v for v in after if before.get(v) != after[v]}
        stale = mapper.work["stale_voxels"]
        assert len(changed) <= stale <= len(after)
        spots = np.array(sorted(dirty))
        for voxel in sorted(changed - dirty)[::200]:
            assert np.abs(spots - voxel).max(axis=1).min() <= largest


def table(mapper: Mapper) -> dict[tuple[int, ...], tuple[object, ...]]:
    kinds, normals, voxels = normals_of(mapper)
    rows = zip(voxels.tolist(), kinds, normals.tolist(), strict=True)
    return {tuple(v): (kind, tuple(n)) for v, kind, n in rows}


def observables(mapper: Mapper) -> dict[tuple[int, ...], int]:
    rows = mapper._store.occupied_rows()
    voxels = mapper._store.voxel_keys(rows).tolist()
    seen = mapper._store.columns.observable[rows].tolist()
    return {tuple(v): s for v, s in zip(voxels, seen, strict=True)}
