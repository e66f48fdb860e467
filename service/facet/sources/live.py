"""Scans from Zenoh into a bounded queue of our own: Zenoh's threads only put them there."""

from __future__ import annotations

import threading
import time
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Protocol

import zenoh
import zenoh.ext

from facet.sources.naming import robot_and_sensor, source_of
from facet_protocol import attachment
from facet_protocol.messages import Envelope, Loss, ProtocolError
from facet_protocol.topics import scans_key


@dataclass(frozen=True, slots=True)
class Waiting:
    """A sample at the door: its payload stays where Zenoh put it until a worker takes it."""

    sample: zenoh.Sample
    received_ns: int
    num_bytes: int


class Tally(Protocol):
    """Who counts what comes in, and what does not get any further."""

    def arrive(self, source: str) -> None: ...

    def settle(self, source: str, outcome: str) -> None: ...


class Inbox:
    """Bounded by messages and by bytes. Half full, the network has to wait, `patience_s` at most:
    Zenoh cuts a link that waits for five; full, the oldest goes and is remembered as shed."""

    def __init__(
        self,
        max_messages: int,
        max_bytes: int,
        clock_ns: Callable[[], int] = time.time_ns,
        *,
        max_message_bytes: int = 1 << 62,
        patience_s: float = 2.0,
        tally: Tally | None = None,
    ) -> None:
        self.num_received = 0
        self.num_bytes = 0
        self._max_messages, self._max_bytes = max_messages, max_bytes
        self._max_message_bytes, self._patience_s = max_message_bytes, patience_s
        self._clock_ns, self._tally = clock_ns, tally
        self._waiting: deque[Waiting] = deque()
        self._shed: list[Loss] = []
        self._shed_before: list[Loss] = []  # of what the last `take` took
        self._hold_until: float | None = None  # monotonic s: the network waits no longer
        self._changed = threading.Condition()
        self._closed = False

    def __len__(self) -> int:
        return len(self._waiting)

    def push(self, sample: zenoh.Sample) -> None:
        """Called on Zenoh's threads: appends, and may hold them back for a while."""
        waiting = Waiting(sample, self._clock_ns(), len(sample.payload))
        with self._changed:
            self.num_received += 1
            if self._tally is not None:
                self._tally.arrive(source_of(str(sample.key_expr)))
            if waiting.num_bytes > self._max_message_bytes:
                self._drop(waiting, "too_large")
                return
            self._hold_back()
            self.num_bytes += waiting.num_bytes
            self._waiting.append(waiting)
            while len(self._waiting) > self._max_messages or self.num_bytes > self._max_bytes:
                if len(self._waiting) == 1:
                    break  # a single message is never too many
                oldest = self._waiting.popleft()
                self.num_bytes -= oldest.num_bytes
                self._drop(oldest, "shed_overload")
            self._changed.notify_all()

    def take(self, timeout_s: float, max_bytes: int) -> list[Envelope]:
        """What waits, oldest first, up to `max_bytes`; waits up to `timeout_s` for the first."""
        with self._changed:
            self._changed.wait_for(lambda: self._waiting or self._closed, timeout_s)
            taken: list[Waiting] = []
            num_bytes = 0
            while self._waiting and (not taken or num_bytes < max_bytes):
                taken.append(self._waiting.popleft())
                num_bytes += taken[-1].num_bytes
            self.num_bytes -= num_bytes
            self._shed_before += self._shed
            self._shed = []
            self._changed.notify_all()
        return [envelope_of(w, w.sample.payload.to_bytes()) for w in taken]

    def take_shed(self) -> list[Loss]:
        """What had to go before that which was taken last: ranges of sequence numbers."""
        with self._changed:
            shed, self._shed_before = self._shed_before, []
        return shed

    @property
    def is_half_full(self) -> bool:
        return 2 * len(self._waiting) >= self._max_messages or 2 * self.num_bytes >= self._max_bytes

    def _hold_back(self) -> None:
        """Wait for room, but in sum no longer than `patience_s` since the queue was half full."""
        if self.is_half_full:
            now = time.monotonic()
            if self._hold_until is None:
                self._hold_until = now + self._patience_s
            self._changed.wait_for(
                lambda: self._closed or not self.is_half_full, max(0.0, self._hold_until - now)
            )
        if not self.is_half_full:
            self._hold_until = None

    def _drop(self, waiting: Waiting, reason: str) -> None:
        envelope = envelope_of(waiting, b"")
        if self._tally is not None:
            self._tally.settle(source_of(envelope.key), reason)
        loss = loss_of(envelope, envelope.sequence, 1, reason)
        last = self._shed[-1] if self._shed else None
        if last is not None and _continues(last, loss):
            self._shed[-1] = replace(last, count=last.count + 1, stamp_ns=loss.stamp_ns)
        else:
            self._shed.append(loss)

    def wake(self) -> None:
        """No one waits any longer for a first message, or for room."""
        with self._changed:
            self._closed = True
            self._changed.notify_all()


class LiveSource:
    """Subscribes to every scan of a map. What a stall made us miss is asked for again."""

    def __init__(self, session: zenoh.Session, map_id: str, inbox: Inbox) -> None:
        self._subscriber = zenoh.ext.declare_advanced_subscriber(
            session,
            scans_key(map_id),
            zenoh.handlers.Callback(inbox.push, indirect=False),
            recovery=zenoh.ext.RecoveryConfig(heartbeat=True, periodic_queries=None),
        )

    def close(self) -> None:
        """No push after this. Must come before the session's close."""
        self._subscriber.undeclare()


def envelope_of(waiting: Waiting, payload: bytes) -> Envelope:
    """The sample as an envelope; one without our attachment has no sequence and its receipt as
    stamp."""
    sample = waiting.sample
    schema, encoding = split_encoding(str(sample.encoding))
    try:
        mark = attachment.unpack(sample.attachment.to_bytes() if sample.attachment else b"")
    except ProtocolError:
        mark = attachment.Attachment(epoch=0, sequence=0, stamp_ns=waiting.received_ns)
    return Envelope(
        key=str(sample.key_expr),
        schema=schema,
        encoding=encoding,
        payload=payload,
        stamp_ns=max(mark.stamp_ns, 0),
        epoch=mark.epoch,
        sequence=mark.sequence,
        received_ns=waiting.received_ns,
    )


def loss_of(envelope: Envelope, first_sequence: int, count: int, reason: str) -> Loss:
    """A gap in the numbers of the envelope's source."""
    robot, sensor = robot_and_sensor(envelope.key)
    return Loss(robot, sensor, envelope.epoch, first_sequence, count, reason, envelope.received_ns)


def _continues(last: Loss, loss: Loss) -> bool:
    names = [(x.robot, x.sensor, x.epoch, x.reason) for x in (last, loss)]
    same = names[0] == names[1]
    follows = loss.first_sequence == (
        last.first_sequence + last.count if loss.first_sequence else 0
    )
    return same and follows


def split_encoding(text: str) -> tuple[str, str]:
    """(schema, encoding) of `application/protobuf;foxglove.PointCloud`."""
    kind, _, schema = text.partition(";")
    return schema, kind.removeprefix("application/")
