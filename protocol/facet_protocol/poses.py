"""Poses and transforms as Foxglove's schemas carry them, both ways."""

from __future__ import annotations

from foxglove_schemas_protobuf import Pose_pb2, Quaternion_pb2, Vector3_pb2
from foxglove_schemas_protobuf.FrameTransform_pb2 import FrameTransform
from foxglove_schemas_protobuf.FrameTransforms_pb2 import FrameTransforms
from foxglove_schemas_protobuf.PoseInFrame_pb2 import PoseInFrame

from facet_protocol.messages import Pose, ProtocolError, StampedPose, StampedTransform, Transforms
from facet_protocol.wire import check_pose, parse, stamp_of, timestamp_of


def _vector(pose: Pose) -> Vector3_pb2.Vector3:
    x, y, z = (float(c) for c in pose.position)
    return Vector3_pb2.Vector3(x=x, y=y, z=z)


def _quaternion(pose: Pose) -> Quaternion_pb2.Quaternion:
    x, y, z, w = (float(c) for c in pose.orientation_xyzw)
    return Quaternion_pb2.Quaternion(x=x, y=y, z=z, w=w)


def pose_message(pose: Pose) -> Pose_pb2.Pose:
    return Pose_pb2.Pose(position=_vector(pose), orientation=_quaternion(pose))


def pose_of(message: Pose_pb2.Pose) -> tuple[Pose, bool]:
    """The pose, and whether it was renormalised. Raises ProtocolError, see `check_pose`."""
    p, q = message.position, message.orientation
    return check_pose((p.x, p.y, p.z), (q.x, q.y, q.z, q.w))


def encode_stamped_pose(value: StampedPose) -> bytes:
    return PoseInFrame(
        timestamp=timestamp_of(value.stamp_ns),
        frame_id=value.frame_id,
        pose=pose_message(value.pose),
    ).SerializeToString(deterministic=True)


def decode_stamped_pose(payload: bytes | memoryview) -> StampedPose:
    message = parse(PoseInFrame, payload)
    if not message.HasField("pose"):
        raise ProtocolError("foxglove.PoseInFrame without a pose", "bad_pose")
    return StampedPose(stamp_of(message.timestamp), message.frame_id, pose_of(message.pose)[0])


def _transform_message(value: StampedTransform) -> FrameTransform:
    return FrameTransform(
        timestamp=timestamp_of(value.stamp_ns),
        parent_frame_id=value.parent_frame_id,
        child_frame_id=value.child_frame_id,
        translation=_vector(value.pose),
        rotation=_quaternion(value.pose),
    )


def _transform_of(message: FrameTransform) -> StampedTransform:
    t, q = message.translation, message.rotation
    pose, _ = check_pose((t.x, t.y, t.z), (q.x, q.y, q.z, q.w))
    if not message.parent_frame_id or not message.child_frame_id:
        raise ProtocolError("foxglove.FrameTransform without both frames", "wrong_frame")
    stamp_ns = stamp_of(message.timestamp)
    return StampedTransform(stamp_ns, message.parent_frame_id, message.child_frame_id, pose)


def encode_transform(value: StampedTransform) -> bytes:
    return _transform_message(value).SerializeToString(deterministic=True)


def decode_transform(payload: bytes | memoryview) -> StampedTransform:
    return _transform_of(parse(FrameTransform, payload))


def encode_transforms(value: Transforms) -> bytes:
    message = FrameTransforms(transforms=[_transform_message(t) for t in value.transforms])
    return message.SerializeToString(deterministic=True)


def decode_transforms(payload: bytes | memoryview) -> Transforms:
    """What is no good transform is left out, and its reason kept."""
    good: list[StampedTransform] = []
    refused: list[str] = []
    for message in parse(FrameTransforms, payload).transforms:
        try:
            good.append(_transform_of(message))
        except ProtocolError as error:
            refused.append(error.reason)
    return Transforms(tuple(good), tuple(refused))
