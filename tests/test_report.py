"""The four-stage report adds up with the counts."""

from __future__ import annotations

import json

import pytest

from facet.mapping.mapper import Mapper
from mapping_logs import LOGS, log, mapped


@pytest.mark.parametrize("name", LOGS)
def test_the_report_agrees_with_the_counts(name: str) -> None:
    whole = log(name)
    mapper = mapped(whole.scans, whole.settings)
    report, counts = mapper.report(), mapper.counts()
    seeds, merged, detailed, final = report.planes
    assert seeds >= merged >= detailed >= final == len(mapper.snapshot().changed)
    assert report.aligned_percent == pytest.approx(100 * counts.aligned / counts.voxels)
    assert report.thick_percent == pytest.approx(100 * counts.thick / counts.voxels)
    assert report.discarded_percent == pytest.approx(100 * counts.discarded / counts.voxels)
    on_planes = sum(p.num_voxels for p in mapper.snapshot().changed)
    assert counts.discarded == counts.voxels - on_planes
    assert whole.settings.detail_level - 1e-9 <= report.detail_level_reached <= 1.0
    assert 0.0 <= report.discarded_points_percent <= 100.0
    assert 0.0 < report.average_two_sigma_m < 2 * whole.settings.voxel_m
    assert report.min_occupation <= whole.settings.min_area_m2 / whole.settings.voxel_m**2


def test_rows_are_a_table_of_four_stages() -> None:
    whole = log("room-lidar3d")
    report = mapped(whole.scans, whole.settings).report()
    assert [len(row) for row in report.rows] == [5, 5, 5]
    assert [int(cell) for cell in report.rows[1][1:]] == list(report.planes)
    assert "min. occupation" in report.rows[2][3]


def test_a_report_is_plain_data() -> None:
    report = Mapper().report()
    assert report.planes == (0, 0, 0, 0)
    assert json.loads(json.dumps(report.as_dict()))["discarded_percent"] == 0.0
