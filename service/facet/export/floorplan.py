"""The plan of one storey: what a horizontal cut through the walls shows, in metres."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from enum import StrEnum

import numpy as np
from numpy.typing import NDArray

from facet_protocol.messages import HoleKind, Plane, PlaneClass, Surface

CUT_M = 1.2  # above the floor: through windows and doors
SILL_M = 0.4  # an opening that starts below this is a door


class Piece(StrEnum):
    SOLID = "wall"
    DOOR = "door"
    WINDOW = "window"
    UNOBSERVED = "unobserved"


@dataclass(frozen=True, slots=True, eq=False)
class Segment:
    """A piece of one wall at cut height, and the side from which the wall was seen."""

    piece: Piece
    ends: NDArray[np.float64]  # (2, 2) m, world x, y
    inward: NDArray[np.float64]  # (2,) unit, world x, y


def floor_level(planes: Sequence[Plane]) -> float:
    """z of the largest floor; without a floor, of the lowest vertex."""
    floors = [
        (surface.area_m2, float(plane.lift(surface.outer)[:, 2].mean()))
        for plane in planes
        if plane.plane_class is PlaneClass.FLOOR
        for surface in plane.surfaces
    ]
    if floors:
        return max(floors)[1]
    lows = [float(p.lift(s.outer)[:, 2].min()) for p in planes for s in p.surfaces]
    return min(lows, default=0.0)


def wall_segments(plane: Plane, surface: Surface, floor_z: float) -> list[Segment]:
    """The wall at cut height from end to end; empty where the cut passes above or below it."""
    inward = plane.facing * plane.normal[:2]
    inward = inward / np.linalg.norm(inward)
    along = np.array([-inward[1], inward[0]])
    crossings = _crossings(plane, surface, along, floor_z + CUT_M)
    offset = _offset(plane, floor_z + CUT_M) * inward
    segments = []
    for k in range(len(crossings) - 1):
        (start, left), (end, right) = crossings[k], crossings[k + 1]
        # inside and outside alternate along the cut
        piece = Piece.SOLID if k % 2 == 0 else _gap(plane, surface, left, right, floor_z)
        ends = np.stack([start * along, end * along]) + offset
        segments.append(Segment(piece, ends, inward))
    return segments


def _crossings(
    plane: Plane, surface: Surface, along: NDArray[np.float64], z: float
) -> list[tuple[float, int]]:
    """Where the rings cross height z: position along the wall; the ring (0 outer, 1.. holes)."""
    found = []
    for number, ring in enumerate([surface.outer, *(hole.ring for hole in surface.holes)]):
        p = plane.lift(ring)
        q = np.roll(p, -1, axis=0)
        rows = np.flatnonzero((p[:, 2] < z) != (q[:, 2] < z))
        share = (z - p[rows, 2]) / (q[rows, 2] - p[rows, 2])
        at = p[rows, :2] + share[:, None] * (q[rows, :2] - p[rows, :2])
        found += [(float(s), number) for s in at @ along]
    return sorted(found)


def _offset(plane: Plane, z: float) -> float:
    """Distance of the cut's line from the origin, along the wall's horizontal inward normal."""
    n = plane.facing * plane.normal
    return float((plane.facing * plane.d - n[2] * z) / np.hypot(n[0], n[1]))


def _gap(plane: Plane, surface: Surface, left: int, right: int, floor_z: float) -> Piece:
    if left != right or left == 0:
        return Piece.DOOR  # a gap of the outline itself, open down to the floor
    hole = surface.holes[left - 1]
    if hole.kind is HoleKind.UNOBSERVED:
        return Piece.UNOBSERVED
    bottom = float(plane.lift(hole.ring)[:, 2].min())
    return Piece.DOOR if bottom < floor_z + SILL_M else Piece.WINDOW
