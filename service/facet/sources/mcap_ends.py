"""What an MCAP file says of itself at its two ends: who wrote it, and its summary."""

from __future__ import annotations

import struct
import zlib
from io import BytesIO
from typing import BinaryIO, NamedTuple

from mcap.data_stream import ReadDataStream
from mcap.opcode import Opcode
from mcap.records import Header

from facet.sources.mcap_chunk import HEAD, HEAD_BYTES, MAX_RECORD_BYTES

MAGIC = b"\x89MCAP0\r\n"
_FOOTER = struct.Struct("<BQQQI")  # opcode, length, summary start, offsets start, summary CRC
_MAX_HEADER_BYTES = 1 << 16


class Summary(NamedTuple):
    """What stands at the end of a finished file."""

    start: int
    records: bytes
    is_whole: bool  # its CRC vouches for it


def writer_of(file: BinaryIO) -> str:
    """The library that wrote the file, as its header has it; "" where that cannot be read."""
    file.seek(len(MAGIC))
    head = file.read(HEAD_BYTES)
    opcode, length = HEAD.unpack(head) if len(head) == HEAD_BYTES else (0, 0)
    if opcode != Opcode.HEADER or length > _MAX_HEADER_BYTES:
        return ""
    try:
        return str(Header.read(ReadDataStream(BytesIO(file.read(length)))).library)
    except Exception:  # noqa: BLE001 damaged bytes raise anything: struct, unicode
        return ""


def find_summary(file: BinaryIO, size: int) -> Summary | None:
    """The summary of a file of `size` bytes; None where there is none that has a CRC."""
    at = size - len(MAGIC) - _FOOTER.size
    file.seek(max(0, at))
    footer = file.read(_FOOTER.size)
    if len(footer) < _FOOTER.size or file.read() != MAGIC:
        return None
    opcode, length, start, _, crc = _FOOTER.unpack(footer)
    if (opcode, length) != (Opcode.FOOTER, _FOOTER.size - HEAD_BYTES) or not crc:
        return None
    start = start or at  # no summary: the CRC is that of the footer alone
    if not 0 <= at - start <= MAX_RECORD_BYTES:
        return None
    file.seek(start)
    records = file.read(at - start)
    return Summary(start, records, zlib.crc32(footer[:-4], zlib.crc32(records)) == crc)
