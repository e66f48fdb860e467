"""Compares a model (model.json of the wire) with the truth of a simulation. Rasters of 5 cm.

`python tests/scorer.py MODEL.json TRUTH.json` prints the table.
"""

from __future__ import annotations

import json
import sys
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import shapely

from facet.simulate.truth import CELL_M, HoleTruth, SurfaceTruth, Truth, cells_in_ring, grown
from facet_protocol.messages import HoleKind, MapUpdate
from matching import (
    CELL_M2,
    MAX_ANGLE_DEG,
    MAX_OFFSET_M,
    Float,
    Mask,
    Match,
    ModelPlane,
    SurfaceScore,
    angle_deg,
    apart,
    model_plane,
    share,
)

CURVE_ANGLE_DEG = 20.0  # between a model plane and the facet of a curved wall that it lies on
BORDER_M = 0.075  # model area this far beyond an outline is still right
MIN_SURFACE_M2, MIN_OPENING_M2 = 0.5, 0.4
APART_DEG, APART_M = 5.0, 0.06  # two surfaces further apart than this are not coplanar
THIN_M = (0.04, 0.15)  # thickness of a thin wall
AROUND = 4  # cells around an opening, of which AROUND_SHARE must have been seen
AROUND_SHARE, MIN_IOU = 0.6, 0.5


@dataclass(frozen=True)
class Score:
    surfaces: tuple[SurfaceScore, ...]  # planar, seen_m2 >= MIN_SURFACE_M2
    area_recall: float  # of all that was seen of these surfaces
    area_precision: float  # of all that the model says, curved things left out
    wrong_m2: float  # model area on no truth surface
    curved_m2: float  # model area on something that is not planar
    planes: int
    truth_planes: int
    splits: tuple[str, ...]  # surfaces that several planes share
    merges: tuple[tuple[str, str], ...]  # surfaces that one plane covers though not coplanar
    thin_walls: tuple[tuple[str, str], ...]
    thin_walls_lost: tuple[tuple[str, str], ...]  # of which a face was not found
    openings: tuple[str, ...]
    openings_missed: tuple[str, ...]
    openings_instead: tuple[str, ...]  # of each one missed: filled, unobserved, outside the outline
    openings_false: int
    openings_false_at: tuple[int, ...] = field(default=())  # ids of their planes

    @property
    def num_found(self) -> int:
        return sum(s.found for s in self.surfaces)

    @property
    def missing(self) -> tuple[str, ...]:
        return tuple(s.name for s in self.surfaces if not s.found)

    @property
    def worst_angle_deg(self) -> float:
        return max((s.angle_deg for s in self.surfaces if s.found), default=0.0)

    @property
    def worst_offset_m(self) -> float:
        return max((abs(s.offset_m) for s in self.surfaces if s.found), default=0.0)

    @property
    def openings_found(self) -> float:
        """Share of the openings; 1 when there are none."""
        count = len(self.openings)
        return 1.0 - len(self.openings_missed) / count if count else 1.0

    def table(self) -> str:
        """The figures, then what went wrong by name."""
        found = [s for s in self.surfaces if s.found]
        middle = float(np.median([s.angle_deg for s in found])) if found else 0.0
        off = float(np.median([abs(s.offset_m) for s in found])) if found else 0.0
        thin = len(self.thin_walls) - len(self.thin_walls_lost)
        opened = len(self.openings) - len(self.openings_missed)
        rows = [
            ("surfaces found", f"{self.num_found} / {len(self.surfaces)}"),
            ("area recall", f"{self.area_recall:.4f}"),
            ("area precision", f"{self.area_precision:.4f}   wrong {self.wrong_m2:.2f} m2"),
            ("angle", f"median {middle:.2f}, worst {self.worst_angle_deg:.2f} deg"),
            ("offset", f"median {1e3 * off:.1f}, worst {1e3 * self.worst_offset_m:.1f} mm"),
            ("planes", f"{self.planes}, truth {self.truth_planes}"),
            ("splits, merges", f"{len(self.splits)}, {len(self.merges)}"),
            ("thin walls", f"{thin} / {len(self.thin_walls)}"),
            ("openings", f"{opened} / {len(self.openings)}, false {self.openings_false}"),
            ("curved as planar", f"{self.curved_m2:.2f} m2"),
        ]
        wrongs = {
            "missing": self.missing,
            "split": self.splits,
            "merged": tuple(" + ".join(pair) for pair in self.merges),
            "thin wall lost": tuple(" | ".join(pair) for pair in self.thin_walls_lost),
            "opening missed": tuple(
                f"{name} ({what})"
                for name, what in zip(self.openings_missed, self.openings_instead, strict=True)
            ),
            "false opening on plane": tuple(str(i) for i in self.openings_false_at),
        }
        rows += [(name, ", ".join(items)) for name, items in wrongs.items() if items]
        return "\n".join(f"{name:24s}{value}" for name, value in rows)


def score(model: Mapping[str, Any], truth: Truth | Mapping[str, Any]) -> Score:
    """Compare; `model` as in model.json (only "planes" is read), `truth` as Truth or its dict."""
    truth = truth if isinstance(truth, Truth) else Truth.from_dict(truth)
    planes = [model_plane(entry) for entry in model["planes"]]
    flat = [s for s in truth.surfaces if s.planar]
    scored = [Match(s, planes) for s in flat if s.seen_m2 >= MIN_SURFACE_M2]
    right, wrong, curved = _areas(planes, truth)
    missed, instead, openings = _openings(scored)
    false_at = _false_openings(planes, flat)
    found = {m.truth.name for m in scored if m.result.found}
    thin = _thin_walls(scored)
    return Score(
        surfaces=tuple(m.result for m in scored),
        area_recall=share(
            sum(int(m.covered.sum()) for m in scored), sum(int(m.seen.sum()) for m in scored)
        ),
        area_precision=share(right, right + wrong),
        wrong_m2=wrong * CELL_M2,
        curved_m2=curved * CELL_M2,
        planes=len(planes),
        truth_planes=len(coplanar_groups([m.truth for m in scored])),
        splits=tuple(m.truth.name for m in scored if len(m.sharing) > 1),
        merges=_merges(scored),
        thin_walls=thin,
        thin_walls_lost=tuple(pair for pair in thin if not found.issuperset(pair)),
        openings=openings,
        openings_missed=missed,
        openings_instead=instead,
        openings_false=len(false_at),
        openings_false_at=false_at,
    )


def model_of(update: MapUpdate) -> dict[str, Any]:
    """A snapshot in the form of model.json, as far as `score` reads it."""
    planes = []
    for plane in update.changed:
        surfaces = [
            {
                "id": s.id,
                "area_m2": s.area_m2,
                "outer": plane.lift(s.outer).tolist(),
                "holes": [
                    {"kind": h.kind.value, "ring": plane.lift(h.ring).tolist()} for h in s.holes
                ],
            }
            for s in plane.surfaces
        ]
        entry = {"id": plane.id, "class": plane.plane_class.value, "d": plane.d}
        entry |= {"normal": plane.normal.tolist(), "facing": plane.facing, "surfaces": surfaces}
        planes.append(entry)
    return {"format": "facet-model", "version": 1, "planes": planes}


def truth_model(truth: Truth, *, min_seen_m2: float = MIN_SURFACE_M2) -> dict[str, Any]:
    """The model that a perfect mapper would make: a plane for each coplanar group."""
    kept = [s for s in truth.surfaces if s.planar and s.seen_m2 >= min_seen_m2]
    planes = []
    for number, group in enumerate(coplanar_groups(kept), start=1):
        sign = 1 if group[0].d >= 0.0 else -1
        surfaces = [
            {
                "outer": s.outer.tolist(),
                "holes": [{"kind": h.kind.value, "ring": h.ring.tolist()} for h in s.holes],
            }
            for s in group
        ]
        entry: dict[str, Any] = {"id": number, "class": group[0].plane_class.value, "facing": sign}
        entry |= {"normal": (sign * group[0].normal).tolist(), "d": sign * group[0].d}
        planes.append(entry | {"surfaces": surfaces})
    return {"format": "facet-model", "version": 1, "planes": planes}


def coplanar_groups(surfaces: list[SurfaceTruth]) -> list[list[SurfaceTruth]]:
    """Surfaces that share a plane (1 degree, 1 cm) and the side they face."""
    groups: list[list[SurfaceTruth]] = []
    for surface in surfaces:
        home = next((g for g in groups if not apart(g[0], surface, 1.0, 0.01)), None)
        if home is None:
            groups.append([surface])
        else:
            home.append(surface)
    return groups


def _areas(planes: list[ModelPlane], truth: Truth) -> tuple[int, int, int]:
    """Cells of the model that lie on a planar truth surface, on nothing, on something curved."""
    flats = [(s, _tolerant(s)) for s in truth.surfaces if s.planar]
    curves = [(s, _tolerant(s)) for s in truth.surfaces if not s.planar]
    right = wrong = curved = 0
    for plane in planes:
        for outer, holes in plane.surfaces:
            cells = _cells(plane, outer, holes)
            on_flat = _on_truth(plane, cells, flats, MAX_ANGLE_DEG)
            rest = cells[~on_flat]
            on_curve = int(_on_truth(plane, rest, curves, CURVE_ANGLE_DEG).sum())
            right += int(on_flat.sum())
            curved += on_curve
            wrong += len(rest) - on_curve
    return right, wrong, curved


def _tolerant(surface: SurfaceTruth) -> shapely.Geometry:
    """Where model area counts as right, in (u, v): the outline grown, its holes shrunk."""
    shape = shapely.Polygon(surface.flat(surface.outer)).buffer(BORDER_M, join_style="mitre")
    for hole in surface.holes:
        shape -= shapely.Polygon(surface.flat(hole.ring)).buffer(-BORDER_M, join_style="mitre")
    shapely.prepare(shape)
    return shape


def _cells(plane: ModelPlane, outer: Float, holes: tuple[tuple[str, Float], ...]) -> Float:
    """World points (M, 3) m, one for each cell of a model surface, on the plane."""
    across = np.eye(3)[int(np.argmin(np.abs(plane.normal)))]
    axis_u = np.cross(across, plane.normal)
    axis_u /= np.linalg.norm(axis_u)
    axes = np.stack([axis_u, np.cross(plane.normal, axis_u)])
    flat = outer @ axes.T
    corner = (float(flat[:, 0].min()), float(flat[:, 1].min()))
    size = np.ceil((flat.max(axis=0) - flat.min(axis=0)) / CELL_M).astype(int)
    shape = (int(size[1]), int(size[0]))
    inside = cells_in_ring(flat, corner, shape)
    for _, ring in holes:
        inside &= ~cells_in_ring(ring @ axes.T, corner, shape)
    rows, columns = np.nonzero(inside)
    uv = np.stack([columns + 0.5, rows + 0.5], axis=1) * CELL_M + np.array(corner)
    return np.asarray(uv @ axes + plane.d * plane.normal)


def _on_truth(
    plane: ModelPlane,
    points: Float,
    surfaces: list[tuple[SurfaceTruth, shapely.Geometry]],
    max_angle_deg: float,
) -> Mask:
    on = np.zeros(len(points), dtype=np.bool_)
    for surface, shape in surfaces:
        if plane.angle_deg(surface.normal) > max_angle_deg:
            continue
        rest = np.flatnonzero(~on)
        near = rest[np.abs(points[rest] @ surface.normal - surface.d) <= MAX_OFFSET_M]
        uv = surface.flat(points[near])
        on[near[shapely.contains_xy(shape, uv)]] = True
    return on


def _merges(matches: list[Match]) -> tuple[tuple[str, str], ...]:
    return tuple(
        (a.truth.name, b.truth.name)
        for i, a in enumerate(matches)
        for b in matches[i + 1 :]
        if a.loosely & b.loosely and apart(a.truth, b.truth, APART_DEG, APART_M)
    )


def _thin_walls(matches: list[Match]) -> tuple[tuple[str, str], ...]:
    """Faces back to back, a thin wall between, that were both seen in the same place."""
    pairs = []
    for i, a in enumerate(matches):
        for b in matches[i + 1 :]:
            if angle_deg(a.truth.normal, -b.truth.normal) > 1.0:
                continue
            thickness = float(a.truth.d - np.mean(b.truth.outer, axis=0) @ a.truth.normal)
            common = a.seen & a.raster(b.truth.outer)
            if THIN_M[0] <= thickness <= THIN_M[1] and common.sum() * CELL_M2 >= MIN_SURFACE_M2:
                pairs.append((a.truth.name, b.truth.name))
    return tuple(pairs)


def _openings(matches: list[Match]) -> tuple[tuple[str, ...], tuple[str, ...], tuple[str, ...]]:
    """Names of the openings that the model misses, what is there instead, and all names."""
    missed, instead, names = [], [], []
    for match in matches:
        for number, hole in enumerate(match.truth.holes):
            if not _expected(match, hole):
                continue
            names.append(f"{match.truth.name} {hole.what} {number}")
            cells = match.raster(hole.ring)
            if _best_iou(match, cells, HoleKind.OPENING) < MIN_IOU:
                missed.append(names[-1])
                instead.append(_instead(match, cells))
    return tuple(missed), tuple(instead), tuple(names)


def _instead(match: Match, cells: Mask) -> str:
    if _best_iou(match, cells, HoleKind.UNOBSERVED) >= MIN_IOU:
        return "unobserved"
    if any(
        share((match.area(p, MAX_OFFSET_M) & cells).sum(), cells.sum()) > 0.5 for p in match.planes
    ):
        return "filled"
    return "outside the outline" if match.covered.any() else "no surface"


def _expected(match: Match, hole: HoleTruth) -> bool:
    """Whether a mapper could know the opening: beams passed, and its border was seen."""
    cells = match.raster(hole.ring)
    around = grown(cells, AROUND) & match.truth.inside()
    large = cells.sum() * CELL_M2 >= MIN_OPENING_M2
    told = hole.kind is HoleKind.OPENING and hole.what != "recess"
    return bool(told and large and share((around & match.seen).sum(), around.sum()) >= AROUND_SHARE)


def _best_iou(match: Match, cells: Mask, wanted: HoleKind) -> float:
    best = 0.0
    for plane in match.planes:
        for kind, ring in (hole for _, holes in plane.surfaces for hole in holes):
            theirs = match.raster(ring) if kind == wanted else np.zeros_like(cells)
            common = cells & theirs & match.within(plane, MAX_OFFSET_M)
            best = max(best, share(common.sum(), (cells | theirs).sum()))
    return best


def _false_openings(planes: list[ModelPlane], surfaces: list[SurfaceTruth]) -> tuple[int, ...]:
    """Plane ids of the model's large openings that lie on no hole of any truth surface."""
    false = []
    for plane in planes:
        on = [s for s in surfaces if s.holes and plane.angle_deg(s.normal) <= MAX_ANGLE_DEG]
        for kind, ring in (hole for _, holes in plane.surfaces for hole in holes):
            cells = _cells(plane, ring, ())
            if kind != HoleKind.OPENING or len(cells) * CELL_M2 < MIN_OPENING_M2:
                continue
            inside = np.zeros(len(cells), dtype=np.bool_)
            for surface in on:
                near = np.abs(cells @ surface.normal - surface.d) <= MAX_OFFSET_M
                for hole in surface.holes:
                    shape = shapely.Polygon(surface.flat(hole.ring)).buffer(BORDER_M)
                    inside |= near & shapely.contains_xy(shape, surface.flat(cells))
            if inside.mean() < MIN_IOU:
                false.append(plane.id)
    return tuple(false)


if __name__ == "__main__":
    MODEL, TRUTH = (json.loads(Path(name).read_text(encoding="utf-8")) for name in sys.argv[1:3])
    sys.stdout.write(score(MODEL, TRUTH).table() + "\n")
