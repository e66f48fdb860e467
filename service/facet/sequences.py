"""Which sequence numbers of a source have come: gaps, duplicates and late arrivals, exactly."""

from __future__ import annotations

from bisect import bisect_right
from collections import defaultdict
from dataclasses import dataclass, field


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


class SequenceLedger:
    """What has come from every source, by epoch. A sequence of 0 says nothing and is not kept."""

    def __init__(self) -> None:
        self._seen: defaultdict[str, dict[int, Numbers]] = defaultdict(dict)

    def note(self, source: str, epoch: int, sequence: int) -> tuple[bool, int]:
        """(is new, how many were skipped right before it). A new epoch skips nothing."""
        if sequence == 0:
            return True, 0
        numbers = self._seen[source].setdefault(epoch, Numbers())
        last = numbers.last
        is_new = numbers.add(sequence)
        return is_new, max(0, sequence - last - 1) if last else 0

    def missing(self) -> dict[str, int]:
        """Numbers that have not come, by source; a late arrival takes one away again."""
        return {
            source: sum(numbers.missing for numbers in epochs.values())
            for source, epochs in sorted(self._seen.items())
        }

    def num_epochs(self) -> dict[str, int]:
        return {source: len(epochs) for source, epochs in sorted(self._seen.items())}
