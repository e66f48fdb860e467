"""Outlines kept up by tiles are those of the whole, made anew."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from alpha_oracle import boundary, regular
from facet.mapping.contours import (
    FRAME_UNIT,
    Contour,
    ContourField,
    make_frame,
    round_normal,
)
from facet.mapping.invariants import crossings
from facet.mapping.mapper import Mapper
from facet.mapping.rings import stitch, surfaces_of
from mapping_logs import cloud, log, mapped, wall

LOGS = ("room-lidar3d", "room-depth")


def edges_of(contour: Contour) -> set[tuple[int, ...]]:
    return {tuple(e) for edges in contour.edges.values() for e in edges.tolist()}


def points_of(contour: Contour) -> NDArray[np.int64]:
    """All grid points of a plane's outline."""
    shares = [share.points + np.array(share.corner) for share in contour.shares.values()]
    return np.unique(np.concatenate(shares).astype(np.int64), axis=0)


@pytest.mark.parametrize("name", LOGS)
def test_incremental_outlines_equal_fresh_ones(name: str) -> None:
    whole = log(name)
    mapper = mapped(whole.shuffled(3).scans, whole.settings, every=2)
    for scan in whole.scans[::3]:
        mapper.retract(scan)
        mapper.update()
    kept = mapper._contours.contours
    normals = {i: np.array(c.rounded) / FRAME_UNIT for i, c in kept.items()}
    assert normals
    fresh = ContourField(whole.settings)
    tiles = mapper._tiles.tiles
    assert fresh.update(mapper._store, tiles, set(tiles), normals, {}) == set(normals)
    for plane_id, one in kept.items():
        two = fresh.contours[plane_id]
        assert two.shares.keys() == one.shares.keys()
        assert edges_of(one) == edges_of(two)
        for a, b in zip(one.outlines, two.outlines, strict=True):
            np.testing.assert_array_equal(a.outer, b.outer)
            assert a.area == b.area
            for h, k in zip(a.holes, b.holes, strict=True):
                np.testing.assert_array_equal(h, k)
    mapper.check_invariants()


@pytest.mark.parametrize("name", LOGS)
def test_outlines_by_tiles_are_those_of_the_whole_alpha_complex(name: str) -> None:
    whole = log(name)
    mapper = mapped(whole.scans, whole.settings, every=4)
    for contour in mapper._contours.contours.values():
        edges = np.array(sorted(edges_of(contour)), np.int64).reshape(-1, 4)
        assert regular(edges) == boundary(points_of(contour))[0]


def test_a_changed_corner_moves_few_tiles() -> None:
    rng = np.random.default_rng(0)
    mapper = mapped([cloud(wall(rng, 200_000, (16.0, 3.0)), at=(0.0, 8.0, 1.5))])
    assert mapper._contours.rolled >= 5
    more = np.add(wall(rng, 60, (0.2, 0.2)), [0.0, 0.05, 3.1])
    mapper.insert(cloud(more, at=(0.0, 0.0, 1.5), sequence=2))
    mapper.update()
    assert 0 < mapper._contours.rolled <= 4
    mapper.check_invariants()


def test_a_plane_that_is_gone_has_no_outline() -> None:
    scan = cloud(wall(np.random.default_rng(0), 20_000, (3.0, 2.0)), at=(0.0, 2.0, 1.5))
    mapper = mapped([scan])
    assert len(mapper._contours.contours) == 1
    mapper.retract(scan)
    mapper.update()
    assert mapper._contours.contours == {}


def normals() -> NDArray[np.float64]:
    spread = np.random.default_rng(1).normal(size=(300, 3))
    axes = np.concatenate([np.eye(3), -np.eye(3)])
    return np.concatenate([axes, spread / np.linalg.norm(spread, axis=1, keepdims=True)])


def test_a_frame_is_right_handed_and_faces_like_its_plane() -> None:
    for normal in normals():
        frame = make_frame(round_normal(normal), 0.05)
        axes = np.stack([frame.axis_u, frame.axis_v, frame.axis_n])
        np.testing.assert_allclose(axes @ axes.T, np.eye(3), atol=1e-12)
        assert np.linalg.det(axes) == pytest.approx(1.0)
        assert frame.axis_n @ normal > np.cos(np.radians(2.0))
        assert frame.step_m == 0.05 / 8
        if abs(frame.axis_n[2]) < 0.9:
            assert abs(frame.axis_u[2]) < 1e-12  # level


def test_a_frame_moves_rarely() -> None:
    normal = np.array([0.8, 0.6, 0.01]) / np.linalg.norm([0.8, 0.6, 0.01])
    assert round_normal(normal) == round_normal(normal + 1e-4)
    assert make_frame(round_normal(normal), 0.05).axis_u.tobytes() == (
        make_frame(round_normal(normal + 1e-4), 0.05).axis_u.tobytes()
    )


def noisy() -> Mapper:
    whole = log("office-lidar3d")
    return mapped(whole.scans, whole.settings)


def test_rings_do_not_cross_themselves_before_they_are_moved_out() -> None:
    for contour in noisy()._contours.contours.values():
        for ring in stitch(np.array(sorted(edges_of(contour)), np.int64).reshape(-1, 4)):
            assert len(crossings(ring)) == 0


def test_the_order_of_tiles_does_not_matter_to_surfaces() -> None:
    for contour in noisy()._contours.contours.values():
        edges = np.array(sorted(edges_of(contour)), np.int64).reshape(-1, 4)
        mixed = np.random.default_rng(2).permutation(edges)
        for a, b in zip(surfaces_of(edges, 8.0), surfaces_of(mixed, 8.0), strict=True):
            np.testing.assert_array_equal(a.outer, b.outer)
