"""The formats of `facet export`: each takes the model and, where there are any, its points."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path

from facet.export.model import Model, planes_of, write_model
from facet_protocol.messages import TilePoints

Write = Callable[[Model, Sequence[TilePoints], Path], None]


def _json(model: Model, tiles: Sequence[TilePoints], path: Path) -> None:
    write_model(model, path)


def _ply(model: Model, tiles: Sequence[TilePoints], path: Path) -> None:
    from facet.export import ply

    if any(len(tile.plane_ids) for tile in tiles):
        ply.write_points(planes_of(model), tiles, path)
    else:
        ply.write_surfaces(planes_of(model), path)


def _glb(model: Model, tiles: Sequence[TilePoints], path: Path) -> None:
    from facet.export import glb

    glb.write_glb(planes_of(model), path)


def _png(model: Model, tiles: Sequence[TilePoints], path: Path) -> None:
    from facet.export import picture

    picture.write_picture(model, path)


# The libraries are imported when a format is written: JSON needs none of them.
FORMATS: dict[str, Write] = {"json": _json, "ply": _ply, "glb": _glb, "png": _png}
