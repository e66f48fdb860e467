"""How a service ends when the disk is slow, when it is full, and when we are at fault."""

from __future__ import annotations

import os
import threading
import time
from pathlib import Path
from typing import Any

import pytest

from facet import intake, keeper
from facet import service as services
from facet.commands.run import _conclude
from facet.commands.terminal import Exit
from facet.service import Service
from facet.sinks.durable_file import DurableFile
from facet.sources.naming import is_scan
from facet.sources.recording import Recording
from facet_protocol import topics
from rig import wait_until
from test_service import ask, break_disk, running, send

SLOW_S = 0.3


def slow_disk(service: Service) -> None:
    """From the next file on."""

    def fdatasync(fd: int) -> None:
        time.sleep(SLOW_S)
        os.fdatasync(fd)

    service.recorder._open_file = lambda path: DurableFile(path, sync_data=fdatasync)


def is_settled(service: Service) -> bool:
    balance = service.account.balance()
    return balance.is_exact and balance.in_flight == 0


def fail_once(mapper: Any) -> None:
    """The next update of the map fails; those after it would not."""
    update = mapper._normals.update

    def fail(*arguments: Any) -> Any:
        mapper._normals.update = update
        raise MemoryError("nothing left")

    mapper._normals.update = fail


def test_what_became_durable_too_late_for_the_map_is_counted(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """And told by the exit code: the model lacks what the log holds."""
    monkeypatch.setattr(services, "DRAIN_S", SLOW_S / 4)
    with running(tmp_path) as (service, robot, _):
        slow_disk(service)
        send(robot, 1, 20)
        wait_until(lambda: service.account["received"] == 20)
        model = service.stop()
    account = service.account
    assert is_settled(service)
    assert account["recorded"] == 20 == account["applied"] + account["not_applied"]
    assert account["not_applied"] > 0
    assert _conclude(service, model) is Exit.LOST
    assert len([*filter(is_scan, Recording([tmp_path]))]) == 20


def test_all_that_waits_at_the_end_is_recorded(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """However many commits it takes."""
    monkeypatch.setattr(intake, "BATCH_BYTES", 1)
    monkeypatch.setattr(services, "DRAIN_S", 0.0)
    with running(tmp_path) as (service, robot, _):
        slow_disk(service)
        send(robot, 1, 12)
        wait_until(lambda: service.account["received"] == 12)
        service.stop()
    assert is_settled(service)
    assert service.account["recorded"] == 12
    assert len([*filter(is_scan, Recording([tmp_path]))]) == 12


def test_a_fast_disk_leaves_nothing_out(tmp_path: Path) -> None:
    with running(tmp_path) as (service, robot, _):
        send(robot, 1, 12)
        wait_until(lambda: service.account["received"] == 12)
        model = service.stop()
    assert is_settled(service)
    assert service.account["applied"] == 12
    assert _conclude(service, model) is Exit.CLEAN


def test_without_a_disk_nobody_waits_for_the_log(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(keeper, "WAIT_S", 600.0)
    with running(tmp_path) as (service, robot, _):
        send(robot, 1, 3)
        wait_until(lambda: service.account["applied"] == 3 and service._pipeline.is_settled)
        break_disk(service, monkeypatch)
        service._intake.roll()
        assert service._intake.is_logged(60.0)
        send(robot, 4, 6)
        wait_until(lambda: service.account.failure and service.account["received"] == 6)
        ending = threading.Thread(target=service.stop, daemon=True)
        ending.start()
        ending.join(60.0)
        assert not ending.is_alive()
    assert is_settled(service)
    assert service.account["unrecorded"] == 3
    assert service.account["checkpoint_failed"] == 1


def test_a_fault_stays_said_while_the_log_goes_on(tmp_path: Path) -> None:
    with running(tmp_path) as (service, robot, _):
        fail_once(service._mapper)
        send(robot, 1, 1)
        wait_until(lambda: service.fault)
        send(robot, 2, 4)
        wait_until(lambda: service.account["recorded"] == 4)
        service._intake.is_logged(10.0)
        assert service.account.failure == "mapper: nothing left"
        service.stop()
    assert is_settled(service)


def test_a_fault_that_a_command_meets_is_ours(tmp_path: Path) -> None:
    """Not the asker's alone: what is derived after it could not be trusted."""
    with running(tmp_path) as (service, robot, client):
        send(robot, 1, 3)
        wait_until(lambda: service.account["applied"] == 3 and service._pipeline.is_settled)
        ask(client, topics.cmd_key("map", "pause"))
        fail_once(service._mapper)
        service._pipeline.is_stale = True
        answer = ask(client, topics.cmd_key("map", "checkpoint"))
        wait_until(lambda: service.fault)
        assert service.account.failure == "mapper: nothing left"
        again = ask(client, topics.cmd_key("map", "checkpoint"))
        assert service.stop() is None
    assert "nothing left" in answer
    assert "nothing left" in again


def test_whoever_asks_is_told_what_is_in_the_way(tmp_path: Path) -> None:
    (tmp_path / "model.ply").mkdir(parents=True)
    with running(tmp_path) as (service, robot, client):
        send(robot, 1, 1)
        wait_until(lambda: service.account["applied"] == 1)
        answer = ask(client, topics.cmd_key("map", "export") + "?format=ply")
        service.stop()
    assert "export failed" in answer
    assert "model.ply" in answer


def test_an_erasure_that_finds_nothing_left_is_settled(tmp_path: Path) -> None:
    with running(tmp_path) as (service, robot, client):
        send(robot, 1, 3)
        wait_until(lambda: service.account["applied"] == 3)
        for times in (1, 2):
            ask(client, topics.cmd_key("map", "erase") + "?robot=r1")
            wait_until(lambda n=times: service.account["used_as_erasure"] == n)  # type: ignore[misc]
        service.stop()
    assert is_settled(service)
    assert service.account["scans_erased"] == 3
