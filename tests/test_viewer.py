"""The live dashboard as a client: joins late, closes gaps, survives viewers and services."""

import contextlib
import socket
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from types import SimpleNamespace

import psutil
import pytest
import zenoh

import office
from facet.session import client_settings, open_session
from facet.sinks.answers import Answers
from facet.sinks.publisher import Publisher
from facet.sinks.screen import Screen
from facet.sinks.snapshots import Snapshots
from facet.sinks.viewer import Follower
from facet_protocol.codec import encode
from facet_protocol.messages import Envelope, MapUpdate, Status, TilePoints
from facet_protocol.topics import update_key
from rig import WAIT_S


class FakeScreen:
    """Remembers what was drawn."""

    def __init__(self) -> None:
        self.drawn: list[object] = []
        self.fresh = False

    def ready(self) -> bool:
        return True

    def take_fresh(self) -> bool:
        fresh, self.fresh = self.fresh, False
        return fresh

    def draw(self, message: object) -> None:
        self.drawn.append(message)

    def of(self, kind: type) -> list:
        return [message for message in self.drawn if isinstance(message, kind)]


@contextlib.contextmanager
def _service(port: int) -> Iterator[SimpleNamespace]:
    settings = {
        "mode": "router",
        "listen/endpoints": [f"tcp/127.0.0.1:{port}"],
        "connect/endpoints": [],
        "transport/shared_memory/enabled": False,
    }
    with open_session(settings) as session:
        snapshots = Snapshots("office")
        publisher = Publisher(session, "office", snapshots)
        answers = Answers(session, "office", snapshots, {})
        try:
            yield SimpleNamespace(session=session, publisher=publisher, snapshots=snapshots)
        finally:
            publisher.close()
            answers.close()


@pytest.fixture
def port() -> int:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


def _publish(service: SimpleNamespace, message: object) -> None:
    schema, payload = encode(message)
    service.publisher.write(Envelope("", schema, "protobuf", payload), message)


def _wait(condition: Callable[[], object], step: Callable[[], None] = lambda: None) -> None:
    deadline = time.monotonic() + WAIT_S
    while not condition():
        assert time.monotonic() < deadline, "waited too long"
        step()
        time.sleep(0.02)


@contextlib.contextmanager
def _follower(port: int) -> Iterator[tuple[Follower, FakeScreen]]:
    screen = FakeScreen()
    settings = client_settings(f"tcp/127.0.0.1:{port}", shared_memory=False)
    with open_session(settings) as session:
        yield Follower(session, "office", screen), screen  # type: ignore[arg-type]


def test_a_late_joiner_gets_map_and_points_then_follows(port):
    updates, tiles = office.growth(), office.points(spacing=0.5)
    with _service(port) as service:
        for update in updates[:10]:
            _publish(service, update)
        for tile in tiles:
            _publish(service, tile)
        with _follower(port) as (follower, screen):
            _wait(lambda: len(screen.of(TilePoints)) >= len(tiles), follower.step)
            assert len(follower._mirror.planes) == 10
            for update in updates[10:]:
                _publish(service, update)
            _publish(service, office.status(1))
            _wait(lambda: follower._mirror.revision == len(updates), follower.step)
            _wait(lambda: screen.of(Status), follower.step)
            assert len(follower._mirror.planes) == len(office.planes())
            drawn = {p.id for update in screen.of(MapUpdate) for p in update.changed}
            assert drawn == {p.id for p in office.planes()}


def test_a_gap_is_closed_by_asking(port):
    updates = office.growth()
    with _service(port) as service, _follower(port) as (follower, _screen):
        _publish(service, updates[0])
        _wait(lambda: follower._mirror.revision == 1, follower.step)
        for update in updates[1:-1]:
            service.snapshots.apply(update)  # made, but lost on the way
        _publish(service, updates[-1])
        _wait(lambda: follower._mirror.revision == len(updates), follower.step)
        assert len(follower._mirror.planes) == len(office.planes())


def test_a_viewer_that_came_back_gets_everything(port):
    with _service(port) as service, _follower(port) as (follower, screen):
        for update in office.growth():
            _publish(service, update)
        _wait(lambda: follower._mirror.revision == len(office.planes()), follower.step)
        screen.drawn.clear()
        follower._draw_everything()
        (snapshot,) = screen.of(MapUpdate)
        assert snapshot.base_revision == 0
        assert len(snapshot.changed) == len(office.planes())


def test_a_service_that_began_anew_replaces_the_map(port):
    with _service(port) as service:
        for update in office.growth():
            _publish(service, update)
        stack = contextlib.ExitStack()
        follower, _ = stack.enter_context(_follower(port))
        _wait(lambda: follower._mirror.revision == len(office.planes()), follower.step)
    with stack, _service(port) as service:
        _publish(service, office.growth()[0])
        _wait(lambda: follower._mirror.revision == 1, follower.step)
        assert list(follower._mirror.planes) == [1]


def test_foreign_bytes_are_passed_over(port):
    with _service(port) as service, _follower(port) as (follower, _screen):
        _publish(service, office.growth()[0])
        encoding = zenoh.Encoding.APPLICATION_PROTOBUF.with_schema("facet.v1.MapUpdate")
        service.session.put(update_key("office"), b"\xff\xff\xff", encoding=encoding)
        service.session.put(update_key("office"), b"", encoding="text/plain")
        _publish(service, office.growth()[1])
        _wait(lambda: follower._mirror.revision == 2, follower.step)


def test_kept_points_are_bounded(port, monkeypatch):
    monkeypatch.setattr("facet.sinks.viewer.MAX_TILE_VOXELS", 2000)
    with _service(port), _follower(port) as (follower, _):
        for tile in office.points(spacing=0.2) * 3:
            follower._keep(tile)
        kept = sum(len(tile.plane_ids) for tile in follower._tiles.values())
        assert kept == follower._num_voxels <= 2000


@pytest.mark.parametrize("target", ["", "off", "browser"])
def test_an_unknown_target_is_refused(target):
    with pytest.raises(ValueError, match="web, native or connect"):
        Screen(target, "office")


def test_the_web_dashboard_listens_on_loopback_only_and_ends_when_it_hangs(port):
    _ends_when_it_hangs(port)


@pytest.mark.slow
def test_a_dashboard_that_hangs_ends_within_two_seconds(port):
    assert _ends_when_it_hangs(port) < 2.0


def _ends_when_it_hangs(port: int) -> float:
    """How many seconds that takes."""
    with _service(port) as service:
        for update in office.growth():
            _publish(service, update)
        command = [sys.executable, "-m", "facet.sinks.viewer", f"tcp/127.0.0.1:{port}"]
        process = subprocess.Popen([*command, "office", "web", "--tied"])
        viewer = psutil.Process(process.pid)
        try:
            _wait(lambda: any(c.name() == "rerun" for c in viewer.children()))
            (rerun,) = viewer.children()
            _wait(lambda: len(_listening(rerun)) >= 2)
            assert {host for host, _ in _listening(rerun)} == {"127.0.0.1"}
            ports = {port for _, port in _listening(rerun)}
            _wait(lambda: ports & _connected(viewer))
            rerun.suspend()
        finally:
            started = time.monotonic()
            process.terminate()
            process.wait(WAIT_S)
            ended_s = time.monotonic() - started
        _wait(lambda: not rerun.is_running() or rerun.status() == psutil.STATUS_ZOMBIE)
    return ended_s


def _listening(process: psutil.Process) -> set[tuple[str, int]]:
    found = process.net_connections(kind="inet")
    return {(c.laddr.ip, c.laddr.port) for c in found if c.status == psutil.CONN_LISTEN}


def _connected(process: psutil.Process) -> set[int]:
    return {c.raddr.port for c in process.net_connections(kind="inet") if c.raddr}


def test_a_killed_viewer_is_started_again_and_drawn_into():
    with Screen("web", "office") as screen:
        _wait(screen.ready)
        assert screen.take_fresh()
        screen.draw(office.snapshot())
        assert screen._child is not None
        screen._child.kill()
        screen._child.wait()
        _wait(lambda: screen.ready() and screen.take_fresh())
        screen.draw(office.snapshot())
        assert screen.ready()
