"""`facet play`: a recording over Zenoh, as the robot that made it would publish it."""

from __future__ import annotations

import time
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Annotated

import typer
import zenoh
import zenoh.ext

from facet.commands.acknowledgements import PATIENCE_S, Acknowledgements
from facet.commands.talk import CredentialsOption, has_service, maps_at, no_service
from facet.commands.terminal import Exit, err, existing, out, progress, said_if_slow
from facet.session import DEFAULT_ENDPOINT, client_settings, open_session
from facet.sources.naming import (
    TRANSFORM_SCHEMAS,
    is_correction,
    is_input,
    is_scan,
    is_static,
    names_of,
    pose_frame,
    source_of,
)
from facet.sources.recording import Recording
from facet_protocol import attachment
from facet_protocol.messages import Envelope
from facet_protocol.topics import check_id, pose_key, scan_key, transforms_key

CACHE_BYTES = 64 << 20  # kept for a service that stalled: at 40 Hz of line scans, minutes
HEARTBEAT_S = 0.2
LISTENER_S = 5.0


class RobotPublisher:
    """Publishes scans, and poses where they come apart, with sequence numbers of their own, and
    keeps the last ones to send again."""

    def __init__(self, session: zenoh.Session, map_id: str) -> None:
        self._session, self._map_id = session, map_id
        self.epoch = time.time_ns() // 1_000_000 & 0xFFFFFFFF  # a new one at each start
        self._publishers: dict[str, zenoh.ext.AdvancedPublisher] = {}
        self._sequences: dict[str, int] = {}

    def publish(self, robot: str, sensor: str, envelope: Envelope) -> None:
        """Send one message as it is; the first on a key waits for someone to listen."""
        key = self._key(robot, sensor, envelope)
        if key not in self._publishers:
            self._publishers[key] = self._declare(key, envelope)
        self._sequences[key] = sequence = self._sequences.get(key, 0) + 1
        self._publishers[key].put(
            bytes(envelope.payload),
            encoding=f"application/{envelope.encoding};{envelope.schema}",
            attachment=attachment.pack(self.epoch, sequence, envelope.stamp_ns),
        )

    @property
    def sent(self) -> dict[str, int]:
        """How many messages, by source."""
        return {source_of(key): num for key, num in self._sequences.items()}

    def close(self) -> None:
        """Stay as long as a heartbeat takes: what is missing at the end can still be asked for."""
        time.sleep(2 * HEARTBEAT_S)
        for publisher in self._publishers.values():
            publisher.undeclare()  # type: ignore[no-untyped-call]

    def _key(self, robot: str, sensor: str, envelope: Envelope) -> str:
        if is_scan(envelope):
            return scan_key(self._map_id, robot, sensor)
        if envelope.schema in TRANSFORM_SCHEMAS:
            return transforms_key(self._map_id, robot, static=is_static(envelope))
        return pose_key(self._map_id, robot, pose_frame(envelope))

    def _declare(self, key: str, first: Envelope) -> zenoh.ext.AdvancedPublisher:
        num_kept = max(16, min(4096, CACHE_BYTES // max(1, len(first.payload))))
        publisher = zenoh.ext.declare_advanced_publisher(
            self._session,
            key,
            congestion_control=zenoh.CongestionControl.BLOCK,
            cache=zenoh.ext.CacheConfig(
                num_kept,
                replies_config=zenoh.ext.RepliesConfig(
                    congestion_control=zenoh.CongestionControl.BLOCK  # what is asked for arrives
                ),
            ),
            sample_miss_detection=zenoh.ext.MissDetectionConfig(
                heartbeat=HEARTBEAT_S,
                sporadic_heartbeat=None,  # also when it sends no more
            ),
            publisher_detection=True,
        )
        if not _has_listener(self._session, key):
            err.print(f"nobody listens to {key}")
        return publisher


def _has_listener(session: zenoh.Session, key: str) -> bool:
    """Wait for a subscriber: what is sent before it is known would be lost."""
    probe = session.declare_publisher(key)
    deadline = time.monotonic() + LISTENER_S
    try:
        while not probe.matching_status.matching:  # type: ignore[attr-defined]  # a wrong stub
            if time.monotonic() > deadline:
                return False
            time.sleep(0.01)
        return True
    finally:
        probe.undeclare()  # type: ignore[no-untyped-call]


def play_scans(
    scans: Iterator[Envelope], publisher: RobotPublisher, robot: str | None, speed: float
) -> Iterator[int]:
    """Publish each message at its stamp, `speed` times as fast (0: at once); counts the scans.
    Corrections are left out."""
    first_ns: int | None = None
    started = time.monotonic()
    num = 0
    for envelope in scans:
        if is_correction(envelope):
            continue  # it names scans by numbers that they do not get again
        stamp_ns = envelope.stamp_ns or envelope.received_ns
        first_ns = stamp_ns if first_ns is None else first_ns
        if speed:
            wait_s = (stamp_ns - first_ns) * 1e-9 / speed - (time.monotonic() - started)
            time.sleep(max(0.0, wait_s))
        source_robot, sensor = names_of(envelope)
        publisher.publish(robot or source_robot, sensor, envelope)
        num += is_scan(envelope)
        yield num


def play(
    logs: Annotated[list[Path], typer.Argument(help="Recordings (.mcap), or folders of them.")],
    speed: Annotated[
        str, typer.Option(help="1: as recorded; N: N times as fast; max: at once.")
    ] = "1",
    robot: Annotated[str | None, typer.Option(help="Publish under this robot's name.")] = None,
    map_id: Annotated[str, typer.Option("--map", help="The map to add to.")] = "map",
    connect: Annotated[str, typer.Option(help="The service's endpoint.")] = DEFAULT_ENDPOINT,
    credentials: CredentialsOption = None,
    shared_memory: Annotated[bool, typer.Option(help="Large scans by shared memory.")] = True,
) -> None:
    """Publish a recording over Zenoh, as the robot would.

    Recordings of ROS 2 too, with their transforms. Scans get new numbers, so corrections of poses,
    which name the old ones, are not sent. At the end it stays until the service has acknowledged
    all of it, also over a link that comes back.

    \b
    facet run &                                    # somebody has to listen
    facet play recordings/office-pushbroom.mcap    # as it was recorded
    facet play a.mcap --robot second --speed 10    # another robot, ten times as fast

    Exit code 3: not all of it was acknowledged, after a minute and a half without news.
    """
    rate = parse_speed(speed)
    if robot is not None:
        check_id(robot)
    recording = Recording(existing(logs))
    settings = client_settings(connect, shared_memory, credentials)
    with open_session(settings) as session, progress("playing", _count(logs)) as bar:
        maps = maps_at(session)
        if maps and map_id not in maps:  # behind an access table nothing may be seen
            err.print(no_service(session, map_id, connect))
        is_there = has_service(session, map_id)
        publisher = RobotPublisher(session, map_id)
        service = Acknowledgements(session, map_id, publisher.epoch)
        num = 0
        try:
            for num in play_scans(filter(is_input, recording), publisher, robot, rate):
                bar.update(bar.task_ids[0], completed=num)
            is_there = is_there or service.is_heard or has_service(session, map_id)
            left = _wait_until_taken(service, publisher.sent) if is_there else 0
        finally:
            service.close()
            publisher.close()
    _conclude(num, publisher.sent, left if is_there else None)
    if not is_there and maps:
        raise typer.Exit(Exit.LOST)  # a service is there, and took none of it


def _wait_until_taken(service: Acknowledgements, sent: Mapping[str, int]) -> int:
    """How many messages a service that is there does not acknowledge."""
    num = sum(sent.values())
    with said_if_slow(f"sent {num:,} messages; waiting until all are acknowledged", err.print):
        return service.wait(sent, PATIENCE_S)


def _conclude(num_scans: int, sent: Mapping[str, int], left: int | None) -> None:
    """The last word; `left` None: nobody acknowledges."""
    out.print(f"played {num_scans:,} scans")
    if left is None:
        err.print("nobody there acknowledges: whether all of them were taken is not known")
    elif left:
        num = sum(sent.values())
        err.print(
            f"{left:,} of {num:,} messages were not acknowledged: those may be lost; "
            "`facet status` tells how the service is"
        )
        raise typer.Exit(Exit.LOST)


def parse_speed(text: str) -> float:
    """0 for max. Raises typer.BadParameter."""
    if text == "max":
        return 0.0
    try:
        speed = float(text)
    except ValueError:
        speed = -1.0
    if not 0.0 < speed < float("inf"):
        raise typer.BadParameter(
            f"{text!r} is neither a number above 0 nor max", param_hint="--speed"
        )
    return speed


def _count(logs: list[Path]) -> int | None:
    """For the progress bar; a pipe has none, and the logs are not read twice."""
    return sum(map(is_scan, Recording(logs))) if err.is_terminal else None
