"""Real recordings beside the project: the largest known planes are there. Skipped without them."""

from __future__ import annotations

from functools import cache

import pytest

from benchmarks.real import PLACES, Found, find, map_place
from facet.mapping.settings import MapSettings

LIMITS = {"corridor": 120, "rooms": None, "panels": None}  # scans
EXPECTED = (
    ("corridor", "floor"),
    ("rooms", "floor"),
    ("rooms", "ceiling"),
    ("panels", "panel 1"),
    ("panels", "panel 2"),
    ("panels", "panel 3"),
)


@cache
def found(name: str) -> dict[str, Found]:
    """What the map has of each known plane of a place."""
    place = next(p for p in PLACES if p.name == name)
    mapper, _ = map_place(place, MapSettings(), LIMITS[name])
    return {known.name: find(known, mapper.snapshot().changed) for known in place.known}


@pytest.mark.parametrize(("place", "name"), EXPECTED)
def test_a_known_plane_is_found(place: str, name: str) -> None:
    got = found(place)[name]
    assert got.plane is not None
    assert got.area_m2 >= 0.8
    assert abs(got.offset_m) <= 0.05
    assert got.angle_deg <= 2.0


def test_panels_are_planes_of_their_own() -> None:
    planes = [found("panels")[f"panel {k}"].plane for k in (1, 2, 3)]
    assert len({plane.id for plane in planes if plane is not None}) == 3
