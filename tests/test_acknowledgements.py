"""A robot stays until its scans are in the log: over a link that breaks, and not for ever."""

from __future__ import annotations

from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest
import zenoh
import zenoh.ext
from typer.testing import CliRunner

from facet.__main__ import app
from facet.commands import play
from facet.commands.acknowledgements import Acknowledgements, taken_of
from facet.commands.play import RobotPublisher
from facet.config import NetworkSection, load_config
from facet.mapping.mapper import Mapper
from facet.mapping.settings import MapSettings
from facet.service import Service
from facet.session import client_settings, open_session, service_settings
from facet.sinks.log_file import write_recording
from facet_protocol import topics
from rig import free_endpoint, patient, room, wait_until
from tcp_proxy import Proxy
from test_service import break_disk, running, send

SCAN = room(1)[0]  # 54 kB
QUICK = {"publish.status_s": 0.05}


@contextmanager
def service_at(folder: Path, **settings: Any) -> Iterator[tuple[Service, str]]:
    """A service that maps into a folder, and where it listens."""
    endpoint = free_endpoint()
    told = {"record.directory": folder, "record.min_free_bytes": 0, **QUICK, **settings}
    network = NetworkSection(listen=(endpoint,), shared_memory=False)
    with open_session(service_settings(network)) as session:
        service = Service(session, load_config(None, told), Mapper(MapSettings(voxel_m=0.1)))
        service.start()
        yield service, endpoint
        service.stop()


@pytest.fixture
def log(tmp_path: Path) -> Path:
    write_recording(tmp_path / "room.mcap", room(6), {})
    return tmp_path / "room.mcap"


def played(log: Path, endpoint: str) -> tuple[int, str]:
    """(exit code, what was said) of `facet play`."""
    told = ["play", str(log), "--speed", "max", "--no-shared-memory", "--connect", endpoint]
    result = CliRunner().invoke(app, told)
    return result.exit_code, result.output


def test_what_a_status_acknowledges() -> None:
    gauges = {
        **{"ack[r1/a]": 90.0, "ack_missing[r1/a]": 4.0, "ack_epoch[r1/a]": 7.0},
        **{"ack[r1/b]": 50.0, "ack_missing[r1/b]": 0.0, "ack_epoch[r1/b]": 6.0},
        **{"ack[r1/c]": 50.0, "queue_msgs": 7.0},
    }
    assert taken_of(gauges, 7) == {"r1/a": 86}


def test_what_is_missing_or_was_shed_is_not_acknowledged(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with running(tmp_path, **{"queue.max_messages": 3, "record.retry_s": 0.05}) as (service, r1, _):
        disk = break_disk(service, monkeypatch)
        send(r1, 1, 1)
        wait_until(lambda: service.account["recorder_failed"])
        send(r1, 2, 6)  # three of them have no room
        wait_until(lambda: service.account["shed_overload"] == 2)
        disk.set()
        wait_until(lambda: service.account["recorded"] == 4)
        r1._sequences[topics.scan_key("map", "r1", "lidar")] += 5  # were never sent
        send(r1, 7, 7)
        wait_until(lambda: service.account["recorded"] == 5)
        gauges = service.account.status("map", 1, 1).gauges
        service.stop()
    assert gauges["ack[r1/lidar]"] == 12
    assert taken_of(gauges, r1.epoch) == {"r1/lidar": 5}


def test_a_link_that_breaks_at_the_end_costs_nothing(tmp_path: Path) -> None:
    """All that comes after the first scan is sent while the network is down."""
    with service_at(tmp_path) as (service, endpoint), Proxy(endpoint) as proxy:
        settings = patient(client_settings(proxy.endpoint, shared_memory=False))
        with open_session(settings) as session, ThreadPoolExecutor() as pool:
            robot = RobotPublisher(session, "map")
            acknowledged = Acknowledgements(session, "map", robot.epoch)
            robot.publish("r1", "front", SCAN)
            wait_until(lambda: acknowledged.wait(robot.sent, 1.0) == 0)
            proxy.cut()
            wait_until(lambda: not list(session.info.routers_zid()))
            for _ in range(20):
                robot.publish("r1", "front", SCAN)
            waiting = pool.submit(acknowledged.wait, robot.sent, 60.0)
            assert service.account["recorded"] == 1
            proxy.restore()
            assert waiting.result() == 0
            assert service.account["recorded"] == 21
            acknowledged.close()
            robot.close()


def test_play_leaves_when_all_is_in_the_log(log: Path, tmp_path: Path) -> None:
    with service_at(tmp_path / "log") as (service, endpoint):
        assert played(log, endpoint) == (0, "played 6 scans\n")
        assert service.account["recorded"] == 6


def test_what_is_never_acknowledged_is_counted(
    log: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(play, "PATIENCE_S", 0.5)
    with service_at(tmp_path / "log", **{"record.retry_s": 0.05}) as (service, endpoint):
        disk = break_disk(service, monkeypatch)
        code, said = played(log, endpoint)
        disk.set()
    assert code == 3
    assert "played 6 scans" in said
    assert "6 of 6 messages were not acknowledged: those may be lost" in said


def test_nobody_waits_for_who_does_not_acknowledge(log: Path) -> None:
    """A subscriber that is no service of Facet's takes them, and play does not wait for a word."""
    endpoint = free_endpoint()
    network = NetworkSection(listen=(endpoint,), shared_memory=False)
    with open_session(service_settings(network)) as session:
        heard: list[zenoh.Sample] = []
        stranger = zenoh.ext.declare_advanced_subscriber(
            session,
            topics.scans_key("map"),
            zenoh.handlers.Callback(heard.append, indirect=False),
        )
        code, said = played(log, endpoint)
        wait_until(lambda: len(heard) == 6)
        stranger.undeclare()
    assert code == 0
    assert "nobody there acknowledges" in said
