"""The paper's halls: one room with boxes, glass that returns nothing, and an armchair."""

from __future__ import annotations

from facet.simulate.surfaces import Opening, TruthSurface, box, level_rectangle, room_walls

WAYPOINTS = [
    (1.2, 1.0, 0), (5.0, 1.0, 0), (8.8, 1.1, 0), (8.9, 4.0, 0), (8.6, 6.8, 0), (5.4, 6.9, 0),
    (5.2, 5.4, 0), (5.3, 4.0, 0), (3.6, 3.6, 0), (1.6, 3.4, 0), (1.2, 2.0, 0),
]  # fmt: skip
LARGE_WAYPOINTS = [
    (1.5, 1.2, 0), (8.0, 1.2, 0), (14.6, 1.3, 0), (14.8, 6.0, 0), (14.6, 10.6, 0), (11.0, 10.7, 0),
    (10.6, 6.2, 0), (8.0, 5.9, 0), (5.6, 6.2, 0), (5.4, 10.6, 0), (2.0, 10.4, 0), (1.4, 6.0, 0),
    (1.6, 2.0, 0), (5.4, 1.9, 0), (5.6, 5.0, 0),
]  # fmt: skip


def hall_surfaces() -> list[TruthSurface]:
    """10 x 8 x 3.5 m, floor at z = 0."""
    openings = {
        "S": [Opening("glass", lo, lo + 1.8, 0.9, 2.5) for lo in (1.0, 4.1, 7.2)],
        "E": [Opening("glass", 3.4, 4.5, 0.0, 2.2)],
        "N": [Opening("door", 6.6, 7.5, 0.0, 2.1)],
    }
    size = (0.0, 10.0), (0.0, 8.0)
    return [
        level_rectangle("floor", *size, 0.0, looks_up=True),
        level_rectangle("ceiling", *size, 3.5, looks_up=False),
        *room_walls("hall", *size, (0.0, 3.5), openings),
        *box("box 1", (2.4, 3.6), (2.0, 2.8), (0.0, 0.8)),
        *box("box 2", (6.4, 7.6), (2.2, 3.4), (0.0, 1.2)),
        *box("box 3", (2.2, 3.2), (4.6, 5.8), (0.0, 1.6)),
        *box("box 4", (6.6, 7.4), (4.8, 5.6), (0.0, 0.6)),
        *box("box 5", (9.2, 10.0), (6.0, 7.0), (0.0, 0.9), "SWNT"),
        *armchair("armchair", 0.25, 5.6),
    ]


def large_hall_surfaces() -> list[TruthSurface]:
    """16 x 12 x 4.5 m, with pillars and a raised stage."""
    openings = {
        "S": [Opening("glass", lo, lo + 2.2, 0.8, 3.0) for lo in (1.0, 4.8, 8.6, 12.4)],
        "E": [Opening("glass", 7.0, 9.0, 0.0, 2.4)],
        "N": [Opening("door", 9.8, 11.2, 0.0, 2.2)],
        "W": [Opening("window", 4.0, 6.5, 0.9, 2.5)],
    }
    size = (0.0, 16.0), (0.0, 12.0)
    pillars = [
        face
        for i, (px, py) in enumerate([(3.8, 3.8), (11.8, 3.8), (3.8, 7.8), (11.8, 7.8)])
        for face in box(f"pillar {i}", (px, px + 0.5), (py, py + 0.5), (0.0, 4.5), "SWNE")
    ]
    return [
        level_rectangle("floor", *size, 0.0, looks_up=True),
        level_rectangle("ceiling", *size, 4.5, looks_up=False),
        *room_walls("hall", *size, (0.0, 4.5), openings),
        *pillars,
        *box("stage", (6.8, 9.6), (8.6, 12.0), (0.0, 0.6), "SWET"),
        *box("box 1", (7.0, 8.4), (2.6, 3.8), (0.0, 0.9)),
        *box("box 2", (12.6, 13.6), (5.2, 6.2), (0.0, 1.4)),
        *box("box 3", (2.4, 3.4), (5.6, 6.6), (0.0, 0.7)),
        *box("box 4", (15.2, 16.0), (2.4, 3.8), (0.0, 1.1), "SWNT"),
        *armchair("armchair", 0.3, 7.6),
    ]


def armchair(name: str, x: float, y: float) -> list[TruthSurface]:
    """A shadow for the wall behind: back at x, sitting looks along +x."""
    return [
        *box(f"{name} seat", (x + 0.05, x + 0.8), (y + 0.05, y + 0.8), (0.0, 0.42)),
        *box(f"{name} back", (x, x + 0.18), (y + 0.02, y + 0.83), (0.0, 0.95)),
        *box(f"{name} arm 1", (x + 0.02, x + 0.78), (y, y + 0.14), (0.0, 0.62)),
        *box(f"{name} arm 2", (x + 0.02, x + 0.78), (y + 0.71, y + 0.85), (0.0, 0.62)),
    ]
