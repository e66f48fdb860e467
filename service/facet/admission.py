"""Which messages of the log are applied: decoded, placed in the map, each once. No clock."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import replace
from functools import lru_cache
from pathlib import Path
from typing import Any, NamedTuple, TypeGuard

from numpy.typing import NDArray

from facet import corrections
from facet.corrections import Corrections
from facet.firsts import Firsts
from facet.frames import Rank
from facet.past import Past, at_once
from facet.placement import Admitted, Dismissed, Placement
from facet.publishers import Publishers
from facet.resolution import Resolution, Settled
from facet.rivals import Rivals, digest_of
from facet.sources.naming import (
    POSE_SCHEMAS,
    TRANSFORM_SCHEMAS,
    is_correction,
    is_scan,
    is_static,
    names_of,
    pose_frame,
    source_of,
)
from facet.standing import freeze_resolution, thaw_resolution
from facet.status import Account
from facet.trajectory import Trajectories
from facet_protocol.codec import decode
from facet_protocol.messages import (
    Corrected,
    Envelope,
    Erase,
    ProtocolError,
    ResolvedPose,
    Scan,
    StampedPose,
    StampedTransform,
    Transforms,
)
from facet_protocol.ros_definitions import ODOMETRY
from facet_protocol.scans import decode_scan
from facet_protocol.topics import (
    CONFLICT_TOPIC,
    CORRECTED_TOPIC,
    PREFIX,
    RESOLVED_TOPIC,
    parse_pose_key,
    parse_scan_key,
)
from facet_protocol.wire import unwrap

WAIT_NS = 500_000_000  # of stamps: for a scan's pose, and between two poses
WAIT_BYTES = 256 << 20  # of scans that wait
MOST_FORESEEN = 4096  # scans that are decoded before it is their turn,
FORESEEN_BYTES = 16 << 10  # none of them larger: of large ones most is read where it lies


class Moved(NamedTuple):
    """Scans to be moved, all of them: as they are in the map, and as they are to be, or None: they
    go. No scans when the correction was refused; `corrected` is what became of it."""

    envelope: Envelope
    scans: tuple[tuple[Scan, Scan | None], ...]
    corrected: Corrected


class _Foreseen(NamedTuple):
    envelope: Envelope  # as long as it is here, no other has its id
    scan: Scan
    digest: bytes


Outcome = Admitted | Dismissed | Moved


class Admission:
    """Turns envelopes into scans, in log order, and counts what it leaves out under its reason.

    `logged`: the log says with which poses scans were applied, and what became of corrections. What
    does not have its pose with it waits for it in `Resolution`, a correction for its points in
    `Corrections`; `past` is where those are found.
    `reject_jumps`: a scan whose pose jumps is refused, not only flagged. `strict`: so are those of
    a second publisher under one name.
    """

    def __init__(
        self,
        account: Account,
        frame_id: str,
        reach_m: float,
        *,
        wait_ns: int = WAIT_NS,
        wait_bytes: int = WAIT_BYTES,
        logged: bool = False,
        past: Past | None = None,
        reject_jumps: bool = False,
        strict: bool = False,
    ) -> None:
        self.past = past or Past()
        self._account = account
        self._publishers = Publishers() if strict else None
        self._frame_id, self._reach_m = frame_id, reach_m
        self._foreseen: dict[int, _Foreseen] = {}  # by the id of the envelope
        self._resolution = Resolution(frame_id, wait_ns, wait_bytes, logged=logged)
        self._firsts = Firsts()
        self._trajectories = Trajectories()
        rivals = Rivals(self.past)
        self.corrections = Corrections(
            frame_id,
            self._firsts,
            self._trajectories,
            rivals,
            lambda envelope: self._decode(_inner(envelope)),
            at_once(self.past),
            logged=logged,
        )
        self._placement = Placement(
            account,
            self._firsts,
            self._trajectories,
            rivals,
            self.corrections.as_mapped,
            reject_jumps=reject_jumps,
        )

    def report_to(self, account: Account) -> None:
        """Count there from now on, also what waits."""
        self._account = self._placement.account = account
        for envelope in (*self._resolution.waiting(), *self.corrections.waiting()):
            account.arrive(source_of(envelope))

    def freeze(self) -> dict[str, NDArray[Any]]:
        """What it remembers, for a checkpoint."""
        publishers = self._publishers.freeze() if self._publishers is not None else {}
        return {
            **publishers,
            **self._firsts.freeze(),
            **self._trajectories.freeze(),
            **self._placement.freeze(),
            **self.past.freeze(),
            **freeze_resolution(self._resolution),
        }

    def thaw(self, frozen: Mapping[str, NDArray[Any]], directory: Path) -> None:
        """Remember what was frozen, of a log that lies in `directory` now. Raises KeyError,
        TypeError, ValueError for anything else."""
        self._firsts.thaw(frozen)
        self._trajectories.thaw(frozen)
        self._placement.thaw(frozen)
        if self._publishers is not None:
            self._publishers.thaw(frozen)
        self.past.thaw(frozen, directory)
        thaw_resolution(self._resolution, frozen, lambda e: self._decode(_inner(e)))

    def foresee(self, envelopes: Iterable[Envelope]) -> None:
        """Decode and hash scans that `admit` is given later, on whichever thread."""
        for envelope in envelopes:
            if len(self._foreseen) >= MOST_FORESEEN:
                return
            is_small = len(envelope.payload) <= FORESEEN_BYTES
            if is_small and envelope.rule is None and is_scan(envelope):
                with suppress(Exception):  # whatever it is, `admit` comes upon it in its turn
                    known = _Foreseen(envelope, self._read(envelope), digest_of(envelope))
                    self._foreseen[id(envelope)] = known

    def admit(self, envelope: Envelope) -> Sequence[Outcome]:
        """The scans to insert: this one, or such as have waited for this pose; or to be moved.
        Often none."""
        known = self._foreseen.pop(id(envelope), None)
        if envelope.key in (RESOLVED_TOPIC, CORRECTED_TOPIC):
            return self._confirm(envelope)
        if envelope.key == CONFLICT_TOPIC:
            return []  # the scans themselves say the same
        if is_correction(envelope):
            return self._admit_correction(envelope)
        source = source_of(envelope)
        try:
            inner = _inner(envelope)
            if envelope.schema in TRANSFORM_SCHEMAS or envelope.schema in POSE_SCHEMAS:
                return self._admit_pose(envelope, inner, source)
            return self._admit_scan(envelope, inner, source, known)
        except ProtocolError as error:
            self._refuse(source, error)
            return []

    @property
    def num_waiting(self) -> int:
        """Scans that wait for their pose."""
        return len(self._resolution)

    @property
    def num_correcting(self) -> int:
        """Corrections that wait for their points."""
        return len(self.corrections)

    def has_come(self, erase: Erase) -> bool:
        """Whether any scan has that an erasure names."""
        return next(self._firsts.of(erase), None) is not None

    def go_on(self) -> Sequence[Moved]:
        """Corrections whose points have come."""
        return self._take_moved(self.corrections.go_on())

    def finish(self, timeout_s: float | None = None) -> Sequence[Outcome]:
        """No message will come any more: what waits for a pose is placed now, or refused; what
        waits for points does so for as long as that, each."""
        placed = self._take(self._resolution.finish())
        if timeout_s is None:
            return [*placed, *self._take_moved(self.corrections.go_live())]
        return [*placed, *self._take_moved(self.corrections.go_on(timeout_s))]

    def go_live(self) -> Sequence[Outcome]:
        """The log ends here: what it does not say is found from the poses that come, and from
        what it holds."""
        placed = self._take(self._resolution.go_live())
        return [*placed, *self._take_moved(self.corrections.go_live())]

    def _admit_scan(
        self, envelope: Envelope, inner: Envelope, source: str, known: _Foreseen | None
    ) -> Sequence[Outcome]:
        scan = self._decode(inner, known.scan if known is not None else None)
        self._check_publisher(envelope, source)
        if not self._placement.meets(envelope, source, known.digest if known is not None else None):
            return []
        if scan.renormalised:
            self._account.count("renormalised", source)
        if scan.frame_id == self._frame_id:
            return [self._placement.place(envelope, scan)]
        return self._take(self._resolution.hold(envelope, scan))

    def _check_publisher(self, envelope: Envelope, source: str) -> None:
        """Raises ProtocolError for a second one, where only one may speak."""
        numbers = (envelope.epoch, envelope.sequence)
        if self._publishers is not None and not self._publishers.admits(source, *numbers):
            text = f"epoch {envelope.epoch} speaks under the name of another that is still there"
            raise ProtocolError(text, "duplicate_publisher")

    def _decode(self, envelope: Envelope, read: Scan | None = None) -> Scan:
        """The scan, `read` if it was already, with what is to be known of its frame. Raises
        ProtocolError."""
        if envelope.key.startswith(f"{PREFIX}/"):
            _check_scan_key(envelope.key)  # a name of ours that is none is refused, not mended
        scan = read if read is not None else self._read(envelope)
        if envelope.rule is not None and envelope.rule.frame:
            scan = replace(scan, frame_id=envelope.rule.frame)
        if scan.frame_id == self._frame_id:
            if not scan.has_pose:
                raise ProtocolError(f"{envelope.schema}: no pose", "bad_pose")
        elif not scan.frame_id or (
            scan.is_placed and not self._resolution.knows(scan.robot, scan.frame_id)
        ):
            text = f"frame_id is {scan.frame_id[:80]!r}, expected {self._frame_id!r}"
            raise ProtocolError(f"{envelope.schema}: {text}", "wrong_frame")
        return scan

    def _read(self, envelope: Envelope) -> Scan:
        """Raises ProtocolError."""
        return decode_scan(envelope, *names_of(envelope), self._reach_m, pose_required=False)

    def _admit_pose(self, envelope: Envelope, inner: Envelope, source: str) -> Sequence[Outcome]:
        if envelope.key.startswith(f"{PREFIX}/"):
            parse_pose_key(envelope.key)
        message = decode(inner)
        robot, _ = names_of(envelope)
        transforms, refused = self._transforms(envelope, message)
        placed: list[Settled] = []
        for transform in transforms:
            reason, settled = self._resolution.tell(robot, transform, _rank(envelope), envelope.key)
            placed += settled
            refused += (reason,) if reason else ()
        self._account.settle(source, "used_as_pose")
        for reason in refused:
            self._account.count(f"poses_rejected.{reason}", source)
        return self._take(placed)

    def _transforms(
        self, envelope: Envelope, message: object
    ) -> tuple[tuple[StampedTransform, ...], tuple[str, ...]]:
        """What a message says of frames, and the reasons for what it says in vain."""
        child = pose_frame(envelope)
        if isinstance(message, Transforms):
            return message.transforms, message.refused
        if isinstance(message, StampedTransform):
            return (replace(message, child_frame_id=child) if child else message,), ()
        if not isinstance(message, StampedPose) or not child or child == message.frame_id:
            text = f"a pose in {getattr(message, 'frame_id', '')[:80]!r}, but of which frame?"
            raise ProtocolError(f"{envelope.schema}: {text} A rule can say it", "wrong_frame")
        return (StampedTransform(message.stamp_ns, message.frame_id, child, message.pose),), ()

    def _admit_correction(self, envelope: Envelope) -> Sequence[Moved]:
        source = source_of(envelope)
        if envelope.sequence and not self._firsts.is_first(envelope, source):
            self._account.settle(source, "duplicate")
            return []
        return self._take_moved(self.corrections.take(envelope))

    def _confirm(self, envelope: Envelope) -> Sequence[Outcome]:
        """The log says with which pose a scan was applied, or what became of a correction."""
        try:
            message = decode(envelope)
        except ProtocolError as error:
            self._account.complain(envelope.key, error.reason, str(error))
            return []
        if isinstance(message, Corrected):
            return self._take_moved(self.corrections.confirm(message))
        return self._take(self._resolution.confirm(message)) if _is_resolved(message) else []

    def _take_moved(self, settled: Iterable[corrections.Settled]) -> list[Moved]:
        """Corrections that wait no longer; what was refused is counted."""
        moved = []
        for envelope, corrected, scans, error in settled:
            if error is not None:
                self._refuse(source_of(envelope), error)
            moved.append(Moved(envelope, scans, corrected))
        return moved

    def _take(self, settled: Iterable[Settled]) -> list[Outcome]:
        """What was placed, with the record of it; what was refused is counted."""
        admitted: list[Outcome] = []
        for envelope, scan, error in settled:
            if error is not None:
                self._refuse(source_of(envelope), error)
                continue
            resolved = ResolvedPose(
                robot=scan.robot,
                sensor=scan.sensor,
                epoch=envelope.epoch,
                sequence=envelope.sequence,
                stamp_ns=envelope.stamp_ns,
                frame_id=self._frame_id,
                pose=scan.pose,
            )
            admitted.append(self._placement.place(envelope, scan, resolved))
        return admitted

    def _refuse(self, source: str, error: ProtocolError) -> None:
        self._placement.refuse(source, error)


@lru_cache(maxsize=1024)  # of those that are right
def _check_scan_key(key: str) -> None:
    """Raises ProtocolError."""
    parse_scan_key(key)


def _inner(envelope: Envelope) -> Envelope:
    """Out of the envelope that a rule knows of. Raises ProtocolError."""
    rule = envelope.rule
    if rule is None or not rule.envelope_field:
        return envelope
    return replace(envelope, payload=unwrap(envelope.payload, rule.envelope_field))


def _rank(envelope: Envelope) -> Rank:
    if is_static(envelope):
        return Rank.STATIC
    return Rank.ODOMETRY if envelope.schema == ODOMETRY else Rank.TRANSFORM


def _is_resolved(message: object) -> TypeGuard[ResolvedPose]:
    return isinstance(message, ResolvedPose)
