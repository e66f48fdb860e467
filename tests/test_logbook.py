"""The log of the service, read by somebody, by nobody, and by one who went away."""

from __future__ import annotations

import logging
import os
import re
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path

import pytest

from facet.logbook import LINE, MAX_WAITING, PATIENCE_S, Logbook
from facet.sinks.log_file import write_recording
from rig import room, wait_until
from test_commands import Running, process

NUM_LINES = MAX_WAITING + 5_000  # of 100 bytes: more than waits and a pipe takes


@pytest.fixture
def pipe() -> Iterator[tuple[int, int]]:
    """A pipe's ends to read from and to write to."""
    ends = os.pipe()
    yield ends
    for end in ends:
        with suppress(OSError):  # where the test did
            os.close(end)


def write_lines(book: Logbook, num: int) -> None:
    logger = logging.Logger("facet.test")
    logger.addHandler(book)
    book.setFormatter(logging.Formatter(LINE))
    for k in range(num):
        logger.warning("line %d %s", k, "." * 60)


def fill(descriptor: int) -> None:
    """Until a write would block."""
    os.set_blocking(descriptor, False)
    try:
        while True:
            os.write(descriptor, b"." * 512)
    except BlockingIOError:
        os.set_blocking(descriptor, True)


def read_all(descriptor: int) -> str:
    text = b""
    while piece := os.read(descriptor, 1 << 16):
        text += piece
    return text.decode()


def test_lines_are_written_in_order_and_whole(pipe: tuple[int, int]) -> None:
    book = Logbook(pipe[1])
    write_lines(book, 50)
    book.close()
    os.close(pipe[1])
    lines = read_all(pipe[0]).splitlines()
    assert [line.split()[5] for line in lines] == [str(k) for k in range(50)]
    assert lines[0].split()[2:5] == ["WARNING", "facet.test:", "line"]
    assert book.num_dropped == 0


def test_nobody_reads_and_nobody_waits(pipe: tuple[int, int]) -> None:
    """Each line is written or counted; who comes to read is told how many are not there."""
    book = Logbook(pipe[1])
    fill(pipe[1])
    write_lines(book, NUM_LINES)  # would hang here
    assert NUM_LINES - MAX_WAITING - 1 <= book.num_dropped <= NUM_LINES - MAX_WAITING
    started = time.monotonic()
    book.close()
    assert time.monotonic() - started < 2 * PATIENCE_S + 1
    os.set_blocking(pipe[0], False)
    text = b""

    def read_on() -> bool:
        nonlocal text
        with suppress(BlockingIOError):
            text += os.read(pipe[0], 1 << 16)
        return text.count(b" line ") + book.num_dropped == NUM_LINES

    wait_until(read_on, 20)
    told = re.findall(rb"\((\d+) lines of log were dropped", text)
    assert sum(map(int, told)) == book.num_dropped


def test_a_reader_that_goes_away_ends_nothing(pipe: tuple[int, int]) -> None:
    book = Logbook(pipe[1])
    os.close(pipe[0])
    write_lines(book, 3)
    book.close()
    assert book.num_dropped == 3


def test_the_next_reader_is_told_of_every_line_that_was_lost(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "log")
    reader = os.open(tmp_path / "log", os.O_RDONLY | os.O_NONBLOCK)
    writer = os.open(tmp_path / "log", os.O_WRONLY)
    os.close(reader)
    book = Logbook(writer)
    write_lines(book, 5)
    wait_until(lambda: book.num_dropped == 5, 20)
    reader = os.open(tmp_path / "log", os.O_RDONLY | os.O_NONBLOCK)
    os.set_blocking(reader, True)
    write_lines(book, 2)
    book.close()
    os.close(writer)
    text = read_all(reader)
    os.close(reader)
    assert text.count(" line ") == 2
    assert text.count("(5 lines of log were dropped") == text.count("dropped") == 1


def test_a_message_that_cannot_be_formatted_ends_nobody(pipe: tuple[int, int]) -> None:
    book = Logbook(pipe[1])
    logger = logging.Logger("facet.test")
    logger.addHandler(book)
    logger.info("%d scans", "three")
    book.close()
    os.close(pipe[1])
    assert "facet.test: '%d scans' cannot be formatted" in read_all(pipe[0])


def test_no_other_file_is_taken_for_a_closed_standard_error(tmp_path: Path) -> None:
    """The next file that is opened has its number."""
    program = (
        "import logging, sys; from facet.logbook import keep_log; own = open(sys.argv[1], 'w');"
        "assert own.fileno() == 2; keep_log(); logging.warning('not for this file');"
        "logging.shutdown(); own.write('data')"
    )
    command = f'"{sys.executable}" -c "{program}" "{tmp_path / "data"}" 2>&-'
    assert subprocess.run(command, shell=True, check=False).returncode == 0
    assert (tmp_path / "data").read_text() == "data"


def test_a_service_goes_on_when_nobody_reads_its_log(tmp_path: Path) -> None:
    """Standard error is a full pipe from the start: it maps, and ends as ever."""
    log, folder = tmp_path / "room.mcap", tmp_path / "log"
    write_recording(log, room(6), {"map": "room", "frame": "map"})
    folder.mkdir()
    os.mkfifo(folder / "stderr.txt")
    reader = os.open(folder / "stderr.txt", os.O_RDONLY | os.O_NONBLOCK)
    writer = os.open(folder / "stderr.txt", os.O_WRONLY)
    fill(writer)
    service = Running(folder)
    try:
        played = process("play", log, "--connect", service.endpoint, "--speed", "max")
        assert played.returncode == 0, played.stderr
        code, output = service.stop()
    finally:
        service.process.kill()
        service.process.wait()
        os.close(reader)
        os.close(writer)
    assert code == 0, output
    assert "recorded 6 of 6 received (100.0 %)" in output
