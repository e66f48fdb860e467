"""Which message of a source is the first with its number, or without one with its bytes."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from facet.sequences import SequenceLedger
from facet_protocol.messages import Envelope, Erase
from facet_protocol.topics import PREFIX

HASH_BYTES = 16


class Firsts:
    """What has come, by number; what has no number that counts, by a hash of stamp and bytes."""

    def __init__(self) -> None:
        self._numbers = SequenceLedger()
        self._hashes: set[bytes] = set()

    def is_first(self, envelope: Envelope, source: str) -> bool:
        """Whether nothing like it has come from `source` before; it has, from now on."""
        known = self._numbers.note(source, envelope.epoch, envelope.sequence)
        if envelope.sequence and not is_loose(envelope):
            return known.is_new
        stamp = envelope.stamp_ns.to_bytes(8, "little", signed=True)
        digest = hashlib.blake2b(source.encode() + stamp, digest_size=HASH_BYTES)
        digest.update(envelope.payload)
        was_there = digest.digest() in self._hashes
        self._hashes.add(digest.digest())
        return not was_there

    def epoch_of(self, source: str, epoch: int, sequence: int) -> int | None:
        """The epoch in which the number has come; None: it has not. Of epoch 0, where the source
        has none such, the one it is in."""
        return self._numbers.find(source, epoch, sequence)

    def of(self, erase: Erase) -> Iterator[tuple[str, int, int]]:
        """(source, epoch, sequence) of all that has come of what an erasure names."""
        last = erase.last or 1 << 64
        for source in self._numbers.num_epochs():
            robot, _, sensor = source.partition("/")
            is_meant = robot == erase.robot and erase.sensor in ("", sensor)
            if is_meant and not sensor.startswith("@"):
                found = self._numbers.between(source, erase.epoch, erase.first, last)
                yield from ((source, *numbers) for numbers in found)

    def freeze(self) -> dict[str, NDArray[Any]]:
        """What it remembers, for a checkpoint."""
        ledger = json.dumps(self._numbers.freeze(), sort_keys=True).encode()
        hashes = b"".join(sorted(self._hashes))
        return {
            "ledger": np.frombuffer(ledger, np.uint8),
            "unnumbered": np.frombuffer(hashes, np.uint8).reshape(-1, HASH_BYTES),
        }

    def thaw(self, frozen: Mapping[str, NDArray[Any]]) -> None:
        """Remember what was frozen. Raises KeyError, TypeError, ValueError for anything else."""
        self._numbers = SequenceLedger.thaw(json.loads(frozen["ledger"].tobytes()))
        self._hashes = {row.tobytes() for row in frozen["unnumbered"].reshape(-1, HASH_BYTES)}


def is_loose(envelope: Envelope) -> bool:
    """A number that may begin anew without a word: in a recording from elsewhere nothing says that
    its publisher was started again. Then only the same stamp and bytes are the same message."""
    return not envelope.epoch and not envelope.key.startswith(f"{PREFIX}/")
