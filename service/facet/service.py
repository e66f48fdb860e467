"""The running service: its threads, and the order in which they start and stop."""

from __future__ import annotations

import json
import logging
import threading
import time
from collections.abc import Callable, Mapping
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from queue import SimpleQueue
from typing import Any

import zenoh

from facet import __version__
from facet.admission import Admission
from facet.checkpoint import Checkpoint
from facet.config import Config
from facet.erasing import Erasing
from facet.export.formats import FORMATS
from facet.export.model import Model, build_model
from facet.intake import DurableQueue, Intake
from facet.keeper import Keeper
from facet.mapping.mapper import Mapper
from facet.outgoing import Outgoing
from facet.past import Past
from facet.pipeline import AT_ONCE, Pipeline
from facet.resume import Newest, Resumed, hold, note_newest
from facet.robots import admission_of, dialects_of
from facet.sinks.answers import Answers, CommandError
from facet.sinks.publisher import Publisher
from facet.sinks.recorder import ACKNOWLEDGED, LogPosition, Recorder
from facet.sinks.snapshots import Snapshots
from facet.sources.live import Inbox, LiveSource
from facet.sources.naming import source_of
from facet.status import Account
from facet_protocol.messages import Envelope, Erase

logger = logging.getLogger(__name__)

CATCH_UP_S = 0.02  # after a long update: for the scans that came in meanwhile to become durable
INSERT_S = 0.5  # so long scans go in while more come, before an update
DRAIN_S = 1.0  # at the end: for what has come in to become durable
LAST_UPDATE_S = 2.5  # at the end: no update starts later than this after `stop`
JOIN_S = 5.0
ANSWER_S = 10.0


@dataclass(slots=True)
class Task:
    """Something the mapper's thread does between two updates: only it may touch the map."""

    run: Callable[[], Any]
    result: Future[Any]


class Service:
    """Everything between the Zenoh session and the map. `start`, then `stop`."""

    def __init__(
        self,
        session: zenoh.Session,
        config: Config,
        mapper: Mapper,
        resumed: Resumed | None = None,
    ) -> None:
        """`resumed` says where the mapper's log has come to; without it the map is new."""
        self.account = Account()
        self._resumed = resumed
        self._session, self._config, self._mapper = session, config, mapper
        self._inbox = Inbox(
            config.queue.max_messages,
            config.queue.max_bytes,
            max_message_bytes=config.network.max_message_bytes,
            patience_s=config.queue.patience_s,
            tally=self.account,
        )
        self._durable = DurableQueue(config.queue.max_bytes)
        self._past = resumed.admission.past if resumed else Past(dialects_of(config.robots))
        self._reading = ThreadPoolExecutor(1, "past")  # of the log, for corrections
        self._outgoing = Outgoing(config.map.id, config.map.frame, time.time_ns)
        self.recorder = _recorder(config, mapper)
        self._intake = Intake(
            self._inbox,
            self.recorder,
            self._durable,
            self._outgoing,
            self.account,
            commit_s=config.record.commit_ms * 1e-3,
            retry_s=config.record.retry_s,
            exit_on_failure=config.record.on_full == "exit",
            past=self._past,
        )
        self._erasing = Erasing(self._intake, self._outgoing, self.account, self._has_come)
        self._position: LogPosition | None = None  # all before it in the log is in the map
        self._newest: Newest = {}
        self._tasks: SimpleQueue[Task] = SimpleQueue()
        self._running = threading.Event()  # cleared: paused
        self._running.set()
        self._stopping = threading.Event()
        self._stop_at = float("inf")  # monotonic s: no update starts later
        self.fault: BaseException | None = None  # what ended the mapper's thread
        self.ended = threading.Event()  # the service cannot go on by itself
        self._mapping = threading.Thread(target=self._map, name="mapper", daemon=True)
        self._reporting = threading.Thread(target=self._report, name="status", daemon=True)

    def start(self) -> None:
        """Publish first, then map, then let scans in."""
        self._snapshots = Snapshots(self._config.map.id)
        self._publisher = Publisher(
            self._session,
            self._config.map.id,
            self._snapshots,
            self._config.publish.queue,
            self.account.count,
        )
        self._answers = Answers(
            self._session, self._config.map.id, self._snapshots, self._commands()
        )
        self._intake.follower = self._publisher
        every_ns = int(self._config.publish.points_s * 1e9) if self._config.publish.points else 0
        self._admission = self._admit()
        self._intake.foresee = self._admission.foresee
        self._pipeline = Pipeline(
            self._mapper,
            self._admission,
            self.account,
            [self._intake, self._erasing],
            self._outgoing,
            every_ns,
        )
        self._keeper = Keeper(self._config.record, self.account, self._intake.is_logged)
        if self._resumed is not None:
            self._go_on(self._resumed)
        self._admission.corrections.ask = lambda wanted: self._reading.submit(
            self._past.read, wanted
        )
        self._intake.start()
        self._mapping.start()
        self._reporting.start()
        named, robots = self._config.map.id, self._config.robots
        self._source = LiveSource(
            self._session, named, self._inbox, dialects_of(robots), robots.keys, self._newest
        )

    def _admit(self) -> Admission:
        if self._resumed is None:
            reach_m = self._mapper.settings.reach_m
            return admission_of(self._config, self.account, reach_m, past=self._past)
        self._resumed.admission.report_to(self.account)
        return self._resumed.admission

    def _go_on(self, resumed: Resumed) -> None:
        """With a map that is there: clients get it whole, whatever they had seen of it."""
        self._pipeline.take_over(resumed.pipeline)
        self._pipeline.go_live()
        self._position, self._newest = resumed.position, resumed.newest
        self._intake.expect((source, *numbers) for source, numbers in resumed.newest.items())
        self.account.gauge("resumed_scans", resumed.num_scans)
        if not self._mapper.revision:
            return
        snapshot, log_time_ns = self._mapper.snapshot(), self._pipeline.log_time_ns
        self._outgoing.remember(snapshot)
        self._publisher.write(*self._outgoing.snapshot(snapshot, log_time_ns))
        if self._config.publish.points:
            for message in self._outgoing.points(self._mapper.points(), log_time_ns):
                self._publisher.write(*message)

    def stop(self) -> Model | None:
        """Take no more scans, apply what is durable, finish the log; the model, if it can be made.

        What the time does not suffice for is in the log, and replay finds it there.
        """
        self._source.close()
        self._stop_at = time.monotonic() + LAST_UPDATE_S
        self._intake.drain(DRAIN_S)
        self._stopping.set()
        self._running.set()
        self._durable.close()
        self._mapping.join(JOIN_S)
        self._past.close()
        self._reading.shutdown(wait=False, cancel_futures=True)
        self._reporting.join(1.0)
        self._say_status()
        self._intake.stop(JOIN_S)
        if not self._mapping.is_alive():  # what became durable too late for the mapper
            _leave_out(self.account, self._durable.take(0.0))
        self._answers.close()
        self._publisher.close()
        if self._mapping.is_alive() or self.fault is not None:
            return None
        self._keep_last()
        return self._model()

    def _keep_last(self) -> None:
        """The next start begins here; without it, it reads more of the log."""
        if self._pipeline.is_settled and self._position is not None:
            with suppress(OSError):  # said and counted
                self._keeper.save(self._hold(self._position))

    def _map(self) -> None:
        """The mapper's thread: all that is durable goes in, then an update, and again."""
        try:
            while not self._stopping.is_set():
                self._step(timeout_s=0.1)
            self._step(timeout_s=0.0)
            self._pipeline.finish(max(0.0, self._stop_at - time.monotonic()))
            _leave_out(self.account, self._admission.corrections.waiting())
        except Exception as error:  # a fault of ours: nothing after it could be trusted
            logger.exception("the mapper failed")
            self.fault = error
            self.account.failure = f"mapper: {error}"
            self.ended.set()

    def _step(self, timeout_s: float) -> None:
        while not self._tasks.empty():
            self._do(self._tasks.get())
        if not self._running.wait(timeout_s):
            return
        taken = self._durable.take(timeout_s)
        started = time.monotonic()  # not to wait is no work
        self._insert(taken)
        while taken and time.monotonic() - started < INSERT_S:  # what has come meanwhile, too
            taken = self._durable.take(0.0)
            self._insert(taken)
        self._pipeline.go_on()
        if self._pipeline.is_stale and time.monotonic() <= self._stop_at:
            self.account.stages({"insert": (time.monotonic() - started) * 1e3})
            update = self._pipeline.update()
            took_s = time.monotonic() - started
            if took_s > self._config.record.commit_ms * 1e-3:
                self._intake.catch_up(CATCH_UP_S)
            else:
                self._intake.hurry()
            self.account.gauge("planes_changed", len(update.changed))
            self.account.gauge("update_ms", took_s * 1e3)
            self.account.gauge("map_lag_s", (time.time_ns() - self._pipeline.log_time_ns) * 1e-9)
            self.account.gauge("voxels", self._mapper.num_voxels)
        if self._position is not None and self._pipeline.is_settled and self._keeper.is_due():
            self._keeper.start(self._hold(self._position))

    def _insert(self, taken: list[Envelope]) -> None:
        """What is durable, as long as there is time."""
        num = 0
        while num < len(taken) and time.monotonic() <= self._stop_at:
            now = taken[num : num + AT_ONCE]
            for envelope in now:
                note_newest(self._newest, envelope)
            self._pipeline.insert(*now)
            num += len(now)
        _leave_out(self.account, taken[num:])
        if taken and num == len(taken):
            self._position = self._durable.taken_to

    def _hold(self, position: LogPosition) -> Checkpoint:
        """The map as it is now, on the thread that owns it."""
        started = time.monotonic()
        checkpoint = hold(self._mapper, self._admission, self._config, position, self._newest)
        self.account.gauge("checkpoint_hold_ms", (time.monotonic() - started) * 1e3)
        return checkpoint

    def _do(self, task: Task) -> None:
        try:
            task.result.set_result(task.run())
        except Exception as error:
            task.result.set_exception(error)
            if not isinstance(error, CommandError):  # a fault of ours, as in any other step
                raise

    def _report(self) -> None:
        """The status thread: one message a period."""
        while not self._stopping.wait(self._config.publish.status_s):
            self._say_status()
            if self._intake.failed.is_set():
                self.ended.set()

    def _say_status(self) -> None:
        """To the network and into the log, which so carries its own account of what was lost."""
        gauge = self.account.gauge
        gauge("paused", not self._running.is_set())
        gauge("queue_msgs", len(self._inbox) + len(self._durable))
        gauge("queue_bytes", self._inbox.num_bytes)
        gauge("waiting_for_points", self._admission.num_correcting)
        gauge("waiting_for_pose", self._admission.num_waiting)
        gauge("foreign_ignored", self._inbox.num_ignored)
        gauge("recorded_bytes", self.recorder.committed_bytes)
        gauge("planes", self._snapshots.num_planes)
        gauge("disk_free_mb", self.recorder.free_bytes() / 1e6)
        revision = self._pipeline.revision
        status = self.account.status(self._config.map.id, revision, time.time_ns())
        for sink in (self._publisher, self._intake):
            sink.write(*self._outgoing.status(status))

    def _model(self) -> Model:
        snapshot, counts = self._mapper.snapshot(), self._mapper.counts()
        return build_model(snapshot, counts, self._mapper.settings.as_dict(), self._mapper.digest())

    def _commands(self) -> dict[str, Callable[[Mapping[str, str]], Mapping[str, Any]]]:
        return {
            "pause": self._pause,
            "resume": self._resume,
            "export": self._export,
            "record": self._record,
            "checkpoint": self._checkpoint,
            "erase": self._erasing.ask,
        }

    def _pause(self, parameters: Mapping[str, str]) -> Mapping[str, Any]:
        """Scans are recorded, and wait; when their queue is full, the oldest at the door go."""
        self._running.clear()
        self._on_mapper(lambda: None)  # what it had begun has ended
        return {"paused": True}

    def _resume(self, parameters: Mapping[str, str]) -> Mapping[str, Any]:
        self._running.set()
        return {"paused": False}

    def _checkpoint(self, parameters: Mapping[str, str]) -> Mapping[str, Any]:
        """Now; the answer comes when it is on the disk."""

        def now() -> Checkpoint:
            if self._position is None:
                raise CommandError("nothing has been mapped yet")
            if self._pipeline.is_stale:
                self._pipeline.update()
            if not self._pipeline.is_settled:
                raise CommandError("a correction is under way: ask again")
            return self._hold(self._position)

        try:
            path, num_bytes = self._keeper.save(self._on_mapper(now))
        except OSError as error:
            raise CommandError(f"it cannot be written: {error}") from error
        return {"path": str(path), "bytes": num_bytes, "revision": self._mapper.revision}

    def _record(self, parameters: Mapping[str, str]) -> Mapping[str, Any]:
        """A new file from the next commit on; the finished ones may be copied."""
        self._intake.roll()
        return {"files": [str(path) for path in self.recorder.paths]}

    def _export(self, parameters: Mapping[str, str]) -> Mapping[str, Any]:
        """`format=json|ply|glb|png`, written into the log's folder under a name of ours."""
        name = parameters.get("format", "json")
        if name not in FORMATS:
            raise CommandError(f"format={name!r} is not one of {', '.join(FORMATS)}")
        path = Path(self._config.record.directory) / f"model.{name}"
        model, tiles = self._on_mapper(lambda: (self._model(), self._mapper.points()))
        FORMATS[name](model, tiles, path)
        return {"path": str(path), "planes": len(model["planes"])}

    def _has_come(self, erase: Erase) -> bool:
        return bool(self._on_mapper(lambda: self._admission.has_come(erase)))

    def _on_mapper(self, run: Callable[[], Any]) -> Any:
        """The result of `run`, on the thread that owns the map, between two updates."""
        if self.fault is not None:
            raise CommandError(f"the mapper failed: {self.fault}")
        task = Task(run, Future())
        self._tasks.put(task)
        try:
            return task.result.result(timeout=ANSWER_S)
        except TimeoutError:
            raise CommandError("the mapper is busy: ask again") from None


def _leave_out(account: Account, envelopes: list[Envelope]) -> None:
    """They are in the log, and not in the map."""
    for envelope in envelopes:
        account.settle(source_of(envelope), "not_applied")


def _recorder(config: Config, mapper: Mapper) -> Recorder:
    record = config.record
    metadata = {
        "cuts": "logged",
        "resolved": "logged",
        "map": config.map.id,
        "frame": config.map.frame,
        "config": config.model_dump_json(exclude={"network"}),
        "settings": json.dumps(mapper.settings.as_dict()),
        "version": __version__,
        "acknowledged": ACKNOWLEDGED[record.mode],
    }
    return Recorder(
        record.directory,
        config.map.id,
        metadata,
        compression=record.compression,
        max_file_bytes=record.max_file_bytes,
        max_file_ns=record.max_file_s * 10**9,
        min_free_bytes=record.min_free_bytes,
        is_fast=record.mode == "fast",
        clock=time.time_ns,
    )
