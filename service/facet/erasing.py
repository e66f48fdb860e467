"""The command `erase`: into the log first, as all that the map is made of; then its outcome."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Mapping
from concurrent.futures import Future
from typing import Any

from facet.outgoing import Outgoing
from facet.sinks import Message, Sink
from facet.sinks.answers import CommandError
from facet.sources.naming import source_of
from facet.status import Account
from facet_protocol import topics
from facet_protocol.messages import Corrected, Envelope, Erase, ProtocolError

ANSWER_S = 10.0
MAX_DIGITS = 20
MAX_NUMBER = {"epoch": (1 << 32) - 1, "first": (1 << 64) - 1, "last": (1 << 64) - 1}


class Erasing:
    """Asks on one thread; as a sink it hears on the mapper's what became of it."""

    def __init__(
        self, log: Sink, outgoing: Outgoing, account: Account, has_come: Callable[[Erase], bool]
    ) -> None:
        """`log` takes it as an input, unless nothing that it names `has_come`: a name typed wrong
        is no part of what the map is made of."""
        self._log, self._outgoing, self._account = log, outgoing, account
        self._has_come = has_come
        self._waiting: dict[tuple[str, int], Future[Corrected]] = {}  # by robot and stamp
        self._lock = threading.Lock()

    def ask(self, parameters: Mapping[str, str]) -> Mapping[str, Any]:
        """`robot=r1`, and to erase less, `sensor=`, `epoch=`, `first=`, `last=` (sequences).

        Raises CommandError: nothing was erased, or it is not done yet.
        """
        erase = _erase_of(parameters)
        if not self._has_come(erase):
            robots = sorted({source.partition("/")[0] for source in self._account.sources()})
            text = f"no such scan of {erase.robot} has come, nothing was erased"
            heard = f"; heard since the start: {', '.join(robots)}" if robots else ""
            raise CommandError(text + heard)
        stamp_ns = time.time_ns()
        topic = topics.erase_topic(erase.robot)
        envelope, _ = self._outgoing.address(topic, erase, stamp_ns, stamp_ns)
        outcome: Future[Corrected] = Future()
        with self._lock:
            self._waiting[erase.robot, stamp_ns] = outcome
        self._account.arrive(source_of(envelope))
        self._log.write(envelope, erase)
        try:
            corrected = outcome.result(ANSWER_S)
        except TimeoutError:
            raise CommandError("not done yet; it is in the log, and will be") from None
        finally:
            with self._lock:
                self._waiting.pop((erase.robot, stamp_ns), None)
        if corrected.reason:
            text = f"nothing of {erase.robot} was erased: {corrected.reason} (the log says more)"
            raise CommandError(text)
        return {"robot": erase.robot, "scans_erased": corrected.num_scans}

    def write(self, envelope: Envelope, message: Message | None) -> None:
        """Hear what became of one."""
        if isinstance(message, Corrected):
            with self._lock:
                outcome = self._waiting.pop((message.robot, message.stamp_ns), None)
            if outcome is not None:
                outcome.set_result(message)

    def close(self) -> None:
        """Nothing: who waits, waits until his time is up."""


def _erase_of(parameters: Mapping[str, str]) -> Erase:
    """Raises CommandError."""
    if not parameters.get("robot"):
        raise CommandError("whose scans? say robot=NAME")
    try:
        for name in ("robot", "sensor"):
            if parameters.get(name):
                topics.check_id(parameters[name])
    except ProtocolError as error:
        raise CommandError(str(error)) from error
    numbers = {name: _number(name, parameters[name]) for name in MAX_NUMBER if name in parameters}
    erase = Erase(parameters["robot"], parameters.get("sensor", ""), **numbers)
    if erase.last and erase.first > erase.last:
        raise CommandError(f"first={erase.first} comes after last={erase.last}")
    return erase


def _number(name: str, text: str) -> int:
    """From 1: none of them is ever 0, which in an `Erase` stands for all."""
    is_number = text.isascii() and text.isdecimal() and len(text) <= MAX_DIGITS
    if not is_number or not 1 <= int(text) <= MAX_NUMBER[name]:
        raise CommandError(f"{name}={text[:80]!r} is not a number from 1 to {MAX_NUMBER[name]}")
    return int(text)
