"""The line: a message in, the map updated, messages out. One thread owns it, and so the map."""

from __future__ import annotations

import time
from collections import Counter, defaultdict
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass

from facet.admission import Admission, Moved, Outcome
from facet.mapping.mapper import Counted, Mapper
from facet.outgoing import Outgoing
from facet.placement import Admitted
from facet.sinks import Message, Sink
from facet.sources.naming import source_of
from facet.status import Account
from facet_protocol import topics
from facet_protocol.messages import (
    Conflict,
    Corrected,
    Cut,
    Envelope,
    MapUpdate,
    ResolvedPose,
    Scan,
)

Tile = tuple[int, int, int]
AT_ONCE = 64  # scans that go into the map together, of whichever robots,
POINTS_AT_ONCE = 1 << 18  # or fewer with so many points
BEATS = 16  # in a period, to one of which the points of a tile are sent
RECORD_TOPICS = {
    ResolvedPose: topics.RESOLVED_TOPIC,
    Corrected: topics.CORRECTED_TOPIC,
    Conflict: topics.CONFLICT_TOPIC,
}


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
        self._admitted: list[Admitted] = []  # not in the map yet: within a call alone
        self._num_points = 0  # theirs
        self._applied: dict[str, Applied] = {}
        self._replaced: list[Conflict] = []  # since the last update
        self._changed_tiles: set[Tile] = set()
        self._points_asked_ns = 0
        self.revision = 0
        self.log_time_ns = 0  # of the newest message applied
        self.is_stale = False  # something was inserted since the last update

    def take_over(self, other: Pipeline) -> None:
        """Go on where a pipeline of the same map and admission has ended."""
        self._applied, self._replaced = other._applied, other._replaced
        self._changed_tiles = other._changed_tiles
        self.revision, self.log_time_ns = self._mapper.revision, other.log_time_ns
        self.is_stale = other.is_stale

    def insert(self, *envelopes: Envelope) -> bool:
        """Take messages, without deriving anything; False when they change nothing in the map: they
        are left out, they wait, or are poses that no scan waits for."""
        num_changes = 0
        for envelope in envelopes:
            self.log_time_ns = max(self.log_time_ns, envelope.received_ns)
            num_changes += self._apply(self._admission.admit(envelope))
            if len(self._admitted) >= AT_ONCE or self._num_points >= POINTS_AT_ONCE:
                self._put_in()
        self._put_in()
        return num_changes > 0

    def go_live(self) -> None:
        """The log that was read ends here: what comes now is new. It may lack the record of what
        was replaced since its last cut."""
        for conflict in self._replaced:
            self._say(conflict)
        self._apply(self._admission.go_live())
        self._put_in()

    def go_on(self) -> bool:
        """Apply the corrections whose points have come from the log."""
        return self._apply(self._admission.go_on()) > 0

    @property
    def is_settled(self) -> bool:
        """The map is what the log says, up to the last message that was taken."""
        return not self.is_stale and not self._admission.num_correcting

    def _apply(self, admitted: Sequence[Outcome]) -> int:
        """How many scans come, go or move. Those that only come are put in together, later."""
        num_changes = 0
        for one in admitted:
            if isinstance(one, Moved):
                self._put_in()
                self._move(one)
                self._say(one.corrected)
                num_changes += len(one.scans)
                continue
            if isinstance(one, Admitted):
                num_changes += 1
                if one.replaced is None:
                    self._admitted.append(one)
                    self._num_points += len(one.scan.points)
                else:
                    self._put_in()
                    self._replace(one, one.replaced)
            for record in one.records:
                self._say(record)
        return num_changes

    def _say(self, message: ResolvedPose | Corrected | Conflict) -> None:
        topic = RECORD_TOPICS[type(message)]
        said = self._outgoing.address(topic, message, message.stamp_ns, self.log_time_ns)
        self._emit((said,))

    def _move(self, moved: Moved) -> None:
        """Scans from where they are to where they are to be."""
        for old, new in moved.scans:
            if new is None:
                self._erase(old)
                continue
            points = self._exchange(old, new)
            self._account.settle(new.source, "scans_corrected", 0, {"scans_corrected": 1, **points})
        self.is_stale |= bool(moved.scans)
        if not moved.corrected.reason:  # one that was refused is counted as that
            is_erasure = topics.is_erase_topic(moved.envelope.key)
            outcome = "used_as_erasure" if is_erasure else "used_as_correction"
            self._account.settle(source_of(moved.envelope), outcome)

    def _erase(self, scan: Scan) -> None:
        """Take a scan out, exactly. It was applied; its points are none of the map's any more."""
        num = self._mapper.retract(scan).points_stored
        points = {"points_stored": -num, "points_rejected.erased": num}
        self._account.settle(scan.source, "scans_erased", 0, {"scans_erased": 1, **points})

    def _exchange(self, old: Scan, new: Scan) -> dict[str, int]:
        """Take one scan out and put another in, exactly; by how much the counters of points move.

        What is in them of a scan that is taken out goes with it, so that points in = stored +
        rejected holds, and each of them, of the scans that are in the map."""
        taken_out, inserted = self._mapper.retract(old), self._mapper.insert(new)
        changes = _points([(new, inserted)])
        changes.subtract(_points([(old, taken_out)]))
        return dict(changes)

    def _put_in(self) -> None:
        """All that was admitted, and takes the place of no other scan, into the map."""
        admitted, self._admitted, self._num_points = self._admitted, [], 0
        if not admitted:
            return
        inserted = self._mapper.insert_all([one.scan for one in admitted])
        by_source: defaultdict[str, list[tuple[Scan, Counted]]] = defaultdict(list)
        for one, counted in zip(admitted, inserted, strict=True):
            by_source[one.scan.source].append((one.scan, counted))
        for source, counts in by_source.items():
            self._account.settle(source, "applied", len(counts), _points(counts))
        for one in admitted:
            self._note(one)

    def _replace(self, one: Admitted, replaced: Scan) -> None:
        """A scan into the place of another."""
        points = self._exchange(replaced, one.scan)
        self._account.settle(one.scan.source, "conflict", also=points)
        self._replaced += [record for record in one.records if isinstance(record, Conflict)]
        self._note(one)

    def _note(self, admitted: Admitted) -> None:
        """It is in the map."""
        envelope, scan, source = admitted.envelope, admitted.scan, admitted.scan.source
        previous = self._applied.get(source)
        num_scans = (previous.num_scans if previous else 0) + 1
        self._applied[source] = Applied(envelope, scan, num_scans)
        self.is_stale = True
        self._emit(((envelope, scan),))

    def update(self) -> MapUpdate:
        """Derive everything that is stale, and send what changed."""
        stopwatch = Stopwatch()
        update = self._mapper.update(stopwatch)
        self.is_stale = False
        self._replaced = []
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
        num_changes = self._apply(self._admission.finish(timeout_s))
        self._put_in()
        if num_changes:
            self.update()
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
        return cuts or [Cut(update.revision, "", "", 0, 0, 0, 0)]  # of corrections alone

    def _send_points(self, update: MapUpdate | None) -> None:
        """The points of the changed tiles whose beat fell since the last update; at the end, of
        all. Each has a beat of its own, or one update would have to send them all."""
        if not self._points_every_ns:
            return
        before, now = self._points_asked_ns, self.log_time_ns
        self._points_asked_ns = now
        tiles = sorted(t for t in self._changed_tiles if not update or self._beats(t, before, now))
        if tiles:
            self._changed_tiles.difference_update(tiles)
            self._emit(self._outgoing.points(self._mapper.points(tiles), self.log_time_ns))

    def _beats(self, tile: Tile, before_ns: int, now_ns: int) -> bool:
        """Whether the points of a tile are due: once in a period, at a time that differs from tile
        to tile."""
        x, y, z = tile
        every = self._points_every_ns
        beat = (7 * x + 11 * y + 13 * z) % BEATS * every // BEATS
        return (now_ns + beat) // every > (before_ns + beat) // every

    def _emit(self, messages: Iterable[tuple[Envelope, Message | None]]) -> None:
        if not self._sinks:  # nothing is encoded for nobody
            return
        for envelope, message in messages:
            for sink in self._sinks:
                sink.write(envelope, message)


def _points(counts: Sequence[tuple[Scan, Counted]]) -> Counter[str]:
    """What the points of scans are counted under: points in = stored + rejected."""
    points: Counter[str] = Counter()
    for scan, counted in counts:
        points["points_in"] += len(scan.points) + sum(scan.ignored.values())
        points["points_stored"] += counted.points_stored
        for reason, num in (*counted.rejected.items(), *scan.ignored.items()):
            points[f"points_rejected.{reason}"] += num
    return points


class Stopwatch:
    """Called as each stage ends; keeps the milliseconds of each."""

    def __init__(self, clock: Callable[[], float] = time.perf_counter) -> None:
        self.stage_ms: dict[str, float] = {}
        self._clock, self._last = clock, clock()

    def __call__(self, stage: str) -> None:
        now = self._clock()
        self.stage_ms[stage] = (now - self._last) * 1e3
        self._last = now
