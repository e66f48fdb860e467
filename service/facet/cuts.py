"""Where a replay cuts its updates: where the log says, every so often, or once at the end."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator

from facet.sources.naming import is_scan, robot_and_sensor
from facet_protocol import topics
from facet_protocol.codec import decode
from facet_protocol.messages import Cut, Envelope, ProtocolError

EVERY_NS = 200_000_000  # of log time, for a log that does not say
Identity = tuple[str, str, int, int, int]  # robot, sensor, epoch, sequence, stamp


def logged_cuts(
    envelopes: Iterable[Envelope], has_cuts: Callable[[], bool]
) -> Iterator[list[Envelope]]:
    """The scans of each update as the log cut them; of a log without cuts, every 0.2 s of it.

    Scans between the last scan that a cut names and the cut itself belong to the next update: they
    were recorded while this one was under way. `has_cuts` is asked once the first scan was read.
    """
    waiting: list[Envelope] = []
    cuts: list[Cut] = []
    for envelope in envelopes:
        cut = _cut(envelope)
        if cuts and (cut is None or cut.revision != cuts[0].revision):
            taken, waiting = _split(waiting, cuts)
            cuts = []
            yield taken
        if cut is not None:
            cuts.append(cut)
        elif is_scan(envelope):
            if waiting and not has_cuts() and _is_due(waiting[0], envelope, EVERY_NS):
                yield waiting
                waiting = []
            waiting.append(envelope)
    if cuts:
        taken, waiting = _split(waiting, cuts)
        yield taken
    if waiting:
        yield waiting


def timed_cuts(envelopes: Iterable[Envelope], every_ns: int) -> Iterator[list[Envelope]]:
    """The scans of every `every_ns` of log time; 0: all of them at once."""
    waiting: list[Envelope] = []
    for envelope in envelopes:
        if not is_scan(envelope):
            continue
        if waiting and every_ns and _is_due(waiting[0], envelope, every_ns):
            yield waiting
            waiting = []
        waiting.append(envelope)
    if waiting:
        yield waiting


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
    """(applied before the cut, after it): up to the last scan that one of its rows names."""
    named = {(c.robot, c.sensor, c.epoch, c.sequence, c.stamp_ns) for c in cuts}
    end = 0
    for k, envelope in enumerate(waiting):
        identity = _identity(envelope)
        if identity in named:
            named.discard(identity)  # a duplicate further on was left out
            end = k + 1
    return waiting[:end], waiting[end:]


def _identity(envelope: Envelope) -> Identity:
    robot, sensor = robot_and_sensor(envelope.key)
    return robot, sensor, envelope.epoch, envelope.sequence, envelope.stamp_ns
