"""What must hold of any map at any time, checked from the map alone (style 7.5, I1 to I7).

Slow: one whole derivation from the integers. For tests and for the curious, not for the line."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from facet.mapping.blocks import CENTRE, find, pack_all, unpack, unpack_all
from facet.mapping.digest import derived_digest, model_planes
from facet.mapping.kernel import kernel
from facet.mapping.normals import EMPTY, VALID
from facet.mapping.observable import observe
from facet.mapping.planes import FREE
from facet.mapping.quantise import VIEW
from facet.mapping.settings import BLOCK, TICKS
from facet.mapping.store import VoxelStore
from facet.mapping.sums import TOUCHED
from facet_protocol.messages import Plane

if TYPE_CHECKING:
    from facet.mapping.mapper import Mapper

_AROUND = np.stack(np.meshgrid(*[[-1, 0, 1]] * 3, indexing="ij"), -1).reshape(-1, 3)[:, ::-1]
_ON_PLANE_M = 1e-4  # a lifted vertex is no farther from its plane


def check_invariants(mapper: Mapper) -> None:
    """Raise AssertionError, with what is wrong, unless all holds.

    What is derived is checked as of the last update, so only while no scan waits for the next."""
    store = mapper._store
    check_blocks(store)
    check_moments(store)
    total = int(store.num_points(store.occupied_rows()).sum())
    stored = mapper._census._points_stored
    assert total == stored, f"voxels hold {total} points, scans brought {stored}"
    if len(store.touched.rows):
        return
    check_observables(store)
    _check_normals(mapper)
    _check_labels(mapper)
    _check_planes(mapper)
    for plane in mapper.snapshot().changed:
        check_plane(plane)
    _check_digest(mapper)


def check_blocks(store: VoxelStore) -> None:
    """I1: keys unique and found, neighbours agree with keys, rows are 0..V-1."""
    blocks, count = store.blocks, store.num_blocks
    keys = blocks.keys[:count]
    assert len(np.unique(keys)) == count, "two blocks have one key"
    number = {int(key): b for b, key in enumerate(keys)}
    for key, b in number.items():
        assert find(blocks.table_keys, blocks.table_values, key) == b, f"block {b} is not found"
    near = pack_all(unpack_all(keys)[:, None, :] + _AROUND)
    told = blocks.neighbours[:count].copy()
    told[:, CENTRE] = np.arange(count)
    expected = np.array([number.get(int(k), -1) for k in near.ravel()]).reshape(told.shape)
    wrong = np.argwhere(told != expected)
    assert not len(wrong), f"block {unpack(int(keys[wrong[0][0]]))} has a wrong neighbour link"
    told_rows = blocks.rows[blocks.lines[:count]].reshape(count, BLOCK**3) - 1
    block, local = np.nonzero(told_rows >= 0)
    rows = told_rows[block, local]
    lines = blocks.lines[:count]
    assert np.array_equal(np.sort(lines[lines > 0]), np.arange(1, store.num_lines)), (
        "a line is shared"
    )
    assert np.array_equal(np.sort(rows), np.arange(store.num_rows)), "rows are not 0..V-1"
    assert np.array_equal(store.columns.block[rows], block), "a row names another block"
    assert np.array_equal(store.columns.local[rows], local), "a row names another place"


def check_moments(store: VoxelStore) -> None:
    """I2, as far as moments tell: they are those of some points with local ticks 0..1023."""
    rows = np.arange(store.num_rows, dtype=np.int32)
    m, views = store.moments(rows), store.views(rows)
    poses = store.columns.poses[: store.num_rows]
    n = m[:, 0]
    assert np.all(n >= 0), "a voxel holds less than nothing"
    void = n == 0
    assert not np.any(m[void]), "an empty voxel has moments"
    assert not np.any(views[void]), "an empty voxel has views"
    assert not np.any(poses[void]), "an empty voxel has poses"
    for axis, square in enumerate((4, 7, 9)):
        one, two = m[:, 1 + axis], m[:, square]
        assert np.all((one >= 0) & (one <= (TICKS - 1) * n)), "a centroid lies outside its voxel"
        assert np.all(two <= (TICKS - 1) * one), "a second moment is too large"
        assert np.all(n * two >= one * one), "a variance is negative"
    assert np.all(np.abs(views) <= VIEW * n[:, None]), "a view is longer than a unit vector"
    assert np.all((poses[:, 0] >= 0) & (poses[:, 0] <= n)), "more line points than points"
    assert np.all(poses[:, 0] * poses[:, 2] >= poses[:, 1] ** 2), "pose sums of no poses"


@kernel
def _observe_all(moments, views, poses, count):  # type: ignore[no-untyped-def]
    out = np.empty(count, np.int64)
    for row in range(count):
        out[row] = observe(moments[row], views[row], poses[row])
    return out


def check_observables(store: VoxelStore) -> None:
    """Every observable is that of the moments, and the occupied bits say which are not empty."""
    c, count = store.columns, store.num_rows
    rows = np.arange(count, dtype=np.int32)
    seen = _observe_all(store.moments(rows), store.views(rows), c.poses, count)
    assert np.array_equal(seen, c.observable[:count]), "an observable is out of date"
    bits = np.zeros_like(store.blocks.occupied)
    on = np.flatnonzero(seen)
    local = c.local[on].astype(np.uint64)
    where = c.block[on], (local >> np.uint64(6)).astype(np.int64)
    np.bitwise_or.at(bits, where, np.uint64(1) << (local & np.uint64(63)))
    assert np.array_equal(bits, store.blocks.occupied), "an occupied bit is wrong"
    assert store.num_voxels == len(on), "voxels were miscounted"


def _check_normals(mapper: Mapper) -> None:
    normals, count = mapper._normals.normals, mapper._store.num_rows
    kind, seen = normals.kind[:count], mapper._store.columns.observable[:count]
    assert np.array_equal(kind == EMPTY, seen == 0), "a voxel without points has a class"
    length = np.linalg.norm(normals.unit[:count][kind == VALID].astype(float), axis=1)
    assert np.all(np.abs(length - 256.0) < 1.0), "a valid normal is no unit vector"
    assert normals.reach[:count].max(initial=0) <= mapper.settings.max_radius, "reach over R_MAX"


def _check_labels(mapper: Mapper) -> None:
    """I4: labels name patches that are there, and a voxel is on one tile-plane at the most."""
    store, patches = mapper._store, mapper._patches.patches
    count = store.num_rows
    block = store.columns.block[:count]
    assert patches.label[:count].min(initial=-1) >= -1, "a label is still to be found"
    for name, labels in (("label", patches.label[:count]), ("claim", patches.second[:count])):
        on = np.flatnonzero(labels >= 0)
        near, index = labels[on] >> 4, labels[on] & 15
        home = np.where(near == CENTRE, block[on], store.blocks.neighbours[block[on], near])
        assert np.all(home >= 0), f"a {name} names a block that is not there"
        assert np.all(index < patches.number[home]), f"a {name} names a patch that is not there"
    times = np.zeros(count, np.int64)
    for tile in mapper._tiles.tiles.values():
        own = tile.rows[~tile.corner]
        np.add.at(times, own, 1)
        occupation = np.bincount(tile.owner[~tile.corner], minlength=tile.num_planes)
        assert np.array_equal(occupation, tile.occupation), f"tile {unpack(tile.key)} miscounts"
    assert np.array_equal(times, patches.label[:count] >= 0), "a voxel is on two tile-planes"
    held = sum(int(t.points[:, 0].sum()) for t in mapper._tiles.tiles.values())
    assert held <= mapper._census._points_stored, "tile-planes hold more points than there are"
    votes = patches.votes[np.arange(patches.votes.shape[1]) < patches.number[:, None]].sum()
    assert mapper._patches.histogram.sum() == votes, "the histogram of noise forgot a patch"


def _check_planes(mapper: Mapper) -> None:
    """I4: planes, their tile-planes and their voxels agree about who belongs to whom."""
    table, label = mapper._table, mapper._planes.label
    ids = np.concatenate(
        [np.zeros(0, np.int64), *(mapper._tiles.tiles[int(k)].ids for k in table.tile_keys)]
    )
    assert np.array_equal(ids == 0, label == FREE), "a tile-plane's id and its plane disagree"
    planes = mapper.snapshot().changed
    assert [p.id for p in planes] == sorted(set(ids[ids != 0].tolist())), "planes and ids disagree"
    points = _points_by_plane(mapper)
    for plane in planes:
        voxels = int(table.occupation[ids == plane.id].sum())
        assert voxels == plane.num_voxels, f"plane {plane.id} has {voxels} voxels"
        num = int(table.total[ids == plane.id].sum())
        assert num == plane.num_points > 0, f"plane {plane.id} has {num} points"
        held = points.get(plane.id, 0)
        assert num == held, f"plane {plane.id}: {num} points in voxels of {held}"
    shown = [points.plane_ids for points in mapper.points()]
    known = {0, *(p.id for p in planes)}
    assert known.issuperset(np.concatenate([[0], *shown]).tolist()), "a voxel shows an unknown id"
    voxels = len(mapper._store.occupied_rows())
    assert sum(map(len, shown)) == voxels, "not every voxel is shown once"


def _points_by_plane(mapper: Mapper) -> dict[int, int]:
    """Points of all voxels of each plane."""
    total: dict[int, int] = {}
    for tile in mapper._tiles.tiles.values():
        own = ~tile.corner
        sums = np.zeros(tile.num_planes, np.int64)
        np.add.at(sums, tile.owner[own], mapper._store.num_points(tile.rows[own]))
        for plane_id, points in zip(tile.ids.tolist(), sums.tolist(), strict=False):
            total[plane_id] = total.get(plane_id, 0) + points
    return total


def check_plane(plane: Plane) -> None:
    """I7 and eq. 6: figures in range, rings on the plane, simple, and turning as stated."""
    name = f"plane {plane.id}"
    assert abs(float(plane.normal @ plane.normal) - 1.0) < 1e-9, f"{name}: normal is no unit"
    assert plane.d >= 0.0, f"{name}: d < 0"
    assert plane.facing in (-1, 1), f"{name}: faces nowhere"
    assert plane.first_seen_ns <= plane.last_seen_ns, f"{name}: last seen before it was seen"
    f = plane.frame
    axes = np.stack([f.axis_u, f.axis_v, f.axis_n])
    assert np.allclose(axes @ axes.T, np.eye(3), atol=1e-9), f"{name}: frame is not orthonormal"
    assert float(np.linalg.det(axes)) > 0.0, f"{name}: frame is left-handed"
    assert float(f.axis_n @ plane.normal) * plane.facing > 0.99, f"{name}: frame faces away"
    ids = [s.id for s in plane.surfaces]
    assert len(set(ids)) == len(ids), f"{name}: two surfaces with one id"
    for surface in plane.surfaces:
        area = signed_area2(surface.outer)
        assert area > 0, f"{name}: outer ring of surface {surface.id} turns clockwise"
        for hole in surface.holes:
            own = signed_area2(hole.ring)
            assert own < 0, f"{name}: a hole of surface {surface.id} turns counter-clockwise"
            area += own
        stated = 2.0 * surface.area_m2 / f.step_m**2
        assert abs(stated - area) < 1e-6 * abs(area) + 1e-6, f"{name}: area misstated"
        for ring in (surface.outer, *(h.ring for h in surface.holes)):
            off = np.abs(plane.lift(ring) @ plane.normal - plane.d).max()
            assert off <= _ON_PLANE_M, f"{name}: a ring leaves its plane by {off} m"


def signed_area2(ring: NDArray[np.int32]) -> int:
    """Twice the signed area of a ring (M, 2), exactly."""
    u, v = ring[:, 0].astype(np.int64), ring[:, 1].astype(np.int64)
    return int(np.sum(u * np.roll(v, -1) - np.roll(u, -1) * v))


def _turn(a: NDArray[np.int64], b: NDArray[np.int64], c: NDArray[np.int64]) -> NDArray[np.int64]:
    """Sign of the turn a -> b -> c."""
    (p, q), (r, s) = (b - a).T, (c - a).T
    return np.asarray(np.sign(p * s - q * r))


def crossings(ring: NDArray[np.int32]) -> NDArray[np.int64]:
    """(X, 2) pairs of edges of a ring (M, 2) that cross at an inner point of both, exactly.
    Rings may touch themselves (a pinched vertex), and touching is no crossing."""
    a = ring.astype(np.int64)
    b = np.roll(a, -1, axis=0)
    low, high = np.minimum(a, b), np.maximum(a, b)
    found = [np.zeros((0, 2), np.int64)]
    for e in range(len(a) - 2):
        near = (low[e + 2 :] <= high[e]).all(axis=1) & (high[e + 2 :] >= low[e]).all(axis=1)
        o = e + 2 + np.flatnonzero(near)
        one = _turn(a[e], b[e], a[o]) * _turn(a[e], b[e], b[o])
        two = _turn(a[o], b[o], np.broadcast_to(a[e], a[o].shape)) * _turn(
            a[o], b[o], np.broadcast_to(b[e], a[o].shape)
        )
        hits = o[(one < 0) & (two < 0)]
        found.append(np.stack([np.full(len(hits), e), hits], axis=1))
    return np.concatenate(found)


def _unsettled(store: VoxelStore, anew: VoxelStore) -> None:
    """Make `anew` hold the same integers, none of them looked at yet. Shares what nobody writes."""
    anew.blocks = store.blocks._replace(occupied=np.zeros_like(store.blocks.occupied))
    anew.columns = store.columns._replace(
        observable=np.zeros_like(store.columns.observable),
        flags=store.columns.flags & ~TOUCHED,
    )
    anew.num_blocks, anew.num_rows = store.num_blocks, store.num_rows
    anew.touch_all()


def _check_digest(mapper: Mapper) -> None:
    """I3 from the same integers: all derived anew gives the same digest; the snapshot's too."""
    digest, counts = mapper.digest(), mapper.counts().as_dict()
    told = derived_digest(model_planes(mapper.snapshot().changed), counts)
    assert told == digest.derived, "snapshot and digest disagree"
    anew = type(mapper)(mapper.settings)
    _unsettled(mapper._store, anew._store)
    anew._space = mapper._free
    anew.update()
    assert anew.digest() == digest, "the map is not what its integers derive to"
