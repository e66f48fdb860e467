"""Which cells of a truth surface each plane of a model covers: what the scorer counts."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from facet.simulate.truth import CELL_M, SurfaceTruth, cells_in_ring

Float = NDArray[np.float64]
Mask = NDArray[np.bool_]

CELL_M2 = CELL_M**2
MAX_ANGLE_DEG, MAX_OFFSET_M = 10.0, 0.05  # a model plane lies on a surface
WIDE_ANGLE_DEG, WIDE_OFFSET_M = 15.0, 0.15  # a model plane that may have merged two surfaces
SPLIT_SHARE, SPLIT_M2 = 0.05, 0.1  # of a surface: what a plane must cover to count


@dataclass(frozen=True, eq=False)
class ModelPlane:
    """A plane of the model, oriented to the side it faces."""

    id: int
    normal: Float
    d: float
    surfaces: tuple[tuple[Float, tuple[tuple[str, Float], ...]], ...]  # outer, (kind, ring)s; m

    def height(self, truth: SurfaceTruth, uv: Float) -> Float:
        """How far the plane lies above the truth surface at (M, 2) m, along its normal."""
        along = np.array([truth.axis_u @ self.normal, truth.axis_v @ self.normal])
        above = self.d - truth.origin @ self.normal - uv @ along
        return np.asarray(above / (truth.normal @ self.normal))

    def angle_deg(self, normal: Float) -> float:
        return angle_deg(self.normal, normal)


@dataclass(frozen=True)
class SurfaceScore:
    name: str
    seen_m2: float
    recall: float  # share of the seen area that model planes cover
    plane_id: int  # that covers most of it; 0: none
    found: bool  # it covers at least half
    angle_deg: float
    offset_m: float  # at the centroid of what it covers


class Match:
    """One truth surface, and which of its cells each model plane covers."""

    def __init__(self, truth: SurfaceTruth, planes: list[ModelPlane]) -> None:
        self.truth = truth
        self.seen = truth.seen()
        self.seen_m2 = float(self.seen.sum()) * CELL_M2
        rows, columns = np.nonzero(np.ones_like(self.seen))
        self.uv = np.stack([columns + 0.5, rows + 0.5], axis=1) * CELL_M + np.array(truth.corner)
        self.near = [p for p in planes if p.angle_deg(truth.normal) <= WIDE_ANGLE_DEG]
        self.planes = [p for p in self.near if p.angle_deg(truth.normal) <= MAX_ANGLE_DEG]
        self.cover = {p.id: self._cover(p, MAX_OFFSET_M) for p in self.planes}
        self.covered = np.any([*self.cover.values(), np.zeros_like(self.seen)], axis=0)

    def raster(self, ring: Float) -> Mask:
        """The cells inside a ring (M, 3) m, seen along the normal."""
        return cells_in_ring(self.truth.flat(ring), self.truth.corner, self.seen.shape)

    def within(self, plane: ModelPlane, offset_m: float) -> Mask:
        """The cells where the unbounded plane is near."""
        return np.abs(plane.height(self.truth, self.uv)).reshape(self.seen.shape) <= offset_m

    def _cover(self, plane: ModelPlane, offset_m: float) -> Mask:
        return self.area(plane, offset_m) & self.seen

    def area(self, plane: ModelPlane, offset_m: float) -> Mask:
        """The cells that the plane's surfaces cover, seen or not."""
        near = self.within(plane, offset_m)
        covered = np.zeros_like(near)
        if not near.any():
            return covered
        for outer, holes in plane.surfaces:
            cells = self.raster(outer)
            for _, ring in holes:
                cells &= ~self.raster(ring)
            covered |= cells
        return covered & near

    def significant(self, cover: Mask) -> bool:
        area = float(cover.sum()) * CELL_M2
        return area >= max(SPLIT_M2, SPLIT_SHARE * self.seen_m2)

    @cached_property
    def sharing(self) -> list[int]:
        """Ids of the planes that cover a good part of the surface."""
        return [i for i, cover in self.cover.items() if self.significant(cover)]

    @cached_property
    def loosely(self) -> set[int]:
        """Likewise with the wide tolerance: planes that may have merged it with another."""
        return {p.id for p in self.near if self.significant(self._cover(p, WIDE_OFFSET_M))}

    @cached_property
    def result(self) -> SurfaceScore:
        total = int(self.seen.sum())
        best = max(self.planes, key=lambda p: int(self.cover[p.id].sum()), default=None)
        recall = share(int(self.covered.sum()), total)
        name = self.truth.name
        if best is None or not self.cover[best.id].any():
            return SurfaceScore(name, self.seen_m2, recall, 0, False, 0.0, 0.0)
        cover = self.cover[best.id]
        centroid = self.uv[cover.ravel()].mean(axis=0, keepdims=True)
        offset = float(best.height(self.truth, centroid)[0])
        found = bool(cover.sum() >= 0.5 * total)
        angle = best.angle_deg(self.truth.normal)
        return SurfaceScore(name, self.seen_m2, recall, best.id, found, angle, offset)


def angle_deg(a: Float, b: Float) -> float:
    """Between unit vectors; exact near 0."""
    return float(np.degrees(2.0 * np.arctan2(np.linalg.norm(a - b), np.linalg.norm(a + b))))


def apart(a: SurfaceTruth, b: SurfaceTruth, angle: float, distance_m: float) -> bool:
    """Whether two surfaces lie on planes further apart than this, or face opposite ways."""
    if angle_deg(a.normal, b.normal) > angle:
        return True
    gaps = (np.mean(b.outer, axis=0) @ a.normal - a.d, np.mean(a.outer, axis=0) @ b.normal - b.d)
    return bool(max(np.abs(gaps)) > distance_m)


def model_plane(entry: Mapping[str, Any]) -> ModelPlane:
    facing = float(entry["facing"])
    surfaces = tuple(
        (np.array(s["outer"]), tuple((h["kind"], np.array(h["ring"])) for h in s["holes"]))
        for s in entry["surfaces"]
    )
    return ModelPlane(
        entry["id"], facing * np.array(entry["normal"]), facing * entry["d"], surfaces
    )


def share(part: float, whole: float) -> float:
    return part / whole if whole else 1.0
