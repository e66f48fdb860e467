"""Scans that come apart from their pose: they wait for it, bounded in stamps and bytes. No clock.

What happens, and when, is a function of the messages in the order of the log alone. Where the log
holds the poses that were found (`/facet/resolved`), those are taken, bit for bit.
"""

from __future__ import annotations

from collections import defaultdict, deque
from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import NamedTuple

from facet.frames import Answer, Frames, Rank, Rigid, compose, pose_of, rigid_of
from facet_protocol.messages import (
    Envelope,
    Pose,
    ProtocolError,
    ResolvedPose,
    Scan,
    StampedTransform,
)

MAX_ROBOTS = 256
Identity = tuple[str, str, int, int, int]  # robot, sensor, epoch, sequence, stamp


@dataclass(slots=True)
class Held:
    """A scan that waits: for its pose, or with it for the log to say the same."""

    envelope: Envelope
    scan: Scan
    answer: Answer = Answer.UNKNOWN
    pose: Pose | None = None  # T_world_sensor, found and not yet confirmed


class Settled(NamedTuple):
    """A scan that waits no longer: placed, or refused."""

    envelope: Envelope
    scan: Scan
    error: ProtocolError | None = None


class Resolution:
    """Places scans in the map's frame. `logged`: the log says with which poses."""

    def __init__(
        self, frame_id: str, wait_ns: int, max_bytes: int, *, logged: bool = False
    ) -> None:
        self._frame_id, self._wait_ns, self._max_bytes = frame_id, wait_ns, max_bytes
        self._logged = logged
        self._frames: dict[str, Frames] = {}
        self._held: dict[int, Held] = {}  # in the order of arrival
        self._by_identity: defaultdict[Identity, deque[int]] = defaultdict(deque)
        self._num_bytes = 0
        self._number = 0

    def __len__(self) -> int:
        return len(self._held)

    def knows(self, robot: str, frame_id: str) -> bool:
        """Whether a transform of the robot has named the frame."""
        return robot in self._frames and frame_id in self._frames[robot]

    def hold(self, envelope: Envelope, scan: Scan) -> Iterator[Settled]:
        """A scan in another frame than the map's: it, and what else waits no longer."""
        self._number += 1
        self._held[self._number] = Held(envelope, scan)
        self._by_identity[identity_of(envelope, scan)].append(self._number)
        self._num_bytes += len(envelope.payload)
        yield from self._settle(scan.robot, scan.stamp_ns)
        yield from self._make_room()

    def tell(
        self, robot: str, transform: StampedTransform, rank: Rank, topic: str
    ) -> tuple[str, list[Settled]]:
        """(why it is left out, or ""; the scans that wait no longer)."""
        if robot not in self._frames and len(self._frames) >= MAX_ROBOTS:
            return "too_many_robots", []
        frames = self._frames.setdefault(robot, Frames(self._wait_ns))
        reason = frames.add(transform, rank, topic)
        now_ns = None if rank is Rank.STATIC else transform.stamp_ns
        return reason, list(self._settle(robot, now_ns))

    def confirm(self, resolved: ResolvedPose) -> Iterator[Settled]:
        """The log says with which pose a scan was applied: it is, now."""
        numbers = self._by_identity.get(
            (resolved.robot, resolved.sensor, resolved.epoch, resolved.sequence, resolved.stamp_ns)
        )
        if numbers:
            number = numbers[0]
            held = self._held[number]
            yield self._release(number, replace(held.scan, pose=resolved.pose))

    def waiting(self) -> list[Envelope]:
        """In the order in which they came."""
        return [held.envelope for held in self._held.values()]

    def go_live(self) -> Iterator[Settled]:
        """The log has no more to say: what was found is taken as it is."""
        self._logged = False
        for number, held in list(self._held.items()):
            if held.pose is not None:
                yield self._give_up(number, "")

    def finish(self) -> Iterator[Settled]:
        """No more will come: what is placed goes, the rest is refused."""
        for number in list(self._held):
            yield self._give_up(number, "no_pose")

    def _settle(self, robot: str, now_ns: int | None) -> Iterator[Settled]:
        """Place what can be placed; refuse what waited too long before the stamp that came now."""
        frames = self._frames.get(robot)
        for number, held in list(self._held.items()):
            scan = held.scan
            if scan.robot != robot or held.pose is not None:
                continue
            found: Rigid | Answer = Answer.UNKNOWN
            if frames is not None:
                found = frames.at(self._frame_id, scan.frame_id, scan.stamp_ns)
            if isinstance(found, Rigid):
                held.pose = pose_of(compose(found, rigid_of(scan.pose)))
                if not self._logged:
                    yield self._give_up(number, "")
            elif now_ns is not None and now_ns - scan.stamp_ns > self._wait_ns:
                held.answer = found
                yield self._give_up(number, "no_pose")
            else:
                held.answer = found

    def _make_room(self) -> Iterator[Settled]:
        while self._num_bytes > self._max_bytes and len(self._held) > 1:
            yield self._give_up(next(iter(self._held)), "no_room_to_wait")

    def _give_up(self, number: int, reason: str) -> Settled:
        """Place a scan whose pose was found, refuse any other."""
        held = self._held[number]
        if held.pose is not None:
            return self._release(number, replace(held.scan, pose=held.pose))
        text = f"frame_id {held.scan.frame_id[:80]!r} at {held.scan.stamp_ns} ns in"
        error = ProtocolError(f"{text} {self._frame_id!r}: {held.answer.value}", reason)
        return self._release(number, held.scan, error)

    def _release(self, number: int, scan: Scan, error: ProtocolError | None = None) -> Settled:
        held = self._held.pop(number)
        identity = identity_of(held.envelope, held.scan)
        numbers = self._by_identity[identity]
        numbers.remove(number)
        if not numbers:
            del self._by_identity[identity]
        self._num_bytes -= len(held.envelope.payload)
        if error is None:
            scan = replace(scan, frame_id=self._frame_id)
        return Settled(held.envelope, scan, error)


def identity_of(envelope: Envelope, scan: Scan) -> Identity:
    """What a scan is known by in the log."""
    return scan.robot, scan.sensor, envelope.epoch, envelope.sequence, envelope.stamp_ns
