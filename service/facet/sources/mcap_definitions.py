"""What an MCAP file defines: schemas and channels, by id, in bounded memory."""

from __future__ import annotations

from collections.abc import Iterable
from io import BytesIO

from mcap.data_stream import ReadDataStream
from mcap.opcode import Opcode
from mcap.records import Channel, Schema

MAX_DEFINITION_BYTES = 64 << 20  # of schemas, channels and metadata that are kept


class Definitions:
    """Schemas and channels by id; what has been defined is never defined otherwise."""

    def __init__(self) -> None:
        self.channels: dict[int, Channel] = {}
        self.schemas: dict[int, Schema] = {}
        self.num_bytes = 0

    def read(self, opcode: int, content: bytes) -> None:
        """Take a schema or a channel. Raises ValueError for another of a known id, and for too
        much."""
        self.make_room(len(content))
        stream = ReadDataStream(BytesIO(content))
        if opcode == Opcode.SCHEMA:
            schema = Schema.read(stream)
            _keep(self.schemas, schema.id, schema)
        else:
            channel = Channel.read(stream)
            _keep(self.channels, channel.id, channel)

    def make_room(self, num_bytes: int) -> None:
        """Count what is to be kept. Raises ValueError when it gets too much."""
        self.num_bytes += num_bytes
        if self.num_bytes > MAX_DEFINITION_BYTES:
            raise ValueError(f"over {MAX_DEFINITION_BYTES} bytes of definitions")

    def add(self, channels: Iterable[Channel], schemas: Iterable[Schema]) -> None:
        self.channels.update((c.id, c) for c in channels)
        self.schemas.update((s.id, s) for s in schemas)

    def find(self, channel_id: int) -> tuple[Channel, str]:
        """A channel and the name of its schema. Raises ValueError when either is not defined."""
        channel = self.channels.get(channel_id)
        if channel is None:
            raise ValueError(f"no channel {channel_id}")
        if not channel.schema_id:
            return channel, ""
        schema = self.schemas.get(channel.schema_id)
        if schema is None:
            raise ValueError(f"no schema {channel.schema_id}")
        return channel, schema.name


def _keep(table: dict[int, Schema] | dict[int, Channel], key: int, value: Schema | Channel) -> None:
    if table.setdefault(key, value) != value:  # type: ignore[arg-type]
        raise ValueError(f"{type(value).__name__.lower()} {key} is not what it was")
