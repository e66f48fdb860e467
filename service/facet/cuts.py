"""Where a replay cuts its updates: where the log says, every so often, or once at the end."""

from __future__ import annotations

import hashlib
from collections import Counter
from collections.abc import Callable, Iterable, Iterator

from facet.sources.naming import CORRECTION, is_correction, is_input, is_scan, names_of
from facet_protocol import topics
from facet_protocol.codec import decode
from facet_protocol.messages import (
    Conflict,
    Corrected,
    Cut,
    Envelope,
    ProtocolError,
    ResolvedPose,
)

EVERY_NS = 200_000_000  # of log time, for a log that does not say
RECORDS = (topics.RESOLVED_TOPIC, topics.CORRECTED_TOPIC, topics.CONFLICT_TOPIC)
Identity = tuple[str, str, int, int, int]  # robot, sensor, epoch, sequence, stamp
Record = ResolvedPose | Corrected | Conflict


class Batch(list[Envelope]):
    """The messages of one update. `revision` is that of the logged cut; 0 when none was logged."""

    def __init__(self, envelopes: Iterable[Envelope], revision: int = 0) -> None:
        super().__init__(envelopes)
        self.revision = revision


def logged_cuts(envelopes: Iterable[Envelope], has_cuts: Callable[[], bool]) -> Iterator[Batch]:
    """The messages of each update as the log cut them; of a log without cuts, every 0.2 s of it.

    Scans between the last scan that a cut names and the cut itself belong to the next update: they
    were recorded while this one was under way. A scan that waited for its pose, and a correction,
    belong to the cut that follows the record of it. `has_cuts` is asked once the first scan was
    read.
    """
    waiting: list[Envelope] = []
    cuts: list[Cut] = []
    for envelope in envelopes:
        cut = _cut(envelope)
        if cuts and (cut is None or cut.revision != cuts[0].revision):
            taken, waiting = _split(waiting, cuts)
            revision, cuts = cuts[0].revision, []
            yield Batch(taken, revision)
        if cut is not None:
            cuts.append(cut)
        elif _is_applied(envelope):
            is_due = is_scan(envelope) and bool(waiting) and not has_cuts()
            if is_due and _is_due(waiting[0], envelope, EVERY_NS):
                yield Batch(waiting)
                waiting = []
            waiting.append(envelope)
    if cuts:
        taken, waiting = _split(waiting, cuts)
        yield Batch(taken, cuts[0].revision)
    if waiting:
        yield Batch(waiting)


def timed_cuts(envelopes: Iterable[Envelope], every_ns: int) -> Iterator[list[Envelope]]:
    """The messages of every `every_ns` of log time; 0: all of them at once."""
    waiting: list[Envelope] = []
    for envelope in envelopes:
        if not _is_applied(envelope):
            continue
        is_due = is_scan(envelope) and bool(waiting) and every_ns > 0
        if is_due and _is_due(waiting[0], envelope, every_ns):
            yield waiting
            waiting = []
        waiting.append(envelope)
    if waiting:
        yield waiting


def _is_applied(envelope: Envelope) -> bool:
    """An input, or the record of what became of one."""
    return is_input(envelope) or envelope.key in RECORDS


def _is_due(first: Envelope, envelope: Envelope, every_ns: int) -> bool:
    return envelope.received_ns - first.received_ns >= every_ns


def _cut(envelope: Envelope) -> Cut | None:
    if envelope.key != topics.CUT_TOPIC:
        return None
    try:
        message = decode(envelope)
    except ProtocolError:
        return None
    return message if isinstance(message, Cut) else None


def _split(waiting: list[Envelope], cuts: list[Cut]) -> tuple[list[Envelope], list[Envelope]]:
    """(applied before the cut, after it): up to the last scan that one of its rows names, or whose
    pose was found before it, or that took the place of another, or the last correction that was
    settled, and the records of them."""
    records = [record for e in waiting if (record := _record(e)) is not None]
    named = Counter(_recorded_identity(r) for r in records if not isinstance(r, Conflict))
    for cut in cuts:
        identity = (cut.robot, cut.sensor, cut.epoch, cut.sequence, cut.stamp_ns)
        named[identity] = max(1, named[identity])
    winners = {(_recorded_identity(r), r.kept) for r in records if isinstance(r, Conflict)}
    end = 0
    for k, envelope in enumerate(waiting):
        if not is_scan(envelope) and not is_correction(envelope):
            continue
        identity = _identity(envelope)
        if named[identity] > 0:
            named[identity] -= 1  # a duplicate further on was left out
            end = k + 1
        elif winners and (winner := (identity, _digest(envelope))) in winners:
            winners.discard(winner)
            end = k + 1
    said = [e for e in waiting[end:] if e.key in RECORDS]
    return waiting[:end] + said, [e for e in waiting[end:] if e.key not in RECORDS]


def _record(envelope: Envelope) -> Record | None:
    """What became of a scan or a correction, where it says that something came of it."""
    if envelope.key not in RECORDS:
        return None
    try:
        message = decode(envelope)
    except ProtocolError:
        return None
    if isinstance(message, Conflict):
        return message if message.replaced else None
    return message if isinstance(message, Corrected | ResolvedPose) else None


def _recorded_identity(record: Record) -> Identity:
    sensor = CORRECTION if isinstance(record, Corrected) else record.sensor
    return record.robot, sensor, record.epoch, record.sequence, record.stamp_ns


def _digest(envelope: Envelope) -> bytes:
    return hashlib.sha256(envelope.payload).digest()


def _identity(envelope: Envelope) -> Identity:
    robot, sensor = names_of(envelope)
    return robot, sensor, envelope.epoch, envelope.sequence, envelope.stamp_ns
