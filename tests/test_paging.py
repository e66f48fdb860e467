"""Bounded memory: what goes to the disk comes back unchanged, and the process holds no more."""

from __future__ import annotations

import errno
import json
import os
import resource
import subprocess
import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from facet.commands.settings import make_mapper
from facet.config import ConfigError, load_config
from facet.mapping.frozen import freeze, thaw
from facet.mapping.mapper import Mapper
from facet.mapping.memory import Heap, Memory
from facet.paging import MIB, PagedMemory, resident_bytes
from facet_protocol.maps import encode_update
from facet_protocol.messages import Pose, Scan
from mapping_logs import log, mapped

ROOM = "room-lidar3d"


def always(folder: Path) -> PagedMemory:
    """Memory that gives everything back after every update."""
    return PagedMemory(folder, 0)


def shared_bytes() -> int:
    """Pages of files that are in memory."""
    return int(Path("/proc/self/statm").read_text().split()[2]) * resource.getpagesize()


@pytest.mark.parametrize("make", [lambda _: Heap(), always], ids=["plain", "paged"])
@pytest.mark.parametrize("rows", [10, 100_000])
def test_a_column_grows(make: Callable[[Path], Memory], rows: int, tmp_path: Path) -> None:
    memory, content = make(tmp_path), np.arange(3 * rows, dtype=np.int32).reshape(rows, 3)
    column = memory.grown(np.zeros((0, 3), np.int32), 0, rows)
    assert column.shape == (rows, 3)
    assert not column.any()
    column[:] = content
    memory.rest()
    for used in (rows, rows // 2, 1):
        column = memory.grown(column, used, 2 * len(column))
        memory.rest()
        np.testing.assert_array_equal(column[:used], content[:used])
        assert not column[used:].any()
    assert not memory.grown(column, 0, len(column)).any()


@pytest.mark.parametrize("name", [ROOM, "room-pushbroom"])
def test_what_comes_back_is_unchanged(
    name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Every column in files, every page given back after every update: the same updates."""
    monkeypatch.setattr("facet.paging.SMALLEST", 1)
    whole = log(name)
    plain = Mapper(whole.settings)
    paged = Mapper(whole.settings, memory=always(tmp_path))
    for scan in whole.scans:
        updates = []
        for mapper in (plain, paged):
            mapper.insert(scan)
            updates.append(encode_update(mapper.update()))
        assert updates[0] == updates[1]
    memory = paged.memory
    assert isinstance(memory, PagedMemory)
    assert memory.times_given_back == len(whole.scans)
    assert memory.file_bytes > 100 * plain.counts().voxels
    again = thaw(freeze(paged), whole.settings, "map", memory)
    for mapper in (plain, paged, again):
        mapper.retract(whole.scans[2])
        mapper.update()
        assert mapper.digest() == plain.digest()
    paged.check_invariants()
    assert list(tmp_path.iterdir()) == []  # files without a name: a crash leaves nothing behind


def elsewhere(scan: Scan, room: int) -> Scan:
    position = scan.pose.position + np.array([20.0 * room, 0.0, 0.0])
    return replace(scan, pose=Pose(position, scan.pose.orientation_xyzw))


def explored(mapper: Mapper, after_each: Callable[[], object] = lambda: None) -> Mapper:
    """Room after room."""
    for room in range(8):
        for scan in log(ROOM).scans[:4]:
            mapper.insert(elsewhere(scan, room))
            mapper.update()
            after_each()
    return mapper


def explore(folder: Path) -> None:
    """What a process of its own says of its memory: (it holds in all, of it columns) after each
    update, the bound, how often it gave back, voxels, digest."""
    whole, held = log(ROOM), []
    mapped(whole.scans[:1], whole.settings)  # compiled loops are loaded
    before, bound = shared_bytes(), resident_bytes() + 24 * MIB
    memory = PagedMemory(folder, bound)
    mapper = Mapper(whole.settings, memory=memory)
    explored(mapper, lambda: held.append((resident_bytes(), shared_bytes() - before)))
    said = (held, bound, memory.times_given_back, mapper.counts().voxels, str(mapper.digest()))
    print(json.dumps(said))  # noqa: T201 to the test that started it


def test_exploring_keeps_the_columns_within_the_bound(tmp_path: Path) -> None:
    """After each update the process holds less than the bound, or of the columns nothing; and the
    map is that of plain memory. In a process that holds nothing else: what earlier tests leave may
    go back to the system at any time."""
    plain = explored(Mapper(log(ROOM).settings))  # and what the other has to load is compiled
    program = "import sys, pathlib, test_paging; test_paging.explore(pathlib.Path(sys.argv[1]))"
    command = [sys.executable, "-c", program, str(tmp_path)]
    child = subprocess.run(command, cwd=Path(__file__).parent, capture_output=True, text=True)
    assert child.returncode == 0, child.stderr
    held, bound, times_given_back, voxels, digest = json.loads(child.stdout)
    assert digest == str(plain.digest())
    assert len(held) == 32
    assert all(resident <= bound or columns < 2 * MIB for resident, columns in held)
    assert times_given_back > 0
    assert max(columns for _, columns in held) < 18 * MIB < 130 * voxels


def test_a_full_disk_leaves_the_map_in_memory(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setattr("facet.paging.SMALLEST", 1)
    whole, reserve, times = log(ROOM), os.posix_fallocate, iter(range(10**6))

    def full(*told: Any) -> None:
        if next(times) > 30:
            raise OSError(errno.ENOSPC, "no room")
        reserve(*told)

    monkeypatch.setattr(os, "posix_fallocate", full)
    plain, paged = Mapper(whole.settings), Mapper(whole.settings, memory=always(tmp_path))
    for mapper in (plain, paged):
        for scan in whole.scans:
            mapper.insert(scan)
            mapper.update()
    assert paged.digest() == plain.digest()
    assert "stays in memory" in caplog.text


def test_the_bound_is_a_setting_of_the_service(tmp_path: Path) -> None:
    told = {"memory.max_ram_mb": 600, "record.directory": str(tmp_path)}
    assert isinstance(make_mapper(load_config(None, told)).memory, PagedMemory)
    assert isinstance(make_mapper(load_config()).memory, Heap)
    with pytest.raises(ConfigError, match=r"max_ram_mb = 3.*>= 512"):
        load_config(None, {"memory.max_ram_mb": 3})
