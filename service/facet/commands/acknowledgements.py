"""What a service says that its log holds of what a robot has sent: until then the robot stays."""

from __future__ import annotations

import threading
import time
from collections import Counter
from collections.abc import Mapping

import zenoh

from facet_protocol import topics
from facet_protocol.messages import ProtocolError
from facet_protocol.records import decode_status

PATIENCE_S = 90.0  # without news: a service may be silent for 60 s, a link takes to come back
_EPOCH = "ack_epoch["  # a gauge of each source


class Acknowledgements:
    """Listens to the status of one map for what a publisher, by its epoch, has sent."""

    def __init__(self, session: zenoh.Session, map_id: str, epoch: int) -> None:
        self.is_heard = False  # somebody there acknowledges
        self._epoch = epoch
        self._taken: Counter[str] = Counter()  # by source
        self._changed = threading.Condition()
        self._subscriber = session.declare_subscriber(
            topics.status_key(map_id), zenoh.handlers.Callback(self._hear, indirect=False)
        )

    def close(self) -> None:
        self._subscriber.undeclare()  # type: ignore[no-untyped-call]

    def wait(self, sent: Mapping[str, int], patience_s: float) -> int:
        """Wait for all that was sent, by source; how many are not acknowledged after so long
        without news."""
        with self._changed:
            left, deadline = self._left(sent), time.monotonic() + patience_s
            while left and (wait_s := deadline - time.monotonic()) > 0.0:
                self._changed.wait(wait_s)
                if (now_left := self._left(sent)) < left:
                    left, deadline = now_left, time.monotonic() + patience_s
            return left

    def _left(self, sent: Mapping[str, int]) -> int:
        return sum(max(0, num - self._taken[source]) for source, num in sent.items())

    def _hear(self, sample: zenoh.Sample) -> None:
        try:
            gauges = decode_status(sample.payload.to_bytes()).gauges
        except ProtocolError:
            return
        with self._changed:
            self.is_heard = True
            for source, num in taken_of(gauges, self._epoch).items():
                self._taken[source] = max(self._taken[source], num)
            self._changed.notify_all()


def taken_of(gauges: Mapping[str, float], epoch: int) -> dict[str, int]:
    """How many of an epoch's messages a service has in its log, by source."""
    taken = {}
    for name, value in gauges.items():
        if name.startswith(_EPOCH) and value == epoch:
            source = name.removeprefix(_EPOCH).removesuffix("]")
            newest, missing = (gauges.get(f"{g}[{source}]", 0) for g in ("ack", "ack_missing"))
            taken[source] = int(newest - missing)
    return taken
