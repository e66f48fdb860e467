"""A small office made by hand: a map that no mapper had to find."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from facet_protocol.messages import (
    Event,
    EventKind,
    Hole,
    HoleKind,
    MapUpdate,
    Plane,
    PlaneClass,
    PlaneFrame,
    Pose,
    Status,
    Surface,
    TilePoints,
)

HEIGHT = 2.7  # m, floor to ceiling
VOXEL = 0.05
STEP = VOXEL / 8.0
STAMP_NS = 1_750_000_000_000_000_000
Box = tuple[float, float, float, float]  # u0, v0, u1, v1


@dataclass(frozen=True)
class Counts:
    """Stands in for the mapper's own counts."""

    scans: int = 412
    points_in: int = 1_204_331
    points_stored: int = 1_198_774
    points_rejected: dict[str, int] | None = None
    voxels: int = 121_345
    valid: int = 109_000
    aligned: int = 3_102
    thick: int = 6_210
    sparse: int = 2_890
    mixed: int = 143
    discarded: int = 8_455
    discarded_points: int = 31_022
    sigma_n_m: float = 0.0112


class Digest(NamedTuple):
    state: str = "5e" * 32
    derived: str = "d7" * 32


SETTINGS: dict[str, object] = {"theta_deg": 12.0, "detail_level": 0.98, "voxel_m": VOXEL}


def rectangle(box: Box) -> NDArray[np.int32]:
    u0, v0, u1, v1 = box
    corners = np.array([[u0, v0], [u1, v0], [u1, v1], [u0, v1]])
    return np.round(corners / STEP).astype(np.int32)


def surface(number: int, outer: NDArray[np.int32], holes: list[tuple[HoleKind, Box]]) -> Surface:
    rings = tuple(Hole(kind, rectangle(box)[::-1]) for kind, box in holes)
    area = _area(outer) + sum(_area(hole.ring) for hole in rings)
    return Surface(number, area * STEP * STEP, outer, rings)


def _area(ring: NDArray[np.int32]) -> float:
    u, v = ring.astype(np.float64).T
    return float(u @ np.roll(v, -1) - v @ np.roll(u, -1)) / 2.0


def plane(
    number: int,
    plane_class: PlaneClass,
    axis_u: tuple[float, float, float],
    axis_v: tuple[float, float, float],
    point: tuple[float, float, float],
    surfaces: tuple[Surface, ...],
) -> Plane:
    """A plane through `point`, seen from the side of axis_u x axis_v."""
    u, v = np.array(axis_u), np.array(axis_v)
    inward = np.cross(u, v)
    inward_d = float(inward @ np.array(point))
    facing = 1 if inward_d >= 0.0 else -1
    corners = np.concatenate([s.outer for s in surfaces]).astype(np.float64) * STEP
    middle = corners.mean(axis=0)
    voxels = int(sum(s.area_m2 for s in surfaces) / VOXEL**2)
    return Plane(
        id=number,
        revision=1,
        plane_class=plane_class,
        normal=facing * inward,
        d=facing * inward_d,
        facing=facing,
        sigma_n_m=0.011,
        thickness_angle_deg=4.1,
        covariance=np.diag([1e-8, 1e-8, 1e-8, 1e-6]),
        num_points=voxels * 10,
        num_voxels=voxels,
        centroid=middle[0] * u + middle[1] * v + inward_d * inward,
        rms_m=0.0105,
        frame=PlaneFrame(u, v, inward, STEP),
        surfaces=surfaces,
        first_seen_ns=STAMP_NS,
        last_seen_ns=STAMP_NS + 60_000_000_000,
        robots=("r1",),
    )


@dataclass
class Room:
    """Four walls that look inwards. Openings are measured from the wall's start, to the right."""

    x0: float
    y0: float
    x1: float
    y1: float
    holes: dict[str, list[tuple[HoleKind, Box]]]
    doors: dict[str, tuple[float, float]]  # a gap down to the floor: part of the outer ring


OPEN, SHADOW = HoleKind.OPENING, HoleKind.UNOBSERVED
WINDOW_V = (0.9, 2.1)


def window(u0: float, u1: float) -> tuple[HoleKind, Box]:
    return OPEN, (u0, WINDOW_V[0], u1, WINDOW_V[1])


ROOMS = [
    Room(
        0.0, 0.0, 5.0, 3.1, {"s": [window(1.0, 2.2), window(3.0, 4.2)]}, {"n": (3.6, 4.5)}
    ),
    Room(
        5.1, 0.0, 12.0, 3.1,
        {"s": [window(6.0, 9.0)], "e": [(SHADOW, (0.6, 0.1, 1.8, 1.9))]},
        {"n": (6.0, 6.9)},
    ),
    Room(
        0.0, 4.9, 7.0, 8.0,
        {"n": [window(1.0, 2.5), window(4.0, 5.5)], "w": [window(5.6, 7.2)]},
        {"s": (1.0, 1.9)},
    ),
    Room(7.1, 4.9, 12.0, 8.0, {"n": [window(8.4, 10.4)]}, {"s": (10.4, 11.3)}),
    Room(
        0.0, 3.2, 12.0, 4.8,
        {
            "w": [(OPEN, (3.6, 0.05, 4.5, 2.05))],
            "n": [(OPEN, (1.0, 0.05, 1.9, 2.05)), (OPEN, (10.4, 0.05, 11.3, 2.05))],
            "s": [(OPEN, (6.0, 0.05, 6.9, 2.05))],
        },
        {"s": (3.6, 4.5)},
    ),
]  # fmt: skip

# side: sign of the wall's inward normal, and whether it runs along x
SIDES = {"s": (1.0, True), "n": (-1.0, True), "w": (1.0, False), "e": (-1.0, False)}


def wall(number: int, room: Room, side: str) -> Plane:
    sign, along_x = SIDES[side]
    start, end = (room.x0, room.x1) if along_x else (room.y0, room.y1)
    offset = {"s": room.y0, "n": room.y1, "w": room.x0, "e": room.x1}[side]
    up = (0.0, 0.0, 1.0)
    # axis_u x up = inward: for inward +y that is -x; for inward +x it is +y
    axis_u = (-sign, 0.0, 0.0) if along_x else (0.0, sign, 0.0)
    turn = axis_u[0] + axis_u[1]

    def across(box: Box) -> Box:
        a, b = sorted((turn * box[0], turn * box[2]))
        return a, box[1], b, box[3]

    outer = rectangle(across((start, 0.0, end, HEIGHT)))
    if side in room.doors:
        outer = _with_door(outer, across((room.doors[side][0], 0.0, room.doors[side][1], 2.05)))
    holes = [(kind, across(box)) for kind, box in room.holes.get(side, [])]
    point = (0.0, offset, 0.0) if along_x else (offset, 0.0, 0.0)
    return plane(number, PlaneClass.WALL, axis_u, up, point, (surface(number * 10, outer, holes),))


def _with_door(outer: NDArray[np.int32], door: Box) -> NDArray[np.int32]:
    u0, v0, u1, v1 = np.round(np.array(door) / STEP).astype(np.int32)
    notch = np.array([[u0, v0], [u0, v1], [u1, v1], [u1, v0]], dtype=np.int32)
    return np.concatenate([outer[:1], notch, outer[1:]])


def planes() -> tuple[Plane, ...]:
    """A floor, a ceiling, five rooms' walls and a ramp."""
    table = (SHADOW, (7.5, 1.0, 9.1, 1.9))
    floor = [
        surface(11 + k, rectangle((r.x0, r.y0, r.x1, r.y1)), [table] if k == 1 else [])
        for k, r in enumerate(ROOMS)
    ]
    ceiling = [
        surface(21 + k, rectangle((r.x0, -r.y1, r.x1, -r.y0)), []) for k, r in enumerate(ROOMS)
    ]
    x, y = (1.0, 0.0, 0.0), (0.0, 1.0, 0.0)
    found = [
        plane(1, PlaneClass.FLOOR, x, y, (0.0, 0.0, 0.0), tuple(floor)),
        plane(2, PlaneClass.CEILING, x, (0.0, -1.0, 0.0), (0.0, 0.0, HEIGHT), tuple(ceiling)),
    ]
    for room in ROOMS:
        for side in SIDES:
            found.append(wall(len(found) + 1, room, side))
    tilt = np.radians(30.0)
    slope = (0.0, float(np.cos(tilt)), float(np.sin(tilt)))
    start = 6.6 * slope[1]
    outer = rectangle((10.4, start, 11.6, start + 1.4 / slope[1]))
    ramp = plane(
        len(found) + 1, PlaneClass.OTHER, x, slope, (10.4, 6.6, 0.0), (surface(900, outer, []),)
    )
    return (*found, ramp)


def rough(seed: int = 1) -> tuple[Plane, ...]:
    """The same planes with outlines as a sensor leaves them: a vertex a voxel, and jagged."""
    rng = np.random.default_rng(seed)

    def jagged(ring: NDArray[np.int32]) -> NDArray[np.int32]:
        pieces = []
        for a, b in zip(ring, np.roll(ring, -1, axis=0), strict=True):
            count = max(1, int(np.linalg.norm(b - a) / 8.0))
            pieces.append(a + (b - a) * (np.arange(count) / count)[:, None])
        dense = np.concatenate(pieces)
        return np.round(dense + rng.uniform(-3, 3, dense.shape)).astype(np.int32)

    def worn(s: Surface) -> Surface:
        holes = tuple(Hole(hole.kind, jagged(hole.ring)) for hole in s.holes)
        return replace(s, outer=jagged(s.outer), holes=holes)

    return tuple(replace(p, surfaces=tuple(worn(s) for s in p.surfaces)) for p in planes())


def snapshot(revision: int = 40) -> MapUpdate:
    return MapUpdate("office", revision, 0, STAMP_NS, planes(), (), ())


def growth() -> list[MapUpdate]:
    """The same office, one plane more an update: with the events a mapper would send."""
    updates = []
    for k, found in enumerate(planes()):
        event = Event(k + 1, EventKind.CREATED, found.id, 0, k + 1, STAMP_NS + k * 10**9)
        update = MapUpdate("office", k + 1, k, STAMP_NS + k * 10**9, (found,), (), (event,))
        updates.append(update)
    return updates


def points(spacing: float = VOXEL, seed: int = 1) -> list[TilePoints]:
    """Noisy voxels on every surface, cut into tiles; one in fifty belongs to no plane."""
    rng = np.random.default_rng(seed)
    xyz, ids = [], []
    for found in planes():
        for s in found.surfaces:
            p = _sample(found, s, spacing, rng)
            xyz.append(p + rng.normal(0.0, 0.008, p.shape))
            ids.append(np.where(rng.random(len(p)) < 0.02, 0, found.id))
    return _tiles(np.concatenate(xyz), np.concatenate(ids))


def _sample(
    found: Plane, s: Surface, spacing: float, rng: np.random.Generator
) -> NDArray[np.float64]:
    from shapely import Polygon, contains_xy

    low, high = s.outer.min(axis=0), s.outer.max(axis=0)
    step = spacing / STEP
    grid = np.mgrid[low[0] : high[0] : step, low[1] : high[1] : step].reshape(2, -1).T + step / 2
    inside = contains_xy(Polygon(s.outer, [h.ring for h in s.holes]), grid[:, 0], grid[:, 1])
    return found.lift(np.round(grid[inside] + rng.uniform(-2, 2, (inside.sum(), 2))).astype(int))


def _tiles(xyz: NDArray[np.float64], ids: NDArray[np.int64]) -> list[TilePoints]:
    units = np.floor(xyz / STEP).astype(np.int64)
    tile = units >> 9  # 64 voxels of 8 units
    tiles = []
    for key in np.unique(tile, axis=0):
        rows = (tile == key).all(axis=1)
        local = (units[rows] & 511).astype(np.uint16)
        i, j, k = (int(n) for n in key)
        tiles.append(TilePoints((i, j, k), VOXEL, local, ids[rows].astype(np.int32)))
    return tiles


def drive(count: int = 60) -> list[tuple[int, Pose]]:
    """Stamps and poses of a robot that goes down the corridor and back."""
    poses = []
    for k in range(count):
        phase = 2.0 * np.pi * k / count
        yaw = 0.0 if np.sin(phase) >= 0.0 else np.pi
        position = np.array([6.0 - 5.0 * np.cos(phase), 4.0 + 0.3 * np.sin(phase), 0.4])
        turn = np.array([0.0, 0.0, np.sin(yaw / 2), np.cos(yaw / 2)])
        poses.append((STAMP_NS + k * 400_000_000, Pose(position, turn)))
    return poses


def status(k: int) -> Status:
    wave = 1.0 + 0.3 * float(np.sin(k / 3.0))
    return Status(
        "office", k, STAMP_NS + k * 10**9, "OK",
        {"received": 10 * k, "applied": 10 * k},
        {"queue_msgs": float(k % 3), "voxels": 4000.0 * k, "planes": float(min(k, 23))},
        {"insert": 3.0 * wave, "normals": 55.0 * wave, "patches": 12.0, "planes": 4.0 * wave,
         "contours": 30.0 / wave},
    )  # fmt: skip
