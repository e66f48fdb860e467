"""CDR, as ROS 2 serialises its messages: a reader that checks every count before it uses it.

Common Data Representation, OMG DDSI-RTPS 2.5 section 10 and CORBA 3.3 part 2 section 9.3: four
bytes say which encoding follows, then every value lies aligned to its own size. Both byte orders.
"""

from __future__ import annotations

import struct
from dataclasses import dataclass
from functools import cache

import numpy as np
from numpy.typing import NDArray

from facet_protocol.messages import ProtocolError

HEADER_BYTES = 4
MAX_PADDING = 7  # RTPS rounds a payload up to 4 bytes, some writers to 8
_ORDERS = {b"\x00\x00": ">", b"\x00\x01": "<"}  # CDR_BE, CDR_LE


@dataclass(frozen=True, slots=True)
class Record:
    """Numbers that follow each other: read in one go, aligned as their widest."""

    layout: struct.Struct
    alignment: int


@cache
def record(order: str, codes: str) -> Record:
    """Of `codes` as in `struct`, all of one size."""
    return Record(struct.Struct(order + codes), struct.calcsize("=" + codes[-1]))


class CdrReader:
    """Reads values one after the other; raises ProtocolError (malformed, bad_length) alone."""

    def __init__(self, payload: bytes | memoryview, name: str) -> None:
        """`name` of the message, for the errors."""
        self._name = name
        data = memoryview(payload).cast("B")
        if len(data) < HEADER_BYTES:
            raise ProtocolError(f"{name}: {len(data)} bytes are no CDR message")
        order = _ORDERS.get(bytes(data[:2]))
        if order is None:
            text = f"CDR encapsulation {bytes(data[:2]).hex()} is neither 0000 nor 0001"
            raise ProtocolError(f"{name}: {text}")
        self.order = order
        self._data = data[HEADER_BYTES:]
        self._at = 0

    def numbers(self, codes: str) -> tuple[float, ...]:
        """Values of one size, by their `struct` codes ("iI", "7d", "B")."""
        row = record(self.order, codes)
        start = self._take(row.layout.size, row.alignment)
        values: tuple[float, ...] = row.layout.unpack_from(self._data, start)
        return values

    def count(self, item_bytes: int) -> int:
        """Items of a sequence, each of at least `item_bytes`: checked, not believed."""
        num = int(self.numbers("I")[0])
        rest = len(self._data) - self._at
        if num * item_bytes > rest:
            text = f"{num} items of {item_bytes} bytes or more declared, {rest} bytes left"
            raise ProtocolError(f"{self._name}: {text}", "bad_length")
        return num

    def string(self) -> str:
        """UTF-8 up to the NUL that ends it."""
        num = self.count(1)
        text = bytes(self._data[self._at : self._at + num])
        self._at += num
        try:
            return text.removesuffix(b"\0").decode()
        except UnicodeDecodeError as error:
            raise ProtocolError(f"{self._name}: {error}") from error

    def octets(self) -> memoryview:
        """A sequence of bytes: a view of the payload."""
        num = self.count(1)
        start = self._take(num, 1)
        return self._data[start : start + num]

    def floats(self) -> NDArray[np.float32]:
        """(N,) a sequence of float32: a view of the payload, in its byte order."""
        num = self.count(4)
        start = self._take(4 * num, 4)
        return np.frombuffer(self._data, np.dtype(f"{self.order}f4"), num, start)

    def end(self) -> None:
        """Nothing but padding may be left."""
        rest = len(self._data) - self._at
        if rest > MAX_PADDING:
            raise ProtocolError(f"{self._name}: {rest} bytes follow its end")

    def _take(self, num_bytes: int, alignment: int) -> int:
        """Offset of the next `num_bytes`, which must be there."""
        start = self._at + -self._at % alignment if num_bytes else self._at
        if start + num_bytes > len(self._data):
            text = f"cut off: byte {start + num_bytes} of {len(self._data)}"
            raise ProtocolError(f"{self._name}: {text}")
        self._at = start + num_bytes
        return start
