"""Every format opens in the library that reads it, and says what the model says."""

from collections import Counter
from dataclasses import replace

import numpy as np
import pytest
import trimesh
from PIL import Image
from plyfile import PlyData

import office
from facet.export.colours import UNASSIGNED, plane_colour, point_colours
from facet.export.formats import FORMATS
from facet.export.model import build_model
from facet_protocol.messages import PlaneClass, TilePoints

MAGIC = {"json": b"{", "ply": b"ply", "glb": b"glTF", "png": b"\x89PNG"}


def _model(planes=None):
    snapshot = office.snapshot()
    if planes is not None:
        snapshot = replace(snapshot, changed=planes)
    counts = office.Counts(points_rejected={})
    return build_model(snapshot, counts, office.SETTINGS, office.Digest())


@pytest.mark.parametrize("name", FORMATS)
@pytest.mark.parametrize("planes", [None, ()], ids=["office", "empty"])
def test_each_format_is_written_the_same_twice(name, planes, tmp_path):
    for k in range(2):
        FORMATS[name](_model(planes), [], tmp_path / f"{k}.{name}")
    first = (tmp_path / f"0.{name}").read_bytes()
    assert first == (tmp_path / f"1.{name}").read_bytes()
    assert first.startswith(MAGIC[name])


def test_ply_points_lie_on_the_planes_they_name(tmp_path):
    tiles = office.points(spacing=0.2)
    FORMATS["ply"](_model(), tiles, tmp_path / "m.ply")
    vertex = PlyData.read(tmp_path / "m.ply")["vertex"]
    assert len(vertex) == sum(len(tile.plane_ids) for tile in tiles)
    planes = {plane.id: plane for plane in office.planes()}
    xyz = np.stack([vertex["x"], vertex["y"], vertex["z"]], axis=1)
    normals = np.stack([vertex["nx"], vertex["ny"], vertex["nz"]], axis=1)
    for number, plane in planes.items():
        rows = vertex["plane_id"] == number
        assert np.abs(xyz[rows] @ plane.normal - plane.d).max() < 0.06
        np.testing.assert_allclose(
            normals[rows], np.tile(plane.facing * plane.normal, (rows.sum(), 1))
        )
    assert not normals[vertex["plane_id"] == 0].any()


def test_ply_without_points_holds_the_surfaces(tmp_path):
    empty = TilePoints((0, 0, 0), 0.05, np.zeros((0, 3), np.uint16), np.zeros(0, np.int32))
    FORMATS["ply"](_model(), [empty], tmp_path / "m.ply")
    mesh = trimesh.load_mesh(tmp_path / "m.ply", process=False)
    expected = sum(s.area_m2 for plane in office.planes() for s in plane.surfaces)
    assert mesh.area == pytest.approx(expected, rel=1e-4)


def test_glb_has_a_named_node_a_surface_and_stands_upright(tmp_path):
    FORMATS["glb"](_model(), [], tmp_path / "m.glb")
    scene = trimesh.load_scene(tmp_path / "m.glb")
    names = [f"{p.plane_class}-{p.id}-{s.id}" for p in office.planes() for s in p.surfaces]
    assert sorted(scene.geometry) == sorted(names)
    low, high = scene.bounds
    np.testing.assert_allclose(high - low, [12.0, office.HEIGHT, 8.0], atol=1e-5)  # y is up
    floor = scene.geometry["floor-1-11"]
    np.testing.assert_allclose(floor.face_normals, np.tile([0.0, 1.0, 0.0], (2, 1)), atol=1e-6)
    assert floor.metadata["plane_id"] == 1
    kinds = Counter(mesh.visual.material.name for mesh in scene.geometry.values())
    assert kinds["wall"] == 20


def test_picture_shows_both_halves(tmp_path):
    FORMATS["png"](_model(), [], tmp_path / "m.png")
    pixels = np.asarray(Image.open(tmp_path / "m.png").convert("RGB")).astype(int)
    ink = (pixels.sum(axis=2) < 700).mean(axis=0)
    half = len(ink) // 2
    assert ink[:half].mean() > 0.05
    assert ink[half:].mean() > 0.05


@pytest.mark.parametrize("kind", PlaneClass)
def test_a_plane_has_its_own_shade_of_its_class(kind):
    shades = np.array([plane_colour(k, kind) for k in range(1, 200)])
    assert len(np.unique(shades, axis=0)) > 190
    for away in (1, 2, 3, 4):  # planes that are found together have ids near each other
        assert np.abs(shades[away:] - shades[:-away]).max(axis=1).min() >= 10
    others = np.array([plane_colour(k, c) for k in range(1, 200) for c in PlaneClass if c != kind])
    assert np.abs(shades[:, None] - others[None]).max(axis=2).min() > 0


def test_points_have_the_shade_of_their_plane():
    colours = point_colours(np.array([0, 5, 0, 6], dtype=np.int32), {5: PlaneClass.WALL})
    assert colours.shape == (4, 3)
    assert tuple(colours[1]) == plane_colour(5, PlaneClass.WALL)
    assert tuple(colours[3]) == plane_colour(6, PlaneClass.OTHER)
    assert tuple(colours[0]) == UNASSIGNED
    assert point_colours(np.zeros(0, dtype=np.int32), {}).shape == (0, 3)
