"""A map that goes on: from a checkpoint and the tail of its log, else from all of its log.

What is kept of a map is a function of its log: a checkpoint only saves the time to compute it
again, and whatever does not fit together is computed again. There is no map in between.
"""

from __future__ import annotations

import hashlib
import json
import logging
import os
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path
from typing import Any

from facet import __version__, mapping
from facet.admission import Admission
from facet.checkpoint import (
    Checkpoint,
    CheckpointError,
    checkpoint_paths,
    read_checkpoint,
    write_checkpoint,
)
from facet.config import Config
from facet.cuts import logged_cuts
from facet.mapping.frozen import freeze, thaw
from facet.mapping.mapper import Mapper
from facet.mapping.memory import Memory
from facet.mapping.settings import MapSettings
from facet.outgoing import Outgoing
from facet.past import definitions_of
from facet.pipeline import Pipeline
from facet.robots import admission_of, dialects_of
from facet.sinks.log_file import ChannelName
from facet.sinks.recorder import LogPosition, log_files
from facet.sources.dialects import Dialects
from facet.sources.mcap_damage import LogError
from facet.sources.mcap_stream import McapStream
from facet.sources.naming import source_of
from facet.sources.recording import envelope_of, is_replayed
from facet.status import Account
from facet_protocol.messages import Envelope

logger = logging.getLogger(__name__)

MAP, ADMISSION = "map/", "admission/"  # of whom an array is
SAY_EVERY_S = 5.0

Newest = dict[str, tuple[int, int]]  # by source: epoch and sequence of the last in the log


def note_newest(newest: Newest, envelope: Envelope) -> None:
    """Keep the largest number of a source's epoch."""
    if envelope.sequence:
        source = source_of(envelope)
        epoch, sequence = newest.get(source, (envelope.epoch, 0))
        largest = max(sequence, envelope.sequence) if epoch == envelope.epoch else envelope.sequence
        newest[source] = (envelope.epoch, largest)


class Stopped(Exception):
    """It was told to end before the map was there again."""


@dataclass(slots=True)
class Resumed:
    """The map as its log leaves it. `pipeline` may be stale: its update is the service's."""

    mapper: Mapper
    admission: Admission
    pipeline: Pipeline
    position: LogPosition | None = None  # all before it is in the map; None: there is no log
    newest: Newest = field(default_factory=dict)
    checkpoint: Path | None = None  # that it began from
    num_scans: int = 0  # read from the log


@cache
def code() -> str:
    """Hash of the mapping core as it is installed: an edit without a new version is another."""
    files = sorted(Path(mapping.__path__[0]).glob("*.py"))
    return hashlib.sha256(b"".join(path.read_bytes() for path in files)).hexdigest()


def origin(settings: MapSettings, config: Config) -> str:
    """Hash of all that decides, beside the log, what the map is."""
    parts = {
        "version": __version__,
        "code": code(),
        "map": config.map.model_dump(mode="json"),
        "robots": config.robots.model_dump(mode="json"),
        "settings": settings.as_dict(),
    }
    return hashlib.sha256(json.dumps(parts, sort_keys=True).encode()).hexdigest()


def hold(
    mapper: Mapper, admission: Admission, config: Config, position: LogPosition, newest: Newest
) -> Checkpoint:
    """The map as of its last update, copied: on the thread that owns it, after an update."""
    header = {
        "origin": origin(mapper.settings, config),
        "version": __version__,
        "map": mapper.map_id,
        "settings": mapper.settings.as_dict(),
        "revision": mapper.revision,
        "log": {"file": position.file, "offset": position.offset, "channels": position.channels},
        "newest": [[source, *numbers] for source, numbers in sorted(newest.items())],
    }
    arrays = {MAP + name: array for name, array in freeze(mapper).items()}
    arrays.update((ADMISSION + name, array) for name, array in admission.freeze().items())
    return Checkpoint(header, arrays)


def save(directory: Path, checkpoint: Checkpoint, system: Any = os) -> tuple[Path, int]:
    """Make it durable: where it is, and its bytes. Raises OSError.

    The log must hold the cut of the map's last update by now: a map is never ahead of its log.
    """
    map_id = checkpoint.header["map"]
    files = log_files(directory, map_id)
    if files:
        _sync(files[-1])
    sizes = [[path.name, path.stat().st_size] for path in files]
    header = {**checkpoint.header, "log": {**checkpoint.header["log"], "files": sizes}}
    newest, previous = checkpoint_paths(directory, map_id)
    return newest, write_checkpoint(newest, previous, Checkpoint(header, checkpoint.arrays), system)


def _sync(path: Path) -> None:
    """A log that did not wait for the disk must be there before what is made from it."""
    fd = os.open(path, os.O_RDONLY | os.O_CLOEXEC)
    try:
        os.fdatasync(fd)
    finally:
        os.close(fd)


def thaw_checkpoint(
    path: Path,
    settings: MapSettings | None = None,
    memory: Memory | None = None,
    origin: str | None = None,
) -> tuple[Checkpoint, Mapper]:
    """A checkpoint and its map; of that `origin` alone, where one is given. Raises
    CheckpointError, OSError."""
    checkpoint = read_checkpoint(path)
    header = checkpoint.header
    if origin not in (None, header.get("origin")):
        raise CheckpointError(path, "it was made by another version, or with other settings")
    try:
        settings = settings or MapSettings(**header["settings"])
        mapper = thaw(_part(checkpoint, MAP), settings, header["map"], memory)
    except (ValueError, TypeError, LookupError, AttributeError) as error:
        raise CheckpointError(path, f"it does not fit together ({error})") from error
    return checkpoint, mapper


def _part(checkpoint: Checkpoint, of: str) -> dict[str, Any]:
    """The arrays of the map, or of the admission."""
    found = checkpoint.arrays.items()
    return {name.removeprefix(of): array for name, array in found if name.startswith(of)}


def resume(config: Config, mapper: Mapper, stop: Callable[[], bool] = lambda: False) -> Resumed:
    """The map of the log that lies in the folder, or `mapper`, new, where there is none.

    Raises Stopped, OSError.
    """
    directory, map_id = config.record.directory, config.map.id
    files = log_files(directory, map_id)
    started = time.monotonic()
    for path in checkpoint_paths(directory, map_id) if files else ():
        try:
            resumed = _from_checkpoint(path, config, mapper, files)
        except FileNotFoundError:
            continue
        except (CheckpointError, OSError) as error:
            logger.warning("not used: %s", error)
            continue
        break
    else:
        resumed = _from_nothing(config, mapper)
    if files:
        _follow(resumed, files, stop, dialects_of(config.robots))
        logger.info(
            "map %s goes on: %s, %d scans of its log, %.1f s",
            map_id,
            resumed.checkpoint.name if resumed.checkpoint else "no checkpoint",
            resumed.num_scans,
            time.monotonic() - started,
        )
    return resumed


def _from_nothing(config: Config, mapper: Mapper) -> Resumed:
    """A new map, and what feeds it in silence."""
    account = Account()  # of its own: the service's begins with the service
    admission = admission_of(config, account, mapper.settings.reach_m, logged=True)
    outgoing = Outgoing(config.map.id, config.map.frame)
    return Resumed(mapper, admission, Pipeline(mapper, admission, account, (), outgoing))


def _from_checkpoint(path: Path, config: Config, new: Mapper, files: Sequence[Path]) -> Resumed:
    """The map of a checkpoint. Raises CheckpointError unless it is of this log and settings."""
    wanted = origin(new.settings, config)
    checkpoint, mapper = thaw_checkpoint(path, new.settings, new.memory, wanted)
    header = checkpoint.header
    resumed = _from_nothing(config, mapper)
    try:
        _check_files(header["log"], files)
        resumed.admission.thaw(_part(checkpoint, ADMISSION), config.record.directory)
        log = header["log"]
        channels = tuple(_channel_name(row) for row in log["channels"])
        resumed.position = LogPosition(str(log["file"]), int(log["offset"]), channels)
        resumed.newest = {source: (epoch, number) for source, epoch, number in header["newest"]}
    except (ValueError, TypeError, LookupError, AttributeError) as error:
        raise CheckpointError(path, f"it does not fit together ({error})") from error
    resumed.checkpoint = path
    return resumed


def _channel_name(row: Sequence[Any]) -> ChannelName:
    topic, schema, encoding, epoch, high = row
    return str(topic), str(schema), str(encoding), int(epoch), int(high)


def _check_files(log: Mapping[str, Any], files: Sequence[Path]) -> None:
    """Raises ValueError unless the log is still what the checkpoint was made from, or more."""
    known = log["files"]
    if not 0 < len(known) <= len(files):
        raise ValueError(f"{len(files)} files of log, where there were {len(known)}")
    if log["file"] not in [name for name, _ in known]:
        raise ValueError(f"the log {log['file']} is not among them")
    for (name, size), path in zip(known, files, strict=False):
        there, may_grow = path.stat().st_size, name >= log["file"]
        if path.name != name or there < size or (there > size and not may_grow):
            raise ValueError(f"the log {name} of {size} bytes is now {path.name} of {there}")


def _follow(
    resumed: Resumed, files: Sequence[Path], stop: Callable[[], bool], dialects: Dialects
) -> None:
    """Apply what the log holds beyond the map, and update it where the log was cut."""
    pipeline, first_revision = resumed.pipeline, resumed.mapper.revision
    envelopes = filter(is_replayed, _envelopes(resumed, files, dialects))
    said = time.monotonic()
    for batch in logged_cuts(envelopes, lambda: True):
        pipeline.insert(*batch)
        resumed.num_scans += len(batch)
        if batch.revision > first_revision:  # the others are in the checkpoint
            pipeline.update()
        if stop():
            raise Stopped
        if time.monotonic() - said > SAY_EVERY_S:
            said = time.monotonic()
            logger.info("reading the log: %d scans so far", resumed.num_scans)
    size = files[-1].stat().st_size
    resumed.position = LogPosition(files[-1].name, size, ())


def _envelopes(resumed: Resumed, files: Sequence[Path], dialects: Dialects) -> Iterator[Envelope]:
    """What lies beyond the position, file by file."""
    position = resumed.position
    names = [path.name for path in files]
    first = names.index(position.file) if position is not None else 0
    for path in files[first:]:
        if position is not None and path.name == position.file:
            stream = McapStream(path, position.offset, definitions_of(position.channels))
        else:
            stream = McapStream(path)
        with suppress(LogError):  # nothing of it can be read: said below
            for message in stream.messages():
                envelope = envelope_of(message, dialects)
                note_newest(resumed.newest, envelope)
                resumed.admission.past.note_read(stream, envelope)
                yield envelope
        if stream.damage.is_lossy:
            logger.warning("%s: %s; %s", path.name, stream.damage, "; ".join(stream.damage.notes))


def set_aside(directory: Path, map_id: str) -> Path | None:
    """Move a map's log and checkpoints into a folder of their own; None: there were none."""
    found = [*log_files(directory, map_id)]
    found += [path for path in checkpoint_paths(directory, map_id) if path.exists()]
    if not found:
        return None
    stamp = time.strftime("%Y%m%dT%H%M%SZ", time.gmtime())
    folder = directory / f"{map_id}-before-{stamp}"
    number = 1
    while folder.exists():
        number += 1
        folder = directory / f"{map_id}-before-{stamp}-{number}"
    folder.mkdir(mode=0o750)
    for path in found:
        path.rename(folder / path.name)
    return folder
