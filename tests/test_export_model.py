"""model.json holds the map without loss, is stable byte for byte, and is checked when read."""

import json
from dataclasses import fields, replace

import numpy as np
import pytest

import office
from facet.export.model import build_model, planes_of, read_model, write_model
from facet_protocol.messages import Plane, ProtocolError


@pytest.fixture
def model():
    counts = office.Counts(points_rejected={"range": 3, "non_finite": 5})
    return build_model(office.snapshot(), counts, office.SETTINGS, office.Digest())


def _assert_same(a: Plane, b: Plane) -> None:
    for name in (field.name for field in fields(Plane)):
        if name not in ("frame", "surfaces"):
            np.testing.assert_array_equal(getattr(a, name), getattr(b, name), err_msg=name)
    np.testing.assert_array_equal(a.frame.axis_u, b.frame.axis_u)
    assert a.frame.step_m == b.frame.step_m
    for s, t in zip(a.surfaces, b.surfaces, strict=True):
        assert (s.id, s.area_m2) == (t.id, t.area_m2)
        np.testing.assert_array_equal(s.outer, t.outer)
        for h, k in zip(s.holes, t.holes, strict=True):
            assert h.kind == k.kind
            np.testing.assert_array_equal(h.ring, k.ring)


def test_the_file_gives_the_planes_back_bit_for_bit(model, tmp_path):
    write_model(model, tmp_path / "model.json")
    again = planes_of(read_model(tmp_path / "model.json"))
    for a, b in zip(office.planes(), again, strict=True):
        _assert_same(a, b)


def test_the_file_has_what_wire_md_promises(model):
    assert model["format"] == "facet-model"
    assert {"scans", "points_rejected", "voxels", "discarded"} <= model["counts"].keys()
    assert list(model["counts"]["points_rejected"]) == ["non_finite", "range"]
    wall = model["planes"][2]
    assert wall["class"] == "wall"
    surface = wall["surfaces"][0]
    assert len(surface["holes"]) == 2
    assert surface["holes"][0]["kind"] == "opening"
    outer = np.array(surface["outer"])
    np.testing.assert_allclose(outer @ np.array(wall["normal"]), wall["d"], atol=1e-9)


def test_same_map_same_bytes(model, tmp_path):
    for name in ("a.json", "b.json"):
        write_model(model, tmp_path / name)
    assert (tmp_path / "a.json").read_bytes() == (tmp_path / "b.json").read_bytes()
    assert json.loads((tmp_path / "a.json").read_text()) == model


def test_an_empty_map_is_a_model(tmp_path):
    empty = replace(office.snapshot(), changed=())
    counts = office.Counts(points_rejected={})
    write_model(build_model(empty, counts, {}, office.Digest()), tmp_path / "m.json")
    assert planes_of(read_model(tmp_path / "m.json")) == ()


@pytest.mark.parametrize(
    "text",
    ["", "[]", "{}", '{"format": "facet-model", "version": 2, "planes": []}',
     '{"format": "facet-model", "version": 1}',
     '{"format": "facet-model", "version": 1, "planes": [{"id": 1}]}',
     '{"format": "facet-model", "version": 1, "planes": 7}', "\xff\xfe"],
)  # fmt: skip
def test_what_is_no_model_is_refused(text, tmp_path):
    (tmp_path / "m.json").write_bytes(text.encode("latin-1"))
    with pytest.raises(ProtocolError):
        read_model(tmp_path / "m.json")


def test_a_bad_plane_is_refused_not_guessed(model, tmp_path):
    model["planes"][0]["normal"] = [0.0, 1.0]
    write_model(model, tmp_path / "m.json")
    with pytest.raises(ProtocolError, match="shape"):
        read_model(tmp_path / "m.json")
