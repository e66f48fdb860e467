"""The values themselves: rotation, lifting, tile points."""

from dataclasses import fields

import numpy as np
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

import facet_protocol
from examples import plane
from facet_protocol import Envelope, Pose, TilePoints
from facet_protocol.messages import Rule


@given(st.integers(0, 10_000))
def test_rotation_is_scipys(seed: int) -> None:
    q = Rotation.random(rng=np.random.default_rng(seed)).as_quat()
    mine = Pose(np.zeros(3), q).rotation()
    np.testing.assert_allclose(mine, Rotation.from_quat(q).as_matrix(), atol=1e-15)
    np.testing.assert_allclose(mine @ mine.T, np.eye(3), atol=1e-15)


def test_lifted_vertices_lie_on_the_plane_where_the_frame_says() -> None:
    wall = plane(1)
    ring = wall.surfaces[0].outer
    vertices = wall.lift(ring)
    np.testing.assert_allclose(vertices @ wall.normal, wall.d, atol=1e-9)
    uv = vertices @ np.stack([wall.frame.axis_u, wall.frame.axis_v], axis=1)
    np.testing.assert_allclose(uv, ring * wall.frame.step_m, atol=1e-9)


def test_tile_points_count_from_their_corner() -> None:
    centroids = np.array([[0, 4, 511]], dtype=np.uint16)
    points = TilePoints((-1, 0, 1), 0.05, centroids, np.zeros(1, dtype=np.int32))
    np.testing.assert_allclose(points.xyz(), [[-3.2, 0.025, 3.2 + 511 * 0.00625]], rtol=1e-6)


def test_public_names_are_pinned() -> None:
    assert sorted(facet_protocol.__all__, key=str.lower) == PUBLIC.split()
    assert all(hasattr(facet_protocol, name) for name in facet_protocol.__all__)


PUBLIC = """
Attachment attachment Conflict Corrected CorrectedPose Correction Cut decode decode_scan
descriptor_set encode encode_scan encode_scene encode_tiles_cloud Envelope Erase Event EventKind
Events facet_descriptors Hole HoleKind LineFan Loss MapMirror MapUpdate Message Plane PlaneClass
PlaneFrame Pose project project_fan ProtocolError ResolvedPose Scan ScanKind Schema SCHEMAS sin_cos
StampedPose StampedTransform Status Surface TilePoints Tombstone topics Transforms
"""


def test_an_owned_envelope_differs_in_whose_bytes_it_has_alone() -> None:
    whole = b"before payload after"
    rule = Rule("a/**", frame="base")
    view = Envelope("a/b", "S", "cdr", memoryview(whole)[7:14], 1, 2, 3, 4, rule, is_derived=True)
    owned = view.owned()
    assert isinstance(owned.payload, bytes)
    for field in fields(Envelope):
        assert getattr(owned, field.name) == getattr(view, field.name)
        assert getattr(view, field.name) != field.default  # or it could be left out
    assert owned.owned() is owned
