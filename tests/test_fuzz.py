"""Broken bytes at every door: an error of ours, or a value; never anything else (G6, P14).

Each target is fed mutants of good examples for FACET_FUZZ_S seconds, 2 by default; `make soak`
gives each a minute, and any time may be set. A failure names the seed and the bytes.
"""

from __future__ import annotations

import logging
import os
import random
import resource
import struct
import time
import zlib
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path

import pytest

import examples
import ros_messages as ros
from certificates import SECURE
from facet.checkpoint import Checkpoint, CheckpointError, read_checkpoint, write_checkpoint
from facet.config import ConfigError, load_config, load_credentials
from facet.session import read_access_control
from facet.sinks.log_file import write_recording
from facet.sources.dialects import Dialects
from facet.sources.mcap_damage import LogError
from facet.sources.naming import CORRECTION, robot_and_sensor
from facet.sources.recording import Recording
from facet_protocol import attachment, topics
from facet_protocol.codec import SCHEMAS, decode, encode
from facet_protocol.messages import Envelope, ProtocolError
from facet_protocol.scans import SCAN_SCHEMAS, decode_scan
from fault_rig import Line, envelopes
from rig import room
from test_checkpoint import sample

SECONDS = float(os.environ.get("FACET_FUZZ_S", "2"))
SOAK_S = 60.0
PREAMBLE = struct.Struct("<8sIIIIQ")  # of a checkpoint
SEED = int(os.environ.get("FACET_FUZZ_SEED", "0")) or time.time_ns() % 2**32
NUMBERS = (0, 1, 0x7F, 0x80, 0xFF, 0xFFFF, 2**31 - 1, 2**31, 2**32 - 1, 2**63 - 1, 2**63, 2**64 - 1)


def mutant(rng: random.Random, good: bytes, corpus: list[bytes]) -> bytes:
    """One to four changes: bits, bytes, numbers at the edge, cuts, copies, pieces of others."""
    data = bytearray(good)
    for _ in range(rng.randint(1, 4)):
        at = rng.randrange(len(data) + 1)
        kind = rng.randrange(8)
        if kind == 0 and at < len(data):
            data[at] ^= 1 << rng.randrange(8)
        elif kind == 1 and at < len(data):
            data[at] = rng.randrange(256)
        elif kind == 2:
            size = rng.choice((1, 2, 4, 8))
            number = rng.choice(NUMBERS) % 2 ** (8 * size)
            data[at : at + size] = number.to_bytes(size, rng.choice(("little", "big")))
        elif kind == 3:
            del data[at:]
        elif kind == 4:
            del data[at : at + rng.randint(1, 16)]
        elif kind == 5:
            data[at:at] = data[at : at + rng.randint(1, 64)]
        elif kind == 6:
            data[at:at] = rng.randbytes(rng.randint(1, 16))
        else:
            other = rng.choice(corpus)
            start = rng.randrange(len(other) + 1)
            data[at : at + 32] = other[start : start + rng.randint(1, 64)]
    return bytes(data[: 1 << 20])


@dataclass(frozen=True)
class Target:
    """`feed` takes any bytes and raises nothing but `allowed`."""

    corpus: list[bytes]
    feed: Callable[[bytes], object]
    allowed: tuple[type[Exception], ...]

    def fuzz(self, seconds: float) -> int:
        """How many mutants were fed."""
        rng, num = random.Random(SEED), 0
        for good in self.corpus:
            self.feed(good)  # a target that takes nothing tests nothing
        end = time.monotonic() + seconds
        while time.monotonic() < end:
            data = mutant(rng, rng.choice(self.corpus), self.corpus)
            num += 1
            try:
                self.feed(data)
            except self.allowed:
                continue
            except Exception as error:
                raise AssertionError(f"seed {SEED}, mutant {num}: {data!r:.2000}") from error
        return num


def decoder(folder: Path) -> Target:
    """Every protobuf schema: the first byte says which."""
    names = sorted(SCHEMAS)
    good = [encode(message) for message in examples.EXAMPLES.values()]
    corpus = [bytes([names.index(schema)]) + payload for schema, payload in good]

    def feed(data: bytes) -> None:
        schema = names[data[0] % len(names)] if data else "nothing"
        decode(Envelope(examples.SCAN_KEY, schema, "protobuf", data[1:]))

    return Target(corpus, feed, (ProtocolError,))


def cdr(folder: Path) -> Target:
    """Every message of ROS that is read: the first byte says which."""
    points = examples.CLOUD.points
    messages = [
        ros.cloud(1, "lidar", points),
        ros.fan(1, "lidar", [1.0, 2.0, 3.0]),
        ros.transforms(ros.transform(1, "map", "base", examples.POSE)),
        ros.odometry(1, "map", "base", examples.POSE),
        ros.stamped_pose(1, "map", examples.POSE),
        ros.covariant_pose(1, "map", examples.POSE),
    ]
    names = [message.__msgtype__ for message in messages]
    corpus = [
        bytes([k]) + ros.cdr(message, little)
        for k, message in enumerate(messages)
        for little in (True, False)
    ]

    def feed(data: bytes) -> None:
        name = names[data[0] % len(names)] if data else "nothing"
        envelope = Envelope("rt/scan", name, "cdr", data[1:])
        if name in SCAN_SCHEMAS:
            decode_scan(envelope, "r1", "lidar", pose_required=False)
        else:
            decode(envelope)

    return Target(corpus, feed, (ProtocolError,))


def content(e: Envelope) -> tuple[object, ...]:
    said = (e.key, e.schema, e.encoding, e.stamp_ns, e.received_ns, e.is_derived)
    return (*said, e.epoch, e.sequence, bytes(e.payload))


def log_reader(folder: Path) -> Target:
    """Logs with chunks, compressed or not: what was written, or damage that is reported."""
    scans = [replace(e, payload=bytes(e.payload)[:300]) for e in room(6)]
    written = [content(e) for e in scans]
    path, corpus = folder / "a.mcap", []
    for compression in ("none", "lz4", "zstd"):
        write_recording(path, scans, {"map": "hall"}, compression=compression)
        corpus.append(path.read_bytes())

    def feed(data: bytes) -> None:
        path.write_bytes(data)
        recording = Recording([path])
        read = [content(e) for e in recording]
        is_right = read == written and recording.metadata == {"facet": {"map": "hall"}}
        assert is_right or recording.is_damaged  # nothing wrong, and nothing missing, in silence

    return Target(corpus, feed, (LogError,))


def sealed(data: bytes) -> bytes:
    """A checkpoint's checksums made right again: what they guard is read."""
    if len(data) < PREAMBLE.size:
        return data
    magic, version, size, _, _, length = PREAMBLE.unpack_from(data)
    text, rest = data[PREAMBLE.size :][:size], data[PREAMBLE.size + size :]
    sums = (zlib.crc32(text), zlib.crc32(rest))
    return PREAMBLE.pack(magic, version, size, *sums, length) + text + rest


def checkpoint(folder: Path) -> Target:
    """As damaged, and as forged: with checksums that are right."""
    path, previous = folder / "a", folder / "b"
    corpus = []
    for number in (1, 2):
        write_checkpoint(path, previous, sample(number))
        corpus.append(path.read_bytes())

    def feed(data: bytes) -> Checkpoint:
        path.write_bytes(sealed(data))
        with suppress(CheckpointError):
            read_checkpoint(path)
        path.write_bytes(data)
        return read_checkpoint(path)

    return Target(corpus, feed, (CheckpointError,))


def config(folder: Path) -> Target:
    """Settings, credentials and access tables, with an option on top."""
    path = folder / "a.toml"
    everything = load_config().model_dump(mode="json", exclude_none=True)
    lines = [f"viewer = {everything['viewer']!r}"]
    for name, section in everything.items():
        if isinstance(section, dict):
            lines.append(f"[{name}]")
            scalars = {k: v for k, v in section.items() if isinstance(v, str | int | float)}
            lines += [
                f"{k} = {str(v).lower() if isinstance(v, bool) else repr(v)}"
                for k, v in scalars.items()
            ]
    texts = [p.read_bytes() for p in (*SECURE.glob("*.toml"), SECURE.parent / "service.toml")]
    corpus = ["\n".join(lines).encode(), *texts]

    def feed(data: bytes) -> None:
        path.write_bytes(data)
        with suppress(ConfigError):
            load_config(path, {"map.id": "hall", "mapping.voxel_m": 0.1})
        with suppress(ConfigError):
            load_credentials(path)

    return Target(corpus, feed, ())


def access(folder: Path) -> Target:
    """Tables of who may do what, as JSON5: a mutant that is taken still lets no stranger in."""
    path = folder / "a.json5"
    corpus = [p.read_bytes() for p in SECURE.glob("*.json5")]

    def feed(data: bytes) -> None:
        path.write_bytes(data)
        table = read_access_control(path)
        assert table["default_permission"] == "deny"

    return Target(corpus, feed, (ConfigError,))


def names(folder: Path) -> Target:
    """Key expressions, topics and the 24 bytes beside a scan."""
    keys = (
        examples.SCAN_KEY,
        "facet/v1/map/robot/r1/correction",
        "0/scan/sensor_msgs::msg::dds_::LaserScan_/RIHS01_abc",
        "rt/points",
        "/velodyne/points 2",
    )
    corpus = [*(key.encode() for key in keys), attachment.pack(1, 2, 3)]
    dialects = Dialects()

    def feed(data: bytes) -> None:
        key = data.decode("utf-8", "replace")
        robot, sensor = robot_and_sensor(key)
        assert topics.check_id(robot)
        assert sensor == CORRECTION or topics.check_id(sensor)
        dialects.recognise(key, "application/cdr;sensor_msgs/msg/PointCloud2")
        dialects.recognise_channel(key, "sensor_msgs/msg/PointCloud2", "cdr")
        dialects.learn(key)
        for parse in (topics.parse_scan_key, topics.parse_correction_key):
            with suppress(ProtocolError):
                parse(key)
        with suppress(ProtocolError):
            attachment.unpack(data)

    return Target(corpus, feed, ())


def line(folder: Path) -> Target:
    """Everything behind the door: whatever comes is applied or counted."""
    taken = Line(folder)
    good = envelopes("r1", 1, 2, 3)

    def feed(data: bytes) -> None:
        number = int.from_bytes(data[:2], "little")
        envelope = replace(good[number % 3], payload=data[2:], sequence=number)
        with suppress(OSError):
            taken.take([envelope])

    return Target([b"\x01\x00" + bytes(e.payload) for e in good], feed, ())


TARGETS = (decoder, cdr, log_reader, checkpoint, config, access, names, line)


def memory_mb() -> float:
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024


def fuzz(make: Callable[[Path], Target], folder: Path, seconds: float) -> None:
    target = make(folder)
    before = memory_mb()
    num = target.fuzz(seconds)
    assert num > 20 * seconds, "too slow to be a test"
    assert memory_mb() - before < 256


@pytest.mark.parametrize("make", TARGETS, ids=lambda make: make.__name__)
def test_mutants_raise_what_they_should(
    make: Callable[[Path], Target], tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    caplog.set_level(logging.CRITICAL)
    fuzz(make, tmp_path, SECONDS)


@pytest.mark.slow
@pytest.mark.parametrize("make", TARGETS, ids=lambda make: make.__name__)
def test_mutants_for_longer(
    make: Callable[[Path], Target], tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    caplog.set_level(logging.CRITICAL)
    fuzz(make, tmp_path, max(SECONDS, SOAK_S))
