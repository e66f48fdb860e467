"""The conformance files of the MCAP project, read from beside this one: none of them is in it.

Reader: what `McapStream` gives of each of the 416 files is what its JSON says, message by message,
with channel, schema and metadata. Writer: the library that writes our logs, told the features of a
file, gives its bytes: 208 files, for upstream tests no writer with padded records. `LogFile` is
held to the same library: chunks, indexes, statistics and CRCs on.
"""

from __future__ import annotations

import json
from hashlib import sha256
from io import BytesIO
from pathlib import Path
from typing import Any

import pytest
from mcap.writer import CompressionType, IndexType, Writer

from facet.sources.mcap_stream import McapStream

FILES = Path(__file__).parents[2] / "shared" / "mcap_conformance"
pytestmark = pytest.mark.skipif(not FILES.exists(), reason="the conformance files are not here")
INPUTS = (
    *("NoData", "OneAttachment", "OneMessage"),
    *("OneMetadata", "OneSchemalessMessage", "TenMessages"),
)


def paths_of(name: str) -> list[Path]:
    return sorted((FILES / name).glob("*.mcap"))


def records_of(path: Path) -> list[dict[str, Any]]:
    """The records that a file must hold, each with its `type`."""
    records = json.loads(path.with_suffix(".json").read_text())["records"]
    return [{"type": record["type"], **dict(record["fields"])} for record in records]


def octets(numbers: list[str]) -> bytes:
    return bytes(int(number) for number in numbers)


def expected(path: Path) -> tuple[list[tuple[Any, ...]], list[tuple[Any, ...]]]:
    """(messages, metadata) by the JSON, in file order."""
    schemas, channels, messages, metadata = {"0": ""}, {}, [], []
    for r in records_of(path):
        if r["type"] == "Schema":
            schemas[r["id"]] = r["name"]
        elif r["type"] == "Channel":
            channels[r["id"]] = r
        elif r["type"] == "Message":
            c = channels[r["channel_id"]]
            times = (int(r["sequence"]), int(r["log_time"]), int(r["publish_time"]))
            named = (c["topic"], c["message_encoding"], c["metadata"], schemas[c["schema_id"]])
            messages.append((*named, *times, octets(r["data"])))
        elif r["type"] == "Metadata":
            metadata.append((r["name"], r["metadata"]))
    return messages, metadata


def given(stream: McapStream) -> tuple[list[tuple[Any, ...]], list[tuple[Any, ...]]]:
    messages = [
        (
            m.channel.topic,
            m.channel.message_encoding,
            m.channel.metadata,
            m.schema,
            m.sequence,
            m.log_time_ns,
            m.publish_time_ns,
            bytes(m.payload),
        )
        for m in stream.messages()
    ]
    return messages, [(m.name, m.metadata) for m in stream.metadata]


@pytest.mark.parametrize("name", INPUTS)
def test_reader(name: str) -> None:
    for path in paths_of(name):
        stream = McapStream(path)
        assert given(stream) == expected(path), path.name
        assert not stream.damage, f"{path.name}: {stream.damage.notes}"


def test_all_files_are_as_published() -> None:
    lines = (FILES / "SHA256SUMS").read_text().splitlines()
    sums = dict(reversed(line.split(maxsplit=1)) for line in lines)
    paths = [path for name in INPUTS for path in paths_of(name)]
    assert len(paths) == 416
    for path in paths:
        assert sha256(path.read_bytes()).hexdigest() == sums[f"./{path.relative_to(FILES)}"]


def writer(stream: BytesIO, flags: set[str]) -> Writer:
    """The library, told what a file's name says."""
    kinds = {
        "ax": IndexType.ATTACHMENT,
        "chx": IndexType.CHUNK,
        "mx": IndexType.MESSAGE,
        "mdx": IndexType.METADATA,
    }
    index_types = IndexType.NONE
    for flag in flags & set(kinds):
        index_types |= kinds[flag]
    return Writer(
        stream,
        compression=CompressionType.NONE,
        index_types=index_types,
        repeat_channels="rch" in flags,
        repeat_schemas="rsh" in flags,
        use_chunking="ch" in flags,
        use_statistics="st" in flags,
        use_summary_offsets="sum" in flags,
        enable_crcs=True,
        enable_data_crcs=True,
    )


def written(path: Path) -> bytes:
    """The file again, from its JSON."""
    stream = BytesIO()
    log = writer(stream, set(path.stem.split("-")[1:]))
    is_data = True
    for r in records_of(path):
        is_data = is_data and r["type"] != "DataEnd"
        if is_data:
            write(log, r)
    log.finish()
    return stream.getvalue()


def write(log: Writer, r: dict[str, Any]) -> None:
    if r["type"] == "Header":
        log.start(profile=r["profile"], library=r["library"])
    elif r["type"] == "Schema":
        log.register_schema(r["name"], r["encoding"], octets(r["data"]))
    elif r["type"] == "Channel":
        log.register_channel(r["topic"], r["message_encoding"], int(r["schema_id"]), r["metadata"])
    elif r["type"] == "Message":
        times = {name: int(r[name]) for name in ("log_time", "publish_time", "sequence")}
        log.add_message(int(r["channel_id"]), data=octets(r["data"]), **times)
    elif r["type"] == "Attachment":
        log.add_attachment(
            create_time=int(r["create_time"]),
            log_time=int(r["log_time"]),
            name=r["name"],
            media_type=r["media_type"],
            data=octets(r["data"]),
        )
    elif r["type"] == "Metadata":
        log.add_metadata(r["name"], r["metadata"])


@pytest.mark.parametrize("name", INPUTS)
def test_writer(name: str) -> None:
    paths = [path for path in paths_of(name) if "-pad" not in path.stem]
    assert len(paths) * 2 == len(paths_of(name))
    for path in paths:
        assert written(path) == path.read_bytes(), path.name
