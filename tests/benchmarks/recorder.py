"""The log and what is kept of the map beside it: acknowledgements, checkpoints, resumes.

Acknowledgement: from a robot's `put` in this process, over Zenoh on loopback, to the line by which
the service in another says that the message is durable; ten robots at 40 Hz. A checkpoint of a
million voxels is held and written while another thread records 400 messages a second: how much
later they are acknowledged by that. A resume: that checkpoint, and the log of six seconds after it.
"""

from __future__ import annotations

import json
import logging
import sys
import tempfile
import threading
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from benchmarks.figures import Figure, at_least, at_most, report
from facet.config import Config, load_config
from facet.mapping.mapper import Mapper
from facet.mapping.settings import MapSettings
from facet.resume import hold, note_newest, resume, save
from facet.robots import admission_of
from facet.sinks.recorder import Recorder
from facet.status import Account
from facet_protocol.messages import Envelope, Pose, Scan, ScanKind
from rig import room_scan
from test_kills import NUM_ROBOTS, RATE_HZ, Robots, Victim, small_scans

SIDE_M = 10.0  # of the floor that one scan covers
POINTS = 200_000  # of such a scan: five a voxel
MESSAGE_S = 1.0 / (NUM_ROBOTS * RATE_HZ)
COMMIT_S = 0.05
WARM_S = 3.0  # kernels are loaded
TAIL_SCANS = 2400  # six seconds of ten robots at 40 Hz: as 60 s are to ten million voxels

Latencies = NDArray[np.float64]  # ms


def hall(num_tiles: int) -> list[Scan]:
    """Scans from above of a floor, a square of SIDE_M each, with 3 mm of noise."""
    rng = np.random.default_rng(5)
    scans = []
    width = int(np.ceil(np.sqrt(num_tiles)))
    for k in range(num_tiles):
        x, y = divmod(k, width)
        points = rng.uniform(-SIDE_M / 2, SIDE_M / 2, (POINTS, 3))
        points[:, 2] = rng.normal(-2.0, 0.003, POINTS)
        base = room_scan(1)
        centre = np.array([x * SIDE_M, y * SIDE_M, 2.0])
        pose = Pose(centre, np.array([0.0, 0.0, 0.0, 1.0]))
        stamped = replace(base, sequence=k + 1, stamp_ns=base.stamp_ns + k, robot="above")
        scans.append(
            replace(stamped, kind=ScanKind.CLOUD, pose=pose, points=points.astype(np.float32))
        )
    return scans


def config_of(folder: Path) -> Config:
    return load_config(None, {"record.directory": folder, "record.min_free_bytes": 0})


def recorder_of(folder: Path, mapper: Mapper) -> Recorder:
    settings = json.dumps(mapper.settings.as_dict())
    metadata = {"cuts": "logged", "resolved": "logged", "map": "map", "settings": settings}
    return Recorder(folder, "map", metadata, clock=time.time_ns)


def acknowledged(num_s: float) -> Latencies:
    """Of every message of ten robots, over Zenoh, until it is durable."""
    sent: list[float] = []

    with tempfile.TemporaryDirectory() as name:
        victim = Victim(Path(name) / "log", checkpoint_s=10.0)
        robots = Robots(victim.endpoint, _Noted(small_scans(40), sent))
        times: dict[tuple[int, int], float] = {}
        reader = threading.Thread(target=_read, args=(victim, times), daemon=True)
        reader.start()
        robots.start()
        time.sleep(num_s)
        robots.stopping.set()
        robots.join(10.0)
        time.sleep(0.5)
        victim.end()
        reader.join(5.0)
    latencies = [
        (times[n % NUM_ROBOTS, n // NUM_ROBOTS + 1] - at) * 1e3
        for n, at in enumerate(sent)
        if (n % NUM_ROBOTS, n // NUM_ROBOTS + 1) in times
    ]
    lost = len(sent) - len(latencies)
    assert lost <= 1, f"{lost} messages were not acknowledged"
    return np.array(latencies[int(WARM_S / MESSAGE_S) :])


class _Noted(list[Envelope]):
    """Scans, each of which notes when it is taken."""

    def __init__(self, scans: list[Envelope], sent: list[float]) -> None:
        super().__init__(scans)
        self._sent = sent

    def __getitem__(self, index: Any) -> Any:
        self._sent.append(time.perf_counter())
        return super().__getitem__(index)


def _read(victim: Victim, times: dict[tuple[int, int], float]) -> None:
    for line in victim.lines():
        key, _epoch, sequence = line.split()
        robot = int(key.split("/robot/r")[1].split("/")[0])
        times[robot, int(sequence)] = time.perf_counter()


class Recording400(threading.Thread):
    """400 messages a second into a log of their own, committed every 50 ms."""

    def __init__(self, folder: Path, mapper: Mapper) -> None:
        super().__init__(daemon=True)
        self._log = recorder_of(folder, mapper)
        self._scan = small_scans(1)[0]
        self.stopping = threading.Event()
        self.latencies: list[float] = []

    def run(self) -> None:
        waiting: list[float] = []
        due, commit, number = time.perf_counter(), time.perf_counter() + COMMIT_S, 0
        while not self.stopping.is_set():
            number += 1
            self._log.write(replace(self._scan, sequence=number))
            waiting.append(due)
            due += MESSAGE_S
            if time.perf_counter() >= commit:
                self._log.commit()
                now = time.perf_counter()
                self.latencies += [(now - at) * 1e3 for at in waiting]
                waiting, commit = [], now + COMMIT_S
            time.sleep(max(0.0, due - time.perf_counter()))
        self._log.close()


def checkpoints(folder: Path, mapper: Mapper, times: int) -> dict[str, Any]:
    """What holding and writing one takes, and what it costs the messages of that time."""
    log = recorder_of(folder / "map", mapper)
    admission = admission_of(config_of(folder / "map"), Account(), mapper.settings.reach_m)
    newest: dict[str, tuple[int, int]] = {}
    for envelope in small_scans(4):
        log.write(envelope)
        note_newest(newest, envelope)
        admission.admit(envelope)
    log.commit()
    thread = Recording400(folder / "other", mapper)
    thread.start()
    time.sleep(3.0)
    quiet = list(thread.latencies[200:])
    at = len(thread.latencies)
    holds, writes, num_bytes = [], [], 0
    for _ in range(times):
        started = time.perf_counter()
        held = hold(mapper, admission, config_of(folder / "map"), log.position, newest)
        holds.append((time.perf_counter() - started) * 1e3)
        started = time.perf_counter()
        num_bytes = save(folder / "map", held)[1]
        writes.append((time.perf_counter() - started) * 1e3)
        time.sleep(0.3)
    busy = list(thread.latencies[at:])
    thread.stopping.set()
    thread.join()
    log.close()
    return {
        "first_hold_ms": float(np.max(holds[:2])),  # in memory that was never touched
        "hold_ms": float(np.median(holds[2:])),
        "write_ms": float(np.median(writes)),
        "num_bytes": num_bytes,
        "quiet_p99": float(np.percentile(quiet, 99)),
        "busy_p99": float(np.percentile(busy, 99)),
        "quiet_max": float(np.max(quiet)),
        "busy_max": float(np.max(busy)),
    }


def resumed_s(folder: Path, settings: MapSettings) -> float:
    logging.disable(logging.WARNING)  # of stamps that are out of order
    started = time.perf_counter()
    resumed = resume(config_of(folder), Mapper(settings))
    assert resumed.checkpoint is not None
    if resumed.pipeline.is_stale:
        resumed.pipeline.update()
    return time.perf_counter() - started


def with_tail(folder: Path, mapper: Mapper) -> None:
    """Six seconds of ten robots into the log behind the checkpoint, without cuts."""
    log, scans = recorder_of(folder, mapper), small_scans(40)
    for k in range(TAIL_SCANS):
        scan = scans[k % len(scans)]
        key = scan.key.replace("/r1/", f"/r{k % NUM_ROBOTS}/")
        log.write(replace(scan, key=key, epoch=9, sequence=k // NUM_ROBOTS + 1))
        if k % 20 == 19:
            log.commit()
    log.close()


def main(quick: bool) -> None:
    latencies = acknowledged(6.0 if quick else 30.0)
    mapper = Mapper(MapSettings())
    for scan in hall(2 if quick else 15):
        mapper.insert(scan)
    mapper.update()
    voxels = mapper.counts().voxels
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        cost = checkpoints(folder, mapper, 4 if quick else 8)
        alone_s = min(resumed_s(folder / "map", mapper.settings) for _ in range(2))
        with_tail(folder / "map", mapper)
        tail_s = resumed_s(folder / "map", mapper.settings)
    stall = cost["busy_max"] - cost["quiet_max"]
    figures = [
        at_most("acknowledged, p50 (G9)", float(np.percentile(latencies, 50)), 100.0, "ms"),
        at_most("acknowledged, p99", float(np.percentile(latencies, 99)), 150.0, "ms"),
        at_most("acknowledged, max", float(latencies.max()), 500.0, "ms"),
        at_least("voxels of the map", voxels, 0 if quick else 1_000_000),
        at_most("checkpoint held by the mapper's thread (G8)", cost["hold_ms"], 50.0, "ms"),
        Figure("the first one, in memory that is new", cost["first_hold_ms"], "ms"),
        Figure("checkpoint written in", cost["write_ms"], "ms"),
        Figure("checkpoint", cost["num_bytes"] / 1e6, "MB"),
        Figure("recording 400/s, p99 without and with one", _pair(cost, "p99"), "ms"),
        at_most("the latest message of that, later by", stall, 50.0, "ms"),
        at_most("resume: checkpoint alone (G7)", alone_s, 3.0, "s"),
        at_most("resume: and 6 s of ten robots at 40 Hz", tail_s, 3.0, "s"),
    ]
    report("recorder", "The log, checkpoints, resumes", figures, cost)


def _pair(cost: dict[str, Any], what: str) -> str:
    return f"{cost[f'quiet_{what}']:.1f}, {cost[f'busy_{what}']:.1f}"


if __name__ == "__main__":
    main("--quick" in sys.argv)
