"""model.json: the smallest file that says everything. Every other format is made from it."""

from __future__ import annotations

import json
import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from facet_protocol.messages import (
    Hole,
    HoleKind,
    MapUpdate,
    Plane,
    PlaneClass,
    PlaneFrame,
    ProtocolError,
    Surface,
)

Model = dict[str, Any]  # JSON values only
FORMAT, VERSION = "facet-model", 1


class Counts(Protocol):
    """What the mapper counts: voxels, except where the name says points or scans."""

    @property
    def scans(self) -> int: ...
    @property
    def points_in(self) -> int: ...
    @property
    def points_stored(self) -> int: ...
    @property
    def points_rejected(self) -> Mapping[str, int]: ...
    @property
    def voxels(self) -> int: ...
    @property
    def valid(self) -> int: ...
    @property
    def aligned(self) -> int: ...
    @property
    def thick(self) -> int: ...
    @property
    def sparse(self) -> int: ...
    @property
    def mixed(self) -> int: ...
    @property
    def discarded(self) -> int: ...
    @property
    def discarded_points(self) -> int: ...
    @property
    def sigma_n_m(self) -> float: ...


class Digest(Protocol):
    @property
    def state(self) -> str: ...
    @property
    def derived(self) -> str: ...


COUNTED = (
    "scans", "points_in", "points_stored", "points_rejected", "voxels", "valid", "aligned",
    "thick", "sparse", "mixed", "discarded", "discarded_points",
)  # fmt: skip


def build_model(
    snapshot: MapUpdate, counts: Counts, settings: Mapping[str, object], digest: Digest
) -> Model:
    """The whole map as JSON values: world coordinates to read, frame units to compute with."""
    counted = {name: getattr(counts, name) for name in COUNTED}
    return {
        "format": FORMAT,
        "version": VERSION,
        "frame": "map",
        "map": {
            "id": snapshot.map_id,
            "revision": snapshot.revision,
            "stamp_ns": snapshot.stamp_ns,
        },
        "settings": dict(settings),
        "counts": counted | {"points_rejected": dict(sorted(counts.points_rejected.items()))},
        "noise": {"sigma_n_m": counts.sigma_n_m},
        "digest": {"state": digest.state, "derived": digest.derived},
        "planes": [_plane_values(plane) for plane in snapshot.changed],
    }


def _plane_values(plane: Plane) -> Model:
    frame = plane.frame
    return {
        "id": plane.id,
        "class": plane.plane_class.value,
        "normal": plane.normal.tolist(),
        "d": plane.d,
        "facing": plane.facing,
        "sigma_n_m": plane.sigma_n_m,
        "thickness_angle_deg": plane.thickness_angle_deg,
        "num_points": plane.num_points,
        "num_voxels": plane.num_voxels,
        "centroid": plane.centroid.tolist(),
        "rms_m": plane.rms_m,
        "revision": plane.revision,
        "covariance": plane.covariance.tolist(),
        "first_seen_ns": plane.first_seen_ns,
        "last_seen_ns": plane.last_seen_ns,
        "robots": list(plane.robots),
        "frame": {
            "axis_u": frame.axis_u.tolist(),
            "axis_v": frame.axis_v.tolist(),
            "axis_n": frame.axis_n.tolist(),
            "step_m": frame.step_m,
        },
        "surfaces": [_surface_values(plane, surface) for surface in plane.surfaces],
    }


def _surface_values(plane: Plane, surface: Surface) -> Model:
    return {
        "id": surface.id,
        "area_m2": surface.area_m2,
        "outer": plane.lift(surface.outer).tolist(),
        "outer_uv": surface.outer.tolist(),
        "holes": [
            {
                "kind": hole.kind.value,
                "ring": plane.lift(hole.ring).tolist(),
                "ring_uv": hole.ring.tolist(),
            }
            for hole in surface.holes
        ],
    }


def planes_of(model: Model) -> tuple[Plane, ...]:
    """The model's planes as `build_model` was given them. Raises ProtocolError."""
    try:
        return tuple(_plane(values) for values in model["planes"])
    except (KeyError, TypeError, ValueError, OverflowError) as error:
        raise ProtocolError(f"not a facet model: {error!r}") from error


def _plane(values: Model) -> Plane:
    frame = values["frame"]
    return Plane(
        id=int(values["id"]),
        revision=int(values["revision"]),
        plane_class=PlaneClass(values["class"]),
        normal=_array(values["normal"], (3,)),
        d=float(values["d"]),
        facing=int(values["facing"]),
        sigma_n_m=float(values["sigma_n_m"]),
        thickness_angle_deg=float(values["thickness_angle_deg"]),
        covariance=_array(values["covariance"], (4, 4)),
        num_points=int(values["num_points"]),
        num_voxels=int(values["num_voxels"]),
        centroid=_array(values["centroid"], (3,)),
        rms_m=float(values["rms_m"]),
        frame=PlaneFrame(
            axis_u=_array(frame["axis_u"], (3,)),
            axis_v=_array(frame["axis_v"], (3,)),
            axis_n=_array(frame["axis_n"], (3,)),
            step_m=float(frame["step_m"]),
        ),
        surfaces=tuple(_surface(surface) for surface in values["surfaces"]),
        first_seen_ns=int(values["first_seen_ns"]),
        last_seen_ns=int(values["last_seen_ns"]),
        robots=tuple(str(robot) for robot in values["robots"]),
    )


def _surface(values: Model) -> Surface:
    holes = tuple(Hole(HoleKind(hole["kind"]), _ring(hole["ring_uv"])) for hole in values["holes"])
    return Surface(int(values["id"]), float(values["area_m2"]), _ring(values["outer_uv"]), holes)


def _array(values: object, shape: tuple[int, ...]) -> NDArray[np.float64]:
    array = np.array(values, dtype=np.float64)
    if array.shape != shape:
        raise ValueError(f"shape {array.shape}, not {shape}")
    return array


def _ring(values: object) -> NDArray[np.int32]:
    return np.array(values, dtype=np.int32).reshape(-1, 2)


def write_model(model: Model, path: Path) -> None:
    """One line a plane, so that diff compares two models. The same model, the same bytes."""
    head = [f"{json.dumps(key)}: {_line(model[key])}" for key in model if key != "planes"]
    planes = ",\n".join(_line(plane) for plane in model["planes"])
    text = "{\n" + ",\n".join([*head, f'"planes": [\n{planes}\n]']) + "\n}\n"
    partial = path.with_name(path.name + ".part")
    partial.write_text(text, encoding="utf-8")
    os.replace(partial, path)


def _line(value: object) -> str:
    return json.dumps(value, allow_nan=False, separators=(", ", ": "))


def read_model(path: Path) -> Model:
    """Raises ProtocolError where the file is not a model that this version reads."""
    try:
        model = json.loads(path.read_bytes())
    except ValueError as error:
        raise ProtocolError(f"{path}: not JSON: {error}") from error
    if not isinstance(model, dict) or model.get("format") != FORMAT:
        raise ProtocolError(f"{path}: not a {FORMAT} file")
    if model.get("version") != VERSION:
        raise ProtocolError(f"{path}: version {model.get('version')}, this reads {VERSION}")
    planes_of(model)
    return model
