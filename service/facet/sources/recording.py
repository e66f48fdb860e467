"""Recordings as a source: envelopes in file order, whole files or cut off, paced or flat out."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator, Sequence
from functools import lru_cache
from pathlib import Path

from facet.sources.dialects import Dialects
from facet.sources.mcap_damage import Damage, LogError
from facet.sources.mcap_stream import LogMessage, McapStream
from facet.sources.naming import is_input
from facet_protocol import topics
from facet_protocol.messages import Envelope

_U32 = re.compile(r"[0-9]{1,10}")


class Recording:
    """The messages of one or more MCAP files, in the order given. Iterate it once."""

    def __init__(
        self,
        paths: Sequence[Path],
        dialects: Dialects | None = None,
        on_message: Callable[[McapStream, Envelope], object] = lambda stream, envelope: None,
    ) -> None:
        """`dialects`: with rules for topics that do not say what they are. `on_message` is told
        where each message is read."""
        self._dialects, self._on_message = dialects or Dialects(), on_message
        self.paths = [file for path in paths for file in _files(path)]
        self.damage: dict[Path, Damage] = {}
        self.metadata: dict[str, dict[str, str]] = {}  # of the file being read, by name
        self.num_unchecked = 0  # messages, of the files read so far, that no checksum vouches for
        self.num_bytes = sum(path.stat().st_size for path in self.paths)

    def __iter__(self) -> Iterator[Envelope]:
        for path in self.paths:
            stream = McapStream(path)
            self.damage[path], self.metadata = stream.damage, {}
            for message in stream.messages():
                if stream.metadata:
                    self.metadata.update((m.name, m.metadata) for m in stream.metadata)
                    stream.metadata.clear()
                envelope = envelope_of(message, self._dialects, is_own="facet" in self.metadata)
                self._on_message(stream, envelope)
                yield envelope
            self.metadata.update((m.name, m.metadata) for m in stream.metadata)
            self.num_unchecked += stream.num_unchecked

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


def envelope_of(
    message: LogMessage, dialects: Dialects | None = None, *, is_own: bool = True
) -> Envelope:
    """The message as it travelled; the epoch, and what MCAP's 32 bits lack, are the channel's.

    `is_own`: Facet wrote the file, and so its transforms.
    """
    channel, metadata = message.channel, message.channel.metadata
    schema, encoding, rule = message.schema, channel.message_encoding, None
    found = (dialects or Dialects()).recognise_channel(channel.topic, schema, encoding)
    if found is not None:
        schema, encoding, rule = found.schema, found.encoding, found.rule
    is_drawn = channel.topic == topics.TF_TOPIC and encoding == "protobuf"
    return Envelope(
        key=channel.topic,
        schema=schema,
        encoding=encoding,
        payload=message.payload,
        stamp_ns=message.publish_time_ns,
        epoch=_number(metadata.get("epoch")),
        sequence=message.sequence + (_number(metadata.get("sequence_high")) << 32),
        received_ns=message.log_time_ns,
        rule=rule,
        is_derived=is_own and is_drawn,
    )


def is_replayed(envelope: Envelope) -> bool:
    """Whether replay reads it: scans, poses, cuts and losses; the rest was derived from them."""
    return is_input(envelope) or envelope.key in _READ


_READ = (
    *(topics.CUT_TOPIC, topics.LOSS_TOPIC, topics.RESOLVED_TOPIC),
    *(topics.CORRECTED_TOPIC, topics.CONFLICT_TOPIC),
)


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
        raise LogError(path, None, "no .mcap file in this folder")
    return files


@lru_cache(maxsize=1024)  # asked with each message, of few channels
def _number(text: str | None) -> int:
    """A number of 32 bits; 0 for anything else that a channel of another's may say."""
    number = int(text) if text is not None and _U32.fullmatch(text) else 0
    return number if number < 1 << 32 else 0
