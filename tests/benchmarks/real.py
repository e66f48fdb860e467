"""Real recordings: are the known floors, ceilings, walls and panels there, each as one plane?

The references were measured from the data itself (RANSAC and least squares): no ground truth. The
recordings are third parties' and not part of the project; without them nothing is judged.

The suited settings are the best of those tried against these very targets: of about 50 for the
corridor, 28 for the rooms, 9 for the panels. They say what can be reached, not what to expect of a
recording nobody tuned for; that is what the defaults' table is for.
"""

from __future__ import annotations

import sys
import time
from dataclasses import asdict, dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from benchmarks.figures import FOLDER, Figure, at_most, report, skip
from facet.export.model import build_model
from facet.export.picture import write_picture
from facet.mapping.mapper import Mapper
from facet.mapping.settings import MapSettings
from facet.warmup import warm_up
from facet_protocol.messages import Plane
from scenes import SHARED_DATA, recorded

NEAR_DEG, NEAR_M, NEAR_M2 = 6.0, 0.06, 0.5  # a plane this near and large is a piece of the same


@dataclass(frozen=True)
class Known:
    """A plane of the scene: normal . x = d, of either side."""

    name: str
    normal: tuple[float, float, float]
    d: float
    within_m: float
    within_deg: float = 2.0


@dataclass(frozen=True)
class Place:
    name: str
    known: tuple[Known, ...]
    suited: MapSettings  # picked on this very recording; the defaults are judged as well
    apart: tuple[tuple[str, str, float, float], ...] = field(default=())  # names, m, tolerance


X, Y, Z = (1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0)
PLACES = (
    Place(
        "corridor",
        (
            Known("floor", Z, 0.0, 0.02), Known("ceiling", Z, 2.47, 0.03),
            Known("leg 1 west", X, -1.11, 0.03), Known("leg 1 east", X, 1.08, 0.03),
            Known("leg 2 far", Y, 8.85, 0.03), Known("leg 2 near", Y, 6.78, 0.03),
            Known("leg 3", X, -10.46, 0.03),
        ),
        MapSettings(voxel_m=0.15, theta_deg=12.0),
    ),
    Place(
        "rooms",
        (
            Known("floor", Z, -1.27, 0.03), Known("ceiling", Z, 1.64, 0.03),
            Known("wall south", Y, -1.46, 0.03), Known("wall north", Y, 3.07, 0.03),
        ),
        MapSettings(voxel_m=0.1, theta_deg=12.0),
        apart=(("floor", "ceiling", 2.91, 0.03),),
    ),
    Place(
        "panels",
        (
            Known("floor", Z, 0.0, 0.02),
            Known("panel 1", (-0.66, -0.75, 0.0), 0.80, 0.02, 1.5),
            Known("panel 2", (-0.77, 0.64, 0.0), 2.35, 0.02, 1.5),
            Known("panel 3", (-0.63, -0.78, 0.0), 1.65, 0.02, 1.5),
        ),
        MapSettings(voxel_m=0.06),
    ),
)  # fmt: skip


@dataclass(frozen=True)
class Found:
    """What the map has of a known plane."""

    plane: Plane | None  # the largest near it
    pieces: int  # planes near it that are large enough to count
    area_m2: float
    angle_deg: float
    offset_m: float  # of its centroid


def find(known: Known, planes: tuple[Plane, ...]) -> Found:
    normal = unit(known.normal)
    near: list[tuple[float, Plane]] = []
    for plane in planes:
        area = sum(surface.area_m2 for surface in plane.surfaces)
        offset = float(plane.centroid @ normal) - known.d
        if angle_deg(plane.normal, normal) <= NEAR_DEG and abs(offset) <= NEAR_M and area > NEAR_M2:
            near.append((area, plane))
    if not near:
        return Found(None, 0, 0.0, np.inf, np.inf)
    area, best = max(near, key=lambda pair: pair[0])
    offset = float(best.centroid @ normal) - known.d
    return Found(best, len(near), area, angle_deg(best.normal, normal), offset)


def unit(normal: tuple[float, float, float]) -> NDArray[np.float64]:
    return np.array(normal) / np.linalg.norm(normal)


def angle_deg(a: NDArray[np.float64], b: NDArray[np.float64]) -> float:
    """Between the lines along two normals."""
    return float(np.degrees(np.arccos(min(1.0, abs(float(a @ b))))))


def map_place(
    place: Place, settings: MapSettings, num_scans: int | None = None
) -> tuple[Mapper, float]:
    """All scans, then one update; seconds of both."""
    warm_up(settings)
    mapper, scans = Mapper(settings, place.name), list(recorded(place.name, num_scans))
    started = time.perf_counter()
    for scan in scans:
        mapper.insert(scan)
    mapper.update()
    return mapper, time.perf_counter() - started


def judge(place: Place, planes: tuple[Plane, ...]) -> list[Figure]:
    figures, found = [], {known.name: find(known, planes) for known in place.known}
    for known in place.known:
        got, name = found[known.name], f"{place.name}: {known.name}"
        text = f"{got.area_m2:.1f} m2 in {got.pieces}"
        figures.append(Figure(f"{name}, planes", text, "1", got.pieces == 1))
        figures.append(
            at_most(f"{name}, offset", 1e3 * abs(got.offset_m), 1e3 * known.within_m, "mm")
        )
        figures.append(at_most(f"{name}, angle", got.angle_deg, known.within_deg, "deg"))
    for a, b, distance, tolerance in place.apart:
        one, other = found[a].plane, found[b].plane
        if one is not None and other is not None:
            off = abs(abs(float((one.centroid - other.centroid) @ one.normal)) - distance)
            what = f"{place.name}: {a} to {b}, off {distance:g} m by"
            figures.append(at_most(what, 1e3 * off, 1e3 * tolerance, "mm"))
    ids = [got.plane.id for got in found.values() if got.plane is not None]
    shared = sorted({i for i in ids if ids.count(i) > 1})
    figures.append(Figure(f"{place.name}: merged", str(shared) if shared else 0, "0", not shared))
    return figures


def run(place: Place, name: str, settings: MapSettings) -> tuple[list[Figure], dict[str, Any]]:
    """One place with one choice of settings: figures, details, and a picture."""
    mapper, seconds = map_place(place, settings)
    snapshot, counts = mapper.snapshot(), mapper.counts()
    found = mapper.report()
    figures = [
        *judge(place, snapshot.changed),
        Figure(f"{place.name}: planes", len(snapshot.changed)),
        Figure(f"{place.name}: noise sigma_N, mm", 1e3 * counts.sigma_n_m),
        Figure(f"{place.name}: discarded points, %", found.discarded_points_percent),
        Figure(f"{place.name}: {counts.points_in:,} points to contours, s", seconds),
    ]
    model = build_model(snapshot, counts, mapper.settings.as_dict(), mapper.digest())
    FOLDER.mkdir(parents=True, exist_ok=True)
    write_picture(model, FOLDER / f"real-{place.name}-{name}.png")
    details = {
        "settings": asdict(settings),
        "counts": counts.as_dict(),
        "report": found.as_dict(),
        "seconds": seconds,
    }
    return figures, details


def changed(settings: MapSettings) -> str:
    """What differs from the defaults."""
    usual = MapSettings().as_dict()
    return ", ".join(f"{k} {v:g}" for k, v in settings.as_dict().items() if v != usual[k])


def main(arguments: list[str]) -> None:
    """`real.py [--quick | PLACE]`."""
    if "--quick" in arguments:
        arguments = [PLACES[0].name]
    if not SHARED_DATA.exists():
        skip(f"no recordings at {SHARED_DATA}")
    for name in ("default", "suited"):
        figures: list[Figure] = []
        details: dict[str, Any] = {}
        for place in (p for p in PLACES if not arguments or p.name == arguments[0]):
            settings = MapSettings() if name == "default" else place.suited
            more, details[place.name] = run(place, name, settings)
            figures += [Figure(f"{place.name}: settings", changed(settings) or "default"), *more]
        report(f"real-{name}", f"Real recordings, {name} settings", figures, {"places": details})


if __name__ == "__main__":
    main(sys.argv[1:])
