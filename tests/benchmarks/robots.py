"""Real time on the whole machine: one large lidar, and how many line scanners a service holds.

`robots.py [--quick] [lidar] [fleet]`. The service runs with recorder and publisher, viewer off; the
players run on the same cores, and their processor time is stated apart.
"""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import psutil

from benchmarks import buildings
from benchmarks.buildings import LIDAR_130K, LINE_361, PERIOD_NS, Looks
from benchmarks.charts import ratios
from benchmarks.figures import Figure, at_least, name_of, report
from benchmarks.live import SETTLE_S, judge, play, read_log, service, stage_table
from facet.commands.play import RobotPublisher, play_scans
from facet.commands.simulate import envelope_of
from facet.session import client_settings, open_session
from facet.simulate.sensors import pushbroom
from facet.sinks.log_file import write_recording
from facet.sources.naming import is_scan, robot_and_sensor
from facet.sources.recording import Recording
from facet_protocol import topics
from facet_protocol.codec import decode
from facet_protocol.messages import Cut, Envelope, LineFan, Pose
from rig import free_endpoint

STRETCH_S = 8.0
LAPS = 9  # the first explores, the last is measured in a mapped building
LIDAR_LIMIT_MS = 150.0
RATE_HZ, LEAST_ROBOTS = 40, 100
FLEETS = (20, 10, 25, 50, 75, 100, 125, 150, 200)  # the first maps the building
FLEET_S, FLEET_LIMIT_MS = 10.0, 1000.0  # held: nothing lost, and p95 no longer than this
FLEET_DRIVE = 1600  # looks that the robots share, each from a place of its own


def lidar(quick: bool) -> tuple[list[Figure], dict[str, Any]]:
    """130,000 beams at 10 Hz: the same stretch again and again, with other noise each time."""
    laps = 3 if quick else LAPS
    near = buildings.stretch(2.0 if quick else STRETCH_S, **LIDAR_130K)
    folder = Path(tempfile.mkdtemp(prefix="facet-lidar-"))
    try:
        endpoint = free_endpoint()
        with service(endpoint, folder / "log"):
            for lap in range(laps):
                path = folder / f"lap{lap}.mcap"
                _record(path, near, lap)
                play(path, endpoint, 1.0 if lap in (0, laps - 1) else 1.5)
                path.unlink()
        journal = read_log(folder / "log")
    finally:
        shutil.rmtree(folder)
    figures = judge(journal, laps * len(near), LIDAR_LIMIT_MS)
    first, *_, last = journal.laps.values()
    stages = stage_table(journal, last)
    behind_s = (max(at for _, at in first.cuts) - max(first.received.values())) * 1e-9
    figures.append(Figure("exploring: caught up after the last scan, s", behind_s))
    named = [Figure(f"130 k x 10 Hz: {f.what}", f.value, f.target, f.met) for f in figures]
    return named, {"lidar": {"stages_ms": stages, "laps": laps}}


def _record(path: Path, near: Looks, lap: int) -> None:
    def envelopes() -> Iterator[Envelope]:
        for index in range(len(near)):
            scan = near.scan(index, draw=lap)
            stamp = 1_700_000_000_000_000_000 + index * PERIOD_NS
            envelope = envelope_of(scan, "map")
            yield Envelope(
                envelope.key, envelope.schema, envelope.encoding, envelope.payload,
                stamp, 1, index + 1, stamp,
            )  # fmt: skip

    write_recording(path, envelopes(), {}, "none")


@dataclass
class Fleet:
    """One run of a fleet, as the log tells it."""

    robots: int
    played: int
    service_cpu: float  # cores
    player_cpu: float
    received: dict[str, dict[int, int]] = field(default_factory=dict)  # robot: sequence: ns
    cuts: dict[str, list[tuple[int, int]]] = field(default_factory=dict)  # robot: sequence, ns

    def latencies_ms(self) -> np.ndarray[Any, np.dtype[np.float64]]:
        """Of every scan that a cut covers, in the second half of the run."""
        found = [np.zeros(0)]
        for robot, scans in self.received.items():
            ends, times = np.array(sorted(self.cuts.get(robot, [(0, 0)]))).T
            half = self.played // self.robots // 2
            late = np.array([s for s in sorted(scans) if half < s <= ends[-1]], dtype=np.int64)
            stamps = np.array([scans[s] for s in late.tolist()], dtype=np.int64)
            found.append((times[np.searchsorted(ends, late)] - stamps) * 1e-6)
        return np.concatenate(found)

    @property
    def num_received(self) -> int:
        return sum(map(len, self.received.values()))

    @property
    def num_applied(self) -> int:
        return sum(max((s for s, _ in cuts), default=0) for cuts in self.cuts.values())

    @property
    def p95_ms(self) -> float:
        late = self.latencies_ms()
        return float(np.percentile(late, 95)) if len(late) else float("inf")

    @property
    def held(self) -> bool:
        whole = self.num_received == self.num_applied == self.played
        return whole and self.p95_ms <= FLEET_LIMIT_MS

    def __str__(self) -> str:
        return (
            f"{'held' if self.held else 'not held'}: p95 {self.p95_ms:.0f} ms, "
            f"lost {self.played - self.num_applied}, cores: service {self.service_cpu:.2f}, "
            f"players {self.player_cpu:.2f}"
        )


def fleet(quick: bool) -> tuple[list[Figure], dict[str, Any]]:
    """One service; larger and larger fleets until one is not held. The first maps the building."""
    sizes, seconds = ((5, 5, 10), 3.0) if quick else (FLEETS, FLEET_S)
    folder, endpoint = Path(tempfile.mkdtemp(prefix="facet-fleet-")), free_endpoint()
    log, runs = folder / "log", list[Fleet]()
    try:
        with service(endpoint, log) as child:
            for robots in sizes:
                runs.append(_run_fleet(endpoint, child.pid, robots, seconds))
                _read_fleets(log, runs)
                if not runs[-1].held and len(runs) > 1:
                    break
    finally:
        shutil.rmtree(folder)
    figures = [
        Figure(
            f"{run.robots} robots of 361 points x {RATE_HZ} Hz{', exploring' * (not k)}", str(run)
        )
        for k, run in enumerate(runs)
    ]
    most = max((run.robots for run in runs[1:] if run.held), default=0)
    figures.append(at_least(f"robots of 361 points x {RATE_HZ} Hz held", most, LEAST_ROBOTS))
    details = [{"robots": r.robots, "p95_ms": r.p95_ms, "service_cpu": r.service_cpu} for r in runs]
    return figures, {"fleet": details}


def _run_fleet(endpoint: str, service_pid: int, robots: int, seconds: float) -> Fleet:
    number = robots * round(seconds * RATE_HZ)
    command = [sys.executable, __file__, "--player", endpoint, str(robots), str(number)]
    player = subprocess.Popen(command, stdout=subprocess.PIPE, text=True)
    assert player.stdout is not None
    player.stdout.readline()  # it has made its scans
    before, started = _cpu_s(service_pid), time.monotonic()
    played_s = float(player.stdout.readline() or "nan")
    service_cpu = (_cpu_s(service_pid) - before) / (time.monotonic() - started)
    player.wait()
    time.sleep(SETTLE_S)
    return Fleet(robots, number, service_cpu, played_s / seconds)


def _read_fleets(log: Path, runs: list[Fleet]) -> None:
    """Fill the last run: of all epochs in the log, the newest is its own."""
    run, newest = runs[-1], 0
    for envelope in Recording([log]):
        if is_scan(envelope):
            if envelope.epoch > newest:
                newest = envelope.epoch
                run.received, run.cuts = {}, {}
            robot, _ = robot_and_sensor(envelope.key)
            if envelope.epoch == newest:
                run.received.setdefault(robot, {})[envelope.sequence] = envelope.received_ns
        elif envelope.key == topics.CUT_TOPIC:
            cut = decode(envelope)
            if isinstance(cut, Cut) and cut.epoch == newest:
                run.cuts.setdefault(cut.robot, []).append((cut.sequence, envelope.received_ns))


def player(endpoint: str, robots: int, number: int) -> None:
    """Make all scans, say so, publish them at their time, say how much processor time it took."""
    looks = buildings.line(FLEET_DRIVE)
    envelopes = [_line_envelope(looks, k, robots) for k in range(number)]
    print("ready", flush=True)
    started = time.process_time()
    with open_session(client_settings(endpoint, True)) as session:
        publisher = RobotPublisher(session, "map")
        for _ in play_scans(iter(envelopes), publisher, None, 1.0):
            pass
        print(time.process_time() - started, flush=True)
        publisher.close()


def _line_envelope(looks: Looks, k: int, robots: int) -> Envelope:
    """Scan k of all: robot k % robots, each driving from a place of its own."""
    robot, step = k % robots, k // robots
    index = (robot * len(looks) // robots + step) % len(looks)
    rng = np.random.default_rng((robot, step))
    noisy = looks.ranges[index] + rng.normal(0.0, buildings.NOISE.range_m, looks.ranges.shape[1])
    pose = Pose(
        looks.positions[index] + rng.normal(0.0, buildings.NOISE.pose_m, 3),
        looks.orientations[index],
    )
    stamp_ns = 1_700_000_000_000_000_000 + k * 1_000_000_000 // (RATE_HZ * robots)
    angles = pushbroom(**LINE_361).angles  # type: ignore[arg-type]
    fan = LineFan(f"r{robot}", "line", 1, step + 1, stamp_ns, "map", pose, *angles, noisy)
    return envelope_of(fan, "map")


def _cpu_s(pid: int) -> float:
    times = psutil.Process(pid).cpu_times()
    return float(times.user + times.system)


def main(arguments: list[str]) -> None:
    quick = "--quick" in arguments
    sections = {"lidar": lidar, "fleet": fleet}
    figures: list[Figure] = []
    details: dict[str, Any] = {"quick": quick, "load_at_start": os.getloadavg()}
    for name in [a for a in arguments if a != "--quick"] or list(sections):
        own, found = sections[name](quick)
        figures += own
        details |= found
    report(name_of("robots", quick), "Robots in real time", figures, details)
    ratios(name_of("robots", quick), "robots in real time, each figure over its target", figures)


if __name__ == "__main__":
    if sys.argv[1:2] == ["--player"]:
        player(sys.argv[2], int(sys.argv[3]), int(sys.argv[4]))
    else:
        main(sys.argv[1:])
