"""Bounded planar polygons with holes, and the builders of walls, boxes and rooms. No sensors."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from facet_protocol.messages import PlaneClass

Float = NDArray[np.float64]
Vector = Sequence[float] | Float
UP = (0.0, 0.0, 1.0)


@dataclass(frozen=True, slots=True)
class Opening:
    """A rectangle left out of a wall: its extent along the wall's axis (x or y) and in z, m.

    "door" and "window" let beams through, "glass" returns nothing, "recess" has a face behind.
    """

    what: str
    lo: float
    hi: float
    bottom: float
    top: float


@dataclass(frozen=True, slots=True, eq=False)
class TruthHole:
    what: str  # "door" | "window" | "glass" | "recess"
    ring: Float  # (M, 2) m, the surface's (u, v), clockwise


@dataclass(frozen=True, slots=True, eq=False)
class TruthSurface:
    """One face of a solid, seen only from the side of its normal, axis_u x axis_v."""

    name: str
    origin: Float  # (3,) m, world
    axis_u: Float  # (3,) unit
    axis_v: Float  # (3,) unit
    outer: Float  # (M, 2) m, counter-clockwise seen from the side of the normal
    holes: tuple[TruthHole, ...] = ()
    planar: bool = True  # False: a facet of something curved

    @property
    def normal(self) -> Float:
        """(3,) unit, towards the side the surface is seen from."""
        return np.cross(self.axis_u, self.axis_v)

    @property
    def d(self) -> float:
        """normal . x = d, m; its sign is free here."""
        return float(self.normal @ self.origin)

    @property
    def plane_class(self) -> PlaneClass:
        """Floor and ceiling within 15 degrees of level, walls within 15 degrees of upright."""
        n_z = float(self.normal[2])
        if abs(n_z) >= np.cos(np.radians(15.0)):
            return PlaneClass.FLOOR if n_z > 0.0 else PlaneClass.CEILING
        return PlaneClass.WALL if abs(n_z) <= np.sin(np.radians(15.0)) else PlaneClass.OTHER

    @property
    def area_m2(self) -> float:
        return ring_area(self.outer) + sum(ring_area(hole.ring) for hole in self.holes)

    def lift(self, ring: Float) -> Float:
        """World coordinates (M, 3) m of (u, v) vertices (M, 2) m."""
        return np.asarray(self.origin + ring[:, :1] * self.axis_u + ring[:, 1:] * self.axis_v)

    def moved(self, R_world_scene: Float, shift: Float) -> TruthSurface:
        """The surface turned by R_world_scene (3, 3) and moved by `shift` (3,) m."""
        return replace(
            self,
            origin=R_world_scene @ self.origin + shift,
            axis_u=R_world_scene @ self.axis_u,
            axis_v=R_world_scene @ self.axis_v,
        )


def ring_area(ring: Float) -> float:
    """Signed area, m2: positive when counter-clockwise (shoelace)."""
    x, y = ring[:, 0], ring[:, 1]
    return float(0.5 * np.sum(x * np.roll(y, -1) - y * np.roll(x, -1)))


def rectangle_ring(u0: float, u1: float, v0: float, v1: float) -> Float:
    """(4, 2), counter-clockwise."""
    return np.array([[u0, v0], [u1, v0], [u1, v1], [u0, v1]], dtype=np.float64)


def polygon(
    name: str,
    origin: Vector,
    axis_u: Vector,
    axis_v: Vector,
    outer: Any,
    holes: Iterable[TruthHole] = (),
    planar: bool = True,
) -> TruthSurface:
    """A surface from any ring (M, 2) m about `origin`; rings are turned the right way round."""
    ring = np.asarray(outer, dtype=np.float64)
    ring = ring if ring_area(ring) > 0.0 else ring[::-1].copy()
    return TruthSurface(
        name,
        np.asarray(origin, dtype=np.float64),
        np.asarray(axis_u, dtype=np.float64),
        np.asarray(axis_v, dtype=np.float64),
        ring,
        tuple(holes),
        planar,
    )


def level(name: str, outline: Any, z: float, *, looks_up: bool) -> TruthSurface:
    """A floor or a ceiling: `outline` (M, 2) m in x, y at height `z`."""
    xy = np.asarray(outline, dtype=np.float64)
    if looks_up:
        return polygon(name, (0, 0, z), (1, 0, 0), (0, 1, 0), xy)
    return polygon(name, (0, 0, z), (0, 1, 0), (1, 0, 0), xy[:, ::-1])


def level_rectangle(
    name: str, x: tuple[float, float], y: tuple[float, float], z: float, *, looks_up: bool
) -> TruthSurface:
    return level(name, rectangle_ring(*x, *y), z, looks_up=looks_up)


def wall(
    name: str,
    start: tuple[float, float],
    end: tuple[float, float],
    z: tuple[float, float],
    openings: Iterable[Opening] = (),
    *,
    profile: Sequence[tuple[float, float]] | None = None,
    planar: bool = True,
) -> TruthSurface:
    """An upright face seen from the right of the walk from `start` to `end` (x, y).

    `profile`, in the openings' coordinates (axis, z), replaces the rectangle.
    """
    a, b = np.array([*start, 0.0]), np.array([*end, 0.0])
    length = float(np.linalg.norm(b - a))
    direction = (b - a) / length
    axis = int(np.argmax(np.abs(direction)))
    sign = 1.0 if direction[axis] > 0.0 else -1.0

    def along(coordinate: float) -> float:
        return float(sign * (coordinate - a[axis]))

    ring = rectangle_ring(0.0, length, *z)
    if profile is not None:
        ring = np.array([[along(s), height] for s, height in profile])
    holes = []
    for opening in openings:
        u0, u1 = sorted((along(opening.lo), along(opening.hi)))
        hole = rectangle_ring(u0, u1, opening.bottom, opening.top)[::-1].copy()
        holes.append(TruthHole(opening.what, hole))
    return polygon(name, a, direction, UP, ring, holes, planar)


def room_walls(
    name: str,
    x: tuple[float, float],
    y: tuple[float, float],
    z: tuple[float, float],
    openings: Mapping[str, Iterable[Opening]] | None = None,
    sides: str = "SWNE",
) -> list[TruthSurface]:
    """The walls of a room seen from inside; `openings` by side, S (low y), W (low x), N, E."""
    corners = {
        "S": ((x[1], y[0]), (x[0], y[0])),
        "W": ((x[0], y[0]), (x[0], y[1])),
        "N": ((x[0], y[1]), (x[1], y[1])),
        "E": ((x[1], y[1]), (x[1], y[0])),
    }
    by_side = openings or {}
    return [wall(f"{name} {s}", *corners[s], z, by_side.get(s, ())) for s in sides]


def box(
    name: str,
    x: tuple[float, float],
    y: tuple[float, float],
    z: tuple[float, float],
    sides: str = "SWNET",
) -> list[TruthSurface]:
    """A solid seen from outside: upright faces S W N E, T the top, B the underside."""
    corners = {
        "S": ((x[0], y[0]), (x[1], y[0])),
        "E": ((x[1], y[0]), (x[1], y[1])),
        "N": ((x[1], y[1]), (x[0], y[1])),
        "W": ((x[0], y[1]), (x[0], y[0])),
    }
    faces = [wall(f"{name} {s}", *corners[s], z) for s in sides if s in corners]
    if "T" in sides:
        faces.append(level_rectangle(f"{name} top", x, y, z[1], looks_up=True))
    if "B" in sides:
        faces.append(level_rectangle(f"{name} underside", x, y, z[0], looks_up=False))
    return faces


def reveal(
    name: str, x: tuple[float, float], y: tuple[float, float], top: float, *, through: str
) -> list[TruthSurface]:
    """Jambs and lintel of a passage along `through` ("x" or "y") in a wall that fills x, y."""
    if through == "y":
        jambs = [
            wall(f"{name} jamb low", (x[0], y[0]), (x[0], y[1]), (0.0, top)),
            wall(f"{name} jamb high", (x[1], y[1]), (x[1], y[0]), (0.0, top)),
        ]
    else:
        jambs = [
            wall(f"{name} jamb low", (x[1], y[0]), (x[0], y[0]), (0.0, top)),
            wall(f"{name} jamb high", (x[0], y[1]), (x[1], y[1]), (0.0, top)),
        ]
    return [*jambs, level_rectangle(f"{name} lintel", x, y, top, looks_up=False)]


def table(
    name: str, x: tuple[float, float], y: tuple[float, float], top: float = 0.74
) -> list[TruthSurface]:
    """A slab of 4 cm on four legs of 6 cm, standing on z = 0."""
    faces = box(name, x, y, (top - 0.04, top), "SWNETB")
    for i, px in enumerate((x[0] + 0.05, x[1] - 0.11)):
        for j, py in enumerate((y[0] + 0.05, y[1] - 0.11)):
            leg = f"{name} leg {2 * i + j}"
            faces += box(leg, (px, px + 0.06), (py, py + 0.06), (0.0, top - 0.04), "SWNE")
    return faces
