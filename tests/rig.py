"""What the shell's tests share: envelopes of a small room, Zenoh on a free port, waiting."""

from __future__ import annotations

import socket
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from typing import Any

import numpy as np
import zenoh

from facet.config import NetworkSection
from facet.session import client_settings, open_session, service_settings
from facet_protocol.codec import encode
from facet_protocol.messages import Envelope, Pose, Scan, ScanKind
from facet_protocol.topics import scan_key

START_NS = 1_700_000_000_000_000_000
PERIOD_NS = 100_000_000
WAIT_S = 60.0  # for what takes no second, on a machine that is busy with other things


def room_scan(sequence: int, robot: str = "r1", epoch: int = 5) -> Scan:
    """A scan of a 3 x 3 x 2.4 m room: floor, and two walls; a little noise, by sequence."""
    rng = np.random.default_rng(sequence)
    a, b = rng.uniform(-1.5, 1.5, (2, 1500))
    far, low = np.full(1500, 1.5), np.full(1500, -1.2)
    faces = [np.stack(f, axis=1) for f in ((a, b, low), (far, a, b), (a, far, b))]
    points = np.concatenate(faces) + rng.normal(0.0, 0.004, (4500, 3))
    return Scan(
        robot=robot,
        sensor="lidar",
        epoch=epoch,
        sequence=sequence,
        stamp_ns=START_NS + sequence * PERIOD_NS,
        frame_id="map",
        kind=ScanKind.CLOUD,
        pose=Pose(np.array([0.0, 0.0, 1.2]), np.array([0.0, 0.0, 0.0, 1.0])),
        points=points.astype(np.float32),
        no_return=np.zeros((0, 3), np.float32),
    )


def scan_envelope(scan: Scan, map_id: str = "map") -> Envelope:
    schema, payload = encode(scan)
    return Envelope(
        key=scan_key(map_id, scan.robot, scan.sensor),
        schema=schema,
        encoding="protobuf",
        payload=payload,
        stamp_ns=scan.stamp_ns,
        epoch=scan.epoch,
        sequence=scan.sequence,
        received_ns=scan.stamp_ns,
    )


def room(num_scans: int, robot: str = "r1") -> list[Envelope]:
    return [scan_envelope(room_scan(k, robot)) for k in range(1, num_scans + 1)]


def unnumbered(envelope: Envelope) -> Envelope:
    return replace(envelope, epoch=0, sequence=0)


def free_endpoint() -> str:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return f"tcp/127.0.0.1:{probe.getsockname()[1]}"


def patient(settings: dict[str, Any]) -> dict[str, Any]:
    """A client's that waits for the service, however busy the machine is."""
    return settings | {"connect/timeout_ms": round(WAIT_S * 1e3)}


@contextmanager
def service_and_client() -> Iterator[tuple[zenoh.Session, zenoh.Session]]:
    """A service's session and a client's, on a free port of this machine; no shared memory."""
    endpoint = free_endpoint()
    network = NetworkSection(listen=(endpoint,), shared_memory=False)
    with (
        open_session(service_settings(network)) as service,
        open_session(patient(client_settings(endpoint, shared_memory=False))) as client,
    ):
        yield service, client


def wait_for_ear(client: zenoh.Session, key: str = scan_key("map", "r1", "lidar")) -> None:
    """What is sent before the subscriber is known is lost."""
    publisher = client.declare_publisher(key)
    wait_until(lambda: publisher.matching_status.matching)
    publisher.undeclare()


def wait_until(condition: Callable[[], object], timeout_s: float = WAIT_S) -> None:
    """Return as soon as it holds; AssertionError when it does not in time."""
    deadline = time.monotonic() + timeout_s
    while not condition():
        assert time.monotonic() < deadline, "waited too long"
        time.sleep(0.01)
