"""`facet recover` and `facet info`: a damaged log again as a clean one, and what is not in it."""

from __future__ import annotations

from pathlib import Path

import pytest
from mcap.reader import make_reader
from mcap.writer import Writer
from typer.testing import CliRunner

from facet.__main__ import app
from facet.commands.terminal import InputError
from facet.sinks.log_file import write_recording
from facet.sources.mcap_stream import LogMessage, McapStream
from facet.sources.recording import Recording
from rig import room
from test_mcap_stream import foreign, unsealed


def facet(*arguments: object) -> tuple[int, str]:
    """(exit code, output)."""
    result = CliRunner().invoke(app, [str(a) for a in arguments])
    if isinstance(result.exception, InputError):
        return 65, str(result.exception)
    return result.exit_code, result.output


def content(message: LogMessage) -> tuple[object, ...]:
    schema = message.schema_record
    return (
        message.channel.topic,
        message.channel.message_encoding,
        message.channel.metadata,
        (schema.name, schema.encoding, schema.data) if schema else None,
        message.sequence,
        message.log_time_ns,
        message.publish_time_ns,
        bytes(message.payload),
    )


def contents(path: Path) -> list[tuple[object, ...]]:
    return [content(message) for message in McapStream(path).messages()]


@pytest.fixture
def log(tmp_path: Path) -> Path:
    """Thirty scans of 54 kB in chunks of 1 MiB."""
    path = tmp_path / "log.mcap"
    write_recording(path, room(30), {"cuts": "logged", "map": "hall"}, "none")
    return path


def test_a_whole_log_is_written_again(log: Path, tmp_path: Path) -> None:
    code, text = facet("recover", log, tmp_path / "clean.mcap")
    assert code == 0
    assert "30 messages" in text
    assert "nothing was lost" in text
    assert contents(tmp_path / "clean.mcap") == contents(log)
    recording = Recording([tmp_path / "clean.mcap"])
    assert recording.head() == {"cuts": "logged", "map": "hall"}
    assert facet("info", tmp_path / "clean.mcap")[0] == 0


def test_a_log_without_its_end_has_lost_nothing(log: Path, tmp_path: Path) -> None:
    """Killed after its last commit: all chunks are whole, only the summary is missing."""
    with log.open("rb") as file:
        summary = make_reader(file).get_summary()
    assert summary is not None
    last = max(summary.chunk_indexes, key=lambda c: c.chunk_start_offset)
    end = last.chunk_start_offset + last.chunk_length
    log.write_bytes(log.read_bytes()[:end])
    assert facet("info", log)[0] == 3
    code, text = facet("recover", log, tmp_path / "clean.mcap")
    assert code == 0
    assert "not finished" in text
    assert len(contents(tmp_path / "clean.mcap")) == 30
    assert facet("info", tmp_path / "clean.mcap")[0] == 0


def test_a_flipped_bit_costs_a_chunk(log: Path, tmp_path: Path) -> None:
    whole = contents(log)
    data = bytearray(log.read_bytes())
    data[len(data) // 2] ^= 8
    log.write_bytes(data)
    code, text = facet("info", log)
    assert code == 3
    assert "wrong checksum" in text
    assert "facet recover" in text
    code, text = facet("recover", log, tmp_path / "clean.mcap")
    assert code == 3
    rest = contents(tmp_path / "clean.mcap")
    assert [c for c in whole if c in rest] == rest
    assert f"lost {30 - len(rest)} messages" in text
    assert 0 < len(rest) < 30
    assert facet("info", tmp_path / "clean.mcap")[0] == 0


def test_a_chunk_that_lost_its_checksum_is_lost(log: Path, tmp_path: Path) -> None:
    """MCAP's 0 is none, and allowed; Facet writes no chunk without one."""
    whole = contents(log)
    with log.open("rb") as file:
        summary = make_reader(file).get_summary()
    assert summary is not None
    index = summary.chunk_indexes[0]
    end = index.chunk_start_offset + index.chunk_length
    log.write_bytes(unsealed(log.read_bytes(), index.chunk_start_offset, end))
    code, text = facet("info", log)
    assert code == 3
    assert "wrong checksum" in text
    assert facet("recover", log, tmp_path / "clean.mcap")[0] == 3
    rest = contents(tmp_path / "clean.mcap")
    assert 0 < len(rest) < 30
    assert rest == whole[-len(rest) :]


def test_what_has_no_checksum_is_said(tmp_path: Path) -> None:
    """A log from elsewhere may be without: nobody can tell whether it is as it was written."""
    path = tmp_path / "a.mcap"
    foreign(path, has_crcs=False)
    code, text = facet("info", path)
    assert code == 0
    assert "30 messages that no checksum vouches for" in text
    code, text = facet("recover", path, tmp_path / "clean.mcap")
    assert code == 0
    assert "30 of them are taken on trust" in text
    foreign(path, has_crcs=True)
    assert "checksum" not in facet("info", path)[1]


def test_nothing_to_recover(tmp_path: Path) -> None:
    for name, data in (("text", b"a text of no importance"), ("cut", b"\x89MCAP0\r\n\x01")):
        (tmp_path / name).write_bytes(data)
        code, _ = facet("recover", tmp_path / name, tmp_path / "clean.mcap")
        assert code in (1, 65)  # 1: LogError, which the command's process turns into 65
    assert sorted(p.name for p in tmp_path.iterdir()) == ["cut", "text"]


def test_what_is_there_is_not_written_over(log: Path) -> None:
    before = log.read_bytes()
    code, text = facet("recover", log, log)
    assert code == 65
    assert "not written over" in text
    assert log.read_bytes() == before


def test_a_foreign_log_keeps_its_schemas(tmp_path: Path) -> None:
    path = tmp_path / "ros.mcap"
    with path.open("wb") as file:
        writer = Writer(file)
        writer.start(profile="ros2")
        schema = writer.register_schema("std_msgs/msg/String", "ros2msg", b"string data")
        talk = writer.register_channel("/talk", "cdr", schema, {"offered_qos_profiles": "x"})
        bare = writer.register_channel("/bare", "json", 0)
        for k in range(4):
            writer.add_message(talk, log_time=9 - k, data=b"\0\1\0\0", publish_time=k, sequence=k)
            writer.add_message(bare, log_time=k, data=b"{}", publish_time=k)
        writer.add_metadata("rosbag2", {"distro": "jazzy"})
        writer.finish()
    assert facet("recover", path, tmp_path / "clean.mcap")[0] == 0
    assert contents(tmp_path / "clean.mcap") == contents(path)
    stream = McapStream(tmp_path / "clean.mcap")
    assert len(list(stream.messages())) == 8
    assert [(m.name, m.metadata) for m in stream.metadata] == [("rosbag2", {"distro": "jazzy"})]
