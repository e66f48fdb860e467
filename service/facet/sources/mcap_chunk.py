"""A chunk of an MCAP file: its layout, its records inflated within a bound, and how to find one."""

from __future__ import annotations

import re
import struct
import zlib
from collections.abc import Iterator
from typing import BinaryIO, NamedTuple

import lz4.frame  # type: ignore[import-untyped]
import zstandard

MAX_CHUNK_BYTES = 64 << 20  # inflated; more is a bomb
MAX_RECORD_BYTES = MAX_CHUNK_BYTES + (1 << 20)  # what is read in one piece
HEAD = struct.Struct("<BQ")  # of any record: opcode, length of what follows
HEAD_BYTES = HEAD.size
_FIXED = struct.Struct("<QQQII")  # start, end, inflated size, CRC, length of the compression's name
_WINDOW = 4 << 20  # read at a time when searching
_MAX_TRIES = 20_000  # what only looks like a chunk, and
_MAX_TRIED_BYTES = 4 << 30  # inflated in vain: then a search gives up
# What every chunk has at byte 16: its inflated size, CRC, and one of three names of a compression;
# records that are not compressed take as many bytes as they are said to.
_SIGN = re.compile(
    rb"(?s)(?=(?!\x00{8})(.{3}[\x00-\x04]\x00{4}).{4}"
    rb"(?:\x03\x00{3}lz4|\x04\x00{3}zstd|\x00{4}\1))"
)
_SIGN_AT = 16
_SIGN_BYTES = 24


class Chunk(NamedTuple):
    """A chunk as it lies in the file."""

    size: int  # bytes, inflated
    crc: int  # of the inflated records; 0: none
    compression: str
    start: int  # of the records, from the start of the chunk's content
    num_bytes: int  # of the records as they lie in the file

    @property
    def end(self) -> int:
        """Where its content must end."""
        return self.start + self.num_bytes


def parse_chunk(content: bytes | memoryview) -> Chunk:
    """The layout of a chunk. Raises ValueError where it cannot be one."""
    if len(content) < _FIXED.size:
        raise ValueError(f"{len(content)} bytes are no chunk")
    _start, _end, size, crc, name_bytes = _FIXED.unpack_from(content)
    at = _FIXED.size + name_bytes
    if name_bytes > 32 or at + 8 > len(content):
        raise ValueError("no compression is named")
    compression = bytes(content[_FIXED.size : at]).decode("ascii", "replace")
    (num_bytes,) = struct.unpack_from("<Q", content, at)
    return Chunk(size, crc, compression, at + 8, num_bytes)


def inflate(chunk: Chunk, content: bytes | memoryview, *, must_have_crc: bool = False) -> bytes:
    """The records of a chunk, checked. Raises ValueError on a wrong size or CRC, and for bombs:
    never more than the chunk says it holds (plus a byte) is inflated, nor more than the limit.
    A CRC of 0 is none, unless its writer gives every chunk one."""
    if chunk.size > MAX_CHUNK_BYTES:
        raise ValueError(f"a chunk of {chunk.size} bytes, the limit is {MAX_CHUNK_BYTES}")
    if chunk.end > len(content):
        raise ValueError(f"its records end {chunk.end - len(content)} bytes after it")
    body = content[chunk.start : chunk.end]
    try:
        data = _inflate(chunk.compression, body, chunk.size)
    except (RuntimeError, zstandard.ZstdError, EOFError) as error:
        raise ValueError(f"{chunk.compression}: {error}") from error
    if len(data) != chunk.size:
        raise ValueError(f"{len(data)} bytes where {chunk.size} were declared")
    if (chunk.crc or must_have_crc) and zlib.crc32(data) != chunk.crc:
        raise ValueError("wrong checksum")
    return data


def _inflate(compression: str, body: bytes | memoryview, size: int) -> bytes:
    """At most size + 1 bytes."""
    if compression == "":
        return bytes(body[: size + 1])
    if compression == "lz4":
        return bytes(lz4.frame.LZ4FrameDecompressor().decompress(body, max_length=size + 1))
    if compression == "zstd":
        inflater = zstandard.ZstdDecompressor(max_window_size=MAX_CHUNK_BYTES)
        with inflater.stream_reader(body) as reader:
            return reader.read(size + 1)
    raise ValueError(f"unknown compression {compression!r}")


def is_chunk(content: bytes | memoryview, length: int | None = None) -> bool:
    """Whether it is laid out as a chunk and nothing else; of `length` bytes, when not all of it is
    given."""
    try:
        chunk = parse_chunk(content)
    except ValueError:
        return False
    num_bytes = len(content) if length is None else length
    return chunk.compression in ("", "lz4", "zstd") and chunk.end == num_bytes


def records_of(data: bytes) -> Iterator[tuple[int, int, int]]:
    """(opcode, start, end) of each. Raises ValueError where one does not fit."""
    at, size = 0, len(data)
    while at < size:
        if at + HEAD_BYTES > size:
            raise ValueError("a record is cut off by the end of its chunk")
        opcode, length = HEAD.unpack_from(data, at)
        start, at = at + HEAD_BYTES, at + HEAD_BYTES + length
        if at > size:
            raise ValueError("a record reaches past the end of its chunk")
        yield opcode, start, at


def find_chunk(file: BinaryIO, start: int, end: int) -> tuple[int, Chunk, bytes] | None:
    """The next good chunk in [start, end) wherever it begins, told by its CRC: the offset of its
    content, its layout, its records. None when there is none, or too much that looks like one."""
    num_bytes = 0
    for tries, at in enumerate(_signs(file, start, end)):
        if tries > _MAX_TRIES or num_bytes > _MAX_TRIED_BYTES:
            break
        file.seek(at)
        try:
            chunk = parse_chunk(file.read(_FIXED.size + 40))
            if not chunk.crc or chunk.num_bytes > min(end - at, MAX_RECORD_BYTES):
                continue
            num_bytes += min(chunk.size, MAX_CHUNK_BYTES)
            file.seek(at)
            return at, chunk, inflate(chunk, file.read(chunk.end))
        except ValueError:
            continue
    return None


def _signs(file: BinaryIO, start: int, end: int) -> Iterator[int]:
    """Offsets in [start, end) where the content of a chunk may begin, in order."""
    at = start + _SIGN_AT
    while at + _SIGN_BYTES <= end:
        file.seek(at)
        window = file.read(min(_WINDOW + _SIGN_BYTES, end - at))
        for match in _SIGN.finditer(window):
            yield at + match.start() - _SIGN_AT
        at += max(1, len(window) - _SIGN_BYTES)
