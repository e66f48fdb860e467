"""Voxels hold exact moments: those of a plain sum, in any order, and undone to the bit."""

from __future__ import annotations

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from facet.mapping.blocks import pack_all
from facet.mapping.digest import state_digest
from facet.mapping.freespace import FreeSpace
from facet.mapping.invariants import check_blocks, check_moments, check_observables
from facet.mapping.observable import observe
from facet.mapping.quantise import VIEW, Ticks
from facet.mapping.store import VoxelStore
from facet.mapping.sums import sums_of, write_sums
from mapping_logs import ticks_of_one


def ticks_of(seed: int, count: int, width: int = 12, pose_hash: int = -1) -> Ticks:
    """Random points in `width` voxels about the origin, with random views."""
    rng = np.random.default_rng(seed)
    points = rng.integers(-512 * width, 512 * width, (count, 3))
    views = rng.normal([1.5, 0.0, 0.0], 1.0, (count, 3))
    views = np.floor(views / np.linalg.norm(views, axis=1, keepdims=True) * VIEW + 0.5)
    return ticks_of_one(points, views.astype(np.int16), pose_hash=pose_hash)


def table(store: VoxelStore) -> dict[tuple[int, int, int], tuple[list[int], ...]]:
    """Occupied voxels by index: moments, views, poses."""
    rows = store.occupied_rows()
    columns = zip(
        store.voxel_keys(rows).tolist(), store.moments(rows).tolist(), store.views(rows).tolist(),
        store.columns.poses[rows].tolist(), strict=True,
    )  # fmt: skip
    return {tuple(key): (m, v, h) for key, m, v, h in columns}


def plain(scans: list[Ticks]) -> dict[tuple[int, int, int], tuple[list[int], ...]]:
    """The same sums by Python integers."""
    sums: dict[tuple[int, int, int], tuple[list[int], ...]] = {}
    for scan in scans:
        for p, view in zip(scan.points.tolist(), scan.views.tolist(), strict=True):
            m, v, h = sums.setdefault(tuple(c // 1024 for c in p), ([0] * 10, [0] * 3, [0] * 3))
            x, y, z = (c % 1024 for c in p)
            for i, s in enumerate((1, x, y, z, x * x, x * y, x * z, y * y, y * z, z * z)):
                m[i] += s
            for i in range(3):
                v[i] += view[i]
            if scan.pose_hashes[0] >= 0:
                for i, s in enumerate((1, scan.pose_hashes[0], scan.pose_hashes[0] ** 2)):
                    h[i] += s
    return sums


def filled(scans: list[Ticks]) -> VoxelStore:
    store = VoxelStore()
    for scan in scans:
        store.insert(scan)
    return store


def digest(store: VoxelStore) -> str:
    return state_digest(store, FreeSpace())


def test_moments_are_those_of_a_plain_sum() -> None:
    scans = [ticks_of(s, 3000, pose_hash=h) for s, h in enumerate((-1, 17, 60_000, -1, 17))]
    store = filled(scans)
    assert table(store) == plain(scans)
    check_blocks(store)
    check_moments(store)
    store.settle()
    check_observables(store)


def test_moments_of_a_voxel_are_those_of_its_points() -> None:
    points = np.random.default_rng(4).integers(0, 1024, (5000, 3))
    scan = ticks_of(0, 5000)._replace(points=points)
    m = filled([scan]).moments(np.zeros(1, np.int32))[0].astype(float)
    spread = np.cov(points.T, bias=True)
    found = m[4:] / m[0] - np.outer(m[1:4], m[1:4])[np.triu_indices(3)] / m[0] ** 2
    np.testing.assert_allclose(found, spread[np.triu_indices(3)], rtol=1e-9)


@settings(max_examples=30, deadline=None)
@given(st.permutations(range(5)), st.integers(0, 1000))
def test_any_order_of_scans_gives_the_same_state(order: list[int], seed: int) -> None:
    scans = [ticks_of(seed + k, 200, pose_hash=k * 999 - 1) for k in range(5)]
    assert digest(filled([scans[k] for k in order])) == digest(filled(scans))


@settings(max_examples=30, deadline=None)
@given(st.integers(0, 1000), st.integers(0, 300), st.integers(0, 300))
def test_insert_then_remove_is_the_identity(seed: int, base: int, more: int) -> None:
    kept, gone = ticks_of(seed, base), ticks_of(seed + 1, more, pose_hash=seed % 3 - 1)
    store = filled([kept])
    store.settle()
    store.insert(gone)
    if seed % 2:
        store.settle()
    store.remove(gone)
    store.settle()
    fresh = filled([kept])
    fresh.settle()
    assert digest(store) == digest(fresh)
    assert observables(store) == observables(fresh)
    check_observables(store)
    check_moments(store)


def observables(store: VoxelStore) -> dict[int, int]:
    rows = store.occupied_rows()
    keys = pack_all(store.voxel_keys(rows)).tolist()
    return dict(zip(keys, store.columns.observable[rows].tolist(), strict=True))


def test_removed_before_inserted_comes_to_nothing() -> None:
    scan = ticks_of(3, 500)
    store = VoxelStore()
    store.remove(scan)
    store.insert(scan)
    assert len(store.occupied_rows()) == 0
    assert digest(store) == digest(VoxelStore())


def test_growing_loses_nothing() -> None:
    """Past every first capacity, with line scans only at the end."""
    scans = [ticks_of(k, 40_000, width=400) for k in range(3)]
    scans.append(ticks_of(9, 20_000, width=400, pose_hash=5))
    store = filled(scans)
    assert store.num_blocks > 4096
    assert int(store.num_points(store.occupied_rows()).sum()) == 140_000
    assert int(store.columns.poses[:, 0].sum()) == 20_000
    check_blocks(store)
    check_moments(store)


def test_settle_tells_what_changed_and_only_that() -> None:
    store = filled([ticks_of(0, 4000)])
    first = store.settle()
    assert sorted(first.rows.tolist()) == sorted(store.occupied_rows().tolist())
    assert not first.before.any()
    assert len(store.settle().rows) == 0
    before = store.columns.observable.copy()
    store.insert(ticks_of(1, 300))
    touched = set(store.touched.rows.tolist())
    settled = store.settle()
    assert np.array_equal(settled.before, before[settled.rows])
    dirty = set(settled.rows.tolist())
    changed = set(
        np.flatnonzero(before[: store.num_rows] != store.columns.observable[: store.num_rows])
    )
    assert dirty == changed
    assert dirty <= touched
    check_observables(store)


def seen(
    moments: list[int], views: tuple[int, int, int], poses: tuple[int, ...] = (0, 0, 0)
) -> dict[str, object]:
    """The parts of an observable."""
    full = np.zeros(10, np.int64)
    full[: len(moments)] = moments
    word = int(observe(full, np.array(views, np.int64), np.array(poses, np.int64)))
    return {
        "centroid": tuple((word >> s) & 15 for s in (0, 4, 8)),
        "votes": (word >> 12) & 15,
        "view": tuple(((word >> s) & 31) - 8 for s in (16, 21, 26)),
        "mixed": bool((word >> 31) & 1),
        "pose": (word >> 32) & 0x1FFFF,
    }


def test_an_observable_is_a_rounded_view() -> None:
    told = seen([2, 1024, 0, 2046], (254, 0, 0))
    assert told == {"centroid": (4, 0, 8), "votes": 2, "view": (7, 1, 1), "mixed": False, "pose": 0}
    assert seen([1, 63, 64, 191], (0, 0, -127))["centroid"] == (0, 1, 1)
    assert seen([1, 63, 64, 192], (0, 0, -127))["centroid"] == (0, 1, 2)
    assert seen([20, 0, 0, 0], (0, 2540, 0))["votes"] == 8


def test_a_settled_voxel_is_rounded_to_quarters() -> None:
    few, many = [63, 63 * 192, 0, 0], [64, 64 * 192, 0, 0]  # a centroid at 1.5 eighths
    assert seen(few, (63 * 127, 0, 0))["centroid"] == (2, 0, 0)
    assert seen(many, (64 * 127, 0, 0))["centroid"] == (2, 0, 0)
    assert seen([63, 63 * 120, 0, 0], (63 * 127, 0, 0))["centroid"] == (1, 0, 0)
    assert seen([64, 64 * 120, 0, 0], (64 * 127, 0, 0))["centroid"] == (0, 0, 0)


def test_a_direction_keeps_the_signs_that_tell_the_side() -> None:
    assert seen([1, 0, 0, 0], (126, -1, 12))["view"] == (7, -1, 1)
    assert seen([1, 0, 0, 0], (110, -64, 0))["view"] == (7, -4, 1)
    assert seen([1, 0, 0, 0], (-90, -90, 1))["view"] == (-7, -7, 1)


def test_a_voxel_seen_from_both_sides_is_mixed() -> None:
    assert seen([4, 0, 0, 0], (0, 0, 0))["mixed"]
    assert seen([4, 0, 0, 0], (127, 0, 0))["mixed"]  # a quarter
    assert not seen([4, 0, 0, 0], (3 * 127, 0, 0))["mixed"]


def test_a_voxel_knows_its_only_line_pose() -> None:
    assert seen([3, 0, 0, 0], (381, 0, 0), (3, 21, 147))["pose"] == 8  # hash 7 thrice
    assert seen([3, 0, 0, 0], (381, 0, 0), (3, 22, 164))["pose"] == 0  # 7, 7, 8
    assert seen([3, 0, 0, 0], (381, 0, 0), (2, 14, 98))["pose"] == 0  # and one of a cloud
    assert seen([2, 0, 0, 0], (254, 0, 0), (2, 0, 0))["pose"] == 1  # hash 0


def test_an_empty_voxel_has_no_observable() -> None:
    nothing: NDArray[np.int64] = np.zeros(10, np.int64)
    assert observe(nothing, np.zeros(3, np.int64), np.zeros(3, np.int64)) == 0


def test_the_mean_observable_fades_as_one_over_n() -> None:
    """One more point flips a voxel's observable with p of about 4/n at most (design 1.2)."""
    rng, flips = np.random.default_rng(5), {}
    store = VoxelStore()
    corner = np.arange(400)[:, None] * [1024, 0, 0] + rng.integers(0, 512, (400, 3))
    for n in range(1, 161):
        points = rng.integers(0, 512, (400, 3)) + corner
        views = np.tile(np.array([VIEW, 0, 0], np.int16), (400, 1))
        store.insert(ticks_of_one(points, views))
        flips[n] = len(store.settle().rows) / 400
    late = np.mean([n * flips[n] for n in range(80, 161)])
    assert 0.2 < late < 4.0


def test_sums_beyond_their_low_parts_are_exact() -> None:
    """A voxel's sums as after half a million points: carried up, carried down, frozen, undone."""
    scan = ticks_of(0, 30_000, width=1)
    many = 700  # times that scan: some 2 * 10^6 points a voxel
    store, once = filled([scan]), filled([scan])
    rows = store.occupied_rows()
    sums = many * sums_of(store.columns, rows)
    store.columns.low[rows] = 0
    for row, own in zip(rows, sums, strict=True):
        write_sums(store.columns, row, own)
    np.testing.assert_array_equal(sums_of(store.columns, rows), sums)
    assert store.columns.high.any()
    assert int(store.num_points(rows).sum()) == many * 30_000
    again = VoxelStore()
    again.restore(store.freeze(), store.blocks.keys[: store.num_blocks])
    assert digest(again) == digest(store)
    again.remove(scan)
    np.testing.assert_array_equal(again.moments(rows), (many - 1) * once.moments(rows))
    np.testing.assert_array_equal(again.views(rows), (many - 1) * once.views(rows))


def test_sums_are_carried_point_by_point() -> None:
    """The same 20,000 points again and again, past the range of the low parts on both sides."""
    points = np.full((20_000, 3), 1023)
    views = np.tile(np.array([VIEW, 0, -VIEW], np.int16), (20_000, 1))
    scan = ticks_of_one(points, views)
    store, row = VoxelStore(), np.zeros(1, np.int32)
    for times in range(1, 21):
        store.insert(scan)
        n = 20_000 * times
        expected = [n, *[1023 * n] * 3, *[1023**2 * n] * 6]
        assert store.moments(row)[0].tolist() == expected
        assert store.views(row)[0].tolist() == [VIEW * n, 0, -VIEW * n]
    assert store.columns.high.any()
    for _ in range(25):
        store.remove(scan)
    assert store.moments(row)[0].tolist() == [
        -v for v in [100_000, *[1023 * 100_000] * 3, *[1023**2 * 100_000] * 6]
    ]
    for _ in range(5):
        store.insert(scan)
    assert digest(store) == digest(VoxelStore())
