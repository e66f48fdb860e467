"""Status, cuts, resolved poses, corrections, conflicts and losses as facet.v1."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import Field, fields
from typing import Any, ClassVar, Protocol, TypeVar

from facet_protocol.messages import (
    Conflict,
    Corrected,
    CorrectedPose,
    Correction,
    Cut,
    Erase,
    Loss,
    Pose,
    ProtocolError,
    ResolvedPose,
    Status,
)
from facet_protocol.proto import service_pb2 as pb
from facet_protocol.wire import check_pose, parse


class _Record(Protocol):
    """Any dataclass."""

    __dataclass_fields__: ClassVar[dict[str, Field[Any]]]


R = TypeVar("R", bound=_Record)
HEALTH = ("OK", "DEGRADED", "FAIL")


def _pose_message(pose: Pose) -> pb.Pose:
    return pb.Pose(position=pose.position, orientation_xyzw=pose.orientation_xyzw)


def _pose_of(message: pb.Pose) -> Pose:
    return check_pose(message.position, message.orientation_xyzw)[0]


def encode_status(status: Status) -> bytes:
    return pb.Status(
        map_id=status.map_id,
        revision=status.revision,
        stamp_ns=status.stamp_ns,
        health=status.health,
        counters=status.counters,
        gauges=status.gauges,
        stage_ms=status.stage_ms,
    ).SerializeToString(deterministic=True)


def decode_status(payload: bytes | memoryview) -> Status:
    message = parse(pb.Status, payload)
    if message.health not in HEALTH:
        raise ProtocolError(f"health {message.health[:40]!r} is not one of {', '.join(HEALTH)}")
    return Status(
        map_id=message.map_id,
        revision=message.revision,
        stamp_ns=message.stamp_ns,
        health=message.health,
        counters=dict(sorted(message.counters.items())),
        gauges=dict(sorted(message.gauges.items())),
        stage_ms=dict(sorted(message.stage_ms.items())),
    )


def encode_resolved(resolved: ResolvedPose) -> bytes:
    return pb.ResolvedPose(
        robot=resolved.robot,
        sensor=resolved.sensor,
        epoch=resolved.epoch,
        sequence=resolved.sequence,
        stamp_ns=resolved.stamp_ns,
        frame_id=resolved.frame_id,
        pose=_pose_message(resolved.pose),
    ).SerializeToString(deterministic=True)


def decode_resolved(payload: bytes | memoryview) -> ResolvedPose:
    m = parse(pb.ResolvedPose, payload)
    pose = _pose_of(m.pose)
    return ResolvedPose(m.robot, m.sensor, m.epoch, m.sequence, m.stamp_ns, m.frame_id, pose)


def encode_correction(correction: Correction) -> bytes:
    poses = [
        pb.CorrectedPose(
            sensor=p.sensor, epoch=p.epoch, sequence=p.sequence, pose=_pose_message(p.pose)
        )
        for p in correction.poses
    ]
    return pb.Correction(robot=correction.robot, poses=poses).SerializeToString(deterministic=True)


def decode_correction(payload: bytes | memoryview) -> Correction:
    m = parse(pb.Correction, payload)
    poses = (CorrectedPose(p.sensor, p.epoch, p.sequence, _pose_of(p.pose)) for p in m.poses)
    return Correction(m.robot, tuple(poses))


def _plain(
    record: type[R], message: type[Any]
) -> tuple[Callable[[R], bytes], Callable[[bytes | memoryview], R]]:
    """Encoder and decoder of a record whose fields are those of its message, by name."""
    names = [field.name for field in fields(record)]

    def encode(one: R) -> bytes:
        values = {name: getattr(one, name) for name in names}
        return bytes(message(**values).SerializeToString(deterministic=True))

    def decode(payload: bytes | memoryview) -> R:
        m = parse(message, payload)
        return record(**{name: getattr(m, name) for name in names})

    return encode, decode


encode_cut, decode_cut = _plain(Cut, pb.Cut)
encode_corrected, decode_corrected = _plain(Corrected, pb.Corrected)
encode_conflict, decode_conflict = _plain(Conflict, pb.Conflict)
encode_erase, decode_erase = _plain(Erase, pb.Erase)
encode_loss, decode_loss = _plain(Loss, pb.Loss)
