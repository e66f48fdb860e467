"""What the fault tests share: the line from a message to the map, with its log and its account."""

from __future__ import annotations

import itertools
import logging
from collections.abc import Iterable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from foxglove_schemas_protobuf.PointCloud_pb2 import PointCloud

from facet.admission import Admission
from facet.mapping.digest import state_digest
from facet.mapping.mapper import Mapper
from facet.mapping.settings import MapSettings
from facet.outgoing import Outgoing
from facet.pipeline import Pipeline
from facet.sinks.recorder import Recorder
from facet.sources.naming import is_scan, source_of
from facet.sources.recording import Recording
from facet.status import Account
from facet_protocol.messages import Envelope, Scan
from rig import room_scan, scan_envelope

SETTINGS = MapSettings(voxel_m=0.1)
SOURCE = "r1/lidar"


class Line:
    """Everything behind the door, in one thread: recorded first, then applied."""

    def __init__(self, folder: Path, max_file_bytes: int = 1 << 30, **options: Any) -> None:
        """`options` of the admission."""
        self.account, self.mapper = Account(), Mapper(SETTINGS)
        self._folder = folder
        clock = itertools.count(10**18, 10**6)  # files are named by it
        self._recorder = Recorder(
            folder, "map", {}, max_file_bytes=max_file_bytes, clock=lambda: next(clock)
        )
        self.admission = Admission(self.account, "map", SETTINGS.reach_m, **options)
        self._pipeline = Pipeline(
            self.mapper,
            self.admission,
            self.account,
            [self],
            Outgoing("map", "map"),
        )

    def write(self, envelope: Envelope, message: object) -> None:
        """What the pipeline says of itself goes into the log too."""
        if not isinstance(message, Scan):
            self._recorder.write(envelope)

    def close(self) -> None:
        """Nothing: the log stays open."""

    def take(self, envelopes: Iterable[Envelope]) -> Line:
        for envelope in envelopes:
            self._recorder.write(envelope)
            self.account.arrive(source_of(envelope))
            self._pipeline.insert(envelope)
            balance = self.account.balance()
            assert balance.is_exact, f"out of balance: {balance}"
        self._recorder.commit()
        return self

    def update(self) -> None:
        """Derive what is stale."""
        self._pipeline.update()

    def finish(self) -> None:
        """No message will come any more."""
        self._pipeline.finish()

    def state(self) -> str:
        return state_digest(self.mapper._store, self.mapper._free)

    def log(self) -> list[Envelope]:
        return list(Recording([self._folder]))

    def recorded(self) -> list[bytes]:
        """What came in, as the log has it."""
        return [bytes(e.payload) for e in self.log() if not e.key.startswith("/facet/")]

    def num_points(self) -> int:
        """Points that the voxels hold."""
        store = self.mapper._store
        return int(store.num_points(store.occupied_rows()).sum())


def small_scan(sequence: int, robot: str = "r1", num: int = 300) -> Scan:
    scan = room_scan(sequence, robot)
    return replace(scan, points=scan.points[:: len(scan.points) // num][:num])


def envelopes(robot: str, *sequences: int) -> list[Envelope]:
    return [scan_envelope(small_scan(k, robot)) for k in sequences]


def around(bad: Iterable[Envelope]) -> list[Envelope]:
    """Two robots at work, and `bad` in the middle."""
    before = [*envelopes("r1", 1), *envelopes("r2", 1)]
    return [*before, *bad, *envelopes("r1", 10), *envelopes("r2", 2)]


def changed(change: object, sequence: int = 5) -> Envelope:
    """A scan whose protobuf message `change` has spoiled."""
    good = scan_envelope(small_scan(sequence))
    message = PointCloud.FromString(bytes(good.payload))
    change(message)  # type: ignore[operator]
    return replace(good, payload=message.SerializeToString())


def with_rows(rows: list[list[float]], sequence: int = 5) -> Scan:
    """A scan with these points (sensor frame) besides its own."""
    scan = small_scan(sequence)
    extra = np.array(rows, np.float64).astype(np.float32)
    return replace(scan, points=np.concatenate([scan.points[:200], extra, scan.points[200:]]))


def lines(caplog: pytest.LogCaptureFixture, reason: str) -> list[str]:
    """What was said in the log about this reason and source."""
    wanted = f"{SOURCE}: {reason}: "
    return [r.getMessage() for r in caplog.records if r.getMessage().startswith(wanted)]


def left_out(
    folder: Path,
    caplog: pytest.LogCaptureFixture,
    bad: list[Envelope],
    reason: str,
    **options: Any,
) -> Line:
    """Promise C: counted once each, said once, recorded all the same, no trace in the map, and the
    other source goes on."""
    clean = Line(folder / "clean", **options).take(around([]))
    with caplog.at_level(logging.INFO):
        spoiled = Line(folder / "spoiled", **options).take(around(bad))
    account = spoiled.account
    assert account[f"rejected.{reason}[{SOURCE}]"] == account[f"rejected.{reason}"] == len(bad)
    assert account.balance().rejected == len(bad)
    assert len(lines(caplog, reason)) == 1, caplog.messages
    assert spoiled.state() == clean.state()
    assert [bytes(e.payload) for e in around(bad)] == spoiled.recorded()
    for name in ("r1/lidar", "r2/lidar"):
        assert account[f"applied[{name}]"] == clean.account[f"applied[{name}]"] == 2
    assert account.balance().in_flight == 0
    return spoiled


def scans_in(folder: Path) -> list[Envelope]:
    """What a folder's logs hold by now; none while there is no log."""
    if not list(folder.glob("*.mcap")):
        return []
    return [e for e in Recording([folder]) if is_scan(e)]
