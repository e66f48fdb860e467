"""kill -9 at random instants: nothing acknowledged is lost, and the map goes on as its replay."""

from __future__ import annotations

import random
import shutil
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import zenoh

from facet.commands.play import RobotPublisher
from facet.commands.replay import replay_log
from facet.config import Config
from facet.mapping.mapper import Mapper
from facet.resume import resume
from facet.session import client_settings, open_session
from facet.sources.naming import is_scan
from facet.sources.recording import Recording
from facet_protocol import topics
from facet_protocol.codec import Message, decode
from facet_protocol.maps import decode_update
from facet_protocol.messages import Cut, Envelope
from kill_target import SETTINGS, config_of
from rig import free_endpoint, patient, room_scan, scan_envelope

NUM_ROBOTS, RATE_HZ = 10, 40.0
LIVES = 10  # of one log, before a new one is begun
Name = tuple[str, int, int]  # key, epoch, sequence


def small_scans(num: int) -> list[Envelope]:
    """Of 300 points each."""
    scans = (room_scan(k) for k in range(1, num + 1))
    return [scan_envelope(replace(scan, points=scan.points[::15])) for scan in scans]


class Robots(threading.Thread):
    """Ten robots at 40 Hz, until told to stop. `seen`: revisions of the map that they heard of."""

    def __init__(self, endpoint: str, scans: list[Envelope]) -> None:
        super().__init__(daemon=True)
        self._endpoint, self._scans = endpoint, scans
        self.stopping = threading.Event()
        self.seen: set[int] = set()

    def run(self) -> None:
        def hear(sample: zenoh.Sample) -> None:
            self.seen.add(decode_update(sample.payload.to_bytes()).revision)

        settings = patient(client_settings(self._endpoint, shared_memory=False))
        with open_session(settings) as session:
            ear = zenoh.handlers.Callback(hear, indirect=False)
            session.declare_subscriber(topics.update_key("map"), ear)
            publisher = RobotPublisher(session, "map")
            due = time.monotonic()
            number = 0
            while not self.stopping.wait(max(0.0, due - time.monotonic())):
                scan = self._scans[number // NUM_ROBOTS % len(self._scans)]
                publisher.publish(f"r{number % NUM_ROBOTS}", "lidar", scan)
                number += 1
                due += 1.0 / (NUM_ROBOTS * RATE_HZ)
            publisher.close()


class Victim:
    """A service in a process of its own, and what it acknowledged before it was killed."""

    def __init__(self, folder: Path, checkpoint_s: float = 0.4, start: str = "cold") -> None:
        self.endpoint = free_endpoint()
        target = Path(__file__).with_name("kill_target.py")
        self._process = subprocess.Popen(
            [sys.executable, str(target), str(folder), self.endpoint, str(checkpoint_s), start],
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
        )
        assert self._process.stdout is not None
        if self._process.stdout.readline() != "ready\n":
            raise AssertionError(self._process.communicate()[1])

    def live(self, seconds: float) -> None:
        """From the first acknowledgement on."""
        assert self._process.stdout is not None
        self._first = self._process.stdout.readline()
        time.sleep(seconds)

    def lines(self) -> Iterator[str]:
        """What is acknowledged, as it is, to the end."""
        assert self._process.stdout is not None
        with self._process.stdout as stdout:
            yield from stdout

    def end(self) -> None:
        """Kill it, whoever reads what it says."""
        self._process.kill()
        self._process.wait()
        assert self._process.stderr is not None
        self._process.stderr.close()

    def kill(self) -> list[Name]:
        self._process.kill()
        lines = [self._first, *self._process.communicate()[0].splitlines()]
        names = []
        for line in lines:
            words = line.split()
            if len(words) == 3:  # the last may be cut off: it was not acknowledged
                names.append((words[0], int(words[1]), int(words[2])))
        return names


def _own(envelope: Envelope) -> Message | None:
    return decode(envelope) if envelope.key == topics.CUT_TOPIC else None


def told(mapper: Mapper) -> tuple[Any, ...]:
    planes = mapper.snapshot().changed
    return mapper.digest(), mapper.revision, [(p.id, p.revision, p.num_points) for p in planes]


def check(folder: Path, acknowledged: set[Name], seen: set[int]) -> bool:
    """Whether the resume could begin with a checkpoint."""
    logged = list(Recording([folder]))
    cuts = {m.revision for e in logged if isinstance(m := _own(e), Cut)}
    assert seen <= cuts, f"revisions that the log does not know: {sorted(seen - cuts)}"
    recorded = [(e.key, e.epoch, e.sequence) for e in logged if is_scan(e)]
    lost = acknowledged - set(recorded)
    assert not lost, f"{len(lost)} acknowledged messages cannot be read"
    assert len(set(recorded)) == len(recorded)
    resumed = resume(config_of(folder), Mapper(SETTINGS))
    if resumed.pipeline.is_stale:
        resumed.pipeline.update()
    replayed = replay_log([folder], Config())
    assert told(resumed.mapper) == told(replayed.mapper)
    return resumed.checkpoint is not None


def kill_many(folder: Path, num: int, seed: int) -> tuple[int, int, int]:
    """(messages acknowledged, resumes that began with a checkpoint, revisions that were heard)."""
    rng, scans = random.Random(seed), small_scans(40)
    acknowledged: set[Name] = set()
    total = from_checkpoint = num_seen = 0
    for life in range(num):
        if life % LIVES == 0:
            shutil.rmtree(folder, ignore_errors=True)
            acknowledged = set()
        victim = Victim(folder)
        robots = Robots(victim.endpoint, scans)
        robots.start()
        victim.live(rng.uniform(0.0, 1.0))
        names = victim.kill()
        robots.stopping.set()
        robots.join(20.0)
        acknowledged.update(names)
        total += len(names)
        num_seen += len(robots.seen)
        from_checkpoint += check(folder, acknowledged, robots.seen)
    return total, from_checkpoint, num_seen


def test_killed_at_random_instants(tmp_path: Path) -> None:
    """Six lives, and more where a busy machine gets too little done in them to be killed at."""
    done = np.zeros(3, np.int64)
    for seed in range(1, 10):
        done += kill_many(tmp_path / "log", 6, seed)
        if (done > (200, 0, 6)).all():
            return
    raise AssertionError(f"{done} acknowledged, resumed from a checkpoint, heard of")


@pytest.mark.slow
def test_killed_a_hundred_times(tmp_path: Path) -> None:
    total, from_checkpoint, num_seen = kill_many(tmp_path / "log", 100, seed=2)
    sys.stdout.write(f"100 kills, {total} acknowledged, {from_checkpoint} from a checkpoint\n")
    assert total > 10_000
    assert from_checkpoint > 50
    assert num_seen > 100
