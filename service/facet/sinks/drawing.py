"""The map's values as what Rerun draws. Pure: every array is fresh, for Rerun keeps references."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence

import numpy as np
import rerun as rr
from numpy.typing import NDArray

from facet.export.colours import (
    CLASS_COLOURS,
    HOLE_COLOURS,
    UNASSIGNED,
    plane_colour,
    point_colours,
)
from facet.export.triangles import inward_normal, middle_of, surface_triangles
from facet_protocol.messages import (
    Event,
    EventKind,
    Plane,
    PlaneClass,
    Pose,
    TilePoints,
)

MESH_ALPHA = 170
SAME_M, SAME_NORMAL = 1e-3, 1e-4
POINT_RADIUS = rr.Radius.ui_points(0.9)
LABEL_AREA_M2 = 2.0  # what is smaller has its name where the pointer is: names hide what is behind
PATH_COLOUR = (255, 214, 64)
ROBOT_COLOUR = (255, 120, 40)


def mesh(plane: Plane) -> rr.Mesh3D | None:
    """All surfaces of a plane as one translucent mesh; None where nothing is finite or has area."""
    vertices, faces, first = [], [], 0
    for surface in plane.surfaces:
        xyz, corners = surface_triangles(plane, surface)
        if len(corners) and np.isfinite(xyz).all():
            vertices.append(xyz)
            faces.append(corners + np.uint32(first))
            first += len(xyz)
    if not faces:
        return None
    positions = np.concatenate(vertices).astype(np.float32)
    normals = np.broadcast_to(inward_normal(plane), positions.shape).astype(np.float32)
    return rr.Mesh3D(
        vertex_positions=positions,
        triangle_indices=np.concatenate(faces),
        vertex_normals=normals,
        albedo_factor=(*colour_of(plane), MESH_ALPHA),
    )


def name_of(plane: Plane) -> str:
    """What it is called on the screen and among the events: `wall 12`."""
    return f"{plane.plane_class.value} {plane.id}"


def colour_of(plane: Plane) -> tuple[int, int, int]:
    return plane_colour(plane.id, plane.plane_class)


def label(plane: Plane) -> rr.Points3D | None:
    """Its name, in the middle of its largest surface; None where it has no area."""
    surface = max(plane.surfaces, key=lambda s: s.area_m2, default=None)
    middle = middle_of(plane, surface) if surface is not None else np.full(3, np.nan)
    if not np.isfinite(middle).all():
        return None
    return rr.Points3D(
        [middle],
        labels=[name_of(plane)],
        show_labels=sum(s.area_m2 for s in plane.surfaces) >= LABEL_AREA_M2,
        colors=colour_of(plane),
        radii=rr.Radius.ui_points(0.0),
    )


def outline(plane: Plane) -> rr.LineStrips3D:
    """Outer rings in the plane's colour, openings and unobserved holes each in their own."""
    strips, colours = [], []
    for surface in plane.surfaces:
        rings = [(surface.outer, colour_of(plane))]
        rings += [(hole.ring, HOLE_COLOURS[hole.kind]) for hole in surface.holes]
        for ring, colour in rings:
            p = plane.lift(ring)
            if len(p) and np.isfinite(p).all():
                strips.append(np.vstack([p, p[:1]]).astype(np.float32))
                colours.append(colour)
    colour_rows = np.array(colours, dtype=np.uint8).reshape(-1, 3)
    return rr.LineStrips3D(strips, colors=colour_rows, radii=rr.Radius.ui_points(1.6))


def points(
    xyz: NDArray[np.float32], plane_ids: NDArray[np.int32], classes: Mapping[int, PlaneClass]
) -> rr.Points3D:
    """(V, 3) m coloured by plane."""
    rgb = point_colours(plane_ids, classes).astype(np.uint32)
    packed = (rgb[:, 0] << 24) | (rgb[:, 1] << 16) | (rgb[:, 2] << 8) | np.uint32(255)
    return rr.Points3D(xyz, colors=packed, radii=POINT_RADIUS)


def split_tile(
    tile: TilePoints, overhead: Iterable[int]
) -> tuple[tuple[NDArray[np.float32], NDArray[np.int32]], ...]:
    """(points, plane ids) of everything below, and of the planes `overhead`."""
    xyz = tile.xyz()
    above = np.isin(tile.plane_ids, list(overhead))
    return tuple((xyz[rows], tile.plane_ids[rows]) for rows in (~above, above))


def robot_transform(pose: Pose) -> rr.Transform3D:
    return rr.Transform3D(
        translation=pose.position.copy(), quaternion=rr.Quaternion(xyzw=pose.orientation_xyzw)
    )


def robot_dot(robot: str) -> rr.Points3D:
    return rr.Points3D([[0.0, 0.0, 0.0]], radii=0.12, colors=ROBOT_COLOUR, labels=[robot])


def robot_arrow() -> rr.Arrows3D:
    """Where it looks: x is forward."""
    return rr.Arrows3D(vectors=[[0.6, 0.0, 0.0]], colors=ROBOT_COLOUR, radii=0.03)


def path(positions: Sequence[NDArray[np.float64]]) -> rr.LineStrips3D:
    strip = np.array(positions, dtype=np.float32)
    return rr.LineStrips3D([strip], colors=PATH_COLOUR, radii=rr.Radius.ui_points(1.5))


def curve(name: str) -> rr.SeriesLines:
    """The look of one curve: classes have their own colours, the rest take what comes."""
    kinds = {kind.value: colour for kind, colour in CLASS_COLOURS.items()}
    return rr.SeriesLines(names=name, widths=1.8, colors=kinds.get(name))


def line(
    text: str,
    stamp_ns: int,
    level: rr.TextLogLevel = rr.TextLogLevel.INFO,
    colour: tuple[int, int, int] = UNASSIGNED,
) -> rr.TextLog:
    """One among the events, `22:13:55 wall 12 created`, in the colour of its plane. A line without
    a colour of its own would have that of the line before."""
    time = str(np.datetime64(stamp_ns, "ns").astype("datetime64[s]")).partition("T")[2]
    return rr.TextLog(f"{time} {text}", level=level, color=colour)


def event_text(event: Event, plane: Plane | None, other: Plane | None) -> str:
    """One line: `wall 12 created, 11.9 m²`; planes by the names that they have on the screen."""
    name = name_of(plane) if plane else f"plane {event.plane_id}"
    other_name = name_of(other) if other else f"plane {event.other_id}"
    area = f", {sum(s.area_m2 for s in plane.surfaces):.1f} m²" if plane else ""
    match event.kind:
        case EventKind.MERGED:
            return f"{name} merged into {other_name}"
        case EventKind.SPLIT:
            return f"{name} split from {other_name}{area}"
        case EventKind.CREATED:
            return f"{name} created{area}"
        case _:
            return f"{name} {event.kind.value}"


def looks_the_same(a: Plane, b: Plane) -> bool:
    """Whether nobody could tell the one drawn from the other: a plane settles by microns."""
    return (
        a.plane_class is b.plane_class
        and bool(np.abs(a.normal - b.normal).max() < SAME_NORMAL)
        and abs(a.d - b.d) < SAME_M
        and _shape(a) == _shape(b)
    )


def _shape(plane: Plane) -> tuple[bytes | str, ...]:
    """Everything that the outlines are made of."""
    f = plane.frame
    rings = [(hole.kind.value, hole.ring) for s in plane.surfaces for hole in s.holes]
    rings += [("outer", surface.outer) for surface in plane.surfaces]
    axes = (f.axis_u.tobytes(), f.axis_v.tobytes(), f.axis_n.tobytes())
    return (*axes, *(part for kind, ring in rings for part in (kind, ring.tobytes())))
