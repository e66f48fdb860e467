"""What a change reaches: after any update all that is derived is what would be derived at once.

Work follows change, so each rule that says whom a change concerns may forget someone. Compared is
not only what users see, but every stage."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from facet.mapping.blocks import pack_all
from facet.mapping.frozen import freeze, thaw
from facet.mapping.mapper import Mapper
from facet.mapping.settings import TICKS, MapSettings
from facet_protocol.messages import Plane, Scan
from mapping_logs import cloud, mapped

Points = NDArray[np.float64]
VOXEL_M = 0.0625  # a power of two: metres of whole voxels and ticks are exact
SETTINGS = MapSettings(voxel_m=VOXEL_M)


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
    """Of the blocks that hold voxels: their patches and tile-planes, whether they ask far."""
    own, told = mapper._patches.patches, dict[str, object]()
    names = ("votes", "centroid", "scatter", "unit", "box", "rung", "counted")
    for block in np.flatnonzero(mapper._store.blocks.occupied.any(axis=1)).tolist():
        part = slice(int(own.number[block]))
        told[f"block {mapper._store.blocks.keys[block]}"] = (
            bool(own.far[block]),
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
