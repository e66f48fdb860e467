"""A robot that stands still, or drives the same loop, makes no array of the map grow."""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Iterator
from dataclasses import fields, is_dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from facet.mapping.mapper import Mapper
from facet.mapping.memory import SMALL, Heap
from facet_protocol.messages import Scan
from mapping_logs import log


def arrays(thing: Any) -> Iterator[NDArray[Any]]:
    """Every array that hangs on something of ours."""
    if isinstance(thing, np.ndarray):
        yield thing
    elif isinstance(thing, dict):
        yield from arrays(list(thing.values()))
    elif isinstance(thing, (list, tuple)):
        for part in thing:
            yield from arrays(part)
    elif is_dataclass(thing) and not isinstance(thing, type):
        yield from arrays([getattr(thing, f.name) for f in fields(thing)])
    elif type(thing).__module__.startswith("facet.mapping"):
        yield from arrays(getattr(thing, "__dict__", {}))


def held_bytes(mapper: Mapper) -> int:
    """Bytes of all arrays, each once."""
    return sum({id(a): a.nbytes for a in arrays(mapper)}.values())


def column_bytes(mapper: Mapper) -> list[int]:
    """Bytes of what is kept of every voxel, block and cell."""
    parts = (mapper._store, mapper._free, mapper._normals, mapper._patches)
    return [sum(a.nbytes for a in arrays(part)) for part in parts]


SHIFTS = 1.02  # a small plane that comes and goes has an outline of some kilobytes


def noisy(scan: Scan, seed: int) -> Scan:
    """The scan of a robot that stands, a millimetre off here and there."""
    noise = np.random.default_rng(seed).uniform(-1e-3, 1e-3, scan.points.shape)
    return replace(scan, points=(scan.points + noise).astype(scan.points.dtype))


def after(mapper: Mapper, scans: list[Scan]) -> int:
    for scan in scans:
        mapper.insert(scan)
        mapper.update()
    return held_bytes(mapper)


def test_the_same_scan_again_and_again_grows_nothing() -> None:
    whole = log("room-lidar3d")
    mapper = Mapper(whole.settings)
    first, columns = after(mapper, [whole.scans[0]] * 5), column_bytes(mapper)
    rows, blocks = mapper._store.num_rows, mapper._store.num_blocks
    assert first > 100 * rows
    last = after(mapper, [whole.scans[0]] * 80)
    assert (mapper._store.num_rows, mapper._store.num_blocks) == (rows, blocks)
    assert column_bytes(mapper) == columns
    assert last < SHIFTS * first


def test_a_standing_robot_grows_nothing() -> None:
    """Its points find their last new voxels soon."""
    whole = log("room-lidar3d")
    mapper = Mapper(whole.settings)
    scans = [noisy(whole.scans[0], seed) for seed in range(90)]
    after(mapper, scans[:1])
    rows = [mapper._store.num_rows]
    first, columns = after(mapper, scans[1:40]), column_bytes(mapper)
    rows.append(mapper._store.num_rows)
    last = after(mapper, scans[40:])
    rows.append(mapper._store.num_rows)
    assert rows[2] - rows[1] < (rows[1] - rows[0]) / 10
    assert column_bytes(mapper) == columns
    assert last < SHIFTS * first


def test_the_same_loop_again_and_again_grows_nothing() -> None:
    whole = log("room-lidar3d")
    mapper, loop = Mapper(whole.settings), list(whole.scans)
    first, rows = after(mapper, loop + loop), mapper._store.num_rows
    columns = column_bytes(mapper)
    last = after(mapper, 4 * loop)
    assert mapper._store.num_rows == rows
    assert column_bytes(mapper) == columns
    assert last < SHIFTS * first


def test_a_large_column_grows_where_it_is() -> None:
    """To copy it would hold up an update; what is behind it is zero, whatever was there."""
    memory = Heap(reserve=16)
    first = memory.grown(np.zeros(0, np.int64), 0, SMALL // 8)
    first[:] = 7
    grown = memory.grown(first, len(first) - 9, 4 * len(first))
    assert np.shares_memory(first, grown)
    assert grown[: len(first) - 9].all()
    assert not grown[len(first) - 9 :].any()
    copy = memory.grown(grown, len(first) - 9, 16 * len(first) + 1)
    assert not np.shares_memory(grown, copy)
    assert np.array_equal(copy[: len(grown)], grown)
    assert not copy[len(grown) :].any()


GROWS = """
import gc
from benchmarks import buildings, growth, inside
from facet.mapping import memory
from facet.mapping.mapper import Mapper

memory.LARGE_PAGES = "MADV_NOHUGEPAGE"
mapper, looks = Mapper(), buildings.office(100)
sources, rows = growth.all_copies(looks), []
mapper._normals._traces.entries[...] = 0  # bounded: all of it from the start
for mark in (500_000, 1_000_000, 1_500_000, 2_000_000):
    growth.grow(mapper, mark, looks, sources)
    mapper.update()
    gc.collect()
    rows.append((inside.num_voxels(mapper), inside.rss_bytes() - inside.free_bytes(mapper)))
print(*(n for row in rows for n in row))
"""


@pytest.mark.skipif(sys.platform != "linux", reason="resident memory is read from /proc")
def test_a_voxel_takes_no_more_than_160_bytes() -> None:
    """All derived, free space apart; a process of its own, which nothing else has filled.

    Without huge pages: which of the large arrays the system rounds up to these, and when, differs
    from run to run by 30 MB, whatever the map holds."""
    child = subprocess.run(
        [sys.executable, "-c", GROWS],
        cwd=Path(__file__).parent,
        env={**os.environ, "NUMPY_MADVISE_HUGEPAGE": "0"},
        capture_output=True,
        text=True,
    )
    assert child.returncode == 0, child.stderr
    voxels, resident = np.array(child.stdout.split(), float).reshape(-1, 2).T
    assert np.polyfit(voxels, resident, 1)[0] <= 160.0
