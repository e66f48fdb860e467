"""Protobuf at the byte level: parsing that fails with ProtocolError alone, zero-copy fields."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from typing import TypeVar

import numpy as np
from google.protobuf.message import DecodeError, Message
from google.protobuf.timestamp_pb2 import Timestamp
from numpy.typing import NDArray

from facet_protocol.messages import Pose, ProtocolError

M = TypeVar("M", bound=Message)

MAX_TOP_FIELDS = 512  # more top-level fields than any message of ours has: a bound on the walk
NORM_TOLERANCE = 1e-3  # a quaternion further off is refused: 1 % is 20 cm at 10 m
_EXACT_NORM = 4e-15  # within rounding of 1: kept, so that encode(decode(x)) keeps its bits

_VARINT, _FIXED64, _BYTES, _FIXED32 = 0, 1, 2, 5


def parse(message_type: type[M], payload: bytes | memoryview) -> M:
    """The message in `payload`. An empty payload would parse as an empty message: refused."""
    name = message_type.DESCRIPTOR.full_name
    if len(payload) == 0:
        raise ProtocolError(f"{name}: empty payload")
    try:
        return message_type.FromString(payload)  # type: ignore[arg-type]  # takes buffers too
    except DecodeError as error:
        raise ProtocolError(f"{name}: {error} ({len(payload)} bytes)") from error


def _varint(data: memoryview, position: int) -> tuple[int, int]:
    if position < len(data) and data[position] < 0x80:  # as most are
        return data[position], position + 1
    value = 0
    for shift in range(0, 70, 7):
        if position >= len(data):
            raise ProtocolError(f"varint cut off at byte {position} of {len(data)}")
        byte = data[position]
        position += 1
        value |= (byte & 0x7F) << shift
        if byte < 0x80:
            return value, position
    raise ProtocolError(f"varint longer than 10 bytes before byte {position}")


def _skip(data: memoryview, position: int, wire_type: int) -> int:
    """Position after a value that starts at `position`."""
    if wire_type == _BYTES:
        length, position = _varint(data, position)
        return position + length
    if wire_type == _VARINT:
        return _varint(data, position)[1]
    if wire_type == _FIXED64:
        return position + 8
    if wire_type == _FIXED32:
        return position + 4
    raise ProtocolError(f"wire type {wire_type} at byte {position}")


def _top_fields(data: memoryview) -> list[tuple[int, int, int, int]]:
    """(start, tag, begin, end) of each top-level field: its value, with its length, is in
    [begin, end)."""
    fields: list[tuple[int, int, int, int]] = []
    position, size = 0, len(data)
    while position < size:
        if len(fields) == MAX_TOP_FIELDS:
            raise ProtocolError(f"more than {MAX_TOP_FIELDS} fields")
        start, tag, begin = position, data[position], position + 1
        if tag >= 0x80:
            tag, begin = _varint(data, position)
        position = begin + 8 if tag & 7 == _FIXED64 else _skip(data, begin, tag & 7)
        if position > size:
            raise ProtocolError(f"field {tag >> 3} ends at byte {position} of {size}")
        fields.append((start, tag, begin, position))
    return fields


def split_bytes_field(
    message_type: type[M], payload: bytes | memoryview, number: int
) -> tuple[M, memoryview]:
    """The message without bytes field `number`, and a view of that field's bytes in `payload`.

    Walks the top-level fields only; nothing of the field is copied. The last occurrence counts.
    """
    data = memoryview(payload).cast("B")
    field = memoryview(b"")
    rest: list[memoryview] = []
    for start, tag, begin, end in _top_fields(data):
        if tag == (number << 3) | _BYTES:
            field = data[_varint(data, begin)[1] : end]
        else:
            rest.append(data[start:end])
    return parse(message_type, b"".join(rest)), field


def split_doubles_field(
    message_type: type[M], payload: bytes | memoryview, number: int
) -> tuple[M, NDArray[np.float64] | None]:
    """Likewise without the repeated field `number` of doubles, and a view of these (N,), packed as
    they are; None where they lie apart, or the walk ends before the payload: then all is in the
    message."""
    data, packed = memoryview(payload).cast("B"), (number << 3) | _BYTES
    try:
        found = [field for field in _top_fields(data) if field[1] >> 3 == number]
    except ProtocolError:  # it may be right all the same
        return parse(message_type, payload), None
    if len(found) != 1 or found[0][1] != packed:
        return parse(message_type, payload), None
    start, _, begin, end = found[0]
    field = data[_varint(data, begin)[1] : end]
    if len(field) % 8:
        raise ProtocolError(f"field {number}: {len(field)} bytes are no doubles")
    rest = b"".join((data[:start], data[end:])) or payload
    return parse(message_type, rest), np.frombuffer(field, "<f8")


def unwrap(payload: bytes | memoryview, number: int) -> memoryview:
    """A view of bytes field `number` of any protobuf message: what an envelope holds."""
    data = memoryview(payload).cast("B")
    found: memoryview | None = None
    for _, tag, begin, end in _top_fields(data):
        if tag == (number << 3) | _BYTES:
            found = data[_varint(data, begin)[1] : end]
    if found is None:
        raise ProtocolError(f"no field {number} in an envelope of {len(data)} bytes")
    return found


def finite(values: Iterable[float], num: int, name: str) -> NDArray[np.float64]:
    """(num,) float64. Raises ProtocolError when there are not `num`, or one is not finite."""
    array = np.array(list(values), dtype=np.float64)
    if array.size != num:
        raise ProtocolError(f"{name}: {array.size} numbers, expected {num}")
    if not all(map(math.isfinite, array.tolist())):
        raise ProtocolError(f"{name}: {array.tolist()} is not finite")
    return array


def check_pose(position: Iterable[float], orientation_xyzw: Iterable[float]) -> tuple[Pose, bool]:
    """A pose with a unit quaternion, and whether it had to be renormalised by more than 1e-9.

    Raises ProtocolError: bad_pose when something is not finite, bad_quaternion when the norm is off
    by more than NORM_TOLERANCE. By + * / sqrt alone: the same bits on every machine.
    """
    p, q = [*map(float, position)], [*map(float, orientation_xyzw)]
    if len(p) != 3 or len(q) != 4:
        raise ProtocolError(f"pose of {len(p)} + {len(q)} numbers, expected 3 + 4", "bad_pose")
    if not all(map(math.isfinite, (*p, *q))):
        raise ProtocolError(f"pose {p} {q} is not finite", "bad_pose")
    norm = math.sqrt(q[0] * q[0] + q[1] * q[1] + q[2] * q[2] + q[3] * q[3])
    if not abs(norm - 1.0) <= NORM_TOLERANCE:
        raise ProtocolError(f"quaternion {q} has norm {norm:.6g}", "bad_quaternion")
    return Pose(np.array(p), np.array(normalised(q))), abs(norm - 1.0) > 1e-9


def normalised(q: Sequence[float]) -> list[float]:
    """The quaternion over its norm; one that is a unit within rounding keeps its bits."""
    square = q[0] * q[0] + q[1] * q[1] + q[2] * q[2] + q[3] * q[3]
    if abs(square - 1.0) <= _EXACT_NORM:
        return list(q)
    norm = math.sqrt(square)
    return [c / norm for c in q]


def stamp_of(timestamp: Timestamp) -> int:
    """int64 ns since the Unix epoch. Raises ProtocolError (bad_stamp) when it is not one."""
    return stamp_of_parts(timestamp.seconds, timestamp.nanos)


def stamp_of_parts(seconds: int, nanos: int) -> int:
    """int64 ns since the Unix epoch. Raises ProtocolError (bad_stamp) when it is not one."""
    if not 0 <= nanos < 1_000_000_000:
        raise ProtocolError(f"stamp has {nanos} nanoseconds", "bad_stamp")
    stamp_ns = seconds * 1_000_000_000 + nanos
    if not -(2**63) <= stamp_ns < 2**63:
        raise ProtocolError(f"stamp of {seconds} s does not fit 64 bits", "bad_stamp")
    return stamp_ns


def timestamp_of(stamp_ns: int) -> Timestamp:
    seconds, nanos = divmod(int(stamp_ns), 1_000_000_000)
    return Timestamp(seconds=seconds, nanos=nanos)
