"""Faults of a running service (F18-F23, F26, F29, F30, F36; G13, G15): its threads in this
process, robots over real sessions."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import psutil
import pytest
import zenoh

from facet import status
from facet.commands.replay import replay_log
from facet.config import Config, NetworkSection, load_config
from facet.mapping.mapper import Mapper
from facet.pipeline import Pipeline
from facet.service import Service
from facet.session import client_settings, open_session, service_settings
from facet.sinks.durable_file import DurableFile
from facet.sources.recording import Recording
from facet.status import balance_of
from facet_protocol import attachment, topics
from facet_protocol.codec import decode
from facet_protocol.messages import Conflict, Envelope, Loss, Status
from fault_rig import SETTINGS, scans_in, small_scan
from rig import START_NS, WAIT_S, free_endpoint, scan_envelope, wait_for_ear, wait_until
from test_commands import Running
from test_service import break_disk, running, send

PAYLOAD = bytes(scan_envelope(small_scan(1)).payload)
KEY = topics.scan_key("map", "r1", "lidar")
Log = pytest.LogCaptureFixture


def put(client: zenoh.Session, sequence: int, epoch: int = 5, robot: str = "r1") -> None:
    """One scan of a publisher that is not ours."""
    client.put(
        topics.scan_key("map", robot, "lidar"),
        PAYLOAD,
        encoding="application/protobuf;foxglove.PointCloud",
        congestion_control=zenoh.CongestionControl.BLOCK,
        attachment=attachment.pack(epoch, sequence, START_NS + sequence),
    )


def put_scan(client: zenoh.Session, sequence: int, epoch: int, robot: str = "r1") -> None:
    """One scan with points of its own."""
    client.put(
        topics.scan_key("map", robot, "lidar"),
        scan_envelope(small_scan(sequence, robot)).payload,
        encoding="application/protobuf;foxglove.PointCloud",
        congestion_control=zenoh.CongestionControl.BLOCK,
        attachment=attachment.pack(epoch, sequence, START_NS + sequence),
    )


def losses(folder: Path) -> list[tuple[str, int, int, str]]:
    logged = [decode(e) for e in Recording([folder]) if e.key == topics.LOSS_TOPIC]
    return [(x.robot, x.first_sequence, x.count, x.reason) for x in logged if isinstance(x, Loss)]


def in_balance(service: Service) -> None:
    for source in ("", *service.account.sources()):
        assert service.account.balance(source).is_exact


def test_f19_gaps_and_late_arrivals(tmp_path: Path, caplog: Log) -> None:
    """Counted at once, logged as ranges, and taken back when the missing comes after all."""
    with running(tmp_path) as (service, _, client):
        wait_for_ear(client)
        for sequence in (1, 2, 6, 7, 4):
            put(client, sequence)
        put(client, 1, robot="r2")
        wait_until(lambda: service.account["applied"] == 6, 60)
        account = service.account
        assert account["lost_upstream[r1/lidar]"] == account["lost_upstream"] == 2  # 3 and 5
        assert account["recovered_late[r1/lidar]"] == 1
        assert account["lost_upstream[r2/lidar]"] == 0
        in_balance(service)
        service.stop()
    assert losses(tmp_path) == [("r1", 3, 3, "lost_upstream"), ("r1", 4, 1, "recovered_late")]
    said = [m for m in caplog.messages if "lost_upstream" in m]
    assert said == ["r1/lidar: lost_upstream: 3 scans from sequence 3"]


def test_f19_gaps_of_sources_beyond_those_counted_by_name_add_up(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(status, "MAX_SOURCES", 1)
    with running(tmp_path) as (service, _, client):
        wait_for_ear(client)
        for robot, sequences in (("r1", (1, 2)), ("r2", (1, 4)), ("r3", (1, 5, 3))):
            for sequence in sequences:
                put(client, sequence, robot=robot)
        wait_until(lambda: service.account["applied"] == 7, 60)
        account = service.account
        assert account["lost_upstream[others]"] == account["lost_upstream"] == 2 + 3 - 1
        service.stop()


def test_f20_a_publisher_that_begins_anew(tmp_path: Path) -> None:
    """No loss, no duplicate: its numbers belong to its epoch."""
    with running(tmp_path) as (service, _, client):
        wait_for_ear(client)
        for epoch, sequence in ((5, 100), (5, 101), (6, 1), (6, 2)):
            put(client, sequence, epoch)
        wait_until(lambda: service.account["applied"] == 4, 60)
        account = service.account
        assert account["source_restarted[r1/lidar]"] == 1
        assert account["lost_upstream"] == account["duplicate"] == 0
        assert account["duplicate_publisher"] == 0
        service.stop()
    assert losses(tmp_path) == []


def test_f21_two_publishers_under_one_name(tmp_path: Path, caplog: Log) -> None:
    with running(tmp_path) as (service, _, client):
        wait_for_ear(client)
        for sequence in (1, 2, 3):
            put(client, sequence, epoch=5)
            put(client, sequence, epoch=6)
        wait_until(lambda: service.account["applied"] == 6, 60)
        assert service.account["duplicate_publisher[r1/lidar]"] == 4
        in_balance(service)
        service.stop()
    assert len([m for m in caplog.messages if "two publishers share the name" in m]) == 1


def test_f21_strict_the_second_publisher_is_refused(tmp_path: Path, caplog: Log) -> None:
    """The alarm stays; what is refused is recorded, and leaves no trace in the map or its replay;
    a robot that begins anew is no second one, and others go on."""
    with running(tmp_path, **{"robots.strict": True}) as (service, _, client):
        wait_for_ear(client)
        for sequence in (1, 2, 3):
            put_scan(client, sequence, epoch=5)
            put_scan(client, 10 + sequence, epoch=6)
            put_scan(client, sequence, epoch=6 + (sequence == 3), robot="r2")
        account = service.account
        wait_until(lambda: account.balance().received == 9 and not account.balance().in_flight, 60)
        assert account["rejected.duplicate_publisher[r1/lidar]"] == 2
        assert account["rejected.duplicate_publisher"] == account.balance().rejected == 2
        assert account["duplicate_publisher[r1/lidar]"] == 4
        assert account["applied[r2/lidar]"] == 3
        assert account["source_restarted[r2/lidar]"] == 1
        said = [m for m in caplog.messages if m.startswith("r1/lidar: duplicate_publisher: ")]
        assert len(said) == 1
        in_balance(service)
        model = service.stop()
    expected = Mapper(SETTINGS)
    for sequence in (1, 2, 3, 11):
        expected.insert(small_scan(sequence))
    for sequence in (1, 2, 3):
        expected.insert(small_scan(sequence, "r2"))
    expected.update()
    assert model is not None
    assert model["digest"]["state"] == expected.digest().state
    replayed = replay_log([tmp_path], Config())
    assert replayed.model()["digest"] == model["digest"]
    assert replayed.left_out == {"duplicate_publisher": 2}
    assert len(scans_in(tmp_path)) == 9


def test_f18_conflicts_live_and_replayed(tmp_path: Path, caplog: Log) -> None:
    """Two publishers with one epoch: every number comes twice, with other bytes. The map is the
    same as if the two had come the other way round, and as that of the replay."""
    digests = []
    for name, turn in (("a", 0), ("b", 1)):
        with running(tmp_path / name) as (service, _, client):
            wait_for_ear(client)
            for sequence in (1, 2, 3, 4):
                pair = (small_scan(sequence), small_scan(sequence, num=200))
                for scan in (pair[turn], pair[1 - turn]):
                    client.put(
                        KEY,
                        scan_envelope(scan).payload,
                        encoding="application/protobuf;foxglove.PointCloud",
                        congestion_control=zenoh.CongestionControl.BLOCK,
                        attachment=attachment.pack(5, sequence, scan.stamp_ns),
                    )
                put(client, sequence, robot="r2")
            wait_until(lambda: service.account["applied"] == 8, 60)
            wait_until(lambda: service.account["conflict"] == 4)
            assert service.account["conflict[r1/lidar]"] == 4
            in_balance(service)
            assert service.account.balance().in_flight == 0
            model = service.stop()
        assert model is not None
        balance = service.account.balance()
        assert balance.points_stored == model["counts"]["points_stored"]
        digests.append(model["digest"])
        replayed = replay_log([tmp_path / name], Config())
        assert replayed.model()["digest"] == model["digest"]
        assert replayed.model()["planes"] == model["planes"]
        assert replayed.account["conflict"] == 4
        assert replayed.account.balance().is_exact
        logged = [decode(e) for e in Recording([tmp_path / name]) if e.key == topics.CONFLICT_TOPIC]
        assert [x.sequence for x in logged if isinstance(x, Conflict)] == [1, 2, 3, 4]
    assert digests[0] == digests[1]
    said = [m for m in caplog.messages if m.startswith("r1/lidar: conflict: ")]
    assert len(said) == 4  # a line a run, and a line a replay


@pytest.mark.parametrize("step_s", [-86400, 86400])
def test_f22_the_clock_steps(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, step_s: int) -> None:
    """A day back or ahead while it runs: log time never goes back, at most one new file, and
    nothing waits for the clock."""
    wall = time.time_ns
    with running(tmp_path) as (service, robot, _):
        send(robot, 1, 3)
        wait_until(lambda: service.account["applied"] == 3, 60)
        monkeypatch.setattr(time, "time_ns", lambda: wall() + step_s * 10**9)
        service._inbox._clock_ns = time.time_ns
        service.recorder._clock = time.time_ns
        send(robot, 4, 8)
        wait_until(lambda: service.account["applied"] == 8, 60)
        service.stop()
    times = [e.received_ns for e in Recording([tmp_path])]
    assert times == sorted(times)
    assert len(service.recorder.paths) <= 2
    assert all(v >= 0 for v in service.account.status("map", 1, 1).stage_ms.values())


def slow_mapper(monkeypatch: pytest.MonkeyPatch, seconds: float) -> threading.Event:
    """Every scan takes so long, until the event is set."""
    quick, insert = threading.Event(), Pipeline.insert

    def slowly(self: Pipeline, *envelopes: Envelope) -> bool:
        quick.wait(seconds * len(envelopes))
        return insert(self, *envelopes)

    monkeypatch.setattr(Pipeline, "insert", slowly)
    return quick


def overload(
    folder: Path, monkeypatch: pytest.MonkeyPatch, seconds: float, after_s: float = WAIT_S
) -> None:
    """F23: ten times what can be mapped. The law at every instant, every queue within its bounds,
    what is shed is the truth, and all is well within `after_s` after."""
    limits = {"queue.max_messages": 64, "queue.max_bytes": 1 << 20, "queue.patience_s": 0.2}
    with running(folder, **limits) as (service, _, client):
        wait_for_ear(client)
        quick = slow_mapper(monkeypatch, 0.025)  # 40 a second
        rss = psutil.Process().memory_info().rss
        end, sent = time.monotonic() + seconds, 0
        while time.monotonic() < end or not service.account["shed_overload"]:
            sent += 1
            put(client, sent)
            in_balance(service)
            assert len(service._inbox) <= 64
            assert service._inbox.num_bytes <= 1 << 20
            time.sleep(0.0025)  # 400 a second
        quick.set()
        put(client, sent + 1)  # the last one shows what went before it
        wait_until(lambda: service.account.balance().in_flight == 0, after_s)
        balance, account = service.account.balance(), service.account
        assert account["shed_overload"] > 0
        assert account["lost_upstream"] + balance.received == sent + 1
        assert balance.applied + account["shed_overload"] == balance.received
        assert account["recorded"] == balance.applied
        assert psutil.Process().memory_info().rss - rss < 64 << 20
        service.stop()
    logged = losses(folder)
    for reason in ("shed_overload", "lost_upstream"):
        assert sum(count for *_, count, why in logged if why == reason) == account[reason]
    statuses = [decode(e) for e in Recording([folder]) if e.key == topics.STATUS_TOPIC]
    assert all(balance_of(s.counters, s.gauges).is_exact for s in statuses if isinstance(s, Status))


def test_g15_overload(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    overload(tmp_path, monkeypatch, 4.0)


@pytest.mark.slow
def test_g15_overload_for_a_minute(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    overload(tmp_path, monkeypatch, 60.0, after_s=5.0)


def test_f29_without_a_disk_nothing_is_acknowledged(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """In flight as long as the disk fails, health FAIL; then all of every robot is there."""
    with running(tmp_path, **{"record.retry_s": 0.05}) as (service, robot, client):
        wait_for_ear(client)
        disk = break_disk(service, monkeypatch)
        send(robot, 1, 3)
        put(client, 1, robot="r2")
        wait_until(lambda: service.account["recorder_failed"])
        wait_until(lambda: service.account.balance().in_flight == 4)
        assert service.account.status("map", 1, 1).health == "FAIL"
        assert service.account["recorded"] == 0
        in_balance(service)
        disk.set()
        wait_until(lambda: service.account["applied"] == 4, 60)
        assert service.account.balance().in_flight == 0
        service.stop()


def test_f30_a_slow_disk_loses_nothing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def fdatasync(fd: int) -> None:
        time.sleep(0.5)  # the fault itself
        os.fdatasync(fd)

    with running(tmp_path) as (service, robot, _):
        monkeypatch.setattr(
            service.recorder, "_open_file", lambda path: DurableFile(path, sync_data=fdatasync)
        )
        send(robot, 1, 10)
        wait_until(lambda: service.account["applied"] == 10, 60)
        assert service.account.status("map", 1, 1).gauges["commit_ms"] >= 500
        service.stop()
    assert service.account["lost_upstream"] == service.account["shed_overload"] == 0


@contextmanager
def timed(folder: Path) -> Iterator[tuple[Service, zenoh.Session, str, list[float]]]:
    """A service, a client, the endpoint, and how long each scan took from the door until it was
    durable, less what the disk took for it: no viewer has a part in that."""
    endpoint, acks = free_endpoint(), list[float]()
    options = {"record.directory": folder, "record.min_free_bytes": 0}
    network = NetworkSection(listen=(endpoint,), shared_memory=False)
    with (
        open_session(service_settings(network)) as session,
        open_session(client_settings(endpoint, shared_memory=False)) as client,
    ):
        service = Service(session, load_config(None, options), Mapper(SETTINGS))
        put_on, disk_ns = service._durable.put, [0]

        def fdatasync(fd: int) -> None:
            started = time.time_ns()
            os.fdatasync(fd)
            disk_ns[0] = time.time_ns() - started

        def put_timed(envelopes: list[Any], *more: Any) -> None:
            now = time.time_ns() - disk_ns[0]
            acks.extend((now - e.received_ns) * 1e-6 for e in envelopes)
            put_on(envelopes, *more)

        service.recorder._open_file = lambda path: DurableFile(path, sync_data=fdatasync)

        service._durable.put = put_timed  # type: ignore[method-assign]
        service.start()
        wait_for_ear(client)
        yield service, client, endpoint, acks


def tree(process: subprocess.Popen[bytes]) -> list[psutil.Process]:
    return [*psutil.Process(process.pid).children(recursive=True), psutil.Process(process.pid)]


def with_viewers(folder: Path, seconds: float) -> tuple[dict[str, tuple[float, float]], float]:
    """(median, 99 %) of the ms from the door to the disk: without a viewer, with one, with one that
    is stopped, and after it was killed; and how many seconds the end took. Every scan is mapped in
    each."""
    found: dict[str, tuple[float, float]] = {}
    sent = 0
    with timed(folder) as (service, client, endpoint, acks):

        def drive(name: str) -> None:
            nonlocal sent
            acks.clear()
            end = time.monotonic() + seconds
            while time.monotonic() < end:
                sent += 1
                put(client, sent)
                time.sleep(0.01)
            wait_until(lambda: service.account["applied"] == sent)
            found[name] = (float(np.median(acks)), float(np.percentile(acks, 99)))

        drive("warm")
        drive("none")
        command = [sys.executable, "-m", "facet.sinks.viewer", endpoint, "map", "web"]
        viewer = subprocess.Popen(command, stderr=subprocess.DEVNULL)
        try:
            wait_until(lambda: len(tree(viewer)) > 1)
            drive("running")
            for process in tree(viewer):
                process.send_signal(signal.SIGSTOP)
            drive("stopped")
            for process in tree(viewer):
                process.kill()
            drive("killed")
        finally:
            viewer.kill()
            viewer.wait()
        started = time.monotonic()
        service.stop()
        stop_s = time.monotonic() - started
        assert service.account["lost_upstream"] == service.account["shed_overload"] == 0
    return found, stop_s


def test_g13_viewers(tmp_path: Path) -> None:
    """F26: whatever the viewer does, every scan comes in and is mapped."""
    found, _ = with_viewers(tmp_path, 1.5)
    assert list(found) == ["warm", "none", "running", "stopped", "killed"]


@pytest.mark.slow
def test_g13_viewers_for_a_minute(tmp_path: Path) -> None:
    """As soon as without."""
    found, stop_s = with_viewers(tmp_path, 60.0)
    sys.stdout.write(f"G13: ack ms (median, 99 %): {found}\n")
    assert stop_s < 5.0
    for name in ("running", "stopped", "killed"):
        assert found[name][0] <= found["none"][0] + 20.0, found
        assert found[name][1] <= found["none"][1] + 20.0, found


@pytest.mark.parametrize(("number", "times"), [(signal.SIGTERM, 1), (signal.SIGINT, 2)])
def test_f36_asked_to_stop(tmp_path: Path, number: int, times: int) -> None:
    """Once: the file is finished, exit code 0. Twice: at once, like a kill; what was acknowledged
    is there all the same."""
    asked_to_stop(tmp_path, number, times, WAIT_S)


@pytest.mark.slow
@pytest.mark.parametrize(("number", "times"), [(signal.SIGTERM, 1), (signal.SIGINT, 2)])
def test_f36_asked_to_stop_within_five_seconds(tmp_path: Path, number: int, times: int) -> None:
    asked_to_stop(tmp_path, number, times, 5.0)


def asked_to_stop(folder: Path, number: int, times: int, timeout_s: float) -> None:
    service = Running(folder / "log")
    try:
        with open_session(client_settings(service.endpoint, shared_memory=False)) as client:
            wait_for_ear(client)
            for sequence in (1, 2, 3):
                put(client, sequence)
            wait_until(lambda: len(scans_in(service.folder)) == 3)
        if times == 2:
            service.process.send_signal(number)
        code, _ = service.stop(number, timeout_s)
    finally:
        service.process.kill()
        service.process.wait()
    assert code == 0 if times == 1 else code in (0, 128 + number)
    recording = Recording([service.folder])
    assert [e.sequence for e in recording if e.key == KEY] == [1, 2, 3]
    assert times == 2 or not recording.is_damaged
