"""The running service under a robot in real time: what is dropped, and how old the map is.

A simulated lidar (10 Hz, 32,000 beams a scan) is played by one process into another, which records
and publishes. Latency of a scan: from its receipt to the update that contains it, both by the log:
the time of its record, and that of the first cut at or behind it. The first lap explores; slow ones
follow, played fast, until the building is mapped; the last one is timed again.
"""

from __future__ import annotations

import os
import shutil
import signal
import subprocess
import sys
import tempfile
import threading
import time
from collections import deque
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.figures import Figure, at_least, at_most, report
from facet.commands.terminal import out
from facet.sources.naming import is_scan
from facet.sources.recording import Recording
from facet_protocol import topics
from facet_protocol.codec import decode
from facet_protocol.messages import Cut, Status
from rig import free_endpoint

STRETCH_M = 15.0
LAPS = (  # how fast the robot drives the same stretch, m/s, and how fast that is played
    (1.0, 1.0),
    *((0.3, 2.5) for _ in range(4)),
    (0.5, 1.0),
)
RIPE = 200  # points a voxel, from which on the building counts as mapped
LIMIT_MS = 300.0
START_S = 120.0  # for kernels that were never compiled
SETTLE_S = 2.0


@dataclass
class Lap:
    """One play of a recording, as the log tells it."""

    received: dict[int, int] = field(default_factory=dict)  # ns, by sequence
    cuts: list[tuple[int, int]] = field(default_factory=list)  # (last sequence, ns)

    def latencies_ms(self) -> np.ndarray[Any, np.dtype[np.float64]]:
        """(N,) of the scans that a cut covers."""
        ends, times = np.array(sorted(self.cuts)).reshape(-1, 2).T
        sequences = np.array(sorted(s for s in self.received if len(ends) and s <= ends[-1]))
        covering = np.searchsorted(ends, sequences)
        received = np.array([self.received[s] for s in sequences.tolist()])
        return (times[covering] - received) * 1e-6

    @property
    def seconds(self) -> float:
        return (max(self.received.values()) - min(self.received.values())) * 1e-9

    @property
    def applied(self) -> int:
        return max((end for end, _ in self.cuts), default=0)


@dataclass
class Journal:
    """What the service's own log says of the whole run."""

    laps: dict[int, Lap] = field(default_factory=dict)  # by epoch, in order of time
    statuses: list[tuple[int, Status]] = field(default_factory=list)


def facet(*arguments: object) -> list[str]:
    return [sys.executable, "-m", "facet", *map(str, arguments)]


def simulate_laps(folder: Path, laps: tuple[tuple[float, float], ...]) -> list[Path]:
    """The same drive with other noise each time; two at a time."""
    paths = [folder / f"lap{k}.mcap" for k in range(len(laps))]
    waiting = [
        facet(
            *("simulate", path, "--sensor", "lidar3d", "--seed", k),
            *("--speed", mps, "--duration", STRETCH_M / mps),
        )
        for k, (path, (mps, _)) in enumerate(zip(paths, laps, strict=True))
    ]
    for pair in (waiting[k : k + 2] for k in range(0, len(waiting), 2)):
        children = [subprocess.Popen(command, stdout=subprocess.DEVNULL) for command in pair]
        for child in children:
            if child.wait() != 0:
                raise RuntimeError("the simulation failed")
    return paths


@contextmanager
def service(endpoint: str, log: Path) -> Iterator[subprocess.Popen[str]]:
    """`facet run` with recorder and publisher, ready; must end cleanly."""
    command = facet("run", "--listen", endpoint, "--record", log, "--viewer", "off")
    child = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True)
    lines: deque[str] = deque(maxlen=100)
    try:
        assert child.stderr is not None
        deadline = time.monotonic() + START_S
        while "ready" not in child.stderr.readline():
            if child.poll() is not None or time.monotonic() > deadline:
                raise RuntimeError("the service did not start")
        said = threading.Thread(target=lines.extend, args=(child.stderr,), daemon=True)
        said.start()  # a pipe that nobody reads is soon full
        yield child
    finally:
        child.send_signal(signal.SIGTERM)
        child.wait(timeout=30)
    if child.returncode != 0:
        rest = "".join(lines)
        out.print(f"the service ended with {child.returncode}:\n{rest}", markup=False)


def play(path: Path, endpoint: str, speed: float | str) -> None:
    command = facet("play", path, "--connect", endpoint, "--speed", speed)
    subprocess.run(command, check=True, stdout=subprocess.DEVNULL)
    time.sleep(SETTLE_S)


def read_log(log: Path) -> Journal:
    """Scans are not decoded."""
    journal = Journal()
    for envelope in Recording([log]):
        if is_scan(envelope):
            lap = journal.laps.setdefault(envelope.epoch, Lap())
            lap.received[envelope.sequence] = envelope.received_ns
        elif envelope.key == topics.CUT_TOPIC:
            cut = decode(envelope)
            if isinstance(cut, Cut):
                lap = journal.laps.setdefault(cut.epoch, Lap())
                lap.cuts.append((cut.sequence, envelope.received_ns))
        elif envelope.key == topics.STATUS_TOPIC:
            status = decode(envelope)
            if isinstance(status, Status):
                journal.statuses.append((envelope.received_ns, status))
    return journal


def stage_table(journal: Journal, lap: Lap) -> dict[str, list[float]]:
    """p50 and p95, ms, of each stage, as the status at 1 Hz sampled them during a lap."""
    start, end = min(lap.received.values()), max(lap.received.values())
    sampled = [s for at, s in journal.statuses if start < at < end]
    stages: dict[str, list[float]] = {}
    for status in sampled:
        gauges = {k: v for k, v in status.gauges.items() if k in ("update_ms", "commit_ms")}
        for name, ms in {**status.stage_ms, **gauges}.items():
            stages.setdefault(name, []).append(ms)
    return {k: np.percentile(v, [50, 95]).round(1).tolist() for k, v in stages.items()}


def ripeness(journal: Journal, lap: Lap) -> float:
    """Points a voxel as the lap begins, a mean over the map."""
    start = min(lap.received.values())
    before = [s for at, s in journal.statuses if at <= start]
    if not before or not before[-1].gauges.get("voxels"):
        return 0.0
    return before[-1].counters.get("points_stored", 0) / before[-1].gauges["voxels"]


def judge(journal: Journal, num_played: int, limit_ms: float = LIMIT_MS) -> list[Figure]:
    last = journal.statuses[-1][1].counters
    applied = sum(lap.applied for lap in journal.laps.values())
    received = sum(len(lap.received) for lap in journal.laps.values())
    shed = sum(n for k, n in last.items() if k.startswith("shed") and "[" not in k)
    first, *_, mapped = journal.laps.values()
    figures = [
        at_most("scans dropped before the log", num_played - received, 0),
        at_most("scans dropped after it", received - applied, 0),
        at_most("lost upstream or shed", last.get("lost_upstream", 0) + shed, 0),
    ]
    for name, lap in (("exploring", first), ("mapped", mapped)):
        ms = lap.latencies_ms()
        p50, p95, p99 = np.percentile(ms, [50, 95, 99]).tolist()
        limited = at_most(f"{name}: latency p95", p95, limit_ms, "ms")
        figures += [
            Figure(f"{name}: scans", len(ms)),
            Figure(f"{name}: updates a second", len(lap.cuts) / lap.seconds),
            Figure(f"{name}: latency p50, ms", p50),
            limited if name == "mapped" else Figure(f"{name}: latency p95, ms", p95),
            Figure(f"{name}: latency p99, ms", p99),
            Figure(f"{name}: latency max, ms", float(ms.max())),
        ]
        stages = stage_table(journal, lap)
        text = ", ".join(f"{k} {p50:.0f}" for k, (p50, _) in stages.items() if p50 >= 1.0)
        figures.append(Figure(f"{name}: stages, p50 ms", text))
    figures.append(at_least("mapped: points a voxel before", ripeness(journal, mapped), RIPE))
    figures.append(Figure("resident memory, MB", journal.statuses[-1][1].gauges["rss_mb"]))
    return figures


def main(arguments: list[str]) -> None:
    """`live.py [--quick]`."""
    laps_driven = LAPS[:1] + LAPS[-1:] if "--quick" in arguments else LAPS
    folder = Path(tempfile.mkdtemp(prefix="facet-live-"))
    try:
        paths = simulate_laps(folder, laps_driven)
        num_scans = [sum(map(is_scan, Recording([path]))) for path in paths]
        endpoint, started = free_endpoint(), os.getloadavg()
        with service(endpoint, folder / "log"):
            for path, (_, speed) in zip(paths, laps_driven, strict=True):
                play(path, endpoint, speed)
        journal = read_log(folder / "log")
        figures = judge(journal, sum(num_scans))
        laps = list(journal.laps.values())
        details = {
            "stages_ms": {
                n: stage_table(journal, laps[k]) for n, k in (("first", 0), ("last", -1))
            },
            "latency_ms": [lap.latencies_ms().round(1).tolist() for lap in (laps[0], laps[-1])],
            "load_at_start": started,
        }
        report("live", "A robot in real time: 10 Hz, 32,000 beams", figures, details)
    finally:
        shutil.rmtree(folder)


if __name__ == "__main__":
    main(sys.argv[1:])
