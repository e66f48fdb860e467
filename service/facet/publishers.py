"""Who may speak under a name where only one may: the publisher that was there first. No clock."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

PATIENCE = 100  # scans of others in a row, none of the first: it has gone


@dataclass(slots=True)
class Name:
    """A source, whose publishers are known by their epochs."""

    owner: int  # epoch
    newest: int  # its largest sequence
    num_others: int = 0  # scans of other epochs since it last went on
    is_contested: bool = False  # it went on after another had begun


class Publishers:
    """A new epoch is a restart, and welcome, until the one before it goes on: then there are two,
    and only the first is heard, as long as it speaks."""

    def __init__(self) -> None:
        self._names: dict[str, Name] = {}

    def admits(self, source: str, epoch: int, sequence: int) -> bool:
        """Whether the scan is of the one that may speak. A number of 0 says nothing."""
        if sequence == 0:
            return True
        name = self._names.setdefault(source, Name(epoch, 0))
        if epoch == name.owner:
            if sequence > name.newest:  # a late one tells nothing of who speaks now
                name.is_contested |= name.num_others > 0
                name.num_others = 0
            name.newest = max(name.newest, sequence)
            return True
        name.num_others += 1
        if name.num_others >= PATIENCE:
            self._names[source] = Name(epoch, sequence)
            return True
        return not name.is_contested

    def freeze(self) -> dict[str, NDArray[Any]]:
        """What it knows, for a checkpoint."""
        rows = [
            [source, n.owner, n.newest, n.num_others, n.is_contested]
            for source, n in sorted(self._names.items())
        ]
        return {"publishers": np.frombuffer(json.dumps(rows).encode(), np.uint8)}

    def thaw(self, frozen: Mapping[str, NDArray[Any]]) -> None:
        """Know what was frozen. Raises KeyError, TypeError, ValueError for anything else."""
        for source, owner, newest, num_others, is_contested in json.loads(
            frozen["publishers"].tobytes()
        ):
            numbers = (int(owner), int(newest), int(num_others))
            self._names[str(source)] = Name(*numbers, bool(is_contested))
