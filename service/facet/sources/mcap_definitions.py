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

    def copy(self) -> Definitions:
        """Another one that knows the same."""
        other = Definitions()
        other.channels, other.schemas = dict(self.channels), dict(self.schemas)
        return other

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

    def find(self, channel_id: int) -> tuple[Channel, Schema | None]:
        """A channel and its schema, if it has one. Raises ValueError when either is not defined."""
        channel = self.channels.get(channel_id)
        if channel is None:
            raise ValueError(f"no channel {channel_id}")
        if not channel.schema_id:
            return channel, None
        schema = self.schemas.get(channel.schema_id)
        if schema is None:
            raise ValueError(f"no schema {channel.schema_id}")
        return channel, schema


def defined(rows: Iterable[tuple[str, str, dict[str, str], str, str, bytes]]) -> Definitions:
    """Channels (topic, encoding, metadata) with their schemas (name, encoding, text), both numbered
    as the library's writer numbers them: from 1, as they came, each schema once."""
    definitions = Definitions()
    schemas: dict[str, int] = {}
    for number, (topic, encoding, metadata, name, kind, text) in enumerate(rows, start=1):
        if name and name not in schemas:
            schemas[name] = len(schemas) + 1
            schema = Schema(data=text, encoding=kind, id=schemas[name], name=name)
            definitions.schemas[schema.id] = schema
        definitions.channels[number] = Channel(
            id=number,
            topic=topic,
            message_encoding=encoding,
            metadata=metadata,
            schema_id=schemas.get(name, 0),
        )
    return definitions


def _keep(table: dict[int, Schema] | dict[int, Channel], key: int, value: Schema | Channel) -> None:
    if table.setdefault(key, value) != value:  # type: ignore[arg-type]
        raise ValueError(f"{type(value).__name__.lower()} {key} is not what it was")
