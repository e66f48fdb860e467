"""One MCAP file in file order: every message of every whole chunk, and what is damaged.

Nothing in the file is believed that can be checked: a chunk by its CRC, any other record by what
follows it, the whole by its own statistics. After a record that cannot be read, the next good chunk
is searched for. What is read is held in memory one chunk at a time.
"""

from __future__ import annotations

import struct
import zlib
from collections.abc import Generator, Iterator
from dataclasses import dataclass
from io import BytesIO
from pathlib import Path
from typing import BinaryIO

from mcap.data_stream import ReadDataStream
from mcap.opcode import Opcode
from mcap.records import Channel, DataEnd, Metadata, MetadataIndex, Schema, Statistics

from facet.sources.mcap_chunk import (
    HEAD,
    HEAD_BYTES,
    MAX_RECORD_BYTES,
    find_chunk,
    inflate,
    is_chunk,
    parse_chunk,
    records_of,
)
from facet.sources.mcap_damage import Damage, LogError
from facet.sources.mcap_definitions import Definitions
from facet.sources.mcap_ends import MAGIC, find_summary, writer_of
from facet_protocol.metadata import METADATA_CRC, OWN_METADATA, RECOVERER, WRITER, metadata_crc

_MESSAGE = struct.Struct("<HIQQ")  # channel, sequence, log time, publish time
_INDEX = struct.Struct("<HI")  # of messages: channel, length of the entries
_INDEX_ENTRY_BYTES = 16
_KNOWN = frozenset(int(opcode) for opcode in Opcode)

Reading = Generator["LogMessage", None, int]  # returns the offset at which to go on


@dataclass(frozen=True, slots=True, eq=False)
class LogMessage:
    """One message as the file holds it."""

    channel: Channel
    schema_record: Schema | None
    payload: memoryview
    sequence: int
    log_time_ns: int
    publish_time_ns: int

    @property
    def schema(self) -> str:
        """The name of its schema; "" when the channel has none."""
        return self.schema_record.name if self.schema_record else ""


class McapStream:
    """Reads one file once, front to back, whole or damaged; `damage` is complete afterwards."""

    def __init__(self, path: Path, start: int = 0, known: Definitions | None = None) -> None:
        """From `start`, the offset of a record; what was defined before it is given as `known`."""
        self.path = path
        self.damage = Damage()
        self.metadata: list[Metadata] = []
        self.num_messages = 0
        self.num_chunks = 0
        self.num_unchecked = 0  # messages that no checksum vouches for
        self.is_finished = False  # the footer was there
        self.offset = start  # of the record in progress
        self._start = start
        self._definitions = known or Definitions()
        self._statistics: Statistics | None = None
        self._writer = ""  # as the header says
        self._has_checksums = False  # a chunk has one, or it is a log of Facet's
        self._has_own_metadata = False
        self._num_metadata = 0  # records of it
        self._size = 0
        self._has_lost_chunk = False  # the one just before
        self._search_from = start  # behind the last record whose length is known to be right
        self._crc: int | None = 0  # of the file so far, while it has no chunks, and was all read

    @property
    def definitions(self) -> Definitions:
        """Known so far."""
        return self._definitions

    def messages(self) -> Iterator[LogMessage]:
        """Every message of every whole chunk. Raises LogError when it is no MCAP file at all."""
        self._size = self.path.stat().st_size
        with self.path.open("rb", buffering=1 << 18) as file:
            self._writer = writer_of(file)
            self._read_summary(file)
            at = yield from self._begin(file)
            while at < self._size and not self.is_finished:
                self.offset = at
                at = yield from self._record(file, at)
        if not self.is_finished and not self.damage:
            self.damage.add(self._size, 0, "the file was not finished: it is cut off here")
        self._check_counts()
        self._check_completeness()

    def _begin(self, file: BinaryIO) -> Reading:
        file.seek(0)
        magic = file.read(len(MAGIC))
        if self._start:
            return self._start
        self._crc = zlib.crc32(magic)
        if magic == MAGIC:
            return len(MAGIC)
        if len(magic) < len(MAGIC) and MAGIC.startswith(magic):
            self.damage.add(0, len(magic), "the file is cut off before its first record")
            return self._size
        if find_chunk(file, 0, self._size) is not None:
            return (yield from self._salvage(file, 0, "the first magic is wrong"))
        if any(magic):
            raise LogError(self.path, 0, "this is not an MCAP file")
        self.damage.add(0, self._size, "its beginning was never written")  # in a power cut
        return self._size

    def _record(self, file: BinaryIO, at: int) -> Reading:
        """Read the record at `at`."""
        file.seek(at)
        head = file.read(HEAD_BYTES)
        opcode, length = HEAD.unpack(head) if len(head) == HEAD_BYTES else (0, 0)
        end: int = at + HEAD_BYTES + length
        if not _begins_record(opcode, length) or end > self._size:
            return (yield from self._cut_off(file, at, opcode, length))
        if opcode == Opcode.ATTACHMENT or length > MAX_RECORD_BYTES:
            return (yield from self._skip(file, at, opcode, end))
        content = file.read(length)
        if opcode == Opcode.CHUNK or (opcode != Opcode.MESSAGE and is_chunk(content)):
            return (yield from self._chunk(file, at, opcode, content))
        if not self._is_followed(file, end, opcode):
            reason = f"{_name(opcode)} of {length} bytes, and then no record"
            return (yield from self._salvage(file, at, reason))
        try:
            if opcode == Opcode.MESSAGE:
                yield self._message(content)
            else:
                self._note(opcode, content)
        except Exception as error:  # noqa: BLE001 damaged bytes raise anything: struct, key, unicode
            self.damage.add(at, HEAD_BYTES + length, f"{_name(opcode)} is damaged ({error})")
        if self._crc is not None and opcode != Opcode.DATA_END:
            self._crc = zlib.crc32(content, zlib.crc32(head, self._crc))
        return end

    def _cut_off(self, file: BinaryIO, at: int, opcode: int, length: int) -> Reading:
        """No whole record begins at `at`: a chunk that says itself that it is longer ends the
        file, anything else may be followed by good chunks."""
        rest = self._size - at
        reason = f"the file is cut off, {rest} bytes are no whole record"
        if opcode == Opcode.CHUNK and is_chunk(file.read(64), length):
            self._lose(at, rest, reason)
            return self._size
        return (yield from self._salvage(file, at, reason))

    def _skip(self, file: BinaryIO, at: int, opcode: int, end: int) -> Reading:
        """Go past what is not read."""
        self._crc = None
        if not self._is_followed(file, end, opcode):
            reason = f"{_name(opcode)} of {end - at} bytes, and then no record"
            return (yield from self._salvage(file, at, reason))
        if opcode != Opcode.ATTACHMENT:
            self._lose(at, end - at, f"{_name(opcode)} of {end - at} bytes is too long to be read")
        self._search_from = end
        return end

    def _chunk(self, file: BinaryIO, at: int, opcode: int, content: bytes) -> Reading:
        end = at + HEAD_BYTES + len(content)
        try:
            chunk = parse_chunk(content)
            data = inflate(chunk, content, must_have_crc=self._is_own)
            self._checkrecords_of(data)
        except Exception as error:  # noqa: BLE001 as above
            reason = f"a chunk is damaged ({error})"
            if is_chunk(content) and self._is_followed(file, end, opcode):
                self._lose(at, end - at, reason)
                self._search_from = end
                return end
            return (yield from self._salvage(file, at, reason))
        if opcode != Opcode.CHUNK:
            self.damage.add(at, 0, f"a chunk was marked as {_name(opcode)}")
        yield from self._messages(data, is_checked=bool(chunk.crc) or self._is_own)
        self._search_from = at + HEAD_BYTES + chunk.end
        return end if self._is_followed(file, end, opcode) else self._search_from

    def _salvage(self, file: BinaryIO, at: int, reason: str) -> Reading:
        """Go on at the next good chunk: all before it is lost. A wrong length may have led past
        one: it is searched for from further back."""
        start = self._search_from
        while (found := find_chunk(file, start, self._size)) is not None:
            offset, chunk, data = found
            try:
                self._checkrecords_of(data)
            except Exception:  # noqa: BLE001 as above
                start = offset + 1
                continue
            self._lose(at, max(0, offset - HEAD_BYTES - at), reason)
            yield from self._messages(data, is_checked=True)
            self._search_from = offset + chunk.end
            return self._search_from
        self._lose(at, self._size - at, reason)
        return self._size

    def _lose(self, at: int, num_bytes: int, reason: str) -> None:
        self.damage.add(at, num_bytes, reason)
        self._has_lost_chunk = num_bytes > 0

    def _checkrecords_of(self, data: bytes) -> None:
        """Take the definitions of a chunk. Raises ValueError unless every message can be read."""
        for opcode, start, end in records_of(data):
            if opcode == Opcode.MESSAGE:
                if end - start < _MESSAGE.size:
                    raise ValueError("a message is too short")
                self._definitions.find(_MESSAGE.unpack_from(data, start)[0])
            elif opcode in (Opcode.SCHEMA, Opcode.CHANNEL):
                self._definitions.read(opcode, data[start:end])

    def _messages(self, data: bytes, is_checked: bool) -> Iterator[LogMessage]:
        self.num_chunks += 1
        self._has_checksums |= is_checked
        self._has_lost_chunk = False
        self._crc = None
        view = memoryview(data)
        for opcode, start, end in records_of(data):
            if opcode == Opcode.MESSAGE:
                self.num_messages += 1
                self.num_unchecked += not is_checked
                yield self._parse(view[start:end])

    def _message(self, content: bytes) -> LogMessage:
        """A message outside of chunks."""
        if self.num_chunks or self._is_own:
            raise ValueError("it lies outside of the chunks: no checksum vouches for it")
        message = self._parse(memoryview(content))
        self.num_messages += 1
        self.num_unchecked += 1
        return message

    def _parse(self, content: memoryview) -> LogMessage:
        channel_id, sequence, log_time, publish_time = _MESSAGE.unpack_from(content)
        channel, schema = self._definitions.find(channel_id)
        payload = content[_MESSAGE.size :]
        return LogMessage(channel, schema, payload, sequence, log_time, publish_time)

    def _note(self, opcode: int, content: bytes) -> None:
        """Everything that is no message: schemas, channels, metadata, the summary."""
        stream = ReadDataStream(BytesIO(content))
        if opcode in (Opcode.SCHEMA, Opcode.CHANNEL):
            self._definitions.read(opcode, content)
        elif opcode == Opcode.METADATA:
            self._note_metadata(Metadata.read(stream), len(content))
        elif opcode == Opcode.MESSAGE_INDEX:
            self._note_index(content)
        elif opcode == Opcode.STATISTICS:
            self._statistics = Statistics.read(stream)
        elif opcode == Opcode.DATA_END:
            self._check_data(DataEnd.read(stream).data_section_crc)
        elif opcode == Opcode.FOOTER:
            self.is_finished = True
        elif opcode < 0x80 and opcode not in _KNOWN:
            raise ValueError("unknown record")  # the specification leaves 0x80 up to others

    def _note_metadata(self, metadata: Metadata, num_bytes: int) -> None:
        self._definitions.make_room(num_bytes)
        is_signed = metadata.metadata.get(METADATA_CRC) == metadata_crc(metadata.metadata)
        if is_signed != (metadata.name == OWN_METADATA):
            raise ValueError("wrong checksum" if not is_signed else "wrong name")
        if is_signed:
            del metadata.metadata[METADATA_CRC]
            self._has_own_metadata = self._has_checksums = True
        self._num_metadata += 1
        self.metadata.append(metadata)

    def _note_index(self, content: bytes) -> None:
        """How many messages a chunk held: of a lost one, that many are lost."""
        _channel, num_bytes = _INDEX.unpack_from(content)
        if num_bytes % _INDEX_ENTRY_BYTES or _INDEX.size + num_bytes > len(content):
            raise ValueError(f"{num_bytes} bytes of entries in {len(content)}")
        if self._has_lost_chunk:
            self.damage.lost_messages += num_bytes // _INDEX_ENTRY_BYTES

    def _check_data(self, crc: int) -> None:
        if crc and self._crc is not None and not self._start and not self.damage:
            if crc != self._crc:
                text = "the checksum of all messages is wrong: one is not as it was written"
                self.damage.doubt(0, text)
            else:
                self.num_unchecked = 0

    def _is_followed(self, file: BinaryIO, end: int, opcode: int) -> bool:
        """Whether what comes next is a record, or the end where there may be one."""
        file.seek(end)
        if opcode == Opcode.FOOTER:
            return file.read(len(MAGIC) + 1) == MAGIC
        head = file.read(HEAD_BYTES)
        return len(head) < HEAD_BYTES or _begins_record(*HEAD.unpack(head))

    def _read_summary(self, file: BinaryIO) -> None:
        """What a finished file says at its end, if its CRC vouches for that: definitions that a
        lost chunk would take with it, and counts."""
        summary = find_summary(file, self._size)
        if summary is None:
            return
        if not summary.is_whole:
            self.damage.add(summary.start, 0, "the summary is damaged (wrong checksum)")
            return
        try:
            self._note_summary(summary.records)
        except Exception as error:  # noqa: BLE001 as above
            self.damage.add(summary.start, 0, f"the summary is damaged ({error})")

    def _note_summary(self, summary: bytes) -> None:
        for opcode, start, end in records_of(summary):
            if opcode in (Opcode.SCHEMA, Opcode.CHANNEL):
                self._definitions.read(opcode, summary[start:end])
            elif opcode == Opcode.STATISTICS:
                self._statistics = Statistics.read(ReadDataStream(BytesIO(summary[start:end])))
            elif opcode == Opcode.METADATA_INDEX:
                index = MetadataIndex.read(ReadDataStream(BytesIO(summary[start:end])))
                self._has_checksums |= index.name == OWN_METADATA

    @property
    def _is_own(self) -> bool:
        return self._writer in (WRITER, RECOVERER)

    def _check_completeness(self) -> None:
        """What a writer always gives, and what is missing here, was lost."""
        if self.num_unchecked and self._has_checksums:
            text = f"{self.num_unchecked} messages have lost their checksum: they may be wrong"
            self.damage.doubt(0, text)
        is_read = self.num_messages and not self._start
        if is_read and self._writer == WRITER and not self._has_own_metadata:
            self.damage.doubt(0, "its settings are lost")

    def _check_counts(self) -> None:
        """Holds what was read against what the file says it holds."""
        statistics = self._statistics
        if statistics is None or self._start:
            return
        missing = statistics.message_count - self.num_messages
        if missing > 0:
            self.damage.lost_messages = missing
            self.damage.add(self._size, 0, f"{missing} messages that were written are missing")
        elif missing < 0:
            text = f"{-missing} messages more than were written: which ones cannot be told"
            self.damage.doubt(self._size, text)
        if statistics.chunk_count != self.num_chunks:
            text = f"{self.num_chunks} chunks of {statistics.chunk_count} that were written"
            self.damage.add(self._size, 0, text)
        if statistics.metadata_count != self._num_metadata:
            what = f"of {statistics.metadata_count} that were written"
            self.damage.doubt(self._size, f"{self._num_metadata} records of metadata {what}")


def _begins_record(opcode: int, length: int) -> bool:
    return (opcode in _KNOWN or opcode >= 0x80) and length < 1 << 40


def _name(opcode: int) -> str:
    try:
        return Opcode(opcode).name.lower()
    except ValueError:
        return f"record 0x{opcode:02x}"
