"""The scenes: surfaces whose truth is exact, and a drive through them."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from facet.simulate import corridor, hall, office
from facet.simulate.drive import Drive
from facet.simulate.sensors import about_z, rotation
from facet.simulate.surfaces import TruthSurface


@dataclass(frozen=True, slots=True, eq=False)
class Scene:
    """Faces of solids, closed but for the openings in outer walls, and a way through them."""

    name: str
    surfaces: tuple[TruthSurface, ...]
    drive: Drive

    def moved(self, turn_deg: float, shift: Sequence[float]) -> Scene:
        """Turned about z, then moved by `shift` (3,) m."""
        R_world_scene, move = rotation(about_z(np.radians(turn_deg))), np.asarray(shift)
        surfaces = tuple(s.moved(R_world_scene, move) for s in self.surfaces)
        return Scene(self.name, surfaces, self.drive.moved(R_world_scene, move))


def _scene(
    name: str,
    surfaces: list[TruthSurface],
    waypoints: Sequence[tuple[float, float, float]],
) -> Scene:
    return Scene(name, tuple(surfaces), Drive(np.array(waypoints, dtype=np.float64)))


def corridor_scene() -> Scene:
    """Along the axes, with the floor at z = 0: where the sign of d is hardest to keep."""
    return _scene("corridor", corridor.corridor_surfaces(), corridor.WAYPOINTS)


def hall_scene() -> Scene:
    return _scene("hall", hall.hall_surfaces(), hall.WAYPOINTS).moved(31.0, (-4.1, 2.3, 0.0))


def large_hall_scene() -> Scene:
    large = _scene("hall85k", hall.large_hall_surfaces(), hall.LARGE_WAYPOINTS)
    return large.moved(-22.0, (1.7, 5.9, -1.26))


def office_scene() -> Scene:
    return _scene("office", office.office_surfaces(), office.WAYPOINTS).moved(
        17.3, (3.2, -7.1, 0.43)
    )


SCENES: dict[str, Callable[[], Scene]] = {
    "corridor": corridor_scene,
    "hall": hall_scene,
    "hall85k": large_hall_scene,
    "office": office_scene,
}
