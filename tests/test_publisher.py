"""The map over Zenoh: what clients get, what late joiners get, and that nobody is waited for."""

from __future__ import annotations

import json
from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest
import zenoh
from google.protobuf.descriptor_pb2 import FileDescriptorSet

from examples import plane
from facet.outgoing import Outgoing
from facet.sinks.answers import Answers, CommandError
from facet.sinks.publisher import Publisher, tile_payload
from facet.sinks.snapshots import Snapshots
from facet_protocol import topics
from facet_protocol.codec import decode, encode
from facet_protocol.messages import (
    Envelope,
    Event,
    EventKind,
    MapUpdate,
    Plane,
    Status,
    TilePoints,
    Tombstone,
)
from facet_protocol.mirror import MapMirror
from facet_protocol.topics import alive_key, cmd_key, plane_key, snapshot_key
from rig import WAIT_S, service_and_client, wait_until

OUTGOING = Outgoing("map", "map", lambda: 1)


def update(revision: int, changed: list[Plane], retired: list[int] | None = None) -> MapUpdate:
    events = tuple(Event(p.id, EventKind.CREATED, p.id, 0, revision, 5) for p in changed)
    gone = tuple(Tombstone(i, 0) for i in retired or [])
    return MapUpdate("map", revision, revision - 1, 5, tuple(changed), gone, events)


def tile(num: int = 3) -> TilePoints:
    centroids = np.zeros((num, 3), np.uint16)
    return TilePoints((1, 2, 3), 0.05, centroids, np.ones(num, np.int32))


class Rig:
    """A publisher with its answers, and a client that keeps what it hears."""

    def __init__(self, service: zenoh.Session, client: zenoh.Session) -> None:
        self.client = client
        self.snapshots = Snapshots("map")
        self.publisher = Publisher(service, "map", self.snapshots)
        commands = {"export": export, "pause": export, "erase": refuse}
        self.answers = Answers(service, "map", self.snapshots, commands)
        self.heard: list[zenoh.Sample] = []
        self.subscriber = client.declare_subscriber(
            "facet/v1/map/**", zenoh.handlers.Callback(self.heard.append, indirect=False)
        )
        wait_until(lambda: list(client.liveliness().get(alive_key("map"))))

    def send(self, message: MapUpdate | Status | TilePoints) -> None:
        if isinstance(message, MapUpdate):
            for envelope, part in OUTGOING.update(message, [], 1):
                self.publisher.write(envelope, part)
        elif isinstance(message, Status):
            self.publisher.write(*OUTGOING.status(message))
        else:
            for envelope, part in OUTGOING.points([message], 1):
                self.publisher.write(envelope, part)

    def heard_keys(self) -> list[str]:
        return [str(sample.key_expr) for sample in self.heard]

    def ask(self, selector: str) -> Any:
        replies = list(
            self.client.get(selector, consolidation=zenoh.ConsolidationMode.NONE, timeout=WAIT_S)
        )
        assert len(replies) == 1
        return replies[0]

    def snapshot(self, since: int) -> MapUpdate:
        answer = message(self.ask(f"{snapshot_key('map')}?since={since}").ok)
        assert isinstance(answer, MapUpdate)
        return answer


def message(sample: zenoh.Sample) -> object:
    schema = str(sample.encoding).partition(";")[2]
    payload = sample.payload.to_bytes()
    return decode(Envelope(str(sample.key_expr), schema, "protobuf", payload))


def export(parameters: Any) -> dict[str, Any]:
    return {"format": parameters.get("format", "json")}


def refuse(parameters: Any) -> dict[str, Any]:
    raise CommandError("not supported: because")


@pytest.fixture
def rig() -> Iterator[Rig]:
    with service_and_client() as (service, client):
        rig = Rig(service, client)
        yield rig
        rig.answers.close()
        rig.publisher.close()


def test_an_update_comes_as_a_whole_and_by_plane(rig: Rig) -> None:
    rig.send(update(1, [plane(3), plane(4)]))
    prefix = "facet/v1/map/"
    wanted = {"update", "events", "plane/3", "plane/4"}
    wait_until(lambda: {key.removeprefix(prefix) for key in rig.heard_keys()} >= wanted)
    received = next(s for s in rig.heard if str(s.key_expr).endswith("/update"))
    assert str(received.encoding) == "application/protobuf;facet.v1.MapUpdate"
    assert encode(message(received)) == encode(update(1, [plane(3), plane(4)]))  # type: ignore[arg-type]


def test_a_mirror_of_what_was_published_is_the_snapshot(rig: Rig) -> None:
    for step in (update(1, [plane(1)]), update(2, [plane(2)]), update(3, [plane(1)], [2])):
        rig.send(step)
    key = topics.update_key("map")
    wait_until(lambda: rig.heard_keys().count(key) == 3)
    mirror = MapMirror()
    assert all(
        mirror.apply(message(s))
        for s in rig.heard
        if str(s.key_expr) == key  # type: ignore[arg-type]
    )
    assert encode(mirror.snapshot()) == encode(rig.snapshot(0))


def test_a_late_plane_subscriber_gets_the_last_state(rig: Rig) -> None:
    rig.send(update(1, [plane(3, 1.0)]))
    rig.send(update(2, [plane(3, 2.0)]))
    wait_until(lambda: rig.heard_keys().count(plane_key("map", 3)) == 2)
    late: list[zenoh.Sample] = []
    subscriber = zenoh.ext.declare_advanced_subscriber(
        rig.client,
        topics.planes_key("map"),
        zenoh.handlers.Callback(late.append, indirect=False),
        history=zenoh.ext.HistoryConfig(max_samples=1),
    )
    wait_until(lambda: late)
    assert message(late[0]).d == 2.0  # type: ignore[attr-defined]
    subscriber.undeclare()


def test_a_retired_plane_is_deleted(rig: Rig) -> None:
    rig.send(update(1, [plane(3)]))
    rig.send(update(2, [], [3]))
    wait_until(lambda: any(s.kind == zenoh.SampleKind.DELETE for s in rig.heard))


def test_a_snapshot_since_closes_a_gap(rig: Rig) -> None:
    rig.send(update(1, [plane(1), plane(2)]))
    mirror = MapMirror()
    mirror.apply(rig.snapshot(0))
    rig.send(update(2, [plane(3)], [1]))
    rig.send(update(3, [plane(4)]))
    assert not mirror.apply(update(3, [plane(4)]))
    answer = rig.snapshot(mirror.revision)
    assert (answer.base_revision, [p.id for p in answer.changed]) == (1, [3, 4])
    assert mirror.apply(answer)
    assert encode(mirror.snapshot()) == encode(rig.snapshot(0))


def test_a_revision_from_another_life_gets_everything(rig: Rig) -> None:
    rig.send(update(1, [plane(1)]))
    assert rig.snapshot(999).base_revision == 0


@pytest.mark.parametrize("revision", ["yesterday", "\u06f1", "1" * 5000])
def test_a_bad_question_is_told_so(rig: Rig, revision: str) -> None:
    answer = rig.ask(f"{snapshot_key('map')}?since={revision}")
    assert revision[:80] in answer.err.payload.to_string()


def test_points_status_and_schema(rig: Rig) -> None:
    rig.send(tile())
    rig.send(Status("map", 1, 7, "OK", {"received": 3}))
    wait_until(
        lambda: {topics.points_key("map"), topics.status_key("map")} <= set(rig.heard_keys())
    )
    points = message(rig.ask(topics.points_key("map")).ok)
    assert isinstance(points, TilePoints)
    assert points.tile == (1, 2, 3)
    files = FileDescriptorSet.FromString(rig.ask(topics.schema_key("map")).ok.payload.to_bytes())
    assert "MapUpdate" in {m.name for file in files.file for m in file.message_type}


def test_commands_answer_or_name_the_cause(rig: Rig) -> None:
    answer = rig.ask(f"{cmd_key('map', 'export')}?format=ply")
    assert json.loads(answer.ok.payload.to_string()) == {"format": "ply"}
    refused = rig.ask(cmd_key("map", "erase"))
    assert refused.err.payload.to_string() == "not supported: because"


@pytest.mark.parametrize(
    ("asked", "said"),
    [
        ("pause?now=1", "'now=1' is no parameter of pause, which takes none: leave it out"),
        ("pause?now", "'now' is no parameter of pause, which takes none: leave it out"),
        ("export?fromat=ply", "'fromat=ply' is no parameter of export, which takes format="),
        ("export?format=ply;now=1", "'now=1' is no parameter of export, which takes format="),
        ("export?format=", "format= has no value: give it one, or leave it out"),
        ("export?format=ply;format=glb", "format= comes twice, 'ply' and 'glb': give it once"),
    ],
)
def test_what_a_command_does_not_know_is_named(rig: Rig, asked: str, said: str) -> None:
    name, _, parameters = asked.partition("?")
    answer = rig.ask(f"{cmd_key('map', name)}?{parameters}")
    assert answer.ok is None
    assert answer.err.payload.to_string() == said


def test_it_publishes_under_its_own_prefix_only(rig: Rig) -> None:
    everything: list[str] = []
    subscriber = rig.client.declare_subscriber(
        "**", zenoh.handlers.Callback(lambda s: everything.append(str(s.key_expr)), indirect=False)
    )
    rig.send(update(1, [plane(1)]))
    rig.send(tile())
    wait_until(lambda: topics.points_key("map") in everything)
    assert all(key.startswith("facet/v1/map/") for key in everything)
    assert not any("/robot/" in key for key in everything)
    subscriber.undeclare()


def test_a_large_tile_is_thinned() -> None:
    for num, expected in ((10, 10), (262_144, 87_382)):
        ((envelope, _),) = OUTGOING.points([tile(num)], 1)
        payload = tile_payload(envelope, tile(num))
        assert len(payload) < 1_000_000
        thin = decode(Envelope("", "facet.v1.TilePoints", "protobuf", payload))
        assert len(thin.plane_ids) == expected  # type: ignore[union-attr]


def test_the_queue_keeps_the_newest() -> None:
    """A publisher whose thread does not get on drops the oldest, and says so."""
    counted: list[str] = []
    with service_and_client() as (service, _):
        publisher = Publisher(service, "map", Snapshots("map"), 2, counted.append)
        publisher._changed.acquire()  # its thread waits here
        for revision in range(1, 6):
            for envelope, part in OUTGOING.update(update(revision, []), [], 1):
                publisher.write(envelope, part)
        assert [m.revision for _, m in publisher._updates] == [4, 5]  # type: ignore[union-attr]
        publisher._changed.release()
        publisher.close()
    assert counted.count("publisher_dropped") == 3
