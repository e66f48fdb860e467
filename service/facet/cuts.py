"""Where a replay cuts its updates: where the log says, every so often, or once at the end."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator

from facet.sources.naming import CORRECTION, is_correction, is_input, is_scan, names_of
from facet_protocol import topics
from facet_protocol.codec import decode
from facet_protocol.messages import Corrected, Cut, Envelope, ProtocolError, ResolvedPose

EVERY_NS = 200_000_000  # of log time, for a log that does not say
RECORDS = (topics.RESOLVED_TOPIC, topics.CORRECTED_TOPIC)
Identity = tuple[str, str, int, int, int]  # robot, sensor, epoch, sequence, stamp


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
    pose was found before it, or the last correction that was settled, and the records of both."""
    named = {(c.robot, c.sensor, c.epoch, c.sequence, c.stamp_ns) for c in cuts}
    named |= {identity for e in waiting if (identity := _recorded_identity(e)) is not None}
    end = 0
    for k, envelope in enumerate(waiting):
        identity = _identity(envelope)
        if identity in named and (is_scan(envelope) or is_correction(envelope)):
            named.discard(identity)  # a duplicate further on was left out
            end = k + 1
    records = [e for e in waiting[end:] if e.key in RECORDS]
    return waiting[:end] + records, [e for e in waiting[end:] if e.key not in RECORDS]


def _recorded_identity(envelope: Envelope) -> Identity | None:
    """Of the scan or correction that a record is about."""
    if envelope.key not in RECORDS:
        return None
    try:
        message = decode(envelope)
    except ProtocolError:
        return None
    if isinstance(message, Corrected):
        return message.robot, CORRECTION, message.epoch, message.sequence, message.stamp_ns
    if not isinstance(message, ResolvedPose):
        return None
    return message.robot, message.sensor, message.epoch, message.sequence, message.stamp_ns


def _identity(envelope: Envelope) -> Identity:
    robot, sensor = names_of(envelope)
    return robot, sensor, envelope.epoch, envelope.sequence, envelope.stamp_ns
