"""The paper's corridor: 20 x 2 m, cupboards 20 to 25 cm deep, doors set back in recesses."""

from __future__ import annotations

from facet.simulate.surfaces import (
    Opening,
    TruthSurface,
    box,
    level,
    level_rectangle,
    room_walls,
    wall,
)

LENGTH, WIDTH, HEIGHT = 20.0, 2.0, 2.5
RECESS, LEAF = 0.12, 2.05  # depth of a recess, height of its door, m
RECESSES_SOUTH = ((3.2, 4.1), (9.0, 9.9), (15.6, 16.5))
RECESSES_NORTH = ((5.4, 6.3), (12.2, 13.1))
OPEN_DOOR = (17.4, 18.3)  # in the north wall, nothing behind

WAYPOINTS = [(0.8, 1.0, 0), (5.0, 1.1, 0), (10.0, 0.95, 0), (15.0, 1.1, 0), (19.2, 1.0, 0)]


def corridor_surfaces() -> list[TruthSurface]:
    """Floor at z = 0, the south wall at y = 0."""
    openings = {
        "S": [Opening("recess", *x, 0.0, LEAF) for x in RECESSES_SOUTH],
        "N": [
            *(Opening("recess", *x, 0.0, LEAF) for x in RECESSES_NORTH),
            Opening("door", *OPEN_DOOR, 0.0, 2.1),
        ],
        "E": [Opening("window", 0.5, 1.5, 0.9, 2.0)],
    }
    size = (0.0, LENGTH), (0.0, WIDTH)
    return [
        level("floor", _floor_outline(), 0.0, looks_up=True),
        level_rectangle("ceiling", *size, HEIGHT, looks_up=False),
        *room_walls("corridor", *size, (0.0, HEIGHT), openings),
        *(face for i, x in enumerate(RECESSES_SOUTH) for face in _recess(f"door S{i}", x, 0.0, -1)),
        *(
            face
            for i, x in enumerate(RECESSES_NORTH)
            for face in _recess(f"door N{i}", x, WIDTH, 1)
        ),
        *box("cupboard 1", (1.0, 2.6), (0.0, 0.25), (0.0, 1.9), "WNET"),
        *box("cupboard 2", (6.0, 8.4), (0.0, 0.2), (0.0, 2.0), "WNET"),
        *box("cupboard 3", (11.5, 13.5), (0.0, 0.22), (0.0, 0.9), "WNET"),
        *box("cupboard 4", (2.4, 4.4), (WIDTH - 0.2, WIDTH), (0.0, 1.9), "SWET"),
        *box("cupboard 5", (8.0, 10.6), (WIDTH - 0.25, WIDTH), (0.0, 2.0), "SWET"),
        *box("cupboard 6", (14.4, 16.4), (WIDTH - 0.22, WIDTH), (0.0, 1.2), "SWET"),
    ]


def _floor_outline() -> list[tuple[float, float]]:
    """Counter-clockwise, with a notch for each recess."""
    outline = [(0.0, 0.0)]
    for lo, hi in RECESSES_SOUTH:
        outline += [(lo, 0.0), (lo, -RECESS), (hi, -RECESS), (hi, 0.0)]
    outline += [(LENGTH, 0.0), (LENGTH, WIDTH)]
    for lo, hi in reversed(RECESSES_NORTH):
        outline += [(hi, WIDTH), (hi, WIDTH + RECESS), (lo, WIDTH + RECESS), (lo, WIDTH)]
    return [*outline, (0.0, WIDTH)]


def _recess(name: str, x: tuple[float, float], y: float, out: int) -> list[TruthSurface]:
    """A closed door `RECESS` behind the wall at y, with its jambs and lintel; `out` is 1 or -1."""
    lo, hi = x
    back = y + out * RECESS
    low, high = min(y, back), max(y, back)
    leaf = ((lo, back), (hi, back)) if out > 0 else ((hi, back), (lo, back))
    return [
        wall(f"{name} leaf", *leaf, (0.0, LEAF)),
        wall(f"{name} jamb low", (lo, low), (lo, high), (0.0, LEAF)),
        wall(f"{name} jamb high", (hi, high), (hi, low), (0.0, LEAF)),
        level_rectangle(f"{name} lintel", x, (low, high), LEAF, looks_up=False),
    ]
