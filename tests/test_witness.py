"""Who saw a tile, and when."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from facet.mapping.blocks import pack
from facet.mapping.quantise import quantise
from facet.mapping.settings import MapSettings
from facet.mapping.witness import Witness
from facet_protocol.messages import Scan
from mapping_logs import cloud

SETTINGS = MapSettings()  # tiles of 3.2 m
HERE, THERE = pack(0, 0, 0), pack(1, -1, 0)


def scan(stamp_ns: int, robot: str, *points: tuple[float, float, float]) -> Scan:
    made = cloud(np.array(points).reshape(-1, 3), at=(0.0, 0.0, 9.0))
    return replace(made, stamp_ns=stamp_ns, robot=robot)


def noted(*scans: Scan) -> Witness:
    witness = Witness()
    if scans:
        witness.note(quantise(scans, SETTINGS), scans)
    return witness


def test_sightings_by_tile() -> None:
    witness = noted(
        scan(50, "a", (1.0, 1.0, 1.0), (4.0, -1.0, 1.0), (1.0, 1.0, 1.0)),
        scan(20, "b", (2.0, 2.0, 2.0)),
        scan(90, "a", (4.0, -2.0, 0.1)),
    )
    here, there, both = witness.of([HERE]), witness.of([THERE]), witness.of([HERE, THERE])
    assert (here.first_ns, here.last_ns, here.robots) == (20, 50, {"a", "b"})
    assert (there.first_ns, there.last_ns, there.robots) == (50, 90, {"a"})
    assert (both.first_ns, both.last_ns, both.robots) == (20, 90, {"a", "b"})


def test_what_nobody_saw() -> None:
    nothing = noted().of([HERE])
    assert (nothing.first_ns, nothing.last_ns, nothing.robots) == (0, 0, set())
    assert noted(scan(5, "a")).of([HERE, THERE]).robots == set()
