"""Sequence numbers: gaps, duplicates and late arrivals, against a plain set."""

from __future__ import annotations

from hypothesis import given
from hypothesis import strategies as st

from facet.sequences import Noted, Numbers, SequenceLedger


@given(st.lists(st.integers(1, 40)))
def test_numbers_are_a_set(sequences: list[int]) -> None:
    numbers, seen = Numbers(), set[int]()
    for sequence in sequences:
        assert numbers.add(sequence) is (sequence not in seen)
        seen.add(sequence)
    assert len(numbers) == len(seen)
    assert all((k in numbers) is (k in seen) for k in range(42))
    assert numbers.missing == (max(seen) - min(seen) + 1 - len(seen) if seen else 0)
    assert all(e + 1 < s for e, s in zip(numbers.ends, numbers.starts[1:], strict=False))


@given(st.lists(st.integers(1, 40)))
def test_what_is_missing_is_what_a_set_says(sequences: list[int]) -> None:
    ledger, numbers = SequenceLedger(), Numbers()
    for sequence in sequences:
        noted = ledger.note("r/s", 1, sequence)
        assert noted.is_new is numbers.add(sequence)
        assert ledger.missing("r/s") == {"r/s": numbers.missing}
        lost = range(noted.first_skipped, noted.first_skipped + noted.skipped)
        assert not any(number in numbers for number in lost)


def test_a_late_arrival_closes_its_gap() -> None:
    ledger = SequenceLedger()
    noted = [ledger.note("r/s", 1, k) for k in (4, 5, 8)]
    assert [(n.is_new, n.skipped, n.is_late) for n in noted] == [
        (True, 0, False),
        (True, 0, False),
        (True, 2, False),
    ]
    assert noted[2].first_skipped == 6
    assert ledger.missing() == {"r/s": 2}
    assert ledger.note("r/s", 1, 6).is_late
    assert not ledger.note("r/s", 1, 6).is_new
    assert ledger.missing() == {"r/s": 1}


def test_a_new_epoch_is_no_loss() -> None:
    ledger = SequenceLedger()
    assert not ledger.note("r/s", 1, 100).is_restart
    noted = ledger.note("r/s", 2, 1)
    assert (noted.is_new, noted.skipped, noted.is_restart) == (True, 0, True)
    assert not noted.is_interleaved
    assert ledger.missing() == {"r/s": 0}
    assert ledger.num_epochs() == {"r/s": 2}


def test_two_publishers_under_one_name_are_seen() -> None:
    ledger = SequenceLedger()
    noted = [ledger.note("r/s", epoch, 1 + k) for k, epoch in enumerate((1, 2, 1, 2))]
    assert [n.is_interleaved for n in noted] == [False, False, True, True]
    assert [n.is_restart for n in noted] == [False, True, False, False]


def test_no_sequence_says_nothing() -> None:
    ledger = SequenceLedger()
    assert all(ledger.note("r/s", 0, 0) == Noted(True) for _ in range(2))
    assert ledger.missing() == {}
