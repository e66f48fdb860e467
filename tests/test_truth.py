"""An office against its exact truth, with few scans: bounds looser than those of `make bench`."""

from __future__ import annotations

import numpy as np
import pytest

from facet.mapping.mapper import Mapper
from facet.simulate import Noise
from scenes import Driven, drive
from scorer import Score, model_of, score

DRIVES = {  # options of the simulation, least recall
    "lidar3d": ({"num_scans": 150, "noise": Noise(0.012, 0.008)}, 0.98),  # the whole drive
    "pushbroom": ({"duration_s": 30.0, "noise": Noise(0.015, 0.008)}, 0.94),  # two rooms
}


@pytest.fixture(scope="module", params=DRIVES)
def driven(request: pytest.FixtureRequest) -> Driven:
    options, _ = DRIVES[request.param]
    return drive("office", request.param, **options)


@pytest.fixture(scope="module")
def mapper(driven: Driven) -> Mapper:
    mapper = Mapper()
    for scan in driven.scans:
        mapper.insert(scan)
    mapper.update()
    return mapper


@pytest.fixture(scope="module")
def scored(driven: Driven, mapper: Mapper) -> Score:
    return score(model_of(mapper.snapshot()), driven.truth)


def test_every_surface_is_found(scored: Score) -> None:
    assert len(scored.surfaces) >= 15
    assert len(scored.missing) <= 4, scored.table()


def test_the_area_is_covered_and_no_other(driven: Driven, scored: Score) -> None:
    _, least_recall = DRIVES[driven.truth.sensor]
    assert scored.area_recall >= least_recall, scored.table()
    assert scored.area_precision >= 0.975, scored.table()


def test_planes_lie_where_the_surfaces_are(scored: Score) -> None:
    found = [s for s in scored.surfaces if s.found]
    assert np.median([s.angle_deg for s in found]) <= 0.25
    assert np.median([abs(s.offset_m) for s in found]) <= 0.002
    assert max(s.angle_deg for s in found if s.seen_m2 >= 1.0) <= 3.0, scored.table()
    assert scored.worst_offset_m <= 0.02, scored.table()


def test_nothing_is_split_or_merged(scored: Score) -> None:
    assert not scored.splits
    assert not scored.merges
    assert scored.planes <= 1.5 * scored.truth_planes, scored.table()


def test_thin_walls_keep_both_faces(driven: Driven, scored: Score) -> None:
    assert not scored.thin_walls_lost
    assert scored.thin_walls or driven.truth.sensor == "pushbroom"


def test_openings_are_holes(scored: Score) -> None:
    assert scored.openings_found >= 0.5, scored.table()
    assert scored.openings_false == 0


def test_the_map_is_sound(mapper: Mapper) -> None:
    mapper.check_invariants()
