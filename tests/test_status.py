"""The account: received = applied + rejected + left out + in flight, at every instant."""

from __future__ import annotations

import logging
import threading

import pytest
from hypothesis import given
from hypothesis import strategies as st

from facet.status import LEFT_OUT, MAX_SOURCES, Account, Balance, balance_of
from facet_protocol.messages import Status

OUTCOMES = ("applied", "rejected.malformed", "rejected.bad_pose", *LEFT_OUT)


def status(account: Account) -> Status:
    return account.status("map", 1, 1)


@given(st.lists(st.tuples(st.sampled_from(["r1/a", "r2/b"]), st.sampled_from(OUTCOMES))))
def test_the_law_holds_after_every_step(steps: list[tuple[str, str]]) -> None:
    account = Account()
    for num, (source, outcome) in enumerate(steps, start=1):
        account.arrive(source)
        assert account.balance(source).in_flight == 1
        assert account.balance().is_exact
        points = {"points_in": 5, "points_stored": 3, "points_rejected.nan": 2}
        account.settle(source, outcome, also=points if outcome == "applied" else None)
        assert account.balance().is_exact
        assert account.balance().received == num
    said = status(account)
    for source in ("", *account.sources()):
        assert balance_of(said.counters, said.gauges, source) == account.balance(source)
        assert account.balance(source).in_flight == 0


def test_what_is_settled_twice_or_not_at_all_shows() -> None:
    account = Account()
    account.arrive("r1/a")
    assert account.balance().in_flight == 1
    account.settle("r1/a", "applied")
    account.settle("r1/a", "duplicate")
    assert account.balance().in_flight == -1
    assert not account.balance().is_exact
    assert not Balance(1, 0, 0, 0, 0, 0, 0, 0).is_exact
    assert not Balance(1, 1, 0, 0, 0, 5, 3, 1).is_exact


def test_one_reason_of_one_source_is_not_that_of_another() -> None:
    account = Account()
    for source, reason in (("r1/a", "malformed"), ("r2/a", "malformed"), ("r2/a", "bad_pose")):
        account.arrive(source)
        account.settle(source, f"rejected.{reason}")
    assert account["rejected.malformed"] == 2
    assert account["rejected.malformed[r2/a]"] == 1
    assert (account.balance("r1/a").rejected, account.balance("r2/a").rejected) == (1, 2)
    assert account.balance().rejected == 3


def test_a_stranger_cannot_make_the_account_grow() -> None:
    account = Account()
    for k in range(MAX_SOURCES + 100):
        account.arrive(f"robot{k}/scan")
        account.settle(f"robot{k}/scan", "applied")
    assert len(account.sources()) <= MAX_SOURCES + 1
    assert account["received[others]"] == 100
    assert account.balance("others").is_exact
    assert account.balance().is_exact


def test_every_status_is_one_instant() -> None:
    """P4 while four threads count: no status in between shows half a message."""
    account, stop = Account(), threading.Event()

    def work(source: str) -> None:
        while not stop.is_set():
            account.arrive(source)
            account.settle(source, "applied", also={"points_in": 7, "points_stored": 7})

    threads = [threading.Thread(target=work, args=(f"r{k}/a",)) for k in range(4)]
    for thread in threads:
        thread.start()
    seen = [status(account) for _ in range(300)]
    stop.set()
    for thread in threads:
        thread.join()
    assert all(balance_of(s.counters, s.gauges).is_exact for s in seen)
    received = [s.counters.get("received", 0) for s in seen]
    assert received == sorted(received)  # P11


def test_one_line_a_source_and_reason(caplog: pytest.LogCaptureFixture) -> None:
    account = Account()
    with caplog.at_level(logging.WARNING):
        for _ in range(5):
            account.complain("r1/a", "malformed", "no end")
        account.complain("r1/a", "bad_pose", "no start")
        account.complain("r2/a", "malformed", "no end")
    assert len(caplog.records) == 3
    assert caplog.messages[0] == "r1/a: malformed: no end"
    assert status(account).health == "DEGRADED"
