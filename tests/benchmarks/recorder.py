"""The log and what is kept of the map beside it: acknowledgements, checkpoints, resumes.

Acknowledgement: from a robot's `put` in this process, over Zenoh on loopback, to the line by which
the service in another says that the message is durable; ten robots at 40 Hz. What fdatasync takes
beside it, in a thread of this process on the same disk, says how much of that is the disk's.

A checkpoint of a million voxels is held and written while another thread records 400 messages a
second: how much later they are acknowledged by that. A resume: that checkpoint, and the log of six
seconds after it.
"""

from __future__ import annotations

import json
import logging
import os
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
from facet_protocol.messages import Pose, Scan, ScanKind
from rig import room_scan
from test_acknowledged import MESSAGE_S, acknowledged
from test_kills import NUM_ROBOTS, small_scans

SIDE_M = 10.0  # of the floor that one scan covers
POINTS = 200_000  # of such a scan: five a voxel
COMMIT_S = 0.05
TAIL_SCANS = 2400  # six seconds of ten robots at 40 Hz: as 60 s are to ten million voxels


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
    with tempfile.TemporaryDirectory() as name:
        latencies, disk = acknowledged(Path(name), 6.0 if quick else 30.0)
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
        Figure("what the disk took by itself meanwhile, p50, p99, max", _three(disk), "ms"),
        Figure("processes that wanted the cores (load of a minute)", os.getloadavg()[0]),
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


def _three(ms: NDArray[np.float64]) -> str:
    return f"{np.median(ms):.1f}, {np.percentile(ms, 99):.1f}, {ms.max():.1f}"


def _pair(cost: dict[str, Any], what: str) -> str:
    return f"{cost[f'quiet_{what}']:.1f}, {cost[f'busy_{what}']:.1f}"


if __name__ == "__main__":
    main("--quick" in sys.argv)
