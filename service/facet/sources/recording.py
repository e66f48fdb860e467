"""Recordings as a source: envelopes in file order, whole files or cut off, paced or flat out."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from pathlib import Path

from facet.sources.mcap_stream import Damage, LogError, LogMessage, McapStream
from facet.sources.naming import is_scan
from facet_protocol import topics
from facet_protocol.messages import Envelope


class Recording:
    """The messages of one or more MCAP files, in the order given. Iterate it once."""

    def __init__(self, paths: Sequence[Path]) -> None:
        self.paths = [file for path in paths for file in _files(path)]
        self.damage: dict[Path, Damage] = {}
        self.metadata: dict[str, dict[str, str]] = {}  # of the file being read, by name
        self.num_bytes = sum(path.stat().st_size for path in self.paths)

    def __iter__(self) -> Iterator[Envelope]:
        for path in self.paths:
            stream = McapStream(path)
            self.damage[path] = stream.damage
            for message in stream.messages():
                self.metadata.update((m.name, m.metadata) for m in stream.metadata)
                stream.metadata.clear()
                yield envelope_of(message)
            self.metadata.update((m.name, m.metadata) for m in stream.metadata)

    def head(self) -> dict[str, str]:
        """What the first file says of itself before its first message: settings, map, frame."""
        stream = McapStream(self.paths[0])
        next(stream.messages(), None)
        return next((dict(m.metadata) for m in stream.metadata if m.name == "facet"), {})

    @property
    def is_damaged(self) -> bool:
        return any(self.damage.values())

    @property
    def has_cuts(self) -> bool:
        """The file being read was written by a service that logs where it cut its updates."""
        return self.metadata.get("facet", {}).get("cuts") == "logged"


def envelope_of(message: LogMessage) -> Envelope:
    """The message as it travelled; the epoch, and what MCAP's 32 bits lack, are the channel's."""
    metadata = message.channel.metadata
    return Envelope(
        key=message.channel.topic,
        schema=message.schema,
        encoding=message.channel.message_encoding,
        payload=message.payload,
        stamp_ns=message.publish_time_ns,
        epoch=_number(metadata.get("epoch")),
        sequence=message.sequence + (_number(metadata.get("sequence_high")) << 32),
        received_ns=message.log_time_ns,
    )


def is_replayed(envelope: Envelope) -> bool:
    """Whether replay reads it: scans, cuts and losses; the rest was derived from them."""
    return is_scan(envelope) or envelope.key in (topics.CUT_TOPIC, topics.LOSS_TOPIC)


def paced(
    envelopes: Iterator[Envelope],
    speed: float,
    clock_ns: Callable[[], int],
    sleep: Callable[[float], object],
) -> Iterator[Envelope]:
    """The same envelopes, each not before its time: `speed` 2 plays twice as fast as recorded."""
    first_ns = start_ns = 0
    for envelope in envelopes:
        at_ns = envelope.received_ns or envelope.stamp_ns
        if not first_ns:
            first_ns, start_ns = at_ns, clock_ns()
        wait_ns = (at_ns - first_ns) / speed - (clock_ns() - start_ns)
        if wait_ns > 0:
            sleep(wait_ns * 1e-9)
        yield envelope


def _files(path: Path) -> list[Path]:
    if not path.is_dir():
        return [path]
    files = sorted(path.glob("*.mcap"))
    if not files:
        raise LogError(path, 0, "no .mcap file in this folder")
    return files


def _number(text: str | None) -> int:
    return int(text) if text and text.isdecimal() else 0
