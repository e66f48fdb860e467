"""What clients may ask over Zenoh: snapshot, points, schema, commands. A thread of its own, since a
reply travels with the asker's quality of service and may have to wait for the asker."""

from __future__ import annotations

import json
import logging
import queue
import re
import threading
from collections.abc import Callable, Mapping
from typing import Any

import zenoh

from facet.sinks.publisher import encoding_of, tile_payload
from facet.sinks.snapshots import Snapshots
from facet_protocol import topics
from facet_protocol.codec import encode, facet_descriptors

logger = logging.getLogger(__name__)

Command = Callable[[Mapping[str, str]], Mapping[str, Any]]
MAX_QUESTIONS = 64
_REVISION = re.compile(r"[0-9]{1,20}")


class CommandError(Exception):
    """A command that cannot be done now; the text is the answer."""


class Answers:
    """Queryables of one map. Every question gets an answer or an error that names the cause."""

    def __init__(
        self,
        session: zenoh.Session,
        map_id: str,
        snapshots: Snapshots,
        commands: Mapping[str, Command],
    ) -> None:
        self._map_id, self._snapshots = map_id, snapshots
        self._questions: queue.Queue[tuple[Callable[[Any], None], Any] | None]
        self._questions = queue.Queue(MAX_QUESTIONS)
        self._queryables = [
            self._declare(session, topics.snapshot_key(map_id), self._snapshot),
            self._declare(session, topics.points_key(map_id), self._points),
            self._declare(session, topics.schema_key(map_id), self._schema),
        ]
        for name, command in commands.items():
            key = topics.cmd_key(map_id, name)
            self._queryables.append(self._declare(session, key, self._obey(name, key, command)))
        self._thread = threading.Thread(target=self._run, name="answers", daemon=True)
        self._thread.start()

    def close(self) -> None:
        """Take no more questions."""
        for queryable in self._queryables:
            queryable.undeclare()
        try:
            self._questions.put(None, timeout=0.5)
        except queue.Full:
            logger.warning("a client does not take its answer")
        self._thread.join(timeout=1.0)

    def _declare(
        self, session: zenoh.Session, key: str, answer: Callable[[Any], None]
    ) -> zenoh.Queryable[Any]:
        def ask(query: Any) -> None:  # on Zenoh's threads: only enqueue
            try:
                self._questions.put_nowait((answer, query))
            except queue.Full:
                _refuse(query, "busy: too many questions at once")

        return session.declare_queryable(key, zenoh.handlers.Callback(ask, indirect=False))

    def _run(self) -> None:
        while (question := self._questions.get()) is not None:
            answer, query = question
            try:
                with query:
                    answer(query)
            except Exception:  # a client that went away must not end the service of the others
                logger.exception("a question could not be answered")

    def _snapshot(self, query: Any) -> None:
        since = query.parameters.get("since", "0")
        if _REVISION.fullmatch(since) is None:
            _refuse(query, f"since={since[:80]!r} is not a revision")
            return
        schema, payload = encode(self._snapshots.since(int(since)))
        query.reply(topics.snapshot_key(self._map_id), payload, encoding=encoding_of(schema))

    def _points(self, query: Any) -> None:
        for envelope, tile in self._snapshots.tiles():
            payload, encoding = tile_payload(envelope, tile), encoding_of(envelope.schema)
            query.reply(topics.points_key(self._map_id), payload, encoding=encoding)

    def _schema(self, query: Any) -> None:
        encoding = encoding_of("google.protobuf.FileDescriptorSet")
        query.reply(topics.schema_key(self._map_id), facet_descriptors(), encoding=encoding)

    def _obey(self, name: str, key: str, command: Command) -> Callable[[Any], None]:
        def answer(query: Any) -> None:
            try:
                result = command(parameters_of(name, str(query.parameters)))
            except CommandError as error:
                _refuse(query, str(error))
                return
            except Exception as error:  # a full disk, a folder in the way: the asker is told
                logger.exception("%s failed", name)
                _refuse(query, f"{name} failed: {error}")
                return
            query.reply(key, json.dumps(result), encoding=zenoh.Encoding.APPLICATION_JSON)

        return answer


def parameters_of(command: str, text: str) -> dict[str, str]:
    """Those of `a=1;b=2`. Raises CommandError for one that the command does not take, that has no
    value, or that comes twice: what was not understood is not done by half."""
    known, found = topics.COMMANDS[command], dict[str, str]()
    for part in filter(None, text.split(";")):
        name, _, value = part.partition("=")
        if name not in known:
            takes = ", ".join(f"{name}=" for name in known) or "none: leave it out"
            raise CommandError(f"{part!r} is no parameter of {command}, which takes {takes}")
        if not value:
            raise CommandError(f"{name}= has no value: give it one, or leave it out")
        if name in found:
            raise CommandError(f"{name}= comes twice, {found[name]!r} and {value!r}: give it once")
        found[name] = value
    return found


def _refuse(query: Any, text: str) -> None:
    with query:
        query.reply_err(text, encoding=zenoh.Encoding.TEXT_PLAIN)
