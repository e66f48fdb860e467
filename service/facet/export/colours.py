"""Colours that mean the same in every picture: one per class, of it a shade per plane, two for
holes."""

from __future__ import annotations

import colorsys
from collections.abc import Mapping
from typing import NamedTuple

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

_GOLDEN = 0.618033988749895  # consecutive ids land far apart
_SILVER = 0.414213562373095  # and not where the golden ones do


class Shades(NamedTuple):
    """From one to the other: hue, saturation and value."""

    hue: tuple[float, float]
    saturation: tuple[float, float]
    value: tuple[float, float]


SHADES: dict[PlaneClass, Shades] = {  # around the colour of the class: walls are pale, of any hue
    PlaneClass.FLOOR: Shades((0.06, 0.12), (0.34, 0.54), (0.62, 0.92)),
    PlaneClass.CEILING: Shades((0.55, 0.62), (0.16, 0.40), (0.56, 0.86)),
    PlaneClass.WALL: Shades((0.0, 1.0), (0.10, 0.24), (0.74, 0.98)),
    PlaneClass.OTHER: Shades((0.27, 0.36), (0.32, 0.58), (0.52, 0.86)),
}


def plane_colour(plane_id: int, plane_class: PlaneClass) -> Rgb:
    """The same shade for the same id, always; 0 (on no plane) is grey."""
    if plane_id <= 0:
        return UNASSIGNED
    shades = SHADES[plane_class]
    hue = _between(shades.hue, plane_id * _GOLDEN)
    saturation = _between(shades.saturation, plane_id * _SILVER)
    value = _between(shades.value, plane_id * _GOLDEN)
    r, g, b = colorsys.hsv_to_rgb(hue, saturation, value)
    return round(r * 255), round(g * 255), round(b * 255)


def _between(ends: tuple[float, float], turns: float) -> float:
    return ends[0] + (ends[1] - ends[0]) * (turns % 1.0)


def point_colours(
    plane_ids: NDArray[np.int32], classes: Mapping[int, PlaneClass]
) -> NDArray[np.uint8]:
    """(V, 3) uint8 for the (V,) plane ids of points; `classes` by plane id."""
    ids, rows = np.unique(plane_ids, return_inverse=True)
    colours = [plane_colour(int(i), classes.get(int(i), PlaneClass.OTHER)) for i in ids]
    table = np.array(colours, dtype=np.uint8).reshape(-1, 3)
    return np.asarray(table[rows])
