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
QUICK_SCANS = 200


@dataclass(frozen=True)
class Column:
    """One column of the table; `sign` 1: more is better."""

    name: str
    sign: int
    of: Callable[[Score], float]


COLUMNS = (
    Column("surfaces found", 1, lambda s: s.num_found),
    Column("area recall", 1, lambda s: round(s.area_recall, 4)),
    Column("area precision", 1, lambda s: round(s.area_precision, 4)),
    Column("splits", -1, lambda s: len(s.splits)),
    Column("worst angle, deg", -1, lambda s: round(s.worst_angle_deg, 2)),
    Column("worst offset, mm", -1, lambda s: round(1e3 * s.worst_offset_m, 1)),
    Column("openings", 1, lambda s: len(s.openings) - len(s.openings_missed)),
)


def cloud_of(mapper: Mapper) -> Cloud:
    """Exact centroids, with Open3D's normals turned to the sensor: the best that they can be."""
    centroids, views = inside.centroids(mapper)
    voxel_m = mapper.settings.voxel_m
    points = libraries.open3d_cloud(centroids)
    libraries.open3d_normals(points, NEIGHBOURS_M[0] * voxel_m, NEIGHBOURS_M[1])
    normals = np.asarray(points.normals).copy()
    normals[np.einsum("ij,ij->i", normals, views) < 0.0] *= -1.0
    return Cloud(centroids, normals, voxel_m)


def open3d_patches(cloud: Cloud) -> Labels:
    points = libraries.open3d_cloud(cloud.centroids, cloud.normals)
    return libraries.open3d_labels(libraries.open3d_patches(points, cloud.min_points), cloud)


def cgal_growing(cloud: Cloud) -> Labels:
    points, shapes = libraries.cgal_points(cloud)
    libraries.cgal_growing(points, shapes, cloud)
    return libraries.cgal_labels(points, cloud.centroids)


def cgal_ransac(cloud: Cloud) -> Labels:
    points, shapes = libraries.cgal_points(cloud)
    libraries.cgal_ransac(points, shapes, cloud)
    return libraries.cgal_labels(points, cloud.centroids)


PEERS: dict[str, Callable[[Cloud], Labels]] = {
    "Open3D patches": open3d_patches,
    "CGAL region growing": cgal_growing,
    "CGAL efficient RANSAC": cgal_ransac,
}


def compare(quick: bool) -> tuple[list[Figure], dict[str, Any]]:
    """One table a drive; Facet should be first in every column, a tie counts as first."""
    figures: list[Figure] = []
    details: dict[str, Any] = {}
    for case in CASES:
        num_scans = QUICK_SCANS if quick else None
        simulation = Simulation("office", case.sensor, noise=case.noise, num_scans=num_scans)
        mapper, truth, _ = map_drive(simulation)
        scores = {"Facet": score(model_of(mapper.snapshot()), truth), **_peers(mapper, truth)}
        figures += _judge(case, scores)
        details[case.sensor] = {name: _row(s) for name, s in scores.items()}
        names = [f"{c.name}" for c in COLUMNS]
        number = len(scores["Facet"].surfaces)
        title = f"office, {case.sensor}: {number} surfaces, the same centroids, outlines and scorer"
        rows = [(name, *_row(s).values(), s.planes) for name, s in scores.items()]
        table(title, ("", *names, "planes"), rows)
    return figures, {"accuracy": details}


def _peers(mapper: Mapper, truth: Truth) -> dict[str, Score]:
    cloud, free = cloud_of(mapper), inside.free_space(mapper)
    found = {}
    for name, label in PEERS.items():
        labels = label(cloud)
        model = model_of_labels(labels, cloud.centroids, cloud.normals, free, mapper.settings)
        found[name] = score(model, truth)
    return found


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
