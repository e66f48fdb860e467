"""Different scans under one number: the one whose payload has the smaller SHA-256 is in the map,
in whatever order they came. No clock."""

from __future__ import annotations

import hashlib
import json
from collections import OrderedDict
from collections.abc import Iterable, Mapping
from enum import StrEnum
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from facet.firsts import is_loose
from facet.past import Number, Past
from facet.sequences import Numbers
from facet_protocol.messages import Envelope, ProtocolError

HORIZON = 8192  # scans of a source whose hashes are known: 200 s at 40 Hz, 65 bytes each
MAX_SOURCES = 256  # whose scans are remembered: the one unheard for longest is forgotten
WINDOW_BYTES = 16 << 20  # of the newest scans of all, as they came; an older one is in the log
FAR_EVERY = 256  # scans of a source for each older rival of its own that the log is read for
MAX_CHOSEN = 1 << 16  # numbers of which a later scan is in the map
HASH_BYTES = 32
COLUMNS = ("numbers", "digests", "placed", "firsts", "met_at")  # of Recent


class Claim(NamedTuple):
    """A scan that wants to be the one of its number."""

    number: Number
    digest: bytes  # SHA-256 of its payload
    num_bytes: int = 0  # of its payload


class Verdict(StrEnum):
    """What is to become of it; the value is the name it is counted under."""

    FIRST = "applied"  # none of its number is in the map
    DUPLICATE = "duplicate"  # it is in the map
    LATE = "late_duplicate"  # the horizon was passed since, or it is one too many of old numbers:
    # the first stays, unseen
    LOSES = "conflict"  # the other has the smaller hash
    WINS = "replaced"  # the other has to go


class Recent:
    """Numbers and hashes of a source's last HORIZON scans; the oldest is overwritten. It takes all
    its memory at once: a robot that drives for hours needs no more than when it came."""

    def __init__(self) -> None:
        self.numbers = _taken((HORIZON, 2), np.uint64)  # epoch, sequence
        self.digests = _taken((HORIZON, HASH_BYTES), np.uint8)
        self.is_placed = _taken((HORIZON,), np.bool_)  # in the map; else it waits, or was refused
        self.firsts = _taken((HORIZON,), np.uint64)  # of the hash of the first with the number
        self.met_at = _taken((HORIZON,), np.int64)  # bytes that had come then
        self.num = 0  # that ever came
        self.asked_at = -FAR_EVERY  # `num` when the log was last to be read for an old rival
        self._last: tuple[int, int] | None = None

    def add(self, epoch: int, sequence: int, digest: bytes, met_at: int = 0) -> None:
        row = self.num % HORIZON
        self.numbers[row] = epoch, sequence
        self.digests[row] = np.frombuffer(digest, np.uint8)
        self.is_placed[row] = False
        self.firsts[row], self.met_at[row] = _prefix(digest), met_at
        self.num += 1
        self._last = epoch, sequence

    def find(self, epoch: int, sequence: int) -> int | None:
        """Its row; None: it is not known any more."""
        if self._last == (epoch, sequence):
            return (self.num - 1) % HORIZON
        known = self.numbers[: self.num]
        same = known == np.array((epoch, sequence), np.uint64)
        rows = np.flatnonzero(same[:, 1] & same[:, 0])
        return int(rows[0]) if len(rows) else None

    def may_ask(self) -> bool:
        """Whether the log may be read for a rival of an old number; it will be."""
        if self.num - self.asked_at < FAR_EVERY:
            return False
        self.asked_at = self.num
        return True

    def columns(self) -> tuple[NDArray[Any], ...]:
        """(N, 2) numbers, (N, 32) hashes, (N,) whether placed, what their firsts were, and when;
        oldest first."""
        order = np.arange(max(0, self.num - HORIZON), self.num) % HORIZON
        return tuple(column[order] for column in self._columns())

    @staticmethod
    def of(columns: Iterable[NDArray[Any]], since_asked: int = FAR_EVERY) -> Recent:
        """What `columns` gave. Raises ValueError for more."""
        recent = Recent()
        for own, column in zip(recent._columns(), columns, strict=True):
            own[: len(column)] = column
            recent.num = len(column)
        recent.asked_at = recent.num - since_asked
        return recent

    def _columns(self) -> tuple[NDArray[Any], ...]:
        return self.numbers, self.digests, self.is_placed, self.firsts, self.met_at


def _taken(shape: tuple[int, ...], dtype: type[np.generic]) -> NDArray[Any]:
    """Zeros whose memory is there, not only promised."""
    out = np.empty(shape, dtype)
    out.fill(0)
    return out


class Rivals:
    """Knows, for the last HORIZON scans of each source, which payload has their number.

    What may not be forgotten is kept for good, and bounded: of which numbers not the first scan of
    the log is in the map, and which are not in it at all.
    """

    def __init__(self, past: Past, *, window_bytes: int = WINDOW_BYTES) -> None:
        self._past, self._window_bytes = past, window_bytes
        self._recent: OrderedDict[str, Recent] = OrderedDict()  # the last heard of is the last
        self._window: OrderedDict[Number, Envelope] = OrderedDict()
        self._num_bytes = 0
        self._met_bytes = 0  # of all scans that ever came
        self._asked, self._claim = Envelope("", "", "", b""), Claim(Number("", 0, 0), b"")
        self._chosen: dict[Number, bytes] = {}
        self._refused: dict[tuple[str, int], Numbers] = {}

    def claim(self, envelope: Envelope, source: str, digest: bytes | None = None) -> Claim | None:
        """What it claims; None for one whose number does not count. `digest`: its hash, where that
        is known (`digest_of`)."""
        if envelope is self._asked:  # most are asked about twice in a row
            return self._claim
        if not envelope.sequence or is_loose(envelope):
            return None
        if max(envelope.epoch, envelope.sequence) >= 1 << 64:  # a log from elsewhere may say so
            return None
        number = Number(source, envelope.epoch, envelope.sequence)
        self._claim = Claim(number, digest or digest_of(envelope), len(envelope.payload))
        self._asked = envelope
        return self._claim

    def meet(self, claim: Claim, *, is_first: bool) -> Verdict:
        """It has come; `is_first`: none with its number had. FIRST and WINS go on to `judge`."""
        number, digest, num_bytes = claim
        self._met_bytes += num_bytes
        if not is_first:
            row = self._row(number)
            if row is None or self._is_one_too_many(self._recent[number.source], row, digest):
                return Verdict.LATE
            is_same = self._recent[number.source].digests[row].tobytes() == digest
            return Verdict.DUPLICATE if is_same else Verdict.WINS
        self._add(number, digest)
        return Verdict.FIRST

    def judge(self, claim: Claim) -> Verdict:
        """It could be in the map now: whether it is to be."""
        number, digest, _ = claim
        row = self._row(number)
        if row is None:
            return Verdict.LATE
        recent = self._recent[number.source]
        if not recent.is_placed[row]:
            return Verdict.FIRST
        kept = recent.digests[row].tobytes()
        if kept == digest:
            return Verdict.DUPLICATE
        return Verdict.WINS if digest < kept else Verdict.LOSES

    def kept(self, number: Number) -> bytes:
        """The hash of the one that is in the map. Raises KeyError when that is not known."""
        row = self._row(number)
        if row is None:
            raise KeyError(number)
        return bytes(self._recent[number.source].digests[row])

    def place(self, claim: Claim, envelope: Envelope) -> None:
        """It is in the map now, and no other of its number. Raises ProtocolError, changing
        nothing, when there is no room to remember it."""
        number, digest, _ = claim
        row, recent = self._row(number), self._recent[number.source]
        assert row is not None
        is_other = recent.digests[row].tobytes() != digest
        if is_other or self._is_refused(number):
            self._choose(number, digest)
        if is_other:
            recent.digests[row] = np.frombuffer(digest, np.uint8)
        recent.is_placed[row] = True
        self._keep(number, envelope)

    def refuse(self, number: Number) -> None:
        """A good scan that is not in the map: no correction may take it out."""
        name = (number.source, number.epoch)
        self._refused.setdefault(name, Numbers()).add(number.sequence)

    def erase(self, number: Number) -> None:
        """It was in the map, and no scan of its number is to be again."""
        self._chosen.pop(number, None)
        self.refuse(number)

    def in_map(self, number: Number) -> Envelope | None:
        """The scan that is in the map, where it is not the first of the log with its number; None
        where it is. Raises ProtocolError (unknown_scan) when none is, and as `find`."""
        digest = self._chosen.get(number)
        if digest is not None:
            return self.find(number, digest)
        if self._is_refused(number):
            text = f"{number.source}: scan {number.sequence} is not in the map"
            raise ProtocolError(text, "unknown_scan")
        return None

    def find(self, number: Number, digest: bytes) -> Envelope:
        """The scan with that payload. Raises OSError, and ProtocolError when the log lacks it."""
        near = self._window.get(number)
        candidates = [near] if near is not None else []
        if not any(digest_of(e) == digest for e in candidates):
            candidates = self._past.read([number]).get(number, [])
        for envelope in candidates:
            if digest_of(envelope) == digest:
                return envelope
        text = f"{number.source}: scan {number.sequence} is not found in the log"
        raise ProtocolError(text, "unreadable_log")

    def freeze(self) -> dict[str, NDArray[Any]]:
        """All but the window, which the log holds."""
        columns = [recent.columns() for recent in self._recent.values()]
        names = [
            [source, len(own[0]), min(FAR_EVERY, recent.num - recent.asked_at)]
            for (source, recent), own in zip(self._recent.items(), columns, strict=True)
        ]
        text = {
            "met_bytes": self._met_bytes,
            "sources": names,
            "chosen": [[*number, digest.hex()] for number, digest in self._chosen.items()],
            "refused": [[*name, n.starts, n.ends] for name, n in self._refused.items()],
        }
        none = tuple(c[:0] for c in Recent().columns())
        whole = (np.concatenate(column) for column in zip(none, *columns, strict=True))
        return {
            "rivals": np.frombuffer(json.dumps(text).encode(), np.uint8),
            **{f"rival_{name}": column for name, column in zip(COLUMNS, whole, strict=True)},
        }

    def thaw(self, frozen: Mapping[str, NDArray[Any]]) -> None:
        """Know what was frozen. Raises KeyError, TypeError, ValueError for anything else."""
        text = json.loads(frozen["rivals"].tobytes())
        columns = [frozen[f"rival_{name}"] for name in COLUMNS]
        num = sum(n for _, n, _ in text["sources"])
        if [c.shape for c in columns] != [(num, 2), (num, HASH_BYTES), (num,), (num,), (num,)]:
            raise ValueError(f"{num} scans in {[c.shape for c in columns]}")
        at = 0
        for source, n, since_asked in text["sources"]:
            own = (c[at : at + n] for c in columns)
            self._recent[str(source)] = Recent.of(own, int(since_asked))
            at += n
        self._met_bytes = int(text["met_bytes"])
        for source, epoch, sequence, digest in text["chosen"]:
            self._chosen[Number(str(source), int(epoch), int(sequence))] = bytes.fromhex(digest)
        for source, epoch, starts, ends in text["refused"]:
            numbers = Numbers(list(map(int, starts)), list(map(int, ends)))
            self._refused[str(source), int(epoch)] = numbers

    def _is_one_too_many(self, recent: Recent, row: int, digest: bytes) -> bool:
        """Whether it differs from the first of its number, which came so long ago that the log is
        to be read for it, and that was done just now: it takes the mapper a tenth of a second.

        It is told by what has come, in the order of the log, and by nothing that became of it: what
        waits for its pose is placed earlier live than in a replay."""
        is_copy = recent.firsts[row] == _prefix(digest)
        is_near = self._met_bytes - int(recent.met_at[row]) <= self._window_bytes
        return not (is_copy or is_near or recent.may_ask())

    def _is_refused(self, number: Number) -> bool:
        return number.sequence in self._refused.get((number.source, number.epoch), ())

    def _row(self, number: Number) -> int | None:
        recent = self._recent.get(number.source)
        return recent.find(number.epoch, number.sequence) if recent is not None else None

    def _add(self, number: Number, digest: bytes) -> None:
        if number.source not in self._recent:
            if len(self._recent) >= MAX_SOURCES:
                self._recent.popitem(last=False)
            self._recent[number.source] = Recent()
        self._recent.move_to_end(number.source)
        self._recent[number.source].add(number.epoch, number.sequence, digest, self._met_bytes)

    def _choose(self, number: Number, digest: bytes) -> None:
        if number not in self._chosen and len(self._chosen) >= MAX_CHOSEN:
            raise ProtocolError(f"{number.source}: no room for more", "too_many_conflicts")
        self._chosen[number] = digest

    def _keep(self, number: Number, envelope: Envelope) -> None:
        """In the window: as bytes of its own, for a view would keep a whole chunk."""
        old = self._window.pop(number, None)
        self._num_bytes += len(envelope.payload) - (len(old.payload) if old is not None else 0)
        self._window[number] = envelope.owned()
        while self._num_bytes > self._window_bytes:
            self._num_bytes -= len(self._window.popitem(last=False)[1].payload)


def digest_of(envelope: Envelope) -> bytes:
    """The hash that tells scans of one number apart."""
    return hashlib.sha256(envelope.payload).digest()


def _prefix(digest: bytes) -> np.uint64:
    return np.uint64(int.from_bytes(digest[:8], "little"))
