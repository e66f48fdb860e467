"""Where one frame is in another at a given stamp: transforms along a chain, interpolated between
stamps, never beyond them. No clock; + - * / and square roots alone, so the same bits everywhere."""

from __future__ import annotations

import math
from bisect import bisect_left
from collections import deque
from dataclasses import dataclass, field
from enum import Enum

import numpy as np

from facet_protocol.messages import Pose, StampedTransform
from facet_protocol.wire import normalised

Vector = tuple[float, float, float]
Quaternion = tuple[float, float, float, float]  # xyzw

MAX_SAMPLES = 4096  # kept by edge: 40 s at 100 Hz
MAX_EDGES = 512  # of one robot
_CLOSE = 1.0 - 1e-11  # cosine of half the angle: below, what is left of an arc is a straight line


class Rank(Enum):
    """Who says where a child is in its parent: the lower outranks the higher."""

    STATIC = 0
    TRANSFORM = 1
    ODOMETRY = 2


class Answer(Enum):
    """Why there is no pose at a stamp, yet or ever."""

    UNKNOWN = "no chain of transforms leads there"
    WAIT = "its transforms do not reach that far yet"
    TOO_OLD = "its transforms begin later"
    GAP = "its transforms are too far apart"


@dataclass(frozen=True, slots=True)
class Rigid:
    """T_parent_child as plain floats."""

    position: Vector
    rotation: Quaternion


def rigid_of(pose: Pose) -> Rigid:
    x, y, z = (float(c) for c in pose.position)
    qx, qy, qz, qw = (float(c) for c in pose.orientation_xyzw)
    return Rigid((x, y, z), (qx, qy, qz, qw))


def pose_of(rigid: Rigid) -> Pose:
    """With a unit quaternion; one that is a unit within rounding keeps its bits."""
    return Pose(np.array(rigid.position), np.array(normalised(rigid.rotation)))


def compose(a: Rigid, b: Rigid) -> Rigid:
    """T_x_z of T_x_y and T_y_z."""
    (px, py, pz), (rx, ry, rz) = a.position, rotate(a.rotation, b.position)
    return Rigid((px + rx, py + ry, pz + rz), multiply(a.rotation, b.rotation))


def inverse(a: Rigid) -> Rigid:
    x, y, z, w = a.rotation
    back = (-x, -y, -z, w)
    rx, ry, rz = rotate(back, a.position)
    return Rigid((-rx, -ry, -rz), back)


def multiply(a: Quaternion, b: Quaternion) -> Quaternion:
    ax, ay, az, aw = a
    bx, by, bz, bw = b
    return (
        aw * bx + ax * bw + ay * bz - az * by,
        aw * by - ax * bz + ay * bw + az * bx,
        aw * bz + ax * by - ay * bx + az * bw,
        aw * bw - ax * bx - ay * by - az * bz,
    )


def rotate(q: Quaternion, v: Vector) -> Vector:
    """v + 2 w (u x v) + 2 u x (u x v), u the vector part of the unit quaternion q."""
    x, y, z, w = q
    tx = 2.0 * (y * v[2] - z * v[1])
    ty = 2.0 * (z * v[0] - x * v[2])
    tz = 2.0 * (x * v[1] - y * v[0])
    return (
        v[0] + w * tx + (y * tz - z * ty),
        v[1] + w * ty + (z * tx - x * tz),
        v[2] + w * tz + (x * ty - y * tx),
    )


def slerp(a: Quaternion, b: Quaternion, t: float) -> Quaternion:
    """Shoemake's great-arc interpolation (1985) along the shorter arc, 0 <= t <= 1.

    Without sine or arc cosine: the middle of two unit quaternions is their normalised sum, exactly
    half way, so the arc is halved towards t until it is so short (1e-5 rad) that the normalised
    chord is the arc to within rounding.
    """
    if a == b:
        return a  # a robot that stands still keeps its bits
    if _cosine(a, b) < 0.0:
        b = (-b[0], -b[1], -b[2], -b[3])
    while t not in (0.0, 1.0) and _cosine(a, b) < _CLOSE:
        middle = _unit(a[0] + b[0], a[1] + b[1], a[2] + b[2], a[3] + b[3])
        t = 2.0 * t
        if t < 1.0:
            b = middle
        else:
            a, t = middle, t - 1.0
    if t == 0.0:
        return a
    if t == 1.0:
        return b
    s = 1.0 - t
    return _unit(*(s * p + t * q for p, q in zip(a, b, strict=True)))


def _cosine(a: Quaternion, b: Quaternion) -> float:
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2] + a[3] * b[3]


def _unit(x: float, y: float, z: float, w: float) -> Quaternion:
    norm = math.sqrt(x * x + y * y + z * z + w * w)
    return (x / norm, y / norm, z / norm, w / norm)


def interpolate(a: Rigid, b: Rigid, t: float) -> Rigid:
    """Between a (t = 0) and b (t = 1): the position on the line, the rotation on the arc."""
    (ax, ay, az), (bx, by, bz) = a.position, b.position
    position = (ax + t * (bx - ax), ay + t * (by - ay), az + t * (bz - az))
    return Rigid(position, slerp(a.rotation, b.rotation, t))


@dataclass(slots=True)
class Edge:
    """T_parent_child over time, as one publisher tells it."""

    parent: str
    child: str
    rank: Rank
    topic: str
    stamps: list[int] = field(default_factory=list)  # ascending
    samples: list[Rigid] = field(default_factory=list)
    arrivals: deque[int] = field(default_factory=deque)  # stamps, in the order in which they came

    def add(self, stamp_ns: int, rigid: Rigid) -> bool:
        """Whether it is new: of two for one stamp the first counts. The oldest arrival makes room;
        a static one is replaced."""
        if self.rank is Rank.STATIC:
            self.stamps, self.samples = [stamp_ns], [rigid]
            return True
        k = bisect_left(self.stamps, stamp_ns)
        if k < len(self.stamps) and self.stamps[k] == stamp_ns:
            return False
        self.stamps.insert(k, stamp_ns)
        self.samples.insert(k, rigid)
        self.arrivals.append(stamp_ns)
        if len(self.arrivals) > MAX_SAMPLES:
            k = bisect_left(self.stamps, self.arrivals.popleft())
            del self.stamps[k], self.samples[k]
        return True

    def at(self, stamp_ns: int, max_gap_ns: int) -> Rigid | Answer:
        if self.rank is Rank.STATIC:
            return self.samples[0]
        k = bisect_left(self.stamps, stamp_ns)
        if k == len(self.stamps):
            return Answer.WAIT
        if self.stamps[k] == stamp_ns:
            return self.samples[k]
        if k == 0:
            return Answer.TOO_OLD
        before, after = self.stamps[k - 1], self.stamps[k]
        if after - before > max_gap_ns:
            return Answer.GAP
        t = (stamp_ns - before) / (after - before)  # of integers: rounded once
        return interpolate(self.samples[k - 1], self.samples[k], t)


class Frames:
    """The frames of one robot: which is where in which, as far as it was told."""

    def __init__(self, max_gap_ns: int) -> None:
        """Stamps further apart than `max_gap_ns` are not interpolated between."""
        self._max_gap_ns = max_gap_ns
        self._edges: dict[tuple[str, str], Edge] = {}  # by parent and child
        self._neighbours: dict[str, list[Edge]] = {}
        self._chains: dict[tuple[str, str], list[tuple[Edge, bool]]] = {}

    def add(self, transform: StampedTransform, rank: Rank, topic: str) -> str:
        """Take one transform; the reason why it is left out, or "".

        Of several topics that tell the same edge one counts, lest two estimates of the same motion
        be mixed: the one of the best rank, of these the first that was heard. Static transforms
        add up, whoever sends them.
        """
        name = (transform.parent_frame_id, transform.child_frame_id)
        edge = self._edges.get(name)
        if edge is None and len(self._edges) >= MAX_EDGES:
            return "too_many_frames"
        if edge is None or rank.value < edge.rank.value:
            edge = self._put(name, Edge(*name, rank, topic))
        elif edge.rank is not rank or (edge.topic != topic and rank is not Rank.STATIC):
            return "told_elsewhere"
        return "" if edge.add(transform.stamp_ns, rigid_of(transform.pose)) else "same_stamp"

    def __contains__(self, frame_id: str) -> bool:
        return frame_id in self._neighbours

    def at(self, target: str, source: str, stamp_ns: int) -> Rigid | Answer:
        """T_target_source at a stamp, by the shortest chain between them."""
        chain = self._chain(target, source)
        if chain is None:
            return Answer.UNKNOWN
        whole: Rigid | None = None
        waits: Answer | None = None
        for edge, forward in chain:
            part = edge.at(stamp_ns, self._max_gap_ns)
            if isinstance(part, Answer):
                if part is not Answer.WAIT:
                    return part
                waits = part
                continue
            step = part if forward else inverse(part)
            whole = step if whole is None else compose(whole, step)
        return waits or whole or Answer.UNKNOWN

    def _put(self, name: tuple[str, str], edge: Edge) -> Edge:
        self._edges[name] = edge
        for frame in name:
            others = [e for e in self._neighbours.get(frame, []) if (e.parent, e.child) != name]
            self._neighbours[frame] = [*others, edge]
        self._chains.clear()
        return edge

    def _chain(self, target: str, source: str) -> list[tuple[Edge, bool]] | None:
        """Edges from `target` to `source`, each with whether it is taken from parent to child."""
        if (target, source) in self._chains:
            return self._chains[target, source]
        ways: dict[str, list[tuple[Edge, bool]]] = {target: []}
        queue = deque([target])
        while queue and source not in ways:
            frame = queue.popleft()
            for edge in self._neighbours.get(frame, []):
                forward = edge.parent == frame
                other = edge.child if forward else edge.parent
                if other not in ways:
                    ways[other] = [*ways[frame], (edge, forward)]
                    queue.append(other)
        chain = ways.get(source)
        if chain:
            self._chains[target, source] = chain
        return chain or None
