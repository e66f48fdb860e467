"""Who may speak where only one may: restarts, two at once, the first gone, late arrivals."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from facet.commands.replay import replay_log
from facet.config import Config, load_config
from facet.mapping.mapper import Mapper
from facet.publishers import PATIENCE, Publishers
from facet.resume import resume
from rig import room_scan, scan_envelope
from test_resume import SETTINGS, Line, told

Said = tuple[int, int]  # epoch, sequence


def heard(publishers: Publishers, said: Iterable[Said]) -> list[Said]:
    return [one for one in said if publishers.admits("r1/a", *one)]


def run(epoch: int, first: int, last: int) -> list[Said]:
    return [(epoch, k) for k in range(first, last + 1)]


def test_a_restart_is_welcome() -> None:
    """Nothing of it is lost, however short the run before it was, or its own."""
    said = [*run(5, 1, 3), *run(6, 1, 2), *run(7, 1, 2 * PATIENCE), *run(8, 1, 5)]
    assert heard(Publishers(), said) == said


def test_of_two_at_once_the_first_is_heard() -> None:
    """What the second said before the first went on could have been a restart."""
    said = [(5, 1), (6, 1), (6, 2), (5, 2), (6, 3), (5, 3), (7, 1), (6, 4), (5, 4)]
    assert heard(Publishers(), said) == [(5, 1), (6, 1), (6, 2), (5, 2), (5, 3), (5, 4)]


def test_when_the_first_is_gone_the_second_is_heard() -> None:
    publishers = Publishers()
    assert len(heard(publishers, [(5, 1), (6, 1), (5, 2)])) == 3
    assert heard(publishers, run(6, 2, PATIENCE + 50)) == run(6, PATIENCE + 1, PATIENCE + 50)
    assert heard(publishers, [(5, 3), (6, PATIENCE + 51)]) == [(5, 3), (6, PATIENCE + 51)]
    assert heard(publishers, [(5, 4)]) == []  # now it is the second


def test_a_late_arrival_is_no_sign_of_life() -> None:
    said = [(5, 1), (5, 3), (6, 1), (5, 2), (6, 2), (5, 3), (6, 3)]
    assert heard(Publishers(), said) == said


def test_without_numbers_nothing_can_be_told() -> None:
    said = [(0, 0), (5, 1), (0, 0), (6, 1), (5, 2), (0, 0)]
    assert heard(Publishers(), said) == said


@given(st.lists(st.tuples(st.integers(1, 3), st.integers(0, 200)), max_size=300), st.integers(0))
def test_what_is_frozen_goes_on(said: list[Said], at: int) -> None:
    one, other = Publishers(), Publishers()
    at %= len(said) + 1
    before = heard(one, said[:at])
    other.thaw({name: np.array(column) for name, column in one.freeze().items()})
    assert heard(one, said[at:]) == heard(other, said[at:])
    assert heard(Publishers(), said)[: len(before)] == before


@pytest.mark.parametrize("keep", [True, False], ids=["checkpoint", "whole log"])
def test_strict_live_resumed_and_replayed(tmp_path: Path, keep: bool) -> None:
    """The log says how it was recorded: its replay refuses the same, unless asked otherwise."""
    overrides = {"record.directory": tmp_path, "mapping.voxel_m": 0.1, "robots.strict": True}
    config = load_config(None, overrides)
    line = Line(tmp_path, resume(config, Mapper(SETTINGS)))
    line.recorder._metadata["config"] = config.model_dump_json(exclude={"network"})
    said = [(5, 1), (6, 1), (5, 2), (6, 2), (5, 3), (6, 3)]
    scans = [scan_envelope(room_scan(k, epoch=e)) for e, k in said]
    for envelope in scans[:4]:
        line.scans(envelope)
    if keep:
        line.checkpoint()
    line.recorder.commit()
    line = Line(tmp_path, resume(config, Mapper(SETTINGS)))
    line.recorder._metadata["config"] = config.model_dump_json(exclude={"network"})
    for envelope in [scans[5], scans[4]]:
        line.scans(envelope)
    line.recorder.close()
    expected = Mapper(SETTINGS)
    for epoch, sequence in [(5, 1), (6, 1), (5, 2), (5, 3)]:
        expected.insert(room_scan(sequence, epoch=epoch))
    expected.update()
    assert line.mapper.digest() == expected.digest()
    replayed = replay_log([tmp_path], Config())
    assert replayed.left_out == {"duplicate_publisher": 2}
    assert told(replayed.mapper)[0] == told(line.mapper)[0]
    lenient = replay_log([tmp_path], load_config(None, {"robots.strict": False}))
    assert lenient.account["applied"] == 6
