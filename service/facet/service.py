"""The running service: its threads, and the order in which they start and stop."""

from __future__ import annotations

import json
import logging
import threading
import time
from collections.abc import Callable, Mapping
from concurrent.futures import Future
from dataclasses import dataclass
from pathlib import Path
from queue import SimpleQueue
from typing import Any

import zenoh

from facet import __version__
from facet.admission import Admission
from facet.config import Config
from facet.export.formats import FORMATS
from facet.export.model import Model, build_model
from facet.intake import DurableQueue, Intake
from facet.mapping.mapper import Mapper
from facet.outgoing import Outgoing
from facet.pipeline import Pipeline
from facet.sinks.answers import Answers, CommandError
from facet.sinks.publisher import Publisher
from facet.sinks.recorder import Recorder
from facet.sinks.snapshots import Snapshots
from facet.sources.live import Inbox, LiveSource
from facet.sources.naming import source_of
from facet.status import Account

logger = logging.getLogger(__name__)

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

    def __init__(self, session: zenoh.Session, config: Config, mapper: Mapper) -> None:
        self.account = Account()
        self._session, self._config, self._mapper = session, config, mapper
        self._inbox = Inbox(
            config.queue.max_messages,
            config.queue.max_bytes,
            max_message_bytes=config.network.max_message_bytes,
            patience_s=config.queue.patience_s,
            tally=self.account,
        )
        self._durable = DurableQueue(config.queue.max_bytes)
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
        )
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
        every_ns = int(self._config.publish.points_s * 1e9) if self._config.publish.points else 0
        self._pipeline = Pipeline(
            self._mapper,
            Admission(self.account, self._config.map.frame, self._mapper.settings.reach_m),
            self.account,
            [self._intake, self._publisher],
            self._outgoing,
            every_ns,
        )
        self._intake.start()
        self._mapping.start()
        self._reporting.start()
        self._source = LiveSource(self._session, self._config.map.id, self._inbox)

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
        self._reporting.join(1.0)
        self._say_status()
        self._answers.close()
        self._publisher.close()
        self._intake.stop(JOIN_S)
        finished = not self._mapping.is_alive() and self.fault is None
        return self._model() if finished else None

    def _map(self) -> None:
        """The mapper's thread: all that is durable goes in, then an update, and again."""
        try:
            while not self._stopping.is_set():
                self._step(timeout_s=0.1)
            self._step(timeout_s=0.0)
            self._pipeline.finish()
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
        started = time.monotonic()
        for envelope in self._durable.take(timeout_s):
            if time.monotonic() > self._stop_at:
                self.account.settle(source_of(envelope.key), "not_applied")
                continue
            self._pipeline.insert(envelope)
        if self._pipeline.is_stale and time.monotonic() <= self._stop_at:
            self.account.stages({"insert": (time.monotonic() - started) * 1e3})
            update = self._pipeline.update()
            self.account.gauge("planes_changed", len(update.changed))
            self.account.gauge("update_ms", (time.monotonic() - started) * 1e3)
            self.account.gauge("map_lag_s", (time.time_ns() - self._pipeline.log_time_ns) * 1e-9)
            self.account.gauge("voxels", self._mapper.counts().voxels)

    def _do(self, task: Task) -> None:
        try:
            task.result.set_result(task.run())
        except Exception as error:  # noqa: BLE001 it is the asker's to handle
            task.result.set_exception(error)

    def _report(self) -> None:
        """The status thread: one message a period."""
        while not self._stopping.wait(self._config.publish.status_s):
            self._say_status()
            if self._intake.failed.is_set():
                self.ended.set()

    def _say_status(self) -> None:
        """To the network and into the log, which so carries its own account of what was lost."""
        gauge = self.account.gauge
        gauge("queue_msgs", len(self._inbox) + len(self._durable))
        gauge("queue_bytes", self._inbox.num_bytes)
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
            "checkpoint": _not_yet("there are no checkpoints: a map is rebuilt from its log"),
            "erase": _not_yet("scans are taken out by a correction, not by a command"),
        }

    def _pause(self, parameters: Mapping[str, str]) -> Mapping[str, Any]:
        """Scans are recorded, and wait; when their queue is full, the oldest at the door go."""
        self._running.clear()
        self._on_mapper(lambda: None)  # what it had begun has ended
        return {"paused": True}

    def _resume(self, parameters: Mapping[str, str]) -> Mapping[str, Any]:
        self._running.set()
        return {"paused": False}

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

    def _on_mapper(self, run: Callable[[], Any]) -> Any:
        """The result of `run`, on the thread that owns the map, between two updates."""
        task = Task(run, Future())
        self._tasks.put(task)
        try:
            return task.result.result(timeout=ANSWER_S)
        except TimeoutError:
            raise CommandError("the mapper is busy: ask again") from None


def _not_yet(cause: str) -> Callable[[Mapping[str, str]], Mapping[str, Any]]:
    def refuse(parameters: Mapping[str, str]) -> Mapping[str, Any]:
        raise CommandError(f"not supported: {cause}")

    return refuse


def _recorder(config: Config, mapper: Mapper) -> Recorder:
    record = config.record
    metadata = {
        "cuts": "logged",
        "map": config.map.id,
        "frame": config.map.frame,
        "config": config.model_dump_json(exclude={"network"}),
        "settings": json.dumps(mapper.settings.as_dict()),
        "version": __version__,
    }
    return Recorder(
        record.directory,
        config.map.id,
        metadata,
        compression=record.compression,
        max_file_bytes=record.max_file_bytes,
        max_file_ns=record.max_file_s * 10**9,
        min_free_bytes=record.min_free_bytes,
        clock=time.time_ns,
    )
