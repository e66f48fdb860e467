"""Scans and poses from Zenoh into a bounded queue: Zenoh's threads only put them there."""

from __future__ import annotations

import ctypes
import threading
import time
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Protocol

import zenoh
import zenoh.ext

from facet.sources.dialects import (
    TOKENS_KEY,
    Dialect,
    Dialects,
    Recognised,
    key_pattern,
    split_encoding,
)
from facet.sources.naming import is_input, is_static, names_of, source_of
from facet.sources.recovery import Recovery, asked_in
from facet_protocol import attachment
from facet_protocol.messages import Envelope, Loss, ProtocolError
from facet_protocol.ros_definitions import TRANSFORMS
from facet_protocol.topics import PREFIX, corrections_key, is_erase_topic, poses_keys, scans_key

MOST_TAKEN = 1 << 15  # messages at once: each may open a channel of the log, which has 65,535
STATIC_KEYS = ("**/tf_static", "**/tf_static/tf2_msgs::msg::dds_::TFMessage_/*")


@dataclass(frozen=True, slots=True)
class Waiting:
    """A sample at the door: its payload stays where Zenoh put it until a worker takes it."""

    sample: zenoh.Sample
    received_ns: int
    num_bytes: int
    what: Recognised

    @property
    def source(self) -> str:
        what = self.what
        if what.rule is None:
            return source_of(what.topic)
        return source_of(Envelope(what.topic, what.schema, what.encoding, b"", rule=what.rule))


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
        self.num_ignored = 0  # samples on foreign keys that are no scans and no poses
        self.num_bytes = 0
        self._max_messages, self._max_bytes = max_messages, max_bytes
        self._max_message_bytes, self._patience_s = max_message_bytes, patience_s
        self._clock_ns, self._tally = clock_ns, tally
        self._waiting: deque[Waiting] = deque()
        self._shed: list[Loss] = []
        self._shed_before: list[Loss] = []  # of what the last `take` took
        self._hold_until: float | None = None  # monotonic s: the network waits no longer
        self._changed = threading.Condition()
        self._wanted_bytes = max_bytes  # the one who waits comes for this much
        self._is_called = False
        self._closed = False

    def __len__(self) -> int:
        return len(self._waiting)

    def push(self, sample: zenoh.Sample, what: Recognised | None = None) -> None:
        """Called on Zenoh's threads: appends, and may hold them back for a while. `what` was
        recognised; a native sample says it itself."""
        what = what or native(sample)
        waiting = Waiting(sample, self._clock_ns(), len(sample.payload), what)
        with self._changed:
            self.num_received += 1
            if self._tally is not None:
                self._tally.arrive(waiting.source)
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
            if self._has_enough():  # not for each message: the mapper has better use for its turn
                self._changed.notify_all()

    def wait(self, timeout_s: float, max_bytes: int) -> bool:
        """Wait until it is time to take: `timeout_s` are over, so much is there, or the queue is
        half full. False when someone called before that."""
        with self._changed:
            self._wanted_bytes = max_bytes
            self._changed.wait_for(lambda: self._is_called or self._has_enough(), timeout_s)
            was_called, self._is_called = self._is_called, False
            return not was_called or self._has_enough()

    def take(self, max_bytes: int) -> list[Envelope]:
        """What is there, oldest first, up to `max_bytes` and MOST_TAKEN."""
        with self._changed:
            taken: list[Waiting] = []
            num_bytes = 0
            most = min(MOST_TAKEN, len(self._waiting))
            while len(taken) < most and (not taken or num_bytes < max_bytes):
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
            self._tally.settle(source_of(envelope), reason)
        loss = loss_of(envelope, envelope.sequence, 1, reason)
        last = self._shed[-1] if self._shed else None
        if last is not None and _continues(last, loss):
            self._shed[-1] = replace(last, count=last.count + 1, stamp_ns=loss.stamp_ns)
        else:
            self._shed.append(loss)

    def call(self) -> None:
        """The one who waits, or will, has something else to do."""
        with self._changed:
            self._is_called = True
            self._changed.notify_all()

    def _has_enough(self) -> bool:
        return self._closed or self.is_half_full or self.num_bytes >= self._wanted_bytes

    def wake(self) -> None:
        """No one waits any longer for messages, or for room."""
        with self._changed:
            self._closed = True
            self._changed.notify_all()


class LiveSource:
    """Subscribes to every scan, pose and correction of a map's robots, whatever they speak.

    What a stall made us miss on Facet's own keys is asked for again, until it comes; so is what was
    sent since the log ended, whose `newest` (epoch, sequence) by source these are. Static
    transforms are asked for when we come late. `keys` are the foreign keys that are listened to:
    what is recognised there by the dialect table is taken, the rest is left alone.
    """

    def __init__(
        self,
        session: zenoh.Session,
        map_id: str,
        inbox: Inbox,
        dialects: Dialects | None = None,
        keys: Sequence[str] = (),
        newest: Mapping[str, tuple[int, int]] | None = None,
    ) -> None:
        self._session, self._inbox, self._newest = session, inbox, dict(newest or {})
        self._dialects = dialects or Dialects()
        self._patterns = [key_pattern(key) for key in keys]
        static = poses_keys(map_id, static=True)
        self._recovery = Recovery(asked_in(session), self._push_native, lacking=self._lacking)
        self._recovery.start()
        self._closers: list[Callable[[], object]] = [self._recovery.close]
        for key in (scans_key(map_id), corrections_key(map_id), *poses_keys(map_id), *static):
            self._subscribe(key, self._take_native, with_history=key in static)
        if keys:
            tokens = zenoh.handlers.Callback(self._note_token, indirect=False)
            watch = session.liveliness().declare_subscriber(TOKENS_KEY, tokens, history=True)
            self._closers.append(watch.undeclare)
            for key in STATIC_KEYS:
                self._subscribe(key, self._take_foreign_static, with_history=True)
        for key in keys:
            handler = zenoh.handlers.Callback(self._take_foreign, indirect=False)
            plain = session.declare_subscriber(key, handler, allowed_origin=zenoh.Locality.REMOTE)
            self._closers.append(plain.undeclare)

    def close(self) -> None:
        """No push after this. Must come before the session's close."""
        while self._closers:
            self._closers.pop()()

    def _subscribe(
        self, key: str, take: Callable[[zenoh.Sample], None], *, with_history: bool
    ) -> None:
        history = zenoh.ext.HistoryConfig(detect_late_publishers=True) if with_history else None
        subscriber = zenoh.ext.declare_advanced_subscriber(
            self._session,
            key,
            zenoh.handlers.Callback(take, indirect=False),
            history=history,
            recovery=zenoh.ext.RecoveryConfig(heartbeat=True, periodic_queries=None),
        )
        self._closers.append(subscriber.undeclare)

    def _note_token(self, sample: zenoh.Sample) -> None:
        """A bridge begins to publish a key, or ends it."""
        token = str(sample.key_expr)
        if sample.kind == zenoh.SampleKind.PUT:
            self._dialects.learn(token)
        else:
            self._dialects.forget(token)

    def _take_native(self, sample: zenoh.Sample) -> None:
        _keep_thread_state()
        self._recovery.note(sample)
        self._push_native(sample)

    def _lacking(self, sample: zenoh.Sample) -> int:
        """How many samples lie between what the log ends with and the first that came since; none
        of a source that is not in it, whatever its numbers say."""
        known = self._newest.get(source_of(str(sample.key_expr)))
        if known is None:
            return 0
        try:
            mark = attachment.unpack(sample.attachment.to_bytes() if sample.attachment else b"")
        except ProtocolError:
            return 0
        return max(0, mark.sequence - known[1] - 1) if mark.epoch == known[0] else 0

    def _push_native(self, sample: zenoh.Sample) -> None:
        self._inbox.push(sample, self._dialects.recognise(*_names(sample)))

    def _take_foreign(self, sample: zenoh.Sample) -> None:
        """What lies on any other key: static transforms come by a way of their own."""
        _keep_thread_state()
        what = self._wanted(sample)
        if what is None:
            self._inbox.num_ignored += not str(sample.key_expr).startswith(f"{PREFIX}/")
        elif not _is_static(what):
            self._inbox.push(sample, what)

    def _take_foreign_static(self, sample: zenoh.Sample) -> None:
        what = self._wanted(sample)
        key = f"/{sample.key_expr}"
        is_ours = any(pattern.fullmatch(key) for pattern in self._patterns)
        if what is not None and is_ours and _is_static(what):
            self._inbox.push(sample, what)

    def _wanted(self, sample: zenoh.Sample) -> Recognised | None:
        what = self._dialects.recognise(*_names(sample))
        if what is None or what.dialect is Dialect.NATIVE:
            return None
        if is_erase_topic(what.topic):  # only the command writes there
            return None
        is_read = is_input(Envelope(what.topic, what.schema, what.encoding, b"", rule=what.rule))
        return what if is_read else None


_kept = threading.local()


def _keep_thread_state() -> None:
    """Keep what the interpreter knows of this thread, one of Zenoh's. It would be made for each
    message and thrown away after it, with memory that goes back to the system each time: as long
    again as the message takes."""
    if not hasattr(_kept, "is_kept"):
        ctypes.pythonapi.PyGILState_Ensure()  # and no release: the thread lives as long as we do
        _kept.is_kept = True


def native(sample: zenoh.Sample) -> Recognised:
    """What a sample says itself, by its encoding."""
    key, encoding = _names(sample)
    return Recognised(Dialect.NATIVE, key, *split_encoding(encoding), None)


def _names(sample: zenoh.Sample) -> tuple[str, str]:
    return str(sample.key_expr), str(sample.encoding)


def _is_static(what: Recognised) -> bool:
    return is_static(Envelope(what.topic, what.schema, what.encoding, b""))


def envelope_of(waiting: Waiting, payload: bytes) -> Envelope:
    """The sample as an envelope; one without an attachment that we know has no sequence, and its
    receipt as stamp."""
    what, beside = waiting.what, waiting.sample.attachment
    mark = _attachment_of(waiting, beside.to_bytes() if beside else b"")
    return Envelope(
        what.topic,
        what.schema,
        what.encoding,
        payload,
        stamp_ns=max(mark.stamp_ns, 0),
        epoch=mark.epoch,
        sequence=mark.sequence,
        received_ns=waiting.received_ns,
        rule=what.rule,
    )


def _attachment_of(waiting: Waiting, data: bytes) -> attachment.Attachment:
    what = waiting.what
    if not data:
        return attachment.Attachment(epoch=0, sequence=0, stamp_ns=waiting.received_ns)
    try:
        if what.dialect is not Dialect.RMW_ZENOH:
            return attachment.unpack(data)
        mark = attachment.unpack_ros(data)
    except ProtocolError:
        return attachment.Attachment(epoch=0, sequence=0, stamp_ns=waiting.received_ns)
    if what.schema == TRANSFORMS:  # many publish them on one topic: their numbers say nothing
        return attachment.Attachment(epoch=0, sequence=0, stamp_ns=mark.stamp_ns)
    return mark


def loss_of(envelope: Envelope, first_sequence: int, count: int, reason: str) -> Loss:
    """A gap in the numbers of the envelope's source."""
    robot, sensor = names_of(envelope)
    return Loss(robot, sensor, envelope.epoch, first_sequence, count, reason, envelope.received_ns)


def _continues(last: Loss, loss: Loss) -> bool:
    names = [(x.robot, x.sensor, x.epoch, x.reason) for x in (last, loss)]
    same = names[0] == names[1]
    follows = loss.first_sequence == (
        last.first_sequence + last.count if loss.first_sequence else 0
    )
    return same and follows
