"""The office: a corridor with rooms on both sides, 25 x 12 m, turned against the axes."""

from __future__ import annotations

import numpy as np

from facet.simulate.surfaces import (
    Float,
    Opening,
    TruthSurface,
    box,
    level,
    level_rectangle,
    polygon,
    rectangle_ring,
    reveal,
    room_walls,
    table,
    wall,
)

HEIGHT = 2.7
STEP = 0.18  # between the two floor levels of room S3
STEP_X = 20.5
CURVE_RADIUS = 1.5
SOUTH, NORTH = 4.92, 7.08  # the rooms' side of the corridor's walls; 8 cm thick
EAVES, RIDGE = 2.0, 3.8  # slanted ceiling of room N2: low at y = 12, high at the corridor
HIGH = 3.0  # ceiling of room N1

DOORS_SOUTH = (3.5, 12.5, 18.3)  # centres along x
DOORS_NORTH = (3.0, 10.0, 16.5, 22.0)
DOOR_Y = 2.4  # centre of the door between S1 and S2


def _door(centre: float) -> Opening:
    return Opening("door", centre - 0.45, centre + 0.45, 0.0, 2.1)


def _pane(what: str, lo: float, hi: float) -> Opening:
    return Opening(what, lo, hi, 0.9, 2.1)


def office_surfaces() -> list[TruthSurface]:
    """In the building's own frame: x along the corridor, floor at z = 0."""
    return [
        *_floors_and_ceilings(),
        *_corridor(),
        *_south_rooms(),
        *_room_n1(),
        *_room_n2(),
        *_room_n3(),
        *_room_n4(),
        *_passages(),
        *_furniture(),
    ]


def _arc(steps: int = 16) -> Float:
    """(steps + 1, 2) m: the corner of N4 rounded off, from the east wall to the north wall."""
    angle = np.linspace(0.0, np.pi / 2.0, steps + 1)
    centre = np.array([25.0 - CURVE_RADIUS, 12.0 - CURVE_RADIUS])
    return np.asarray(centre + CURVE_RADIUS * np.stack([np.cos(angle), np.sin(angle)], axis=1))


def _floors_and_ceilings() -> list[TruthSurface]:
    floor = [(0, 0), (STEP_X, 0), (STEP_X, SOUTH), (25, SOUTH), *_arc(), (0, 12)]
    flat = [(0, 0), (25, 0), *_arc(), (14.04, 12), (14.04, 7.04), (0, 7.04)]
    run = 12.0 - NORTH
    slope = np.array([0.0, run, EAVES - RIDGE]) / np.hypot(run, EAVES - RIDGE)
    slanted = polygon(
        "N2 slanted ceiling",
        (6.08, NORTH, RIDGE),
        slope,
        (1, 0, 0),
        rectangle_ring(0.0, float(np.hypot(run, EAVES - RIDGE)), 0.0, 14.0 - 6.08),
    )
    return [
        level("floor", floor, 0.0, looks_up=True),
        level_rectangle("S3 platform", (STEP_X, 25), (0, SOUTH), STEP, looks_up=True),
        wall("S3 riser", (STEP_X, SOUTH), (STEP_X, 0), (0.0, STEP)),
        level("ceiling", flat, HEIGHT, looks_up=False),
        level_rectangle("N1 ceiling", (0, 6), (NORTH, 12), HIGH, looks_up=False),
        slanted,
    ]


def _corridor() -> list[TruthSurface]:
    openings = {
        "S": [_door(c) for c in DOORS_SOUTH],
        "N": [_door(c) for c in DOORS_NORTH],
        "W": [Opening("glass", 5.55, 6.45, 0.0, 2.1)],
        "E": [_pane("window", 5.4, 6.6)],
    }
    return room_walls("corridor", (0, 25), (5, 7), (0, HEIGHT), openings)


def _south_rooms() -> list[TruthSurface]:
    x1, x2, x3 = (0.0, 8.0), (8.08, 16.0), (16.08, 25.0)
    between = [_door(DOOR_Y)]
    full = (0.0, HEIGHT)
    s1 = {"S": [_pane("glass", 1.0, 2.6), _pane("window", 4.6, 6.2)], "N": [_door(3.5)]}
    s2 = {"S": [_pane("glass", 9.2, 11.0), _pane("glass", 13.0, 14.8)], "N": [_door(12.5)]}
    faces = room_walls("S1", x1, (0, SOUTH), full, {**s1, "E": between})
    faces += room_walls("S2", x2, (0, SOUTH), full, {**s2, "W": between})
    faces += room_walls("S3", x3, (0, SOUTH), full, sides="W")
    stepped = [
        (x3[0], 0.0), (STEP_X, 0.0), (STEP_X, STEP),
        (x3[1], STEP), (x3[1], HEIGHT), (x3[0], HEIGHT),
    ]  # fmt: skip
    window = [_pane("window", 21.6, 23.4)]
    door = [_door(DOORS_SOUTH[2])]
    faces.append(wall("S3 S", (x3[1], 0), (x3[0], 0), full, window, profile=stepped))
    faces.append(wall("S3 N", (x3[0], SOUTH), (x3[1], SOUTH), full, door, profile=stepped))
    faces.append(wall("S3 E", (x3[1], SOUTH), (x3[1], 0), (STEP, HEIGHT)))
    return faces


def _room_n1() -> list[TruthSurface]:
    openings = {"S": [_door(3.0)], "W": [_pane("glass", 8.6, 10.4)], "N": [_pane("window", 2, 4)]}
    return room_walls("N1", (0, 6), (NORTH, 12), (0, HIGH), openings)


def _room_n2() -> list[TruthSurface]:
    gable = [(NORTH, 0.0), (12.0, 0.0), (12.0, EAVES), (NORTH, RIDGE)]
    pane = [Opening("glass", 9.0, 11.0, 0.7, 1.7)]
    full = (0.0, RIDGE)
    return [
        *room_walls("N2", (6.08, 14), (NORTH, 12), full, {"S": [_door(10.0)]}, "S"),
        wall("N2 W", (6.08, NORTH), (6.08, 12), full, profile=gable),
        wall("N2 N", (6.08, 12), (14, 12), (0.0, EAVES), pane),
        wall("N2 E", (14, 12), (14, NORTH), full, profile=gable),
    ]


def _room_n3() -> list[TruthSurface]:
    openings = {"S": [_door(16.5)], "N": [_pane("window", 15.4, 17.4)]}
    return room_walls("N3", (14.08, 19), (NORTH, 12), (0, HEIGHT), openings)


def _room_n4() -> list[TruthSurface]:
    x0, x1, y1, r = 19.08, 25.0, 12.0, CURVE_RADIUS
    full = (0.0, HEIGHT)
    arc = _arc()[::-1]  # walked from north to east, the room on the right
    facets = [
        wall(f"N4 curve {i}", (*arc[i],), (*arc[i + 1],), full, planar=False)
        for i in range(len(arc) - 1)
    ]
    return [
        *room_walls("N4", (x0, x1), (NORTH, y1), full, {"S": [_door(22.0)]}, "SW"),
        wall("N4 N", (x0, y1), (x1 - r, y1), full, [_pane("glass", 20.2, 22.0)]),
        *facets,
        wall("N4 E", (x1, y1 - r), (x1, NORTH), full),
    ]


def _passages() -> list[TruthSurface]:
    faces: list[TruthSurface] = []
    for i, c in enumerate(DOORS_SOUTH):
        faces += reveal(f"door S{i + 1}", (c - 0.45, c + 0.45), (SOUTH, 5.0), 2.1, through="y")
    for i, c in enumerate(DOORS_NORTH):
        faces += reveal(f"door N{i + 1}", (c - 0.45, c + 0.45), (7.0, NORTH), 2.1, through="y")
    y = (DOOR_Y - 0.45, DOOR_Y + 0.45)
    return [*faces, *reveal("door S1-S2", (8.0, 8.08), y, 2.1, through="x")]


def _furniture() -> list[TruthSurface]:
    return [
        *table("S1 table", (1.0, 2.8), (1.4, 2.3)),
        *box("S1 cupboard", (0.0, 0.45), (2.6, 4.2), (0.0, 1.9), "SNET"),
        *box("S1 cabinet", (5.2, 6.8), (4.47, SOUTH), (0.0, 0.8), "SWET"),
        *box("S2 pillar 1", (10.4, 10.9), (2.5, 3.0), (0.0, HEIGHT), "SWNE"),
        *box("S2 pillar 2", (13.4, 13.9), (1.4, 1.9), (0.0, HEIGHT), "SWNE"),
        *box("S2 cupboard", (15.5, 16.0), (2.6, 4.4), (0.0, 2.0), "SWNT"),
        *box("S3 cabinet", (16.08, 16.58), (1.2, 3.2), (0.0, 1.1), "SNET"),
        *box("N1 cupboard", (4.2, 5.6), (11.5, 12.0), (0.0, 2.0), "SWET"),
        *table("N1 table", (0.6, 1.4), (8.8, 10.6)),
        *table("N2 table", (9.2, 11.0), (9.4, 10.3)),
        *box("N2 cabinet", (6.08, 6.53), (8.0, 10.0), (0.0, 0.9), "SNET"),
        *box("N3 cupboard", (18.5, 19.0), (8.6, 10.4), (0.0, 1.8), "SWNT"),
        *table("N4 table", (21.2, 22.8), (9.6, 10.4)),
        *box("corridor cupboard", (7.2, 8.6), (5.0, 5.35), (0.0, 1.8), "WNET"),
    ]


# Through every room: x, y, and the height of the floor there.
WAYPOINTS = [
    (1.0, 6.0, 0), (2.9, 6.0, 0), (3.5, 5.6, 0), (3.5, 4.2, 0), (3.4, 3.2, 0), (1.2, 3.2, 0),
    (0.7, 2.2, 0), (0.6, 0.8, 0), (3.2, 0.8, 0), (4.2, 1.6, 0), (6.2, 1.4, 0), (6.8, 2.4, 0),
    (9.4, 2.4, 0), (9.6, 1.2, 0), (12.2, 0.9, 0), (14.6, 0.9, 0), (14.7, 2.4, 0), (13.2, 3.6, 0),
    (12.5, 4.2, 0), (12.5, 5.5, 0), (11.6, 6.0, 0), (10.4, 6.0, 0), (10.0, 6.5, 0), (10.0, 8.0, 0),
    (8.2, 8.6, 0), (7.4, 9.6, 0), (7.8, 11.0, 0), (10.0, 11.1, 0), (12.6, 10.8, 0), (12.6, 8.6, 0),
    (10.8, 8.4, 0), (10.0, 7.8, 0), (10.0, 6.6, 0), (9.2, 6.1, 0), (4.2, 6.1, 0), (3.0, 6.4, 0),
    (3.0, 8.2, 0), (2.2, 8.4, 0), (2.2, 10.8, 0), (3.4, 10.8, 0), (4.8, 10.4, 0), (4.8, 8.4, 0),
    (3.2, 8.2, 0), (3.0, 7.8, 0), (3.0, 6.4, 0), (4.0, 6.0, 0), (15.6, 6.0, 0), (16.5, 6.4, 0),
    (16.5, 8.0, 0), (15.2, 8.6, 0), (15.2, 10.8, 0), (17.4, 10.8, 0), (17.4, 8.6, 0),
    (16.5, 7.9, 0),
    (16.5, 6.4, 0), (17.4, 5.9, 0), (18.3, 5.5, 0), (18.3, 4.0, 0), (17.4, 3.4, 0), (17.3, 1.0, 0),
    (19.6, 1.0, 0), (21.2, 1.0, STEP), (23.8, 1.0, STEP), (23.8, 3.8, STEP), (21.4, 3.8, STEP),
    (19.6, 3.4, 0), (18.3, 4.0, 0), (18.3, 5.6, 0), (19.2, 6.0, 0), (21.0, 6.0, 0), (22.0, 6.5, 0),
    (22.0, 8.2, 0), (23.6, 8.6, 0), (24.0, 9.6, 0), (23.5, 10.9, 0), (22.0, 11.2, 0),
    (20.2, 10.8, 0), (20.2, 8.8, 0), (21.8, 8.4, 0), (22.0, 7.8, 0), (22.0, 6.4, 0), (23.0, 6.0, 0),
    (24.2, 6.0, 0),
]  # fmt: skip
