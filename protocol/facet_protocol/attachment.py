"""What travels beside a message on Zenoh: epoch, sequence, stamp. A loss shows as a gap.

Ours are 24 bytes. ROS 2 over rmw_zenoh has its own, in several layouts.
"""

from __future__ import annotations

import re
import struct
import zlib
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


_ROS = re.compile(  # with names in some releases, without in others; the length of the gid likewise
    rb"(?:\x0fsequence_number)?(?P<sequence>.{8})(?:\x10source_timestamp)?(?P<stamp>.{8})"
    rb"(?:\x0asource_gid)?\x10?(?P<gid>.{16})",
    re.DOTALL,
)


def unpack_ros(data: bytes) -> Attachment:
    """What rmw_zenoh sends beside a message; the epoch is made of the publisher's id.

    Raises ProtocolError when the bytes are in none of the layouts that are known.
    """
    match = _ROS.fullmatch(data)
    if match is None:
        raise ProtocolError(f"attachment of {len(data)} bytes is not rmw_zenoh's", "bad_attachment")
    (sequence,) = struct.unpack("<q", match["sequence"])
    (stamp_ns,) = struct.unpack("<q", match["stamp"])
    if sequence < 0:
        raise ProtocolError(f"sequence number {sequence} is below 0", "bad_attachment")
    return Attachment(zlib.crc32(match["gid"]) or 1, sequence, stamp_ns)
