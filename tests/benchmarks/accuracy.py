"""Facet and the libraries on the same simulated drives: the same centroids, outlines and scorer."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from benchmarks import inside, libraries
from benchmarks.figures import Figure
from benchmarks.libraries import Cloud
from benchmarks.memberships import model_of_labels
from benchmarks.truth import CASES, Case, map_drive
from facet.commands.terminal import table
from facet.mapping.mapper import Mapper
from facet.simulate import Simulation, Truth
from scorer import Score, model_of, score

Labels = NDArray[np.int32]
NEIGHBOURS_M = (3.0, 41)  # voxels, count: of the normals that the libraries are given
QUICK_SCANS = {"lidar3d": 200, "pushbroom": 3000}


@dataclass(frozen=True)
class Column:
    """One column of the table; `sign` 1: more is better."""

    name: str
    sign: int
    of: Callable[[Score], float]


COLUMNS = (
    Column("found", 1, lambda s: s.num_found),
    Column("recall", 1, lambda s: round(s.area_recall, 4)),
    Column("precision", 1, lambda s: round(s.area_precision, 4)),
    Column("splits", -1, lambda s: len(s.splits)),
    Column("worst deg", -1, lambda s: round(s.worst_angle_deg, 2)),
    Column("worst mm", -1, lambda s: round(1e3 * s.worst_offset_m, 1)),
    Column("openings", 1, lambda s: _opened(s.openings) - _opened(s.openings_missed)),
    Column(
        "but doors", 1, lambda s: _opened(s.openings, "door") - _opened(s.openings_missed, "door")
    ),
)


def _opened(names: tuple[str, ...], but: str = "none") -> int:
    """How many of the openings; a door is closed at its threshold by Facet's walls alone, so the
    others are counted apart."""
    return sum(f" {but} " not in name for name in names)


def cloud_of(mapper: Mapper) -> Cloud:
    """Exact centroids, with Open3D's normals turned to the sensor: the best that they can be."""
    centroids, views = inside.centroids(mapper)
    voxel_m = mapper.settings.voxel_m
    points = libraries.open3d_cloud(centroids)
    libraries.open3d_normals(points, NEIGHBOURS_M[0] * voxel_m, NEIGHBOURS_M[1])
    normals = np.asarray(points.normals).copy()
    normals[np.einsum("ij,ij->i", normals, views) < 0.0] *= -1.0
    return Cloud(centroids, normals, voxel_m)


def open3d_patches(cloud: Cloud, variance_deg: float, coplanarity_deg: float) -> Labels:
    points = libraries.open3d_cloud(cloud.centroids, cloud.normals)
    boxes = libraries.open3d_patches(points, cloud.min_points, variance_deg, coplanarity_deg)
    return libraries.open3d_labels(boxes, cloud)


def cgal_growing(cloud: Cloud, distance: float, neighbours: int) -> Labels:
    points, shapes = libraries.cgal_points(cloud)
    libraries.cgal_growing(points, shapes, cloud, distance, neighbours)
    return libraries.cgal_labels(points, cloud.centroids)


def cgal_ransac(cloud: Cloud, distance: float) -> Labels:
    points, shapes = libraries.cgal_points(cloud)
    libraries.cgal_ransac(points, shapes, cloud, distance)
    return libraries.cgal_labels(points, cloud.centroids)


# each library with the settings that did best of a dozen, and its own or the obvious ones; the
# table shows what finds most surfaces. Facet keeps its defaults.
PEERS: dict[str, tuple[Callable[..., Labels], tuple[tuple[float, ...], ...]]] = {
    "Open3D patches": (open3d_patches, ((45, 60), (60, 75))),
    "CGAL region growing": (cgal_growing, ((1.0, 24), (1.0, 12))),
    "CGAL efficient RANSAC": (cgal_ransac, ((0.6,), (1.0,))),
}


def compare(quick: bool) -> tuple[list[Figure], dict[str, Any]]:
    """One table a drive; Facet should be first in every column, a tie counts as first."""
    figures: list[Figure] = []
    details: dict[str, Any] = {}
    for case in CASES:
        num_scans = QUICK_SCANS[case.sensor] if quick else None
        simulation = Simulation("office", case.sensor, noise=case.noise, num_scans=num_scans)
        mapper, truth, _ = map_drive(simulation)
        scores = {
            "Facet": score(model_of(mapper.snapshot()), truth),
            **_peers(mapper, truth, quick),
        }
        figures += _judge(case, scores)
        figures += [
            Figure(f"{case.sensor}: worst, Facet : {name}, on the {count} that both found", text)
            for name, count, text in _common(scores)
        ]
        details[case.sensor] = {name: _row(s) for name, s in scores.items()}
        names = [column.name for column in COLUMNS]
        number = len(scores["Facet"].surfaces)
        title = f"office, {case.sensor}: {number} surfaces, the same centroids, outlines and scorer"
        rows = [(name, *_row(s).values(), s.planes) for name, s in scores.items()]
        table(title, ("", *names, "planes"), rows)
    return figures, {"accuracy": details}


def _peers(mapper: Mapper, truth: Truth, quick: bool) -> dict[str, Score]:
    """The best of each library's settings: most surfaces found, then most area."""
    cloud, free = cloud_of(mapper), inside.free_space(mapper)
    found = {}
    for name, (label, settings) in PEERS.items():
        scores = []
        for chosen in settings[:1] if quick else settings:
            labels = label(cloud, *chosen)
            model = model_of_labels(labels, cloud.centroids, cloud.normals, free, mapper.settings)
            scores.append(score(model, truth))
        found[name] = max(scores, key=lambda s: (s.num_found, s.area_recall))
    return found


def _common(scores: dict[str, Score]) -> list[tuple[str, int, str]]:
    """Worst errors where both Facet and a library found the surface: who finds only the easy ones
    has small errors."""
    own = {s.name: s for s in scores["Facet"].surfaces if s.found}
    rows = []
    for name, scored in scores.items():
        both = [(own[s.name], s) for s in scored.surfaces if s.found and s.name in own]
        if name == "Facet" or not both:
            continue
        angles = [max(pair[k].angle_deg for pair in both) for k in (0, 1)]
        offsets = [1e3 * max(abs(pair[k].offset_m) for pair in both) for k in (0, 1)]
        text = f"{angles[0]:.2f} : {angles[1]:.2f} deg, {offsets[0]:.1f} : {offsets[1]:.1f} mm"
        rows.append((name, len(both), text))
    return rows


def _row(scored: Score) -> dict[str, float]:
    return {column.name: column.of(scored) for column in COLUMNS}


def _judge(case: Case, scores: dict[str, Score]) -> list[Figure]:
    figures = []
    for column in COLUMNS:
        own = column.of(scores["Facet"])
        others = {name: column.of(s) for name, s in scores.items() if name != "Facet"}
        best = max(others, key=lambda name: column.sign * others[name])
        target = f"{'>=' if column.sign > 0 else '<='} {others[best]:g} ({best})"
        met = column.sign * own >= column.sign * others[best]
        figures.append(
            Figure(f"{case.sensor}: {column.name}, beside the best peer", own, target, met)
        )
    return figures
