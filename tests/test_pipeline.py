"""The pipeline with a mapper that only counts: who is told what, in which order."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from examples import plane
from facet.admission import Admission
from facet.outgoing import Outgoing
from facet.pipeline import Pipeline, Stopwatch
from facet.status import Account
from facet_protocol import topics
from facet_protocol.messages import Cut, Envelope, MapUpdate, Scan, TilePoints
from rig import room


class CountingMapper:
    """A mapper whose map is the number of its scans."""

    def __init__(self) -> None:
        self.scans: list[Scan] = []
        self.revision = 0
        self.changed_tiles: list[tuple[int, int, int]] = []
        self.restless: list[tuple[int, int, int]] = []  # tiles that change with every update

    def insert_all(self, scans: Sequence[Scan]) -> list[Any]:
        self.scans += scans
        nan = {"nan": 1}
        return [SimpleNamespace(points_stored=len(s.points) - 1, rejected=nan) for s in scans]

    def update(self, timer: Any) -> MapUpdate:
        timer("normals")
        self.revision += 1
        self.changed_tiles = self.restless or [(self.revision, 0, 0)]
        stamp_ns = self.scans[-1].stamp_ns
        return MapUpdate("map", self.revision, self.revision - 1, stamp_ns, (plane(3),), (), ())

    def points(self, tiles: list[tuple[int, int, int]]) -> list[TilePoints]:
        none = np.zeros((0, 3), np.uint16)
        return [TilePoints(tile, 0.05, none, np.zeros(0, np.int32)) for tile in tiles]


class Notebook:
    """A sink that keeps everything."""

    def __init__(self) -> None:
        self.entries: list[tuple[Envelope, Any]] = []

    def write(self, envelope: Envelope, message: Any) -> None:
        self.entries.append((envelope, message))

    def close(self) -> None:
        pass

    def topics(self) -> list[str]:
        return [envelope.key for envelope, _ in self.entries]

    def of(self, kind: type) -> list[Any]:
        return [message for _, message in self.entries if isinstance(message, kind)]


class Rig:
    def __init__(self, points_every_ns: int = 0) -> None:
        self.mapper, self.notebook, self.account = CountingMapper(), Notebook(), Account()
        self.pipeline = Pipeline(
            self.mapper,  # type: ignore[arg-type]
            Admission(self.account, "map", 8.0),
            self.account,
            [self.notebook],
            Outgoing("map", "map"),
            points_every_ns,
        )


def test_a_scan_then_its_cut_then_the_update() -> None:
    rig = Rig()
    scan = room(1)[0]
    assert rig.pipeline.insert(scan)
    update = rig.pipeline.update()
    assert rig.notebook.topics() == [
        scan.key,
        topics.CUT_TOPIC,
        topics.UPDATE_TOPIC,
        topics.SCENE_TOPIC,
        topics.pose_topic("r1"),
        topics.TF_TOPIC,
    ]
    assert rig.pipeline.revision == update.revision == 1


def test_a_cut_names_the_last_scan_of_every_source() -> None:
    rig = Rig()
    for envelope in [*room(3), *room(2, "r2")]:
        rig.pipeline.insert(envelope)
    rig.pipeline.update()
    rig.pipeline.insert(replace(room(4)[3]))
    rig.pipeline.update()
    cuts = [(c.revision, c.robot, c.sequence, c.num_scans) for c in rig.notebook.of(Cut)]
    assert cuts == [(1, "r1", 3, 3), (1, "r2", 2, 2), (2, "r1", 4, 1), (2, "r2", 2, 0)]


def test_what_is_left_out_is_no_ones_update() -> None:
    rig = Rig()
    good = room(1)[0]
    assert not rig.pipeline.insert(replace(good, payload=b"x"))
    assert not rig.pipeline.is_stale
    assert rig.pipeline.insert(good)
    assert not rig.pipeline.insert(good)
    assert rig.account["duplicate"] == 1
    assert rig.pipeline.is_stale
    assert len(rig.mapper.scans) == 1


def test_every_point_is_accounted_for() -> None:
    rig = Rig()
    for envelope in room(2):
        rig.pipeline.insert(envelope)
    account = rig.account
    assert account["points_in"] == account["points_stored"] + account["points_rejected.nan"] == 9000
    assert account["applied"] == account["applied[r1/lidar]"] == 2


def test_points_are_sent_now_and_then_and_at_the_end() -> None:
    rig = Rig(points_every_ns=10_000_000_000)
    for envelope in room(5):  # 0.1 s apart
        rig.pipeline.insert(envelope)
        rig.pipeline.update()
    assert len(rig.notebook.of(TilePoints)) < 5
    rig.pipeline.finish()
    assert sorted(tile.tile[0] for tile in rig.notebook.of(TilePoints)) == [1, 2, 3, 4, 5]


def test_points_of_many_tiles_are_not_all_sent_with_one_update() -> None:
    rig = Rig(points_every_ns=1_000_000_000)
    tiles = rig.mapper.restless = [(x, y, 0) for x in range(8) for y in range(8)]
    told = []
    for envelope in room(30):  # 0.1 s apart
        rig.pipeline.insert(envelope)
        before = len(rig.notebook.of(TilePoints))
        rig.pipeline.update()
        told.append([t.tile for t in rig.notebook.of(TilePoints)[before:]])
    counts = [len(own) for own in told[1:]]
    assert 0 < min(counts) <= max(counts) < len(tiles) // 3
    for second in (told[5:15], told[15:25]):
        assert sorted(tile for own in second for tile in own) == tiles, "once a period each"


def test_two_runs_say_the_same_bytes() -> None:
    def said() -> list[tuple[str, bytes, int]]:
        rig = Rig()
        for envelope in room(3):
            rig.pipeline.insert(envelope)
            rig.pipeline.update()
        rig.pipeline.finish()
        return [(e.key, bytes(e.payload), e.received_ns) for e, _ in rig.notebook.entries]

    assert said() == said()


def test_a_fault_of_the_mapper_is_not_hidden(monkeypatch: pytest.MonkeyPatch) -> None:
    rig = Rig()

    def fail(scans: Sequence[Scan]) -> Any:
        raise AssertionError("an invariant")

    monkeypatch.setattr(rig.mapper, "insert_all", fail)
    with pytest.raises(AssertionError, match="an invariant"):
        rig.pipeline.insert(room(1)[0])


def test_stopwatch() -> None:
    clock = iter([1.0, 1.5, 1.75]).__next__
    stopwatch = Stopwatch(clock)
    stopwatch("normals")
    stopwatch("planes")
    assert stopwatch.stage_ms == {"normals": 500.0, "planes": 250.0}
