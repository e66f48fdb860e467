"""New poses for scans that are in the map, or none any more: all of a batch, or nothing. No clock.

The points come from the log, which may take a while: a correction waits for them, and the map goes
on. What became of it is written down (`/facet/corrected`), and a replay does the same at the same
place; of a log that does not say, it happens where the correction stands.
"""

from __future__ import annotations

from collections import defaultdict, deque
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Future, wait
from dataclasses import dataclass, replace
from itertools import islice
from typing import NamedTuple

from facet.firsts import Firsts, is_loose
from facet.past import Found, Number
from facet.rivals import Rivals
from facet.sources.naming import names_of
from facet.trajectory import Name, Trajectories
from facet_protocol.codec import decode
from facet_protocol.messages import (
    Corrected,
    CorrectedPose,
    Correction,
    Envelope,
    Erase,
    Pose,
    ProtocolError,
    Scan,
)
from facet_protocol.topics import (
    check_id,
    is_erase_topic,
    parse_correction_key,
    parse_erase_topic,
)

SCHEMA = "facet.v1.Correction"
MAX_HELD = 256  # corrections that wait for their points
MAX_ERASED = 1 << 16  # scans, at once
BOUND_M = 50_000.0  # no map reaches further
Ask = Callable[[Sequence[Number]], "Future[Found]"]
Decode = Callable[[Envelope], Scan]


@dataclass(slots=True)
class Held:
    """A correction that waits: for its points, or for the log to say what became of it."""

    envelope: Envelope
    numbers: list[Number]
    poses: list[Pose] | None  # new ones, T_world_sensor; None: they are to go
    found: Future[Found] | None = None  # asked for


class Settled(NamedTuple):
    """A correction that waits no longer. `scans`: as they are in the map, and as they are to be."""

    envelope: Envelope
    corrected: Corrected
    scans: tuple[tuple[Scan, Scan | None], ...] = ()
    error: ProtocolError | None = None


class Corrections:
    """In the order of the log. `ask` gets the scans of some numbers from the log, at once or on
    another thread; `logged`: the log says what became of each."""

    def __init__(
        self,
        frame_id: str,
        firsts: Firsts,
        trajectories: Trajectories,
        rivals: Rivals,
        decode_scan: Decode,
        ask: Ask,
        *,
        logged: bool = False,
    ) -> None:
        self.ask = ask
        self._frame_id, self._firsts, self._trajectories = frame_id, firsts, trajectories
        self._rivals, self._decode_scan, self._logged = rivals, decode_scan, logged
        self._held: deque[Held] = deque()

    def __len__(self) -> int:
        return len(self._held)

    def take(self, envelope: Envelope) -> Iterator[Settled]:
        """A correction; whatever is settled by now."""
        try:
            if len(self._held) >= MAX_HELD and not self._logged:
                raise ProtocolError(f"{MAX_HELD} corrections wait already", "too_many_corrections")
            self._held.append(self._checked(envelope))
        except ProtocolError as error:
            yield self._refused(envelope, error)
        if not self._logged:
            yield from self.go_on()

    def confirm(self, corrected: Corrected) -> Iterator[Settled]:
        """The log says what became of a correction."""
        name = _name(corrected)
        held = next((h for h in self._held if _name(self._record(h.envelope)) == name), None)
        if held is None:
            return  # it was refused as it came
        self._held.remove(held)
        if corrected.reason:
            error = ProtocolError("as the log says", corrected.reason)
            yield self._refused(held.envelope, error)
            return
        yield self._settle(held, self.ask(held.numbers))

    def go_on(self, timeout_s: float | None = 0.0) -> Iterator[Settled]:
        """Settle, oldest first, what has its points; None waits for all."""
        if self._logged:
            return
        while self._held:
            first = self._held[0]
            if first.found is None:
                first.found = self.ask(first.numbers)
            if timeout_s != 0.0:
                wait([first.found], timeout_s)
            if not first.found.done():
                return
            self._held.popleft()
            yield self._settle(first, first.found)

    def go_live(self) -> Iterator[Settled]:
        """The log has no more to say."""
        self._logged = False
        yield from self.go_on(None)

    def waiting(self) -> list[Envelope]:
        """In the order in which they came."""
        return [held.envelope for held in self._held]

    def _checked(self, envelope: Envelope) -> Held:
        """Raises ProtocolError where something is wrong with it that can be told at once."""
        if is_erase_topic(envelope.key):
            return self._erasure(envelope)
        _, named = parse_correction_key(envelope.key)
        is_one = envelope.schema == SCHEMA and envelope.encoding == "protobuf"
        correction = decode(envelope) if is_one else None
        if not isinstance(correction, Correction):
            raise ProtocolError(f"{envelope.schema[:80]!r} is no correction", "unknown_schema")
        if correction.robot != named:
            text = f"robot {correction.robot[:80]!r} under the key of {named!r}"
            raise ProtocolError(f"{envelope.schema}: {text}", "bad_name")
        if not correction.poses:
            raise ProtocolError(f"{envelope.schema}: it names no scan", "empty")
        robot, _ = names_of(envelope)
        numbers = [self._number(robot, pose) for pose in correction.poses]
        if len(set(numbers)) < len(numbers):
            raise ProtocolError(f"{envelope.schema}: a scan is named twice", "repeated_scan")
        return Held(envelope, numbers, [pose.pose for pose in correction.poses])

    def _erasure(self, envelope: Envelope) -> Held:
        """Raises ProtocolError."""
        erase = decode(envelope)
        if not isinstance(erase, Erase) or erase.robot != parse_erase_topic(envelope.key):
            raise ProtocolError(f"{envelope.schema[:80]!r} is no erasure", "unknown_schema")
        found = islice(self._firsts.of(erase), MAX_ERASED + 1)
        numbers = [Number(*number) for number in found]
        if not numbers:
            raise ProtocolError(f"no such scan of {erase.robot} has come", "unknown_scan")
        if len(numbers) > MAX_ERASED:
            text = f"{erase.robot}: more than {MAX_ERASED} scans at once: say first= and last="
            raise ProtocolError(text, "too_large")
        return Held(envelope, numbers, None)

    def _number(self, robot: str, corrected: CorrectedPose) -> Number:
        source = f"{robot}/{check_id(corrected.sensor)}"
        position = corrected.pose.position.tolist()
        if max(map(abs, position)) > BOUND_M:
            raise ProtocolError(f"{source}: position {position} is out of bounds", "bad_pose")
        epoch = self._firsts.epoch_of(source, corrected.epoch, corrected.sequence)
        if epoch is None:
            text = f"no scan {corrected.sequence} of epoch {corrected.epoch} has come"
            raise ProtocolError(f"{source}: {text}", "unknown_scan")
        return Number(source, epoch, corrected.sequence)

    def _settle(self, held: Held, question: Future[Found]) -> Settled:
        """Move all of its scans, or none."""
        try:
            found = question.result()
            if held.poses is None:
                return self._settle_erasure(held, found)
            old = [self.as_mapped(number, found.get(number, [])) for number in held.numbers]
            moved: defaultdict[Name, list[tuple[int, Pose]]] = defaultdict(list)
            for number, pose in zip(held.numbers, held.poses, strict=True):
                moved[number.source, number.epoch].append((number.sequence, pose))
            if not self._trajectories.move(moved):
                raise ProtocolError("no room for more corrected poses", "too_many_corrected")
        except ProtocolError as error:
            return self._refused(held.envelope, error)
        except OSError as error:
            text = f"the log cannot be read: {error}"
            return self._refused(held.envelope, ProtocolError(text, "unreadable_log"))
        pairs = zip(old, held.poses, strict=True)
        scans = tuple((scan, replace(scan, pose=pose)) for scan, pose in pairs)
        return Settled(held.envelope, self._record(held.envelope, len(scans)), scans)

    def _settle_erasure(self, held: Held, found: Found) -> Settled:
        """Those of its scans that are in the map have to go. Raises ProtocolError, OSError."""
        old: dict[Number, Scan] = {}
        for number in held.numbers:
            try:
                old[number] = self.as_mapped(number, found.get(number, []))
            except ProtocolError as error:
                if error.reason != "unknown_scan":
                    raise
        for number in old:
            self._rivals.erase(number)
        scans = tuple((scan, None) for scan in old.values())
        return Settled(held.envelope, self._record(held.envelope, len(scans)), scans)

    def as_mapped(self, number: Number, candidates: Sequence[Envelope]) -> Scan:
        """The scan with the pose that it has in the map. Raises ProtocolError when it has none, and
        OSError. The first good candidate is it, unless a rival of it is."""
        rival = self._rivals.in_map(number)
        candidates = candidates if rival is None else [rival]
        if len({(e.stamp_ns, bytes(e.payload)) for e in candidates if is_loose(e)}) > 1:
            text = f"{number.source}: several scans have the number {number.sequence}"
            raise ProtocolError(text, "ambiguous_scan")
        scan = next(filter(None, map(self._good, candidates)), None)
        if scan is None:
            text = f"{number.source}: scan {number.sequence} is not found in the log"
            raise ProtocolError(text, "unreadable_log")
        pose = self._trajectories.find(*number)
        if pose is not None:
            return replace(scan, pose=pose, frame_id=self._frame_id)
        if scan.frame_id != self._frame_id:
            text = f"{number.source}: scan {number.sequence} is not in the map, or too long"
            raise ProtocolError(text, "unknown_scan")
        return scan

    def _good(self, envelope: Envelope) -> Scan | None:
        try:
            return self._decode_scan(envelope)
        except ProtocolError:
            return None  # and so it was when it came

    def _refused(self, envelope: Envelope, error: ProtocolError) -> Settled:
        return Settled(envelope, self._record(envelope, 0, error.reason), (), error)

    def _record(self, envelope: Envelope, num_scans: int = 0, reason: str = "") -> Corrected:
        robot, _ = names_of(envelope)
        numbers = (envelope.epoch, envelope.sequence, envelope.stamp_ns)
        return Corrected(robot, *numbers, num_scans, reason)


def _name(corrected: Corrected) -> tuple[str, int, int, int]:
    return corrected.robot, corrected.epoch, corrected.sequence, corrected.stamp_ns
