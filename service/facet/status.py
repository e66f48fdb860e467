"""The service's account of itself: counters that only grow, gauges, stage times, health."""

from __future__ import annotations

import logging
import threading
import time
from collections import Counter
from collections.abc import Mapping
from contextlib import suppress

from facet_protocol.messages import Status

logger = logging.getLogger(__name__)

MAX_SOURCES = 256  # sources counted by name; a stranger cannot make the account grow for ever
BURST_S = 10.0  # one line of log per source and reason in this time


class Account:
    """Counters and gauges of every thread; the one place where they meet."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._counters: Counter[str] = Counter()
        self._sources: set[str] = set()
        self._gauges: dict[str, float] = {}
        self._stage_ms: dict[str, float] = {}
        self._spoken: dict[tuple[str, str], float] = {}
        self.failure = ""  # why health is FAIL; "" when it is not
        self.trouble_until = 0.0  # monotonic s: DEGRADED until then

    def count(self, name: str, source: str = "", num: int = 1) -> None:
        """Add to a counter, and to the source's own."""
        if num == 0:
            return
        with self._lock:
            self._counters[name] += num
            if source:
                self._counters[f"{name}[{self._known(source)}]"] += num

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
                gauges=dict(sorted({**self._gauges, "rss_mb": _rss_mb()}.items())),
                stage_ms=dict(self._stage_ms),
            )

    def _health(self) -> str:
        if self.failure:
            return "FAIL"
        return "DEGRADED" if time.monotonic() < self.trouble_until else "OK"

    def _known(self, source: str) -> str:
        if source not in self._sources and len(self._sources) >= MAX_SOURCES:
            return "others"
        self._sources.add(source)
        return source


def _rss_mb() -> float:
    """Resident memory, MB; 0 where the system does not say."""
    with suppress(OSError, ValueError, IndexError), open("/proc/self/statm", encoding="ascii") as f:
        return int(f.read().split()[1]) * 4096 / 1e6
    return 0.0
