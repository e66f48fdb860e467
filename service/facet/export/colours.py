"""Colours that mean the same in every picture: one per class, one per plane id, two for holes."""

from __future__ import annotations

import colorsys

import numpy as np
from numpy.typing import NDArray

from facet_protocol.messages import HoleKind, PlaneClass

Rgb = tuple[int, int, int]

CLASS_COLOURS: dict[PlaneClass, Rgb] = {
    PlaneClass.FLOOR: (216, 186, 144),
    PlaneClass.CEILING: (150, 168, 184),
    PlaneClass.WALL: (222, 219, 211),
    PlaneClass.OTHER: (134, 178, 126),
}
HOLE_COLOURS: dict[HoleKind, Rgb] = {
    HoleKind.OPENING: (46, 134, 222),
    HoleKind.UNOBSERVED: (214, 96, 60),
}
UNASSIGNED: Rgb = (120, 120, 120)

_GOLDEN = 0.618033988749895  # consecutive ids land far apart on the hue circle


def plane_colour(plane_id: int) -> Rgb:
    """The same colour for the same id, always; 0 (on no plane) is grey."""
    if plane_id <= 0:
        return UNASSIGNED
    hue = (plane_id * _GOLDEN) % 1.0
    saturation, value = ((0.45, 0.88), (0.58, 0.76), (0.32, 0.94))[plane_id % 3]
    r, g, b = colorsys.hsv_to_rgb(hue, saturation, value)
    return round(r * 255), round(g * 255), round(b * 255)


def point_colours(plane_ids: NDArray[np.int32]) -> NDArray[np.uint8]:
    """(V, 3) uint8 for the (V,) plane ids of points."""
    ids, rows = np.unique(plane_ids, return_inverse=True)
    table = np.array([plane_colour(int(i)) for i in ids], dtype=np.uint8).reshape(-1, 3)
    return np.asarray(table[rows])
