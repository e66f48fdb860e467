"""What was missed and not sent again at the first time of asking: it is asked for until it comes.

Zenoh's advanced subscriber asks a publisher once for what lies in a gap. When the link breaks over
the answer, it goes on behind the gap, and what the publisher still keeps would be lost.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import NamedTuple, Protocol

import zenoh

FIRST_S, LAST_S = 0.5, 4.0  # between one time of asking and the next
GIVE_UP_S = 600.0  # without an answer
ANSWER_S = 60.0  # what takes longer is asked for again
MAX_ASKED = 64  # samples at a time, at first: a slow network answers that in time
MAX_PUBLISHERS = 4096
MAX_GAPS = 1024
MAX_MISSING = 1 << 16  # samples of a gap: no cache keeps more


class Publisher(NamedTuple):
    """An advanced publisher, by its key and Zenoh's name for it."""

    key: str
    session: str
    entity: str

    def selector(self, first: int, last: int) -> str:
        """Asks its cache for the samples with these numbers."""
        return f"{self.key}/@adv/pub/{self.session}/{self.entity}/**?_sn={first}..{last}"


@dataclass(slots=True, eq=False)
class Gap:
    """Samples that are missing: Zenoh's own numbers, `last` included."""

    publisher: Publisher
    first: int
    last: int
    due: float
    ends: float  # then it is given up
    wait_s: float = FIRST_S
    num_asked: int = MAX_ASKED  # at a time
    is_asked: bool = False
    has_answer: bool = False  # to the last time of asking


class Ask(Protocol):
    """Ask for a selector: `take` gets every sample of the answer, and then `end` is called."""

    def __call__(
        self, selector: str, take: Callable[[zenoh.Sample], None], end: Callable[[], None]
    ) -> None: ...


class Recovery:
    """Sees the gaps in what comes from advanced publishers, and hands what fills them to `take`."""

    def __init__(
        self,
        ask: Ask,
        take: Callable[[zenoh.Sample], None],
        clock: Callable[[], float] = time.monotonic,
        lacking: Callable[[zenoh.Sample], int] = lambda sample: 0,
    ) -> None:
        """`lacking`: how many samples before the first of a publisher have not come either."""
        self._ask, self._take, self._clock, self._lacking = ask, take, clock, lacking
        self._newest: dict[Publisher, int] = {}
        self._gaps: list[Gap] = []
        self._changed = threading.Condition()
        self._closed = False
        self._thread = threading.Thread(target=self._run, name="recovery", daemon=True)

    def start(self) -> None:
        self._thread.start()

    def close(self) -> None:
        """Nothing is taken any more."""
        with self._changed:
            self._closed = True
            self._changed.notify_all()
        if self._thread.ident is not None:
            self._thread.join()

    @property
    def num_missing(self) -> int:
        """Samples that are still asked for."""
        with self._changed:
            return sum(gap.last - gap.first + 1 for gap in self._gaps)

    def note(self, sample: zenoh.Sample) -> None:
        """What lies between a sample and the one before it was given up by Zenoh."""
        info = sample.source_info
        if info is None:
            return  # no advanced publisher
        source, number = info.source_id, info.source_sn
        publisher = Publisher(str(sample.key_expr), str(source.zid), str(source.eid))
        with self._changed:
            known = self._newest.pop(publisher, None)
            before = known if known is not None else number - 1 - self._lacking(sample)
            before = max(before, -1)  # the first has the number 0
            self._newest[publisher] = max(before, number)
            if len(self._newest) > MAX_PUBLISHERS:
                del self._newest[next(iter(self._newest))]
            if 0 < number - before - 1 <= MAX_MISSING:
                now = self._clock()
                gap = Gap(publisher, before + 1, number - 1, now + FIRST_S, now + GIVE_UP_S)
                self._gaps = [*self._gaps, gap][-MAX_GAPS:]
                self._changed.notify_all()

    def _run(self) -> None:
        while (gap := self._next()) is not None:
            last = min(gap.last, gap.first + gap.num_asked - 1)
            selector = gap.publisher.selector(gap.first, last)
            self._ask(selector, partial(self._fill, gap), partial(self._end, gap))

    def _next(self) -> Gap | None:
        """Wait for the next gap that is to be asked for; None: there will be none."""
        with self._changed:
            while not self._closed:
                waiting = [gap for gap in self._gaps if not gap.is_asked]
                gap = min(waiting, key=lambda gap: gap.due, default=None)
                now = self._clock()
                if gap is not None and gap.due <= now:
                    gap.is_asked, gap.has_answer = True, False
                    return gap
                self._changed.wait(gap.due - now if gap is not None else None)
        return None

    def _fill(self, gap: Gap, sample: zenoh.Sample) -> None:
        """Take one that was missing. A cache answers from the oldest on: what lies before it and
        did not come is not there any more."""
        number = sample.source_info.source_sn if sample.source_info is not None else -1
        with self._changed:
            is_wanted = (
                gap.first <= number <= gap.last and str(sample.key_expr) == gap.publisher.key
            )
            if self._closed or not is_wanted:
                return
            gap.first, gap.has_answer = number + 1, True
        self._take(sample)

    def _end(self, gap: Gap) -> None:
        """The answer is over, whole or not."""
        with self._changed:
            now, gap.is_asked = self._clock(), False
            if gap.has_answer:
                gap.due, gap.ends, gap.wait_s = now, now + GIVE_UP_S, FIRST_S
                gap.num_asked = MAX_ASKED
            else:  # nobody is there, or these are not: more of them next time
                gap.due, gap.wait_s = now + gap.wait_s, min(2 * gap.wait_s, LAST_S)
                gap.num_asked = min(2 * gap.num_asked, MAX_MISSING)
            if gap.first > gap.last or now > gap.ends:
                self._gaps = [other for other in self._gaps if other is not gap]
            self._changed.notify_all()


def asked_in(session: zenoh.Session) -> Ask:
    """Asks the caches of the publishers that a session reaches."""

    def ask(selector: str, take: Callable[[zenoh.Sample], None], end: Callable[[], None]) -> None:
        def hear(reply: zenoh.Reply) -> None:
            if reply.ok is not None:
                take(reply.ok)

        try:
            session.get(
                selector,
                zenoh.handlers.Callback(hear, end, indirect=False),
                target=zenoh.QueryTarget.ALL,
                consolidation=zenoh.ConsolidationMode.NONE,
                accept_replies=zenoh.ReplyKeyExpr.ANY,
                timeout=ANSWER_S,
            )
        except zenoh.ZError:  # the session is closing
            end()

    return ask
