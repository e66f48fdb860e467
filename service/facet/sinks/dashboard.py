"""Draws the map into one Rerun stream: into a file while replaying, or into a live viewer.

`rr.log` can block for good (a viewer that stalls), so a live dashboard has its own process.
What changes often waits here, the latest of each kind only, and is drawn a few times a second.
"""

from __future__ import annotations

from collections import deque
from pathlib import Path

import numpy as np
import rerun as rr
from numpy.typing import NDArray

from facet.export.viewpoint import corners, is_overhead
from facet.sinks import drawing, layout
from facet_protocol.codec import Message
from facet_protocol.messages import (
    Envelope,
    EventKind,
    MapUpdate,
    Plane,
    PlaneClass,
    Pose,
    Scan,
    StampedPose,
    Status,
    TilePoints,
)
from facet_protocol.topics import pose_topic

POSE_TOPICS = pose_topic("_").removesuffix("_")
NS = 1_000_000_000  # of stamps
PLANES_EVERY_S, POINTS_EVERY_S = 0.25, 1.0  # live
FILE_PLANES_EVERY_S, FILE_POINTS_EVERY_S = 0.5, 3.0  # a file keeps all of it
MARGIN = 0.05  # of the fitted model's size: what grows farther leaves the view
PATH_STEP_M = 0.05  # a robot that stands still grows no path
PATH_PIECE = 64  # positions an entity: the piece under way is drawn again, the others are done


class RobotPath:
    """The last piece of where one robot went."""

    def __init__(self) -> None:
        self.piece = 0
        self.positions: deque[NDArray[np.float64]] = deque(maxlen=PATH_PIECE)

    def add(self, position: NDArray[np.float64]) -> bool:
        """Whether there is something new to draw."""
        if self.positions and np.linalg.norm(position - self.positions[-1]) < PATH_STEP_M:
            return False
        if len(self.positions) == PATH_PIECE:
            self.positions = deque([self.positions[-1]], maxlen=PATH_PIECE)
            self.piece += 1
        self.positions.append(position.copy())
        return len(self.positions) > 1


class Dashboard:
    """Everything that is drawn of one map. One thread; memory follows the map, not the time."""

    def __init__(
        self,
        stream: rr.RecordingStream,
        planes_every_s: float = PLANES_EVERY_S,
        points_every_s: float = POINTS_EVERY_S,
    ) -> None:
        self._stream = stream
        self._planes_every_ns = int(planes_every_s * NS)
        self._points_every_ns = int(points_every_s * NS)
        self._stamp_ns = 0
        self._planes: dict[int, Plane] = {}
        self._drawn: dict[int, Plane] = {}  # as last drawn
        self._waiting_planes: set[int] = set()
        self._waiting_tiles: dict[tuple[int, int, int], TilePoints] = {}
        self._planes_due_ns = self._points_due_ns = 0
        self._robots: dict[str, RobotPath] = {}
        self._series: set[str] = set()
        self._health = "OK"
        self._fitted: NDArray[np.float64] | None = None  # (2, 3) m: the box that the view shows
        stream.log("/", rr.ViewCoordinates.RIGHT_HAND_Z_UP, static=True)
        stream.send_blueprint(layout.blueprint(()))

    def draw(self, message: Message | None, topic: str = "") -> None:
        """One message of the pipeline, whatever it is; what cannot be drawn is passed over."""
        match message:
            case StampedPose() if topic.startswith(POSE_TOPICS):
                robot = topic.removeprefix(POSE_TOPICS)
                self.write_scan_pose(robot, message.pose, message.stamp_ns)
            case Scan():
                self.write_scan_pose(message.robot, message.pose, message.stamp_ns)
            case MapUpdate():
                self.write_update(message)
            case TilePoints():
                self.write_points([message])
            case Status():
                self.write_status(message)
            case _:
                pass

    def write_update(self, update: MapUpdate) -> None:
        """A delta, or a snapshot (base 0), which replaces everything."""
        retired = {t.plane_id for t in update.retired}
        if update.base_revision == 0:
            retired = self._planes.keys() - {plane.id for plane in update.changed}
        gone = {number: self._planes.pop(number, None) for number in retired}
        self._planes.update((plane.id, plane) for plane in update.changed)
        self._waiting_planes |= retired | {plane.id for plane in update.changed}
        self._advance(update.stamp_ns)
        self._log_events(update, gone)

    def write_points(self, tiles: list[TilePoints]) -> None:
        self._waiting_tiles.update((tile.tile, tile) for tile in tiles)
        self._advance(self._stamp_ns)

    def write_scan_pose(self, robot: str, pose: Pose, stamp_ns: int) -> None:
        """Where a robot's sensor was when it scanned."""
        if not (np.isfinite(pose.position).all() and np.isfinite(pose.orientation_xyzw).all()):
            return
        self._advance(stamp_ns)
        entity = f"robots/{robot}"
        if robot not in self._robots:
            self._robots[robot] = RobotPath()
            self._stream.log(f"{entity}/marker/dot", drawing.robot_dot(robot), static=True)
            self._stream.log(f"{entity}/marker/arrow", drawing.robot_arrow(), static=True)
        self._stream.log(f"{entity}/marker", drawing.robot_transform(pose))
        path = self._robots[robot]
        if path.add(pose.position):
            self._stream.log(f"{entity}/path/{path.piece}", drawing.path(path.positions))

    def write_status(self, status: Status) -> None:
        self._advance(status.stamp_ns)
        for name, value in status.stage_ms.items():
            self._log_number(f"stages/{name}", value)
        for name, value in status.gauges.items():
            self._log_number(f"gauges/{name}", value)
        if status.health != self._health:
            level = rr.TextLogLevel.INFO if status.health == "OK" else rr.TextLogLevel.WARN
            line = drawing.line(f"health {status.health}", status.stamp_ns, level)
            self._stream.log("events/health", line)
            self._health = status.health

    def flush(self) -> None:
        """Draw what waits, whatever the time."""
        self._draw_planes()
        self._draw_tiles()

    def _advance(self, stamp_ns: int) -> None:
        """Time only goes on: robots and updates arrive out of step."""
        self._stamp_ns = max(self._stamp_ns, stamp_ns)
        self._stream.set_time(layout.TIMELINE, timestamp=np.datetime64(self._stamp_ns, "ns"))
        if self._stamp_ns >= self._planes_due_ns and self._waiting_planes:
            self._planes_due_ns = self._stamp_ns + self._planes_every_ns
            self._draw_planes()
        if self._stamp_ns >= self._points_due_ns and self._waiting_tiles:
            self._points_due_ns = self._stamp_ns + self._points_every_ns
            self._draw_tiles()

    def _draw_planes(self) -> None:
        if not self._waiting_planes:
            return
        for number in sorted(self._waiting_planes):
            self._draw_plane(number, self._planes.get(number))
        self._waiting_planes.clear()
        for kind in PlaneClass:
            planes = [p for p in self._planes.values() if p.plane_class is kind]
            area = sum(s.area_m2 for plane in planes for s in plane.surfaces)
            self._log_number(f"area/{kind.value}", area)
        self._fit_view()

    def _draw_plane(self, number: int, plane: Plane | None) -> None:
        before = self._drawn.pop(number, None)
        if before and (plane is None or _entity(before) != _entity(plane)):
            self._stream.log(_entity(before), rr.Clear(recursive=True))
            before = None
        if plane is None:
            return
        if before and drawing.looks_the_same(before, plane):
            self._drawn[number] = before
            return
        self._drawn[number] = plane
        entity = _entity(plane)
        mesh = drawing.mesh(plane)
        self._stream.log(f"{entity}/surface", mesh or rr.Clear(recursive=False))
        self._stream.log(f"{entity}/outline", drawing.outline(plane))
        self._stream.log(f"{entity}/name", drawing.label(plane) or rr.Clear(recursive=False))

    def _draw_tiles(self) -> None:
        classes = {i: plane.plane_class for i, plane in self._planes.items()}
        overhead = [i for i, plane in self._planes.items() if is_overhead(plane)]
        for key, tile in sorted(self._waiting_tiles.items()):
            name = "_".join(str(k) for k in key)
            below, above = drawing.split_tile(tile, overhead)
            for kind, rows in (("below", below), (layout.OVERHEAD, above)):
                self._stream.log(f"map/points/{kind}/{name}", drawing.points(*rows, classes))
        self._waiting_tiles.clear()

    def _fit_view(self) -> None:
        """Step back when the map has outgrown the view; otherwise leave the eye to the user."""
        p = corners(plane for plane in self._planes.values() if not is_overhead(plane))
        if len(p) == 0:
            return
        box = np.stack([p.min(axis=0), p.max(axis=0)])
        if self._fitted is None or _leaves(box, self._fitted):
            self._fitted = box
            self._stream.send_blueprint(layout.blueprint([*self._planes.values()]))

    def fit_view_finally(self) -> None:
        """The view for someone who opens the finished file."""
        has_service = any(name.startswith("stages/") for name in self._series)
        self._stream.send_blueprint(layout.blueprint([*self._planes.values()], has_service))

    def _log_number(self, entity: str, value: float) -> None:
        if not np.isfinite(value):
            return
        if entity not in self._series:
            self._series.add(entity)
            curve = drawing.curve(entity.partition("/")[2])
            self._stream.log(entity, curve, static=True)
        self._stream.log(entity, rr.Scalars(float(value)))

    def _log_events(self, update: MapUpdate, gone: dict[int, Plane | None]) -> None:
        """A line each, but one for all that were only updated: that is most of them."""
        num_updated = 0
        for event in update.events:
            if event.kind is EventKind.UPDATED:
                num_updated += 1
                continue
            plane, other = (
                self._planes.get(i) or gone.get(i) for i in (event.plane_id, event.other_id)
            )
            text = drawing.event_text(event, plane, other)
            colours = (drawing.colour_of(plane),) if plane else ()
            line = drawing.line(text, event.stamp_ns, rr.TextLogLevel.INFO, *colours)
            self._stream.log("events", line)
        if num_updated:
            text = f"{num_updated} planes updated, revision {update.revision}"
            line = drawing.line(text, update.stamp_ns, rr.TextLogLevel.DEBUG)
            self._stream.log("events", line)


def _leaves(box: NDArray[np.float64], fitted: NDArray[np.float64]) -> bool:
    """Whether a box (2, 3) sticks out of another by more than the view has room for."""
    room = MARGIN * float(np.linalg.norm(fitted[1] - fitted[0]))
    return bool((box[0] < fitted[0] - room).any() or (box[1] > fitted[1] + room).any())


def _entity(plane: Plane) -> str:
    above = f"{layout.OVERHEAD}/" if is_overhead(plane) else ""
    return f"map/planes/{above}{plane.plane_class.value}/{plane.id}"


class RrdViewer:
    """A sink that draws into an .rrd file; never blocks."""

    def __init__(self, path: Path, name: str = "facet") -> None:
        self._stream = rr.RecordingStream("facet", recording_id=name)
        self._stream.set_log_time_enabled(False)
        self._stream.set_log_tick_enabled(False)
        self._stream.save(path)
        self._dashboard = Dashboard(self._stream, FILE_PLANES_EVERY_S, FILE_POINTS_EVERY_S)
        self._is_open = True
        self.write_update = self._dashboard.write_update
        self.write_points = self._dashboard.write_points
        self.write_scan_pose = self._dashboard.write_scan_pose
        self.write_status = self._dashboard.write_status

    def write(self, envelope: Envelope, message: Message | None) -> None:
        self._dashboard.draw(message, envelope.key)

    def close(self) -> None:
        """Draw what waits and finish the file; a second call does nothing."""
        if self._is_open:
            self._is_open = False
            self._dashboard.flush()
            self._dashboard.fit_view_finally()
            self._stream.flush()
            self._stream.disconnect()
