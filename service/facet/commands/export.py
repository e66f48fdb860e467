"""`facet export`: a model, or the map of a log, in another program's format."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from facet.commands.terminal import Exit, existing, megabytes, out, out_file
from facet.config import Config


def export(
    file: Annotated[
        Path, typer.Argument(metavar="MODEL|LOG", help="model.json, or a log (.mcap) to replay.")
    ],
    target: Annotated[Path, typer.Argument(metavar="OUT", help="The file to write.")],
    file_format: Annotated[
        str | None,
        typer.Option("--format", help="json | ply | glb | png.", show_default="OUT's ending"),
    ] = None,
) -> None:
    """Write a map in another format.

    \b
    facet export out/log/model.json rooms.glb      # surfaces, for any 3-D program
    facet export out/log points.ply                # a log also has its points
    facet export out/log/model.json rooms.ply      # a model: its surfaces, as triangles
    facet export out/log/model.json plan.png       # a view and a plan, with measures

    Lengths are metres, z is up; in glb, as its standard demands, y. Exit code 3: the log was
    damaged, or scans of it were left out.
    """
    from facet.export.formats import FORMATS
    from facet.export.model import read_model

    name = (file_format or target.suffix.removeprefix(".")).lower()
    if not name:
        known = ", ".join(f".{own}" for own in FORMATS)
        raise typer.BadParameter(f"{target} has no ending: give it one of {known}, or --format")
    if name not in FORMATS:
        raise typer.BadParameter(
            f"{name!r} is not one of {', '.join(FORMATS)}", param_hint="--format"
        )
    existing([file])
    out_file(target)
    code = Exit.CLEAN
    if file.suffix == ".json":
        model, tiles = read_model(file), []
    else:
        from facet.commands.outcome import require_scans, say_losses
        from facet.commands.replay import replay_log

        result = replay_log([file], Config())
        require_scans(result)
        say_losses(result)
        model, tiles, code = result.model(), result.mapper.points(), result.exit_code
    target.parent.mkdir(parents=True, exist_ok=True)
    FORMATS[name](model, tiles, target)
    out.print(f"{target}: {len(model['planes'])} planes, {megabytes(target.stat().st_size)}")
    raise typer.Exit(code)
