"""Robots as they are: every dialect live, and recordings of ROS 2, give the native log's map."""

from __future__ import annotations

import json
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import zenoh
from typer.testing import CliRunner

import robot_dialects as robots
import ros_messages as ros
from facet.__main__ import app
from facet.commands.play import RobotPublisher, play_scans
from facet.commands.replay import replay_log
from facet.config import Config, ConfigError, RobotsSection, load_config
from facet.mapping.mapper import Mapper
from facet.mapping.settings import MapSettings
from facet.robots import dialects_of
from facet.service import Service
from facet.sinks.log_file import write_recording
from facet.sources.naming import is_input
from facet.sources.recording import Recording
from facet_protocol import topics
from facet_protocol.codec import decode
from facet_protocol.messages import LineFan, Pose, ResolvedPose
from rig import room, room_scan, scan_envelope, service_and_client, wait_until

SETTINGS = MapSettings(voxel_m=0.1)
NUM = 6


def map_of(*logs: Path, **settings: Any) -> tuple[Any, Any]:
    """(digest, the replay) of logs that do not know their voxel size."""
    config = load_config(None, {"mapping.voxel_m": 0.1, **settings})
    result = replay_log(list(logs), config)
    return result.model()["digest"], result


@pytest.fixture(scope="module")
def expected(tmp_path_factory: pytest.TempPathFactory) -> Any:
    """The digest of the room as a native robot records it."""
    path = tmp_path_factory.mktemp("native") / "room.mcap"
    write_recording(path, room(NUM), {})
    return map_of(path)[0]


@contextmanager
def running(directory: Path, **settings: Any) -> Iterator[tuple[Service, zenoh.Session]]:
    config = load_config(
        None, {"record.directory": directory, "record.min_free_bytes": 0, **settings}
    )
    with service_and_client() as (session, client):
        service = Service(session, config, Mapper(SETTINGS))
        yield service, client


def put(client: zenoh.Session, samples: list[robots.Put]) -> None:
    for sample in samples:
        client.put(
            sample.key,
            sample.payload,
            encoding=sample.encoding,
            attachment=sample.attachment,
            congestion_control=zenoh.CongestionControl.BLOCK,
        )


@pytest.mark.parametrize("name", robots.DIALECTS)
def test_every_dialect_gives_the_same_map_live_and_replayed(
    name: str, tmp_path: Path, expected: Any
) -> None:
    """Static transforms were sent before the service came, as a driver does that starts first."""
    with running(tmp_path, **{"robots.rules": robots.RULES}) as (service, client):
        static = robots.publish_static(client, robots.STATIC[name])
        kept = [client.liveliness().declare_token(token) for token in robots.tokens()]
        service.start()
        wait_until(lambda: service.account["used_as_pose"] == 1)
        client.put("camera/image", b"x" * 1000, encoding="image/png")
        for scan in robots.scans(NUM):
            put(client, robots.DIALECTS[name](scan))
        wait_until(lambda: service.account["applied"] == NUM, 60)
        for token in kept:
            token.undeclare()
        static.undeclare()
        model = service.stop()
    assert model is not None
    assert model["digest"] == expected
    balance = service.account.balance()
    assert balance.is_exact
    assert (balance.received, balance.applied, balance.in_flight) == (2 * NUM + 1, NUM, 0)
    assert service.account["used_as_pose"] == NUM + 1
    assert service._inbox.num_ignored == 1
    result = replay_log([tmp_path], Config())
    assert result.model()["digest"] == expected
    assert result.exit_code == 0
    assert [p["id"] for p in result.model()["planes"]] == [p["id"] for p in model["planes"]]


def test_numbers_of_rmw_zenoh_are_read(tmp_path: Path) -> None:
    """A gap shows; the log keeps the bytes as they came, under the name that ROS gives them."""
    with running(tmp_path) as (service, client):
        service.start()
        static = robots.publish_static(client, robots.STATIC["rmw_zenoh"])
        for number in (1, 2, 5):
            put(client, robots.rmw_zenoh(room_scan(number)))
        wait_until(lambda: service.account["applied"] == 3, 60)
        static.undeclare()
        service.stop()
    assert service.account["lost_upstream"] == 2
    log = [e for e in Recording([tmp_path]) if e.schema == robots.CLOUD]
    assert [(e.key, e.encoding, e.epoch, e.sequence) for e in log] == [
        ("/points", "cdr", robots.GID_EPOCH, number) for number in (1, 2, 5)
    ]
    assert bytes(log[0].payload) == robots.rmw_zenoh(room_scan(1))[0].payload


def test_what_was_found_is_in_the_log_and_counts_when_the_poses_do_not(tmp_path: Path) -> None:
    """With the transforms cut out of it, a log still gives its map: every pose is written down."""
    with running(tmp_path / "log") as (service, client):
        service.start()
        static = robots.publish_static(client, robots.STATIC["tagged"])
        for scan in robots.scans(NUM):
            put(client, robots.tagged(scan))
        wait_until(lambda: service.account["applied"] == NUM, 60)
        static.undeclare()
        model = service.stop()
    assert model is not None
    recording = Recording([tmp_path / "log"])
    envelopes = list(recording)
    poses = [decode(e) for e in envelopes if e.key == topics.RESOLVED_TOPIC]
    assert [p.sensor for p in poses if isinstance(p, ResolvedPose)] == ["points"] * NUM
    without = [e for e in envelopes if e.schema != robots.TF]
    write_recording(tmp_path / "cut.mcap", without, recording.metadata["facet"])
    digest, result = map_of(tmp_path / "cut.mcap")
    assert digest == model["digest"]
    assert result.exit_code == 0


def bag_of(folder: Path, scans: list[Any], tf_after: bool = True) -> Path:
    def messages() -> Iterator[tuple[str, int, Any]]:
        yield "/tf_static", scans[0].stamp_ns, robots.static_chain()
        for scan in scans:
            said = [("/points", robots.cloud(scan)), ("/tf", robots.moving(scan))]
            for topic, message in said if tf_after else said[::-1]:
                yield topic, scan.stamp_ns, message
        yield "/goal_pose", scans[-1].stamp_ns, ros.stamped_pose(5, "map", robots.STILL)

    return ros.write_bag(folder, messages())


@pytest.mark.parametrize("tf_after", [True, False])
def test_a_rosbag2_replays_as_it_is(tmp_path: Path, expected: Any, tf_after: bool) -> None:
    bag = bag_of(tmp_path / "bag", list(robots.scans(NUM)), tf_after)
    digest, result = map_of(bag)
    assert digest == expected
    assert result.exit_code == 0
    assert result.account["received"] == 2 * NUM + 1  # a goal is no one's pose
    assert map_of(bag, **{"mapping.voxel_m": 0.1})[0] == expected


def test_a_simulated_drive_as_a_rosbag2(tmp_path: Path) -> None:
    """The scans of a simulated lidar through PointCloud2 and tf: the digest of the native log."""
    from facet.simulate import Simulation

    simulation = Simulation("corridor", "lidar3d", num_scans=12)
    scans = [replace(scan, no_return=scan.no_return[:0]) for scan in simulation.messages()]
    write_recording(tmp_path / "native.mcap", map(scan_envelope, scans), {})
    native = replay_log([tmp_path / "native.mcap"], Config())
    ours = replay_log([bag_of(tmp_path / "bag", scans)], Config())
    assert ours.model()["digest"] == native.model()["digest"]
    assert ours.account["points_stored"] == native.account["points_stored"] > 10_000


def test_line_scans_as_a_rosbag2(tmp_path: Path) -> None:
    """Ranges that float32 holds give the same points, whoever carries them."""
    rng = np.random.default_rng(0)
    fans = [
        LineFan(
            **{"robot": "r1", "sensor": "laser", "epoch": 5, "sequence": k, "frame_id": "map"},
            stamp_ns=room_scan(k).stamp_ns,
            pose=room_scan(k).pose,
            start_angle=-1.5,
            end_angle=-1.5 + 192 * 0.015625,
            ranges=rng.uniform(0.5, 5.0, 193).astype(np.float32).astype(np.float64),
        )
        for k in range(1, 5)
    ]
    native = [scan_envelope(fan) for fan in fans]  # type: ignore[arg-type]
    write_recording(tmp_path / "native.mcap", native, {})

    def messages() -> Iterator[tuple[str, int, Any]]:
        for fan in fans:
            step = {"angle_min": -1.5, "angle_increment": 0.015625}
            yield "/scan", fan.stamp_ns, ros.fan(fan.stamp_ns, "laser", fan.ranges, **step)
            odometry = ros.odometry(fan.stamp_ns, "map", "laser", fan.pose)
            yield "/odom", fan.stamp_ns, odometry

    digest, result = map_of(ros.write_bag(tmp_path / "bag", messages()))
    assert digest == map_of(tmp_path / "native.mcap")[0]
    assert result.account["applied"] == 4


def drive() -> Iterator[tuple[str, int, Any]]:
    """A sensor mounted askew on a robot that turns; poses at their own stamps, two links of a chain
    at different rates, scans between them."""
    mount = Pose(np.array([0.2, -0.1, 0.4]), np.array([0.1, -0.7, 0.1, 0.7]))
    start = room_scan(1).stamp_ns
    yield "/tf_static", start, ros.transforms(ros.transform(0, "base", "lidar", mount))
    for k in range(40):
        stamp, angle = start + k * 17_000_000, 0.05 * k
        turn = np.array([0.0, 0.0, np.sin(angle / 2), np.cos(angle / 2)])
        pose = Pose(np.array([0.03 * k, -0.02 * k, 1.0]), turn)
        yield "/odom", stamp, ros.odometry(stamp, "odom", "base", pose)
        if k % 3 == 0:
            drift = Pose(np.array([0.001 * k, 0.0, 0.0]), robots.STILL.orientation_xyzw)
            yield "/tf", stamp, ros.transforms(ros.transform(stamp, "map", "odom", drift))
        if k % 5 == 2:
            scan_ns = stamp + 3_123_457
            points = room_scan(k).points
            yield "/points", scan_ns, ros.cloud(scan_ns, "lidar", points)


def test_a_drive_with_poses_of_its_own_live_and_as_a_rosbag2(tmp_path: Path) -> None:
    """Live, the replay of its log, and the recording of ROS 2 all resolve to the same bits."""
    messages = list(drive())
    digest, result = map_of(ros.write_bag(tmp_path / "bag", messages))
    assert result.account["applied"] == 8
    with running(tmp_path / "log") as (service, client):
        service.start()
        for topic, _, message in messages:
            kind = f"application/cdr;{message.__msgtype__}"
            put(client, [robots.Put(f"rt{topic}", ros.cdr(message), kind)])
        wait_until(lambda: service.account["applied"] == 8, 60)
        model = service.stop()
    assert model is not None
    assert model["digest"] == digest
    assert map_of(tmp_path / "log")[0] == digest
    poses = [decode(e) for e in Recording([tmp_path / "log"]) if e.key == topics.RESOLVED_TOPIC]
    first = poses[0]
    assert isinstance(first, ResolvedPose)
    assert abs(np.linalg.norm(first.pose.orientation_xyzw) - 1.0) < 1e-15


def test_scans_without_a_pose_are_refused_and_counted(tmp_path: Path) -> None:
    scans = list(robots.scans(12))

    def messages() -> Iterator[tuple[str, int, Any]]:
        yield "/tf_static", scans[0].stamp_ns, robots.static_chain()
        for scan in scans:
            yield "/points", scan.stamp_ns, robots.cloud(scan)
            if scan.sequence in (3, 4):
                yield "/tf", scan.stamp_ns, robots.moving(scan)

    _, result = map_of(ros.write_bag(tmp_path / "bag", messages()))
    assert result.left_out == {"no_pose": 10}
    assert result.account["applied"] == 2
    assert result.exit_code == 3
    balance = result.account.balance()
    assert balance.is_exact
    assert balance.in_flight == 0


def test_two_robots_with_the_same_frames_are_kept_apart(tmp_path: Path, expected: Any) -> None:
    scans = list(robots.scans(NUM))
    away = replace(robots.STILL, position=np.array([100.0, 0.0, 0.0]))

    def messages() -> Iterator[tuple[str, int, Any]]:
        for name in ("r1", "r2"):
            yield f"/{name}/tf_static", scans[0].stamp_ns, robots.static_chain()
        for scan in scans:
            yield "/r1/points", scan.stamp_ns, robots.cloud(scan)
            other = ros.transform(scan.stamp_ns, "odom", "base", away)
            yield "/r2/tf", scan.stamp_ns, ros.transforms(other)
            yield "/r1/tf", scan.stamp_ns, robots.moving(scan)

    bag = ros.write_bag(tmp_path / "bag", messages())
    rules = [{"key": "r1/**", "robot": "one"}, {"key": "/r2/**", "robot": "two"}]
    digest, result = map_of(bag, **{"robots.rules": rules})
    assert digest == expected
    assert result.account["applied[one/r1_points]"] == NUM


def test_a_key_expression_that_is_none_is_named() -> None:
    with pytest.raises(ConfigError, match=r"'a\*' is no key expression"):
        dialects_of(RobotsSection(keys=("a*",)))
    with pytest.raises(ConfigError, match=r"unknown key robots.rules.0.typ; did you mean .*type\?"):
        load_config(None, {"robots.rules": [{"key": "a", "typ": "x"}]})
    assert json.loads(Config().model_dump_json())["robots"]["keys"] == ["**"]


def test_a_rosbag2_is_played_and_mapped_live(tmp_path: Path, expected: Any) -> None:
    bag = bag_of(tmp_path / "bag", list(robots.scans(NUM)))
    with running(tmp_path / "log") as (service, client):
        service.start()
        publisher = RobotPublisher(client, "map")
        inputs = filter(is_input, Recording([bag]))
        assert list(play_scans(inputs, publisher, "r9", 0.0))[-1] == NUM
        wait_until(lambda: service.account["applied"] == NUM, 60)
        publisher.close()
        model = service.stop()
    assert model is not None
    assert model["digest"] == expected
    assert service.account["applied[r9/points]"] == NUM
    assert map_of(tmp_path / "log")[0] == expected


def test_info_names_the_dialect_of_every_channel(tmp_path: Path) -> None:
    bag = bag_of(tmp_path / "bag", list(robots.scans(2)))
    result = CliRunner().invoke(app, ["info", str(bag)])
    assert result.exit_code == 0
    lines = {line.split()[1]: line for line in result.output.splitlines() if "/msg/" in line}
    assert "ROS 2" in lines["/points"]
    assert "ROS 2" in lines["/tf_static"]
    assert "not read" in lines["/goal_pose"]
    assert "robot/points" in result.output
