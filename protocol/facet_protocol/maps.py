"""Planes, updates, events and tile points as facet.v1: lossless, and one value has one encoding."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from enum import StrEnum
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from facet_protocol.messages import (
    Event,
    EventKind,
    Events,
    Hole,
    HoleKind,
    MapUpdate,
    Plane,
    PlaneClass,
    PlaneFrame,
    ProtocolError,
    Surface,
    TilePoints,
    Tombstone,
)
from facet_protocol.proto import map_pb2 as pb
from facet_protocol.wire import finite, parse

K = TypeVar("K", bound=StrEnum)

# Numbers on the wire: the place in the enumeration, from 1. 0 is "unspecified" and refused.
_CLASSES = tuple(PlaneClass)
_HOLE_KINDS = tuple(HoleKind)
_EVENT_KINDS = tuple(EventKind)


def _number(kinds: Sequence[K], value: K) -> int:
    return kinds.index(value) + 1


def _kind(kinds: Sequence[K], number: int) -> K:
    if not 1 <= number <= len(kinds):
        raise ProtocolError(f"{type(kinds[0]).__name__} {number} is unknown")
    return kinds[number - 1]


def _ring_list(ring: NDArray[np.int32]) -> list[int]:
    return list(np.asarray(ring).ravel().tolist())


def _ring_of(values: Sequence[int]) -> NDArray[np.int32]:
    if len(values) % 2:
        raise ProtocolError(f"ring of {len(values)} numbers, expected pairs")
    return np.array(list(values), dtype=np.int32).reshape(-1, 2)


def _ascending(ids: Iterable[int], name: str) -> None:
    last = 0
    for value in ids:
        if value <= last:
            raise ProtocolError(f"{name} {value} after {last}: ids are ascending, from 1")
        last = value


def _surface_message(surface: Surface) -> pb.Surface:
    holes = [
        pb.Hole(kind=_number(_HOLE_KINDS, h.kind), ring=_ring_list(h.ring))  # type: ignore[arg-type]
        for h in surface.holes
    ]
    return pb.Surface(
        id=surface.id, area_m2=surface.area_m2, outer=_ring_list(surface.outer), holes=holes
    )


def _surface_of(message: pb.Surface) -> Surface:
    holes = tuple(Hole(_kind(_HOLE_KINDS, h.kind), _ring_of(h.ring)) for h in message.holes)
    return Surface(message.id, message.area_m2, _ring_of(message.outer), holes)


def _frame_message(frame: PlaneFrame) -> pb.PlaneFrame:
    return pb.PlaneFrame(
        axis_u=frame.axis_u, axis_v=frame.axis_v, axis_n=frame.axis_n, step_m=frame.step_m
    )


def _frame_of(message: pb.PlaneFrame) -> PlaneFrame:
    if not 0.0 < message.step_m < math.inf:
        raise ProtocolError(f"plane frame of step {message.step_m} m")
    return PlaneFrame(
        axis_u=finite(message.axis_u, 3, "axis_u"),
        axis_v=finite(message.axis_v, 3, "axis_v"),
        axis_n=finite(message.axis_n, 3, "axis_n"),
        step_m=message.step_m,
    )


def _plane_message(plane: Plane) -> pb.Plane:
    return pb.Plane(
        id=plane.id,
        revision=plane.revision,
        plane_class=_number(_CLASSES, plane.plane_class),  # type: ignore[arg-type]
        normal=plane.normal,
        d=plane.d,
        facing=plane.facing,
        sigma_n_m=plane.sigma_n_m,
        thickness_angle_deg=plane.thickness_angle_deg,
        covariance=np.asarray(plane.covariance).ravel(),
        num_points=plane.num_points,
        num_voxels=plane.num_voxels,
        centroid=plane.centroid,
        rms_m=plane.rms_m,
        frame=_frame_message(plane.frame),
        surfaces=[_surface_message(s) for s in plane.surfaces],
        first_seen_ns=plane.first_seen_ns,
        last_seen_ns=plane.last_seen_ns,
        robots=plane.robots,
    )


def _plane_of(message: pb.Plane) -> Plane:
    if message.facing not in (1, -1):
        raise ProtocolError(f"plane {message.id} facing {message.facing}, expected 1 or -1")
    if not math.isfinite(message.d):
        raise ProtocolError(f"plane {message.id} at d = {message.d}")
    if len(message.covariance) != 16:
        raise ProtocolError(f"covariance of {len(message.covariance)} numbers, expected 16")
    return Plane(
        id=message.id,
        revision=message.revision,
        plane_class=_kind(_CLASSES, message.plane_class),
        normal=finite(message.normal, 3, "normal"),
        d=message.d,
        facing=message.facing,
        sigma_n_m=message.sigma_n_m,
        thickness_angle_deg=message.thickness_angle_deg,
        covariance=np.array(list(message.covariance), dtype=np.float64).reshape(4, 4),
        num_points=message.num_points,
        num_voxels=message.num_voxels,
        centroid=finite(message.centroid, 3, "centroid"),
        rms_m=message.rms_m,
        frame=_frame_of(message.frame),
        surfaces=tuple(_surface_of(s) for s in message.surfaces),
        first_seen_ns=message.first_seen_ns,
        last_seen_ns=message.last_seen_ns,
        robots=tuple(message.robots),
    )


def encode_plane(plane: Plane) -> bytes:
    return _plane_message(plane).SerializeToString(deterministic=True)


def decode_plane(payload: bytes | memoryview) -> Plane:
    message = parse(pb.Plane, payload)
    _ascending([message.id], "plane")
    return _plane_of(message)


def _event_message(event: Event) -> pb.Event:
    return pb.Event(
        number=event.number,
        kind=_number(_EVENT_KINDS, event.kind),  # type: ignore[arg-type]
        plane_id=event.plane_id,
        other_id=event.other_id,
        revision=event.revision,
        stamp_ns=event.stamp_ns,
    )


def _event_of(message: pb.Event) -> Event:
    return Event(
        number=message.number,
        kind=_kind(_EVENT_KINDS, message.kind),
        plane_id=message.plane_id,
        other_id=message.other_id,
        revision=message.revision,
        stamp_ns=message.stamp_ns,
    )


def encode_events(events: Events) -> bytes:
    message = pb.Events(map_id=events.map_id, events=[_event_message(e) for e in events.events])
    return message.SerializeToString(deterministic=True)


def decode_events(payload: bytes | memoryview) -> Events:
    message = parse(pb.Events, payload)
    _ascending((e.number for e in message.events), "event")
    return Events(message.map_id, tuple(_event_of(e) for e in message.events))


def encode_update(update: MapUpdate) -> bytes:
    return pb.MapUpdate(
        map_id=update.map_id,
        revision=update.revision,
        base_revision=update.base_revision,
        stamp_ns=update.stamp_ns,
        changed=[_plane_message(p) for p in update.changed],
        retired=[
            pb.Tombstone(plane_id=t.plane_id, subsumed_by=t.subsumed_by) for t in update.retired
        ],
        events=[_event_message(e) for e in update.events],
    ).SerializeToString(deterministic=True)


def decode_update(payload: bytes | memoryview) -> MapUpdate:
    message = parse(pb.MapUpdate, payload)
    if message.base_revision > message.revision:
        text = f"revision {message.revision} on base {message.base_revision}"
        raise ProtocolError(f"facet.v1.MapUpdate: {text}")
    _ascending((p.id for p in message.changed), "plane")
    _ascending((t.plane_id for t in message.retired), "retired plane")
    _ascending((e.number for e in message.events), "event")
    return MapUpdate(
        map_id=message.map_id,
        revision=message.revision,
        base_revision=message.base_revision,
        stamp_ns=message.stamp_ns,
        changed=tuple(_plane_of(p) for p in message.changed),
        retired=tuple(Tombstone(t.plane_id, t.subsumed_by) for t in message.retired),
        events=tuple(_event_of(e) for e in message.events),
    )


def encode_tile(points: TilePoints) -> bytes:
    return pb.TilePoints(
        tile=points.tile,
        voxel_m=points.voxel_m,
        centroids=np.asarray(points.centroids, dtype="<u2").tobytes(),
        plane_ids=np.asarray(points.plane_ids, dtype="<i4").tobytes(),
    ).SerializeToString(deterministic=True)


def decode_tile(payload: bytes | memoryview) -> TilePoints:
    message = parse(pb.TilePoints, payload)
    if len(message.tile) != 3 or not 0.0 < message.voxel_m < math.inf:
        raise ProtocolError(f"tile {list(message.tile)} of voxel {message.voxel_m} m")
    centroids, plane_ids = message.centroids, message.plane_ids
    if len(centroids) % 6 or len(centroids) * 4 != len(plane_ids) * 6:
        text = f"{len(centroids)} bytes of centroids and {len(plane_ids)} of plane ids"
        raise ProtocolError(f"facet.v1.TilePoints: {text}")
    i, j, k = message.tile
    return TilePoints(
        tile=(i, j, k),
        voxel_m=message.voxel_m,
        centroids=np.frombuffer(centroids, dtype="<u2").reshape(-1, 3),
        plane_ids=np.frombuffer(plane_ids, dtype="<i4"),
    )
