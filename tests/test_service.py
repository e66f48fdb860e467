"""The service's threads in this process: scans over Zenoh in, a log and a map out."""

from __future__ import annotations

import errno
import os
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
import zenoh

from facet.commands.play import RobotPublisher
from facet.commands.replay import replay_log
from facet.config import Config, load_config
from facet.intake import DurableQueue
from facet.mapping.mapper import Mapper
from facet.mapping.settings import MapSettings
from facet.service import Service
from facet.sinks.durable_file import DurableFile
from facet.sinks.recorder import LogPosition
from facet.sources.naming import is_scan
from facet.sources.recording import Recording
from facet.status import Account
from facet_protocol import topics
from facet_protocol.codec import decode
from rig import WAIT_S, room, service_and_client, wait_until

SETTINGS = MapSettings(voxel_m=0.1)


@contextmanager
def running(
    directory: Path, **settings: Any
) -> Iterator[tuple[Service, RobotPublisher, zenoh.Session]]:
    """A service that maps into `directory`, a robot and a client's session."""
    config = load_config(
        None, {"record.directory": directory, "record.min_free_bytes": 0, **settings}
    )
    with service_and_client() as (session, client):
        service = Service(session, config, Mapper(SETTINGS))
        service.start()
        robot = RobotPublisher(client, "map")
        yield service, robot, client
        robot.close()


def send(robot: RobotPublisher, first: int, last: int) -> None:
    for envelope in room(last)[first - 1 :]:
        robot.publish("r1", "lidar", envelope)


def break_disk(service: Service, monkeypatch: pytest.MonkeyPatch) -> threading.Event:
    """Nothing reaches the disk until the event is set."""
    works = threading.Event()

    def fdatasync(fd: int) -> None:
        if not works.is_set():
            raise OSError(errno.ENOSPC, "No space left on device")
        os.fdatasync(fd)

    monkeypatch.setattr(
        service.recorder, "_open_file", lambda path: DurableFile(path, sync_data=fdatasync)
    )
    return works


def ask(client: zenoh.Session, selector: str) -> str:
    (reply,) = client.get(selector, timeout=WAIT_S)
    if reply.ok is not None:
        return reply.ok.payload.to_string()
    assert reply.err is not None
    return reply.err.payload.to_string()


def test_what_is_mapped_live_is_mapped_again_from_the_log(tmp_path: Path) -> None:
    with running(tmp_path) as (service, robot, _):
        send(robot, 1, 12)
        wait_until(lambda: service.account["applied"] == 12, 60)
        model = service.stop()
    assert model is not None
    assert model["planes"]
    account = service.account
    assert account["received"] == account["recorded"] == account["applied"] == 12
    result = replay_log([tmp_path], Config())
    assert result.mapper.settings == SETTINGS  # the log knows them
    assert result.model()["digest"] == model["digest"]
    assert [p["id"] for p in result.model()["planes"]] == [p["id"] for p in model["planes"]]
    assert not result.recording.is_damaged


def test_a_replay_says_what_the_service_said(tmp_path: Path) -> None:
    """The updates in the log and those of its replay, byte for byte."""
    with running(tmp_path) as (service, robot, _):
        send(robot, 1, 10)
        wait_until(lambda: service.account["applied"] == 10, 60)
        service.stop()

    class Updates:
        def __init__(self) -> None:
            self.payloads: list[bytes] = []

        def write(self, envelope: Any, message: Any) -> None:
            if envelope.key == topics.UPDATE_TOPIC:
                self.payloads.append(bytes(envelope.payload))

        def close(self) -> None:
            pass

    replayed = Updates()
    replay_log([tmp_path], Config(), sinks=[replayed])
    logged = [bytes(e.payload) for e in Recording([tmp_path]) if e.key == topics.UPDATE_TOPIC]
    assert logged == replayed.payloads
    assert logged


def test_losses_and_duplicates_are_counted_and_logged(tmp_path: Path) -> None:
    with running(tmp_path) as (service, robot, client):
        send(robot, 1, 2)
        key = topics.scan_key("map", "r1", "lidar")
        robot._sequences[key] += 5  # five scans that never were sent
        send(robot, 3, 3)
        robot._sequences[key] -= 1  # the last one again
        send(robot, 3, 3)
        client.put(
            key,
            b"nonsense",
            encoding="application/protobuf;foxglove.PointCloud",
            congestion_control=zenoh.CongestionControl.BLOCK,
        )
        wait_until(lambda: service.account["rejected.malformed"] == 1, 60)
        service.stop()
    account = service.account
    assert account["lost_upstream"] == 5
    assert account["duplicate"] == 1
    assert account["received"] == account["recorded"] == 5
    assert account["applied"] == 3
    losses = [decode(e) for e in Recording([tmp_path]) if e.key == topics.LOSS_TOPIC]
    assert [(x.first_sequence, x.count, x.reason) for x in losses] == [  # type: ignore[union-attr]
        (3, 5, "lost_upstream")
    ]


def test_nothing_is_mapped_that_is_not_logged(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The disk fails for a while: health says so, then everything is recorded and mapped."""
    with running(tmp_path, **{"record.retry_s": 0.05}) as (service, robot, _):
        disk = break_disk(service, monkeypatch)
        send(robot, 1, 5)
        wait_until(lambda: service.account["recorder_failed"] >= 2)
        assert service.account.failure
        assert service.account["applied"] == service.account["recorded"] == 0
        disk.set()
        wait_until(lambda: service.account["applied"] == 5, 60)
        assert service.account.failure == ""
        service.stop()
    assert [e.sequence for e in filter(is_scan, Recording([tmp_path]))] == [1, 2, 3, 4, 5]


def test_no_client_sees_a_revision_that_the_log_does_not_know(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The disk fails while an update is derived: it is published when its cut is durable."""
    with running(tmp_path, **{"record.retry_s": 0.05}) as (service, robot, _):
        disk = break_disk(service, monkeypatch)
        disk.set()
        update = service._pipeline.update

        def fail_meanwhile() -> Any:
            disk.clear()
            return update()

        monkeypatch.setattr(service._pipeline, "update", fail_meanwhile)
        send(robot, 1, 1)
        wait_until(lambda: service._pipeline.revision, 60)
        wait_until(lambda: service.account["recorder_failed"] >= 2)
        assert service._snapshots.since(0).revision == 0
        disk.set()
        wait_until(lambda: service._snapshots.since(0).revision == 1)
        service.stop()
    cuts = [decode(e) for e in Recording([tmp_path]) if e.key == topics.CUT_TOPIC]
    assert [cut.revision for cut in cuts] == [1]  # type: ignore[union-attr]


def test_commands_of_a_running_service(tmp_path: Path) -> None:
    with running(tmp_path) as (service, robot, client):
        send(robot, 1, 4)
        wait_until(lambda: service.account["applied"] == 4, 60)
        assert "model.json" in ask(client, topics.cmd_key("map", "export"))
        assert (tmp_path / "model.json").exists()
        assert "'xyz' is not one of" in ask(client, topics.cmd_key("map", "export") + "?format=xyz")
        assert "map.checkpoint" in ask(client, topics.cmd_key("map", "checkpoint"))
        assert (tmp_path / "map.checkpoint").exists()
        ask(client, topics.cmd_key("map", "pause"))
        send(robot, 5, 6)
        wait_until(lambda: service.account["recorded"] == 6)
        assert service.account["applied"] == 4
        ask(client, topics.cmd_key("map", "resume"))
        wait_until(lambda: service.account["applied"] == 6, 60)
        ask(client, topics.cmd_key("map", "record"))
        send(robot, 7, 7)
        wait_until(lambda: service.account["applied"] == 7, 60)
        service.stop()
    assert len(service.recorder.paths) == 2
    assert not Recording([tmp_path]).is_damaged


def test_a_full_queue_sheds_the_oldest_and_says_so(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """While the disk fails nothing is taken from the door; what overflows there is counted."""
    settings = {"queue.max_messages": 3, "record.retry_s": 0.05}
    with running(tmp_path, **settings) as (service, robot, _):
        disk = break_disk(service, monkeypatch)
        send(robot, 1, 1)
        wait_until(lambda: service.account["recorder_failed"])
        send(robot, 2, 10)
        wait_until(lambda: service._inbox.num_received == 10)
        disk.set()
        wait_until(lambda: service.account["applied"] == 4, 60)
        service.stop()
    account = service.account
    assert account["shed_overload"] == 6
    assert account["received"] == 10
    assert account["recorded"] == 4
    assert account["lost_upstream"] == 0


def test_what_was_left_out_at_the_end_is_read_at_the_next_start() -> None:
    durable, account = DurableQueue(1 << 20), Account()
    durable.put(room(2), LogPosition("a.mcap", 100, ()))
    stopped = SimpleNamespace(_stop_at=0.0, _position=None, _durable=durable, account=account)
    Service._insert(stopped, durable.take(0.0))  # type: ignore[arg-type]
    Service._insert(stopped, durable.take(0.0))  # type: ignore[arg-type]
    assert stopped._position is None
    assert account["not_applied"] == 2


def test_a_fault_of_the_mapper_ends_the_service_and_not_the_log(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with running(tmp_path) as (service, robot, _):

        def fail(*args: Any) -> Any:
            raise AssertionError("an invariant")

        monkeypatch.setattr(service._mapper, "update", fail)
        send(robot, 1, 3)
        assert service.ended.wait(60)
        assert service.stop() is None
    assert isinstance(service.fault, AssertionError)
    assert len(list(filter(is_scan, Recording([tmp_path])))) == 3
