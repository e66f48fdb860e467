"""What a change reaches: after any update all that is derived is what would be derived at once.

Work follows change, so each rule that says whom a change concerns may forget someone. Compared is
not only what users see, but every stage, and with the limits of rare paths set low."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from facet.mapping import claims, normals, patches, pivot, rungs, runs, store, traces
from facet.mapping.blocks import pack_all
from facet.mapping.frozen import freeze, thaw
from facet.mapping.mapper import Mapper
from facet.mapping.settings import TICKS, MapSettings
from facet_protocol.maps import encode_update
from facet_protocol.messages import Plane, Scan, ScanKind
from facet_protocol.mirror import MapMirror
from mapping_logs import cloud, mapped

Points = NDArray[np.float64]
VOXEL_M = 0.0625  # a power of two: metres of whole voxels and ticks are exact
SETTINGS = MapSettings(voxel_m=VOXEL_M)
RARE = (  # limits below which a path is not taken, and what they are set to
    (store, "NOTED", 50),
    (patches, "FEW", 1),
    (rungs, "FEW", 1),
    (claims, "FEW", 1),
    (pivot, "FEW", 1),
    (normals, "SHARES", 3),
    (traces, "ENTRIES", 13),
    (traces, "MOST_KEPT", 3),
    (runs, "SHARES", 3),
)


def grid(*axes: Points | list[float]) -> Points:
    """All points of three axes, voxels."""
    return np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3).astype(float)


def twice(low: float, high: float, step: float = 0.5) -> Points:
    """Places along an axis, two a voxel."""
    return np.arange(low, high, step) + step / 2.0


def seen(voxels: Points, at: tuple[float, float, float], sequence: int = 1) -> Scan:
    """A scan of points in voxels, from a place in voxels."""
    return cloud(voxels * VOXEL_M, at=[c * VOXEL_M for c in at], sequence=sequence)


# what a mapper holds, under names that do not depend on the order in which it came


def voxels_of(mapper: Mapper) -> dict[str, NDArray[Any]]:
    """Columns of the occupied voxels, by ascending key."""
    own = mapper._store
    rows = own.occupied_rows()
    keys = pack_all(own.voxel_keys(rows))
    rows = rows[np.argsort(keys)]
    columns = {name: c[rows] for name, c in mapper._normals.normals._asdict().items()}
    for name in ("member", "label", "second"):
        columns[name] = getattr(mapper._patches.patches, name)[rows]
    return {"key": np.sort(keys), "observable": own.columns.observable[rows], **columns}


def patches_of(mapper: Mapper) -> dict[str, object]:
    """Of the blocks that hold voxels: their patches and tile-planes."""
    own, told = mapper._patches.patches, dict[str, object]()
    names = ("votes", "centroid", "scatter", "unit", "box", "rung", "counted")
    for block in np.flatnonzero(mapper._store.blocks.occupied.any(axis=1)).tolist():
        part = slice(int(own.number[block]))
        told[f"block {mapper._store.blocks.keys[block]}"] = (
            *(getattr(own, name)[block, part].tobytes() for name in names),
            mapper._tiles.plane_of_patch[block, part].tobytes(),
        )
    return told


def tiles_of(mapper: Mapper) -> dict[str, object]:
    """Of the tiles that hold tile-planes all that is kept, voxels by their keys."""
    told = dict[str, object]()
    for key, tile in mapper._tiles.tiles.items():
        if not tile.num_planes:
            continue
        own = (*tile.nodes, tile.points, tile.total, tile.planes, tile.occupation, tile.corner)
        rows = pack_all(mapper._store.voxel_keys(tile.rows))
        told[f"tile {key}"] = [c.tobytes() for c in (*own, tile.starts, tile.pairs, rows)]
    return told


def contours_of(mapper: Mapper) -> list[object]:
    """Of the planes, in canonical order: frame, cells and edges."""
    table, label = mapper._table, mapper._planes.label
    none = [np.zeros(0, np.int64)]
    ids = np.concatenate(none + [mapper._tiles.tiles[k].ids for k in table.tile_keys.tolist()])
    told: list[object] = []
    for plane in range(len(mapper._planes.occupation)):
        contour = mapper._contours.contours[int(ids[label == plane][0])]
        cells = {at: (c.places.tobytes(), c.words.tobytes()) for at, c in contour.cells.items()}
        edges = {at: e.tobytes() for at, e in contour.edges.items() if len(e)}
        told.append((contour.rounded, cells, edges))
    return told


def plane_bytes(plane: Plane) -> bytes:
    """Everything of a plane but its history: ids, revision, who saw it when."""
    surfaces = [replace(s, id=0) for s in plane.surfaces]
    surfaces.sort(key=lambda s: (s.outer.tobytes(), s.area_m2))
    bare = replace(
        plane, id=0, revision=0, surfaces=tuple(surfaces), first_seen_ns=0, last_seen_ns=0,
        robots=(),
    )  # fmt: skip
    arrays = (plane.normal, plane.covariance, plane.centroid, *vars_of(plane.frame))
    return repr(bare).encode() + b"".join(a.tobytes() for a in arrays)


def vars_of(frame: Any) -> tuple[Points, ...]:
    return frame.axis_u, frame.axis_v, frame.axis_n


def check_same(mapper: Mapper, anew: Mapper) -> None:
    """All that is derived is equal to the bit."""
    one, two = voxels_of(mapper), voxels_of(anew)
    for name, column in two.items():
        assert np.array_equal(one[name], column), f"{name} of voxels"
    for of in (patches_of, tiles_of):
        told, expected = of(mapper), of(anew)
        wrong = [k for k in told.keys() | expected.keys() if told.get(k) != expected.get(k)]
        assert not wrong, f"{sorted(wrong)[0]} is not what it would be"
    assert np.array_equal(mapper._patches.histogram, anew._patches.histogram)
    assert np.array_equal(mapper._planes.label, anew._planes.label)
    kept, made = mapper._bends._kept.sums, anew._bends._kept.sums
    known = (kept[:, 0] >= 0) & (made[:, 0] >= 0)
    assert np.array_equal(kept[known], made[known]), "sums of strips"
    assert contours_of(mapper) == contours_of(anew), "contours"
    shown = (sorted(map(plane_bytes, m.snapshot().changed)) for m in (mapper, anew))
    assert next(shown) == next(shown), "planes"
    assert (mapper.counts(), mapper.report()) == (anew.counts(), anew.report())
    assert mapper.digest() == anew.digest()


# holes that were there


def test_a_threshold_is_told_of_the_other_jamb_with_nothing_between() -> None:
    """The voxels of a doorsill belong to the wall, too, once its other side is seen: two blocks on,
    and no voxel of the gap."""
    floor = grid(twice(-24, 8), twice(-16, 16), [0.4])
    left = grid(twice(-24, 0), [4.4], twice(0, 24))
    right = seen(grid(twice(16, 40), [4.4], twice(0, 24)), (0.0, -40.0, 20.0), 2)
    first = seen(np.concatenate([floor, left]), (0.0, -40.0, 20.0))
    one, both = mapped([first], SETTINGS), mapped([first, right], SETTINGS)
    on_sill = (voxels_of(m)["second"][:, None] >= 0 for m in (one, both))
    assert int(next(on_sill).sum()) < int(next(on_sill).sum())
    mapper = mapped([first, right], SETTINGS, every=1)
    check_same(mapper, both)
    mapper.retract(right)
    mapper.update()
    check_same(mapper, one)


def test_tiles_that_lost_their_planes_freeze_and_thaw() -> None:
    wall = seen(grid([2.4], twice(0, 20), twice(0, 20)), (30.0, 10.0, 10.0))
    mapper = mapped([wall], SETTINGS)
    assert len(mapper.snapshot().changed) == 1
    mapper.retract(wall)
    mapper.update()
    other = thaw(freeze(mapper), SETTINGS, mapper.map_id)
    assert other.digest() == mapper.digest() == Mapper(SETTINGS).digest()


def along(step: int) -> Scan:
    """A floor with eight points a voxel, `step` ticks before and behind the middle along x."""
    ends = [(x * step, y * 256, z * 64) for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)]
    middle = grid(twice(16, 32, 1.0), twice(16, 32, 1.0), [20.5])
    points = middle[:, None] + (np.array(ends) + 0.5) / TICKS
    return seen(points.reshape(-1, 3), (0.0, 0.0, 64.0))


def test_a_plane_whose_covariance_alone_changed_is_told() -> None:
    """Points that move within their voxels leave a plane where it was, to the bit, but not how
    well its tilt is known."""
    narrow, wide = along(64), along(384)
    mapper, expected = mapped([narrow], SETTINGS), mapped([wide], SETTINGS)
    mapper.retract(narrow)
    mapper.insert(wide)
    assert len(mapper.update().changed) == 1
    check_same(mapper, expected)


def test_tiles_that_show_voxels_of_a_plane_beyond_theirs_are_told_when_it_goes() -> None:
    """A voxel beyond the tile of the plane it goes with is shown by its own tile."""
    panel = grid([10.4], twice(57, 64, 0.25), twice(4, 11, 0.25))
    stray = [[10.4, 66.3, 8.3]]  # one point, so that it has no normal of its own
    mapper = mapped([seen(np.concatenate([panel, stray]), (40.0, 50.0, 8.0))], SETTINGS)
    assert [p.plane_ids.tolist() for p in mapper.points([(0, 1, 0)])] == [[1]]
    mapper.insert(seen(grid(twice(200, 280), twice(200, 280), [3.4]), (220.0, 220.0, 40.0), 2))
    assert [stone.plane_id for stone in mapper.update().retired] == [1]  # too little, now
    assert [p.plane_ids.tolist() for p in mapper.points([(0, 1, 0)])] == [[0]]
    assert {(0, 0, 0), (0, 1, 0)} <= set(mapper.changed_tiles)


def sheet(rng: np.random.Generator, low: int, high: int, wide: int, pitch: list[int]) -> Points:
    """A piece of the sheet x = 0, from `low` to `high` along y: rows of points so far apart."""
    along, up = np.arange(low, high, pitch[0]), np.arange(0, wide, pitch[1])
    points = grid([0.4], along + 0.5, up + 0.5)
    return np.repeat(points, rng.integers(1, 4), axis=0)


def turned(points: Points, way: int) -> Points:
    """Along other axes, and there not upright."""
    if way == 3:  # slanted
        return points @ np.array([[0.8, 0.6, 0.0], [-0.6, 0.8, 0.0], [0.0, 0.0, 1.0]])
    return np.roll(points, way, axis=1)


def pieces(rng: np.random.Generator) -> list[Scan]:
    """Sheets over several tiles in pieces, thin or dense, with gaps, from either side; what meets
    them at an angle; some points here and there."""
    wide, pitch = int(rng.integers(3, 40)), [int(rng.integers(1, 9)), int(rng.integers(1, 9))]
    corner = 64.0 * rng.integers(-2, 2, 3) + rng.choice([0.0, 0.0, 0.5, 60.0])
    way, steps, scans = int(rng.integers(4)), list[tuple[int, int]](), list[Scan]()
    for tile in range(3):
        first, last = 64 * tile + rng.integers(0, 9), 64 * tile + rng.integers(48, 65)
        middle = int(rng.integers(first, last))
        ends = [(first, last)] if rng.random() < 0.5 else [(first, middle), (middle + 6, last)]
        steps.extend((int(low), int(high)) for low, high in ends)
    for low, high in steps:
        points = sheet(rng, low, high, wide, pitch)
        kind = rng.random()
        if kind < 0.3:  # the same rows in a corner or on a step
            points = np.concatenate([points, (points - [0, low, 0])[:, [1, 0, 2]] + [0, low, 0]])
        elif kind < 0.4:
            points = points + rng.normal(size=points.shape) * 0.2
        side = 60.0 if rng.random() < 0.8 else -60.0
        places = turned(np.concatenate([points, [[side, 60.0, 10.0]]]), way) + corner
        some = places[rng.permutation(len(places) - 1)[:1500]]
        scans.append(seen(some, tuple(places[-1]), len(scans) + 1))
    stray = rng.integers(-20, 150, (3, 3)) * [0.02, 1.0, 0.2]
    scans.append(seen(turned(stray, way) + corner, tuple(corner + 60.0), 10))
    return [replace(s, kind=ScanKind.LINE) if rng.random() < 0.1 else s for s in scans]


def shown(mapper: Mapper) -> dict[tuple[int, int, int], tuple[bytes, bytes]]:
    told = (p for p in mapper.points() if len(p.plane_ids))
    return {p.tile: (p.centroids.tobytes(), p.plane_ids.tobytes()) for p in told}


def scans_come_and_go(seed: int) -> None:
    """After every update a map is that of its scans, its messages fold to it, and it says which
    tiles to show again; at the end it comes back from what was frozen."""
    rng = np.random.default_rng(seed)
    few = replace(SETTINGS, min_area_m2=0.1, min_surface_m2=0.02)
    scans, there, mirror, mapper = pieces(rng), set[int](), MapMirror(), Mapper(few)
    before = shown(mapper)
    for number in (*rng.permutation(len(scans)), *rng.integers(0, len(scans), 4)):
        (mapper.retract if number in there else mapper.insert)(scans[number])
        there ^= {int(number)}
        if rng.random() < 0.2:
            continue
        assert mirror.apply(mapper.update())
        assert encode_update(mirror.snapshot()) == encode_update(mapper.snapshot())
        check_same(mapper, mapped([scans[k] for k in sorted(there)], few))
        after, told = shown(mapper), set(mapper.changed_tiles)
        assert {t for t in before.keys() | after if after.get(t) != before.get(t)} <= told
        before = after
    mapper.update()
    other = thaw(freeze(mapper), few, mapper.map_id)
    assert encode_update(other.snapshot()) == encode_update(mapper.snapshot())
    assert other.digest() == mapper.digest()


@pytest.mark.parametrize("seed", range(8))
def test_scans_that_come_and_go_leave_what_they_would_at_once(seed: int) -> None:
    scans_come_and_go(seed)


@pytest.mark.parametrize("seed", range(100, 108))
def test_so_they_do_on_rare_paths(seed: int, monkeypatch: pytest.MonkeyPatch) -> None:
    for module, name, limit in RARE:
        monkeypatch.setattr(module, name, limit)
    scans_come_and_go(seed)


@pytest.mark.parametrize("noted", [0, store.NOTED])
@pytest.mark.parametrize(("first", "last", "up"), [(66.5, 54.0, 8.0), (69.5, 51.0, 4.0)])
def test_normals_that_turn_far_from_what_was_touched_are_summed_again(
    noted: int, first: float, last: float, up: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A thin wall goes on beyond a gap: in the next tile its border is none any more, no more."""
    monkeypatch.setattr(store, "NOTED", noted)
    rows = np.arange(4.5, 4.0 + 3.3 * up, up)
    wall = seen(grid([10.4], np.arange(first, 120.0, 5.0), rows), (60.0, 60.0, 10.0))
    more = seen(grid([10.4], np.arange(last - 0.5, 0.0, -5.0), rows), (60.0, 60.0, 10.0), 2)
    mapper = mapped([wall], SETTINGS)
    borders = mapper._normals.normals.border.sum()
    mapper.insert(more)
    mapper.update()
    assert mapper._normals.normals.border[: mapper._store.num_rows].sum() != borders
    check_same(mapper, mapped([wall, more], SETTINGS))
