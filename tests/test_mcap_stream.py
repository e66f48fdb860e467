"""Logs cut off, flipped, bombed: every whole good chunk is read, and nothing wrong in silence."""

from __future__ import annotations

import random
import struct
import subprocess
import sys
import zlib
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import lz4.frame
import pytest
import zstandard
from mcap.reader import make_reader
from mcap.writer import CompressionType, Writer

from facet.sinks.log_file import write_recording
from facet.sources.mcap_chunk import inflate, parse_chunk, records_of
from facet.sources.mcap_damage import LogError
from facet.sources.mcap_stream import McapStream
from facet_protocol.messages import Envelope

HEAD = struct.Struct("<BQ")
SEED = 20


@dataclass(frozen=True)
class Whole:
    """A log as it was written: bytes, messages, and [start, end) of its chunks with the number of
    messages up to the end of each."""

    data: bytes
    messages: list[tuple[object, ...]]
    chunks: list[tuple[int, int, int]]


def fields(path: Path, stream: McapStream) -> list[tuple[object, ...]]:
    return [
        (
            m.channel.topic,
            m.schema,
            m.channel.message_encoding,
            tuple(sorted(m.channel.metadata.items())),
            m.sequence,
            m.log_time_ns,
            m.publish_time_ns,
            bytes(m.payload),
        )
        for m in stream.messages()
    ]


def envelopes(num: int) -> Iterator[Envelope]:
    rng = random.Random(SEED)
    for k in range(1, num + 1):
        robot = f"r{k % 3}"
        payload = rng.randbytes(rng.randrange(20, 90)) + bytes(rng.randrange(40))
        yield Envelope(
            key=f"facet/v1/map/robot/{robot}/scan/front",
            schema="foxglove.PointCloud",
            encoding="protobuf",
            payload=payload,
            stamp_ns=10**9 + k,
            epoch=7,
            sequence=k,
            received_ns=2 * 10**9 + k,
        )


def whole_log(path: Path, num: int, compression: str, chunk_bytes: int = 1000) -> Whole:
    """A log of small chunks."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("facet.sinks.log_file.CHUNK_BYTES", chunk_bytes)
        write_recording(path, envelopes(num), {"cuts": "logged", "map": "m"}, compression)
    with path.open("rb") as file:
        summary = make_reader(file).get_summary()
    assert summary is not None
    indexes = sorted(summary.chunk_indexes, key=lambda c: c.chunk_start_offset)
    stream = McapStream(path)
    messages = fields(path, stream)
    assert not stream.damage
    assert len(messages) == num
    counts, per_chunk = 0, []
    for c in indexes:
        counts += _num_messages(path, c.chunk_start_offset, c.chunk_length)
        start = c.chunk_start_offset
        per_chunk.append((start, start + c.chunk_length, counts))
    assert counts == num
    return Whole(path.read_bytes(), messages, per_chunk)


def _num_messages(path: Path, start: int, length: int) -> int:
    """Of the message indexes that follow a chunk, one entry a message."""
    data, at, num = path.read_bytes(), start + length, 0
    while data[at] == 0x07:
        (size,) = struct.unpack_from("<Q", data, at + 1)
        num += struct.unpack_from("<I", data, at + 11)[0] // 16
        at += 9 + size
    return num


def read(path: Path, data: bytes) -> tuple[list[tuple[object, ...]], McapStream | None]:
    """(messages, stream); no stream when it was refused as a whole."""
    path.write_bytes(data)
    stream = McapStream(path)
    try:
        return fields(path, stream), stream
    except LogError:
        return [], None


def check_cuts(path: Path, log: Whole, cuts: list[int]) -> None:
    for length in cuts:
        messages, stream = read(path, log.data[:length])
        good = max((num for _, end, num in log.chunks if end <= length), default=0)
        assert messages == log.messages[:good], f"cut at byte {length}"
        assert stream is not None
        assert stream.damage, f"cut at byte {length}: nothing is said"


def check_flips(path: Path, log: Whole, bits: list[int]) -> int:
    """How many flips lost a message."""
    lossy = 0
    known = set(log.messages)
    data = bytearray(log.data)
    for bit in bits:
        at, mask = bit >> 3, 1 << (bit & 7)
        data[at] ^= mask
        messages, stream = read(path, bytes(data))
        data[at] ^= mask
        assert set(messages) <= known, f"bit {bit}: a message that was never written"
        assert messages == sorted(messages, key=log.messages.index), f"bit {bit}: out of order"
        if messages != log.messages:
            lossy += 1
            assert stream is None or stream.damage, f"bit {bit}: lost in silence"
            assert stream is not None, f"bit {bit}: the whole file was given up"
            hit = [c for c in log.chunks if c[0] <= at < c[1]]
            assert hit, f"bit {bit} is in no chunk and cost messages: {stream.damage.notes}"
            missing = len(log.messages) - len(messages)
            assert stream.damage.lost_messages == missing
    return lossy


@pytest.mark.parametrize("compression", ["lz4", "zstd", "none"])
def test_cut_anywhere(tmp_path: Path, compression: str) -> None:
    log = whole_log(tmp_path / "a.mcap", 60, compression)
    cuts = random.Random(SEED).sample(range(len(log.data)), 200)
    check_cuts(tmp_path / "cut.mcap", log, [0, 1, 7, 8, 9, *cuts, len(log.data) - 1])


@pytest.mark.parametrize("compression", ["lz4", "zstd", "none"])
def test_one_bit_flipped(tmp_path: Path, compression: str) -> None:
    log = whole_log(tmp_path / "a.mcap", 60, compression)
    bits = random.Random(SEED).sample(range(8 * len(log.data)), 300)
    assert check_flips(tmp_path / "bit.mcap", log, bits) > 80


def test_without_its_checksum_a_chunk_is_believed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The mutant that the test above must kill: a reader that does not look at the CRC."""
    log = whole_log(tmp_path / "a.mcap", 60, "none")
    monkeypatch.setattr(
        "facet.sources.mcap_stream.inflate",
        lambda chunk, content, **told: inflate(chunk._replace(crc=0), content),
    )
    bits = random.Random(SEED).sample(range(8 * len(log.data)), 100)
    with pytest.raises(AssertionError, match="never written"):
        check_flips(tmp_path / "bit.mcap", log, bits)


@pytest.mark.parametrize("compression", ["lz4", "none"])
def test_every_bit_around_a_chunk_flipped(tmp_path: Path, compression: str) -> None:
    """Opcode, length and layout of the second chunk, and the records right after it."""
    log = whole_log(tmp_path / "a.mcap", 30, compression)
    start, end, _ = log.chunks[1]
    places = [*range(start, start + 60), *range(end, end + 40)]
    bits = [8 * at + k for at in places for k in range(8)]
    check_flips(tmp_path / "bit.mcap", log, bits)


@pytest.mark.slow
@pytest.mark.parametrize("compression", ["lz4", "zstd", "none"])
def test_cut_everywhere(tmp_path: Path, compression: str) -> None:
    log = whole_log(tmp_path / "a.mcap", 1000, compression, 16_000)
    cuts = list(range(len(log.data)))
    check_cuts(tmp_path / "cut.mcap", log, random.Random(SEED).sample(cuts, min(len(cuts), 20_000)))


@pytest.mark.slow
@pytest.mark.parametrize("compression", ["lz4", "zstd", "none"])
def test_ten_thousand_bits_flipped(tmp_path: Path, compression: str) -> None:
    log = whole_log(tmp_path / "a.mcap", 200, compression)
    bits = random.Random(SEED).sample(range(8 * len(log.data)), 10_000)
    assert check_flips(tmp_path / "bit.mcap", log, bits) > 1000


def test_a_log_in_the_middle_of_another_is_not_read(tmp_path: Path) -> None:
    """A payload that is itself a log lies whole in a chunk that is cut off or damaged."""
    inner = whole_log(tmp_path / "inner.mcap", 20, "none")
    robot = next(envelopes(1))
    scan = Envelope(robot.key, robot.schema, robot.encoding, inner.data, sequence=1)
    write_recording(tmp_path / "outer.mcap", [scan, scan], {}, "none")
    outer = (tmp_path / "outer.mcap").read_bytes()
    cut_messages, _ = read(tmp_path / "cut.mcap", outer[: len(outer) * 2 // 5])
    flipped = bytearray(outer)
    flipped[len(inner.data) // 2] ^= 4
    flipped_messages, stream = read(tmp_path / "cut.mcap", bytes(flipped))
    assert cut_messages == flipped_messages == []
    assert stream is not None
    assert stream.damage.lost_messages == 2


def test_flips_outside_of_chunks_are_told_by_the_checksum_of_the_data(tmp_path: Path) -> None:
    """A log without chunks has one checksum for all: it cannot say which message is wrong."""
    path = tmp_path / "a.mcap"
    with path.open("wb") as file:
        writer = Writer(file, use_chunking=False, enable_data_crcs=True)
        writer.start()
        schema = writer.register_schema("s", "x", b"abc")
        channel = writer.register_channel("topic", "x", schema)
        for k in range(20):
            writer.add_message(channel, log_time=k, data=bytes([k] * 30), publish_time=k)
        writer.finish()
    data = path.read_bytes()
    stream = McapStream(path)
    good = fields(path, stream)
    assert len(good) == 20
    assert not stream.damage
    assert stream.num_unchecked == 0
    for bit in random.Random(SEED).sample(range(8 * len(data)), 500):
        flipped = bytearray(data)
        flipped[bit >> 3] ^= 1 << (bit & 7)
        messages, maybe = read(tmp_path / "b.mcap", bytes(flipped))
        assert messages == good or maybe is None or maybe.damage, f"bit {bit}"


def test_metadata_has_its_own_checksum(tmp_path: Path) -> None:
    write_recording(tmp_path / "a.mcap", [], {"settings": '{"voxel_m": 0.05}'})
    stream = McapStream(tmp_path / "a.mcap")
    assert list(stream.messages()) == []
    assert [m.metadata for m in stream.metadata] == [{"settings": '{"voxel_m": 0.05}'}]
    data = (tmp_path / "a.mcap").read_bytes().replace(b"0.05", b"0.25")
    _, stream_or_none = read(tmp_path / "b.mcap", data)
    assert stream_or_none is not None
    assert stream_or_none.metadata == []
    assert "wrong checksum" in stream_or_none.damage.notes[0]


def test_a_first_chunk_that_is_lost_takes_no_definitions_with_it(tmp_path: Path) -> None:
    """They are in the summary too."""
    log = whole_log(tmp_path / "a.mcap", 60, "lz4")
    data = bytearray(log.data)
    data[log.chunks[0][0] + 80] ^= 1
    messages, stream = read(tmp_path / "b.mcap", bytes(data))
    assert messages == log.messages[log.chunks[0][2] :]
    assert stream is not None
    assert stream.damage.lost_messages == log.chunks[0][2]


def test_another_definition_of_a_channel_is_damage(tmp_path: Path) -> None:
    path = tmp_path / "a.mcap"
    with path.open("wb") as file:
        writer = Writer(file, compression=CompressionType.NONE, repeat_channels=False)
        writer.start()
        channel = writer.register_channel("one", "x", 0)
        for k in range(2):
            writer.add_message(channel, log_time=0, data=b"a", publish_time=0)
            writer.flush()
            if k == 0:
                another = writer.register_channel("two", "x", 0)
                assert another == 2
        writer.finish()
    data = bytearray(path.read_bytes())
    at = data.index(b"\x03\0\0\0two") - 4  # its id, in the second chunk: number 1 once more
    data[at : at + 2] = b"\x01\x00"
    chunk = data.rindex(b"\x06", 0, at - 40)
    body = bytes(data[chunk + 9 + 40 : chunk + 9 + 40 + _u64(data, chunk + 9 + 32)])
    data[chunk + 9 + 24 : chunk + 9 + 28] = struct.pack("<I", zlib.crc32(body))
    messages, stream = read(tmp_path / "b.mcap", bytes(data))
    assert [m[0] for m in messages] == ["one"]
    assert stream is not None
    assert "channel 1 is not what it was" in stream.damage.notes[0]


def packed(compression: str, records: bytes) -> bytes:
    if compression == "lz4":
        return bytes(lz4.frame.compress(records))
    return zstandard.ZstdCompressor().compress(records) if compression else records


def unsealed(data: bytes, start: int, end: int) -> bytes:
    """The log with the CRC of one chunk set to 0, which in MCAP says that it has none, and a bit of
    its last message changed: everything else is right."""
    content = data[start + HEAD.size : end]
    chunk = parse_chunk(content)
    records = inflate(chunk, content)
    *_, (_, first, last) = records_of(records)
    for at in range(first + 22, last):  # the first 22 bytes say which message it is
        body = packed(chunk.compression, flipped(records, at))
        if len(body) == chunk.num_bytes:
            changed = content[:24] + bytes(4) + content[28 : chunk.start] + body
            return data[: start + HEAD.size] + changed + data[end:]
    raise AssertionError("no change leaves the chunk as long as it is")


def flipped(data: bytes, at: int) -> bytes:
    return data[:at] + bytes([data[at] ^ 1]) + data[at + 1 :]


@pytest.mark.parametrize("compression", ["lz4", "zstd", "none"])
@pytest.mark.parametrize("number", [0, 1, -1])
def test_a_chunk_of_ours_that_lost_its_checksum_is_damaged(
    tmp_path: Path, compression: str, number: int
) -> None:
    """MCAP allows a chunk without one; Facet writes none."""
    log = whole_log(tmp_path / "a.mcap", 60, compression)
    start, end, _ = log.chunks[number]
    messages, stream = read(tmp_path / "b.mcap", unsealed(log.data, start, end))
    ends = [0, *(num for _, _, num in log.chunks)]
    number %= len(log.chunks)
    assert messages == log.messages[: ends[number]] + log.messages[ends[number + 1] :]
    assert stream is not None
    assert stream.damage.lost_messages == ends[number + 1] - ends[number]
    assert "wrong checksum" in stream.damage.notes[0]
    assert stream.num_unchecked == 0


@pytest.mark.parametrize("is_metadata_lost", [False, True])
def test_without_its_header_a_log_of_ours_is_doubted(
    tmp_path: Path, is_metadata_lost: bool
) -> None:
    """One chunk, so that no other tells that there are checksums: the metadata does, or what the
    summary says of it."""
    log = whole_log(tmp_path / "a.mcap", 10, "none", 1 << 20)
    start, end, _ = log.chunks[0]
    data = unsealed(log.data, start, end)
    header, metadata = data.index(b"facet"), data.index(b"\x05\0\0\0facet", 33) + 4
    data = flipped(data, header + 2)
    if is_metadata_lost:
        data = flipped(data, metadata + 2)
    messages, stream = read(tmp_path / "b.mcap", data)
    assert len(messages) == 10
    assert stream is not None
    assert stream.num_unchecked == 10
    assert stream.damage.is_doubtful
    assert "10 messages have lost their checksum" in stream.damage.notes[-1]


def foreign(path: Path, has_crcs: bool) -> bytes:
    """Thirty messages in ten chunks, as another writer writes them."""
    with path.open("wb") as file:
        writer = Writer(file, compression=CompressionType.NONE, enable_crcs=has_crcs)
        writer.start()
        channel = writer.register_channel("topic", "x", 0)
        for k in range(30):
            writer.add_message(channel, log_time=k, data=bytes([k] * 40), publish_time=k)
            if k % 3 == 2:
                writer.flush()
        writer.add_metadata("about", {"crc32": "of something else"})
        writer.finish()
    return path.read_bytes()


def test_a_foreign_log_without_checksums_is_read_as_it_is(tmp_path: Path) -> None:
    messages, stream = read(tmp_path / "b.mcap", foreign(tmp_path / "a.mcap", has_crcs=False))
    assert len(messages) == 30
    assert stream is not None
    assert not stream.damage
    assert stream.num_unchecked == 30
    assert [m.metadata for m in stream.metadata] == [{"crc32": "of something else"}]


@pytest.mark.parametrize("number", [0, 4, 9])
def test_one_chunk_without_a_checksum_among_others_is_doubted(tmp_path: Path, number: int) -> None:
    """Nobody can tell whether it was written so: it is read, and said."""
    data = foreign(tmp_path / "a.mcap", has_crcs=True)
    good, _ = read(tmp_path / "b.mcap", data)
    with (tmp_path / "a.mcap").open("rb") as file:
        summary = make_reader(file).get_summary()
    assert summary is not None
    index = summary.chunk_indexes[number]
    end = index.chunk_start_offset + index.chunk_length
    changed = unsealed(data, index.chunk_start_offset, end)
    messages, stream = read(tmp_path / "b.mcap", changed)
    assert len(messages) == 30
    assert messages != good
    assert stream is not None
    assert stream.damage.is_doubtful
    assert stream.num_unchecked == 3


@pytest.mark.parametrize("opcode", [0x8C, 0x0D])
def test_what_a_log_of_ours_begins_with_is_missed(tmp_path: Path, opcode: int) -> None:
    """Its settings: without them the same scans give another map. The record is there, and marked
    as one that no reader has to know. The header tells, or the summary."""
    log = whole_log(tmp_path / "a.mcap", 10, "lz4")
    data = bytearray(log.data)
    record = data.index(b"\x05\0\0\0facet", 33) - HEAD.size
    assert data[record] == 0x0C
    data[record] = opcode
    cut_off = bytes(data[: log.chunks[-1][1]])
    messages, stream = read(tmp_path / "b.mcap", cut_off)
    assert messages == log.messages
    assert stream is not None
    assert stream.damage.is_doubtful
    assert any("settings" in note for note in stream.damage.notes)
    messages, stream = read(tmp_path / "b.mcap", flipped(bytes(data), data.index(b"facet") + 2))
    assert messages == log.messages
    assert stream is not None
    assert "0 records of metadata of 1" in stream.damage.notes[-1]


def _u64(data: bytearray, at: int) -> int:
    number: int = struct.unpack_from("<Q", data, at)[0]
    return number


def bomb(compression: str, declared: int, num_bytes: int) -> bytes:
    """A log of one chunk that inflates to more than it says."""
    zeros = bytes(num_bytes)
    if compression == "lz4":
        body = lz4.frame.compress(zeros)
    else:
        body = zstandard.ZstdCompressor().compress(zeros)
    name = compression.encode()
    content = struct.pack("<QQQII", 0, 0, declared, 1, len(name)) + name
    content += struct.pack("<Q", len(body)) + body
    return b"\x89MCAP0\r\n" + HEAD.pack(1, 8) + bytes(8) + HEAD.pack(6, len(content)) + content


PROBE = """
import sys
from pathlib import Path
from facet.sources.mcap_stream import McapStream
stream = McapStream(Path(sys.argv[1]))
print(sum(1 for _ in stream.messages()), len(stream.damage.notes) > 0)
status = dict(line.split(":") for line in open("/proc/self/status"))
print(int(status["VmHWM"].split()[0]) >> 10)  # of this program; ru_maxrss keeps its parent's
"""


@pytest.mark.parametrize("compression", ["lz4", "zstd"])
@pytest.mark.parametrize("declared", [100, 64 << 20, 1 << 40])
def test_bombs_are_not_inflated(tmp_path: Path, compression: str, declared: int) -> None:
    path = tmp_path / "bomb.mcap"
    path.write_bytes(bomb(compression, declared, 300 << 20))
    command = [sys.executable, "-c", PROBE, str(path)]
    result = subprocess.run(command, capture_output=True, text=True, timeout=60, check=True)
    said, peak_mb = result.stdout.split("\n")[:2]
    assert said == "0 True"
    assert int(peak_mb) <= 256


def test_millions_of_tiny_messages_take_the_memory_of_one_chunk(tmp_path: Path) -> None:
    record = HEAD.pack(5, 22) + struct.pack("<HIQQ", 1, 0, 0, 0)
    channel = struct.pack("<HHI", 1, 0, 1) + b"t" + struct.pack("<II", 0, 0)
    body = HEAD.pack(4, len(channel)) + channel + record * 1_000_000
    content = struct.pack("<QQQII", 0, 0, len(body), zlib.crc32(body), 0)
    content += struct.pack("<Q", len(body)) + body
    path = tmp_path / "tiny.mcap"
    path.write_bytes(b"\x89MCAP0\r\n" + HEAD.pack(6, len(content)) + content)
    command = [sys.executable, "-c", PROBE, str(path)]
    result = subprocess.run(command, capture_output=True, text=True, timeout=60, check=True)
    said, peak_mb = result.stdout.split("\n")[:2]
    assert said == "1000000 True"  # it has no footer
    assert int(peak_mb) <= 256


@pytest.mark.parametrize(
    "data",
    [b"", b"\x89MC", b"\x89MCAP0\r\n", b"\x89MCAP0\r\n" + HEAD.pack(1, 1 << 62), bytes(1000)],
)
def test_what_a_crash_leaves_of_a_new_file_is_damage_and_no_error(
    tmp_path: Path, data: bytes
) -> None:
    messages, stream = read(tmp_path / "a.mcap", data)
    assert messages == []
    assert stream is not None
    assert stream.damage


def test_a_log_whose_first_byte_is_wrong_is_still_a_log(tmp_path: Path) -> None:
    log = whole_log(tmp_path / "a.mcap", 30, "lz4")
    messages, stream = read(tmp_path / "b.mcap", b"\x00" + log.data[1:])
    assert messages == log.messages
    assert stream is not None
    assert stream.damage


def test_a_search_for_chunks_ends(tmp_path: Path) -> None:
    """A file of nothing but what looks like the start of a chunk."""
    sign = struct.pack("<QQQII", 0, 0, 40, 1, 0) + struct.pack("<Q", 40)
    path = tmp_path / "a.mcap"
    path.write_bytes(b"\x89MCAP0\r\n" + sign * 100_000)
    stream = McapStream(path)
    assert list(stream.messages()) == []
    assert stream.damage
