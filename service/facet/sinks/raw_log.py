"""A log of messages as another log holds them: each keeps its channel, its schema and its times."""

from __future__ import annotations

from typing import Any, Protocol

from mcap.writer import CompressionType, Writer

from facet.sinks.durable_file import DurableFile
from facet.sinks.log_file import CHUNK_BYTES, SYNC_BYTES
from facet_protocol.metadata import OWN_METADATA, RECOVERER, signed


class Raw(Protocol):
    """A message as a file holds it: `channel` and `schema_record` are MCAP's own."""

    @property
    def channel(self) -> Any: ...
    @property
    def schema_record(self) -> Any: ...
    @property
    def payload(self) -> memoryview: ...
    @property
    def sequence(self) -> int: ...
    @property
    def log_time_ns(self) -> int: ...
    @property
    def publish_time_ns(self) -> int: ...


class RawLog:
    """Chunks with CRCs and a summary, as `LogFile` writes them."""

    def __init__(self, file: DurableFile) -> None:
        self._file = file
        self._schemas: dict[tuple[str, str, bytes], int] = {}
        self._channels: dict[int, int] = {}  # by the number it had
        self._synced = 0
        self._writer = Writer(
            file,  # type: ignore[arg-type]  # it needs write, tell and flush alone
            chunk_size=CHUNK_BYTES,
            compression=CompressionType.LZ4,
        )
        self._writer.start(profile="", library=RECOVERER)

    def add(self, message: Raw) -> None:
        """Take one message. Raises OSError."""
        self._writer.add_message(
            self._channel(message),
            log_time=message.log_time_ns,
            data=bytes(message.payload),
            publish_time=message.publish_time_ns,
            sequence=message.sequence,
        )
        if self._file.tell() - self._synced > SYNC_BYTES:
            self._writer.flush()
            self._file.sync()
            self._synced = self._file.tell()

    def add_metadata(self, name: str, entries: dict[str, str]) -> None:
        """Take a record of metadata; one of ours is signed again."""
        self._writer.add_metadata(name, signed(entries) if name == OWN_METADATA else entries)

    def finish(self) -> None:
        """Write the summary and close the file. Raises OSError."""
        self._writer.finish()
        self._file.sync()
        self._file.close()

    def abandon(self) -> None:
        """Close it, whatever it holds; never raises."""
        self._file.abandon()

    def _channel(self, message: Raw) -> int:
        channel = message.channel
        if channel.id not in self._channels:
            schema = message.schema_record
            self._channels[channel.id] = self._writer.register_channel(
                channel.topic,
                channel.message_encoding,
                self._schema(schema.name, schema.encoding, schema.data) if schema else 0,
                channel.metadata,
            )
        return self._channels[channel.id]

    def _schema(self, name: str, encoding: str, text: bytes) -> int:
        key = (name, encoding, text)
        if key not in self._schemas:
            self._schemas[key] = self._writer.register_schema(name, encoding, text)
        return self._schemas[key]
