"""Scenes: closed, exact, and driven through with room to spare."""

from __future__ import annotations

import numpy as np
import pytest

from facet.simulate import SCENES, Simulation
from facet.simulate.drive import Drive
from facet.simulate.surfaces import Opening, box, level_rectangle, ring_area, room_walls, wall
from facet.simulate.truth import SurfaceTruth, scene_truth
from facet_protocol.messages import PlaneClass
from scenes import small


@pytest.mark.parametrize("name", list(SCENES))
def test_no_beam_sees_the_back_of_a_face(name: str) -> None:
    simulation = Simulation(name, small("lidar3d"), num_scans=40)
    for index in range(len(simulation)):
        look = simulation.look(index)
        ranges, _ = simulation.faces.cast(look.position, look.directions, two_sided=True)
        front = np.where(look.faces >= 0, look.ranges, np.inf)
        assert np.all(ranges >= front - 1e-9)


@pytest.mark.parametrize("name", list(SCENES))
def test_empty_beams_leave_through_openings_only(name: str) -> None:
    simulation = Simulation(name, small("lidar3d"), num_scans=25)
    surfaces = simulation.scene.surfaces
    for index in range(len(simulation)):
        look = simulation.look(index)
        empty = look.directions[look.faces < 0]
        through = np.zeros(len(empty), dtype=bool)
        for surface in (s for s in surfaces if s.holes):
            along = empty @ surface.normal
            along[along == 0.0] = np.nan
            t = (surface.d - look.position @ surface.normal) / along
            local = look.position + t[:, None] * empty - surface.origin
            uv = local @ np.stack([surface.axis_u, surface.axis_v], axis=1)
            for hole in surface.holes:
                low, high = hole.ring.min(axis=0), hole.ring.max(axis=0)
                through |= (t > 0.0) & np.all((uv > low) & (uv < high), axis=1)
        assert through.all()


@pytest.mark.parametrize("name", list(SCENES))
def test_drive_keeps_clear_of_everything(name: str) -> None:
    simulation = Simulation(name, "pushbroom", num_scans=400)
    angles = np.linspace(0.0, 2.0 * np.pi, 60, endpoint=False)
    level = np.stack([np.cos(angles), np.sin(angles), np.zeros(60)], axis=1)
    for height in (0.3, 1.0):
        for position in simulation.positions + np.array([0.0, 0.0, height]):
            ranges, _ = simulation.faces.cast(position, level)
            assert ranges.min() > 0.25


@pytest.mark.parametrize("name", list(SCENES))
def test_surfaces_are_well_formed(name: str) -> None:
    surfaces = SCENES[name]().surfaces
    assert len({s.name for s in surfaces}) == len(surfaces)
    for s in surfaces:
        axes = np.stack([s.axis_u, s.axis_v, s.normal])
        np.testing.assert_allclose(axes @ axes.T, np.eye(3), atol=1e-12)
        np.testing.assert_allclose(s.lift(s.outer) @ s.normal, s.d, atol=1e-9)
        assert ring_area(s.outer) > 0.0
        assert all(ring_area(h.ring) < 0.0 for h in s.holes)


def test_office_has_each_kind_of_thing() -> None:
    surfaces = SCENES["office"]().surfaces
    whats = {hole.what for s in surfaces for hole in s.holes}
    assert whats == {"door", "window", "glass"}
    assert {s.plane_class for s in surfaces} == set(PlaneClass)
    assert sum(not s.planar for s in surfaces) == 16
    floors = sorted({round(s.d, 3) for s in surfaces if s.name in ("floor", "S3 platform")})
    assert floors == pytest.approx([0.43, 0.61])


def test_office_is_turned_against_the_axes() -> None:
    walls = [s for s in SCENES["office"]().surfaces if s.plane_class is PlaneClass.WALL]
    assert all(np.abs(s.normal[:2]).max() < 0.999 for s in walls if s.planar)


def test_office_rooms_are_all_seen() -> None:
    truth = scene_truth(Simulation("office", small("lidar3d"), num_scans=100))
    walls = [s for s in truth.surfaces if s.planar and s.area_m2 > 9.0]

    def share(surface: SurfaceTruth) -> float:
        return surface.seen_m2 / surface.area_m2

    assert min(share(s) for s in walls) > 0.6


def test_a_wall_is_seen_from_the_right_of_the_walk() -> None:
    np.testing.assert_allclose(wall("w", (0, 0), (3, 0), (0, 2)).normal, [0, -1, 0])


def test_an_opening_is_where_it_was_said() -> None:
    opening = Opening("window", 1.0, 1.5, 0.9, 2.0)
    for walls in (room_walls("r", (0, 4), (0, 3), (0, 2.5), {side: [opening]}) for side in "SWNE"):
        (holed,) = (s for s in walls if s.holes)
        world = holed.lift(holed.holes[0].ring)
        axis = 0 if holed.name[-1] in "SN" else 1
        np.testing.assert_allclose([world[:, axis].min(), world[:, axis].max()], [1.0, 1.5])
        np.testing.assert_allclose([world[:, 2].min(), world[:, 2].max()], [0.9, 2.0])


def test_a_room_looks_inwards_and_a_box_outwards() -> None:
    extent = (0.0, 2.0), (0.0, 3.0), (0.0, 2.5)
    middle = np.array([1.0, 1.5, 1.25])
    assert all(middle @ s.normal > s.d for s in room_walls("room", *extent))
    assert all(middle @ s.normal < s.d for s in box("box", *extent, "SWNETB"))
    assert level_rectangle("f", *extent[:2], 0.0, looks_up=True).plane_class is PlaneClass.FLOOR
    assert level_rectangle("c", *extent[:2], 2.0, looks_up=False).plane_class is PlaneClass.CEILING


def test_a_drive_is_even_and_smooth() -> None:
    drive = Drive(np.array([[0.0, 0.0, 0.0], [4.0, 0.0, 0.0], [4.0, 4.0, 0.5]]))
    positions, headings = drive.sample(0.05)
    steps = np.linalg.norm(np.diff(positions, axis=0), axis=1)
    np.testing.assert_allclose(steps, 0.05, atol=2e-4)
    assert np.abs(np.diff(headings)).max() < 0.3
    assert headings[0] == pytest.approx(0.0, abs=1e-6)
    assert headings[-1] == pytest.approx(np.pi / 2.0, abs=1e-6)
