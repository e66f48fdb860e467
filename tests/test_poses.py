"""Poses and transforms from elsewhere."""

import numpy as np
import pytest
from foxglove_schemas_protobuf.FrameTransform_pb2 import FrameTransform
from foxglove_schemas_protobuf.PoseInFrame_pb2 import PoseInFrame

from examples import POSE, STAMP_NS, TRANSFORM
from facet_protocol import ProtocolError, StampedPose, Transforms
from facet_protocol.poses import (
    decode_stamped_pose,
    decode_transform,
    decode_transforms,
    encode_stamped_pose,
    encode_transform,
    encode_transforms,
)


def test_a_pose_in_a_frame_comes_back() -> None:
    value = decode_stamped_pose(encode_stamped_pose(StampedPose(STAMP_NS, "map", POSE)))
    assert (value.stamp_ns, value.frame_id) == (STAMP_NS, "map")
    assert value.pose.position.tolist() == POSE.position.tolist()
    assert value.pose.orientation_xyzw.tolist() == POSE.orientation_xyzw.tolist()


def test_transforms_come_back_in_order() -> None:
    value = decode_transforms(encode_transforms(Transforms((TRANSFORM, TRANSFORM))))
    assert [t.child_frame_id for t in value.transforms] == ["base", "base"]
    assert decode_transform(encode_transform(TRANSFORM)).parent_frame_id == "map"


def test_what_is_missing_is_refused() -> None:
    with pytest.raises(ProtocolError, match="without a pose"):
        decode_stamped_pose(PoseInFrame(frame_id="map").SerializeToString())
    message = FrameTransform.FromString(encode_transform(TRANSFORM))
    message.child_frame_id = ""
    with pytest.raises(ProtocolError) as caught:
        decode_transform(message.SerializeToString())
    assert caught.value.reason == "wrong_frame"
    message.ClearField("rotation")
    with pytest.raises(ProtocolError) as caught:
        decode_transform(message.SerializeToString())
    assert caught.value.reason == "bad_quaternion"


def test_positions_keep_their_sign_of_zero() -> None:
    payload = encode_stamped_pose(StampedPose(0, "map", type(POSE)(-np.zeros(3), np.eye(4)[3])))
    assert np.signbit(decode_stamped_pose(payload).pose.position).all()
