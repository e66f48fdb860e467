"""Scans of the log, read again: where they lie, by sensor, epoch and sequence."""

from __future__ import annotations

import json
import os
import threading
from array import array
from collections import defaultdict
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import Future
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from facet.sinks.log_file import ChannelName, channel_metadata, schema_text
from facet.sources.dialects import Dialects
from facet.sources.mcap_damage import LogError
from facet.sources.mcap_definitions import Definitions, defined
from facet.sources.mcap_ends import MAGIC
from facet.sources.mcap_stream import McapStream
from facet.sources.naming import is_scan, source_of
from facet.sources.recording import envelope_of
from facet_protocol.messages import Envelope, ProtocolError

SEGMENT_BYTES = 8 << 20  # of the log: what is read to find one scan
MAX_BYTES = 256 << 20  # of scans that are read at once
MAX_SENSORS = 1 << 16  # with their epochs: scans of more are not found again
Known = Callable[[], Definitions]


class Number(NamedTuple):
    """What a scan is known by."""

    source: str
    epoch: int
    sequence: int


Found = dict[Number, list[Envelope]]  # in the order of the log: a bad one may come first


class Part(NamedTuple):
    """A part of one file: whole records."""

    path: Path
    start: int
    end: int


class Past:
    """Keeps, for every few megabytes of log, the range of sequences of each sensor in it. `note`,
    `define`, `read` and `freeze` may be called on any thread."""

    def __init__(
        self, dialects: Dialects | None = None, *, segment_bytes: int = SEGMENT_BYTES,
        max_bytes: int = MAX_BYTES,
    ) -> None:  # fmt: skip
        self._dialects = dialects or Dialects()
        self._segment_bytes, self._max_bytes = segment_bytes, max_bytes
        self._files: list[Path] = []
        self._segments = array("q")  # file, start, end; three a segment
        self._ranges: dict[tuple[str, int], array[int]] = {}  # segment, first, last sequence
        self._known: dict[Path, Known] = {}
        self._lock = threading.Lock()
        self._closed = threading.Event()

    def note(self, path: Path, start: int, end: int, envelopes: Iterable[Envelope]) -> None:
        """The scans among the envelopes lie there in a file."""
        with self._lock:
            segment = self._segment(path, start, end)
            for envelope in envelopes:
                if envelope.sequence and is_scan(envelope):
                    self._widen((source_of(envelope), envelope.epoch), segment, envelope.sequence)

    def note_read(self, stream: McapStream, envelope: Envelope) -> None:
        """The message that a stream has just read."""
        if envelope.sequence and is_scan(envelope):
            with self._lock:
                segment = self._segment(stream.path, stream.offset, stream.offset + 1)
                self._widen((source_of(envelope), envelope.epoch), segment, envelope.sequence)
                self._known[stream.path] = stream.definitions.copy

    def define(self, path: Path, known: Known) -> None:
        """What was defined in a file, for one that has not yet said so at its end."""
        with self._lock:
            self._known[path] = known

    def read(self, wanted: Sequence[Number]) -> Found:
        """All that has one of the numbers. Raises OSError, and ProtocolError for too much."""
        found: Found = defaultdict(list)
        sequences, numbers = {number.sequence for number in wanted}, set(wanted)
        num_bytes = 0
        for part in self._parts(wanted):
            for envelope in self._scans(part, sequences):
                number = Number(source_of(envelope), envelope.epoch, envelope.sequence)
                if number not in numbers:
                    continue
                num_bytes += len(envelope.payload)
                if num_bytes > self._max_bytes:
                    text = f"the scans take more than {self._max_bytes >> 20} MiB: correct fewer"
                    raise ProtocolError(text, "too_large")
                found[number].append(envelope)
        return found

    def close(self) -> None:
        """Whoever reads, stops."""
        self._closed.set()

    def freeze(self) -> dict[str, NDArray[Any]]:
        """Where everything lies, for a checkpoint: files by name."""
        with self._lock:
            names = [[source, epoch, len(r) // 3] for (source, epoch), r in self._ranges.items()]
            text = {"files": [path.name for path in self._files], "sensors": names}
            rows = [np.array(r, np.int64) for r in self._ranges.values()]
            none = np.zeros(0, np.int64)
            return {
                "past": np.frombuffer(json.dumps(text).encode(), np.uint8),
                "past_segments": np.array(self._segments, np.int64).reshape(-1, 3),
                "past_ranges": np.concatenate([none, *rows]).reshape(-1, 3),
            }

    def thaw(self, frozen: Mapping[str, NDArray[Any]], directory: Path) -> None:
        """Know what was frozen. Raises KeyError, TypeError, ValueError for anything else."""
        text = json.loads(frozen["past"].tobytes())
        segments = np.asarray(frozen["past_segments"], np.int64)
        ranges = np.asarray(frozen["past_ranges"], np.int64)
        num = sum(n for _, _, n in text["sensors"])
        if segments.shape[1:] != (3,) or ranges.shape != (num, 3):
            raise ValueError(f"{num} ranges in {ranges.shape}, {segments.shape}")
        self._files = [directory / str(name) for name in text["files"]]
        self._segments = array("q", segments.reshape(-1).tolist())
        at = 0
        for source, epoch, n in text["sensors"]:
            kept = ranges[at : at + n].reshape(-1).tolist()
            self._ranges[str(source), int(epoch)] = array("q", kept)
            at += n

    def _segment(self, path: Path, start: int, end: int) -> int:
        """The number of the segment that now reaches to `end`."""
        last = self._files[-1] if self._files else None
        if last is not path and last != path:  # most are the very same: a path takes its time
            self._files.append(path)
        file, at = len(self._files) - 1, len(self._segments) - 3
        if at >= 0 and self._segments[at] == file:
            first = self._segments[at + 1]
            if first <= start < first + self._segment_bytes:
                self._segments[at + 2] = max(end, self._segments[at + 2])
                return at // 3
        self._segments.extend((file, start, end))
        return len(self._segments) // 3 - 1

    def _widen(self, name: tuple[str, int], segment: int, sequence: int) -> None:
        if sequence >= 1 << 63:
            return
        ranges = self._ranges.get(name)
        if ranges is None:
            if len(self._ranges) >= MAX_SENSORS:
                return
            ranges = self._ranges[name] = array("q")
        if ranges and ranges[-3] == segment:
            if sequence < ranges[-2]:
                ranges[-2] = sequence
            elif sequence > ranges[-1]:
                ranges[-1] = sequence
        else:
            ranges.extend((segment, sequence, sequence))

    def _parts(self, wanted: Sequence[Number]) -> list[Part]:
        """Where the numbers may lie, in the order of the log."""
        by_name: defaultdict[tuple[str, int], list[int]] = defaultdict(list)
        for number in wanted:
            by_name[number.source, number.epoch].append(number.sequence)
        chosen: set[int] = set()
        with self._lock:
            for name, sequences in by_name.items():
                ranges = np.array(self._ranges.get(name, ()), np.int64).reshape(-1, 3)
                ordered = np.sort(np.array(sequences, np.uint64)).astype(np.int64)
                first = np.searchsorted(ordered, ranges[:, 1])
                last = np.searchsorted(ordered, ranges[:, 2], side="right")
                chosen.update(ranges[first < last, 0].tolist())
            rows = np.array(self._segments, np.int64).reshape(-1, 3)[sorted(chosen)].tolist()
            return [Part(self._files[file], start, end) for file, start, end in rows]

    def _scans(self, part: Part, sequences: set[int]) -> Iterator[Envelope]:
        """Scans of a part that have one of the sequences, whoever sent them; copied."""
        with self._lock:
            known = self._known.get(part.path)
        start = part.start if known is not None or _is_finished(part.path) else 0
        stream = McapStream(part.path, start, known() if known is not None else None)
        try:
            for message in stream.messages():
                if self._closed.is_set():
                    raise OSError("the service stops")
                if stream.offset >= part.end:
                    return
                if stream.offset < part.start:
                    continue
                envelope = envelope_of(message, self._dialects)
                if envelope.sequence in sequences and is_scan(envelope):
                    yield envelope.owned()
        except LogError as error:
            raise OSError(str(error)) from error


def at_once(past: Past) -> Callable[[Sequence[Number]], Future[Found]]:
    """Asks on the same thread."""

    def ask(wanted: Sequence[Number]) -> Future[Found]:
        answer: Future[Found] = Future()
        try:
            answer.set_result(past.read(wanted))
        except (OSError, ProtocolError) as error:
            answer.set_exception(error)
        return answer

    return ask


def definitions_of(channels: Sequence[ChannelName]) -> Definitions:
    """What a log of ours defines, by its channels."""
    return defined(
        (topic, encoding, channel_metadata(name), schema, *schema_text(schema))
        for name in channels
        for topic, schema, encoding, _epoch, _high in [name]
    )


def _is_finished(path: Path) -> bool:
    """Whether the file has an end, where all that it defines stands once more."""
    with path.open("rb") as file:
        file.seek(max(0, os.fstat(file.fileno()).st_size - len(MAGIC)))
        return file.read() == MAGIC
