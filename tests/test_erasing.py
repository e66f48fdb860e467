"""Scans that are erased: as if they had never come, live as in the replay, and after a resume."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from typer.testing import CliRunner

from facet import corrections, erasing
from facet.__main__ import app
from facet.commands.replay import replay_log
from facet.commands.terminal import Exit
from facet.config import Config, load_config
from facet.mapping.mapper import Mapper
from facet.outgoing import Outgoing
from facet.resume import resume
from facet.sources.recording import Recording
from facet_protocol import topics
from facet_protocol.codec import encode
from facet_protocol.messages import Envelope, Erase
from rig import START_NS, scan_envelope, wait_until
from test_corrections import CorrectedLine, correction, digest_of, pose, small
from test_resume import SETTINGS, config, told
from test_rivals import rival_pair
from test_service import ask, running, send

COMMAND = topics.cmd_key("map", "erase")


def erasure(erase: Erase, number: int = 1) -> Envelope:
    stamp_ns = START_NS + 10**11 + number
    topic = topics.erase_topic(erase.robot)
    return Outgoing("map", "map").address(topic, erase, stamp_ns, stamp_ns)[0]


def erase(line: CorrectedLine, what: Erase, number: int = 1) -> None:
    account_of(line).arrive(f"{what.robot}/@correction")
    line.scans(erasure(what, number))


def account_of(line: CorrectedLine) -> Any:
    return line.pipeline._account


def put(line: CorrectedLine, *sequences: int, robot: str = "r1") -> None:
    for k in sequences:
        account_of(line).arrive(f"{robot}/lidar")
        line.scans(scan_envelope(small(k, robot)))


ERASED = {
    "all": (Erase("r1"), (1, 2, 3, 4)),
    "sensor": (Erase("r1", "lidar"), (1, 2, 3, 4)),
    "epoch": (Erase("r1", epoch=5), (1, 2, 3, 4)),
    "from": (Erase("r1", first=3), (3, 4)),
    "to": (Erase("r1", last=1), (1,)),
    "between": (Erase("r1", "lidar", 5, 2, 3), (2, 3)),
}


@pytest.mark.parametrize("name", ERASED)
def test_as_if_they_had_never_come(name: str, tmp_path: Path) -> None:
    what, gone = ERASED[name]
    line = CorrectedLine(tmp_path)
    put(line, 1, 2, 3, 4)
    put(line, 1, 2, robot="r2")
    erase(line, what)
    left = [small(k) for k in (1, 2, 3, 4) if k not in gone]
    left += [small(k, "r2") for k in (1, 2)]
    assert line.mapper.digest() == digest_of(left)
    account = account_of(line)
    assert account["scans_erased[r1/lidar]"] == account["scans_erased"] == len(gone)
    assert account["applied[r1/lidar]"] == 4
    for source in ("", "r1/lidar", "r2/lidar", "r1/@correction"):
        assert account.balance(source).is_exact
        assert account.balance(source).in_flight == 0
    assert account["points_stored"] == line.mapper.counts().points_stored
    assert account.balance("r2/lidar").points_rejected == 0
    put(line, 5)
    assert line.mapper.digest() == digest_of([*left, small(5)])
    line.recorder.close()
    replayed = replay_log([tmp_path], Config())
    assert told(replayed.mapper) == told(line.mapper)
    assert replayed.account["used_as_erasure"] == 1
    assert replayed.account.balance().is_exact


NOTHING = {
    "robot": ("unknown_scan", Erase("r9")),
    "sensor": ("unknown_scan", Erase("r1", "other")),
    "epoch": ("unknown_scan", Erase("r1", epoch=6)),
    "range": ("unknown_scan", Erase("r1", first=3, last=2)),
}


@pytest.mark.parametrize("name", NOTHING)
def test_what_is_not_there_is_refused(name: str, tmp_path: Path) -> None:
    reason, what = NOTHING[name]
    line = CorrectedLine(tmp_path)
    put(line, 1, 2)
    erase(line, what)
    assert account_of(line)[f"rejected.{reason}"] == 1
    assert account_of(line).balance().is_exact
    assert line.mapper.digest() == digest_of([small(1), small(2)])


def test_what_is_no_erasure_is_refused(tmp_path: Path) -> None:
    line = CorrectedLine(tmp_path)
    put(line, 1)
    of_another = replace(erasure(Erase("r1")), payload=encode(Erase("r2"))[1])
    for bad in (of_another, replace(erasure(Erase("r1"), 2), schema="facet.v1.Loss")):
        line.scans(bad)
    assert account_of(line)["rejected.unknown_schema"] == 2
    assert line.mapper.digest() == digest_of([small(1)])


def test_too_many_at_once_are_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(corrections, "MAX_ERASED", 2)
    line = CorrectedLine(tmp_path)
    put(line, 1, 2, 3)
    erase(line, Erase("r1"))
    assert account_of(line)["rejected.too_large"] == 1
    erase(line, Erase("r1", last=2), 2)
    erase(line, Erase("r1", first=3), 3)
    assert account_of(line)["scans_erased"] == 3
    assert line.mapper.counts().voxels == 0


@pytest.mark.parametrize("keep", [True, False], ids=["checkpoint", "whole log"])
def test_erased_for_good(tmp_path: Path, keep: bool) -> None:
    """Also after a resume: no correction, rival, copy or other erasure brings it back, or takes it
    out twice. What was moved or chosen is erased where it is."""
    best, worst = rival_pair(3)
    line = CorrectedLine(tmp_path)
    put(line, 1, 2, 4)
    line.scans(scan_envelope(worst), scan_envelope(best), correction({2: pose(0.3)}))
    erase(line, Erase("r1", first=2, last=3))
    assert line.mapper.digest() == digest_of([small(1), small(4)])
    if keep:
        line.checkpoint()
    line.recorder.commit()  # and then the process is killed
    line = CorrectedLine(tmp_path, resume(config(tmp_path), Mapper(SETTINGS)))
    again = [scan_envelope(s) for s in (small(2), worst, best, rival_pair(2)[0], rival_pair(2)[1])]
    line.scans(*again, correction({1: pose(0.1), 2: pose(0.2)}, 2), correction({3: pose(0.2)}, 3))
    erase(line, Erase("r1", first=2, last=3), 2)
    put(line, 5)
    assert line.mapper.digest() == digest_of([small(1), small(4), small(5)])
    line.recorder.close()
    assert told(replay_log([tmp_path], Config()).mapper)[0] == told(line.mapper)[0]


def test_killed_before_it_was_done_it_is_by_the_next_run(tmp_path: Path) -> None:
    line = CorrectedLine(tmp_path)
    put(line, 1, 2)
    line.record([erasure(Erase("r1", last=1))])
    resumed = resume(config(tmp_path), Mapper(SETTINGS))
    again = CorrectedLine(tmp_path, resumed)
    again.pipeline.update()
    assert again.mapper.digest() == digest_of([small(2)])


def test_the_command(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with running(tmp_path) as (service, robot, client):
        send(robot, 1, 4)
        wait_until(lambda: service.account["applied"] == 4, 60)
        for parameters, said in {
            "": "say robot=NAME",
            "?robot=a b": "is not [A-Za-z0-9_-]",
            "?robot=r1;last=x": "last='x' is not a number from 1",
            "?robot=r1;last=0": "last='0' is not a number from 1",  # not: all of them
            f"?robot=r1;last={'9' * 5000}": "is not a number from 1",
            "?robot=r1;first=3;last=2": "first=3 comes after last=2",
            "?robot=r1;sensor=": "sensor= has no value",  # not: every one
            "?robot=r1;robot=r2": "robot= comes twice, 'r1' and 'r2'",
            "?robot=r1;speed=3": "'speed=3' is no parameter of erase, which takes robot=, sensor=",
            "?robot=r9": "of r9 has come, nothing was erased; heard since the start: r1",
            "?robot=r1;first=9": "no such scan of r1 has come",
        }.items():
            assert said in ask(client, COMMAND + parameters)
        assert service.account["scans_erased"] == 0
        assert '"scans_erased": 2' in ask(client, f"{COMMAND}?robot=r1;first=2;last=3")
        # a robot cannot: there is no key for it
        for key in ("facet/erase/r1", "facet/v1/map/erase/r1"):
            payload = encode(Erase("r1"))[1]
            client.put(key, payload, encoding="application/protobuf;facet.v1.Erase")
        send(robot, 5, 5)
        wait_until(lambda: service.account["applied"] == 5, 60)
        monkeypatch.setattr(erasing, "ANSWER_S", 0.1)
        ask(client, topics.cmd_key("map", "pause"))
        assert "not done yet" in ask(client, f"{COMMAND}?robot=r1;last=1")
        ask(client, topics.cmd_key("map", "resume"))
        wait_until(lambda: service.account["scans_erased"] == 3)
        model = service.stop()
    assert model is not None
    assert service.account.balance().is_exact
    assert service.account.balance().in_flight == 0
    replayed = replay_log([tmp_path], Config())
    assert replayed.model()["digest"] == model["digest"]
    assert replayed.model()["planes"] == model["planes"]
    result = CliRunner().invoke(app, ["info", str(tmp_path)])
    said = "0 corrections (of none), 2 erasures: 2 applied; 3 scans moved or erased"
    assert said in " ".join(result.output.split())
    assert sum(topics.is_erase_topic(e.key) for e in Recording([tmp_path])) == 2
    assert replayed.exit_code is Exit.CLEAN  # a name typed wrong is not in the log
    assert (
        resume(
            load_config(None, {"record.directory": tmp_path, "mapping.voxel_m": 0.1}),
            Mapper(SETTINGS),
        )
        .mapper.digest()
        .state
        == model["digest"]["state"]
    )
