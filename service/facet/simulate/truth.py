"""What a drive could have found: every surface, exactly, with the part of it that was seen."""

from __future__ import annotations

import base64
import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numba import njit
from numpy.typing import NDArray

from facet.simulate.simulation import Look, Simulation
from facet.simulate.surfaces import TruthSurface, ring_area
from facet_protocol.messages import HoleKind, PlaneClass

Float = NDArray[np.float64]
CELL_M = 0.05
CLOSING = 2  # cells: gaps between hits up to 20 cm wide count as seen
OPEN_SHARE = 0.5  # of a hole's cells that beams passed, for it to count as an opening
_MANY_BEAMS = 5000  # above it every third beam tells which cells of holes were passed


@dataclass(frozen=True, slots=True, eq=False)
class HoleTruth:
    what: str  # "door" | "window" | "glass" | "recess"
    kind: HoleKind  # what the sensor of this drive can tell it to be
    ring: Float  # (M, 3) m, world, clockwise seen from the facing side
    passed: float  # share of its cells through or beside which beams were known to go


@dataclass(frozen=True, slots=True, eq=False)
class SurfaceTruth:
    """One bounded surface. (u, v) = ((p - origin) . axis_u, (p - origin) . axis_v)."""

    name: str
    plane_class: PlaneClass
    planar: bool
    normal: Float  # (3,) unit, towards the side it is seen from
    d: float  # normal . x = d, m, of either sign
    origin: Float  # (3,) m, world: (u, v) = (0, 0)
    axis_u: Float  # (3,) unit; axis_u x axis_v = normal
    axis_v: Float  # (3,) unit
    outer: Float  # (M, 3) m, world, counter-clockwise seen from the facing side
    holes: tuple[HoleTruth, ...]
    corner: tuple[float, float]  # m, (u, v) of the corner of observed[0, 0]
    observed: NDArray[np.bool_]  # (rows along v, columns along u), cells of CELL_M that were hit

    def flat(self, points: Float) -> Float:
        """(M, 2) m, (u, v) of world points (M, 3)."""
        axes = np.stack([self.axis_u, self.axis_v], axis=1)
        return np.asarray((points - self.origin) @ axes)

    @property
    def area_m2(self) -> float:
        rings = [self.outer, *(hole.ring for hole in self.holes)]
        return sum(ring_area(self.flat(ring)) for ring in rings)

    def inside(self) -> NDArray[np.bool_]:
        """The cells of `observed` whose centre lies on the surface and in none of its holes."""
        cells = cells_in_ring(self.flat(self.outer), self.corner, self.observed.shape)
        for hole in self.holes:
            cells &= ~cells_in_ring(self.flat(hole.ring), self.corner, self.observed.shape)
        return cells

    def seen(self) -> NDArray[np.bool_]:
        """The cells that could be found: `observed` with its small gaps closed, on the surface."""
        return closed(self.observed, CLOSING) & self.inside()

    @property
    def seen_m2(self) -> float:
        return float(self.seen().sum()) * CELL_M**2


@dataclass(frozen=True, slots=True, eq=False)
class Truth:
    scene: str
    sensor: str
    seed: int
    num_scans: int
    range_noise_m: float
    pose_noise_m: float
    surfaces: tuple[SurfaceTruth, ...]

    def surface(self, name: str) -> SurfaceTruth:
        return next(s for s in self.surfaces if s.name == name)

    def as_dict(self) -> dict[str, Any]:
        head = {key: getattr(self, key) for key in _HEAD}
        surfaces = [_surface_dict(surface) for surface in self.surfaces]
        return {"format": "facet-truth", "version": 1, **head, "surfaces": surfaces}

    @staticmethod
    def from_dict(data: Mapping[str, Any]) -> Truth:
        """The inverse of `as_dict`; ValueError when `data` is something else."""
        if data.get("format") != "facet-truth" or data.get("version") != 1:
            raise ValueError("not a facet-truth, version 1")
        surfaces = tuple(_surface_from(entry) for entry in data["surfaces"])
        return Truth(**{key: data[key] for key in _HEAD}, surfaces=surfaces)

    def write(self, path: Path) -> None:
        path.write_text(json.dumps(self.as_dict()), encoding="utf-8")

    @staticmethod
    def read(path: Path) -> Truth:
        return Truth.from_dict(json.loads(path.read_text(encoding="utf-8")))


_HEAD = ("scene", "sensor", "seed", "num_scans", "range_noise_m", "pose_noise_m")


class Observer:
    """Gathers, look by look, which cells of the scene were seen: the mask of Truth."""

    def __init__(self, simulation: Simulation) -> None:
        self.simulation = simulation
        self.faces = simulation.faces
        shape = np.ceil((self.faces.upper - self.faces.lower) / CELL_M).astype(np.int64)
        self.shape = np.maximum(shape, 1)  # (S, 2) cells along u and v
        self.start = np.concatenate([[0], np.cumsum(self.shape[:, 0] * self.shape[:, 1])])
        self.seen = np.zeros(self.start[-1], dtype=np.uint8)
        self.passed = np.zeros(self.start[-1], dtype=np.uint8)
        counts = np.diff(self.faces.first_ring)
        self.holed = np.flatnonzero(counts > 1)  # surfaces with holes

    def watch(self, look: Look) -> None:
        faces = self.faces
        _mark_hits(
            look.position, look.directions, look.ranges, look.faces, faces.origin, faces.axes,
            faces.lower, self.shape, self.start, self.seen,
        )  # fmt: skip
        ends = look.ranges
        if self.simulation.sensor.says_empty:
            ends = np.where(look.faces < 0, self.simulation.reach_m, ends)
        ends = np.where(np.isfinite(ends), ends, 0.0)
        step = 3 if len(ends) > _MANY_BEAMS else 1
        _mark_passed(
            look.position, look.directions[::step], ends[::step], self.holed, faces.origin,
            faces.axes, faces.lower, faces.upper, self.shape, self.start, self.passed,
        )  # fmt: skip

    def truth(self) -> Truth:
        sim = self.simulation
        surfaces = [
            _surface_truth(surface, self.faces.lower[i], self._mask(self.seen, i),
                           self._mask(self.passed, i))
            for i, surface in enumerate(sim.scene.surfaces)
        ]  # fmt: skip
        return Truth(
            sim.scene.name, sim.sensor.name, sim.seed, len(sim), sim.noise.range_m,
            sim.noise.pose_m, tuple(surfaces),
        )  # fmt: skip

    def _mask(self, cells: NDArray[np.uint8], surface: int) -> NDArray[np.bool_]:
        columns, rows = self.shape[surface]
        flat = cells[self.start[surface] : self.start[surface + 1]]
        return flat.reshape(rows, columns).astype(np.bool_)


def scene_truth(simulation: Simulation) -> Truth:
    """The truth of a whole simulation: every beam is cast. A running Observer casts none."""
    observer = Observer(simulation)
    for index in range(len(simulation)):
        observer.watch(simulation.look(index))
    return observer.truth()


def cells_in_ring(
    ring: Float, corner: tuple[float, float], shape: tuple[int, ...]
) -> NDArray[np.bool_]:
    """Which cell centres of a raster (rows, columns) lie in `ring` (M, 2) m: even-odd rule."""
    rows, columns = shape
    v = corner[1] + (np.arange(rows) + 0.5) * CELL_M
    (u0, v0), (u1, v1) = ring.T[:, :, None], np.roll(ring, -1, axis=0).T[:, :, None]
    edge, row = np.nonzero((v0 > v) != (v1 > v))  # each crossing flips all cells to its left
    slope = (u1 - u0)[edge, 0] / (v1 - v0)[edge, 0]
    u = u0[edge, 0] + slope * (v[row] - v0[edge, 0])
    left = np.clip(np.ceil((u - corner[0]) / CELL_M - 0.5), 0, columns).astype(np.int64)
    flips = np.zeros((rows, columns + 1), dtype=np.int64)
    np.add.at(flips, (row, left), 1)
    to_the_right = np.cumsum(flips[:, ::-1], axis=1)[:, ::-1]
    return np.asarray(to_the_right[:, 1:] % 2 == 1)


def grown(mask: NDArray[np.bool_], cells: int) -> NDArray[np.bool_]:
    """Dilated by a square of `cells` in every direction."""
    padded = np.pad(mask, cells)
    rows = np.any([np.roll(padded, k, axis=0) for k in range(-cells, cells + 1)], axis=0)
    both = np.any([np.roll(rows, k, axis=1) for k in range(-cells, cells + 1)], axis=0)
    return np.asarray(both[cells:-cells, cells:-cells])


def closed(mask: NDArray[np.bool_], cells: int) -> NDArray[np.bool_]:
    """Dilated, then eroded by the same square; what lies outside the raster is not seen."""
    wide = grown(np.pad(mask, cells), cells)
    return ~grown(~wide, cells)[cells:-cells, cells:-cells]


def _surface_truth(
    surface: TruthSurface, lower: Float, seen: NDArray[np.bool_], passed: NDArray[np.bool_]
) -> SurfaceTruth:
    corner = (float(lower[0]), float(lower[1]))
    holes = []
    for hole in surface.holes:
        cells = cells_in_ring(hole.ring, corner, seen.shape)
        share = float(grown(passed, CLOSING)[cells].mean()) if cells.any() else 0.0
        kind = HoleKind.OPENING if share >= OPEN_SHARE else HoleKind.UNOBSERVED
        holes.append(HoleTruth(hole.what, kind, surface.lift(hole.ring), share))
    return SurfaceTruth(
        surface.name, surface.plane_class, surface.planar, surface.normal, surface.d,
        surface.origin, surface.axis_u, surface.axis_v, surface.lift(surface.outer),
        tuple(holes), corner, seen,
    )  # fmt: skip


def _surface_dict(surface: SurfaceTruth) -> dict[str, Any]:
    bits = base64.b64encode(np.packbits(surface.observed).tobytes()).decode("ascii")
    return {
        "name": surface.name,
        "class": surface.plane_class.value,
        "planar": surface.planar,
        "normal": surface.normal.tolist(),
        "d": surface.d,
        "area_m2": surface.area_m2,
        "seen_m2": surface.seen_m2,
        "frame": {key: getattr(surface, key).tolist() for key in ("origin", "axis_u", "axis_v")},
        "outer": surface.outer.tolist(),
        "holes": [
            {"what": h.what, "kind": h.kind.value, "passed": h.passed, "ring": h.ring.tolist()}
            for h in surface.holes
        ],
        "observed": {
            "cell_m": CELL_M,
            "corner": list(surface.corner),
            "shape": list(surface.observed.shape),
            "bits": bits,  # rows along v, then columns along u, most significant bit first
        },
    }


def _surface_from(data: Mapping[str, Any]) -> SurfaceTruth:
    observed, frame = data["observed"], data["frame"]
    rows, columns = observed["shape"]
    packed = np.frombuffer(base64.b64decode(observed["bits"]), dtype=np.uint8)
    mask = np.unpackbits(packed, count=rows * columns).reshape(rows, columns).astype(np.bool_)
    holes = tuple(
        HoleTruth(h["what"], HoleKind(h["kind"]), np.array(h["ring"]), h["passed"])
        for h in data["holes"]
    )
    return SurfaceTruth(
        data["name"], PlaneClass(data["class"]), data["planar"], np.array(data["normal"]),
        data["d"], np.array(frame["origin"]), np.array(frame["axis_u"]), np.array(frame["axis_v"]),
        np.array(data["outer"]), holes, (observed["corner"][0], observed["corner"][1]), mask,
    )  # fmt: skip


@njit(cache=True, nogil=True)
def _mark_hits(  # type: ignore[no-untyped-def]
    position, directions, ranges, hit, origin, axes, lower, shape, start, seen
):
    """Mark the cell that each beam met."""
    for k in range(directions.shape[0]):
        s = hit[k]
        if s < 0:
            continue
        u = v = 0.0
        for c in range(3):
            p = position[c] + ranges[k] * directions[k, c] - origin[s, c]
            u += p * axes[s, 0, c]
            v += p * axes[s, 1, c]
        column = min(max(int((u - lower[s, 0]) / 0.05), 0), shape[s, 0] - 1)
        row = min(max(int((v - lower[s, 1]) / 0.05), 0), shape[s, 1] - 1)
        seen[start[s] + row * shape[s, 0] + column] = 1


@njit(cache=True, nogil=True)
def _mark_passed(  # type: ignore[no-untyped-def]
    position, directions, ends, holed, origin, axes, lower, upper, shape, start, passed
):
    """Mark where beams crossed the planes of surfaces with holes, from either side."""
    for s in holed:
        a = axes[s]
        du, dv, height = 0.0, 0.0, 0.0
        for c in range(3):
            p = position[c] - origin[s, c]
            du += p * a[0, c]
            dv += p * a[1, c]
            height += p * a[2, c]
        for k in range(directions.shape[0]):
            dx, dy, dz = directions[k]
            slope = a[2, 0] * dx + a[2, 1] * dy + a[2, 2] * dz
            if slope * height >= 0.0:
                continue
            t = -height / slope
            if t >= ends[k] - 1e-6:
                continue
            u = du + t * (a[0, 0] * dx + a[0, 1] * dy + a[0, 2] * dz)
            v = dv + t * (a[1, 0] * dx + a[1, 1] * dy + a[1, 2] * dz)
            if lower[s, 0] < u < upper[s, 0] and lower[s, 1] < v < upper[s, 1]:
                column = min(int((u - lower[s, 0]) / 0.05), shape[s, 0] - 1)
                row = min(int((v - lower[s, 1]) / 0.05), shape[s, 1] - 1)
                passed[start[s] + row * shape[s, 0] + column] = 1
