"""An update's work follows what changed, not the size of the map (design 3.9)."""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest

from facet.mapping.mapper import Mapper
from facet.mapping.settings import MapSettings
from facet.simulate import Noise, Simulation, simulate
from facet_protocol.messages import Scan
from mapping_logs import log
from scenes import room, small

EVERY = 5  # scans an update


@cache
def drive_along() -> tuple[Scan, ...]:
    """One way through the corridor with an upright line scanner: the map grows at one end."""
    return tuple(simulate("corridor", "pushbroom", num_scans=360))


def works(mapper: Mapper, scans: tuple[Scan, ...]) -> list[dict[str, int]]:
    """Work counters of an update after each EVERY scans."""
    told = []
    for number, scan in enumerate(scans, start=1):
        mapper.insert(scan)
        if number % EVERY == 0:
            mapper.update()
            told.append(mapper.work)
    return told


@cache
def grown() -> tuple[Mapper, list[dict[str, int]]]:
    mapper = Mapper(MapSettings(voxel_m=0.1))
    return mapper, works(mapper, drive_along())


def sizes(mapper: Mapper) -> dict[str, int]:
    """How much there is of what the counters count."""
    tiles = mapper.points()
    blocks = {(p.tile, *row) for p in tiles for row in (p.centroids // 64).tolist()}
    contours = mapper._contours.contours.values()
    return {
        "stale_voxels": mapper.counts().voxels,
        "blocks_regrouped": len(blocks),
        "blocks_relabelled": len(blocks),
        "tiles_changed": len(tiles),
        "outline_tiles": sum(len(c.cells) for c in contours),
    }


def checks_late_work(mapper: Mapper, told: list[dict[str, int]]) -> None:
    """In the last quarter of a drive the middle update touches little of the map."""
    whole, late = sizes(mapper), told[-len(told) // 4 :]
    shares = {n: float(np.median([w[n] for w in late])) / max(1, whole[n]) for n in whole}
    limits = {
        "stale_voxels": 0.10,
        "blocks_regrouped": 0.10,
        "blocks_relabelled": 0.12,
        "tiles_changed": 0.50,
        "outline_tiles": 0.50,
    }
    for name, limit in limits.items():
        assert shares[name] <= limit, f"{name}: {shares[name]:.2f} of the map at every update"


def test_a_late_update_touches_little_of_the_map() -> None:
    mapper, told = grown()
    checks_late_work(mapper, told)
    mapper.check_invariants()


def test_the_work_of_an_update_does_not_grow_with_the_map() -> None:
    _, told = grown()
    quarter = len(told) // 4
    for name in ("stale_voxels", "blocks_regrouped", "blocks_relabelled", "tiles_changed"):
        early = np.median([w[name] for w in told[quarter : 2 * quarter]])
        late = np.median([w[name] for w in told[-quarter:]])
        assert late <= 1.5 * early + 3, f"{name}: {early} early, {late} late"


def test_only_what_was_touched_is_dirty_and_stale_lies_round_it() -> None:
    for work in grown()[1]:
        assert work["dirty_voxels"] <= work["touched_voxels"]
        assert work["dirty_voxels"] <= work["stale_voxels"]


def test_the_same_scan_again_and_again_settles_to_nothing() -> None:
    scan = log("room-lidar3d").scans[0]
    mapper = Mapper()
    told = works(mapper, (scan,) * (6 * EVERY))
    assert told[0]["dirty_voxels"] > 1000
    quiet = ("dirty_voxels", "stale_voxels", "blocks_regrouped", "tiles_changed")
    assert [told[-1][name] for name in quiet] == [0, 0, 0, 0]
    assert told[-1]["outline_tiles"] <= 4  # a fit with more points may round to another frame
    assert told[-1]["touched_voxels"] > 1000
    mapper.check_invariants()


def test_a_robot_that_stands_still_soon_costs_little() -> None:
    """One more point flips a voxel's observable with p about 4/n: dirty voxels fade as 1/n."""
    mapper, told = Mapper(), []
    noise = Noise(range_m=0.012, pose_m=0.0)
    for seed in range(60):
        still = Simulation(room(), small("depth"), seed=seed, noise=noise, num_scans=40)
        mapper.insert(still.message(still.look(3)))
        if seed % EVERY == EVERY - 1:
            mapper.update()
            told.append(mapper.work["dirty_voxels"])
    assert told[-1] < 0.35 * told[2], f"dirty voxels by update: {told}"
    mapper.check_invariants()


@pytest.mark.parametrize("name", ["stale_voxels", "tiles_changed", "outline_tiles"])
def test_work_is_counted_at_all(name: str) -> None:
    """A counter that is always nothing would pass every limit."""
    assert min(w[name] for w in grown()[1]) > 0
