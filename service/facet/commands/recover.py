"""`facet recover`: a damaged log as a clean one, with everything in it that is whole."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from facet.commands.terminal import Exit, InputError, err, existing, megabytes, out, progress
from facet.sinks.durable_file import DurableFile
from facet.sinks.raw_log import RawLog
from facet.sources.mcap_stream import McapStream


def recover(
    damaged: Annotated[Path, typer.Argument(help="A log (.mcap) that is cut off or damaged.")],
    clean: Annotated[Path, typer.Argument(help="The file to write; it must not be there.")],
) -> None:
    """Save what is whole in a damaged log, as a clean one.

    \b
    facet recover out/log/map-20260101T120000Z-000001.mcap clean.mcap

    Every message of every whole chunk is taken, byte for byte, with its channel, its schema and its
    times, and so is the metadata; attachments are not. Exit code 0: nothing was lost; 3: something
    was, it is said what; 65: there is nothing to recover.
    """
    existing([damaged])
    if clean.exists():
        raise InputError(f"{clean} is there already: it is not written over")
    stream = McapStream(damaged)
    partial = clean.with_name(clean.name + ".part")
    partial.unlink(missing_ok=True)
    log = RawLog(DurableFile(partial))
    try:
        with progress("recovering") as bar:
            for message in stream.messages():
                _copy_metadata(stream, log)
                log.add(message)
                bar.advance(bar.task_ids[0])
        _copy_metadata(stream, log)
        log.finish()
    except BaseException:
        log.abandon()
        partial.unlink(missing_ok=True)
        raise
    _conclude(stream, partial, clean)


def _copy_metadata(stream: McapStream, log: RawLog) -> None:
    for metadata in stream.metadata:
        log.add_metadata(metadata.name, metadata.metadata)
    stream.metadata.clear()


def _conclude(stream: McapStream, partial: Path, clean: Path) -> None:
    for note in stream.damage.notes:
        err.print(f"damage: {note}")
    if not stream.num_messages and stream.damage:
        partial.unlink()
        raise InputError(f"{stream.path}: nothing in it can be recovered")
    partial.replace(clean)
    size = megabytes(clean.stat().st_size)
    out.print(f"recovered {stream.num_messages:,} messages into {clean} ({size})")
    if stream.num_unchecked:
        out.print(f"{stream.num_unchecked:,} of them are taken on trust: they had no checksum")
    if stream.damage.is_lossy:
        out.print(str(stream.damage))
        raise typer.Exit(Exit.LOST)
    out.print("nothing was lost")
