"""Scans that have their pose: into the map, in the place of a rival, or not at all. No clock."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from typing import Any, NamedTuple

from numpy.typing import NDArray

from facet.firsts import Firsts
from facet.past import Number
from facet.plausibility import Plausibility
from facet.rivals import HORIZON, Claim, Rivals, Verdict
from facet.status import Account
from facet.trajectory import Trajectories
from facet_protocol.messages import Conflict, Envelope, ProtocolError, ResolvedPose, Scan

Record = ResolvedPose | Conflict  # what the log gets of a scan
AsMapped = Callable[[Number, Sequence[Envelope]], Scan]


class Admitted(NamedTuple):
    """A scan to insert, and the one that has to go for it."""

    envelope: Envelope
    scan: Scan
    records: tuple[Record, ...] = ()
    replaced: Scan | None = None


class Dismissed(NamedTuple):
    """A scan that could be in the map, and is not to be."""

    records: tuple[Record, ...]


class Placement:
    """Of several scans under one number one is in the map, whichever came first (`Rivals`). Counts
    what it leaves out, and what is odd; with `reject_jumps` a pose that jumps is refused."""

    def __init__(
        self,
        account: Account,
        firsts: Firsts,
        trajectories: Trajectories,
        rivals: Rivals,
        as_mapped: AsMapped,
        *,
        reject_jumps: bool = False,
    ) -> None:
        self.account = account
        self._firsts, self._trajectories, self._rivals = firsts, trajectories, rivals
        self._as_mapped, self._reject_jumps = as_mapped, reject_jumps
        self._plausibility = Plausibility()

    def meets(self, envelope: Envelope, source: str, digest: bytes | None = None) -> bool:
        """Whether a scan that has come goes on; else it was there, and is counted. `digest`: of its
        payload, where that is known."""
        claim = self._rivals.claim(envelope, source, digest)
        is_first = self._firsts.is_first(envelope, source)
        if claim is None:
            verdict = Verdict.FIRST if is_first else Verdict.DUPLICATE
        else:
            verdict = self._rivals.meet(claim, is_first=is_first)
        if verdict in (Verdict.DUPLICATE, Verdict.LATE):
            self._leave_out(source, verdict, envelope)
            return False
        return True

    def place(
        self, envelope: Envelope, scan: Scan, resolved: ResolvedPose | None = None
    ) -> Admitted | Dismissed:
        """A scan in the map's frame; `resolved` when it came apart from its pose."""
        records: tuple[Record, ...] = (resolved,) if resolved is not None else ()
        claim = self._rivals.claim(envelope, scan.source)
        verdict = self._rivals.judge(claim) if claim is not None else Verdict.FIRST
        if verdict in (Verdict.DUPLICATE, Verdict.LATE):
            self._leave_out(scan.source, verdict, envelope)
            return Dismissed(records)
        conflicts: tuple[Record, ...] = ()
        if claim is not None and verdict is not Verdict.FIRST:
            conflicts = (self._conflict(envelope, scan, claim, verdict),)
        if verdict is Verdict.LOSES:
            self.account.settle(scan.source, verdict)
            return Dismissed(records + conflicts)
        try:
            taken, replaced = self._take(envelope, scan, claim, verdict, resolved is not None)
        except ProtocolError as error:
            self.refuse(scan.source, error)
            if claim is not None and verdict is Verdict.FIRST:
                self._rivals.refuse(claim.number)
            return Dismissed(records)
        return Admitted(envelope, taken, records + conflicts, replaced)

    def refuse(self, source: str, error: ProtocolError) -> None:
        """Count it under its reason, and say it."""
        self.account.settle(source, f"rejected.{error.reason}")
        self.account.complain(source, error.reason, str(error))

    def freeze(self) -> dict[str, NDArray[Any]]:
        """What it compares the next scans with, for a checkpoint."""
        return {**self._rivals.freeze(), **self._plausibility.freeze()}

    def thaw(self, frozen: Mapping[str, NDArray[Any]]) -> None:
        """Compare with what was frozen. Raises KeyError, TypeError, ValueError for all else."""
        self._rivals.thaw(frozen)
        self._plausibility.thaw(frozen)

    def _take(
        self, envelope: Envelope, scan: Scan, claim: Claim | None, verdict: Verdict, is_found: bool
    ) -> tuple[Scan, Scan | None]:
        """The scan as it goes into the map, and as its rival is in it. Raises ProtocolError, and
        then nothing has changed."""
        odd = self._plausibility.oddities(scan, envelope.received_ns)
        if self._reject_jumps and "pose_jump" in odd:
            raise ProtocolError(odd["pose_jump"], "pose_jump")
        is_rival = claim is not None and verdict is Verdict.WINS
        replaced = self._in_map(claim.number) if claim is not None and is_rival else None
        if claim is not None:
            self._rivals.place(claim, envelope)
        for name, text in odd.items():
            self.account.count(name, scan.source)
            self.account.complain(scan.source, name, text)
        self._plausibility.take(scan)
        return self._posed(envelope, scan, is_rival=is_rival, is_found=is_found), replaced

    def _posed(self, envelope: Envelope, scan: Scan, *, is_rival: bool, is_found: bool) -> Scan:
        """With its pose, or the one that a correction gave its number; what was found is noted."""
        if not (is_rival or is_found):
            return scan
        number = Number(scan.source, envelope.epoch, envelope.sequence)
        corrected = self._trajectories.corrected(*number) if is_rival else None
        if corrected is not None:
            return replace(scan, pose=corrected)
        if is_found or (is_rival and self._trajectories.find(*number) is not None):
            self._trajectories.note(*number, scan.pose)
        return scan

    def _in_map(self, number: Number) -> Scan:
        """The scan that has to go. Raises ProtocolError when it cannot be found again."""
        try:
            envelope = self._rivals.find(number, self._rivals.kept(number))
            return self._as_mapped(number, [envelope])
        except OSError as error:
            raise ProtocolError(f"the log cannot be read: {error}", "unreadable_log") from error

    def _conflict(self, envelope: Envelope, scan: Scan, claim: Claim, verdict: Verdict) -> Conflict:
        """The record of it; said, too."""
        hashes = [self._rivals.kept(claim.number), claim.digest]
        kept, left_out = sorted(hashes)
        text = f"two scans have the number {envelope.sequence} of epoch {envelope.epoch}: "
        text += f"{kept.hex()[:12]} is kept, {left_out.hex()[:12]} is left out"
        self.account.complain(scan.source, "conflict", text)
        numbers = (envelope.epoch, envelope.sequence, envelope.stamp_ns)
        is_replaced = verdict is Verdict.WINS
        return Conflict(scan.robot, scan.sensor, *numbers, kept, left_out, is_replaced)

    def _leave_out(self, source: str, verdict: Verdict, envelope: Envelope) -> None:
        self.account.settle(source, verdict)
        if verdict is Verdict.LATE:
            text = f"number {envelope.sequence} of epoch {envelope.epoch} came again after more "
            text += f"than {HORIZON} others, or soon after another that came as late: "
            text += "the first stays, whatever this one is"
            self.account.complain(source, verdict, text)
