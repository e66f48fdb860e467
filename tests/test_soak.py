"""Long runs (G10): ten robots drive the same floor again and again. Memory, threads, files and
bytes a message stay what they were after the first lap."""

from __future__ import annotations

import ctypes
import gc
import itertools
import logging
import os
import shutil
import sys
import threading
import time
from collections.abc import Iterable, Iterator
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import psutil
import pytest
from foxglove_schemas_protobuf.LaserScan_pb2 import LaserScan

from facet.sources.naming import is_scan, source_of
from facet.sources.recording import Recording
from facet.warmup import warm_up
from facet_protocol.messages import Envelope
from facet_protocol.topics import scan_key
from fault_rig import SETTINGS, Line
from rig import START_NS

LAP = Path(__file__).parents[1] / "recordings" / "office-pushbroom.mcap"
ROBOTS, RATE_HZ = 10, 40
FILE_BYTES = 32 << 20  # a file's index is kept until it is finished: files that are soon full
PROCESS = psutil.Process()


def lap() -> list[bytes]:
    """The scans of one drive, without their stamps: each time they are new."""
    payloads = []
    for envelope in filter(is_scan, Recording([LAP])):
        message = LaserScan.FromString(bytes(envelope.payload))
        message.ClearField("timestamp")
        payloads.append(message.SerializeToString())
    return payloads


def drives(payloads: list[bytes], seconds: int) -> Iterator[list[Envelope]]:
    """What ten robots send in so many seconds of their driving, each a tenth of a lap behind the
    one before, for ever."""
    behind = len(payloads) // ROBOTS
    batch: list[Envelope] = []
    for step in itertools.count():
        stamp_ns = START_NS + step * 10**9 // RATE_HZ
        for robot in range(ROBOTS):
            payload = payloads[(step + robot * behind) % len(payloads)]
            key = scan_key("map", f"r{robot}", "line")
            batch.append(
                Envelope(
                    key, "foxglove.LaserScan", "protobuf", payload, stamp_ns, 5, step + 1, stamp_ns
                )
            )
        if len(batch) >= seconds * ROBOTS * RATE_HZ:
            yield batch
            batch = []


class Fleet(Line):
    """A line that asks for its balance once a batch: what it has counted grows with the robots, and
    adding it up after each scan takes longer than the scan."""

    def take(self, envelopes: Iterable[Envelope]) -> Line:
        for envelope in envelopes:
            self._recorder.write(envelope)
            self.account.arrive(source_of(envelope))
            self._pipeline.insert(envelope)
        self._recorder.commit()
        assert self.account.balance().is_exact
        return self


@dataclass(frozen=True)
class Mark:
    """How things stood after so much driving."""

    robot_hours: float
    rss_mib: float
    threads: int
    files: int
    bytes_a_message: float


def settle() -> None:
    """Give back what is free: what the allocator keeps for later comes and goes by megabytes."""
    gc.collect()
    with suppress(AttributeError):  # of glibc
        ctypes.CDLL(None).malloc_trim(0)


def mark(line: Line, folder: Path, num: int) -> Mark:
    settle()
    return Mark(
        robot_hours=num / RATE_HZ / 3600.0,
        rss_mib=PROCESS.memory_info().rss / 2**20,
        threads=threading.active_count(),
        files=sum(not path.endswith(".mcap") for path in open_files()),  # a log comes and goes
        bytes_a_message=sum(p.stat().st_size for p in folder.glob("*.mcap")) / num,
    )


def open_files() -> Iterator[str]:
    for fd in os.listdir("/proc/self/fd"):
        with suppress(OSError):
            yield os.readlink(f"/proc/self/fd/{fd}")


def soak(
    folder: Path,
    robot_hours: float,
    payloads: list[bytes],
    laps_between: float = 0.5,
    seconds_between: int = 1,
) -> list[Mark]:
    """Drive, with an update every few seconds of it; after the first lap a mark at every half lap,
    at the same places of the floor."""
    line, marks, num = Fleet(folder, FILE_BYTES), list[Mark](), 0
    every = int(laps_between * len(payloads)) * ROBOTS
    for batch in drives(payloads, seconds_between):
        line.take(batch)
        line.update()
        num += len(batch)
        if num >= len(payloads) * ROBOTS and num // every > (num - len(batch)) // every:
            marks.append(mark(line, folder, num))
            if marks[-1].robot_hours >= robot_hours:
                break
    assert line.account.balance().is_exact
    assert line.account["applied"] == line.account["received"] == num
    assert line.num_points() == line.account["points_stored"]  # P5
    return marks


def slope(marks: list[Mark]) -> float:
    """MiB a robot-hour: the median of all slopes between two marks (Theil-Sen)."""
    pairs = itertools.combinations(marks, 2)
    return float(
        np.median([(b.rss_mib - a.rss_mib) / (b.robot_hours - a.robot_hours) for a, b in pairs])
    )


def checks(marks: list[Mark]) -> None:
    first, last = marks[0], marks[-1]
    assert last.threads == first.threads
    assert last.files == first.files
    assert last.bytes_a_message == pytest.approx(first.bytes_a_message, rel=0.01)


def test_g10_a_few_laps(tmp_path: Path) -> None:
    """Too short for a slope, long enough for a leak of some hundred bytes a scan."""
    marks = soak(tmp_path, 0.1, lap()[::3])
    checks(marks)
    assert marks[-1].rss_mib - marks[1].rss_mib < 4.0


@pytest.mark.slow
def test_g10_four_robot_hours(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], caplog: pytest.LogCaptureFixture
) -> None:
    """In four minutes: of processor time, all threads together, which others' work on the machine
    stretches less than the clock's."""
    caplog.set_level(logging.CRITICAL)  # what is said is kept for the report, and looks like a leak
    warm_up(SETTINGS)  # as `facet run` does: a loop that is first needed hours later is no leak
    started, spent = time.monotonic(), time.process_time()
    marks = soak(tmp_path, 4.0, lap(), laps_between=1.0, seconds_between=3)
    wall_s, processor_s = time.monotonic() - started, time.process_time() - spent
    with capsys.disabled():
        said = f"{marks[-1].robot_hours:.2f} robot-hours in {wall_s:.0f} s"
        said += f" ({processor_s:.0f} s of the processor)"
        figures = f"{slope(marks):+.3f} MiB a robot-hour, {marks[-1].rss_mib:.0f} MiB"
        sys.stdout.write(f"\nG10: {said}, {figures}\n")
    checks(marks)
    assert slope(marks) <= 0.1
    assert processor_s <= 240.0
    shutil.rmtree(tmp_path)
