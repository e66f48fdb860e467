"""Status, cuts, resolved poses, corrections, conflicts and losses as facet.v1."""

from __future__ import annotations

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


def encode_cut(cut: Cut) -> bytes:
    return pb.Cut(
        revision=cut.revision,
        robot=cut.robot,
        sensor=cut.sensor,
        epoch=cut.epoch,
        sequence=cut.sequence,
        stamp_ns=cut.stamp_ns,
        num_scans=cut.num_scans,
    ).SerializeToString(deterministic=True)


def decode_cut(payload: bytes | memoryview) -> Cut:
    m = parse(pb.Cut, payload)
    return Cut(m.revision, m.robot, m.sensor, m.epoch, m.sequence, m.stamp_ns, m.num_scans)


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


def encode_corrected(corrected: Corrected) -> bytes:
    return pb.Corrected(
        robot=corrected.robot,
        epoch=corrected.epoch,
        sequence=corrected.sequence,
        stamp_ns=corrected.stamp_ns,
        num_scans=corrected.num_scans,
        reason=corrected.reason,
    ).SerializeToString(deterministic=True)


def decode_corrected(payload: bytes | memoryview) -> Corrected:
    m = parse(pb.Corrected, payload)
    return Corrected(m.robot, m.epoch, m.sequence, m.stamp_ns, m.num_scans, m.reason)


def encode_conflict(conflict: Conflict) -> bytes:
    return pb.Conflict(
        robot=conflict.robot,
        sensor=conflict.sensor,
        epoch=conflict.epoch,
        sequence=conflict.sequence,
        stamp_ns=conflict.stamp_ns,
        kept=conflict.kept,
        left_out=conflict.left_out,
        replaced=conflict.replaced,
    ).SerializeToString(deterministic=True)


def decode_conflict(payload: bytes | memoryview) -> Conflict:
    m = parse(pb.Conflict, payload)
    numbers = (m.epoch, m.sequence, m.stamp_ns)
    return Conflict(m.robot, m.sensor, *numbers, m.kept, m.left_out, m.replaced)


def encode_erase(erase: Erase) -> bytes:
    return pb.Erase(
        robot=erase.robot,
        sensor=erase.sensor,
        epoch=erase.epoch,
        first=erase.first,
        last=erase.last,
    ).SerializeToString(deterministic=True)


def decode_erase(payload: bytes | memoryview) -> Erase:
    m = parse(pb.Erase, payload)
    return Erase(m.robot, m.sensor, m.epoch, m.first, m.last)


def encode_loss(loss: Loss) -> bytes:
    return pb.Loss(
        robot=loss.robot,
        sensor=loss.sensor,
        epoch=loss.epoch,
        first_sequence=loss.first_sequence,
        count=loss.count,
        reason=loss.reason,
        stamp_ns=loss.stamp_ns,
    ).SerializeToString(deterministic=True)


def decode_loss(payload: bytes | memoryview) -> Loss:
    m = parse(pb.Loss, payload)
    return Loss(m.robot, m.sensor, m.epoch, m.first_sequence, m.count, m.reason, m.stamp_ns)
