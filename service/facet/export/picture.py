"""The model as one PNG: a cutaway view on the left, the plan of the main storey on the right."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence, Set
from pathlib import Path
from typing import Any

import numpy as np
import shapely
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch, PathPatch, Polygon
from matplotlib.path import Path as Outline
from numpy.typing import NDArray

from facet.export import cutaway
from facet.export.colours import CLASS_COLOURS, HOLE_COLOURS, Rgb
from facet.export.floorplan import CUT_M, Piece, Segment, floor_level, wall_segments
from facet.export.model import Model, planes_of
from facet.export.viewpoint import corners, is_overhead, turned, walls_azimuth
from facet_protocol.messages import HoleKind, Plane, PlaneClass, Surface

INCHES = (20.0, 9.6)
DPI = 110
INK = "#2b2e34"
PALE = "#8a8f98"
POCHE_M = 0.09  # a wall is drawn this thick, away from the side it was seen from
LABEL_MIN_M2 = 2.0
OPENING_TINT = "#cfe4f8"
DOOR_LINE: dict[str, Any] = {"lw": 1.0, "ls": (0, (3, 2))}
OFF_CUT_LINE: dict[str, Any] = {"color": PALE, "lw": 0.6, "ls": (0, (4, 3))}
PLAN_TITLE = f"Plan, cut {CUT_M:g} m above the main floor"


def write_picture(model: Model, path: Path) -> None:
    """Same model, same bytes (for the same matplotlib)."""
    planes = planes_of(model)
    figure = Figure(figsize=INCHES, dpi=DPI, facecolor="white")
    FigureCanvasAgg(figure)
    view = figure.add_axes((0.01, 0.07, 0.52, 0.80))
    plan = figure.add_axes((0.55, 0.07, 0.43, 0.80))
    _draw_cutaway(view, planes)
    _draw_plan(plan, planes)
    _draw_words(figure, model, planes)
    figure.savefig(path, format="png", metadata={"Software": None})


def _draw_cutaway(axes: Axes, planes: Sequence[Plane]) -> None:
    box = axes.get_window_extent()
    axes.imshow(cutaway.render(planes, int(box.width), int(box.height)), aspect="equal")
    axes.set_axis_off()


def _draw_plan(axes: Axes, planes: Sequence[Plane]) -> None:
    axes.set_aspect("equal")
    axes.set_axis_off()
    level = floor_level(planes)
    azimuth = walls_azimuth(planes)
    aligned = [turned(plane, azimuth) for plane in planes if not is_overhead(plane)]
    for plane in aligned:
        for surface in plane.surfaces:
            if plane.plane_class is PlaneClass.WALL:
                _draw_wall(axes, plane, surface, level)
            else:
                _draw_ground(axes, plane, surface)
    drawn = corners(aligned)
    if len(drawn):
        _draw_measures(axes, drawn[:, :2], azimuth)


def _draw_ground(axes: Axes, plane: Plane, surface: Surface) -> None:
    """A floor, or anything else that is not upright, seen from above."""
    is_floor = plane.plane_class is PlaneClass.FLOOR
    rings = [plane.lift(r)[:, :2] for r in (surface.outer, *(h.ring for h in surface.holes))]
    colour = _hex(CLASS_COLOURS[plane.plane_class])
    edge = "none" if is_floor else "#4d7a46"
    patch = PathPatch(_outline(rings), facecolor=colour, edgecolor=edge, alpha=0.45, zorder=1)
    axes.add_patch(patch)
    for hole, ring in zip(surface.holes, rings[1:], strict=True):
        if hole.kind is HoleKind.UNOBSERVED:
            tint = _hex(HOLE_COLOURS[hole.kind])
            axes.add_patch(Polygon(ring, fc="none", ec=tint, hatch="////", lw=0.6, zorder=2))
    if is_floor and surface.area_m2 >= LABEL_MIN_M2:
        x, y = _label_spot(shapely.Polygon(rings[0], rings[1:]).buffer(0))
        axes.text(x, y, f"{surface.area_m2:.1f} m²", ha="center", va="center", color=INK, size=11)


def _label_spot(area: shapely.Geometry) -> tuple[float, float]:
    """The centroid where there is room around it, else the middle of the widest part."""
    widest = shapely.maximum_inscribed_circle(area)  # a line: the centre and where it touches
    centroid = area.centroid
    roomy = area.contains(centroid) and area.boundary.distance(centroid) > widest.length / 2.0
    x, y = centroid.coords[0] if roomy else widest.coords[0]
    return float(x), float(y)


def _draw_wall(axes: Axes, plane: Plane, surface: Surface, level: float) -> None:
    segments = wall_segments(plane, surface, level)
    for segment in segments:
        PIECES[segment.piece](axes, segment)
    if not segments:  # a parapet, a lintel: above or below the cut
        ring = plane.lift(surface.outer)[:, :2]
        axes.plot(ring[:, 0], ring[:, 1], **OFF_CUT_LINE, zorder=2)


def _box(segment: Segment) -> NDArray[np.float64]:
    """(4, 2) m: the segment, made as thick as a drawn wall."""
    return np.concatenate([segment.ends, segment.ends[::-1] - POCHE_M * segment.inward])


def _draw_solid(axes: Axes, segment: Segment) -> None:
    axes.add_patch(Polygon(_box(segment), facecolor=INK, edgecolor=INK, linewidth=0.8, zorder=4))


def _draw_door(axes: Axes, segment: Segment) -> None:
    tint = _hex(HOLE_COLOURS[HoleKind.OPENING])
    (xa, ya), (xb, yb) = segment.ends
    axes.plot([xa, xb], [ya, yb], color=tint, **DOOR_LINE, zorder=3)


def _draw_window(axes: Axes, segment: Segment) -> None:
    tint = _hex(HOLE_COLOURS[HoleKind.OPENING])
    box = Polygon(_box(segment), facecolor=OPENING_TINT, edgecolor=tint, linewidth=0.9, zorder=3)
    axes.add_patch(box)


def _draw_unobserved(axes: Axes, segment: Segment) -> None:
    tint = _hex(HOLE_COLOURS[HoleKind.UNOBSERVED])
    box = Polygon(_box(segment), fc="white", ec=tint, hatch="//////", linewidth=0.9, zorder=3)
    axes.add_patch(box)


PIECES = {
    Piece.SOLID: _draw_solid,
    Piece.DOOR: _draw_door,
    Piece.WINDOW: _draw_window,
    Piece.UNOBSERVED: _draw_unobserved,
}


def _draw_measures(axes: Axes, points: NDArray[np.float64], azimuth: float) -> None:
    """Overall dimensions, scale bar and the map's axes, below and to the left of the plan."""
    low, high = points.min(axis=0), points.max(axis=0)
    size = high - low
    gap = 0.05 * float(size.max())
    arrow = {"arrowstyle": "<|-|>", "color": PALE, "lw": 0.9, "shrinkA": 0, "shrinkB": 0}
    below, left = low[1] - gap, low[0] - gap
    axes.annotate("", (low[0], below), (high[0], below), arrowprops=arrow)
    axes.annotate("", (left, low[1]), (left, high[1]), arrowprops=arrow)
    words: dict[str, Any] = {
        "color": INK,
        "size": 10,
        "ha": "center",
        "va": "center",
        "backgroundcolor": "white",
    }
    axes.text((low[0] + high[0]) / 2, below, f"{size[0]:.2f} m", **words)
    axes.text(left, (low[1] + high[1]) / 2, f"{size[1]:.2f} m", rotation=90, **words)
    _draw_scale_bar(axes, low[0], below - 1.2 * gap, float(size.max()))
    _draw_axes_mark(axes, high[0] - gap, below - 1.9 * gap, 0.8 * gap, azimuth)
    words = {"color": INK, "size": 12, "ha": "center", "va": "bottom"}
    axes.text((low[0] + high[0]) / 2, high[1] + gap / 2, PLAN_TITLE, **words)
    axes.set_xlim(left - gap, high[0] + gap)
    axes.set_ylim(below - 2.4 * gap, high[1] + 1.5 * gap)


def _draw_scale_bar(axes: Axes, x: float, y: float, extent: float) -> None:
    unit = next(u for u in (0.1, 0.2, 0.5, 1.0, 2.0, 5.0, 10.0, 20.0, 50.0, 1e9) if u > extent / 14)
    height = extent / 120
    for k in range(4):
        box = [[x + k * unit, y], [x + (k + 1) * unit, y]]
        ring = box + [[p[0], p[1] + height] for p in reversed(box)]
        axes.add_patch(Polygon(ring, facecolor=INK if k % 2 == 0 else "white", edgecolor=INK))
    for k in (0, 2, 4):
        text = f"{k * unit:g}" + (" m" if k == 4 else "")
        axes.text(x + k * unit, y - height, text, ha="center", va="top", size=9, color=INK)


def _draw_axes_mark(axes: Axes, x: float, y: float, length: float, azimuth: float) -> None:
    """The map's own axes: the plan is turned so that the walls lie along the page."""
    for name, angle in (("x", -azimuth), ("y", np.pi / 2.0 - azimuth)):
        dx, dy = length * np.cos(angle), length * np.sin(angle)
        arrow = {"arrowstyle": "-|>", "color": INK, "lw": 1.1, "shrinkA": 0, "shrinkB": 0}
        axes.annotate("", (x + dx, y + dy), (x, y), arrowprops=arrow)
        axes.text(x + 1.25 * dx, y + 1.25 * dy, name, size=9, color=INK, ha="center", va="center")


def _draw_words(figure: Figure, model: Model, planes: Sequence[Plane]) -> None:
    counts, settings = model["counts"], model["settings"]
    classes = Counter(plane.plane_class for plane in planes)
    parts = ", ".join(_plural(classes[kind], kind.value) for kind in PlaneClass if classes[kind])
    surfaces = sum(len(plane.surfaces) for plane in planes)
    title = f"{model['map']['id']}: {_plural(len(planes), 'plane')} ({parts})"
    figure.text(0.02, 0.945, title, size=18, weight="bold", color=INK)
    figure.text(
        0.02,
        0.91,
        f"{_plural(surfaces, 'surface')} from {counts['points_stored']:,} points of "
        f"{_plural(counts['scans'], 'scan')} in {_plural(counts['voxels'], 'voxel')} of "
        f"{100 * settings['voxel_m']:g} cm.  Noise {1000 * model['noise']['sigma_n_m']:.1f} mm, "
        f"θ {settings['theta_deg']:g}°, detail level {settings['detail_level']:g}.",
        size=11.5,
        color=PALE,
    )
    figure.text(
        0.02, 0.015, f"derived digest {model['digest']['derived'][:16]}", size=8.5, color=PALE
    )
    _draw_legend(figure, classes.keys() - {PlaneClass.CEILING})


def _draw_legend(figure: Figure, shown: Set[PlaneClass]) -> None:
    """What the colours and lines of both drawings mean; of the classes, those that are there."""
    tint = {kind: _hex(colour) for kind, colour in HOLE_COLOURS.items()}
    kinds = [kind for kind in PlaneClass if kind in shown]
    door = {"color": tint[HoleKind.OPENING], **DOOR_LINE}
    handles: list[Artist] = [
        *(Patch(fc=_hex(CLASS_COLOURS[kind]), ec=INK, label=kind.value) for kind in kinds),
        Line2D([], [], color=PALE, lw=0.6, label="cut away to look inside"),
        Patch(facecolor=INK, label="wall in the cut"),
        Line2D([], [], **OFF_CUT_LINE, label="wall above or below it"),
        Patch(facecolor=OPENING_TINT, edgecolor=tint[HoleKind.OPENING], label="opening"),
        Line2D([], [], **door, label="opening down to the floor"),
        Patch(fc="white", ec=tint[HoleKind.UNOBSERVED], hatch="////", label="unobserved"),
    ]
    figure.legend(
        handles=handles, loc="lower center", ncols=len(handles), frameon=False, fontsize=10
    )


def _plural(count: int, noun: str) -> str:
    return f"{count:,} {noun}" + ("" if count == 1 or noun == "other" else "s")


def _outline(rings: list[NDArray[np.float64]]) -> Outline:
    closed = [Outline(np.vstack([ring, ring[:1]]), closed=True) for ring in rings]
    return Outline.make_compound_path(*closed)


def _hex(colour: Rgb) -> str:
    return "#{:02x}{:02x}{:02x}".format(*colour)
