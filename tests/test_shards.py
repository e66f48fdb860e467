"""The map cut into shards (P7): each gets the points of its own tiles and of a halo of max_radius
round them, and tells its own voxels' normals as the whole map does, to the bit."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from facet.mapping.normals import NormalField
from facet.mapping.quantise import Ticks, quantise
from facet.mapping.settings import TICKS, TILE, MapSettings
from facet.mapping.store import VoxelStore
from facet_protocol.messages import Scan, ScanKind
from mapping_logs import cloud, ticks_of_one

SETTINGS = MapSettings(voxel_m=0.1)
HALO = SETTINGS.max_radius
Table = NDArray[np.int64]  # (V, 10): voxel, normal, class, thickness, border, reach; by voxel


def derived(scans: Sequence[Ticks]) -> Table:
    """What a store of these points knows of each voxel, brought up to date after every scan."""
    store, field = VoxelStore(), NormalField(SETTINGS)
    for ticks in scans:
        store.insert(ticks)
        field.update(store, store.settle())
    rows, told = store.occupied_rows(), field.normals
    columns = (told.unit, told.kind, told.thickness, told.border, told.reach)
    voxels = store.voxel_keys(rows)
    table = np.column_stack([voxels, *(np.asarray(c[rows], np.int64) for c in columns)])
    return table[np.lexsort(voxels.T)]


def within(voxels: NDArray[np.int64], tile: NDArray[np.int64], halo: int = 0) -> NDArray[np.bool_]:
    """Which voxels (V, 3) lie in a tile, or in the halo round it."""
    low = tile * TILE
    return np.all((voxels >= low - halo) & (voxels < low + TILE + halo), axis=1)


def shard(ticks: Ticks, tile: NDArray[np.int64], halo: int) -> Ticks:
    """The points of a scan that are this tile's business."""
    kept = within(ticks.points // TICKS, tile, halo)
    return ticks_of_one(ticks.points[kept], ticks.views[kept], pose_hash=ticks.pose_hashes[0])


def sharded(scans: Sequence[Ticks], halo: int) -> Table:
    """What the shards know, each of its own tile."""
    tiles = np.unique(np.concatenate([s.points // (TICKS * TILE) for s in scans]), axis=0)
    parts = []
    for tile in tiles:
        part = derived([shard(ticks, tile, halo) for ticks in scans])
        parts.append(part[within(part[:, :3], tile)])
    assert len(parts) > 1
    whole = np.concatenate(parts)
    return whole[np.lexsort(whole[:, :3].T)]


def surface(rng: np.random.Generator, count: int, noise_m: float, number: int) -> Scan:
    """A disc of 9 m anywhere near where tiles meet, seen by a 3-D or a line scanner."""
    normal = rng.normal(size=3)
    normal /= np.linalg.norm(normal)
    offsets = rng.uniform(-4.5, 4.5, (count, 3))
    offsets -= np.outer(offsets @ normal, normal)
    points = rng.uniform(-2.0, 2.0, 3) + offsets + rng.normal(0.0, noise_m, (count, 1)) * normal
    kind = ScanKind.LINE if number % 3 == 2 else ScanKind.CLOUD
    return cloud(points, at=6.0 * normal, kind=kind, sequence=number)


def scene(seed: int, counts: Sequence[int], noise_m: float) -> list[Ticks]:
    rng = np.random.default_rng(seed)
    scans = [surface(rng, count, noise_m, k) for k, count in enumerate(counts, start=1)]
    return [quantise([scan], SETTINGS) for scan in scans]


@settings(max_examples=10, deadline=None)
@given(
    seed=st.integers(0, 2**32 - 1),
    counts=st.lists(st.sampled_from([150, 600, 3000, 8000]), min_size=1, max_size=3),
    noise_m=st.sampled_from([0.0, 0.01, 0.05]),
)
def test_p7_shards_tell_what_the_whole_tells(seed: int, counts: list[int], noise_m: float) -> None:
    scans = scene(seed, counts, noise_m)
    np.testing.assert_array_equal(sharded(scans, HALO), derived(scans))


def test_p7_a_halo_one_voxel_short_is_not_enough() -> None:
    """Where points are few, regions look as far as they may."""
    scans = scene(1, [150] * 6, 0.01)
    whole = derived(scans)
    assert whole[:, -1].max() == HALO  # some voxel needs all of it
    np.testing.assert_array_equal(sharded(scans, HALO), whole)
    short = sharded(scans, HALO - 1)
    np.testing.assert_array_equal(short[:, :3], whole[:, :3])
    assert np.any(short != whole)
