"""Strips of what is round are no planes, narrow planes are; and what is known of tile-planes from
update to update, when they are asked."""

from __future__ import annotations

import random

import numpy as np
import pytest

from facet.mapping.bends import Bends, _bent, _spans
from facet.mapping.mapper import Mapper
from facet.mapping.merging import Nodes
from facet.simulate import Noise
from mapping_logs import log
from scenes import columns, drive
from scorer import model_of, score


def strips(*places: tuple[float, float, float], votes: float = 400.0) -> Nodes:
    """Upright strips of 8 x 50 voxels: x and y where they stand, and where they face, degrees."""
    x, y, facing = np.array(places).T
    sine, cosine = np.sin(np.radians(facing)), np.cos(np.radians(facing))
    width, height = votes * 8.0**2 / 12.0, votes * 50.0**2 / 12.0
    flat = np.zeros(len(places))
    scatter = [sine * sine * width, -sine * cosine * width, flat, cosine * cosine * width, flat]
    return Nodes(
        np.full(len(places), votes),
        np.column_stack([x, y, flat]),
        np.column_stack([*scatter, flat + height]),
        np.column_stack([cosine, sine, flat]) * votes,
    )


def bent(nodes: Nodes, turns_deg: list[float]) -> list[bool]:
    """Which strips are, where each touches the next."""
    first = np.arange(len(turns_deg) - 1)
    pairs = np.column_stack([first, first + 1])
    spans = _spans(nodes.votes, nodes.scatter)
    found: list[bool] = _bent(pairs, nodes, spans, np.radians(turns_deg)).tolist()
    return found


def round_column(step_deg: float, number: int = 4) -> Nodes:
    """Strips round a column, `step_deg` from one to the next, seen from outside."""
    radius = 4.0 / np.tan(np.radians(step_deg) / 2.0)
    angle = np.arange(number) * step_deg
    x, y = radius * np.cos(np.radians(angle)), radius * np.sin(np.radians(angle))
    return strips(*zip(x, y, angle, strict=True))


def test_strips_that_turn_as_they_stand_to_one_another_are_bent() -> None:
    assert bent(round_column(20.0), [20.0] * 4) == [True] * 4


def test_beside_a_bent_strip_less_of_a_turn_is_asked_for() -> None:
    """At its end a curved wall goes over into a plane one, and turns by a part of the angle."""
    column = round_column(20.0)
    assert bent(column, [7.0] * 4) == [False] * 4
    assert bent(column, [7.0, 7.0, 20.0, 7.0]) == [True] * 4
    assert bent(column, [7.0, 0.0, 20.0, 7.0]) == [False, False, True, True]


def test_faces_of_a_pillar_are_not_though_points_of_others_turn_their_rims() -> None:
    assert bent(round_column(60.0), [13.0] * 4) == [False] * 4


def test_strips_that_turn_the_other_way_are_not() -> None:
    assert bent(round_column(20.0), [-20.0] * 4) == [False] * 4
    inside = round_column(20.0)  # seen from inside they hollow
    inside = inside._replace(unit=-inside.unit)
    assert bent(inside, [-20.0] * 4) == [True] * 4


def test_a_lone_strip_is_not() -> None:
    assert bent(round_column(20.0, 1), [20.0]) == [False]


def test_what_is_much_smaller_or_not_beside_it_bends_no_strip() -> None:
    pair = round_column(20.0, 2)
    small = pair._replace(votes=pair.votes * [1.0, 0.2], unit=pair.unit * [[1.0], [0.2]])
    assert bent(small, [20.0, 20.0]) == [False, True]
    above = pair._replace(mean=pair.mean + np.array([[0.0, 0.0, 0.0], [0.0, 0.0, 30.0]]))
    assert bent(above, [20.0, 20.0]) == [False, False]


def test_a_round_column_makes_no_planes_and_each_face_of_a_pillar_one() -> None:
    driven = drive(columns(), "lidar3d", num_scans=80, noise=Noise(0.012, 0.008))
    mapper = Mapper()
    mapper.insert_all(driven.scans)
    mapper.update()
    scored = score(model_of(mapper.snapshot()), driven.truth)
    assert not scored.missing, scored.table()
    assert sum(s.name.startswith("pillar") for s in scored.surfaces) == 6
    assert scored.curved_m2 <= 0.5, scored.table()  # of 9
    assert not scored.splits
    assert not scored.merges


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
