"""From the door to the log to the mapper: what is recorded, and only that, is handed on."""

from __future__ import annotations

import logging
import threading
import time
from collections import Counter, deque
from collections.abc import Callable, Iterable
from dataclasses import replace
from functools import partial

from facet.outgoing import Addressed, Outgoing
from facet.past import Past, definitions_of
from facet.sequences import SequenceLedger
from facet.sinks import Message, Sink
from facet.sinks.recorder import LogPosition, Recorder
from facet.sources.live import Inbox, loss_of
from facet.sources.naming import source_of
from facet.status import Account
from facet_protocol.messages import (
    Envelope,
    Erase,
    Events,
    Loss,
    MapUpdate,
    Scan,
    Status,
    TilePoints,
)

logger = logging.getLogger(__name__)

BATCH_BYTES = 8 << 20  # a commit is due after this much, whatever the clock says
HURRY_S = 0.01  # on a disk that takes longer, updates wait for the next commit: scans go first
MAX_DERIVED = 4096  # messages of our own that wait for the log: then it gets no status


class DurableQueue:
    """Scans that are in the log and wait for the mapper, bounded by bytes."""

    def __init__(self, max_bytes: int) -> None:
        self._max_bytes = max_bytes
        self._num_bytes = 0
        self._waiting: deque[Envelope] = deque()
        self._end: LogPosition | None = None  # of what waits
        self.taken_to: LogPosition | None = None  # all that lies before it in the log was taken
        self._changed = threading.Condition()
        self._closed = False

    def __len__(self) -> int:
        return len(self._waiting)

    @property
    def has_room(self) -> bool:
        return self._num_bytes < self._max_bytes

    def put(self, envelopes: list[Envelope], end: LogPosition | None = None) -> None:
        """Hand on what the log holds up to `end`."""
        with self._changed:
            self._waiting.extend(envelopes)
            self._end = end
            self._num_bytes += sum(len(e.payload) for e in envelopes)
            self._changed.notify_all()

    def take(self, timeout_s: float) -> list[Envelope]:
        """All that wait, in log order."""
        with self._changed:
            self._changed.wait_for(lambda: self._waiting or self._closed, timeout_s)
            taken = list(self._waiting)
            self._waiting.clear()
            self._num_bytes = 0
            self.taken_to = self._end
            self._changed.notify_all()
        return taken

    def wait_for_room(self, timeout_s: float) -> bool:
        with self._changed:
            return self._changed.wait_for(lambda: self.has_room, timeout_s)

    def close(self) -> None:
        """No one waits any longer; what is in it can still be taken."""
        with self._changed:
            self._closed = True
            self._changed.notify_all()


class Intake:
    """The recorder's thread. As a sink it takes what the pipeline says, for the same log.

    Scans go on to the mapper when they are durable, and updates and events to `follower` when their
    cut is: no client sees a revision that the log does not know. An update is committed at once
    (`hurry`), so that this costs what the disk takes, not the rest of `commit_s`.

    When the disk fails: health is FAIL, nothing is handed on, and it is tried again every
    `retry_s`, or the service ends (`exit_on_failure`).
    """

    def __init__(
        self,
        inbox: Inbox,
        recorder: Recorder,
        durable: DurableQueue,
        outgoing: Outgoing,
        account: Account,
        *,
        commit_s: float = 0.05,
        retry_s: float = 5.0,
        exit_on_failure: bool = False,
        past: Past | None = None,
    ) -> None:
        self.follower: Sink | None = None  # set before the start
        self.foresee: Callable[[list[Envelope]], None] = lambda scans: None  # likewise
        self._past = past  # is told where in the log scans lie
        self._written_to: LogPosition | None = None
        self._inbox, self._recorder, self._durable = inbox, recorder, durable
        self._outgoing, self._account = outgoing, account
        self._commit_s, self._retry_s = commit_s, retry_s
        self._exit_on_failure = exit_on_failure
        self._ledger = SequenceLedger()
        self._shed: Counter[tuple[str, int]] = Counter()  # by source and epoch
        self._derived: deque[Addressed | threading.Event] = deque()
        self._said: list[Addressed] = []  # written, not yet durable: for the follower
        self._failure = ""  # why the log is not being written
        self._took_s = 0.0  # the last commit
        self._is_asked = False  # for scans, before they are due
        self._is_finished = False  # the log is whole, and nothing more comes
        self._has_ended = False  # nothing more is written, whole or not
        self._awaited: list[threading.Event] = []  # set when what was taken is durable
        self._scans: list[Envelope] = []  # written, not yet durable
        self._stopping = threading.Event()
        self._roll = threading.Event()
        self.failed = threading.Event()  # the disk failed and `exit_on_failure` says to end
        self._thread = threading.Thread(target=self._run, name="recorder", daemon=True)

    def start(self) -> None:
        self._thread.start()

    def expect(self, newest: Iterable[tuple[str, int, int]]) -> None:
        """Before the start: (source, epoch, sequence) that the log ends with, so that what was
        sent while no service was there is seen to be missing."""
        for source, epoch, sequence in newest:
            self._ledger.note(source, epoch, sequence)

    def write(self, envelope: Envelope, message: Message | None) -> None:
        """Queue one of our own messages for the log; scans are in it already. Points are for the
        eye: they are not logged, and wait for nothing."""
        if isinstance(message, TilePoints) and self.follower is not None:
            self.follower.write(envelope, message)
        if isinstance(message, Scan | TilePoints):
            return
        if isinstance(message, Status) and len(self._derived) >= MAX_DERIVED:
            self._account.count("log_dropped")  # of all else there is no more than was durable
            return
        self._derived.append((envelope, message))

    def hurry(self) -> None:
        """Commit what `write` has taken without waiting for the clock. Scans wait for it all the
        same: an update that brought the next ones at once would leave the mapper no rest."""
        self._inbox.call()

    def catch_up(self, timeout_s: float) -> bool:
        """Commit what has come in by now, scans too, and wait until it is handed on: for a mapper
        whose updates take longer than `commit_s`, and who has no rest anyway. A scan then waits for
        the update under way, and never for the next one."""
        self._is_asked = True
        self._inbox.call()
        return self.is_logged(timeout_s)

    def is_logged(self, timeout_s: float) -> bool:
        """Whether all that `write` has taken by now is durable, or is after so long."""
        if self._has_ended:
            return self._is_finished and not self._derived
        logged = threading.Event()
        self._derived.append(logged)
        return logged.wait(timeout_s)

    def close(self) -> None:
        """Nothing: the log is finished by `stop`, after the last message of every thread."""

    def roll(self) -> None:
        """Start a new file at the next commit."""
        self._roll.set()

    def drain(self, timeout_s: float) -> None:
        """Wait until what has come in is durable and handed on, or the time is up."""
        deadline = time.monotonic() + timeout_s
        while self.catch_up(max(0.0, deadline - time.monotonic())) and len(self._inbox):
            pass

    def stop(self, timeout_s: float) -> None:
        """Record what is left and finish the file."""
        self._stopping.set()
        self._inbox.wake()
        self._thread.join(timeout_s)

    def _run(self) -> None:
        try:
            self._record_until_stopped()
        except Exception as error:  # a fault of ours: without a log there is no map
            logger.exception("the recorder failed")
            self._account.failure = f"recorder: {error}"
            self.failed.set()
        self._has_ended = True

    def _record_until_stopped(self) -> None:
        due = time.monotonic() + self._commit_s
        while not self._stopping.is_set():
            is_due = self._inbox.wait(max(0.0, due - time.monotonic()), BATCH_BYTES)
            if self._is_asked:
                self._is_asked, is_due = False, True
            if not is_due and self._took_s > HURRY_S:
                continue
            if is_due and not self._failure and self._durable.wait_for_room(self._commit_s):
                self._take()
            if not self._failure:
                self._take_own()
            self._commit()
            if is_due:
                due = time.monotonic() + self._commit_s
        self._take()
        while len(self._inbox):  # more than one commit takes
            if not self._failure:
                self._commit()
            self._take()
        self._take_own()
        self._finish()

    def _take(self) -> None:
        """From the inbox into the recorder, counted."""
        taken = self._inbox.take(BATCH_BYTES)
        for loss in self._inbox.take_shed():
            self._lose(loss)
        for envelope in taken:
            self._note(envelope)
            self._recorder.write(envelope)
            self._scans.append(envelope)

    def _take_own(self) -> None:
        """From ourselves into the recorder."""
        while self._derived:
            taken = self._derived.popleft()
            if isinstance(taken, threading.Event):
                self._awaited.append(taken)
                continue
            self._recorder.write(taken[0])
            if isinstance(taken[1], Erase):  # of our own making, and an input all the same
                self._scans.append(taken[0])
            if isinstance(taken[1], MapUpdate | Events):
                self._said.append(taken)

    def _note(self, envelope: Envelope) -> None:
        """What the number of one message tells: a gap before it, a restart, a late arrival."""
        source = source_of(envelope)
        noted = self._ledger.note(source, envelope.epoch, envelope.sequence)
        if noted.skipped:
            self._log_loss(loss_of(envelope, noted.first_skipped, noted.skipped, "lost_upstream"))
        if noted.is_late:
            self._account.count("recovered_late", source)
            self._write_loss(loss_of(envelope, envelope.sequence, 1, "recovered_late"))
        if noted.is_restart:
            self._account.count("source_restarted", source)
            logger.info("%s: has begun anew, epoch %d", source, envelope.epoch)
        if noted.is_interleaved:
            self._account.count("duplicate_publisher", source)
            text = f"epochs alternate ({envelope.epoch}): two publishers share the name"
            self._account.complain(source, "duplicate_publisher", text)
        self._account.count("lost_upstream", source, noted.skipped - noted.is_late)

    def _lose(self, loss: Loss) -> None:
        """What the inbox had to drop did arrive: it is no loss upstream."""
        source = f"{loss.robot}/{loss.sensor}"
        if loss.first_sequence:
            self._shed[source, loss.epoch] += loss.count
            for sequence in range(loss.first_sequence, loss.first_sequence + loss.count):
                noted = self._ledger.note(source, loss.epoch, sequence)
                self._account.count("lost_upstream", source, noted.skipped - noted.is_late)
                if noted.skipped:
                    gap = replace(loss, first_sequence=noted.first_skipped, count=noted.skipped)
                    self._log_loss(replace(gap, reason="lost_upstream"))
        self._log_loss(loss)

    def _write_loss(self, loss: Loss) -> None:
        envelope, _ = self._outgoing.loss(loss)
        self._recorder.write(envelope)

    def _log_loss(self, loss: Loss) -> None:
        self._write_loss(loss)
        text = f"{loss.count} scans from sequence {loss.first_sequence}"
        self._account.complain(f"{loss.robot}/{loss.sensor}", loss.reason, text)

    def _commit(self) -> None:
        """Make it durable and hand it on; on a failing disk wait, and keep it."""
        started = time.monotonic()
        try:
            if self._roll.is_set():
                self._roll.clear()
                self._recorder.commit()
                self._recorder.roll()
            self._recorder.commit()
        except OSError as error:
            self._fail(error)
            return
        if self._failure:
            logger.warning("the log is being written again")
            if self._account.failure == self._failure:  # not another thread's
                self._account.failure = ""
            self._failure = ""
        self._took_s = time.monotonic() - started
        if self._scans:
            self._account.gauge("commit_ms", self._took_s * 1e3)
        self._hand_on()

    def _hand_on(self) -> None:
        said, self._said = self._said, []
        for envelope, message in said:
            if self.follower is not None:
                self.follower.write(envelope, message)
        scans = self._scans  # till they are handed on: `drain` waits for that
        for source, num in Counter(map(source_of, scans)).items():
            self._account.count("recorded", source, num)
            self._acknowledge(source)
        if scans:
            position = self._recorder.position
            self._note_past(scans, position)
            self.foresee(scans)
            self._durable.put(scans, position)
            self._scans = []
        while self._awaited:
            self._awaited.pop().set()

    def _acknowledge(self, source: str) -> None:
        """All that was noted is in the log now, up to the newest number of its epoch, but for what
        is missing. In this order: who reads between two of them is told too little."""
        epoch, newest, missing = self._ledger.newest(source)
        missing += self._shed[source, epoch]
        for name, value in {"ack_missing": missing, "ack": newest, "ack_epoch": epoch}.items():
            self._account.gauge(name, value, source)

    def _note_past(self, scans: list[Envelope], position: LogPosition) -> None:
        last, self._written_to = self._written_to, position
        if self._past is not None:
            path = self._recorder.directory / position.file
            start = last.offset if last is not None and last.file == position.file else 0
            self._past.note(path, start, position.offset, scans)
            self._past.define(path, partial(definitions_of, position.channels))

    def _fail(self, error: OSError) -> None:
        self._failure = self._account.failure = str(error)
        self._account.count("recorder_failed")
        logger.error("the log cannot be written, nothing is mapped: %s", error)
        if self._exit_on_failure:
            self.failed.set()
        self._stopping.wait(self._retry_s)

    def _finish(self) -> None:
        try:
            self._recorder.close()
            self._hand_on()
            self._is_finished = True
        except OSError as error:
            lost = self._recorder.forget()
            self._account.failure = str(error)
            for envelope in self._scans:
                self._account.settle(source_of(envelope), "unrecorded")
            logger.error("%d messages could not be recorded: %s", len(lost), error)
