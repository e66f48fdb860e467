"""The service's account of itself: counters that only grow, gauges, stage times, health.

The law of it, at every instant, for each source and for all of them:
received = applied + rejected (by reason) + left out (by cause) + in flight.
"""

from __future__ import annotations

import logging
import threading
import time
from collections import Counter
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass

from facet_protocol.messages import Status

logger = logging.getLogger(__name__)

MAX_SOURCES = 256  # sources counted by name; a stranger cannot make the account grow for ever
BURST_S = 10.0  # one line of log per source and reason in this time

# Why a good message is not applied: it was there already; it may have been, too long ago to tell;
# another with its number was chosen; the queue, the disk or the time did not suffice for it; it has
# no points, and said where a sensor is, or was.
LEFT_OUT = (
    *("duplicate", "late_duplicate", "conflict", "shed_overload", "too_large", "unrecorded"),
    *("not_applied", "used_as_pose", "used_as_correction", "used_as_erasure"),
)


@dataclass(frozen=True, slots=True)
class Balance:
    """What became of the messages of one source, or of all, and of the points of the applied."""

    received: int
    applied: int
    rejected: int
    left_out: int
    in_flight: int  # between the door and the map
    points_in: int
    points_stored: int
    points_rejected: int

    @property
    def is_exact(self) -> bool:
        """Nothing was lost in silence, and nothing counted twice."""
        settled = self.applied + self.rejected + self.left_out
        points = self.points_stored + self.points_rejected
        return self.received == settled + self.in_flight >= settled and self.points_in == points


def balance_of(
    counters: Mapping[str, int], gauges: Mapping[str, float], source: str = ""
) -> Balance:
    """The balance in a status; of all sources together when none is named."""
    tail = f"[{source}]" if source else ""

    def count(name: str) -> int:
        return counters.get(name + tail, 0)

    def count_all(prefix: str) -> int:
        return sum(
            num
            for name, num in counters.items()
            if name.startswith(prefix) and (name.endswith(tail) if tail else "[" not in name)
        )

    return Balance(
        received=count("received"),
        applied=count("applied"),
        rejected=count_all("rejected."),
        left_out=sum(count(name) for name in LEFT_OUT),
        in_flight=int(gauges.get("in_flight" + tail, 0)),
        points_in=count("points_in"),
        points_stored=count("points_stored"),
        points_rejected=count_all("points_rejected."),
    )


class Account:
    """Counters and gauges of every thread; the one place where they meet."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._counters: Counter[str] = Counter()
        self._in_flight: Counter[str] = Counter()  # by source
        self._sources: set[str] = set()
        self._gauges: dict[str, float] = {}
        self._stage_ms: dict[str, float] = {}
        self._spoken: dict[tuple[str, str], float] = {}
        self.failure = ""  # why health is FAIL; "" when it is not
        self.trouble_until = 0.0  # monotonic s: DEGRADED until then

    def count(self, name: str, source: str = "", num: int = 1) -> None:
        """Add to a counter, and to the source's own."""
        with self._lock:
            self._add(name, source, num)

    def arrive(self, source: str, num: int = 1) -> None:
        """Messages have come in: they are in flight until each is settled."""
        with self._lock:
            self._add("received", source, num)
            self._in_flight[self._known(source)] += num

    def settle(
        self, source: str, outcome: str, num: int = 1, also: Mapping[str, int] | None = None
    ) -> None:
        """Messages of `source` are no longer in flight: `applied`, `rejected.<reason>`, or one of
        LEFT_OUT. `also` are counters that move in the same instant: those of their points."""
        with self._lock:
            self._in_flight[self._known(source)] -= num
            for name, more in {outcome: num, **(also or {})}.items():
                self._add(name, source, more)

    def balance(self, source: str = "") -> Balance:
        """As it stands at this instant."""
        with self._lock:
            return balance_of(self._counters, self._flights(), source)

    def sources(self) -> list[str]:
        """Every source that was counted by name."""
        with self._lock:
            return sorted(self._sources)

    def set_counter(self, name: str, value: int) -> None:
        with self._lock:
            self._counters[name] = value

    def gauge(self, name: str, value: float, source: str = "") -> None:
        """Set a gauge; one of a source is kept under the source's name."""
        with self._lock:
            self._gauges[f"{name}[{self._known(source)}]" if source else name] = value

    def stages(self, stage_ms: Mapping[str, float]) -> None:
        with self._lock:
            self._stage_ms.update(stage_ms)

    def complain(self, source: str, reason: str, text: str) -> None:
        """One line of log per source and reason and burst; health is DEGRADED for a while."""
        now = time.monotonic()
        with self._lock:
            self.trouble_until = now + BURST_S
            key = (self._known(source), reason)
            if now - self._spoken.get(key, -BURST_S) < BURST_S:
                return
            self._spoken[key] = now
        logger.warning("%s: %s: %s", source, reason, text)

    def __getitem__(self, name: str) -> int:
        with self._lock:
            return self._counters[name]

    def counters(self) -> dict[str, int]:
        with self._lock:
            return {name: num for name, num in sorted(self._counters.items()) if num}

    def status(self, map_id: str, revision: int, stamp_ns: int) -> Status:
        """Everything as it stands now."""
        with self._lock:
            return Status(
                map_id=map_id,
                revision=revision,
                stamp_ns=stamp_ns,
                health=self._health(),
                counters={name: num for name, num in sorted(self._counters.items()) if num > 0},
                gauges=dict(
                    sorted({**self._gauges, **self._flights(), "rss_mb": _rss_mb()}.items())
                ),
                stage_ms=dict(self._stage_ms),
            )

    def _add(self, name: str, source: str, num: int) -> None:
        if num:
            self._counters[name] += num
            if source:
                self._counters[f"{name}[{self._known(source)}]"] += num

    def _flights(self) -> dict[str, float]:
        by_source = {f"in_flight[{s}]": float(n) for s, n in self._in_flight.items() if n}
        return {"in_flight": float(sum(self._in_flight.values())), **by_source}

    def _health(self) -> str:
        if self.failure:
            return "FAIL"
        return "DEGRADED" if time.monotonic() < self.trouble_until else "OK"

    def _known(self, source: str) -> str:
        if source not in self._sources and len(self._sources) >= MAX_SOURCES:
            source = "others"
        self._sources.add(source)
        return source


def _rss_mb() -> float:
    """Resident memory, MB; 0 where the system does not say."""
    with suppress(OSError, ValueError, IndexError), open("/proc/self/statm", encoding="ascii") as f:
        return int(f.read().split()[1]) * 4096 / 1e6
    return 0.0
