"""The line: a message in, the map updated, messages out. One thread owns it, and so the map."""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass

from facet.admission import Admission, Admitted, Moved
from facet.mapping.mapper import Mapper
from facet.mapping.quantise import quantise
from facet.outgoing import Outgoing
from facet.plausibility import Plausibility
from facet.sinks import Message, Sink
from facet.sources.naming import source_of
from facet.status import Account
from facet_protocol import topics
from facet_protocol.messages import Corrected, Cut, Envelope, MapUpdate, ResolvedPose, Scan

Tile = tuple[int, int, int]


@dataclass(slots=True)
class Applied:
    """The last scan of a source that is in the map, and how many came since the last cut."""

    envelope: Envelope
    scan: Scan
    num_scans: int


class Pipeline:
    """Applies scans and derives updates; every sink sees every message once, in order.

    Who fails how: a bad message is counted and left out (`Admission`); a fault of the mapper's is
    not caught here, for nothing that comes after it could be trusted.
    """

    def __init__(
        self,
        mapper: Mapper,
        admission: Admission,
        account: Account,
        sinks: Sequence[Sink],
        outgoing: Outgoing,
        points_every_ns: int = 0,
    ) -> None:
        self._mapper, self._admission, self._account = mapper, admission, account
        self._sinks, self._outgoing = tuple(sinks), outgoing
        self._points_every_ns = points_every_ns  # 0: points are not sent
        self._plausibility = Plausibility()
        self._applied: dict[str, Applied] = {}
        self._changed_tiles: set[Tile] = set()
        self._points_sent_ns = 0
        self.revision = 0
        self.log_time_ns = 0  # of the newest message applied
        self.is_stale = False  # something was inserted since the last update

    def take_over(self, other: Pipeline) -> None:
        """Go on where a pipeline of the same map and admission has ended."""
        self._applied = other._applied
        self._changed_tiles = other._changed_tiles
        self.revision, self.log_time_ns = self._mapper.revision, other.log_time_ns
        self.is_stale = other.is_stale

    def insert(self, envelope: Envelope) -> bool:
        """Take one message, without deriving anything; False when it changes nothing in the map: it
        is left out, it waits, or it is a pose that no scan waits for."""
        self.log_time_ns = max(self.log_time_ns, envelope.received_ns)
        return self._apply(self._admission.admit(envelope))

    def go_live(self) -> None:
        """The log that was read ends here: what comes now is new."""
        self._apply(self._admission.go_live())

    def go_on(self) -> bool:
        """Apply the corrections whose points have come from the log."""
        return self._apply(self._admission.go_on())

    @property
    def is_settled(self) -> bool:
        """The map is what the log says, up to the last message that was taken."""
        return not self.is_stale and not self._admission.num_correcting

    def _apply(self, admitted: Sequence[Admitted | Moved]) -> bool:
        num_changes = 0
        for one in admitted:
            if isinstance(one, Moved):
                self._move(one)
                self._say(topics.CORRECTED_TOPIC, one.corrected)
                num_changes += len(one.scans)
                continue
            self._insert(one.envelope, one.scan)
            if one.resolved is not None:
                self._say(topics.RESOLVED_TOPIC, one.resolved)
            num_changes += 1
        return num_changes > 0

    def _say(self, topic: str, message: ResolvedPose | Corrected) -> None:
        said = self._outgoing.address(topic, message, message.stamp_ns, self.log_time_ns)
        self._emit((said,))

    def _move(self, moved: Moved) -> None:
        """Take scans out where they are, and put them in where they are to be: exactly."""
        for old, new in moved.scans:
            out = quantise(old, self._mapper.settings)
            self._mapper.retract(old)
            inserted = self._mapper.insert(new)
            changes = Counter(inserted.rejected)
            changes.subtract(out.rejected)
            points = {f"points_rejected.{reason}": num for reason, num in changes.items()}
            points["points_stored"] = inserted.points_stored - len(out.points)
            self._account.settle(new.source, "scans_corrected", 0, {"scans_corrected": 1, **points})
        if moved.scans:
            self._account.settle(source_of(moved.envelope), "used_as_correction")
            self.is_stale = True

    def _insert(self, envelope: Envelope, scan: Scan) -> None:
        inserted = self._mapper.insert(scan)
        self._count(scan, inserted.points_stored, inserted.rejected)
        for name, text in self._plausibility.oddities(scan, envelope.received_ns).items():
            self._account.count(name, scan.source)
            self._account.complain(scan.source, name, text)
        previous = self._applied.get(scan.source)
        num_scans = (previous.num_scans if previous else 0) + 1
        self._applied[scan.source] = Applied(envelope, scan, num_scans)
        self.is_stale = True
        self._emit(((envelope, scan),))

    def update(self) -> MapUpdate:
        """Derive everything that is stale, and send what changed."""
        stopwatch = Stopwatch()
        update = self._mapper.update(stopwatch)
        self.is_stale = False
        self.revision = update.revision
        self._account.stages(stopwatch.stage_ms)
        self._account.count("updates")
        self._emit(self._outgoing.update(update, self._cuts(update), self.log_time_ns))
        self._emit(self._outgoing.poses([a.scan for a in self._applied.values()], self.log_time_ns))
        self._changed_tiles.update(self._mapper.changed_tiles)
        self._send_points(update)
        return update

    def finish(self, timeout_s: float | None = None) -> None:
        """Settle what still waits for its pose, or, as long as that, for its points; send what was
        held back: the last points, the last scene."""
        if self._apply(self._admission.finish(timeout_s)):
            self.update()
        self._points_every_ns = min(self._points_every_ns, 1)
        self._emit(self._outgoing.finish(self.log_time_ns))
        self._send_points(None)

    def _cuts(self, update: MapUpdate) -> list[Cut]:
        """Where this update ends, by source, in the order of their names."""
        cuts = []
        for source in sorted(self._applied):
            applied = self._applied[source]
            envelope = applied.envelope
            cuts.append(
                Cut(
                    revision=update.revision,
                    robot=applied.scan.robot,
                    sensor=applied.scan.sensor,
                    epoch=envelope.epoch,
                    sequence=envelope.sequence,
                    stamp_ns=envelope.stamp_ns,
                    num_scans=applied.num_scans,
                )
            )
            applied.num_scans = 0
        return cuts

    def _send_points(self, update: MapUpdate | None) -> None:
        due = self.log_time_ns - self._points_sent_ns >= self._points_every_ns
        if not self._points_every_ns or not self._changed_tiles or (update and not due):
            return
        self._points_sent_ns = self.log_time_ns
        tiles, self._changed_tiles = sorted(self._changed_tiles), set()
        self._emit(self._outgoing.points(self._mapper.points(tiles), self.log_time_ns))

    def _emit(self, messages: Iterable[tuple[Envelope, Message | None]]) -> None:
        if not self._sinks:  # nothing is encoded for nobody
            return
        for envelope, message in messages:
            for sink in self._sinks:
                sink.write(envelope, message)

    def _count(self, scan: Scan, points_stored: int, rejected: dict[str, int]) -> None:
        """One instant for a scan and all its points: points in = stored + rejected."""
        lost = Counter(rejected) + Counter(scan.ignored)
        points = {f"points_rejected.{reason}": num for reason, num in lost.items()}
        points["points_in"] = len(scan.points) + sum(scan.ignored.values())
        points["points_stored"] = points_stored
        self._account.settle(scan.source, "applied", also=points)


class Stopwatch:
    """Called as each stage ends; keeps the milliseconds of each."""

    def __init__(self, clock: Callable[[], float] = time.perf_counter) -> None:
        self.stage_ms: dict[str, float] = {}
        self._clock, self._last = clock, clock()

    def __call__(self, stage: str) -> None:
        now = self._clock()
        self.stage_ms[stage] = (now - self._last) * 1e3
        self._last = now
