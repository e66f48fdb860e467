"""Ids last: the larger part keeps them, and none is used twice."""

from __future__ import annotations

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from facet.mapping.identity import Heritage, Identity, Lineage
from facet_protocol.messages import EventKind


def shared(*rows: tuple[int, int, int]) -> Heritage:
    """Rows of (old id, plane, voxels)."""
    table = np.array(rows, np.int64).reshape(-1, 3)
    return Heritage(table[:, 0], table[:, 1], table[:, 2])


def started(count: int) -> Identity:
    identity = Identity()
    assert identity.assign(count, shared()).ids.tolist() == list(range(1, count + 1))
    return identity


def told(identity: Identity, lineage: Lineage, updated: list[int]) -> list[tuple[object, int, int]]:
    events = identity.events(lineage, updated, 7, 99)
    assert all((e.revision, e.stamp_ns) == (7, 99) for e in events)
    return [(e.kind, e.plane_id, e.other_id) for e in events]


def test_planes_keep_their_ids_wherever_they_stand() -> None:
    identity = started(3)
    lineage = identity.assign(3, shared((1, 2, 50), (2, 0, 60), (3, 1, 70)))
    assert lineage.ids.tolist() == [2, 3, 1]
    assert (lineage.created, lineage.retired) == ({}, ())
    assert told(identity, lineage, [2]) == [(EventKind.UPDATED, 2, 0)]


def test_a_merge_keeps_the_larger_id_and_names_it() -> None:
    identity = started(2)
    lineage = identity.assign(1, shared((1, 0, 30), (2, 0, 80)))
    assert lineage.ids.tolist() == [2]
    assert [(t.plane_id, t.subsumed_by) for t in lineage.retired] == [(1, 2)]
    assert told(identity, lineage, [2]) == [(EventKind.MERGED, 1, 2), (EventKind.UPDATED, 2, 0)]


def test_a_split_leaves_the_id_with_the_larger_part() -> None:
    identity = started(1)
    lineage = identity.assign(2, shared((1, 0, 30), (1, 1, 80)))
    assert lineage.ids.tolist() == [2, 1]
    assert lineage.created == {2: 1}
    assert told(identity, lineage, [1, 2]) == [(EventKind.SPLIT, 2, 1), (EventKind.UPDATED, 1, 0)]


def test_what_loses_its_support_is_retired() -> None:
    identity = started(2)
    lineage = identity.assign(1, shared((2, 0, 10)))
    assert [(t.plane_id, t.subsumed_by) for t in lineage.retired] == [(1, 0)]
    assert told(identity, lineage, []) == [(EventKind.RETIRED, 1, 0)]


def test_a_new_plane_is_created() -> None:
    identity = started(1)
    lineage = identity.assign(2, shared((1, 0, 10)))
    assert lineage.ids.tolist() == [1, 2]
    assert told(identity, lineage, [2]) == [(EventKind.CREATED, 2, 0)]


def test_shares_of_many_tiles_add_up() -> None:
    identity = started(2)
    rows = [(1, 0, 40), *[(2, 0, 15)] * 3, (1, 1, 5)]
    assert identity.assign(2, shared(*rows)).ids.tolist() == [2, 1]


def test_the_order_of_shares_does_not_matter() -> None:
    rows = [(1, 0, 20), (2, 0, 20), (2, 1, 20), (3, 1, 21), (3, 2, 7)]
    results = set()
    for seed in range(6):
        mixed = np.random.default_rng(seed).permutation(rows)
        results.add(tuple(started(3).assign(3, shared(*map(tuple, mixed))).ids.tolist()))
    assert len(results) == 1


def test_a_plane_without_a_name_gives_none_away() -> None:
    """Voxels that were on no plane have the id 0."""
    lineage = started(1).assign(2, shared((0, 0, 900), (1, 1, 1)))
    assert lineage.ids.tolist() == [2, 1]
    assert lineage.created == {2: 0}


def test_events_are_numbered_without_a_gap() -> None:
    identity = Identity()
    numbers = []
    for count in (2, 3, 0, 1):
        lineage = identity.assign(count, shared())
        numbers += [e.number for e in identity.events(lineage, lineage.ids.tolist(), 1, 1)]
    assert numbers == list(range(1, len(numbers) + 1))


@settings(deadline=None)
@given(st.data())
def test_ids_are_never_used_twice(data: st.DataObject) -> None:
    """Planes come, go, merge and split at random."""
    identity, alive, ever, dead = Identity(), set(), set(), set()
    for _ in range(data.draw(st.integers(1, 8))):
        count = data.draw(st.integers(0, 5))
        known = st.sampled_from([0, *sorted(alive | dead)])
        row = st.tuples(known, st.integers(0, max(0, count - 1)), st.integers(1, 50))
        rows = data.draw(st.lists(row, max_size=10)) if count else []
        lineage = identity.assign(count, shared(*rows))
        now = set(lineage.ids.tolist())
        assert len(now) == count
        assert now.isdisjoint(dead)
        assert now - alive == set(lineage.created)
        assert set(lineage.created).isdisjoint(ever)
        assert {t.plane_id for t in lineage.retired} == alive - now
        assert list(lineage.retired) == sorted(lineage.retired, key=lambda t: t.plane_id)
        assert all(t.subsumed_by in {0, *now} for t in lineage.retired)
        ever |= now
        dead |= alive - now
        alive = now
