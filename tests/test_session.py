"""Who gets in, and what he may say: the example settings of docker/secure over real sessions."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path

import psutil
import pytest
import trustme
import zenoh

from certificates import SECURE, Site
from facet.commands.acknowledgements import Acknowledgements
from facet.commands.play import RobotPublisher
from facet.commands.talk import has_service
from facet.config import ConfigError, NetworkSection, load_config
from facet.session import client_settings, open_session, read_access_control, service_settings
from facet.sources.live import Inbox, LiveSource
from facet_protocol import topics
from facet_protocol.messages import Envelope, Status
from facet_protocol.records import encode_status
from rig import WAIT_S, free_endpoint, room, wait_until
from tcp_proxy import Proxy

KEY = "facet/v1/map/robot/{}/scan/lidar"
HERE = "tcp/127.0.0.1"
ENCODING = "application/protobuf;foxglove.PointCloud"


@pytest.fixture
def site(tmp_path: Path) -> Site:
    endpoint = free_endpoint().replace("tcp/127.0.0.1", "tls/localhost")
    return Site(tmp_path, endpoint, free_endpoint())


@contextmanager
def door(site: Site, kind: str) -> Iterator[Inbox]:
    """A service's session with one of the example settings, and the inbox behind it."""
    network = load_config(site.settings(kind)).network
    with open_session(service_settings(network)) as session:
        inbox = Inbox(1000, 1 << 24)
        source = LiveSource(session, "map", inbox)
        yield inbox
        source.close()


@contextmanager
def client(
    endpoint: str, credentials: Path | None, timeout_s: float = WAIT_S
) -> Iterator[zenoh.Session]:
    settings = client_settings(endpoint, shared_memory=False, credentials=credentials)
    with open_session(settings | {"connect/timeout_ms": round(timeout_s * 1e3)}) as session:
        yield session


def speaks(session: zenoh.Session, *names: str) -> None:
    """A scan under each name, and one more under the first: after it, all have passed the door."""
    wait_until(lambda: is_heard(session, names[0]))
    said = [*((name, name.encode()) for name in names), (names[0], b"last")]
    for name, word in said:
        block = zenoh.CongestionControl.BLOCK
        session.put(KEY.format(name), word, encoding=ENCODING, congestion_control=block)


def is_heard(session: zenoh.Session, name: str) -> bool:
    publisher = session.declare_publisher(KEY.format(name))
    try:
        return publisher.matching_status.matching
    finally:
        publisher.undeclare()


def taken(inbox: Inbox) -> list[tuple[str, bytes]]:
    """Everything up to the last word: (robot of the key, payload)."""
    seen: list[Envelope] = []
    wait_until(lambda: seen.extend(inbox.take(1 << 20)) or last(seen))
    return [(e.key.split("/")[4], bytes(e.payload)) for e in seen]


def last(seen: list[Envelope]) -> bool:
    return bool(seen) and bytes(seen[-1].payload) == b"last"


def refused(endpoint: str, credentials: Path | None) -> None:
    error = pytest.raises(zenoh.ZError, match="Unable to connect")
    with error, client(endpoint, credentials, timeout_s=1.5):
        pass


def credentials_of(site: Site, kind: str, name: str) -> Path:
    return site.certificate_of(name) if kind == "mtls" else site.login_of(name)


@pytest.mark.parametrize("kind", ["mtls", "users"])
def test_a_robot_speaks_under_its_own_name_only(site: Site, kind: str) -> None:
    """S5."""
    with door(site, kind) as inbox, ExitStack() as stack:
        for robot, other in (("r1", "r2"), ("r2", "r1")):
            session = stack.enter_context(client(site.endpoint, credentials_of(site, kind, robot)))
            speaks(session, robot, other, "r3")
            assert taken(inbox) == [(robot, robot.encode()), (robot, b"last")]
        publisher = RobotPublisher(session, "map")
        for envelope in room(5, "r2"):
            publisher.publish("r2", "lidar", envelope)
        numbers: list[int] = []
        wait_until(
            lambda: numbers.extend(e.sequence for e in inbox.take(1 << 24)) or len(numbers)
            == 5
        )  # fmt: skip
        publisher.close()
    assert numbers == [1, 2, 3, 4, 5]


@pytest.mark.parametrize("kind", ["mtls", "users"])
def test_what_a_robot_sent_in_vain_is_asked_for_through_the_same_door(
    site: Site, kind: str
) -> None:
    """What lies under @adv is let in by a rule of its own."""
    scan, numbers = room(1)[0], list[int]()
    with door(site, kind) as inbox, Proxy(site.endpoint.replace("tls/localhost", HERE)) as network:

        def taken() -> list[int]:
            numbers.extend(e.sequence for e in inbox.take(1 << 24))
            return sorted(numbers)

        endpoint = network.endpoint.replace(HERE, "tls/localhost")
        with client(endpoint, credentials_of(site, kind, "r1")) as robot:
            publisher = RobotPublisher(robot, "map")
            publisher.publish("r1", "lidar", scan)
            wait_until(lambda: taken() == [1])
            network.cut()
            wait_until(lambda: not list(robot.info.routers_zid()), 20)
            for _ in range(10):
                publisher.publish("r1", "lidar", scan)
            network.restore()
            wait_until(lambda: taken() == list(range(1, 12)), 20)
            publisher.close()


@pytest.mark.parametrize("kind", ["mtls", "users"])
def test_a_robot_hears_what_was_taken(site: Site, kind: str) -> None:
    """And nothing else that the service says."""
    gauges = {"ack[r1/lidar]": 3.0, "ack_missing[r1/lidar]": 0.0, "ack_epoch[r1/lidar]": 7.0}
    status = encode_status(Status("map", 1, 1, "OK", gauges=gauges))
    settings = service_settings(load_config(site.settings(kind)).network)
    heard: list[zenoh.Sample] = []
    with open_session(settings) as service:
        token = service.liveliness().declare_token(topics.alive_key("map"))
        with client(site.endpoint, credentials_of(site, kind, "r1")) as robot:
            updates = robot.declare_subscriber(topics.update_key("map"), heard.append)
            acknowledged = Acknowledgements(robot, "map", epoch=7)
            assert has_service(robot, "map")

            def is_told() -> bool:
                service.put(topics.update_key("map"), b"not for robots")
                service.put(topics.status_key("map"), status)
                return acknowledged.wait({"r1/lidar": 3}, 0.1) == 0

            wait_until(is_told)
            acknowledged.close()
            updates.undeclare()
        token.undeclare()
    assert heard == []


@pytest.mark.parametrize("kind", ["mtls", "users"])
def test_a_robot_does_not_answer_for_another(site: Site, kind: str) -> None:
    """S5: nobody else says what r1 has sent."""
    kept = KEY.format("r1") + "/@adv/pub/1/2/_"
    settings = service_settings(load_config(site.settings(kind)).network)
    with open_session(settings) as service, ExitStack() as stack:
        sessions = [
            stack.enter_context(client(site.endpoint, credentials_of(site, kind, robot)))
            for robot in ("r2", "r1")
        ]
        answers = [
            session.declare_queryable(kept, lambda q, word=word: q.reply(q.key_expr, word))
            for session, word in zip(sessions, (b"r2", b"r1"), strict=True)
        ]
        said: list[bytes] = []
        wait_until(lambda: said.extend(words(service, kept)) or said)
        assert set(said) == {b"r1"}
        for answer in answers:
            answer.undeclare()


def words(session: zenoh.Session, key: str) -> list[bytes]:
    replies = session.get(key, target=zenoh.QueryTarget.ALL, timeout=2.0)
    return [reply.ok.payload.to_bytes() for reply in replies if reply.ok]


def test_no_password_or_a_wrong_one_is_no_session(site: Site) -> None:
    """S3 and S11: the wrong word is refused, and the right one is in no error of ours."""
    with door(site, "users"):
        nothing = site.folder / "nothing.toml"
        nothing.write_text('root_ca_certificate = "ca.pem"\n')
        refused(site.endpoint, nothing)
        refused(site.endpoint, site.login_of("r1", "wrong"))
        refused(site.local, None)  # also on loopback: everybody needs one
        with client(site.endpoint, site.login_of("r1")):
            pass


def test_no_certificate_a_foreign_or_an_old_one_is_no_session(site: Site) -> None:
    """S3."""
    site.issue("late", "late.example", days=-1)
    site.issue("stranger", "r1.example", ca=trustme.CA())
    with door(site, "mtls"):
        nothing = site.folder / "nothing.toml"
        nothing.write_text('root_ca_certificate = "ca.pem"\n')
        refused(site.endpoint, nothing)
        for name in ("late", "stranger"):
            refused(site.endpoint, site.certificate_of(name))
        with client(site.endpoint, site.certificate_of("r1")):
            pass


def test_tools_of_this_machine_need_no_certificate(site: Site) -> None:
    with door(site, "mtls") as inbox, client(site.local, None) as session:
        speaks(session, "r1", "r7")
        assert [robot for robot, _ in taken(inbox)] == ["r1", "r7", "r1"]


def test_a_reader_reads_and_cannot_command(site: Site) -> None:
    network = load_config(site.settings("mtls")).network
    with open_session(service_settings(network)) as service:
        answers = [
            service.declare_queryable(f"facet/v1/map/{name}", lambda q: q.reply(q.key_expr, b"yes"))
            for name in ("snapshot", "cmd/pause", "cmd/erase")
        ]
        with (
            client(site.endpoint, site.certificate_of("desk")) as desk,
            client(site.local, None) as operator,
        ):
            wait_until(lambda: list(desk.get("facet/v1/map/snapshot", timeout=1.0)))
            for command in ("cmd/pause", "cmd/erase?robot=r1"):
                assert list(operator.get(f"facet/v1/map/{command}", timeout=WAIT_S))
                assert not [r for r in desk.get(f"facet/v1/map/{command}", timeout=1.0) if r.ok]
        for answer in answers:
            answer.undeclare()


def test_nothing_listens_but_loopback() -> None:
    """S1: the sockets of this process with the default settings; the port is a free one."""
    endpoint = free_endpoint()
    before = sockets()
    with open_session(service_settings(NetworkSection(listen=(endpoint,)))):
        opened = sockets() - before
    assert opened == {("127.0.0.1", int(endpoint.rpartition(":")[2]))}
    assert NetworkSection().listen == ("tcp/127.0.0.1:7447",)


def sockets() -> set[tuple[str, int]]:
    """Where this process listens, and what it takes datagrams on: no UDP socket, no scouting."""
    return {
        (c.laddr.ip, c.laddr.port)
        for c in psutil.Process().net_connections("inet")
        if c.status in (psutil.CONN_LISTEN, psutil.CONN_NONE)
    }


def test_sessions_are_bounded() -> None:
    """The peer too many is refused; the others stay."""
    endpoint = free_endpoint()
    network = NetworkSection(listen=(endpoint,), max_sessions=3, shared_memory=False)
    with open_session(service_settings(network)), ExitStack() as stack:
        for _ in range(3):
            stack.enter_context(client(endpoint, None))
        refused(endpoint, None)


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (('default_permission: "deny"', 'default_permission: "allow"'), "must say"),
        (("enabled: true", "enabled: false"), "must say"),
        (('cert_common_names: ["r1"]', 'zids: ["38a4829bce9166ee"]'), "zids prove nothing"),
        (("rules:", "rulez:"), "access"),
        (("{", "["), "access"),
    ],
)
def test_a_weak_table_is_refused(tmp_path: Path, change: tuple[str, str], said: str) -> None:
    """S6, and that a table which lets strangers in is none."""
    path = tmp_path / "access.json5"
    path.write_text((SECURE / "access-mtls.json5").read_text().replace(*change, 1))
    with pytest.raises(ConfigError, match=said):
        read_access_control(path)


def test_the_example_tables_name_no_zenoh_id() -> None:
    for path in SECURE.glob("*.json5"):
        assert not any(subject["zids"] for subject in read_access_control(path)["subjects"])


def test_a_missing_file_is_named(site: Site) -> None:
    network = load_config(site.settings("mtls")).network
    (site.folder / "service.key").unlink()
    with pytest.raises(ConfigError, match=r"service\.key: no such file"):
        service_settings(network)


def test_an_open_door_is_refused_with_the_reason(tmp_path: Path) -> None:
    """S2, by the command: exit code 78, the reason and the cure; nothing is written."""
    for endpoint in ("tcp/0.0.0.0:7447", "tcp/[::]:0", "tls/0.0.0.0:7447", "udp/0.0.0.0:7447"):
        command = [sys.executable, "-m", "facet", "run", "--listen", endpoint]
        done = subprocess.run(command, capture_output=True, text=True, cwd=tmp_path, check=False)
        assert done.returncode == 78
        assert f"{endpoint} is open to the network" in done.stderr
        assert "mutual_tls or users_file" in done.stderr
    assert list(tmp_path.iterdir()) == []
