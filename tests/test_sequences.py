"""Sequence numbers: gaps, duplicates and late arrivals, against a plain set."""

from __future__ import annotations

from hypothesis import given
from hypothesis import strategies as st

from facet.sequences import Numbers, SequenceLedger


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


def test_a_late_arrival_closes_its_gap() -> None:
    ledger = SequenceLedger()
    assert [ledger.note("r/s", 1, k) for k in (4, 5, 8)] == [(True, 0), (True, 0), (True, 2)]
    assert ledger.missing() == {"r/s": 2}
    assert ledger.note("r/s", 1, 6) == (True, 0)
    assert ledger.note("r/s", 1, 6) == (False, 0)
    assert ledger.missing() == {"r/s": 1}


def test_a_new_epoch_is_no_loss() -> None:
    ledger = SequenceLedger()
    ledger.note("r/s", 1, 100)
    assert ledger.note("r/s", 2, 1) == (True, 0)
    assert ledger.missing() == {"r/s": 0}
    assert ledger.num_epochs() == {"r/s": 2}


def test_no_sequence_says_nothing() -> None:
    ledger = SequenceLedger()
    assert [ledger.note("r/s", 0, 0) for _ in range(2)] == [(True, 0), (True, 0)]
    assert ledger.missing() == {}
