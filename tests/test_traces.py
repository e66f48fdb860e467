"""Sums kept from one estimate of a normal to the next are those that would be taken anew."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from facet.mapping.adaptive import make_rule
from facet.mapping.mapper import Mapper
from facet.mapping.settings import MapSettings
from facet.mapping.traces import CUBE, KEY, NUMBER, OWNER, SLAB, SLAB_UNIT
from facet_protocol.messages import Scan
from mapping_logs import cloud

VOXEL_M = 0.0625
SETTINGS = MapSettings(voxel_m=VOXEL_M)
Votes = dict[tuple[int, int, int], int]


def room(seed: int, points: int = 900) -> Scan:
    """A corner: floor and two walls, noisy, seen from one of two places."""
    rng = np.random.default_rng(seed)
    face = rng.integers(0, 3, points)
    found = rng.uniform(0.0, 1.2, (points, 3))
    found[np.arange(points), face] = rng.normal(0.0, 0.012, points)
    at = [0.9, 0.8, 0.7] if seed % 2 else [0.3, 0.9, 0.5]
    return cloud(found, at=at, sequence=seed + 1)


def votes_of(mapper: Mapper) -> Votes:
    """Observables by voxel."""
    store = mapper._store
    rows = store.occupied_rows()
    words = store.columns.observable[rows].tolist()
    return dict(zip(map(tuple, store.voxel_keys(rows).tolist()), words, strict=True))


def centroid(word: int) -> NDArray[np.int64]:
    return np.array([word & 15, (word >> 4) & 15, (word >> 8) & 15])


def view(word: int) -> NDArray[np.int64]:
    return np.array([((word >> s) & 31) - 8 for s in (16, 21, 26)])


def counts(seen: int, word: int, offset: NDArray[np.int64], key: int) -> bool:
    """Whether a vote counts for the sum of a key, by the definition."""
    kind = (key >> 5) & 3
    if kind == CUBE:
        both_sides = (seen >> 31) & 1 == 1
        own, other = view(seen), view(word)
        dot = min(0, int(own @ other))
        near = 4 * dot * dot <= int(own @ own) * int(other @ other)
        return both_sides or (near and (word >> 31) & 1 == 0)
    normal = np.array([(key >> 7) & 255, (key >> 15) & 255, key >> 23]) - SLAB_UNIT
    (rule,) = make_rule(SETTINGS)
    half = rule.slab if kind == SLAB else rule.thin_slab
    away = int(normal @ (8 * offset + centroid(word) - centroid(seen)))
    return abs(away) < half and int(normal @ view(word)) > 0


def plain_sum(votes: Votes, at: tuple[int, int, int], key: int) -> list[int]:
    """The sum of a key round a voxel, vote by vote."""
    total = np.zeros(11, np.int64)
    for place, word in votes.items():
        offset = np.array(place) - at
        if np.abs(offset).max() > key & 31 or not counts(votes[at], word, offset, key):
            continue
        c, w = 8 * offset + centroid(word), (word >> 12) & 15
        products = [w * c[a] * c[b] for a in range(3) for b in range(a, 3)]
        total += [1, w, *(w * c), *products]
    return [int(t) for t in total]


def kept(mapper: Mapper) -> list[tuple[tuple[int, int, int], int, list[int]]]:
    """(voxel, key, sum) of all that is kept."""
    own, traces = mapper._store, mapper._normals._traces
    told = []
    for share, begin in np.argwhere(traces.entries[..., OWNER] > 0).tolist():
        row = int(traces.entries[share, begin, OWNER]) - 1
        if traces.slot[row] != begin + 1:
            continue
        (voxel,) = map(tuple, own.voxel_keys(np.array([row], np.int32)).tolist())
        number = int(traces.entries[share, begin, NUMBER])
        entries = traces.entries[share, begin : begin + number].tolist()
        told.extend((voxel, entry[KEY], entry[:KEY]) for entry in entries)
    return told


def test_what_is_kept_is_what_would_be_summed_anew() -> None:
    mapper = Mapper(SETTINGS)
    scans = [room(seed) for seed in range(8)]
    rng = np.random.default_rng(0)
    kinds = set()
    for scan in scans:
        mapper.insert(scan)
        mapper.update()
    for step in range(4):
        mapper.retract(scans[step])
        mapper.insert(room(100 + step, 60))
        mapper.update()
        votes, told = votes_of(mapper), kept(mapper)
        for n in rng.permutation(len(told))[:60].tolist():
            voxel, key, total = told[n]
            assert total == plain_sum(votes, voxel, key), (voxel, key)
            kinds.add((key >> 5) & 3)
    assert {CUBE, SLAB} <= kinds


def test_what_is_kept_is_used() -> None:
    """Else nothing here could fail: sums that are made false make the next normals false."""
    mapper, fresh = Mapper(SETTINGS), Mapper(SETTINGS)
    scans = [*(room(seed) for seed in range(8)), room(200, 20), room(201, 20)]
    for scan in scans:
        if scan is scans[-1]:
            mapper._normals._traces.entries[..., 5:KEY] //= 2
        mapper.insert(scan)
        mapper.update()
        fresh.insert(scan)
    fresh.update()
    assert mapper.digest().state == fresh.digest().state
    wrong, right = (dict(normals_of(m)) for m in (mapper, fresh))
    assert wrong != right


def normals_of(mapper: Mapper) -> list[tuple[tuple[int, ...], tuple[int, ...]]]:
    """(voxel, normal) of each."""
    rows = mapper._store.occupied_rows()
    voxels = map(tuple, mapper._store.voxel_keys(rows).tolist())
    return list(zip(voxels, map(tuple, mapper._normals.normals.unit[rows].tolist()), strict=True))
