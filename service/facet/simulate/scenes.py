"""The scenes: surfaces whose truth is exact, and a drive through them."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from facet.simulate import office
from facet.simulate.drive import Drive
from facet.simulate.sensors import about_z, rotation
from facet.simulate.surfaces import TruthSurface


@dataclass(frozen=True, slots=True, eq=False)
class Scene:
    name: str
    surfaces: tuple[TruthSurface, ...]
    drive: Drive


def office_scene(
    *, turn_deg: float = 17.3, shift: tuple[float, float, float] = (3.2, -7.1, 0.43)
) -> Scene:
    """Rooms on both sides of a corridor; thin walls, a step, a slanted ceiling, a curved wall."""
    R_world_scene = rotation(about_z(np.radians(turn_deg)))
    move = np.asarray(shift)
    surfaces = tuple(s.moved(R_world_scene, move) for s in office.office_surfaces())
    drive = Drive(np.array(office.WAYPOINTS, dtype=np.float64)).moved(R_world_scene, move)
    return Scene("office", surfaces, drive)


SCENES: dict[str, Callable[[], Scene]] = {"office": office_scene}
