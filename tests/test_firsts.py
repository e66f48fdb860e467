"""Duplicates: by number, and by stamp and bytes where a number says nothing."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

from typer.testing import CliRunner

from facet.__main__ import app
from facet.commands.replay import replay_log
from facet.config import Config
from facet.firsts import Firsts
from facet.sinks.log_file import write_recording
from facet_protocol.messages import Envelope
from rig import room, unnumbered


def foreign(number: int, sequence: int) -> Envelope:
    return replace(room(number)[-1], key="/points", epoch=0, sequence=sequence)


def test_by_number_or_by_bytes() -> None:
    firsts, (one, two) = Firsts(), room(2)
    said = [one, one, replace(two, sequence=1), two, unnumbered(one), unnumbered(one)]
    assert [firsts.is_first(e, "r1/lidar") for e in said] == [True, False, False, True, True, False]
    again = Firsts()
    again.thaw(firsts.freeze())
    for known in (firsts, again):
        assert not known.is_first(two, "r1/lidar")
        assert not known.is_first(unnumbered(one), "r1/lidar")
        assert known.is_first(two, "r2/lidar")
        assert known.epoch_of("r1/lidar", 0, 1) == 5  # the epoch it is in
        assert known.epoch_of("r1/lidar", 6, 1) is None
        assert known.epoch_of("r1/lidar", 5, 3) is None


def test_numbers_from_elsewhere_may_begin_anew(tmp_path: Path) -> None:
    """In one channel, without an epoch: only the same stamp and bytes are the same scan."""
    scans = [foreign(k, sequence) for k, sequence in enumerate([1, 2, 3, 1, 2], 1)]
    write_recording(tmp_path / "a.mcap", [*scans, scans[4]], {})
    result = replay_log([tmp_path], Config())
    assert result.account["applied"] == 5
    assert result.account["duplicate"] == 1
    said = CliRunner().invoke(app, ["info", str(tmp_path)]).output
    (row,) = [line.strip(" │|").split() for line in said.splitlines() if " robot/points " in line]
    numbers = [word for word in row if word.isdecimal()]
    assert (numbers[0], numbers[-1]) == ("6", "1")  # scans, duplicates
