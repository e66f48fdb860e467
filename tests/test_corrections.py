"""Corrected poses: exact, whole or not at all, live as in the replay of the log."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from concurrent.futures import Future
from dataclasses import replace
from functools import cache, partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import zenoh
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from typer.testing import CliRunner

import robot_dialects as robots
import ros_messages as ros
from facet.__main__ import app
from facet.commands.replay import replay_log
from facet.config import Config, load_config
from facet.mapping.digest import state_digest
from facet.mapping.mapper import Mapper
from facet.past import definitions_of
from facet.resume import resume
from facet.service import Service
from facet.sinks.log_file import write_recording
from facet.sources.recording import Recording
from facet_protocol import attachment, topics
from facet_protocol.codec import decode, encode
from facet_protocol.messages import Corrected, CorrectedPose, Correction, Envelope, Pose, Scan
from rig import room_scan, scan_envelope, service_and_client, wait_for_ear, wait_until
from test_resume import SETTINGS, Line, config, told

KEY = topics.correction_key("map", "r1")
Moves = dict[int, Pose]  # by sequence


def pose(dx: float, dy: float = 0.0, angle: float = 0.0) -> Pose:
    """About the middle of the room: shifted by metres, turned by rad."""
    turn = np.array([0.0, 0.0, np.sin(angle / 2), np.cos(angle / 2)])
    return Pose(np.array([dx, dy, 1.2]), turn)


@cache
def small(sequence: int, robot: str = "r1") -> Scan:
    scan = room_scan(sequence, robot)
    return replace(scan, points=scan.points[::3])


def shifted(sequence: int, robot: str = "r1") -> Scan:
    """As a robot sends it that is off by a little more with every scan."""
    return replace(small(sequence, robot), pose=pose(0.07 * sequence, -0.04, 0.02 * sequence))


def correction(moves: Moves, number: int = 1, robot: str = "r1", **changes: Any) -> Envelope:
    """Number `number` of a robot's corrections, by `robot`."""
    poses = tuple(CorrectedPose("lidar", 5, sequence, p) for sequence, p in moves.items())
    schema, payload = encode(Correction(robot, poses))
    envelope = Envelope(
        key=topics.correction_key("map", robot),
        schema=schema,
        encoding="protobuf",
        payload=payload,
        stamp_ns=room_scan(1).stamp_ns + 10**10 + number,
        epoch=9,
        sequence=number,
        received_ns=room_scan(1).stamp_ns + 10**10 + number,
    )
    return replace(envelope, **changes)


class CorrectedLine(Line):
    """A line whose log is read for corrections."""

    def record(self, envelopes: Iterable[Envelope]) -> list[Envelope]:
        before = self.recorder.position
        taken = super().record(envelopes)
        after, past = self.recorder.position, self.admission.past
        path = self.folder / after.file
        past.note(path, before.offset if before.file == after.file else 0, after.offset, taken)
        past.define(path, partial(definitions_of, after.channels))
        return taken


def map_of(scans: Iterable[Scan]) -> Mapper:
    mapper = Mapper(SETTINGS)
    for scan in scans:
        mapper.insert(scan)
    mapper.update()
    return mapper


def digest_of(scans: Iterable[Scan]) -> Any:
    return map_of(scans).digest()


@settings(max_examples=5, deadline=None, suppress_health_check=list(HealthCheck))
@given(data=st.data())
def test_corrected_is_as_if_the_poses_had_been_right(
    data: st.DataObject, tmp_path_factory: pytest.TempPathFactory
) -> None:
    """Any batches at any time, also of scans that were corrected before; then the replay too."""
    line = CorrectedLine(tmp_path_factory.mktemp("log"))
    where: Moves = {}
    number = 0
    for sequence in range(1, data.draw(st.integers(2, 5)) + 1):
        line.scans(scan_envelope(shifted(sequence)))
        where[sequence] = shifted(sequence).pose
        batch = st.sets(st.sampled_from(sorted(where)), min_size=1)
        for chosen in data.draw(st.lists(batch, max_size=2)):
            number += 1
            offset = st.floats(-1.0, 1.0)
            moves = {k: pose(*data.draw(st.tuples(offset, offset, offset))) for k in chosen}
            line.scans(correction(moves, number))
            where.update(moves)
    expected = digest_of(replace(small(k), pose=p) for k, p in where.items())
    assert line.mapper.digest() == expected
    line.recorder.close()
    replayed = replay_log([line.folder], Config())
    assert told(replayed.mapper) == told(line.mapper)
    assert replayed.exit_code == 0
    assert replayed.account["used_as_correction"] == number


def test_all_of_a_batch_moves_in_one_update(tmp_path: Path) -> None:
    """While its points are read the map goes on; no update sees a part of it."""
    line = CorrectedLine(tmp_path)
    for k in (1, 2, 3):
        line.scans(scan_envelope(shifted(k)))
    read, asked = line.admission.corrections.ask, []

    def later(wanted: Sequence[Any]) -> Future[Any]:
        asked.append((wanted, Future()))
        return asked[-1][1]

    line.admission.corrections.ask = later
    line.scans(correction({1: pose(0.0), 2: pose(0.0)}))
    line.scans(correction({2: pose(0.1)}, 2))
    line.scans(scan_envelope(shifted(4)))
    assert line.mapper.digest() == digest_of(shifted(k) for k in (1, 2, 3, 4))
    assert not line.pipeline.is_settled
    assert len(asked) == 1  # the second waits for the first
    asked[0][1].set_result(read(asked[0][0]).result())
    assert line.pipeline.go_on()
    line.pipeline.update()
    moved = [replace(small(k), pose=pose(0.0)) for k in (1, 2)]
    assert line.mapper.digest() == digest_of([*moved, shifted(3), shifted(4)])
    asked[1][1].set_result(read(asked[1][0]).result())
    line.pipeline.go_on()
    line.pipeline.update()
    assert line.pipeline.is_settled
    line.recorder.close()
    records = [decode(e) for e in Recording([tmp_path]) if e.key == topics.CORRECTED_TOPIC]
    assert [(r.sequence, r.num_scans, r.reason) for r in records if isinstance(r, Corrected)] == [
        (1, 2, ""),
        (2, 1, ""),
    ]
    assert told(replay_log([tmp_path], Config()).mapper) == told(line.mapper)


def bad_corrections() -> dict[str, tuple[str, Envelope]]:
    """(the reason it is refused for, a batch whose first scan is good)."""
    good = {1: pose(0.0)}
    nan = replace(pose(0.0), position=np.array([0.0, np.nan, 0.0]))
    twice = Correction("r1", (CorrectedPose("lidar", 5, 1, pose(0.0)),) * 2)
    elsewhere = Correction("r1", (CorrectedPose("other", 5, 1, pose(0.0)),))
    of_another = Correction("r1", (CorrectedPose("lidar", 5, 7, pose(0.0)),))
    later = Correction("r1", (CorrectedPose("lidar", 6, 1, pose(0.0)),))
    no_name = Correction("r1", (CorrectedPose("a b", 5, 1, pose(0.0)),))
    stretched = replace(pose(0.0), orientation_xyzw=np.array([0.0, 0.0, 0.0, 1.1]))
    return {
        "unknown scan": ("unknown_scan", correction({**good, 99: pose(0.0)})),
        "no number": ("unknown_scan", correction({**good, 0: pose(0.0)})),
        "unknown epoch": ("unknown_scan", correction({}, payload=encode(later)[1])),
        "unknown sensor": ("unknown_scan", correction({}, payload=encode(elsewhere)[1])),
        "scan of another robot": ("unknown_scan", correction({}, payload=encode(of_another)[1])),
        "in the name of another": ("bad_name", correction(good, robot="r2", key=KEY)),
        "no name": ("bad_id", correction({}, payload=encode(no_name)[1])),
        "not a number": ("bad_pose", correction({**good, 2: nan})),
        "out of the world": ("bad_pose", correction({**good, 2: pose(1e6)})),
        "no rotation": ("bad_quaternion", correction({**good, 2: stretched})),
        "empty": ("empty", correction({}, payload=encode(Correction("r1", ()))[1])),
        "twice": ("repeated_scan", correction({}, payload=encode(twice)[1])),
        "cut off": ("malformed", correction(good, payload=correction(good).payload[:20])),
        "something else": ("unknown_schema", correction(good, schema="facet.v9.Correction")),
        "a scan": ("unknown_schema", replace(scan_envelope(shifted(1)), key=KEY, sequence=3)),
    }


@pytest.fixture(scope="module")
def ready(tmp_path_factory: pytest.TempPathFactory) -> CorrectedLine:
    line = CorrectedLine(tmp_path_factory.mktemp("ready"))
    line.scans(*(scan_envelope(shifted(k)) for k in (1, 2, 3)), scan_envelope(shifted(7, "r2")))
    return line


def state(mapper: Mapper) -> Any:
    return state_digest(mapper._store, mapper._free)


@pytest.mark.parametrize("name", bad_corrections())
def test_what_is_wrong_with_one_refuses_the_batch(name: str, ready: CorrectedLine) -> None:
    reason, envelope = bad_corrections()[name]
    numbered = replace(envelope, sequence=1000 + list(bad_corrections()).index(name))
    account = ready.pipeline._account
    before, known = state(ready.mapper), account[f"rejected.{reason}"]
    account.arrive("r1/@correction")
    assert not ready.pipeline.insert(ready.record([numbered])[0])
    assert not ready.pipeline.is_stale
    assert state(ready.mapper) == before
    assert account[f"rejected.{reason}"] == known + 1
    assert account["used_as_correction"] == 0
    assert account.balance("r1/@correction").is_exact


def test_a_log_that_is_gone_refuses_and_the_replay_says_the_same(tmp_path: Path) -> None:
    line = CorrectedLine(tmp_path)
    line.scans(scan_envelope(shifted(1)))
    before = state(line.mapper)
    kept = line.admission.past._files[0]
    line.admission.past._files[0] = tmp_path / "moved-away.mcap"
    line.scans(correction({1: pose(0.0)}))
    line.admission.past._files[0] = kept
    assert state(line.mapper) == before
    assert line.pipeline._account["rejected.unreadable_log"] == 1
    line.recorder.close()
    replayed = replay_log([tmp_path], Config())
    assert replayed.left_out == {"unreadable_log": 1}
    assert told(replayed.mapper) == told(line.mapper)


def test_too_much_at_once_is_refused(tmp_path: Path) -> None:
    line = CorrectedLine(tmp_path)
    line.scans(*(scan_envelope(shifted(k)) for k in (1, 2, 3)))
    line.admission.past._max_bytes = 2 * len(scan_envelope(shifted(1)).payload)
    line.scans(correction({k: pose(0.0) for k in (1, 2, 3)}))
    assert line.pipeline._account["rejected.too_large"] == 1
    line.scans(correction({k: pose(0.0) for k in (1, 2)}, 2))
    assert line.pipeline._account["used_as_correction"] == 1


def test_an_old_correction_that_comes_again_does_nothing(tmp_path: Path) -> None:
    line = CorrectedLine(tmp_path)
    line.scans(scan_envelope(shifted(1)))
    first = correction({1: pose(0.5)})
    line.scans(first, correction({1: pose(0.0)}, 2), first)
    assert line.mapper.digest() == digest_of([replace(small(1), pose=pose(0.0))])
    assert line.pipeline._account["duplicate"] == 1


def test_the_account_of_points_holds(tmp_path: Path) -> None:
    """A pose in a far corner of the world takes points out of the map: they are counted there."""
    line = CorrectedLine(tmp_path)
    account = line.pipeline._account
    scan = shifted(1)
    far = np.array([[200.0, 0.0, 0.0]], np.float32)
    scan = replace(scan, points=np.concatenate([scan.points, far]))
    line.scans(scan_envelope(scan))
    line.scans(correction({1: Pose(np.array([49_999.0, 0.0, 0.0]), pose(0.0).orientation_xyzw)}))
    balance = account.balance("r1/lidar")
    assert balance.points_in == balance.points_stored + balance.points_rejected
    assert balance.points_stored == line.mapper.counts().points_stored


def test_after_a_checkpoint_a_later_correction_starts_from_the_last_pose(tmp_path: Path) -> None:
    """Poses that were given, and where scans lie in the log, are part of it."""
    line = CorrectedLine(tmp_path, max_file_bytes=30_000)
    for k in (1, 2, 3):
        line.scans(scan_envelope(shifted(k)))
    line.scans(correction({1: pose(0.3), 2: pose(0.3)}))
    line.checkpoint()
    line.scans(scan_envelope(shifted(4)))
    line.recorder.commit()  # and then the process is killed
    resumed = resume(config(tmp_path), Mapper(SETTINGS))
    assert resumed.checkpoint is not None
    again = CorrectedLine(tmp_path, resumed)
    again.scans(correction({1: pose(0.0), 3: pose(0.0), 4: pose(0.0)}, 2))
    moved = [replace(small(k), pose=pose(0.0)) for k in (1, 3, 4)]
    assert again.mapper.digest() == digest_of([*moved, replace(small(2), pose=pose(0.3))])
    again.recorder.close()
    assert told(replay_log([tmp_path], Config()).mapper) == told(again.mapper)


def test_killed_before_it_was_settled_it_is_by_the_next_run(tmp_path: Path) -> None:
    line = CorrectedLine(tmp_path)
    line.scans(scan_envelope(shifted(1)))
    line.record([correction({1: pose(0.0)})])  # durable, and then the process is killed
    right = digest_of([replace(small(1), pose=pose(0.0))])
    assert replay_log([tmp_path], Config()).mapper.digest() == right
    resumed = resume(config(tmp_path), Mapper(SETTINGS))
    again = CorrectedLine(tmp_path, resumed)
    again.pipeline.update()
    assert again.mapper.digest() == right
    again.recorder.close()
    assert told(replay_log([tmp_path], Config()).mapper) == told(again.mapper)


def test_scans_that_came_apart_from_their_pose_are_corrected_too(tmp_path: Path) -> None:
    """Of a recording of ROS 2 without a word about poses: numbers of its own, several epochs of
    none. What was found is what it is taken out with."""
    scans = list(robots.scans(3))

    def messages() -> Any:
        yield "/tf_static", scans[0].stamp_ns, robots.static_chain()
        for scan in scans:
            yield "/points", scan.stamp_ns, robots.cloud(scan)
            yield "/tf", scan.stamp_ns, robots.moving(scan)

    bag = list(Recording([ros.write_bag(tmp_path / "bag", messages())]))
    numbers = [e.sequence for e in bag if e.key == "/points"]
    poses = tuple(CorrectedPose("points", 0, n, pose(0.0)) for n in numbers if n)
    if not poses:
        bag = [replace(e, sequence=k) for k, e in enumerate(bag, 1)]
        numbers = [e.sequence for e in bag if e.key == "/points"]
        poses = tuple(CorrectedPose("points", 0, n, pose(0.0)) for n in numbers)
    schema, payload = encode(Correction("robot", poses))
    moved = correction({}, robot="robot", payload=payload, schema=schema)
    write_recording(tmp_path / "moved.mcap", [*bag, moved], {})
    overrides = load_config(None, {"mapping.voxel_m": 0.1})
    replayed = replay_log([tmp_path / "moved.mcap"], overrides)
    assert replayed.account["scans_corrected"] == 3
    cloud = [replace(scan, pose=pose(0.0), no_return=scan.no_return[:0]) for scan in scans]
    assert replayed.mapper.digest() == digest_of(cloud)


def test_live_over_zenoh_and_again_from_its_log(tmp_path: Path) -> None:
    overrides = {"record.directory": tmp_path, "record.min_free_bytes": 0}
    with service_and_client() as (session, client):
        service = Service(session, load_config(None, overrides), Mapper(SETTINGS))
        service.start()

        def put(envelope: Envelope) -> None:
            client.put(
                envelope.key,
                bytes(envelope.payload),
                encoding=f"application/protobuf;{envelope.schema}",
                attachment=attachment.pack(envelope.epoch, envelope.sequence, envelope.stamp_ns),
                congestion_control=zenoh.CongestionControl.BLOCK,
            )

        for envelope in (scan_envelope(shifted(1)), correction({1: pose(0.0)})):
            wait_for_ear(client, envelope.key)
        for k in range(1, 7):
            put(scan_envelope(shifted(k)))
        wait_until(lambda: service.account["applied"] == 6, 60)
        put(correction({k: pose(0.0) for k in (1, 2, 3)}))
        wait_until(lambda: service.account["used_as_correction"] == 1)
        put(correction({1: pose(0.0), 60: pose(0.0)}, 2))
        wait_until(lambda: service.account["rejected.unknown_scan"] == 1)
        put(correction({k: pose(0.1) for k in (3, 4, 5, 6)}, 3))
        put(scan_envelope(shifted(7)))
        wait_until(lambda: service.account["applied"] == 7)
        wait_until(lambda: service.account["used_as_correction"] == 2)
        model = service.stop()
    assert model is not None
    where = {1: 0.0, 2: 0.0, 3: 0.1, 4: 0.1, 5: 0.1, 6: 0.1}
    scans = [replace(small(k), pose=pose(x)) for k, x in where.items()]
    expected = digest_of([*scans, shifted(7)])
    assert model["digest"] == {"state": expected.state, "derived": expected.derived}
    balance = service.account.balance()
    assert balance.is_exact
    assert (balance.received, balance.applied, balance.in_flight) == (10, 7, 0)
    replayed = replay_log([tmp_path], Config())
    assert told(replayed.mapper) == told(service._mapper)
    assert replayed.model()["planes"] == model["planes"]
    assert replayed.left_out == {"unknown_scan": 1}
    events = [bytes(e.payload) for e in Recording([tmp_path]) if e.key == topics.EVENTS_TOPIC]
    assert events
    result = CliRunner().invoke(app, ["info", str(tmp_path)])
    assert "3 corrections (3 of r1): 2 applied, 1 unknown_scan; 7 scans moved" in result.output
