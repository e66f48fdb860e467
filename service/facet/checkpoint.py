"""A checkpoint: arrays and a header in one file that is whole, or is refused. No pickles.

    8 bytes   magic
    u32, u32  version of this format; length of the header
    u32, u32  CRC-32 of the header; of what follows it
    u64       length of what follows it
    header    JSON; `arrays` lists name, dtype, shape and offset of each
    arrays    raw, C order, little-endian, each at a multiple of 64

It gets its name when it is on the disk; the one before it is kept beside it.
"""

from __future__ import annotations

import json
import math
import os
import re
import struct
import zlib
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

MAGIC = b"FACETCP\n"
FORMAT = 1
SUFFIX = ".checkpoint"
ALIGNMENT = 64
MAX_HEADER_BYTES = 64 << 20
_PREAMBLE = struct.Struct("<8sIIIIQ")
_KINDS = "biufSU"  # of dtypes: plain numbers and fixed strings
_DTYPE = re.compile(rf"[<|][{_KINDS}][0-9]{{1,4}}")  # as numpy spells them: it reads much more
_PIECE = 4 << 20  # on the disk at a time: a log on the same disk does not wait for all of it

Arrays = Mapping[str, NDArray[Any]]


class CheckpointError(ValueError):
    """A checkpoint that cannot be used: which, and why."""

    def __init__(self, path: Path, reason: str) -> None:
        super().__init__(f"{path}: {reason}")
        self.path, self.reason = path, reason


@dataclass(frozen=True, slots=True, eq=False)
class Checkpoint:
    """What is kept of a map: `header` says of what, and up to where in the log."""

    header: dict[str, Any]  # JSON
    arrays: dict[str, NDArray[Any]]


def checkpoint_paths(directory: Path, map_id: str) -> tuple[Path, Path]:
    """The newest checkpoint of a map, and the one before it."""
    return directory / f"{map_id}{SUFFIX}", directory / f"{map_id}.previous{SUFFIX}"


def is_checkpoint(path: Path) -> bool:
    """Whether it says it is one."""
    if not path.is_file():
        return False
    with path.open("rb") as file:
        return file.read(len(MAGIC)) == MAGIC


def write_checkpoint(path: Path, previous: Path, checkpoint: Checkpoint, system: Any = os) -> int:
    """Make it durable under `path`; what was there goes to `previous`. How many bytes it takes.

    Raises OSError, and then both are what they were, or `previous` is the newest. `system` is os,
    or in tests what fails like it.
    """
    partial = path.with_name(path.name + ".part")
    head, pieces = _laid_out(checkpoint)
    fd = system.open(partial, os.O_WRONLY | os.O_CREAT | os.O_TRUNC | os.O_CLOEXEC, 0o640)
    try:
        try:
            num_bytes = sum(_write(system, fd, piece) for piece in (memoryview(head), *pieces))
            system.fsync(fd)
        finally:
            os.close(fd)
        with suppress(FileNotFoundError):
            system.replace(path, previous)
        system.replace(partial, path)
        _sync_names(system, path.parent)
    except OSError:
        with suppress(OSError):
            partial.unlink(missing_ok=True)
        raise
    return num_bytes


def _laid_out(checkpoint: Checkpoint) -> tuple[bytes, list[memoryview]]:
    """(all before the arrays, the arrays with what lies between them)."""
    table, pieces, at, crc = [], [], 0, 0
    for name in sorted(checkpoint.arrays):
        array = np.asarray(checkpoint.arrays[name])
        if array.dtype.kind not in _KINDS:
            raise TypeError(f"{name} is an array of {array.dtype}")
        array = array.astype(array.dtype.newbyteorder("<"), order="C", copy=False)
        table.append([name, array.dtype.str, list(array.shape), at])
        gap = bytes(-array.nbytes % ALIGNMENT)
        for piece in (array.reshape(-1).view(np.uint8).data, memoryview(gap)):
            crc = zlib.crc32(piece, crc)
            at += piece.nbytes
            pieces.append(piece)
    header = {**checkpoint.header, "arrays": table}
    text = json.dumps(header, sort_keys=True, separators=(",", ":")).encode()
    sums = (zlib.crc32(text), crc)
    return _PREAMBLE.pack(MAGIC, FORMAT, len(text), *sums, at) + text, pieces


def _write(system: Any, fd: int, data: memoryview) -> int:
    num_bytes = 0
    while num_bytes < data.nbytes:
        num_written = system.write(fd, data[num_bytes : num_bytes + _PIECE])
        if num_written <= 0:
            raise OSError("nothing could be written")
        num_bytes += num_written
        if data.nbytes >= _PIECE:
            system.fsync(fd)
    return num_bytes


def _sync_names(system: Any, directory: Path) -> None:
    fd = system.open(directory, os.O_RDONLY | os.O_DIRECTORY | os.O_CLOEXEC)
    try:
        system.fsync(fd)
    finally:
        os.close(fd)


def read_checkpoint(path: Path) -> Checkpoint:
    """What was written, to the bit. Raises CheckpointError for anything else, and OSError.

    Takes the memory of the file and no more; the arrays share it and can be written to.
    """
    with path.open("rb") as file:
        size = os.fstat(file.fileno()).st_size
        preamble = file.read(_PREAMBLE.size)
        if len(preamble) < _PREAMBLE.size or not preamble.startswith(MAGIC):
            raise CheckpointError(path, "this is no checkpoint")
        _, version, num_head, head_crc, crc, num_body = _PREAMBLE.unpack(preamble)
        if version != FORMAT:
            raise CheckpointError(path, f"its format is {version}, this version reads {FORMAT}")
        if num_head > MAX_HEADER_BYTES or _PREAMBLE.size + num_head + num_body != size:
            raise CheckpointError(path, f"{size} bytes are not what it says it has")
        text = file.read(num_head)
        if zlib.crc32(text) != head_crc:
            raise CheckpointError(path, "the checksum of its header is wrong")
        body = np.fromfile(file, dtype=np.uint8, count=num_body)
    if len(body) != num_body or zlib.crc32(body.data) != crc:
        raise CheckpointError(path, "the checksum of its arrays is wrong")
    try:
        header = json.loads(text)
        arrays = {str(row[0]): _array(body, *row[1:]) for row in header.pop("arrays")}
    except (ValueError, TypeError, LookupError, AttributeError, RecursionError) as error:
        raise CheckpointError(path, f"its header makes no sense ({error})") from error
    return Checkpoint(header, arrays)


def _array(body: NDArray[np.uint8], dtype: str, shape: list[int], at: int) -> NDArray[Any]:
    """One array of the table. Raises ValueError, TypeError where it cannot be."""
    if _DTYPE.fullmatch(dtype) is None or any(n < 0 for n in shape) or at < 0 or at % ALIGNMENT:
        raise ValueError(f"an array of {dtype} {shape} at {at}")
    kind = np.dtype(dtype)
    num_bytes = math.prod(shape) * kind.itemsize
    if at + num_bytes > len(body):
        raise ValueError(f"an array of {dtype} {shape} at {at} in {len(body)} bytes")
    if kind.itemsize == 0:
        return np.zeros(shape, kind)
    return body[at : at + num_bytes].view(kind).reshape(shape)
