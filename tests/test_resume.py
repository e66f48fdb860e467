"""Crash and resume: whatever is left of a run, the map goes on as a replay of its log gives it."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable, Iterable
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from facet.checkpoint import Checkpoint, checkpoint_paths, read_checkpoint, write_checkpoint
from facet.commands.replay import replay_log
from facet.config import Config, load_config
from facet.keeper import Keeper
from facet.mapping.mapper import Mapper
from facet.mapping.settings import MapSettings
from facet.outgoing import Outgoing
from facet.pipeline import Pipeline
from facet.resume import (
    Newest,
    Resumed,
    Stopped,
    hold,
    note_newest,
    origin,
    resume,
    save,
    set_aside,
    thaw_checkpoint,
)
from facet.robots import admission_of
from facet.sinks.recorder import LogPosition, Recorder, log_files
from facet.status import Account
from facet_protocol.messages import Envelope, Scan
from rig import room, room_scan, scan_envelope, unnumbered

SETTINGS = MapSettings(voxel_m=0.1)
METADATA = {
    "cuts": "logged",
    "resolved": "logged",
    "map": "map",
    "frame": "map",
    "settings": json.dumps(SETTINGS.as_dict()),
}


def config(folder: Path) -> Config:
    return load_config(None, {"record.directory": folder, "mapping.voxel_m": 0.1})


class Line:
    """The service without its threads: what is committed is applied, what is derived is logged."""

    def __init__(self, folder: Path, resumed: Resumed | None = None, **options: Any) -> None:
        self.folder = folder
        clock = iter(range(10**9, 10**18, 10**9))
        self.recorder = Recorder(folder, "map", METADATA, clock=lambda: next(clock), **options)
        account = Account()
        if resumed is None:
            self.mapper = Mapper(SETTINGS)
            self.admission = admission_of(config(folder), account, SETTINGS.reach_m)
        else:
            self.mapper, self.admission = resumed.mapper, resumed.admission
            self.admission.report_to(account)
        self.pipeline = Pipeline(
            self.mapper, self.admission, account, [self], Outgoing("map", "map")
        )
        self.position: LogPosition | None = None
        self.newest: Newest = {}
        if resumed is not None:
            self.pipeline.take_over(resumed.pipeline)
            self.pipeline.go_live()
            self.position, self.newest = resumed.position, resumed.newest

    def write(self, envelope: Envelope, message: Any) -> None:
        if not isinstance(message, Scan):
            self.recorder.write(envelope)

    def close(self) -> None:
        pass

    def record(self, envelopes: Iterable[Envelope]) -> list[Envelope]:
        """Commit them; they are not applied yet."""
        taken = list(envelopes)
        for envelope in taken:
            self.recorder.write(envelope)
        self.recorder.commit()
        return taken

    def apply(self, envelopes: Iterable[Envelope]) -> None:
        taken = list(envelopes)
        self.pipeline.insert(*taken)
        for envelope in taken:
            note_newest(self.newest, envelope)
        self.position = self.recorder.position

    def scans(self, *envelopes: Envelope) -> None:
        self.apply(self.record(envelopes))
        self.pipeline.update()

    def checkpoint(self) -> Path:
        assert self.position is not None
        held = hold(self.mapper, self.admission, config(self.folder), self.position, self.newest)
        self.recorder.commit()  # the cut of the last update
        return save(self.folder, held)[0]


def told(mapper: Mapper) -> tuple[Any, ...]:
    """All that a client sees of a map."""
    planes = mapper.snapshot().changed
    return mapper.digest(), mapper.revision, [(p.id, p.revision, p.num_points) for p in planes]


def resumed_from(folder: Path) -> Resumed:
    """Resumed, and what was left of the log without a cut derived."""
    resumed = resume(config(folder), Mapper(SETTINGS))
    if resumed.pipeline.is_stale:
        resumed.pipeline.update()
    return resumed


def replayed(folder: Path) -> tuple[Any, ...]:
    return told(replay_log([folder], Config()).mapper)


def test_nothing_there_is_a_new_map(tmp_path: Path) -> None:
    mapper = Mapper(SETTINGS)
    resumed = resume(config(tmp_path), mapper)
    assert resumed.mapper is mapper
    assert resumed.position is None
    assert resumed.num_scans == 0


def test_a_checkpoint_and_the_tail_of_the_log(tmp_path: Path) -> None:
    """The tail lies in the middle of a file, whose channels were defined before it."""
    line, scans = Line(tmp_path), room(12)
    for k in range(0, 6, 2):
        line.scans(*scans[k : k + 2])
    line.checkpoint()
    for k in range(6, 12, 2):
        line.scans(*scans[k : k + 2])
    line.recorder.commit()  # and then the process is killed
    resumed = resumed_from(tmp_path)
    assert resumed.checkpoint is not None
    assert resumed.num_scans == 6
    assert told(resumed.mapper) == replayed(tmp_path) == told(line.mapper)
    assert resumed.newest == {"r1/lidar": (5, 12)}


def test_without_a_checkpoint_all_of_the_log(tmp_path: Path) -> None:
    line = Line(tmp_path)
    for scan in room(5):
        line.scans(scan)
    line.recorder.commit()
    resumed = resumed_from(tmp_path)
    assert resumed.checkpoint is None
    assert resumed.num_scans == 5
    assert told(resumed.mapper) == replayed(tmp_path) == told(line.mapper)


def test_killed_at_any_step_the_map_goes_on_and_so_do_its_ids(tmp_path: Path) -> None:
    """Every step of a run may be its last, also of the run that resumed; the log may roll."""
    scans = [e for pair in zip(room(9), room(9, "r2"), strict=True) for e in pair]
    line = Line(tmp_path / "log", max_file_bytes=300_000)

    def crash() -> None:
        nonlocal line
        shutil.rmtree(tmp_path / "copy", ignore_errors=True)
        shutil.copytree(tmp_path / "log", tmp_path / "copy")
        assert told(resumed_from(tmp_path / "copy").mapper) == replayed(tmp_path / "copy")

    for k in range(0, 18, 3):
        taken = line.record(scans[k : k + 3])
        crash()
        line.apply(taken)
        line.pipeline.update()
        if k in (3, 9, 12):
            line.checkpoint()
            crash()
        if k == 9:
            resumed = resume(config(tmp_path / "log"), Mapper(SETTINGS))
            line = Line(tmp_path / "log", resumed, max_file_bytes=300_000)
            if line.pipeline.is_stale:
                line.pipeline.update()
        line.recorder.commit()
        crash()
    assert len(log_files(tmp_path / "log", "map")) > 2
    assert line.mapper.counts().scans == 18


def test_scans_left_without_a_cut_are_cut_by_the_next_run(tmp_path: Path) -> None:
    line, scans = Line(tmp_path), room(6)
    line.scans(*scans[:2])
    line.record(scans[2:4])  # durable, and then the process is killed
    resumed = resume(config(tmp_path), Mapper(SETTINGS))
    assert resumed.pipeline.is_stale
    again = Line(tmp_path, resumed)
    again.pipeline.update()
    again.scans(*scans[4:])
    again.recorder.close()
    assert told(again.mapper) == replayed(tmp_path)


@pytest.mark.parametrize("number", [True, False])
def test_what_came_before_the_crash_is_a_duplicate_after_it(tmp_path: Path, number: bool) -> None:
    scans = room(4) if number else [unnumbered(e) for e in room(4)]
    line = Line(tmp_path)
    line.scans(*scans[:3])
    line.checkpoint()
    line.recorder.close()
    again = Line(tmp_path, resume(config(tmp_path), Mapper(SETTINGS)))
    again.scans(*scans)
    assert again.mapper.counts().scans == 4
    again.recorder.close()
    assert told(again.mapper) == replayed(tmp_path)


def two_checkpoints(folder: Path) -> Line:
    line = Line(folder)
    for scan in room(4):
        line.scans(scan)
        if scan.sequence in (2, 3):
            line.checkpoint()
    line.recorder.commit()
    return line


def damage(path: Path) -> None:
    data = bytearray(path.read_bytes())
    data[len(data) // 2] ^= 1
    path.write_bytes(data)


def other_header(path: Path, **changes: Any) -> None:
    old = read_checkpoint(path)
    write_checkpoint(path, path.with_suffix(".old"), Checkpoint(old.header | changes, old.arrays))
    path.with_suffix(".old").unlink()


def no_arrays(path: Path) -> None:
    write_checkpoint(path, path.with_suffix(".old"), Checkpoint(read_checkpoint(path).header, {}))
    path.with_suffix(".old").unlink()


SPOILED: dict[str, Callable[[Path], object]] = {
    "missing": Path.unlink,
    "empty": lambda path: path.write_bytes(b""),
    "cut": lambda path: path.write_bytes(path.read_bytes()[:-100]),
    "flipped": damage,
    "other settings": lambda path: other_header(path, origin="0" * 64),
    "no log": lambda path: other_header(path, log={}),
    "no arrays": no_arrays,
    "a folder": lambda path: (path.unlink(), path.mkdir()),
}


@pytest.mark.parametrize("how", SPOILED)
def test_a_spoiled_checkpoint_is_not_used(tmp_path: Path, how: str) -> None:
    line = two_checkpoints(tmp_path)
    newest, previous = checkpoint_paths(tmp_path, "map")
    SPOILED[how](newest)
    resumed = resumed_from(tmp_path)
    assert resumed.checkpoint == previous
    assert told(resumed.mapper) == replayed(tmp_path) == told(line.mapper)
    SPOILED[how](previous)
    resumed = resumed_from(tmp_path)
    assert resumed.checkpoint is None
    assert told(resumed.mapper) == told(line.mapper)


@pytest.mark.parametrize("other", [{"theta_deg": 10.0}, {"voxel_m": 0.25}])
def test_other_settings_are_applied_to_all_of_the_log(
    tmp_path: Path, other: dict[str, float], caplog: pytest.LogCaptureFixture
) -> None:
    two_checkpoints(tmp_path)
    settings = replace(SETTINGS, **other)
    resumed = resume(config(tmp_path), Mapper(settings))
    assert caplog.text.count("with other settings") == 2
    assert resumed.checkpoint is None
    assert resumed.num_scans == 4
    assert resumed.mapper.settings == settings


def test_a_log_that_is_no_longer_what_it_was_is_read_from_the_start(tmp_path: Path) -> None:
    line = Line(tmp_path, max_file_bytes=60_000)
    for scan in room(4):
        line.scans(scan)
    line.checkpoint()
    line.recorder.close()
    first, *_, last = log_files(tmp_path, "map")
    assert first != last
    first.unlink()
    resumed = resumed_from(tmp_path)
    assert resumed.checkpoint is None
    assert told(resumed.mapper) == replayed(tmp_path)
    line.checkpoint()
    last.write_bytes(last.read_bytes()[:-3000])
    assert resumed_from(tmp_path).checkpoint is None


def test_other_files_in_the_folder_are_not_this_maps(tmp_path: Path) -> None:
    line = Line(tmp_path)
    line.scans(*room(2))
    line.recorder.close()
    (tmp_path / "notes.mcap").write_bytes(b"not a log")
    (log,) = log_files(tmp_path, "map")
    shutil.copy(log, tmp_path / log.name.replace("map-", "map-2-"))
    assert log_files(tmp_path, "map") == [log]
    assert told(resumed_from(tmp_path).mapper) == told(line.mapper)


def test_a_stop_leaves_the_log_and_no_map(tmp_path: Path) -> None:
    two_checkpoints(tmp_path)
    with pytest.raises(Stopped):
        resume(config(tmp_path), Mapper(SETTINGS), lambda: True)


def test_set_aside(tmp_path: Path) -> None:
    assert set_aside(tmp_path, "map") is None
    two_checkpoints(tmp_path)
    (tmp_path / "other.mcap").touch()
    folder = set_aside(tmp_path, "map")
    assert folder is not None
    assert sorted(p.name for p in tmp_path.iterdir()) == sorted([folder.name, "other.mcap"])
    assert len(list(folder.iterdir())) == 3
    assert resume(config(tmp_path), Mapper(SETTINGS)).num_scans == 0


def test_a_checkpoint_is_the_map(tmp_path: Path) -> None:
    line = Line(tmp_path)
    line.scans(*room(3))
    path = line.checkpoint()
    checkpoint, mapper = thaw_checkpoint(path)
    assert told(mapper) == told(line.mapper)
    assert checkpoint.header["revision"] == 1
    first = path.read_bytes()
    line.checkpoint()
    assert path.read_bytes() == first


class Clock:
    now = 0.0

    def __call__(self) -> float:
        return self.now


def test_the_keeper_saves_now_and_then(tmp_path: Path) -> None:
    line, account, clock = Line(tmp_path), Account(), Clock()
    line.scans(*room(1))
    keeper = Keeper(config(tmp_path).record, account, lambda timeout_s: True, clock)
    assert not keeper.is_due()
    clock.now = 61.0
    assert keeper.is_due()
    assert line.position is not None
    path, num_bytes = keeper.save(
        hold(line.mapper, line.admission, config(tmp_path), line.position, line.newest)
    )
    assert path.stat().st_size == num_bytes
    assert account["checkpoints"] == 1
    assert not keeper.is_due()


def test_a_checkpoint_that_cannot_be_written_is_counted(tmp_path: Path) -> None:
    line, account = Line(tmp_path), Account()
    line.scans(scan_envelope(room_scan(1)))

    class Full:
        @staticmethod
        def open(*args: Any) -> int:
            raise OSError(28, "No space left on device")

    assert line.position is not None
    keeper = Keeper(config(tmp_path).record, account, lambda timeout_s: True, system=Full)
    with pytest.raises(OSError, match="No space"):
        keeper.save(hold(line.mapper, line.admission, config(tmp_path), line.position, line.newest))
    assert account["checkpoint_failed"] == 1
    assert not list(tmp_path.glob("*checkpoint*"))


def test_no_checkpoint_is_ahead_of_its_log(tmp_path: Path) -> None:
    """The cut of its update comes first: else a replay would cut elsewhere, and name otherwise."""
    line, account = Line(tmp_path), Account()
    line.scans(*room(1))
    assert line.position is not None
    keeper = Keeper(config(tmp_path).record, account, lambda timeout_s: False)
    with pytest.raises(OSError, match="not being written"):
        keeper.save(hold(line.mapper, line.admission, config(tmp_path), line.position, line.newest))
    assert not list(tmp_path.glob("*checkpoint*"))


def test_rules_for_robots_are_part_of_where_a_map_comes_from(tmp_path: Path) -> None:
    """Another rule may give a scan another pose: a checkpoint made without it is not used."""
    line = Line(tmp_path)
    line.scans(*room(2))
    line.checkpoint()
    line.recorder.commit()
    rules = {"robots.rules": [{"key": "amcl_pose", "frame": "base_link"}]}
    other = load_config(None, {"record.directory": tmp_path, "mapping.voxel_m": 0.1, **rules})
    assert origin(SETTINGS, other) != origin(SETTINGS, config(tmp_path))
    assert resume(config(tmp_path), Mapper(SETTINGS)).checkpoint is not None
    assert resume(other, Mapper(SETTINGS)).checkpoint is None
