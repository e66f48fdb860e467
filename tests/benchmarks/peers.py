"""Facet beside the libraries that people would pick today, on the same voxel centroids.

`peers.py [--quick] [speed] [accuracy]`. Runs of Facet and of a library take turns in one process,
all warm, each with all cores; medians. Needs the environment of `make bench` (.venv-bench).
"""

from __future__ import annotations

import os
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

os.environ.setdefault("NUMBA_THREADING_LAYER", "omp")  # Open3D brings a TBB that numba refuses

import numba
import numpy as np
import small_gicp
from scipy.spatial import cKDTree

from benchmarks import buildings, inside, libraries
from benchmarks.accuracy import cloud_of, compare
from benchmarks.charts import ratios
from benchmarks.figures import Figure, at_least, at_most, name_of, report
from benchmarks.growth import all_copies, grow
from benchmarks.libraries import Cloud
from facet.commands.terminal import table
from facet.mapping.mapper import Mapper
from facet.mapping.settings import MapSettings
from facet.pipeline import Stopwatch
from facet.warmup import warm_up
from facet_protocol.messages import Scan

VOXELS, QUICK_VOXELS = 1_000_000, 60_000
RUNS = 5
SAMPLE = 4000  # voxels that tell how many others a region holds
OURS, OPEN3D, NEWER, GICP = "Facet", "Open3D", "Open3D tensor", "small_gicp"
PATCHES, GROWING, RANSAC = "Open3D patches", "CGAL region growing", "CGAL efficient RANSAC"


@dataclass(frozen=True)
class Region:
    """What Facet's normals look at, as a radius search: as wide in a plane, as many voxels."""

    cube: int  # half side, voxels
    radius_m: float
    voxels: int


def speed(quick: bool) -> tuple[list[Figure], dict[str, Any]]:
    """Normals of a whole map, and a whole map, beside the libraries."""
    looks = buildings.office(30 if quick else 100)
    scans = _scans(looks, QUICK_VOXELS if quick else VOXELS)
    mapper, _ = _map(scans)
    cloud, region = cloud_of(mapper), _region(mapper)
    runs = 2 if quick else RUNS
    ours: list[dict[str, float]] = []
    theirs: dict[str, list[float]] = {}
    for _ in range(runs):
        ours.append(_map(scans)[1])
        for name, seconds in _others(cloud, region).items():
            theirs.setdefault(name, []).append(seconds)
    middle = {name: float(np.median(values)) for name, values in theirs.items()}
    own = {name: float(np.median([run[name] for run in ours])) for name in ours[0]}
    _show(own, middle, len(cloud.centroids))
    points = sum(len(scan.points) for scan in scans)
    figures = [
        Figure("voxels", len(cloud.centroids)),
        Figure("points", points),
        Figure("threads", numba.get_num_threads()),
        Figure(
            "region of a normal, m, and voxels in it", f"{region.radius_m:.3f}, {region.voxels}"
        ),
        *_normals(own, middle, len(cloud.centroids)),
        *_whole(own, middle),
    ]
    details = {"ours_s": ours, "theirs_s": theirs, "region": vars(region), "points": points}
    return figures, {"speed": details}


def _normals(own: dict[str, float], theirs: dict[str, float], voxels: int) -> list[Figure]:
    rates = {name: voxels / theirs[name] * 1e-6 for name in (OPEN3D, NEWER, GICP)}
    rate = voxels / own["normals"] * 1e-6
    best = max(OPEN3D, NEWER, key=lambda name: rates[name])
    return [
        Figure("normals, Facet, M voxels/s", rate),
        *(Figure(f"normals, {name}, M voxels/s", value) for name, value in rates.items()),
        at_least(f"normals, times as fast as {best}", rate / rates[best], 4.0),
    ]


def _whole(own: dict[str, float], theirs: dict[str, float]) -> list[Figure]:
    total = own["insert"] + own["update"]
    figures = [
        Figure("whole map, Facet, points to contours, s", total),
        Figure("  of which update, moments to contours, s", own["update"]),
    ]
    for name, limit in ((PATCHES, 1.0), (GROWING, 0.5), (RANSAC, 0.5)):
        figures += [
            Figure(f"planes alone, {name}, s", theirs[name]),
            at_most(f"whole map, time over that of {name}", total / theirs[name], limit),
        ]
    return figures


def _others(cloud: Cloud, region: Region) -> dict[str, float]:
    """Seconds of each library, once. Clouds are made and normals given before the clock starts."""
    plain = libraries.open3d_cloud(cloud.centroids)
    tensor = libraries.open3d_tensor_cloud(cloud.centroids)
    known = libraries.open3d_cloud(cloud.centroids, cloud.normals)
    gicp = small_gicp.PointCloud(cloud.centroids)
    threads = numba.get_num_threads()
    size = region.radius_m, region.voxels
    seconds = {
        OPEN3D: _timed(libraries.open3d_normals, plain, *size),
        NEWER: _timed(libraries.open3d_tensor_normals, tensor, *size),
        GICP: _timed(
            small_gicp.estimate_normals, gicp, num_neighbors=region.voxels, num_threads=threads
        ),
        PATCHES: _timed(libraries.open3d_patches, known, cloud.min_points),
    }
    for name, detect in ((GROWING, libraries.cgal_growing), (RANSAC, libraries.cgal_ransac)):
        points, shapes = libraries.cgal_points(cloud)
        seconds[name] = _timed(detect, points, shapes, cloud)
    return seconds


def _timed(work: Callable[..., Any], *arguments: Any, **options: Any) -> float:
    started = time.perf_counter()
    work(*arguments, **options)
    return time.perf_counter() - started


def _scans(looks: buildings.Looks, voxels: int) -> list[Scan]:
    """The scans that fill so many voxels."""
    mapper, taken = Mapper(), []

    def noted() -> Any:
        for scan in all_copies(looks):
            taken.append(scan)
            yield scan

    grow(mapper, voxels, looks, noted())
    return taken[:-1]


def _map(scans: list[Scan]) -> tuple[Mapper, dict[str, float]]:
    """Points to contours; seconds of insert, of the update and of each of its stages."""
    mapper = Mapper()
    started = time.perf_counter()
    for scan in scans:
        mapper.insert(scan)
    insert_s = time.perf_counter() - started
    stopwatch = Stopwatch()
    update_s = _timed(mapper.update, stopwatch)
    stages = {stage: ms * 1e-3 for stage, ms in stopwatch.stage_ms.items()}
    return mapper, {"insert": insert_s, "update": update_s, **stages}


def _region(mapper: Mapper) -> Region:
    """The median region: a disc as large as the square that the cube cuts out of a plane. Radii
    are the largest that were looked at: the final one is at most that, mostly one less."""
    cube = max(1, int(np.median(inside.radii(mapper))) - 1)
    voxel_m = mapper.settings.voxel_m
    centroids, _ = inside.centroids(mapper)
    chosen = np.random.default_rng(0).choice(len(centroids), SAMPLE)
    around = cKDTree(centroids).query_ball_point(
        centroids[chosen], (cube + 0.5) * voxel_m, p=np.inf, return_length=True
    )
    radius_m = (2 * cube + 1) * voxel_m / np.sqrt(np.pi)
    return Region(cube, float(radius_m), int(np.median(around)))


def _show(own: dict[str, float], theirs: dict[str, float], voxels: int) -> None:
    rows = [(f"Facet, {name}", value) for name, value in own.items()]
    rows += list(theirs.items())
    table(f"{voxels:,} voxels, medians", ("", "s"), rows)


def main(arguments: list[str]) -> None:
    quick = "--quick" in arguments
    sections = {"speed": speed, "accuracy": compare}
    chosen = [a for a in arguments if a != "--quick"] or list(sections)
    warm_up(MapSettings())
    figures: list[Figure] = []
    details: dict[str, Any] = {"quick": quick, "threads": numba.get_num_threads()}
    for name in chosen:
        own, found = sections[name](quick)
        figures += own
        details |= found
    report(name_of("peers", quick), "Beside the libraries", figures, details)
    ratios(name_of("peers", quick), "beside the libraries, each figure over its target", figures)


if __name__ == "__main__":
    main(sys.argv[1:])
