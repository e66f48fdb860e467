"""The paper's corridor, simulated, at its settings; `make bench NAME=paper` has all its sets."""

from __future__ import annotations

import pytest

from benchmarks.paper import CASES, Mapped, drive_case, map_case
from scorer import Score, model_of, score

CORRIDOR = CASES[0]


@pytest.fixture(scope="module")
def mapped_and_score() -> tuple[Mapped, Score]:
    driven = drive_case(CORRIDOR)
    mapped = map_case(CORRIDOR, driven.scans)
    return mapped, score(model_of(mapped.mapper.snapshot()), driven.truth)


def test_it_is_as_large_as_the_papers(mapped_and_score: tuple[Mapped, Score]) -> None:
    counts = mapped_and_score[0].counts
    assert 11_800 <= counts.points_in <= 12_200
    assert counts.points_stored == counts.points_in
    assert 1.0 <= counts.points_in / counts.voxels <= 1.5  # "every voxel" is "every point"


def test_no_more_is_discarded_than_in_the_paper(mapped_and_score: tuple[Mapped, Score]) -> None:
    assert mapped_and_score[0].report.discarded_points_percent <= 7.2


def test_the_stages_only_drop_planes(mapped_and_score: tuple[Mapped, Score]) -> None:
    report = mapped_and_score[0].report
    assert list(report.planes) == sorted(report.planes, reverse=True)
    assert report.planes[-1] <= 38
    assert report.detail_level_reached >= CORRIDOR.detail_level
    assert 0.02 <= report.average_two_sigma_m <= 0.05  # the paper's: 0.04


def test_what_is_there_is_found(mapped_and_score: tuple[Mapped, Score]) -> None:
    scored = mapped_and_score[1]
    assert scored.num_found >= len(scored.surfaces) - 4
    assert scored.area_recall >= 0.93
    assert scored.area_precision >= 0.88


def test_only_doors_a_voxel_behind_their_wall_are_merged(
    mapped_and_score: tuple[Mapped, Score],
) -> None:
    """A limit of so coarse a map: their leaves stand 12 cm back, the voxels measure 10."""
    assert all("leaf" in " ".join(pair) for pair in mapped_and_score[1].merges)


def test_the_map_is_sound(mapped_and_score: tuple[Mapped, Score]) -> None:
    mapped_and_score[0].mapper.check_invariants()
