"""Where to look at a model from: along its walls' own directions, and under its ceilings."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from facet.export.triangles import inward_normal
from facet_protocol.messages import Plane, PlaneClass, PlaneFrame

ELEVATION = np.radians(48.0)
TURN = np.radians(28.0)  # off the walls' own direction, so that no wall is seen edge on


def is_overhead(plane: Plane) -> bool:
    """A ceiling, or a slope that looks down: it hides the rooms from whoever looks from above."""
    if plane.plane_class is PlaneClass.OTHER:
        return bool(inward_normal(plane)[2] < 0.0)
    return plane.plane_class is PlaneClass.CEILING


def corners(planes: Iterable[Plane]) -> NDArray[np.float64]:
    """(M, 3) m, world: every finite vertex of the outlines."""
    rings = [plane.lift(surface.outer) for plane in planes for surface in plane.surfaces]
    whole = np.concatenate([np.zeros((0, 3)), *rings])
    return np.asarray(whole[np.isfinite(whole).all(axis=1)])


def walls_azimuth(planes: Sequence[Plane]) -> float:
    """rad in [-pi/4, pi/4]: how far most wall area is turned off the world's axes."""
    fold = 0.0 + 0.0j  # walls a quarter turn apart count as one direction
    for plane in planes:
        if plane.plane_class is PlaneClass.WALL:
            angle = np.arctan2(plane.normal[1], plane.normal[0])
            fold += sum(s.area_m2 for s in plane.surfaces) * np.exp(4j * angle)
    return float(np.angle(fold)) / 4.0


def turned(plane: Plane, angle: float) -> Plane:
    """The same plane in a world turned by -angle (rad) about z: what lay along it lies along x."""
    c, s = np.cos(angle), np.sin(angle)
    R = np.array([[c, s, 0.0], [-s, c, 0.0], [0.0, 0.0, 1.0]])
    f = plane.frame
    frame = PlaneFrame(R @ f.axis_u, R @ f.axis_v, R @ f.axis_n, f.step_m)
    return replace(plane, normal=R @ plane.normal, centroid=R @ plane.centroid, frame=frame)


def view_rotation(planes: Sequence[Plane]) -> NDArray[np.float64]:
    """(3, 3) rows right, up, towards the viewer: from the south, turned off the walls."""
    azimuth = walls_azimuth(planes) - np.pi / 2.0 + TURN
    right = np.array([-np.sin(azimuth), np.cos(azimuth), 0.0])
    level = np.array([np.cos(azimuth), np.sin(azimuth), 0.0])
    towards = np.cos(ELEVATION) * level + np.sin(ELEVATION) * np.array([0.0, 0.0, 1.0])
    return np.stack([right, np.cross(towards, right), towards])
