"""A hole is an opening where beams went through the plane, before it, on it and behind it."""

from __future__ import annotations

import numpy as np
import pytest

from facet.mapping.contours import make_frame, round_normal
from facet.mapping.freespace import CELL, FreeSpace
from facet.mapping.openings import hole_kind, probes, samples
from facet.mapping.quantise import quantise
from facet.mapping.settings import MapSettings
from facet_protocol.messages import HoleKind
from mapping_logs import cloud

SETTINGS = MapSettings()
INSIDE = np.array([-1.0, 0.0, 0.0])  # a wall at x = 2.03, seen from x < 2
OFFSET = -2.03
FRAME = make_frame(round_normal(INSIDE), SETTINGS.voxel_m)


def hole_at(y: float, z: float, width: float, height: float) -> np.ndarray:
    """The ring of a hole, in grid units."""
    corners = np.array([(y, z), (y + width, z), (y + width, z + height), (y, z + height)])
    world = np.stack([np.full(4, 2.03), *corners.T], axis=1)
    uv = np.stack([world @ FRAME.axis_u, world @ FRAME.axis_v], axis=1) / FRAME.step_m
    return np.floor(uv + 0.5).astype(np.int32)


def beams(seed: int, low: float, high: float, end: float = 4.0, count: int = 4000) -> FreeSpace:
    """Free space of empty beams from (0, 2, 1.7) to x = `end`, level and wide in [low, high]."""
    rng = np.random.default_rng(seed)
    yz = low + (high - low) * rng.random((2, count))
    ends = np.stack([np.full(count, end), *yz], axis=1)
    free = FreeSpace()
    scan = cloud(np.zeros((0, 3)), at=(0.0, 2.0, 1.7), no_return=ends)
    free.insert(quantise([scan], SETTINGS))
    return free


def kind_of(free: FreeSpace, ring: np.ndarray) -> HoleKind:
    return hole_kind(probes(samples(ring), FRAME, INSIDE, OFFSET, SETTINGS), free, SETTINGS)


def test_probes_lie_before_on_and_behind_the_plane() -> None:
    found = probes(samples(hole_at(1.5, 1.0, 1.0, 1.2)), FRAME, INSIDE, OFFSET, SETTINGS)
    world = (found + 0.5) * SETTINGS.tick_m
    before, on, behind = world
    step = CELL * SETTINGS.voxel_m
    for points, x in ((before, 2.03 - step), (on, 2.03), (behind, 2.03 + step)):
        np.testing.assert_allclose(points[:, 0], x, atol=1e-4)
        assert np.all((points[:, 1] > 1.5) & (points[:, 1] < 2.5))
        assert np.all((points[:, 2] > 1.0) & (points[:, 2] < 2.2))
    assert len(on) == pytest.approx(1.2 / (step / 2) ** 2, rel=0.3)


def test_beams_through_a_hole_make_it_an_opening() -> None:
    ring = hole_at(1.5, 1.2, 1.0, 1.0)
    assert kind_of(beams(0, 1.0, 3.0), ring) is HoleKind.OPENING
    assert kind_of(FreeSpace(), ring) is HoleKind.UNOBSERVED


def test_beams_that_end_before_the_plane_open_nothing() -> None:
    assert kind_of(beams(0, 1.0, 3.0, end=1.9), hole_at(1.5, 1.2, 1.0, 1.0)) is HoleKind.UNOBSERVED


def test_beams_beside_a_hole_open_nothing() -> None:
    assert kind_of(beams(0, 1.0, 3.0), hole_at(4.5, 1.2, 1.0, 1.0)) is HoleKind.UNOBSERVED


def test_a_share_of_the_hole_is_enough() -> None:
    assert kind_of(beams(0, 1.0, 2.2), hole_at(1.6, 1.6, 0.8, 0.8)) is HoleKind.OPENING
    assert kind_of(beams(0, 1.0, 1.8), hole_at(1.6, 1.6, 2.4, 2.4)) is HoleKind.UNOBSERVED


def test_too_few_beams_open_nothing() -> None:
    few = beams(0, 1.0, 3.0, count=8 * SETTINGS.passed_beams)
    assert kind_of(few, hole_at(1.5, 1.2, 1.0, 1.0)) is HoleKind.UNOBSERVED


def test_a_hole_too_small_to_sample_is_unobserved() -> None:
    assert kind_of(beams(0, 1.0, 3.0), hole_at(1.5, 1.2, 0.03, 0.03)) is HoleKind.UNOBSERVED
