"""Slow and absent things (F23-F26; G13-G15): with our publisher nothing is lost, with any other
the loss is counted exactly, and a viewer changes nothing."""

from __future__ import annotations

import signal
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

import pytest
import zenoh

from facet.commands.play import RobotPublisher
from facet.session import client_settings, open_session
from facet.sources.recording import Recording
from facet.status import balance_of
from facet_protocol import attachment, topics
from facet_protocol.codec import decode
from facet_protocol.messages import Envelope, Loss, Status
from fault_rig import envelopes
from rig import START_NS, patient, room, wait_until
from tcp_proxy import Proxy
from test_commands import Running

SCAN = room(1)[0]  # 54 kB: eight seconds of them fit into no socket
SMALL = envelopes("r1", 1)[0]  # a minute of them fits into our publisher's cache
RATE_HZ = 40
SETTLED_S = 60.0  # until all is received or lost, on a machine that is busy with other things


class Sender:
    """A robot that sends at RATE_HZ until it is stopped; `sent` is the truth."""

    def __init__(self, endpoint: str, robot: str, scan: Envelope = SCAN) -> None:
        self.sent, self.worst_put_s = 0, 0.0
        self._endpoint, self._robot, self._scan = endpoint, robot, scan
        self._stop = threading.Event()
        self._done = threading.Event()
        self._thread = threading.Thread(target=self._run, daemon=True)
        self._thread.start()
        wait_until(lambda: self.sent, 20)

    def stop(self) -> None:
        """Send no more; the session stays until `close`, so that what is asked for is there."""
        self._stop.set()

    def close(self) -> None:
        self._stop.set()
        self._done.set()
        self._thread.join(20)
        assert not self._thread.is_alive()

    def _run(self) -> None:
        settings = patient(client_settings(self._endpoint, shared_memory=False))
        with open_session(settings) as session:
            put = self._ours(session) if self._robot == "ours" else self._plain(session)
            due = time.monotonic()
            while not self._stop.is_set():
                started = time.monotonic()
                put()
                self.sent += 1
                self.worst_put_s = max(self.worst_put_s, time.monotonic() - started)
                due = max(due + 1.0 / RATE_HZ, time.monotonic())
                self._stop.wait(due - time.monotonic())
            self._done.wait(2 * SETTLED_S)

    def _ours(self, session: zenoh.Session) -> Any:
        publisher = RobotPublisher(session, "map")
        return lambda: publisher.publish("ours", "lidar", self._scan)

    def _plain(self, session: zenoh.Session) -> Any:
        key = topics.scan_key("map", self._robot, "lidar")
        publisher = session.declare_publisher(
            key,
            congestion_control=zenoh.CongestionControl.BLOCK,
            encoding="application/protobuf;foxglove.PointCloud",
        )
        wait_until(lambda: publisher.matching_status.matching)

        def put() -> None:
            mark = attachment.pack(7, self.sent + 1, START_NS + self.sent)
            publisher.put(self._scan.payload, attachment=mark)

        return put


@contextmanager
def watched(endpoint: str) -> Iterator[list[Status]]:
    """Every status that the service publishes."""
    seen: list[Status] = []

    def hear(sample: zenoh.Sample) -> None:
        from facet_protocol.records import decode_status

        seen.append(decode_status(sample.payload.to_bytes()))

    with open_session(patient(client_settings(endpoint, shared_memory=False))) as session:
        subscriber = session.declare_subscriber(
            topics.status_key("map"), zenoh.handlers.Callback(hear, indirect=False)
        )
        yield seen
        subscriber.undeclare()


def counted(seen: list[Status], robot: str) -> tuple[int, int]:
    """(received, lost upstream) as the last status says."""
    counters = seen[-1].counters if seen else {}
    name = f"[{robot}/lidar]"
    return counters.get(f"received{name}", 0), counters.get(f"lost_upstream{name}", 0)


def wait_until_heard_again(plain: Sender, seen: list[Status]) -> None:
    """What a plain publisher loses at its very end nobody can know: it sends until it is heard."""
    sent = plain.sent
    wait_until(lambda: seen and seen[-1].gauges.get("ack[plain/lidar]", 0) > sent, SETTLED_S)


def checks_the_log(folder: Path, lost: dict[str, int]) -> None:
    """The log's own account: every status in balance, and its loss records sum to the truth."""
    logged = [
        decode(e) for e in Recording([folder]) if e.key in (topics.STATUS_TOPIC, topics.LOSS_TOPIC)
    ]
    statuses = [m for m in logged if isinstance(m, Status)]
    assert statuses
    for status in statuses:
        for source in ("", "ours/lidar", "plain/lidar"):
            assert balance_of(status.counters, status.gauges, source).is_exact
    gaps = dict.fromkeys(lost, 0)
    for loss in (m for m in logged if isinstance(m, Loss)):
        gaps[loss.robot] += {"lost_upstream": loss.count, "recovered_late": -loss.count}[
            loss.reason
        ]
    assert gaps == lost


def survives(
    service: Running, senders: dict[str, Sender], seen: list[Status]
) -> tuple[str, dict[str, int]]:
    """Wait until all that was sent is received or counted as lost, and what our publisher sent is
    received: it may be counted as lost until it comes. Returns the last words, and what each lost.
    """
    for sender in senders.values():
        sender.stop()
    with suppress(AssertionError):  # who waited in vain is told what was lost
        wait_until(lambda: counted(seen, "ours") == (senders["ours"].sent, 0), SETTLED_S)
    wait_until(lambda: all(sum(counted(seen, r)) == s.sent for r, s in senders.items()), SETTLED_S)
    lost = {robot: counted(seen, robot)[1] for robot in senders}
    for sender in senders.values():
        sender.close()
    _, output = service.stop()
    return output, lost


def test_g14_the_service_stalls(tmp_path: Path) -> None:
    """F24: eight seconds of SIGSTOP. 0 lost with our publisher; with a plain one, whose link Zenoh
    closes after five, the loss is counted to the message, live, in the log and in the last line."""
    service = Running(tmp_path / "log")
    try:
        with watched(service.endpoint) as seen:
            senders = {robot: Sender(service.endpoint, robot) for robot in ("ours", "plain")}
            wait_until(lambda: counted(seen, "plain")[0] > 10, 20)
            service.process.send_signal(signal.SIGSTOP)
            time.sleep(8.0)  # the fault itself
            service.process.send_signal(signal.SIGCONT)
            wait_until_heard_again(senders["plain"], seen)
            output, lost = survives(service, senders, seen)
    finally:
        service.process.kill()
        service.process.wait()
    assert lost["ours"] == 0
    assert lost["plain"] > 0
    assert f"lost upstream {lost['plain']:,}" in output
    checks_the_log(tmp_path / "log", lost)


def outage(folder: Path, seconds: float, scan: Envelope = SCAN) -> float:
    """F25: the network is down and comes back. Returns how long after that all are heard again."""
    service = Running(folder)
    try:
        with Proxy(service.endpoint) as network, watched(service.endpoint) as seen:
            senders = {r: Sender(network.endpoint, r, scan) for r in ("ours", "plain")}
            wait_until(lambda: min(counted(seen, r)[0] for r in senders) > 10, 20)
            network.cut()
            unheard = -senders["plain"].sent
            time.sleep(seconds)  # the fault itself
            unheard += senders["plain"].sent
            network.restore()
            started = time.monotonic()
            wait_until_heard_again(senders["plain"], seen)
            back_s = time.monotonic() - started
            output, lost = survives(service, senders, seen)
    finally:
        service.process.kill()
        service.process.wait()
    assert lost["ours"] == 0
    assert lost["plain"] >= unheard - 1 > 0  # one may be under way
    assert f"lost upstream {lost['plain']:,}" in output
    checks_the_log(folder, lost)
    return back_s


def test_g14_the_network_fails(tmp_path: Path) -> None:
    outage(tmp_path / "log", 6.0)


@pytest.mark.slow
def test_g14_the_network_fails_for_a_minute(tmp_path: Path) -> None:
    """Within the cache of our publisher: 4096 scans, or 64 MB of them."""
    back_s = outage(tmp_path / "log", 60.0, SMALL)
    assert back_s <= 5.0 + 1.0  # a status is at most a second old
