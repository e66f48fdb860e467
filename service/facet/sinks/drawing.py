"""The map's values as what Rerun draws. Pure: every array is fresh, for Rerun keeps references."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

import numpy as np
import rerun as rr
import rerun.blueprint as rrb
from numpy.typing import NDArray

from facet.export.colours import CLASS_COLOURS, HOLE_COLOURS, plane_colour, point_colours
from facet.export.triangles import inward_normal, surface_triangles
from facet_protocol.messages import (
    Event,
    EventKind,
    Plane,
    Pose,
    TilePoints,
)

TIMELINE = "stamp"
MESH_ALPHA = 170
POINT_RADIUS = rr.Radius.ui_points(0.9)
PATH_COLOUR = (255, 214, 64)
ROBOT_COLOUR = (255, 120, 40)
Bounds = NDArray[np.float64]  # (2, 3) m, world: lowest and highest corner


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
        albedo_factor=(*plane_colour(plane.id), MESH_ALPHA),
    )


def outline(plane: Plane) -> rr.LineStrips3D:
    """Outer rings in the plane's colour, openings and unobserved holes each in their own."""
    strips, colours = [], []
    for surface in plane.surfaces:
        rings = [(surface.outer, plane_colour(plane.id))]
        rings += [(hole.ring, HOLE_COLOURS[hole.kind]) for hole in surface.holes]
        for ring, colour in rings:
            p = plane.lift(ring)
            if len(p) and np.isfinite(p).all():
                strips.append(np.vstack([p, p[:1]]).astype(np.float32))
                colours.append(colour)
    colour_rows = np.array(colours, dtype=np.uint8).reshape(-1, 3)
    return rr.LineStrips3D(strips, colors=colour_rows, radii=rr.Radius.ui_points(1.6))


def points(xyz: NDArray[np.float32], plane_ids: NDArray[np.int32]) -> rr.Points3D:
    """(V, 3) m coloured by plane."""
    rgb = point_colours(plane_ids).astype(np.uint32)
    packed = (rgb[:, 0] << 24) | (rgb[:, 1] << 16) | (rgb[:, 2] << 8) | np.uint32(255)
    return rr.Points3D(xyz, colors=packed, radii=POINT_RADIUS)


def split_tile(
    tile: TilePoints, ceilings: Iterable[int]
) -> tuple[tuple[NDArray[np.float32], NDArray[np.int32]], ...]:
    """(points, plane ids) of everything below the ceilings, and of the ceilings."""
    xyz = tile.xyz()
    on_ceiling = np.isin(tile.plane_ids, list(ceilings))
    return tuple((xyz[rows], tile.plane_ids[rows]) for rows in (~on_ceiling, on_ceiling))


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


def event_text(event: Event, plane: Plane | None) -> str:
    """One line: `wall 12 created, 11.9 m²`."""
    name = f"{plane.plane_class.value if plane else 'plane'} {event.plane_id}"
    area = f", {sum(s.area_m2 for s in plane.surfaces):.1f} m²" if plane else ""
    match event.kind:
        case EventKind.MERGED:
            return f"{name} merged into {event.other_id}"
        case EventKind.SPLIT:
            return f"{name} split from {event.other_id}{area}"
        case EventKind.CREATED:
            return f"{name} created{area}"
        case _:
            return f"{name} {event.kind.value}"


def bounds_of(planes: Iterable[Plane]) -> Bounds | None:
    """Of everything drawn; None for nothing."""
    corners = [p.lift(s.outer) for p in planes for s in p.surfaces if len(s.outer)]
    finite = [c[np.isfinite(c).all(axis=1)] for c in corners]
    whole = np.concatenate([np.zeros((0, 3)), *finite])
    return np.stack([whole.min(axis=0), whole.max(axis=0)]) if len(whole) else None


def blueprint(bounds: Bounds | None) -> rrb.Blueprint:
    """How the dashboard opens: the model without its ceilings, curves and events beside it."""
    model = rrb.Spatial3DView(
        name="Model",
        origin="/",
        contents=["+ /map/**", "+ /robots/**", "- /map/planes/ceiling/**", "- /map/ceiling/**"],
        eye_controls=_eye(bounds),
        background=rrb.Background(color=(24, 27, 33)),
        line_grid=rrb.LineGrid3D(visible=False),
    )
    whole = rrb.Spatial3DView(
        name="With ceilings", origin="/", contents=["+ /map/**", "+ /robots/**"]
    )
    curves: list[rrb.View | rrb.Container] = [
        rrb.TimeSeriesView(name="Stage times, ms", origin="/stages"),
        rrb.TimeSeriesView(name="Surfaces by class, m²", origin="/area"),
        rrb.Tabs(
            rrb.TextLogView(name="Events", origin="/events", columns=_event_columns()),
            rrb.TimeSeriesView(name="Service", origin="/gauges"),
            active_tab=0,
        ),
    ]
    return rrb.Blueprint(
        rrb.Horizontal(
            rrb.Tabs(model, whole, active_tab=0), rrb.Vertical(*curves), column_shares=[5, 2]
        ),
        rrb.BlueprintPanel(state="collapsed"),
        rrb.SelectionPanel(state="collapsed"),
        rrb.TimePanel(state="collapsed", timeline=TIMELINE, play_state="following"),
    )


def _event_columns() -> rrb.TextLogColumns:
    """When, and what; of the columns that a log view knows."""
    kinds = rrb.encodings.TextLogColumnKind
    hidden = [rrb.encodings.TextLogColumn(kind, visible=kind == kinds.Body) for kind in kinds]
    return rrb.TextLogColumns(text_log_columns=hidden)


def _eye(bounds: Bounds | None) -> rrb.EyeControls3D | None:
    """From the south-west and above, far enough away to see everything."""
    if bounds is None:
        return None
    size = bounds[1] - bounds[0]
    middle = bounds.mean(axis=0) - np.array([0.0, 0.0, 0.4 * size[2]])
    direction = np.array([-0.30, -0.72, 0.95])
    distance = 0.85 * float(np.hypot(size[0], size[1])) + max(float(size[2]), 2.5)
    return rrb.EyeControls3D(
        kind=rrb.Eye3DKind.Orbital,
        position=middle + direction * distance / np.linalg.norm(direction),
        look_target=middle,
        eye_up=(0.0, 0.0, 1.0),
    )
