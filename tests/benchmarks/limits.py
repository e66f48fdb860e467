"""How well the points themselves know the planes of the simulated office: least squares on the
points of each surface, told apart by the truth. No mapper can be asked for much more."""

from __future__ import annotations

import sys

import numpy as np
import shapely

from benchmarks.figures import Figure, report
from benchmarks.truth import CASES, SMALL_M2, Case
from facet.mapping.quantise import quantise
from facet.mapping.settings import MapSettings
from facet.simulate import Observer, Simulation, Truth
from facet_protocol.messages import LineFan
from facet_protocol.scans import project

LEAST_M2, NEAR_M, INSIDE_M = 0.5, 0.05, 0.03
LEAST_POINTS = 10


def points_of(simulation: Simulation, observer: Observer) -> tuple[np.ndarray, np.ndarray]:
    """(N, 3) points of the drive, metres, and (N, 3) directions to where they were seen from."""
    settings = MapSettings()
    points, views = [], []
    for index in range(len(simulation)):
        look = simulation.look(index)
        observer.watch(look)
        message = simulation.message(look)
        scan = project(message, simulation.reach_m) if isinstance(message, LineFan) else message
        ticks = quantise([scan], settings)
        points.append((ticks.points * settings.tick_m).astype(np.float32))
        views.append(ticks.views.astype(np.int8))
    return np.concatenate(points), np.concatenate(views)


def fitted(truth: Truth, points: np.ndarray, views: np.ndarray) -> np.ndarray:
    """(S, 4) area, points, angle in degrees, offset in mm, of each surface with enough points."""
    rows = []
    for surface in truth.surfaces:
        if not surface.planar or surface.seen_m2 < LEAST_M2:
            continue
        off = points @ surface.normal.astype(np.float32) - np.float32(surface.d)
        near = np.flatnonzero(np.abs(off) < NEAR_M)
        near = near[views[near] @ surface.normal > 0.0]
        flat = surface.flat(points[near].astype(np.float64))
        inside = shapely.Polygon(surface.flat(surface.outer)).buffer(-INSIDE_M)
        own = shapely.contains_xy(inside, flat[:, 0], flat[:, 1])
        if own.sum() < LEAST_POINTS:
            continue
        flat, height = flat[own] - flat[own].mean(axis=0), off[near[own]].astype(np.float64)
        design = np.column_stack([flat, np.ones(len(flat))])
        slope_u, slope_v, offset = np.linalg.lstsq(design, height, rcond=None)[0]
        angle = np.degrees(np.arctan(np.hypot(slope_u, slope_v)))
        rows.append((surface.seen_m2, own.sum(), angle, 1e3 * abs(offset)))
    return np.array(rows)


def judge(case: Case) -> list[Figure]:
    simulation = Simulation("office", case.sensor, noise=case.noise)
    observer = Observer(simulation)
    points, views = points_of(simulation, observer)
    table = fitted(observer.truth(), points, views)
    large = table[:, 0] >= SMALL_M2
    figures = [
        Figure("surfaces with points of their own", len(table)),
        Figure("fewest points", int(table[:, 1].min())),
        Figure("angle, median, deg", float(np.median(table[:, 2]))),
        Figure("angle, worst, deg", float(table[large, 2].max())),
        Figure("angle, worst under 1 m2, deg", float(table[~large, 2].max())),
        Figure("offset, worst, mm", float(table[:, 3].max())),
    ]
    return [Figure(f"{case.sensor}: {f.what}", f.value, f.target, f.met) for f in figures]


if __name__ == "__main__":
    chosen = [c for c in CASES if not sys.argv[1:] or c.sensor in sys.argv[1:]]
    figures = [figure for case in chosen for figure in judge(case)]
    report("limits", "Least squares on the points of each surface", figures, {})
