"""The outlines that other mappers' voxels are given are the ones Facet gives its own."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from benchmarks import inside
from benchmarks.memberships import model_of_labels
from facet.mapping.mapper import Mapper
from facet_protocol.messages import HoleKind
from scenes import driven
from scorer import model_of, score


@pytest.fixture(scope="module")
def models() -> tuple[dict[str, Any], dict[str, Any], Any]:
    """Facet's model of a room, and the same from its voxels' plane ids alone."""
    room = driven("room", "lidar3d", 40)
    mapper = Mapper()
    for scan in room.scans:
        mapper.insert(scan)
    mapper.update()
    snapshot = mapper.snapshot()
    inward = {plane.id: plane.facing * plane.normal for plane in snapshot.changed}
    tiles = mapper.points()
    ids = np.concatenate([tile.plane_ids for tile in tiles])
    xyz = np.concatenate([tile.xyz() for tile in tiles]).astype(np.float64)
    on = ids > 0
    normals = np.array([inward[i] for i in ids[on].tolist()])
    free = inside.free_space(mapper)
    labels = ids[on].astype(np.int32)
    found = model_of_labels(labels, xyz[on], normals, free, mapper.settings)
    return model_of(snapshot), found, room.truth


def test_the_same_planes_are_found_as_well(models: Any) -> None:
    own, given, truth = (score(models[0], models[2]), score(models[1], models[2]), models[2])
    assert truth.surfaces
    assert given.num_found == own.num_found > 0
    assert given.planes == own.planes
    assert given.area_recall == pytest.approx(own.area_recall, abs=0.01)
    assert given.area_precision == pytest.approx(own.area_precision, abs=0.01)
    lost = set(given.openings_missed) - set(own.openings_missed)
    assert all(" door " in name for name in lost)  # a threshold is claimed by Facet's walls alone


def test_glass_is_told_from_what_was_not_observed(models: Any) -> None:
    def kinds(model: dict[str, Any]) -> set[str]:
        return {h["kind"] for p in model["planes"] for s in p["surfaces"] for h in s["holes"]}

    assert HoleKind.OPENING in kinds(models[1])
    assert kinds(models[1]) == kinds(models[0])
