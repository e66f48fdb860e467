"""One MCAP file in file order: every message of every whole chunk, and what is damaged."""

from __future__ import annotations

import struct
import zlib
from collections.abc import Iterator
from dataclasses import dataclass, field
from io import BytesIO
from pathlib import Path
from typing import BinaryIO

import lz4.frame  # type: ignore[import-untyped]
import zstandard
from mcap.data_stream import ReadDataStream
from mcap.opcode import Opcode
from mcap.records import Channel, Metadata, Schema, Statistics

MAGIC = b"\x89MCAP0\r\n"
MAX_CHUNK_BYTES = 64 << 20  # decompressed; more is a bomb
_HEAD = struct.Struct("<BQ")  # opcode, length of what follows
_MESSAGE = struct.Struct("<HIQQ")  # channel, sequence, log time, publish time
_CHUNK = struct.Struct("<QQQI")  # start, end, uncompressed size, uncompressed CRC


class LogError(ValueError):
    """A log that cannot be read: which file, at which byte, and why."""

    def __init__(self, path: Path, offset: int, reason: str) -> None:
        super().__init__(f"{path}: byte {offset}: {reason}")
        self.path, self.offset, self.reason = path, offset, reason


@dataclass(frozen=True, slots=True, eq=False)
class LogMessage:
    """One message as the file holds it."""

    channel: Channel
    schema: str  # name; "" when the channel has none
    payload: memoryview
    sequence: int
    log_time_ns: int
    publish_time_ns: int


@dataclass(slots=True)
class Damage:
    """What a file has lost: empty when it is whole."""

    notes: list[str] = field(default_factory=list)
    lost_messages: int = 0  # known from the file's own statistics
    lost_bytes: int = 0

    def add(self, offset: int, num_bytes: int, reason: str) -> None:
        self.notes.append(f"byte {offset}: {reason}")
        self.lost_bytes += num_bytes

    def __bool__(self) -> bool:
        return bool(self.notes)


class McapStream:
    """Reads one file once, front to back, whole or cut off; `damage` is complete afterwards."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self.damage = Damage()
        self.metadata: list[Metadata] = []
        self.num_messages = 0
        self.num_chunks = 0
        self.is_finished = False  # the footer was there
        self._schemas: dict[int, Schema] = {}
        self._channels: dict[int, Channel] = {}
        self._statistics: Statistics | None = None
        self._size = 0

    def messages(self) -> Iterator[LogMessage]:
        """Every message of every whole chunk. Raises LogError when it is no MCAP file at all."""
        self._size = self.path.stat().st_size
        with self.path.open("rb") as file:
            if file.read(len(MAGIC)) != MAGIC:
                raise LogError(self.path, 0, "this is not an MCAP file")
            while not self.is_finished:
                record = self._next_record(file)
                if record is None:
                    break
                yield from self._read(*record)
            if self.is_finished and file.read(len(MAGIC)) != MAGIC:
                self.damage.add(file.tell(), 0, "the last magic is missing")
        self._check_counts()

    def _next_record(self, file: BinaryIO) -> tuple[int, int, bytes] | None:
        """(offset, opcode, content) of the next record; None at the end of what can be read."""
        offset = file.tell()
        head = file.read(_HEAD.size)
        if len(head) == _HEAD.size:
            opcode, length = _HEAD.unpack(head)
            if length <= self._size - offset - _HEAD.size and opcode != 0:
                return offset, opcode, file.read(length)
        rest = self._size - offset
        self.damage.add(offset, rest, f"the file is cut off, {rest} bytes are no whole record")
        return None

    def _read(self, offset: int, opcode: int, content: bytes) -> Iterator[LogMessage]:
        try:
            if opcode == Opcode.CHUNK:
                yield from self._chunk(content)
            elif opcode == Opcode.MESSAGE:
                yield self._message(memoryview(content))
            else:
                self._note(opcode, content)
        except Exception as error:  # noqa: BLE001 damaged bytes raise anything: struct, key, lz4, zstd
            self.damage.add(offset, len(content), f"{_name(opcode)} is damaged ({error})")

    def _note(self, opcode: int, content: bytes) -> None:
        """Everything that is no message: schemas, channels, metadata, the summary."""
        stream = ReadDataStream(BytesIO(content))
        if opcode == Opcode.SCHEMA:
            schema = Schema.read(stream)
            self._schemas[schema.id] = schema
        elif opcode == Opcode.CHANNEL:
            channel = Channel.read(stream)
            self._channels[channel.id] = channel
        elif opcode == Opcode.METADATA:
            self.metadata.append(Metadata.read(stream))
        elif opcode == Opcode.STATISTICS:
            self._statistics = Statistics.read(stream)
        elif opcode == Opcode.FOOTER:
            self.is_finished = True
        elif opcode < 0x80 and opcode not in set(Opcode):
            raise ValueError("unknown record")  # the specification leaves 0x80 up to others

    def _chunk(self, content: bytes) -> Iterator[LogMessage]:
        data = memoryview(_decompress(content))
        messages: list[LogMessage] = []  # of a chunk, all or nothing
        at = 0
        while at < len(data):
            opcode, length = _HEAD.unpack_from(data, at)
            start, at = at + _HEAD.size, at + _HEAD.size + length
            if at > len(data):
                raise ValueError("a record reaches past the end of its chunk")
            if opcode == Opcode.MESSAGE:
                messages.append(self._parse_message(data[start:at]))
            else:
                self._note(opcode, bytes(data[start:at]))
        self.num_chunks += 1
        self.num_messages += len(messages)
        yield from messages

    def _message(self, content: memoryview) -> LogMessage:
        message = self._parse_message(content)
        self.num_messages += 1
        return message

    def _parse_message(self, content: memoryview) -> LogMessage:
        channel_id, sequence, log_time, publish_time = _MESSAGE.unpack_from(content)
        channel = self._channels.get(channel_id)
        if channel is None:
            raise ValueError(f"no channel {channel_id}")
        schema = self._schemas[channel.schema_id].name if channel.schema_id else ""
        payload = content[_MESSAGE.size :]
        return LogMessage(channel, schema, payload, sequence, log_time, publish_time)

    def _check_counts(self) -> None:
        """Holds what was read against what the file says it holds."""
        if self._statistics is None:
            return
        missing = self._statistics.message_count - self.num_messages
        if missing > 0:
            self.damage.lost_messages = missing
            self.damage.add(self._size, 0, f"{missing} messages that were written are missing")


def _decompress(content: bytes) -> bytes:
    """The records of a chunk, checked. Raises ValueError on a wrong size or CRC."""
    _start, _end, size, crc = _CHUNK.unpack_from(content)
    at = _CHUNK.size
    (length,) = struct.unpack_from("<I", content, at)
    compression = content[at + 4 : at + 4 + length].decode()
    at += 4 + length
    (num_bytes,) = struct.unpack_from("<Q", content, at)
    body = content[at + 8 : at + 8 + num_bytes]
    if size > MAX_CHUNK_BYTES:
        raise ValueError(f"a chunk of {size} bytes, the limit is {MAX_CHUNK_BYTES}")
    data = _inflate(compression, body, size)
    if len(data) != size:
        raise ValueError(f"{len(data)} bytes where {size} were declared")
    if crc and zlib.crc32(data) != crc:
        raise ValueError("wrong checksum")
    return data


def _inflate(compression: str, body: bytes, size: int) -> bytes:
    """At most size + 1 bytes: a chunk that declares less than it holds is caught, not inflated."""
    if compression == "":
        return body
    if compression == "lz4":
        return bytes(lz4.frame.LZ4FrameDecompressor().decompress(body, max_length=size + 1))
    if compression == "zstd":
        with zstandard.ZstdDecompressor().stream_reader(body) as reader:
            return reader.read(size + 1)
    raise ValueError(f"unknown compression {compression!r}")


def _name(opcode: int) -> str:
    try:
        return Opcode(opcode).name.lower()
    except ValueError:
        return f"record 0x{opcode:02x}"
