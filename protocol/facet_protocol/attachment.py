"""The 24 bytes beside every scan on Zenoh: magic, epoch, sequence, stamp. A loss shows as a gap."""

from __future__ import annotations

import struct
from dataclasses import dataclass

from facet_protocol.messages import ProtocolError

MAGIC = b"FCT1"
SIZE = 24
_LAYOUT = struct.Struct("<4sIQq")


@dataclass(frozen=True, slots=True)
class Attachment:
    epoch: int  # a new one at each start of the publisher, u32
    sequence: int  # from 1, u64; 0 means none
    stamp_ns: int  # the source's stamp, i64 ns since the Unix epoch


def pack(epoch: int, sequence: int, stamp_ns: int) -> bytes:
    """24 bytes, little-endian. Raises ProtocolError when a value does not fit its field."""
    try:
        return _LAYOUT.pack(MAGIC, epoch, sequence, stamp_ns)
    except struct.error as error:
        text = f"attachment ({epoch}, {sequence}, {stamp_ns}) does not fit u32, u64, i64"
        raise ProtocolError(text, "bad_attachment") from error


def unpack(data: bytes | memoryview) -> Attachment:
    """The attachment in exactly 24 bytes. Raises ProtocolError on anything else."""
    if len(data) != SIZE:
        raise ProtocolError(f"attachment of {len(data)} bytes, expected {SIZE}", "bad_attachment")
    magic, epoch, sequence, stamp_ns = _LAYOUT.unpack(data)
    if magic != MAGIC:
        raise ProtocolError(f"attachment starts {magic!r}, expected {MAGIC!r}", "bad_attachment")
    return Attachment(epoch, sequence, stamp_ns)
