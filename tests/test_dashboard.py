"""The dashboard's file holds what the map held; nothing in it is NaN, aliased or left behind."""

from collections import defaultdict
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import rerun as rr
from rerun.chunk import RrdReader

import office
from facet.sinks import drawing
from facet.sinks.dashboard import PATH_PIECE, Dashboard, RobotPath, RrdViewer, _leaves
from facet_protocol.messages import (
    Envelope,
    Event,
    EventKind,
    MapUpdate,
    PlaneClass,
    Pose,
    StampedPose,
    Tombstone,
)
from facet_protocol.topics import pose_topic

FLAT = np.array([0.0, 0.0, 0.0, 1.0])


@pytest.fixture(autouse=True)
def _strict():
    rr.set_strict_mode(True)
    yield
    rr.set_strict_mode(False)


def _entities(path: Path) -> dict[str, list[dict]]:
    """Rows by entity, in the order of the file."""
    rows = defaultdict(list)
    for chunk in RrdReader(path).stream():
        rows[chunk.entity_path] += chunk.to_record_batch().to_pylist()
    return rows


def test_the_whole_office_lands_in_the_file(tmp_path):
    viewer = RrdViewer(tmp_path / "m.rrd")
    updates, tiles = office.growth(), office.points(spacing=0.2)
    for k, update in enumerate(updates):
        viewer.write_update(update)
        viewer.write_status(office.status(k))
    viewer.write_points(tiles)
    for stamp_ns, pose in office.drive():
        viewer.write_scan_pose("r1", pose, stamp_ns)
    viewer.close()
    viewer.close()
    rows = _entities(tmp_path / "m.rrd")
    planes = [p for p in rows if p.startswith("/map/planes/") and p.endswith("/outline")]
    assert len(planes) == len(office.planes())
    assert len([p for p in rows if p.startswith("/map/points/below/")]) == len(tiles)
    assert {"/stages/normals", "/area/wall", "/gauges/voxels", "/events"} <= rows.keys()
    assert len(rows["/events"]) == len(updates)
    assert rows["/events"][0]["stamp"].timestamp() == pytest.approx(office.STAMP_NS / 1e9)
    assert len(rows["/robots/r1/marker"]) == 60
    assert "/robots/r1/path/0" in rows


def test_it_is_a_sink(tmp_path):
    viewer = RrdViewer(tmp_path / "m.rrd")
    pose = StampedPose(office.STAMP_NS, "map", office.drive()[0][1])
    for topic, message in (
        ("/facet/update", office.snapshot()),
        (pose_topic("r7"), pose),
        ("/facet/status", office.status(3)),
        ("facet/v1/m/points", office.points(spacing=0.5)[0]),
        ("facet/v1/m/robot/r/scan/s", None),
    ):
        viewer.write(Envelope(topic, "", "protobuf", b""), message)
    viewer.close()
    rows = _entities(tmp_path / "m.rrd")
    assert {"/robots/r7/marker", "/map/planes/floor/1/surface"} <= rows.keys()


def test_a_retired_plane_is_cleared(tmp_path):
    viewer = RrdViewer(tmp_path / "m.rrd")
    viewer.write_update(office.snapshot(1))
    event = Event(1, EventKind.MERGED, 3, 4, 2, office.STAMP_NS)
    later = office.STAMP_NS + 10**9
    viewer.write_update(MapUpdate("office", 2, 1, later, (), (Tombstone(3, 4),), (event,)))
    viewer.close()
    rows = _entities(tmp_path / "m.rrd")
    assert rows["/map/planes/wall/3"][-1]["Clear:is_recursive"] == [True]
    assert rows["/events"][-1]["TextLog:text"] == ["15:06:40 wall 3 merged into wall 4"]


def test_an_event_leads_to_its_plane(tmp_path):
    """By the name on the screen, and by the colour."""
    viewer = RrdViewer(tmp_path / "m.rrd")
    created = Event(1, EventKind.CREATED, 3, 0, 1, office.STAMP_NS)
    updated = Event(2, EventKind.UPDATED, 2, 0, 1, office.STAMP_NS)
    split = Event(3, EventKind.SPLIT, 2, 1, 1, office.STAMP_NS)
    viewer.write_update(replace(office.snapshot(1), events=(created, updated, split)))
    viewer.close()
    rows = _entities(tmp_path / "m.rrd")
    said = [(row["TextLog:text"][0], row["TextLog:color"][0]) for row in rows["/events"]]
    colours = {}
    for path in ("wall/3", "floor/1", "overhead/ceiling/2"):
        name = rows[f"/map/planes/{path}/name"][-1]
        colours[name["Points3D:labels"][0]] = name["Points3D:colors"][0]
        (corner,) = name["Points3D:positions"]
        number = int(path.rpartition("/")[2])
        plane = next(plane for plane in office.planes() if plane.id == number)
        assert np.dot(plane.normal, corner) == pytest.approx(plane.d, abs=1e-6)
    assert said[:2] == [
        (f"15:06:40 wall 3 created, {area_of(3):.1f} m²", colours["wall 3"]),
        (f"15:06:40 ceiling 2 split from floor 1, {area_of(2):.1f} m²", colours["ceiling 2"]),
    ]
    assert said[2][0] == "15:06:40 1 planes updated, revision 1"
    assert said[2][1] not in colours.values()


def area_of(number):
    return sum(s.area_m2 for p in office.planes() if p.id == number for s in p.surfaces)


@pytest.mark.parametrize(("side_m", "is_shown"), [(3.0, True), (1.0, False)])
def test_small_planes_do_not_cover_the_map_with_their_names(side_m, is_shown):
    square = office.surface(1, office.rectangle((0.0, 0.0, side_m, side_m)), [])
    plane = replace(office.planes()[0], surfaces=(square,))
    assert drawing.label(plane).show_labels.as_arrow_array().to_pylist() == [is_shown]
    assert drawing.label(replace(plane, surfaces=())) is None


def test_a_snapshot_clears_what_it_does_not_name(tmp_path):
    viewer = RrdViewer(tmp_path / "m.rrd")
    viewer.write_update(office.snapshot(9))
    first = replace(office.snapshot(2), changed=office.planes()[:1])
    viewer.write_update(first)
    viewer.close()
    rows = _entities(tmp_path / "m.rrd")
    cleared = [path for path, found in rows.items() if "Clear:is_recursive" in found[-1]]
    assert len(cleared) == len(office.planes()) - 1


def test_a_plane_that_changes_class_moves(tmp_path):
    viewer = RrdViewer(tmp_path / "m.rrd")
    viewer.write_update(office.snapshot(1))
    ramp = replace(office.planes()[-1], plane_class=PlaneClass.FLOOR)
    later = office.STAMP_NS + 10**9
    viewer.write_update(MapUpdate("office", 2, 1, later, (ramp,), (), ()))
    viewer.close()
    rows = _entities(tmp_path / "m.rrd")
    assert "Clear:is_recursive" in rows[f"/map/planes/other/{ramp.id}"][-1]
    assert f"/map/planes/floor/{ramp.id}/surface" in rows


@pytest.mark.parametrize(("shift_m", "num_drawn"), [(0.01, 2), (1e-6, 1)])
def test_updates_in_quick_succession_are_drawn_once(tmp_path, shift_m, num_drawn):
    viewer = RrdViewer(tmp_path / "m.rrd")
    for k in range(200):
        stamp_ns = office.STAMP_NS + k * 10**6  # 0.2 s in all
        floor = replace(office.planes()[0], d=k * shift_m)
        viewer.write_update(MapUpdate("office", k + 1, k, stamp_ns, (floor,), (), ()))
    viewer.close()
    assert len(_entities(tmp_path / "m.rrd")["/map/planes/floor/1/surface"]) == num_drawn


def test_nothing_that_is_not_a_number_is_drawn(tmp_path):
    viewer = RrdViewer(tmp_path / "m.rrd")
    viewer.write_scan_pose("r1", Pose(np.array([np.nan, 0.0, 0.0]), FLAT), office.STAMP_NS)
    broken = replace(office.planes()[0], d=float("nan"))
    viewer.write_update(replace(office.snapshot(1), changed=(broken,)))
    viewer.write_status(replace(office.status(1), gauges={"rate": float("nan")}, stage_ms={}))
    viewer.close()
    rows = _entities(tmp_path / "m.rrd")
    assert not any(path.startswith("/robots") for path in rows)
    assert "/gauges/rate" not in rows
    assert "Mesh3D:vertex_positions" not in rows["/map/planes/floor/1/surface"][-1]


def test_a_callers_array_may_change_afterwards(tmp_path):
    viewer = RrdViewer(tmp_path / "m.rrd")
    position = np.array([1.0, 2.0, 3.0])
    viewer.write_scan_pose("r1", Pose(position, FLAT), office.STAMP_NS)
    tile = office.points(spacing=0.5)[0]
    expected = tile.xyz()
    writable = replace(tile, centroids=tile.centroids.copy())
    viewer.write_points([writable])
    viewer.write_update(office.snapshot(1))
    viewer.write_scan_pose("r1", Pose(position, FLAT), office.STAMP_NS + 10**10)
    position[:] = 9.0
    writable.centroids[:] = 0
    viewer.close()
    rows = _entities(tmp_path / "m.rrd")
    assert rows["/robots/r1/marker"][0]["Transform3D:translation"] == [[1.0, 2.0, 3.0]]
    name = "_".join(str(k) for k in tile.tile)
    drawn = [
        p for kind in ("below", "overhead")
        for p in rows[f"/map/points/{kind}/{name}"][0].get("Points3D:positions") or []
    ]  # fmt: skip
    np.testing.assert_allclose(sorted(map(tuple, drawn)), sorted(map(tuple, expected)))


def test_ceiling_points_are_kept_apart():
    tile = max(office.points(spacing=0.2), key=lambda t: (t.plane_ids == 2).sum())
    (_, below), (xyz, above) = drawing.split_tile(tile, [2])
    assert set(above) == {2}
    assert 2 not in below
    assert len(below) + len(above) == len(tile.plane_ids)
    assert xyz[:, 2] == pytest.approx(office.HEIGHT, abs=0.06)


def test_a_path_grows_only_while_the_robot_moves():
    path = RobotPath()
    assert not path.add(np.zeros(3))
    assert not any(path.add(np.zeros(3)) for _ in range(100))
    for k in range(1, 1000):
        assert path.add(np.array([k * 0.1, 0.0, 0.0]))
        assert len(path.positions) <= PATH_PIECE
    assert path.piece == 999 // (PATH_PIECE - 1)


def test_the_view_follows_the_map_outwards(monkeypatch):
    stream = rr.RecordingStream("test")
    stream.memory_recording()
    sent = []
    monkeypatch.setattr(stream, "send_blueprint", lambda plan: sent.append(plan))
    dashboard = Dashboard(stream)
    for update in office.growth():
        dashboard.write_update(update)
    assert 2 <= len(sent) <= 4


@pytest.mark.parametrize(
    ("low", "high", "expected"),
    [
        ((0.0, 0.0, 0.0), (4.0, 30.0, 3.0), False),
        ((-1.0, 0.0, 0.0), (4.0, 31.0, 3.0), False),  # within the margin
        ((0.0, 0.0, 0.0), (8.0, 30.0, 3.0), True),  # across a long map: hardly larger in all
        ((0.0, -2.0, 0.0), (4.0, 30.0, 3.0), True),
    ],
)
def test_what_grows_out_of_the_view_is_seen_at_once(low, high, expected):
    fitted = np.array([(0.0, 0.0, 0.0), (4.0, 30.0, 3.0)])
    assert _leaves(np.array([low, high]), fitted) is expected
