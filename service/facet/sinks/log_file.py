"""One MCAP file being written: channels and schemas are declared as messages need them."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from pathlib import Path

from mcap.writer import CompressionType, Writer

from facet.sinks.durable_file import DurableFile
from facet_protocol import codec
from facet_protocol.codec import Message
from facet_protocol.messages import Envelope, ProtocolError, Scan, TilePoints
from facet_protocol.metadata import OWN_METADATA, WRITER, signed

COMPRESSIONS = {
    "lz4": CompressionType.LZ4,
    "zstd": CompressionType.ZSTD,
    "none": CompressionType.NONE,
}
CHUNK_BYTES = 1 << 20
SYNC_BYTES = 8 << 20
ChannelName = tuple[str, str, str, int, int]  # topic, schema, encoding, epoch, sequence >> 32


class LogFile:
    """Chunks with CRCs, a summary at the end; what was added is durable after `sync`, or, if the
    file does not wait for the disk, with the system."""

    def __init__(
        self,
        file: DurableFile,
        metadata: Mapping[str, str],
        compression: str = "lz4",
        waits: bool = True,
    ) -> None:
        self.channel_names: list[ChannelName] = []  # number 1 first; it only grows
        self._file, self._waits = file, waits
        self._schemas: dict[str, int] = {}
        self._channels: dict[ChannelName, int] = {}
        self._writer = Writer(
            file,  # type: ignore[arg-type]  # it needs write, tell and flush alone
            chunk_size=CHUNK_BYTES,
            compression=COMPRESSIONS[compression],
        )
        self._writer.start(profile="", library=WRITER)
        self._writer.add_metadata(OWN_METADATA, signed(metadata))

    @property
    def path(self) -> Path:
        return self._file.path

    @property
    def num_bytes(self) -> int:
        return self._file.tell()

    @property
    def num_channels(self) -> int:
        return len(self._channels)

    def add(self, envelope: Envelope, log_time_ns: int) -> None:
        """Take one message; its bytes are not looked into."""
        self._writer.add_message(
            self._channel(envelope),
            log_time=log_time_ns,
            data=bytes(envelope.payload),
            publish_time=envelope.stamp_ns,
            sequence=envelope.sequence & 0xFFFFFFFF,
        )

    def sync(self) -> None:
        """Close the chunk in progress and wait for the disk. Raises OSError."""
        self._writer.flush()
        self._file.sync(self._waits)

    def finish(self) -> None:
        """Write the summary and close the file. Raises OSError."""
        self._writer.finish()
        self._file.sync(self._waits)
        self._file.close()

    def abandon(self) -> None:
        """Cut back to the last good chunk and close; never raises."""
        self._file.abandon()

    def _channel(self, envelope: Envelope) -> int:
        """The channel of a message; a new epoch opens a new one."""
        high = envelope.sequence >> 32  # MCAP counts in 32 bits
        name = (envelope.key, envelope.schema, envelope.encoding, envelope.epoch, high)
        if name not in self._channels:
            schema = self._schema(envelope.schema) if envelope.schema else 0
            self._channels[name] = self._writer.register_channel(
                envelope.key, envelope.encoding, schema, channel_metadata(name)
            )
            self.channel_names.append(name)
        return self._channels[name]

    def _schema(self, name: str) -> int:
        if name not in self._schemas:
            self._schemas[name] = self._writer.register_schema(name, *schema_text(name))
        return self._schemas[name]


def schema_text(name: str) -> tuple[str, bytes]:
    """(encoding, text) of a schema; empty for one that we do not know: recorded by name alone."""
    try:
        return codec.schema_text(name)
    except ProtocolError:
        return "", b""


def channel_metadata(name: ChannelName) -> dict[str, str]:
    """What a channel says beside its topic: the epoch, and what MCAP's 32 bits lack."""
    _topic, _schema, _encoding, epoch, high = name
    metadata = {"epoch": str(epoch)} if epoch else {}
    return {**metadata, "sequence_high": str(high)} if high else metadata


def write_recording(
    path: Path, envelopes: Iterable[Envelope], metadata: Mapping[str, str], compression: str = "lz4"
) -> int:
    """Write a whole recording in one go, over one that is there; how many messages it holds.

    Stopped half way it leaves nothing behind: the file gets its name when it is finished.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    partial = path.with_name(path.name + ".part")
    partial.unlink(missing_ok=True)
    log = LogFile(DurableFile(partial), metadata, compression)
    num = log_time_ns = synced = 0
    try:
        for envelope in envelopes:
            log_time_ns = max(log_time_ns, envelope.received_ns)
            log.add(envelope, log_time_ns)
            num += 1
            if log.num_bytes - synced > SYNC_BYTES:
                log.sync()
                synced = log.num_bytes
        log.finish()
    except BaseException:
        log.abandon()
        partial.unlink(missing_ok=True)
        raise
    partial.replace(path)
    return num


class UpdateLog:
    """A sink that writes what a replay derives, without the scans: the same log, the same bytes."""

    def __init__(self, path: Path) -> None:
        path.parent.mkdir(parents=True, exist_ok=True)
        path.unlink(missing_ok=True)
        self._log: LogFile | None = LogFile(DurableFile(path), {"cuts": "logged"})
        self._synced = 0

    def write(self, envelope: Envelope, message: Message | None) -> None:
        """Take one message of ours; scans are in the log that is replayed."""
        if self._log is None or isinstance(message, Scan | TilePoints):
            return
        self._log.add(envelope, envelope.received_ns)
        if self._log.num_bytes - self._synced > SYNC_BYTES:
            self._log.sync()
            self._synced = self._log.num_bytes

    def close(self) -> None:
        """Finish the file; a second call does nothing."""
        if self._log is not None:
            self._log.finish()
            self._log = None
