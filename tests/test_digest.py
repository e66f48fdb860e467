"""Two hashes: free of order and ids, and computed again from the file."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from facet.export.model import build_model, read_model, write_model
from facet.mapping.digest import derived_digest, model_planes, state_digest
from facet.mapping.freespace import FreeSpace
from facet.mapping.mapper import Mapper
from facet.mapping.store import VoxelStore
from facet_protocol.messages import HoleKind, Plane, PlaneClass
from mapping_logs import LOGS, log, mapped
from office import planes as example_planes

COUNTS = {"voxels": 900, "aligned": 1, "thick": 2, "sparse": 3, "discarded": 40}


def digest(planes: list[Plane], **counts: int) -> str:
    return derived_digest(model_planes(planes), COUNTS | counts)


@pytest.mark.parametrize("name", LOGS)
def test_the_file_gives_the_mappers_own_digest(name: str, tmp_path: Path) -> None:
    whole = log(name)
    mapper = mapped(whole.scans, whole.settings)
    told = mapper.digest()
    model = build_model(mapper.snapshot(), mapper.counts(), whole.settings.as_dict(), told)
    write_model(model, tmp_path / "model.json")
    read: dict[str, Any] = read_model(tmp_path / "model.json")
    assert derived_digest(read["planes"], read["counts"]) == told.derived
    assert read["digest"] == {"state": told.state, "derived": told.derived}


def planes() -> list[Plane]:
    found = list(example_planes())
    assert any(len(s.holes) > 1 for p in found for s in p.surfaces)
    return found


def test_order_and_ids_do_not_matter() -> None:
    told = digest(planes())
    mixed = [replace(p, id=90 - p.id, revision=7, robots=("x",)) for p in planes()[::-1]]
    assert digest(mixed) == told
    turned = [
        replace(p, surfaces=tuple(replace(s, id=5, holes=s.holes[::-1]) for s in p.surfaces[::-1]))
        for p in planes()
    ]
    assert digest(turned) == told


def changes() -> dict[str, Plane]:
    """A wall with holes, changed in one thing each."""
    wall = next(p for p in planes() if any(s.holes for s in p.surfaces))
    surface = next(s for s in wall.surfaces if s.holes)
    hole = surface.holes[0]
    other = HoleKind.OPENING if hole.kind is HoleKind.UNOBSERVED else HoleKind.UNOBSERVED
    step = np.zeros_like(surface.outer)
    step[0, 0] = 1

    def with_hole(**new: Any) -> Plane:
        holes = (replace(hole, **new), *surface.holes[1:])
        return replace(wall, surfaces=(replace(surface, holes=holes),))

    return {
        "normal": replace(wall, normal=np.nextafter(wall.normal, 2.0)),
        "d": replace(wall, d=np.nextafter(wall.d, 9.0)),
        "sigma": replace(wall, sigma_n_m=wall.sigma_n_m * (1 + 1e-15)),
        "facing": replace(wall, facing=-wall.facing),
        "class": replace(wall, plane_class=PlaneClass.OTHER),
        "outer": replace(wall, surfaces=(replace(surface, outer=surface.outer + step),)),
        "hole kind": with_hole(kind=other),
        "hole ring": with_hole(ring=hole.ring[:-1]),
        "no hole": replace(wall, surfaces=(replace(surface, holes=surface.holes[1:]),)),
        "same": replace(wall, surfaces=(surface,)),
    }  # fmt: skip


def test_the_smallest_change_shows() -> None:
    digests = {name: digest([plane]) for name, plane in changes().items()}
    assert len(set(digests.values())) == len(digests)


@pytest.mark.parametrize("name", COUNTS)
def test_the_remainder_counts(name: str) -> None:
    assert digest(planes(), **{name: 12345}) != digest(planes())


def test_minus_zero_is_zero() -> None:
    one = planes()[0]
    plus, minus = (replace(one, normal=np.array([z, 0.0, 1.0])) for z in (0.0, -0.0))
    assert digest([plus]) == digest([minus])


def test_the_state_is_that_of_nothing_when_nothing_is_left() -> None:
    assert Mapper().digest().state == state_digest(VoxelStore(), FreeSpace())


def test_the_state_hears_of_beams_alone() -> None:
    whole = log("room-lidar3d")
    scan = next(s for s in whole.scans if len(s.no_return))
    deaf = replace(scan, no_return=scan.no_return[:0])
    one, two = mapped([scan]).digest(), mapped([deaf]).digest()
    assert one.state != two.state
