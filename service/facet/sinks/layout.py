"""How the dashboard opens: which views, where, and the eye from which the model is seen."""

from __future__ import annotations

from collections.abc import Sequence

import rerun.blueprint as rrb

from facet.export.viewpoint import corners, is_overhead, view_rotation
from facet_protocol.messages import Plane

TIMELINE = "stamp"
OVERHEAD = "overhead"  # entities of this name are left out of the first view
GAUGES = {  # what is drawn together has one unit; `facet top` shows them all
    "Waiting, messages": ("in_flight", "queue_msgs", "waiting_for_pose", "waiting_for_points"),
    "Memory, MB": ("rss_mb",),
    "Voxels": ("voxels",),
}
LEGEND = rrb.Corner2D.LeftTop  # curves begin low and grow
FAR = 1.05  # of the model's width in the view: the eye's distance


def blueprint(planes: Sequence[Plane], has_service: bool = True) -> rrb.Blueprint:
    """The model without its ceilings, large; curves and events beside it.

    `has_service` False leaves out what only a running service tells: its stage times and gauges.
    """
    events = rrb.TextLogView(name="Events", origin="/events", columns=_event_columns())
    area = rrb.TimeSeriesView(name="Surfaces by class, m²", origin="/area", plot_legend=LEGEND)
    stages = rrb.TimeSeriesView(name="Stage times, ms", origin="/stages", plot_legend=LEGEND)
    if has_service:
        side = rrb.Vertical(stages, area, rrb.Tabs(events, *_gauges(), active_tab=0))
    else:
        side = rrb.Vertical(area, events)
    return rrb.Blueprint(
        rrb.Horizontal(
            rrb.Tabs(_model(planes), _whole(), active_tab=0), side, column_shares=[5, 2]
        ),
        rrb.BlueprintPanel(state="collapsed"),
        rrb.SelectionPanel(state="collapsed"),
        rrb.TimePanel(state="collapsed", timeline=TIMELINE, play_state="following"),
    )


def _model(planes: Sequence[Plane]) -> rrb.Spatial3DView:
    hidden = [f"- /map/{kind}/{OVERHEAD}/**" for kind in ("planes", "points")]
    return rrb.Spatial3DView(
        name="Model",
        origin="/",
        contents=["+ /map/**", "+ /robots/**", *hidden],
        eye_controls=_eye(planes),
        background=rrb.Background(color=(24, 27, 33)),
        line_grid=rrb.LineGrid3D(visible=False),
    )


def _gauges() -> list[rrb.TimeSeriesView]:
    return [
        rrb.TimeSeriesView(
            name=title,
            origin="/gauges",
            contents=[f"+ $origin/{name}" for name in names],
            plot_legend=LEGEND,
        )
        for title, names in GAUGES.items()
    ]


def _whole() -> rrb.Spatial3DView:
    return rrb.Spatial3DView(
        name="With ceilings", origin="/", contents=["+ /map/**", "+ /robots/**"]
    )


def _event_columns() -> rrb.TextLogColumns:
    """The text alone: it says the time, of which a column of its own would show the year."""
    kinds = rrb.encodings.TextLogColumnKind
    columns = [rrb.encodings.TextLogColumn(kind, visible=kind == kinds.Body) for kind in kinds]
    stamps = [rrb.encodings.TimelineColumn(TIMELINE, visible=False)]
    return rrb.TextLogColumns(timeline_columns=stamps, text_log_columns=columns)


def _eye(planes: Sequence[Plane]) -> rrb.EyeControls3D | None:
    """Far enough away to see everything below the ceilings."""
    R_view_world = view_rotation(planes)
    p_view = corners(p for p in planes if not is_overhead(p)) @ R_view_world.T
    if len(p_view) == 0:
        return None
    low, high = p_view.min(axis=0), p_view.max(axis=0)
    width, height, _ = high - low
    target = (low + high) / 2.0 @ R_view_world
    return rrb.EyeControls3D(
        kind=rrb.Eye3DKind.Orbital,
        position=target + FAR * max(width, 1.4 * height, 3.0) * R_view_world[2],
        look_target=target,
        eye_up=(0.0, 0.0, 1.0),
    )
