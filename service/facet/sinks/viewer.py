"""The live dashboard: a client of the map like any other, in a process of its own.

`python -m facet.sinks.viewer ENDPOINT MAP TARGET` with TARGET `web`, `native` or `connect:URL`.
A viewer that stalls blocks `rr.log` for good: only this process stands still then, and it can be
killed at any time.
"""

from __future__ import annotations

import argparse
import ctypes
import logging
import os
import signal
import threading
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path

import zenoh

from facet.logbook import keep_log
from facet.session import client_settings, open_session
from facet.sinks.screen import Screen
from facet_protocol import topics
from facet_protocol.codec import Message, decode
from facet_protocol.messages import Envelope, MapUpdate, ProtocolError, TilePoints
from facet_protocol.mirror import MapMirror

logger = logging.getLogger(__name__)

PR_SET_PDEATHSIG = 1
POLL_S = 0.05
RETRY_S = 1.0
QUERY_S = 5.0
EXIT_S = 1.0  # how long a stopping viewer may take before it is cut off
MAX_TILE_VOXELS = 8_000_000  # kept to draw again in a new viewer: 80 MB
RINGS = {"update": 64, "points": 256, "status": 4, "scans": 16}  # the oldest goes


def follow(
    endpoint: str,
    map_id: str,
    target: str,
    stop: threading.Event | None = None,
    bind: str = "127.0.0.1",
    credentials: Path | None = None,
) -> None:
    """Draw the map of a service until `stop` is set; waits for the service, and for the viewer."""
    stop = stop or threading.Event()
    with Screen(target, map_id, bind) as screen:
        while not stop.is_set():
            try:
                settings = client_settings(endpoint, credentials=credentials)
                with open_session(settings) as session:
                    Follower(session, map_id, screen).run(stop)
            except zenoh.ZError as error:
                logger.info("no service at %s yet: %s", endpoint, error)
                stop.wait(RETRY_S)


class Follower:
    """Snapshot, then updates, folded by MapMirror; asks again where it sees a gap."""

    def __init__(self, session: zenoh.Session, map_id: str, screen: Screen) -> None:
        self._session, self._map_id, self._screen = session, map_id, screen
        self._mirror = MapMirror(map_id)
        self._tiles: dict[tuple[int, int, int], TilePoints] = {}
        self._num_voxels = 0
        keys = {
            "update": topics.update_key(map_id),
            "points": topics.points_key(map_id),
            "status": topics.status_key(map_id),
            "scans": topics.scans_key(map_id),
        }
        self._streams = {
            name: session.declare_subscriber(keys[name], zenoh.handlers.RingChannel(size))
            for name, size in RINGS.items()
        }
        self._alive = session.liveliness().declare_subscriber(
            topics.alive_key(map_id), zenoh.handlers.RingChannel(4), history=True
        )

    def run(self, stop: threading.Event) -> None:
        while not stop.is_set():
            if self._screen.ready():
                if self._screen.take_fresh():
                    self._draw_everything()
                self.step()
            stop.wait(POLL_S)

    def step(self) -> None:
        """Draw what has come since the last step."""
        for sample in _waiting(self._alive):
            if sample.kind == zenoh.SampleKind.PUT:  # a service began, perhaps with an older map
                self._ask_everything()
        for name, stream in self._streams.items():
            samples = list(_waiting(stream))
            # of the robots only the newest pose of each matters
            for sample in _newest_by_key(samples) if name == "scans" else samples:
                message = _message(sample)
                if message is not None:
                    self._take(message)

    def _take(self, message: Message) -> None:
        if isinstance(message, MapUpdate):
            self._take_update(message)
            return
        if isinstance(message, TilePoints):
            self._keep(message)
        self._screen.draw(message)

    def _take_update(self, update: MapUpdate) -> None:
        known = self._mirror.revision
        if not self._mirror.apply(update):
            for answer in self._ask(f"{topics.snapshot_key(self._map_id)}?since={known}"):
                if isinstance(answer, MapUpdate) and self._mirror.apply(answer):
                    self._screen.draw(answer)
        elif update.base_revision == 0 or self._mirror.revision != known:
            self._screen.draw(update)

    def _ask_everything(self) -> None:
        for key in (topics.snapshot_key(self._map_id), topics.points_key(self._map_id)):
            for answer in self._ask(key):
                self._take(answer)

    def _ask(self, selector: str) -> Iterator[Message]:
        replies = self._session.get(
            selector, consolidation=zenoh.ConsolidationMode.NONE, timeout=QUERY_S
        )
        for reply in replies:
            message = _message(reply.ok) if reply.ok is not None else None
            if message is not None:
                yield message

    def _keep(self, tile: TilePoints) -> None:
        """The newest points of each tile; the one heard of longest ago goes when it is too much."""
        old = self._tiles.pop(tile.tile, None)
        self._num_voxels -= len(old.plane_ids) if old else 0
        if len(tile.plane_ids):
            self._tiles[tile.tile] = tile
            self._num_voxels += len(tile.plane_ids)
        while self._num_voxels > MAX_TILE_VOXELS:
            self._num_voxels -= len(self._tiles.pop(next(iter(self._tiles))).plane_ids)

    def _draw_everything(self) -> None:
        """For a viewer that has just come, or come back."""
        if self._mirror.revision:
            self._screen.draw(self._mirror.snapshot())
        for tile in self._tiles.values():
            self._screen.draw(tile)


Subscriber = zenoh.Subscriber[zenoh.handlers.Handler[zenoh.Sample]]


def _waiting(subscriber: Subscriber) -> Iterator[zenoh.Sample]:
    while (sample := subscriber.try_recv()) is not None:
        yield sample


def _newest_by_key(samples: list[zenoh.Sample]) -> list[zenoh.Sample]:
    return list({str(sample.key_expr): sample for sample in samples}.values())


def _message(sample: zenoh.Sample) -> Message | None:
    """None for what this viewer cannot read: another dialect's scans, a newer schema."""
    encoding, _, schema = str(sample.encoding).partition(";")
    envelope = Envelope(
        key=str(sample.key_expr),
        schema=schema,
        encoding=encoding.removeprefix("application/"),
        payload=sample.payload.to_bytes(),
    )
    with suppress(ProtocolError):
        return decode(envelope)
    return None


def main(arguments: list[str] | None = None) -> None:
    """Follow until a signal; ends soon, also when the viewer does not take its data."""
    parser = argparse.ArgumentParser(prog="python -m facet.sinks.viewer")
    parser.add_argument("endpoint", help="tcp/127.0.0.1:7447")
    parser.add_argument("map")
    parser.add_argument("target", help="web | native | connect:URL")
    parser.add_argument("--bind", default="127.0.0.1", help="where the web viewer listens")
    parser.add_argument("--tied", action="store_true", help="end with the process that started us")
    options = parser.parse_args(arguments)
    if options.tied:
        _end_with_parent()
    keep_log()
    stop = threading.Event()
    for number in (signal.SIGTERM, signal.SIGINT):
        signal.signal(number, lambda *_: stop.set())
    failures: list[Exception] = []
    worker = threading.Thread(target=_follow_or_fail, args=(options, stop, failures), daemon=True)
    worker.start()
    while worker.is_alive() and not stop.is_set():
        stop.wait(0.2)
    worker.join(EXIT_S)
    logging.shutdown()
    os._exit(1 if failures else 0)  # also past a thread that hangs in a dead viewer's stream


def _end_with_parent() -> None:
    """A service that is killed leaves no viewer behind (Linux; elsewhere nothing happens)."""
    with suppress(OSError, AttributeError):
        ctypes.CDLL(None).prctl(PR_SET_PDEATHSIG, signal.SIGKILL)


def _follow_or_fail(
    options: argparse.Namespace, stop: threading.Event, failures: list[Exception]
) -> None:
    try:
        shown = os.environ.get("FACET_CREDENTIALS")
        credentials = Path(shown) if shown else None
        follow(options.endpoint, options.map, options.target, stop, options.bind, credentials)
    except Exception as error:
        logger.exception("the viewer failed")
        failures.append(error)


if __name__ == "__main__":
    main()
