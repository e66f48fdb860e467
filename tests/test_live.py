"""Scans over real Zenoh sessions on this machine: counted, bounded, recovered."""

from __future__ import annotations

import threading
import time
from dataclasses import astuple
from types import SimpleNamespace
from typing import Any

import pytest
import zenoh

from facet.commands.play import RobotPublisher
from facet.sources import live
from facet.sources.dialects import split_encoding
from facet.sources.live import Inbox, LiveSource
from facet.status import Account
from facet_protocol import attachment
from facet_protocol.messages import Envelope
from rig import WAIT_S, room, service_and_client, wait_until

KEY = "facet/v1/map/robot/r1/scan/front"
PATIENCE_S = 3.0  # a busy machine may sleep for a second over what takes no time


def take_all(inbox: Inbox, num: int) -> list[Envelope]:
    taken: list[Envelope] = []
    wait_until(lambda: taken.extend(inbox.take(1 << 20)) or len(taken) >= num)
    return taken


def heard(client: zenoh.Session) -> zenoh.Publisher:
    """Someone listens to it, and nothing is dropped on the way."""
    publisher = client.declare_publisher(KEY, congestion_control=zenoh.CongestionControl.BLOCK)
    wait_until(lambda: publisher.matching_status.matching)
    return publisher


def sample(sequence: int, size: int = 10) -> Any:
    """What Zenoh hands to the inbox, as far as the inbox looks."""
    mark = attachment.pack(9, sequence, sequence * 1000) if sequence else None
    return SimpleNamespace(
        payload=Payload(size),
        attachment=SimpleNamespace(to_bytes=lambda: mark) if mark else None,
        encoding="application/protobuf;foxglove.PointCloud",
        key_expr=KEY,
    )


class Payload:
    def __init__(self, size: int) -> None:
        self._size = size

    def __len__(self) -> int:
        return self._size

    def to_bytes(self) -> bytes:
        return b"x" * self._size


def test_a_scan_arrives_as_it_was_sent() -> None:
    sent = room(3)
    with service_and_client() as (service, client):
        inbox = Inbox(100, 1 << 24, lambda: 42)
        source = LiveSource(service, "map", inbox)
        publisher = RobotPublisher(client, "map")
        for envelope in sent:
            publisher.publish("r1", "front", envelope)
        received = take_all(inbox, 3)
        publisher.close()
        source.close()
    assert [e.sequence for e in received] == [1, 2, 3]
    assert len({e.epoch for e in received}) == 1
    assert all(e.key == KEY and e.received_ns == 42 for e in received)
    assert [(e.schema, e.encoding) for e in received] == [("foxglove.PointCloud", "protobuf")] * 3
    assert [e.stamp_ns for e in received] == [e.stamp_ns for e in sent]
    assert [e.payload for e in received] == [e.payload for e in sent]


def test_another_map_and_another_key_stay_outside() -> None:
    with service_and_client() as (service, client):
        inbox = Inbox(100, 1 << 24)
        source = LiveSource(service, "map", inbox)
        publisher = RobotPublisher(client, "map")
        client.put("facet/v1/other/robot/r1/scan/front", b"x")
        client.put("facet/v1/map/robot/r1/pose", b"x")
        publisher.publish("r1", "front", room(1)[0])
        assert len(take_all(inbox, 1)) == 1
        publisher.close()
        source.close()
    assert inbox.num_received == 1


def test_a_message_that_is_too_large_is_cut_in_the_transport() -> None:
    """16 MiB is the limit; also for what an advanced publisher sends again."""
    with service_and_client() as (service, client):
        inbox = Inbox(100, 1 << 30)
        source = LiveSource(service, "map", inbox)
        robot = heard(client)
        robot.put(bytes((16 << 20) + 1))
        robot.put(bytes(100))
        assert [len(e.payload) for e in take_all(inbox, 1)] == [100]
        source.close()


def test_what_a_thread_of_zenohs_knows_stays_with_it() -> None:
    """Its state is not made anew for each message, or what is local to it would be lost."""
    own, num_new = threading.local(), 0

    class Noting(Inbox):
        def push(self, sample: Any, what: Any = None) -> None:
            nonlocal num_new
            num_new += not hasattr(own, "is_known")
            own.is_known = True
            super().push(sample, what)

    with service_and_client() as (service, client):
        inbox = Noting(1000, 1 << 24)
        source = LiveSource(service, "map", inbox)
        robot = heard(client)
        for _ in range(100):
            robot.put(b"x")
        take_all(inbox, 100)
        source.close()
    assert num_new <= 10  # one for each thread


def test_without_an_attachment_there_is_no_sequence() -> None:
    inbox = Inbox(10, 1 << 20, lambda: 42)
    inbox.push(sample(0))
    (envelope,) = inbox.take(1 << 20)
    assert (envelope.epoch, envelope.sequence, envelope.stamp_ns) == (0, 0, 42)


def test_the_oldest_is_shed_and_remembered() -> None:
    inbox = Inbox(3, 1 << 20, lambda: 42, patience_s=0.0)
    for sequence in range(1, 8):
        inbox.push(sample(sequence))
    assert [e.sequence for e in inbox.take(1 << 20)] == [5, 6, 7]
    (loss,) = inbox.take_shed()
    assert astuple(loss) == ("r1", "front", 9, 1, 4, "shed_overload", 42)
    assert inbox.take_shed() == []


def test_no_more_is_taken_at_once_than_a_log_has_channels_for(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(live, "MOST_TAKEN", 3)
    inbox = Inbox(1000, 1 << 20)
    for sequence in range(1, 8):
        inbox.push(sample(sequence))
    taken = [[e.sequence for e in inbox.take(1 << 20)] for _ in range(4)]
    assert taken == [[1, 2, 3], [4, 5, 6], [7], []]


def test_bytes_are_bounded_too() -> None:
    inbox = Inbox(1000, 1000, patience_s=0.0)
    for sequence in range(1, 21):
        inbox.push(sample(sequence, size=100))
        assert inbox.num_bytes <= 1000
    assert [e.sequence for e in inbox.take(450)] == [11, 12, 13, 14, 15]
    (loss,) = inbox.take_shed()
    assert (loss.first_sequence, loss.count) == (1, 10)
    assert len(inbox) == 5
    assert inbox.num_bytes == 500


def test_one_huge_message_is_kept() -> None:
    inbox = Inbox(10, 100, patience_s=0.0)
    inbox.push(sample(1, size=500))
    assert len(inbox) == 1


def test_half_full_the_network_waits_and_then_no_longer() -> None:
    """F23: in sum `patience_s`, whichever thread it is, and again only after there was room."""
    inbox = Inbox(8, 1 << 20, patience_s=PATIENCE_S)
    for sequence in (1, 2, 3, 4):
        assert pushed(inbox, sequence) < PATIENCE_S / 2
    assert pushed(inbox, 5) > 0.9 * PATIENCE_S  # half full: no room came
    assert pushed(inbox, 6) < PATIENCE_S / 2
    assert [e.sequence for e in inbox.take(1 << 20)] == [1, 2, 3, 4, 5, 6]
    for sequence in (7, 8, 9, 10):
        assert pushed(inbox, sequence) < PATIENCE_S / 2
    taker = threading.Timer(0.05, inbox.take, (1 << 20,))
    taker.start()
    assert pushed(inbox, 11) < 0.9 * PATIENCE_S  # room came in time
    taker.join()
    assert len(inbox) == 1


def pushed(inbox: Inbox, sequence: int) -> float:
    """Seconds that the network had to wait."""
    started = time.monotonic()
    inbox.push(sample(sequence))
    return time.monotonic() - started


def test_what_is_too_large_does_not_come_in() -> None:
    """F4, behind the transport's own limit: counted, not recorded, and no loss upstream."""
    account = Account()
    inbox = Inbox(10, 1 << 20, max_message_bytes=100, tally=account)
    for sequence, size in ((1, 100), (2, 101), (3, 100)):
        inbox.push(sample(sequence, size=size))
    assert [e.sequence for e in inbox.take(1 << 20)] == [1, 3]
    assert [(x.first_sequence, x.count, x.reason) for x in inbox.take_shed()] == [
        (2, 1, "too_large")
    ]
    assert account["too_large[r1/front]"] == 1
    assert account.balance("r1/front").in_flight == 2


def test_waiting_ends_when_it_is_woken() -> None:
    inbox = Inbox(10, 100)
    inbox.wake()
    assert inbox.wait(60.0, 100)
    assert inbox.take(100) == []


def test_the_recorder_waits_until_it_is_time_to_take() -> None:
    """Not for each message: a thread that is woken takes its turn from the mapper."""
    inbox = Inbox(8, 1 << 20)
    inbox.push(sample(1))
    assert inbox.wait(0.0, 100)  # the time is up
    inbox.call()
    assert not inbox.wait(60.0, 100)  # there is something else to do
    ended = threading.Event()
    waiting = threading.Thread(target=lambda: inbox.wait(60.0, 100) and ended.set())
    waiting.start()
    for sequence in (2, 3):
        inbox.push(sample(sequence))
    assert not ended.wait(0.05)
    inbox.push(sample(4, size=80))  # so many bytes are there
    assert ended.wait(WAIT_S)
    inbox.take(1 << 20)
    for sequence in (5, 6, 7, 8):
        inbox.push(sample(sequence))
    assert inbox.wait(60.0, 100)  # the queue is half full
    inbox.call()
    assert inbox.wait(60.0, 100)  # it still is


def test_encodings() -> None:
    assert split_encoding("application/protobuf;foxglove.PointCloud") == (
        "foxglove.PointCloud",
        "protobuf",
    )
    assert split_encoding("application/cdr;sensor_msgs/msg/PointCloud2")[1] == "cdr"
    assert split_encoding("zenoh/bytes") == ("", "zenoh/bytes")
