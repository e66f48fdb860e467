"""What was missed is asked for until it comes: over real sessions whose link breaks, and alone."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from types import SimpleNamespace
from typing import Any

from facet.commands.play import RobotPublisher
from facet.config import NetworkSection
from facet.session import client_settings, open_session, service_settings
from facet.sources.live import Inbox, LiveSource
from facet.sources.recovery import GIVE_UP_S, MAX_ASKED, MAX_GAPS, MAX_MISSING, Recovery
from rig import free_endpoint, patient, room, wait_for_ear, wait_until
from tcp_proxy import Proxy

KEY = "facet/v1/map/robot/r1/scan/front"
SCAN = room(1)[0]  # 54 kB


@dataclass
class Cache:
    """What a publisher keeps, as an `Ask`; an answer breaks off after `at_once` samples."""

    kept: list[int]
    at_once: int = 1000
    num_absent: int = 0  # times that it does not answer
    asked: list[tuple[int, int]] = field(default_factory=list)

    def __call__(self, selector: str, take: Callable[[Any], None], end: Callable[[], None]) -> None:
        key, _, numbers = selector.partition("/@adv/pub/5e55/7/**?_sn=")
        assert key == KEY
        first, last = map(int, numbers.split(".."))
        self.asked.append((first, last))
        if len(self.asked) > self.num_absent:
            for number in [n for n in self.kept if first <= n <= last][: self.at_once]:
                take(sample(number))
        end()


def sample(number: int, key: str = KEY) -> Any:
    source = SimpleNamespace(zid="5e55", eid=7)
    return SimpleNamespace(
        key_expr=key, source_info=SimpleNamespace(source_id=source, source_sn=number)
    )


@contextmanager
def recovering(ask: Any, **told: Any) -> Iterator[tuple[Recovery, list[int]]]:
    """It and the numbers that it hands on."""
    taken: list[int] = []
    recovery = Recovery(ask, lambda s: taken.append(s.source_info.source_sn), **told)
    recovery.start()
    yield recovery, taken
    recovery.close()


def noted(recovery: Recovery, *numbers: int) -> None:
    for number in numbers:
        recovery.note(sample(number))


def test_an_answer_that_breaks_off_is_asked_for_again() -> None:
    cache = Cache([2, 3, 4, 5, 6, 7, 8, 9], at_once=3)
    with recovering(cache) as (recovery, taken):
        noted(recovery, 0, 1, 10, 11)
        wait_until(lambda: not recovery.num_missing)
    assert cache.asked == [(2, 9), (5, 9), (8, 9)]
    assert taken == [2, 3, 4, 5, 6, 7, 8, 9]


def test_what_came_before_the_first_is_asked_for_where_it_is_lacking() -> None:
    """Of a publisher that was heard before a restart; the others' first is their beginning."""
    cache = Cache([3, 4, 5, 6])
    with recovering(cache, lacking=lambda first: 4) as (recovery, taken):
        noted(recovery, 7, 8)
        wait_until(lambda: not recovery.num_missing)
    assert cache.asked == [(3, 6)]
    assert taken == [3, 4, 5, 6]
    with recovering(Cache([0, 1]), lacking=lambda first: 9) as (recovery, taken):
        noted(recovery, 2)
        wait_until(lambda: not recovery.num_missing)
    assert taken == [0, 1]


def test_nobody_answers_at_first() -> None:
    cache = Cache([2, 3], num_absent=2)
    with recovering(cache) as (recovery, taken):
        noted(recovery, 1, 4)
        wait_until(lambda: not recovery.num_missing)
    assert cache.asked == [(2, 3)] * 3
    assert taken == [2, 3]


def test_what_is_not_kept_any_more_is_not_waited_for() -> None:
    cache = Cache(list(range(150, 301)))
    with recovering(cache) as (recovery, taken):
        noted(recovery, 1, 301)
        wait_until(lambda: not recovery.num_missing)
    assert cache.asked == [(2, 65), (2, 129), (2, 257), (258, 300)]
    assert taken == cache.kept


def test_much_is_asked_for_a_little_at_a_time() -> None:
    cache = Cache(list(range(1000)))
    with recovering(cache) as (recovery, taken):
        noted(recovery, 0, 201)
        wait_until(lambda: not recovery.num_missing)
    assert cache.asked == [(1, 64), (65, 128), (129, 192), (193, 200)]
    assert taken == list(range(1, 201))
    assert MAX_ASKED == 64


def test_what_never_comes_is_given_up() -> None:
    """By a clock that is many times as fast."""
    cache = Cache([])
    with recovering(cache, clock=lambda: time.monotonic() * GIVE_UP_S) as (recovery, taken):
        noted(recovery, 1, 3)
        assert recovery.num_missing == 1
        wait_until(lambda: not recovery.num_missing)
    assert cache.asked[0] == (2, 2)
    assert taken == []


def test_only_what_was_asked_for_is_taken() -> None:
    strangers = [sample(1), sample(4), sample(2, "facet/v1/map/robot/r2/scan/front"), sample(2)]

    def ask(selector: str, take: Callable[[Any], None], end: Callable[[], None]) -> None:
        for stranger in [*strangers, SimpleNamespace(key_expr=KEY, source_info=None)]:
            take(stranger)
        end()

    with recovering(ask) as (recovery, taken):
        recovery.note(SimpleNamespace(key_expr=KEY, source_info=None))  # no advanced publisher
        noted(recovery, 1, 3)
        wait_until(lambda: not recovery.num_missing)
    assert taken == [2]


def test_what_is_remembered_is_bounded() -> None:
    recovery = Recovery(Cache([]), lambda s: None)
    noted(recovery, 0, MAX_MISSING + 2)  # no cache keeps so many
    noted(recovery, 5)  # begun anew
    assert recovery.num_missing == 0
    noted(recovery, *range(10**6, 10**6 + 4 * MAX_GAPS, 2))
    assert recovery.num_missing == MAX_GAPS
    recovery.close()


def test_after_its_end_nothing_is_taken() -> None:
    late: list[Callable[[Any], None]] = []

    def ask(selector: str, take: Callable[[Any], None], end: Callable[[], None]) -> None:
        late.append(take)

    with recovering(ask) as (recovery, taken):
        noted(recovery, 1, 3)
        wait_until(lambda: late)
    late[0](sample(2))
    assert taken == []


def test_a_link_that_breaks_over_the_answer_costs_nothing() -> None:
    """The network comes back, and fails again while what was missed is being sent."""
    endpoint = free_endpoint()
    network = NetworkSection(listen=(endpoint,), shared_memory=False)
    numbers: list[int] = []
    with open_session(service_settings(network)) as service, Proxy(endpoint) as proxy:
        inbox = Inbox(10_000, 1 << 30)
        source = LiveSource(service, "map", inbox)

        def taken() -> set[int]:
            numbers.extend(e.sequence for e in inbox.take(1 << 30))
            return set(numbers)

        settings = patient(client_settings(proxy.endpoint, shared_memory=False))
        with open_session(settings) as robot:
            publisher = RobotPublisher(robot, "map")
            publisher.publish("r1", "front", SCAN)
            wait_until(lambda: taken() == {1})
            proxy.cut()
            wait_until(lambda: not list(robot.info.routers_zid()), 20)
            for _ in range(100):
                publisher.publish("r1", "front", SCAN)
            proxy.restore(max_bytes=20 * len(SCAN.payload))
            wait_until(lambda: list(robot.info.routers_zid()), 20)
            publisher.publish("r1", "front", SCAN)  # what is behind the gap waits for the answer
            wait_until(lambda: proxy.num_bytes > 20 * len(SCAN.payload), 20)
            wait_until(lambda: not list(robot.info.routers_zid()), 20)
            proxy.restore()
            wait_until(lambda: taken() == set(range(1, 103)), 40)
            publisher.close()
        source.close()
    assert len(numbers) == 102  # each of them once


def test_a_service_that_begins_again_asks_for_what_it_missed() -> None:
    """Of a robot that went on meanwhile, as long as its publisher keeps it."""
    endpoint = free_endpoint()
    network = NetworkSection(listen=(endpoint,), shared_memory=False)
    settings = patient(client_settings(endpoint, shared_memory=False))
    with open_session(service_settings(network)) as service, open_session(settings) as robot:
        publisher, inbox = RobotPublisher(robot, "map"), Inbox(1000, 1 << 30)
        source = LiveSource(service, "map", inbox)
        wait_for_ear(robot, KEY)

        def until(last: int) -> list[int]:
            numbers: list[int] = []

            def all_there() -> bool:
                numbers.extend(e.sequence for e in inbox.take(1 << 30))
                return last in numbers

            wait_until(all_there)
            return numbers

        for _ in range(3):
            publisher.publish("r1", "front", SCAN)
        assert until(3) == [1, 2, 3]
        source.close()
        for _ in range(7):
            publisher.publish("r1", "front", SCAN)
        source = LiveSource(service, "map", inbox, newest={"r1/front": (publisher.epoch, 3)})
        wait_for_ear(robot, KEY)
        publisher.publish("r1", "front", SCAN)
        assert sorted({11, *until(10)}) == [*range(4, 12)]
        source.close()
        publisher.close()
