"""Checkpoints as files: what is read is what was written, or nothing; a crash leaves one of two."""

from __future__ import annotations

import errno
import os
import random
import struct
import zlib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from facet.checkpoint import (
    FORMAT,
    MAGIC,
    Checkpoint,
    CheckpointError,
    checkpoint_paths,
    is_checkpoint,
    read_checkpoint,
    write_checkpoint,
)


def sample(number: int = 1) -> Checkpoint:
    arrays = {
        "moments": np.arange(60, dtype=np.int64).reshape(6, 10) * number,
        "sigma": np.array([0.1, np.nan, -0.0]),
        "flags": np.array([True, False]),
        "empty": np.zeros((0, 3), np.int32),
        "words": np.array(["r1/lidar", "r2"]),
        "one": np.array(7, np.uint16),
        "strided": np.arange(10, dtype=np.uint8)[::3],
    }
    return Checkpoint({"map": "hall", "number": number}, arrays)


def same(a: Checkpoint, b: Checkpoint) -> bool:
    return (
        a.header == b.header
        and set(a.arrays) == set(b.arrays)
        and all(
            x.dtype == b.arrays[n].dtype
            and x.shape == b.arrays[n].shape
            and x.tobytes() == b.arrays[n].tobytes()
            for n, x in a.arrays.items()
        )
    )


def written(folder: Path, number: int = 1, **options: Any) -> Path:
    newest, previous = checkpoint_paths(folder, "hall")
    write_checkpoint(newest, previous, sample(number), **options)
    return newest


def test_what_is_read_is_what_was_written(tmp_path: Path) -> None:
    path = written(tmp_path)
    assert same(read_checkpoint(path), sample())
    read_checkpoint(path).arrays["moments"][0, 0] = 5  # it is ours to change
    assert is_checkpoint(path)
    assert [p.name for p in tmp_path.iterdir()] == ["hall.checkpoint"]
    assert path.stat().st_mode & 0o137 == 0


def test_the_same_map_gives_the_same_bytes(tmp_path: Path) -> None:
    first = written(tmp_path).read_bytes()
    shuffled = dict(reversed(sample().arrays.items()))
    newest, previous = checkpoint_paths(tmp_path, "hall")
    write_checkpoint(newest, previous, Checkpoint(sample().header, shuffled))
    assert newest.read_bytes() == previous.read_bytes() == first


def test_the_previous_one_is_kept(tmp_path: Path) -> None:
    for number in (1, 2, 3):
        written(tmp_path, number)
    newest, previous = checkpoint_paths(tmp_path, "hall")
    assert read_checkpoint(newest).header["number"] == 3
    assert read_checkpoint(previous).header["number"] == 2


def test_cut_anywhere_it_is_refused(tmp_path: Path) -> None:
    path = written(tmp_path)
    whole = path.read_bytes()
    for length in range(len(whole)):
        path.write_bytes(whole[:length])
        with pytest.raises(CheckpointError):
            read_checkpoint(path)
    path.write_bytes(whole + b"\0")
    with pytest.raises(CheckpointError, match="not what it says"):
        read_checkpoint(path)


def test_any_bit_flipped_it_is_refused(tmp_path: Path) -> None:
    path = written(tmp_path)
    whole = path.read_bytes()
    for bit in random.Random(3).sample(range(8 * len(whole)), 1500):
        flipped = bytearray(whole)
        flipped[bit >> 3] ^= 1 << (bit & 7)
        path.write_bytes(flipped)
        with pytest.raises(CheckpointError):
            read_checkpoint(path)


def forged(header: bytes, body: bytes = b"", version: int = FORMAT) -> bytes:
    """A file whose checksums are right, whatever is in it."""
    sums = (zlib.crc32(header), zlib.crc32(body))
    return struct.pack("<8sIIIIQ", MAGIC, version, len(header), *sums, len(body)) + header + body


@pytest.mark.parametrize(
    ("data", "reason"),
    [
        (forged(b"{}", version=FORMAT + 1), "its format is 2"),
        (forged(b"{"), "no sense"),
        (forged(b"[]"), "no sense"),
        (forged(b"{}"), "no sense"),
        (forged(b'{"arrays": 5}'), "no sense"),
        (forged(b'{"arrays": [["a"]]}'), "no sense"),
        (forged(b'{"arrays": [["a", "|O", [1], 0]]}', bytes(64)), "no sense"),
        (forged(b'{"arrays": [["a", "<i8", [9], 0]]}', bytes(64)), "no sense"),
        (forged(b'{"arrays": [["a", "<i8", [-1], 0]]}', bytes(64)), "no sense"),
        (forged(b'{"arrays": [["a", "<i8", [1], 8]]}', bytes(64)), "no sense"),
        (forged(b'{"arrays": [["a", "<i8", [99999999999, 99999999999], 0]]}'), "no sense"),
        (forged(b'{"arrays": [["a", "<i8", ["1"], 0]]}', bytes(64)), "no sense"),
        (forged(b'{"arrays": [["a", "<a4", [1], 0]]}', bytes(64)), "no sense"),
        (forged(b'{"arrays": [["a", "<i8,<i8", [1], 0]]}', bytes(64)), "no sense"),
        (forged(b'{"arrays": ' + b"[" * 100_000), "no sense"),
    ],
)
def test_what_makes_no_sense_is_refused(tmp_path: Path, data: bytes, reason: str) -> None:
    path = tmp_path / "a.checkpoint"
    path.write_bytes(data)
    with pytest.raises(CheckpointError, match=reason):
        read_checkpoint(path)


@given(st.binary(max_size=200))
def test_any_header_is_read_or_refused(tmp_path_factory: Any, header: bytes) -> None:
    path = tmp_path_factory.getbasetemp() / "any.checkpoint"
    path.write_bytes(forged(header, bytes(64)))
    try:
        read_checkpoint(path)
    except CheckpointError:
        return


def test_objects_are_not_written(tmp_path: Path) -> None:
    newest, previous = checkpoint_paths(tmp_path, "hall")
    with pytest.raises(TypeError, match="object"):
        write_checkpoint(newest, previous, Checkpoint({}, {"a": np.array([{}])}))


class FailingSystem:
    """os, whose n-th call fails; what a call half does, it half does."""

    def __init__(self, nth: int, for_ever: bool, error: int) -> None:
        self.num_calls = 0
        self._nth, self._for_ever, self._error = nth, for_ever, error

    def __getattr__(self, name: str) -> Callable[..., Any]:
        call = getattr(os, name)

        def wrapped(*args: Any) -> Any:
            self.num_calls += 1
            late = self.num_calls > self._nth
            if self.num_calls == self._nth or (late and self._for_ever):
                if name == "write":
                    call(args[0], args[1][: len(args[1]) // 2])
                raise OSError(self._error, os.strerror(self._error))
            return call(*args)

        return wrapped


@pytest.mark.parametrize("for_ever", [False, True])
@pytest.mark.parametrize("error", [errno.ENOSPC, errno.EIO])
def test_every_call_that_fails_leaves_a_good_checkpoint(
    tmp_path: Path, for_ever: bool, error: int
) -> None:
    """Also none of the calls leaves the map without one."""
    newest, previous = checkpoint_paths(tmp_path, "hall")
    counting = FailingSystem(0, False, 0)
    written(tmp_path, 1, system=counting)
    for nth in range(1, counting.num_calls + 1):
        written(tmp_path, 1)
        failing = FailingSystem(nth, for_ever, error)
        try:
            written(tmp_path, 2, system=failing)
        except OSError as failure:
            assert failure.errno == error  # noqa: PT017 the call may also have gone through
        good = [read_checkpoint(p).header["number"] for p in (newest, previous) if p.exists()]
        assert good, f"call {nth}: nothing is left"
        assert set(good) <= {1, 2}
        assert sorted(p.suffix for p in tmp_path.iterdir()) == [".checkpoint"] * len(good)


def test_killed_between_any_two_calls_a_good_checkpoint_is_there(tmp_path: Path) -> None:
    class Killed(BaseException):
        pass

    class Dying(FailingSystem):
        def __getattr__(self, name: str) -> Callable[..., Any]:
            def wrapped(*args: Any) -> Any:
                self.num_calls += 1
                if self.num_calls == self._nth:
                    raise Killed
                return getattr(os, name)(*args)

            return wrapped

    newest, previous = checkpoint_paths(tmp_path, "hall")
    written(tmp_path, 1)
    for nth in range(1, 40):
        dying = Dying(nth, False, 0)
        try:
            written(tmp_path, 2, system=dying)
        except Killed:
            good = [read_checkpoint(p).header["number"] for p in (newest, previous) if p.exists()]
            assert good
        written(tmp_path, 1)  # what it left behind is in nobody's way
    assert dying.num_calls < 39
