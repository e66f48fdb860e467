"""The scorer: exact truth scores 1, and each kind of damage shows in its own figure."""

from __future__ import annotations

import copy
from typing import Any

import numpy as np
import pytest

from facet.simulate import SCENES, Simulation, Truth, scene_truth
from scenes import driven, small
from scorer import Score, score, truth_model

Model = dict[str, Any]


@pytest.fixture(scope="module")
def office() -> Truth:
    return scene_truth(Simulation("office", small("lidar3d"), num_scans=90))


@pytest.fixture(scope="module")
def corridor() -> Truth:
    return scene_truth(Simulation("corridor", small("lidar3d"), num_scans=40))


@pytest.fixture
def model(office: Truth) -> Model:
    return truth_model(office)


def plane_of(model: Model, truth: Truth, name: str) -> dict[str, Any]:
    """The model plane with the surface `name`."""
    outer = truth.surface(name).outer.tolist()
    return next(p for p in model["planes"] if any(s["outer"] == outer for s in p["surfaces"]))


def surface_of(model: Model, truth: Truth, name: str) -> dict[str, Any]:
    outer = truth.surface(name).outer.tolist()
    found = next(s for s in plane_of(model, truth, name)["surfaces"] if s["outer"] == outer)
    return found  # type: ignore[no-any-return]


def shift(plane: dict[str, Any], along: float) -> None:
    """Move a plane towards the side it faces, m."""
    normal = np.array(plane["normal"]) * plane["facing"]
    plane["d"] += plane["facing"] * along
    for surface in plane["surfaces"]:
        surface["outer"] = (np.array(surface["outer"]) + along * normal).tolist()
        for hole in surface["holes"]:
            hole["ring"] = (np.array(hole["ring"]) + along * normal).tolist()


def is_perfect(result: Score) -> bool:
    return (
        not (result.missing or result.splits or result.merges or result.thin_walls_lost)
        and not (result.openings_missed or result.openings_false)
        and result.area_recall == result.area_precision == 1.0
        and result.curved_m2 == 0.0
        and result.planes == result.truth_planes
        and max(result.worst_angle_deg, result.worst_offset_m) < 1e-6
    )


@pytest.mark.parametrize("scene", list(SCENES))
@pytest.mark.parametrize("sensor", ["lidar3d", "depth"])
def test_exact_truth_is_perfect(scene: str, sensor: str) -> None:
    truth = driven(scene, sensor, 40).truth
    assert is_perfect(score(truth_model(truth), truth))


def test_the_truth_as_a_file_scores_the_same(office: Truth, model: Model) -> None:
    assert score(model, office.as_dict()).table() == score(model, office).table()


def test_the_office_has_what_is_to_be_found(office: Truth, model: Model) -> None:
    result = score(model, office)
    assert len(result.thin_walls) >= 10
    assert len(result.openings) >= 20
    assert {"S3 riser", "N2 slanted ceiling", "S3 platform"} <= {s.name for s in result.surfaces}
    assert "openings" in result.table()


def test_an_empty_model_finds_nothing(office: Truth) -> None:
    result = score({"planes": []}, office)
    assert result.num_found == result.area_recall == result.openings_found == 0.0
    assert result.area_precision == 1.0
    assert result.thin_walls_lost == result.thin_walls


def test_a_shifted_wall_is_an_offset(office: Truth, model: Model) -> None:
    shift(plane_of(model, office, "N1 W"), 0.02)
    result = score(model, office)
    assert result.worst_offset_m == pytest.approx(0.02, abs=1e-9)
    assert not result.missing
    assert result.area_recall == 1.0


def test_a_wall_shifted_too_far_is_missing_and_wrong(office: Truth, model: Model) -> None:
    shift(plane_of(model, office, "S1 E"), 0.08)
    result = score(model, office)
    assert result.missing == ("S1 E",)
    assert result.wrong_m2 == pytest.approx(office.surface("S1 E").area_m2, rel=0.03)
    assert result.openings_missed == ("S1 E door 0",)


def test_a_tilted_wall_is_an_angle(office: Truth, model: Model) -> None:
    plane = plane_of(model, office, "N1 E")
    surface = office.surface("N1 E")
    normal = surface.normal + np.tan(np.radians(1.5)) * surface.axis_u
    normal *= plane["facing"] / np.linalg.norm(normal)
    plane |= {"normal": normal.tolist(), "d": float(normal @ surface.outer.mean(axis=0))}
    result = score(model, office)
    assert result.worst_angle_deg == pytest.approx(1.5, abs=1e-6)
    assert result.worst_offset_m < 0.01  # at the centroid, not at the world's origin


def test_the_wrong_side_is_not_the_surface(office: Truth, model: Model) -> None:
    plane_of(model, office, "S1 W")["facing"] *= -1
    result = score(model, office)
    assert "S1 W" in result.missing
    assert result.area_precision < 1.0


def test_a_filled_hole_is_a_missed_opening_and_wrong_area(office: Truth, model: Model) -> None:
    surface_of(model, office, "N3 N")["holes"].clear()
    result = score(model, office)
    assert result.openings_missed == ("N3 N window 0",)
    assert result.openings_instead == ("filled",)
    assert 0.6 * 2.4 < result.wrong_m2 < 2.4  # its rim is within the tolerance


def test_a_hole_of_the_wrong_kind_is_a_missed_opening(office: Truth, model: Model) -> None:
    surface_of(model, office, "N3 N")["holes"][0]["kind"] = "unobserved"
    result = score(model, office)
    assert result.openings_missed == ("N3 N window 0",)
    assert result.openings_instead == ("unobserved",)
    assert result.wrong_m2 == 0.0


def test_a_door_left_out_of_the_outline_is_a_missed_opening(office: Truth, model: Model) -> None:
    truth, surface = office.surface("N1 S"), surface_of(model, office, "N1 S")
    (hole,) = surface["holes"]
    u = np.sort(truth.flat(np.array(hole["ring"]))[:, 0])
    a, b, *top = truth.flat(np.array(surface["outer"]))
    notch = [[u[0], 0.0], [u[0], 2.1], [u[-1], 2.1], [u[-1], 0.0]]
    uv = np.array([a, *notch, b, *top])
    outer = truth.origin + uv[:, :1] * truth.axis_u + uv[:, 1:] * truth.axis_v
    surface |= {"outer": outer.tolist(), "holes": []}
    result = score(model, office)
    assert result.openings_missed == ("N1 S door 0",)
    assert result.openings_instead == ("outside the outline",)
    assert result.area_recall == result.area_precision == 1.0


def test_an_opening_that_is_not_there_is_false(office: Truth, model: Model) -> None:
    truth = office.surface("S2 E")
    square = np.array([[3.0, 1.0], [3.0, 1.9], [3.9, 1.9], [3.9, 1.0]])
    ring = truth.origin + square[:, :1] * truth.axis_u + square[:, 1:] * truth.axis_v
    surface_of(model, office, "S2 E")["holes"].append({"kind": "opening", "ring": ring.tolist()})
    result = score(model, office)
    assert result.openings_false == 1
    assert result.openings_false_at == (plane_of(model, office, "S2 E")["id"],)
    assert 0.99 < result.area_recall < 1.0


def test_a_split_plane_is_seen(office: Truth, model: Model) -> None:
    plane = plane_of(model, office, "N2 slanted ceiling")
    other = copy.deepcopy(plane) | {"id": 1000}
    a, b, c, d = (np.array(v) for v in plane["surfaces"][0]["outer"])
    middle, across = (a + b) / 2, (c + d) / 2
    plane["surfaces"][0]["outer"] = [v.tolist() for v in (a, middle, across, d)]
    other["surfaces"][0]["outer"] = [v.tolist() for v in (middle, b, c, across)]
    model["planes"].append(other)
    result = score(model, office)
    assert result.splits == ("N2 slanted ceiling",)
    assert result.planes == result.truth_planes + 1
    assert result.area_recall == 1.0


def test_a_shell_beside_a_wall_is_a_split(office: Truth, model: Model) -> None:
    shell = copy.deepcopy(plane_of(model, office, "S2 E")) | {"id": 1000}
    shift(shell, 0.03)
    model["planes"].append(shell)
    assert score(model, office).splits == ("S2 E",)


def test_a_ghost_costs_precision(office: Truth, model: Model) -> None:
    ghost = copy.deepcopy(plane_of(model, office, "S2 E")) | {"id": 1000}
    shift(ghost, 1.2)
    model["planes"].append(ghost)
    result = score(model, office)
    assert result.area_precision < 0.99
    assert result.wrong_m2 == pytest.approx(office.surface("S2 E").area_m2, rel=0.03)
    assert result.planes == result.truth_planes + 1
    assert not result.splits


def test_a_dropped_surface_is_missing(office: Truth, model: Model) -> None:
    plane = plane_of(model, office, "S1 E")
    plane["surfaces"].remove(surface_of(model, office, "S1 E"))
    result = score(model, office)
    assert result.missing == ("S1 E",)
    assert result.thin_walls_lost == (("S1 E", "S2 W"),)
    assert result.area_recall < 1.0
    assert result.area_precision == 1.0


def test_merged_walls_are_seen(corridor: Truth) -> None:
    model = truth_model(corridor)
    wall = plane_of(model, corridor, "corridor S")
    leaf = plane_of(model, corridor, "door S1 leaf")
    assert leaf is not wall
    model["planes"].remove(leaf)
    shift(leaf, 0.10)
    shift(wall, -0.02)
    wall["surfaces"] += leaf["surfaces"]
    result = score(model, corridor)
    assert ("corridor S", "door S1 leaf") in result.merges
    assert "door S1 leaf" in result.missing
    assert result.planes == result.truth_planes - 1


def test_walls_merged_into_a_tilted_bridge_are_seen(corridor: Truth) -> None:
    assert score(truth_model(corridor), corridor).merges == ()
    model = truth_model(corridor)
    leaf = plane_of(model, corridor, "door S1 leaf")
    wall = plane_of(model, corridor, "corridor S")
    model["planes"].remove(leaf)
    wall["surfaces"] += leaf["surfaces"]  # flat outlines, tilted plane: 6 cm over the leaf
    normal = np.array(wall["normal"]) + np.array([0.005, 0.0, 0.0])
    normal /= np.linalg.norm(normal)
    wall |= {"normal": normal.tolist(), "d": float(normal @ np.array([9.45, -0.06, 0.0]))}
    assert ("corridor S", "door S1 leaf") in score(model, corridor).merges


def test_a_curved_wall_called_planar_is_counted_apart(office: Truth, model: Model) -> None:
    facets = [s for s in office.surfaces if not s.planar]
    facet = facets[len(facets) // 2]
    sign = 1 if facet.d >= 0.0 else -1
    plane = {"id": 1000, "facing": sign, "normal": (sign * facet.normal).tolist()}
    plane |= {"d": sign * facet.d, "surfaces": [{"outer": facet.outer.tolist(), "holes": []}]}
    model["planes"].append(plane)
    result = score(model, office)
    assert result.curved_m2 == pytest.approx(facet.area_m2, rel=0.1)
    assert result.area_precision == 1.0
