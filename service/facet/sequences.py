"""Which sequence numbers of a source have come: gaps, duplicates and late arrivals, exactly."""

from __future__ import annotations

from bisect import bisect_right
from collections import Counter, defaultdict
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from typing import Any, NamedTuple


@dataclass(slots=True)
class Numbers:
    """A set of positive integers as disjoint ranges: a source without gaps takes two numbers."""

    starts: list[int] = field(default_factory=list)  # ascending
    ends: list[int] = field(default_factory=list)  # inclusive; ends[i] + 1 < starts[i + 1]

    def __contains__(self, number: int) -> bool:
        i = bisect_right(self.starts, number) - 1
        return i >= 0 and number <= self.ends[i]

    def __len__(self) -> int:
        return sum(self.ends) - sum(self.starts) + len(self.starts)

    def add(self, number: int) -> bool:
        """Whether it was new."""
        i = bisect_right(self.starts, number) - 1
        if i >= 0 and number <= self.ends[i]:
            return False
        joins_left = i >= 0 and self.ends[i] == number - 1
        joins_right = i + 1 < len(self.starts) and self.starts[i + 1] == number + 1
        if joins_left and joins_right:
            self.ends[i] = self.ends.pop(i + 1)
            del self.starts[i + 1]
        elif joins_left:
            self.ends[i] = number
        elif joins_right:
            self.starts[i + 1] = number
        else:
            self.starts.insert(i + 1, number)
            self.ends.insert(i + 1, number)
        return True

    @property
    def first(self) -> int:
        return self.starts[0] if self.starts else 0

    @property
    def last(self) -> int:
        return self.ends[-1] if self.ends else 0

    @property
    def missing(self) -> int:
        """How many lie between the first and the last and have not come."""
        return self.last - self.first + 1 - len(self) if self.starts else 0


class Noted(NamedTuple):
    """What a sequence number tells about its source."""

    is_new: bool  # False: it has come before
    skipped: int = 0  # how many are found missing by it: a range that starts at
    first_skipped: int = 0  # this number
    is_late: bool = False  # it fills a gap that was counted
    is_restart: bool = False  # the publisher has begun anew
    is_interleaved: bool = False  # an epoch that had ended goes on: two publishers, one name


class SequenceLedger:
    """What has come from every source, by epoch. A sequence of 0 says nothing and is not kept."""

    def __init__(self) -> None:
        self._seen: defaultdict[str, dict[int, Numbers]] = defaultdict(dict)
        self._current: dict[str, int] = {}  # the epoch of the last message
        self._skipped: Counter[str] = Counter()
        self._late: Counter[str] = Counter()

    def note(self, source: str, epoch: int, sequence: int) -> Noted:
        """Take one number. A new epoch skips nothing: what it began with is not known."""
        if sequence == 0:
            return Noted(True)
        epochs = self._seen[source]
        ends = epochs[epoch].ends if epoch in epochs else []
        if ends and ends[-1] == sequence - 1 and self._current.get(source) == epoch:
            ends[-1] = sequence
            return Noted(True, 0, sequence)  # the next one, as most are
        is_restart = bool(epochs) and epoch not in epochs
        is_interleaved = epoch in epochs and epoch != self._current[source]
        self._current[source] = epoch
        numbers = epochs.setdefault(epoch, Numbers())
        first, last = numbers.first, numbers.last
        is_new = numbers.add(sequence)
        start, end = (sequence, first) if sequence < first else (last or sequence, sequence)
        skipped = max(0, end - start - 1)
        is_late = is_new and first < sequence < last
        self._skipped[source] += skipped
        self._late[source] += is_late
        return Noted(is_new, skipped, start + 1, is_late, is_restart, is_interleaved)

    def find(self, source: str, epoch: int, sequence: int) -> int | None:
        """The epoch in which a number has come, or None. An epoch of 0 that the source never had
        is the one of its last message."""
        epochs = self._seen.get(source, {})
        if not epoch and epoch not in epochs:
            epoch = self._current.get(source, 0)
        return epoch if epoch in epochs and sequence in epochs[epoch] else None

    def between(self, source: str, epoch: int, first: int, last: int) -> Iterator[tuple[int, int]]:
        """(epoch, sequence) of what has come from `first` to `last`; of epoch 0: of every one."""
        for known, numbers in self._seen.get(source, {}).items():
            if epoch and epoch != known:
                continue
            for start, end in zip(numbers.starts, numbers.ends, strict=True):
                for sequence in range(max(start, first), min(end, last) + 1):
                    yield known, sequence

    def freeze(self) -> dict[str, Any]:
        """All of it, as JSON knows it."""
        return {
            source: {
                "epochs": [[e, n.starts, n.ends] for e, n in epochs.items()],
                "current": self._current[source],
                "skipped": self._skipped[source],
                "late": self._late[source],
            }
            for source, epochs in sorted(self._seen.items())
            if epochs
        }

    @staticmethod
    def thaw(frozen: Mapping[str, Any]) -> SequenceLedger:
        """What was frozen. Raises KeyError, TypeError, ValueError for anything else."""
        ledger = SequenceLedger()
        for source, kept in frozen.items():
            for epoch, starts, ends in kept["epochs"]:
                numbers = Numbers(list(map(int, starts)), list(map(int, ends)))
                ledger._seen[source][int(epoch)] = numbers
            ledger._current[source] = int(kept["current"])
            ledger._skipped[source] = int(kept["skipped"])
            ledger._late[source] = int(kept["late"])
        return ledger

    def missing(self, source: str | None = None) -> dict[str, int]:
        """Numbers that have not come, by source; a late arrival takes one away again."""
        sources = sorted(self._skipped) if source is None else [source]
        return {s: self._skipped[s] - self._late[s] for s in sources}

    def newest(self, source: str) -> tuple[int, int, int]:
        """(epoch, newest number, how many before it are missing) of its last message's epoch."""
        epoch = self._current.get(source, 0)
        numbers = self._seen.get(source, {}).get(epoch, Numbers())
        return epoch, numbers.last, numbers.missing

    def num_epochs(self) -> dict[str, int]:
        return {source: len(epochs) for source, epochs in sorted(self._seen.items())}
