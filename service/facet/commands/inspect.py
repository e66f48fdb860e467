"""`facet info` and `facet digest`: what a file holds, what it lost, what its map hashes to."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass, field
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from facet.checkpoint import is_checkpoint, read_checkpoint
from facet.commands.terminal import Exit, err, existing, megabytes, out, table
from facet.config import Config
from facet.firsts import Firsts
from facet.robots import dialects_of, recorded_robots
from facet.sequences import SequenceLedger
from facet.sources.dialects import Dialect, Dialects
from facet.sources.naming import is_correction, is_input, is_scan, names_of, source_of
from facet.sources.recording import Recording
from facet_protocol import topics
from facet_protocol.codec import decode
from facet_protocol.messages import Conflict, Corrected, Envelope, Loss, ProtocolError

if TYPE_CHECKING:
    from facet.mapping.digest import Digest

OWN_TOPICS = (
    *(topics.CUT_TOPIC, topics.LOSS_TOPIC),
    *(topics.CORRECTED_TOPIC, topics.CONFLICT_TOPIC),
)


@dataclass(slots=True)
class Channel:
    """One topic of a recording."""

    schema: str
    dialect: str  # how it says what it is; "derived" by Facet, or "not read"
    num_messages: int = 0
    num_bytes: int = 0
    first_ns: int = 0
    last_ns: int = 0


@dataclass(slots=True)
class Contents:
    """What a recording holds, by topic and by source."""

    dialects: Dialects = field(default_factory=Dialects)
    channels: dict[tuple[str, str], Channel] = field(default_factory=dict)  # by topic and schema
    scans: Counter[str] = field(default_factory=Counter)
    duplicates: Counter[str] = field(default_factory=Counter)
    conflicts: Counter[bool] = field(default_factory=Counter)  # whether the later one was kept
    losses: Counter[str] = field(default_factory=Counter)  # what the log says of itself
    cuts: set[int] = field(default_factory=set)
    ledger: SequenceLedger = field(default_factory=SequenceLedger)
    firsts: Firsts = field(default_factory=Firsts)
    corrections: Counter[str] = field(default_factory=Counter)  # by robot
    outcomes: Counter[str] = field(default_factory=Counter)  # of corrections, as the log says
    num_moved: int = 0  # scans, by corrections and erasures
    num_erasures: int = 0

    def note(self, envelope: Envelope) -> None:
        """Count one message."""
        name = (envelope.key, envelope.schema)
        if name not in self.channels:
            self.channels[name] = Channel(envelope.schema, self._dialect(envelope))
        channel = self.channels[name]
        channel.num_messages += 1
        channel.num_bytes += len(envelope.payload)
        channel.first_ns = channel.first_ns or envelope.received_ns
        channel.last_ns = max(channel.last_ns, envelope.received_ns)
        if is_scan(envelope):
            source = source_of(envelope)
            self.scans[source] += 1
            self.ledger.note(source, envelope.epoch, envelope.sequence)
            if envelope.sequence and not self.firsts.is_first(envelope, source):
                self.duplicates[source] += 1
        elif topics.is_erase_topic(envelope.key):
            self.num_erasures += 1
        elif is_correction(envelope):
            self.corrections[names_of(envelope)[0]] += 1
        elif envelope.key in OWN_TOPICS:
            self._note_own(envelope)

    def _dialect(self, envelope: Envelope) -> str:
        if is_input(envelope):
            name = (envelope.key, envelope.schema, envelope.encoding)
            found = self.dialects.recognise_channel(*name)
            if topics.is_erase_topic(envelope.key):
                return str(Dialect.NATIVE)
            return str(found.dialect) if found else "not read"
        is_own = envelope.is_derived or envelope.key.startswith("/facet/")
        return "derived" if is_own else "not read"

    def _note_own(self, envelope: Envelope) -> None:
        try:
            message = decode(envelope)
        except ProtocolError:
            return
        if isinstance(message, Loss):
            self.losses[message.reason] += message.count
        elif isinstance(message, Corrected):
            self.outcomes[message.reason or "applied"] += 1
            self.num_moved += message.num_scans
        elif isinstance(message, Conflict):
            self.conflicts[message.replaced] += 1
        else:
            self.cuts.add(getattr(message, "revision", 0))


def info(
    file: Annotated[
        Path, typer.Argument(help="A log (.mcap), a folder of them, model.json or a checkpoint.")
    ],
) -> None:
    """Tell what is in a log, and what was lost. A model or a checkpoint, too.

    \b
    facet info out/log
    facet info out/log/model.json

    Exit code 3: the log is damaged or cut off; what could be read was counted.
    """
    existing([file])
    if file.suffix == ".json":
        _model_info(file)
        return
    if is_checkpoint(file):
        _checkpoint_info(file)
        return
    dialects = dialects_of(recorded_robots(Recording([file]).head()))
    recording, contents = Recording([file], dialects), Contents(dialects)
    for envelope in recording:
        contents.note(envelope)
    _print_contents(recording, contents)
    raise typer.Exit(Exit.LOST if recording.is_damaged else Exit.CLEAN)


def _print_contents(recording: Recording, contents: Contents) -> None:
    channels = sorted(contents.channels.items())
    firsts = [channel.first_ns for _, channel in channels if channel.first_ns]
    num = len(recording.paths)
    out.print(f"{num} file{'s' * (num > 1)}, {megabytes(recording.num_bytes)}")
    if firsts:
        last_ns = max(channel.last_ns for _, channel in channels)
        out.print(f"{_utc(min(firsts))} to {_utc(last_ns)}, {(last_ns - min(firsts)) * 1e-9:.1f} s")
    rows = [
        (topic, c.schema, c.dialect, c.num_messages, megabytes(c.num_bytes), _rate(c))
        for (topic, _), c in channels
    ]
    table("channels", ("topic", "schema", "dialect", "messages", "size", "Hz"), rows)
    missing, epochs = contents.ledger.missing(), contents.ledger.num_epochs()
    sources = [
        (s, n, epochs.get(s, 0), missing.get(s, 0), contents.duplicates[s])
        for s, n in sorted(contents.scans.items())
    ]
    table("sources", ("robot/sensor", "scans", "epochs", "missing", "duplicates"), sources)
    out.print(f"{len(contents.cuts):,} updates were cut")
    if contents.corrections or contents.num_erasures:
        _print_corrections(contents)
    if contents.conflicts:
        out.print(
            f"{contents.conflicts.total():,} times a number came with other bytes: "
            f"{contents.conflicts[True]:,} took the place of the scan before"
        )
    for reason, num in sorted(contents.losses.items()):
        out.print(f"{num:,} scans {reason}, as the log says itself")
    if recording.num_unchecked:
        out.print(f"{recording.num_unchecked:,} messages that no checksum vouches for")
    metadata = recording.metadata.get("facet", {})
    if metadata:
        table("metadata", ("key", "value"), sorted(metadata.items()))
    for path, damage in recording.damage.items():
        for note in damage.notes:
            err.print(f"damage: {path}: {note}")
        if damage.is_lossy:
            err.print(
                f"damage: {path}: {damage}; `facet recover` writes what is whole to a new file"
            )


def _print_corrections(contents: Contents) -> None:
    robots = ", ".join(f"{num:,} of {name}" for name, num in sorted(contents.corrections.items()))
    ends = ", ".join(f"{num:,} {name}" for name, num in sorted(contents.outcomes.items()))
    erasures = f", {contents.num_erasures:,} erasures" if contents.num_erasures else ""
    erased = " or erased" if contents.num_erasures else ""
    out.print(
        f"{contents.corrections.total():,} corrections ({robots or 'of none'}){erasures}: "
        f"{ends or 'not applied yet'}; {contents.num_moved:,} scans moved{erased}"
    )


def _checkpoint_info(path: Path) -> None:
    checkpoint = read_checkpoint(path)
    header = checkpoint.header
    num_bytes = sum(array.nbytes for array in checkpoint.arrays.values())
    rows = [
        ("map", header.get("map", "")),
        ("version", header.get("version", "")),
        ("revision", header.get("revision", "")),
        ("log", f"{header['log']['file']} up to byte {header['log']['offset']:,}"),
        *((f"newest of {source}", number) for source, _, number in header.get("newest", [])),
        ("size", megabytes(num_bytes)),
        *sorted(header.get("settings", {}).items()),
    ]
    table(str(path), ("what", "value"), rows)


def _rate(channel: Channel) -> str:
    span_s = (channel.last_ns - channel.first_ns) * 1e-9
    return f"{(channel.num_messages - 1) / span_s:.1f}" if span_s > 0 else ""


def _utc(stamp_ns: int) -> str:
    return datetime.fromtimestamp(stamp_ns * 1e-9, tz=UTC).strftime("%Y-%m-%d %H:%M:%S")


def _model_info(path: Path) -> None:
    from facet.commands.outcome import summary
    from facet.export.model import read_model

    model = read_model(path)
    rows = summary(model, 0.0, 0.0)[:-2]  # without the times, which a model does not have
    table(str(path), ("what", "value"), rows)
    planes = [
        (
            plane["id"],
            plane["class"],
            f"{plane['normal'][0]:+.3f} {plane['normal'][1]:+.3f} {plane['normal'][2]:+.3f}",
            f"{plane['d']:.3f}",
            f"{sum(s['area_m2'] for s in plane['surfaces']):.2f}",
            f"{1e3 * plane['sigma_n_m']:.1f}",
        )
        for plane in model["planes"]
    ]
    table("planes", ("id", "class", "normal", "d m", "area m²", "sigma mm"), planes)


def digest(
    file: Annotated[
        Path, typer.Argument(help="A log (.mcap), a folder of them, model.json or a checkpoint.")
    ],
) -> None:
    """Print the two hashes of a map. One is of its state, one of what is derived from it.

    \b
    facet digest out/log                # replays it
    facet digest out/log/model.json     # computes the derived hash again from the file
    facet digest out/log/map.checkpoint # of the map that it keeps

    Equal scans give equal digests, in whatever order they came. Exit code 3: the log was damaged,
    or scans of it were left out. 65: a model that does not hash to what it says.
    """
    existing([file])
    if file.suffix == ".json":
        raise typer.Exit(_model_digest(file))
    if is_checkpoint(file):
        from facet.resume import thaw_checkpoint

        _print_digest(thaw_checkpoint(file)[1].digest())
        return
    from facet.commands.outcome import require_scans, say_losses
    from facet.commands.replay import replay_log

    result = replay_log([file], Config(), update_every="end")
    require_scans(result)
    say_losses(result)
    _print_digest(result.mapper.digest())
    raise typer.Exit(result.exit_code)


def _print_digest(hashes: Digest) -> None:
    out.print(f"state   {hashes.state}")
    out.print(f"derived {hashes.derived}")


def _model_digest(path: Path) -> Exit:
    from facet.export.model import read_model
    from facet.mapping.digest import derived_digest

    model = read_model(path)
    derived = derived_digest(model["planes"], model["counts"])
    out.print(f"derived {derived}")
    if derived != model["digest"]["derived"]:
        err.print(f"{path} says {model['digest']['derived']}: it was changed, or made elsewhere")
        return Exit.BAD_INPUT
    return Exit.CLEAN
