"""Folding updates gives the map: the same bytes as a snapshot of it."""

from __future__ import annotations

from dataclasses import replace

import pytest
from hypothesis import given
from hypothesis import strategies as st

from examples import plane
from facet_protocol import MapMirror, MapUpdate, Plane, ProtocolError, Tombstone
from facet_protocol.maps import decode_update, encode_update


def update(
    base: int, changed: dict[int, float], retired: tuple[int, ...] = (), step: int = 1
) -> MapUpdate:
    planes = tuple(plane(i, d) for i, d in sorted(changed.items()))
    tombstones = tuple(Tombstone(i, 0) for i in sorted(retired))
    revision = base + step
    return MapUpdate("office", revision, base, 100 + revision, planes, tombstones, ())


class Truth:
    """The map itself, in the plainest way."""

    def __init__(self) -> None:
        self.planes: dict[int, Plane] = {}
        self.last: MapUpdate | None = None

    def apply(self, change: MapUpdate) -> None:
        for p in change.changed:
            self.planes[p.id] = p
        for t in change.retired:
            del self.planes[t.plane_id]
        self.last = change

    def snapshot(self) -> MapUpdate:
        assert self.last is not None
        planes = tuple(p for _, p in sorted(self.planes.items()))
        return replace(self.last, base_revision=0, changed=planes, retired=(), events=())


@given(data=st.data())
def test_updates_however_lost_end_in_the_snapshot(data: st.DataObject) -> None:
    """Some updates are lost; the client asks for a snapshot when it is told of a gap."""
    truth, mirror = Truth(), MapMirror()
    for base in range(data.draw(st.integers(1, 8))):
        alive = sorted(truth.planes)
        gone = data.draw(st.lists(st.sampled_from(alive), unique=True)) if alive else []
        ids = st.integers(1, 12).filter(lambda i, gone=gone: i not in gone)
        changed = data.draw(st.dictionaries(ids, st.floats(0.0, 9.0), max_size=3))
        change = update(base, changed, tuple(gone))
        truth.apply(change)
        if data.draw(st.booleans()):
            continue  # lost
        if not mirror.apply(decode_update(encode_update(change))):
            assert mirror.apply(truth.snapshot())
        assert encode_update(mirror.snapshot()) == encode_update(truth.snapshot())


def test_a_gap_is_told_and_changes_nothing() -> None:
    mirror = MapMirror()
    assert mirror.apply(update(0, {1: 1.0}))
    before = encode_update(mirror.snapshot())
    assert not mirror.apply(update(2, {2: 2.0}))
    assert encode_update(mirror.snapshot()) == before
    assert mirror.revision == 1


def test_what_is_known_already_changes_nothing() -> None:
    mirror = MapMirror()
    for base in range(3):
        assert mirror.apply(update(base, {1: float(base)}))
    before = encode_update(mirror.snapshot())
    assert mirror.apply(update(1, {1: 99.0}))
    assert encode_update(mirror.snapshot()) == before


def test_a_delta_from_before_catches_up() -> None:
    mirror = MapMirror()
    mirror.apply(update(0, {1: 1.0, 2: 2.0}))
    mirror.apply(update(1, {1: 1.5}))
    assert mirror.apply(update(1, {1: 1.75, 3: 3.0}, retired=(2,), step=4))  # snapshot?since=1
    assert sorted(mirror.planes) == [1, 3]
    assert (mirror.revision, mirror.stamp_ns) == (5, 105)


def test_a_snapshot_replaces_everything() -> None:
    mirror = MapMirror()
    mirror.apply(update(0, {1: 1.0, 2: 2.0}, step=9))
    assert mirror.apply(update(0, {3: 3.0}, step=2))  # the service began anew
    assert sorted(mirror.planes) == [3]
    assert mirror.revision == 2


def test_another_map_is_refused() -> None:
    mirror = MapMirror("office")
    with pytest.raises(ProtocolError) as caught:
        mirror.apply(replace(update(0, {}), map_id="hall"))
    assert caught.value.reason == "wrong_map"
