"""Simulated sensors: the noise that was asked for, the same scans from the same seed."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from facet.simulate import SENSORS, Noise, Sensor, Simulation, Truth, scene_truth, simulate
from facet.simulate.raycast import GLASS, NOTHING, Faces
from facet.simulate.sensors import about_z, multiply, rotation
from facet.simulate.surfaces import TruthSurface, level_rectangle
from facet.simulate.truth import CELL_M, cells_in_ring, closed, grown
from facet_protocol.codec import encode
from facet_protocol.messages import Envelope, HoleKind, LineFan, Scan, ScanKind
from facet_protocol.scans import decode_scan
from scenes import Driven, drive, driven, quaternion_xyzw, recorded, room, small

KEY = "facet/v1/map/robot/sim/scan/sensor"
SILENT = Noise(0.0, 0.0, 0.0)


def world(scan: Scan, points: NDArray[np.float32]) -> NDArray[np.float64]:
    return points.astype(np.float64) @ rotation(scan.pose.orientation_xyzw).T + scan.pose.position


def to_nearest_surface(
    points: NDArray[np.float64], surfaces: tuple[TruthSurface, ...]
) -> NDArray[np.float64]:
    """(N,) m, to the nearest plane whose outline's box holds the point."""
    best = np.full(len(points), np.inf)
    for s in surfaces:
        uv = (points - s.origin) @ np.stack([s.axis_u, s.axis_v], axis=1)
        inside = np.all((uv > s.outer.min(axis=0) - 0.1) & (uv < s.outer.max(axis=0) + 0.1), axis=1)
        best = np.where(inside, np.minimum(best, np.abs(points @ s.normal - s.d)), best)
    return best


def same(a: Scan, b: Scan) -> bool:
    return (
        (a.sequence, a.stamp_ns, a.kind) == (b.sequence, b.stamp_ns, b.kind)
        and a.points.tobytes() == b.points.tobytes()
        and a.no_return.tobytes() == b.no_return.tobytes()
        and a.pose.position.tobytes() == b.pose.position.tobytes()
        and a.pose.orientation_xyzw.tobytes() == b.pose.orientation_xyzw.tobytes()
    )


@pytest.fixture(params=list(SENSORS))
def sensor(request: pytest.FixtureRequest) -> Sensor:
    return small(request.param)


def test_points_without_noise_lie_on_surfaces(sensor: Sensor) -> None:
    run = drive(room(), sensor, noise=SILENT, num_scans=12)
    for scan in run.scans:
        distance = to_nearest_surface(world(scan, scan.points), run.simulation.scene.surfaces)
        assert distance.max() < 2e-6  # float32 on the wire


def test_same_seed_same_scans(sensor: Sensor) -> None:
    first, second = (list(Simulation(room(), sensor, seed=3, num_scans=6).scans()) for _ in "ab")
    assert all(same(a, b) for a, b in zip(first, second, strict=True))
    other = Simulation(room(), sensor, seed=4, num_scans=6).scans()
    assert not any(same(a, b) for a, b in zip(first, other, strict=True))


def test_a_scan_does_not_depend_on_those_before(sensor: Sensor) -> None:
    simulation = Simulation(room(), sensor, seed=3, num_scans=6)
    in_turn = list(simulation.messages())
    alone = simulation.message(simulation.look(4))
    assert np.array_equal(alone.pose.position, in_turn[4].pose.position)


def test_scans_are_whole_and_in_order(sensor: Sensor) -> None:
    simulation = Simulation(room(), sensor, num_scans=10)
    scans = list(simulation.scans())
    assert len(scans) == len(simulation) == 10
    assert [s.sequence for s in scans] == list(range(1, 11))
    assert np.all(np.diff([s.stamp_ns for s in scans]) == simulation.period_ns)
    for scan in scans:
        assert scan.kind is sensor.kind
        assert scan.points.dtype == scan.no_return.dtype == np.float32
        assert len(scan.points) + len(scan.no_return) <= len(sensor.beams)
        assert np.isfinite(scan.points).all()
        assert np.linalg.norm(scan.pose.orientation_xyzw) == pytest.approx(1.0, abs=1e-12)


def test_range_noise_is_along_the_beam() -> None:
    run = drive(room(), small("lidar3d"), noise=Noise(0.02, 0.0), num_scans=4)
    errors = []
    for index, scan in enumerate(run.scans):
        look = run.simulation.look(index)
        hit = look.faces >= 0
        errors.append(np.linalg.norm(scan.points, axis=1) - look.ranges[hit])
        cosine = np.sum(scan.points * look.beams[hit], axis=1) / np.linalg.norm(scan.points, axis=1)
        np.testing.assert_allclose(cosine, 1.0, atol=1e-6)
    error = np.concatenate(errors)
    assert np.std(error) == pytest.approx(0.02, rel=0.03)
    assert np.mean(error) == pytest.approx(0.0, abs=0.001)


def test_pose_noise_is_in_the_message_only() -> None:
    noise = Noise(0.0, 0.01, 0.5)
    run = drive(room(), SENSORS["lidar3d"](rings=2, columns=8), noise=noise, num_scans=300)
    silent = Simulation(room(), run.simulation.sensor, noise=SILENT, num_scans=300)
    shifts, turns = [], []
    for index, scan in enumerate(run.scans):
        look = silent.look(index)
        shifts.append(scan.pose.position - look.position)
        turn = np.abs(scan.pose.orientation_xyzw @ look.orientation_xyzw)
        turns.append(2.0 * np.degrees(np.arccos(min(turn, 1.0))))
        np.testing.assert_allclose(
            np.linalg.norm(scan.points, axis=1), look.ranges[look.faces >= 0], rtol=1e-6
        )
    assert np.std(shifts) == pytest.approx(0.01, rel=0.1)
    assert np.sqrt(np.mean(np.square(turns))) == pytest.approx(0.5, rel=0.15)


def test_what_is_simulated_is_what_its_reader_gets(sensor: Sensor) -> None:
    simulation = Simulation(room(), sensor, num_scans=4)
    for message, scan in zip(simulation.messages(), simulation.scans(), strict=True):
        schema, payload = encode(message)
        envelope = Envelope(KEY, schema, "protobuf", payload)
        head = {"robot": "sim", "sensor": sensor.name, "epoch": 1, "sequence": scan.sequence}
        assert same(replace(decode_scan(envelope, "sim", sensor.name), **head), scan)


def test_glass_and_open_doors_come_back_empty() -> None:
    run = driven("room", "lidar3d", 12)
    ends = np.concatenate([scan.no_return for scan in run.scans])
    assert len(ends) > 0
    np.testing.assert_allclose(np.linalg.norm(ends, axis=1), run.simulation.reach_m, rtol=1e-6)
    kinds = {h.what: h.kind for s in run.truth.surfaces for h in s.holes}
    assert kinds == {"door": HoleKind.OPENING, "glass": HoleKind.OPENING}


def test_a_depth_camera_cannot_tell_glass() -> None:
    run = driven("room", "depth", 40)
    assert all(len(scan.no_return) == 0 for scan in run.scans)
    kinds = {h.what: h.kind for s in run.truth.surfaces for h in s.holes}
    assert kinds == {"door": HoleKind.UNOBSERVED, "glass": HoleKind.UNOBSERVED}


def test_a_pushbroom_is_a_fan() -> None:
    run = driven("room", "pushbroom", 60)
    for fan, scan in zip(run.messages, run.scans, strict=True):
        assert isinstance(fan, LineFan)
        assert scan.kind is ScanKind.LINE
        assert fan.ranges.dtype == np.float64
        assert len(scan.points) == np.isfinite(fan.ranges).sum()
        assert len(scan.no_return) == np.isposinf(fan.ranges).sum()
        assert np.all(scan.points[:, 2] == 0.0)


def test_a_pushbroom_sees_floor_walls_and_ceiling_at_once() -> None:
    simulation = Simulation("corridor", "pushbroom", num_scans=30)
    names = {simulation.scene.surfaces[f].name for f in simulation.look(0).faces if f >= 0}
    assert {"floor", "ceiling", "corridor S", "corridor N"} <= names
    forward = rotation(multiply(about_z(0.0), simulation.sensor.mount_xyzw))[:, 2]
    np.testing.assert_allclose(forward, [1.0, 0.0, 0.0], atol=1e-12)


def test_the_papers_half_fan() -> None:
    sensor = SENSORS["pushbroom"](fan_deg=180.0, beams=181)
    assert sensor.angles == pytest.approx((0.0, np.pi))
    assert sensor.beams[90] == pytest.approx([0.0, 1.0, 0.0])


def test_sizes_of_the_lidar() -> None:
    assert len(SENSORS["lidar3d"]().beams) == 32_000
    assert len(SENSORS["lidar3d"](rings=64, columns=2048).beams) == 131_072
    assert len(SENSORS["depth"]().beams) == 160 * 120


def test_how_many_scans() -> None:
    assert len(Simulation("hall85k", "pushbroom", max_points=85_000)) == 85_000 // 360
    assert sum(len(s.points) for s in simulate("hall", "pushbroom", max_points=15_000)) <= 15_000
    timed = Simulation("hall", "pushbroom", duration_s=2.0)
    assert len(timed) == 80
    slow, fast = (len(Simulation("hall", "pushbroom", speed_mps=v)) for v in (0.25, 0.5))
    assert slow == pytest.approx(2 * fast, abs=2)


def test_cast_meets_the_nearest_and_respects_holes_and_glass() -> None:
    near = level_rectangle("near", (0.0, 1.0), (0.0, 1.0), -1.0, looks_up=True)
    far = level_rectangle("far", (-5.0, 5.0), (-5.0, 5.0), -2.0, looks_up=True)
    down = np.array([[0.0, 0.0, -1.0], [0.0, 0.0, 1.0]])
    ranges, faces = Faces([far, near]).cast(np.array([0.5, 0.5, 0.0]), down)
    assert ranges.tolist() == [1.0, np.inf]
    assert faces.tolist() == [1, NOTHING]
    ranges, faces = Faces([far, near]).cast(np.array([2.5, 0.5, 0.0]), down)
    assert ranges.tolist() == [2.0, np.inf]
    simulation = Simulation(room(), small("lidar3d"), num_scans=5)
    assert GLASS in simulation.look(2).faces
    assert np.isinf(simulation.look(2).ranges[simulation.look(2).faces == GLASS]).all()


def test_truth_survives_its_file(tmp_path: Path) -> None:
    truth = driven("room", "lidar3d", 12).truth
    truth.write(tmp_path / "truth.json")
    again = Truth.read(tmp_path / "truth.json")
    assert again.as_dict() == truth.as_dict()
    assert np.array_equal(again.surface("floor").observed, truth.surface("floor").observed)
    with pytest.raises(ValueError, match="facet-truth"):
        Truth.from_dict({"format": "facet-model", "version": 1})


def test_truth_of_a_simulation_is_that_of_its_run() -> None:
    run = driven("room", "lidar3d", 12)
    again = scene_truth(Simulation(room(), small("lidar3d"), num_scans=12))
    assert again.as_dict() == run.truth.as_dict()


def test_what_is_behind_the_box_is_not_seen() -> None:
    truth = driven("room", "lidar3d", 12).truth
    floor, wall = truth.surface("floor"), truth.surface("room E")
    assert floor.area_m2 == pytest.approx(20.0)
    assert floor.seen_m2 < floor.area_m2 - 0.8  # the box stands on 1.2 m2
    assert wall.seen_m2 < wall.area_m2 - 0.8
    assert truth.surface("room W").seen_m2 > 0.9 * 10.0


def observed_points(run: Driven) -> int:
    return sum(int(s.observed.sum()) for s in run.truth.surfaces)


def test_more_scans_see_more() -> None:
    assert observed_points(driven("room", "pushbroom", 60)) > observed_points(
        driven("room", "pushbroom", 20)
    )


def test_cells_in_ring_follow_the_even_odd_rule() -> None:
    ring = np.array([[0.0, 0.0], [1.0, 0.0], [1.0, 0.5], [0.5, 0.5], [0.5, 1.0], [0.0, 1.0]])
    cells = cells_in_ring(ring, (-0.1, -0.1), (24, 24))
    assert cells.sum() * CELL_M**2 == pytest.approx(0.75)
    assert not cells[:2].any()
    assert not cells[:, :2].any()
    turned = cells_in_ring(ring[::-1] @ np.array([[0.8, 0.6], [-0.6, 0.8]]), (-1.0, -1.0), (60, 60))
    assert turned.sum() * CELL_M**2 == pytest.approx(0.75, abs=0.03)


def test_closing_fills_gaps_and_adds_no_border() -> None:
    mask = np.zeros((20, 20), dtype=bool)
    mask[5:15, 5:15] = True
    mask[8, 8] = mask[10:12, 5:15] = False
    assert closed(mask, 2).sum() == 100
    assert grown(mask, 1).sum() == 144


def test_quaternions_of_matrices() -> None:
    rng = np.random.default_rng(5)
    for q in rng.normal(size=(50, 4)):
        q /= np.linalg.norm(q)
        again = quaternion_xyzw(rotation(q))
        assert abs(again @ q) == pytest.approx(1.0, abs=1e-12)


@pytest.mark.parametrize("name", ["corridor", "panels", "rooms"])
def test_real_recordings_become_scans(name: str) -> None:
    scans = list(recorded(name, limit=2))
    assert len(scans) == 2
    assert all(np.isfinite(s.points).all() for s in scans)
    assert all(len(s.points) > 1000 for s in scans)
