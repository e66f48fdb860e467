"""The map's messages: lossless, one encoding a value, and checked on the way in."""

from __future__ import annotations

import struct
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from examples import CREATED, EXAMPLES, plane
from facet_protocol import EventKind, HoleKind, MapUpdate, PlaneClass, ProtocolError, TilePoints
from facet_protocol.maps import (
    decode_events,
    decode_plane,
    decode_tile,
    decode_update,
    encode_plane,
    encode_tile,
    encode_update,
)
from facet_protocol.proto import map_pb2 as pb

UPDATE = EXAMPLES["facet.v1.MapUpdate"]
assert isinstance(UPDATE, MapUpdate)


@given(bits=st.lists(st.integers(0, 2**64 - 1), min_size=2, max_size=2))
def test_floats_travel_by_their_bits(bits: list[int]) -> None:
    sigma, rms = struct.unpack("<2d", struct.pack("<2Q", *bits))
    if sigma != sigma or rms != rms:
        return  # the bits of a NaN are nobody's
    sent = replace(plane(1), sigma_n_m=sigma, rms_m=rms)
    received = decode_plane(encode_plane(sent))
    pair = struct.pack("<2d", received.sigma_n_m, received.rms_m)
    assert struct.unpack("<2Q", pair) == tuple(bits)


def test_a_plane_comes_back_with_every_field() -> None:
    sent = plane(3)
    received = decode_plane(encode_plane(sent))
    for name in ("normal", "covariance", "centroid"):
        assert getattr(received, name).tobytes() == getattr(sent, name).tobytes()
    assert np.signbit(received.normal[1])
    assert [s.id for s in received.surfaces] == [7, 8]
    assert received.surfaces[0].outer.dtype == np.int32
    assert received.surfaces[0].outer.tolist() == sent.surfaces[0].outer.tolist()
    assert [h.kind for h in received.surfaces[0].holes] == [HoleKind.OPENING, HoleKind.UNOBSERVED]
    assert received.surfaces[0].holes[1].ring.tolist() == [[-300, 50], [-300, 90], [-360, 90]]
    assert received.robots == ("r1", "r2")
    assert (received.plane_class, received.facing) == (PlaneClass.WALL, -1)


def test_numpy_scalars_are_taken_as_the_numbers_they_are() -> None:
    sent = plane(3)
    numpy = replace(sent, id=np.int64(3), num_points=np.int64(48_211), d=np.float64(sent.d))
    assert encode_plane(numpy) == encode_plane(sent)


def test_numbers_on_the_wire_are_the_names_in_the_schema() -> None:
    """The codec counts the enumerations; this pins them to the .proto's own names."""
    for kinds, enum, prefix in (
        (PlaneClass, pb.PlaneClass, "PLANE_CLASS"),
        (HoleKind, pb.HoleKind, "HOLE_KIND"),
        (EventKind, pb.EventKind, "EVENT_KIND"),
    ):
        names = [f"{prefix}_{kind.name}" for kind in kinds]
        assert [enum.Value(name) for name in names] == list(range(1, len(names) + 1))
        assert len(enum.keys()) == len(names) + 1


Change = Callable[[pb.MapUpdate], object]
BAD_UPDATES: dict[str, Change] = {
    "facing": lambda m: setattr(m.changed[0], "facing", 0),
    "class": lambda m: setattr(m.changed[0], "plane_class", 0),
    "new class": lambda m: setattr(m.changed[0], "plane_class", 17),
    "normal of two": lambda m: m.changed[0].normal.pop(),
    "normal not finite": lambda m: m.changed[0].normal.__setitem__(0, np.nan),
    "d not finite": lambda m: setattr(m.changed[0], "d", np.inf),
    "covariance of fifteen": lambda m: m.changed[0].covariance.pop(),
    "no frame": lambda m: m.changed[0].ClearField("frame"),
    "half a vertex": lambda m: m.changed[0].surfaces[0].outer.pop(),
    "hole of no kind": lambda m: setattr(m.changed[0].surfaces[0].holes[0], "kind", 0),
    "ids not ascending": lambda m: setattr(m.changed[1], "id", 3),
    "id zero": lambda m: setattr(m.changed[0], "id", 0),
    "tombstones not ascending": lambda m: setattr(m.retired[1], "plane_id", 1),
    "events not ascending": lambda m: setattr(m.events[1], "number", 11),
    "event of no kind": lambda m: setattr(m.events[0], "kind", 0),
    "base after revision": lambda m: setattr(m, "base_revision", 10),
}


@pytest.mark.parametrize("change", BAD_UPDATES.values(), ids=BAD_UPDATES.keys())
def test_values_that_cannot_be_are_refused(change: Change) -> None:
    message = pb.MapUpdate.FromString(encode_update(UPDATE))
    change(message)
    with pytest.raises(ProtocolError) as caught:
        decode_update(message.SerializeToString())
    assert caught.value.reason == "malformed"


def test_events_are_numbered_in_order() -> None:
    twice = pb.Events(map_id="m", events=[pb.Event(number=11, kind=1), pb.Event(number=11, kind=1)])
    with pytest.raises(ProtocolError, match="event 11 after 11"):
        decode_events(twice.SerializeToString())
    assert CREATED.number == 11


@given(num=st.integers(0, 20), seed=st.integers(0, 99))
def test_tiles_come_back(num: int, seed: int) -> None:
    rng = np.random.default_rng(seed)
    centroids = rng.integers(0, 512, (num, 3), dtype=np.uint16)
    sent = TilePoints((-7, 2, 0), 0.05, centroids, rng.integers(-1, 9, num, dtype=np.int32))
    received = decode_tile(encode_tile(sent))
    assert received.tile == sent.tile
    assert received.centroids.tolist() == centroids.tolist()
    assert received.plane_ids.tolist() == sent.plane_ids.tolist()
    assert received.xyz().shape == (num, 3)


@pytest.mark.parametrize(
    ("centroids", "plane_ids", "tile", "voxel_m"),
    [
        (b"\0" * 6, b"", [0, 0, 0], 0.05),
        (b"\0" * 5, b"\0" * 4, [0, 0, 0], 0.05),
        (b"", b"\0" * 4, [0, 0, 0], 0.05),
        (b"", b"", [0, 0], 0.05),
        (b"", b"", [0, 0, 0], 0.0),
        (b"", b"", [0, 0, 0], np.nan),
    ],
)
def test_tiles_that_do_not_hold_together_are_refused(
    centroids: bytes, plane_ids: bytes, tile: list[int], voxel_m: float
) -> None:
    message = pb.TilePoints(tile=tile, voxel_m=voxel_m, centroids=centroids, plane_ids=plane_ids)
    with pytest.raises(ProtocolError):
        decode_tile(message.SerializeToString())
