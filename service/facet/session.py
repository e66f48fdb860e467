"""Zenoh sessions as Facet opens them: nothing listens that was not asked for, nothing scouts."""

from __future__ import annotations

import json
import os
import resource
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

import zenoh

from facet.config import ConfigError, NetworkSection, load_credentials

DEFAULT_ENDPOINT = "tcp/127.0.0.1:7447"
CONNECT_TIMEOUT_MS = 3000
ENVELOPE_BYTES = 1 << 16  # what travels beside a payload: key, encoding, attachment
MAX_PENDING = 4096  # connections that have not shown who they are: 10 KB and an open file each
MIN_PENDING = 64  # of them, where a process may not open many files
ACCEPT_MS = 3000  # for showing it
ACCEPTORS = 32  # threads of Zenoh's; they hear all links, and wait for each that they close
OWN_FILES = 256  # of the log, the viewer, the libraries: no connection takes their place


@contextmanager
def open_session(settings: dict[str, Any]) -> Iterator[zenoh.Session]:
    """A session that is closed whatever happens: an open one keeps the process from ending."""
    if settings.get("listen/endpoints"):
        _allow_files(settings)
        os.environ.setdefault("ZENOH_RUNTIME", f"(acc: (worker_threads: {ACCEPTORS}))")
    session = zenoh.open(_config(settings))
    try:
        yield session
    finally:
        session.close()  # type: ignore[no-untyped-call]


def service_settings(network: NetworkSection) -> dict[str, Any]:
    """A router of its own: robots and tools reach each other through it."""
    settings: dict[str, Any] = {
        "mode": "router",
        "listen/endpoints": list(network.listen),
        "connect/endpoints": list(network.connect),
        "low_pass_filter": [_size_limit(network.max_message_bytes)],
        "transport/link/rx/max_message_size": network.max_message_bytes + ENVELOPE_BYTES,
        "transport/unicast/max_sessions": network.max_sessions,
        "transport/unicast/accept_pending": _max_pending(network.max_sessions),
        "transport/unicast/accept_timeout": ACCEPT_MS,
        "transport/shared_memory/enabled": network.shared_memory,
    }
    shown = _shown(network.credentials) if network.credentials is not None else {}
    if network.listen_certificate is not None:
        settings["transport/link/tls"] = shown.get("transport/link/tls", {}) | _tls(network)
    if network.users_file is not None:
        users = {"dictionary_file": str(_existing(network.users_file))}
        settings["transport/auth/usrpwd"] = shown.get("transport/auth/usrpwd", {}) | users
    settings = shown | settings
    if network.access_control is not None:
        settings["access_control"] = read_access_control(network.access_control)
    return settings


def _max_pending(max_sessions: int) -> int:
    """How many connections may be half open: who opens so many, again and again, keeps others out.
    As many as there may be files beside what is needed."""
    files = resource.getrlimit(resource.RLIMIT_NOFILE)[1]
    if files == resource.RLIM_INFINITY:
        return MAX_PENDING
    return min(MAX_PENDING, max(MIN_PENDING, files - max_sessions - OWN_FILES))


def _allow_files(settings: dict[str, Any]) -> None:
    """Raise what this process may open, as far as it may itself, to what the settings let in."""
    unicast = "transport/unicast/"
    wanted = settings.get(f"{unicast}accept_pending", 0) + settings.get(f"{unicast}max_sessions", 0)
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    if not wanted or soft in (hard, resource.RLIM_INFINITY) or soft >= wanted + OWN_FILES:
        return
    most = wanted + OWN_FILES if hard == resource.RLIM_INFINITY else min(hard, wanted + OWN_FILES)
    with suppress(OSError, ValueError):  # a system with a limit of its own: fewer get in at once
        resource.setrlimit(resource.RLIMIT_NOFILE, (most, hard))


def read_access_control(path: Path) -> dict[str, Any]:
    """Zenoh's table `access_control` from a JSON5 file.

    Raises ConfigError when it cannot be read, lets in what it does not name, or trusts a Zenoh id:
    anyone can call himself any.
    """
    try:
        text = path.read_text("utf-8")
        config = zenoh.Config.from_json5(f"{{access_control: {text}\n}}")
        table: dict[str, Any] = json.loads(config.get_json("access_control"))
    except OSError as error:
        raise ConfigError(f"network.access_control: {path}: {error.strerror}") from error
    except (zenoh.ZError, ValueError) as error:
        raise ConfigError(f"network.access_control: {path}: {error}") from error
    if not table["enabled"] or table["default_permission"] != "deny":
        text = 'must say enabled: true and default_permission: "deny"'
        raise ConfigError(f"network.access_control: {path}: {text}")
    if any(subject.get("zids") for subject in table["subjects"] or ()):
        text = "zids prove nothing: name cert_common_names or usernames"
        raise ConfigError(f"network.access_control: {path}: {text}")
    return table


def client_settings(
    endpoint: str = DEFAULT_ENDPOINT, shared_memory: bool = True, credentials: Path | None = None
) -> dict[str, Any]:
    """A client of a running service; fails when nobody answers within CONNECT_TIMEOUT_MS.

    `credentials` is a TOML file (`facet.config.Credentials`). Raises ConfigError.
    """
    settings = {
        "mode": "client",
        "listen/endpoints": [],
        "connect/endpoints": [endpoint],
        "connect/timeout_ms": CONNECT_TIMEOUT_MS,
        "transport/shared_memory/enabled": shared_memory,
        "timestamping/enabled": True,  # the advanced publisher needs it
    }
    return settings | (_shown(credentials) if credentials is not None else {})


def _shown(path: Path) -> dict[str, Any]:
    """User and password, certificate and key, as far as the file has them."""
    told, settings = load_credentials(path), dict[str, Any]()
    if told.user is not None and told.password is not None:
        secret = told.password.get_secret_value()
        settings["transport/auth/usrpwd"] = {"user": told.user, "password": secret}
    tls: dict[str, Any] = {}
    if told.root_ca_certificate is not None:
        tls["root_ca_certificate"] = str(_existing(told.root_ca_certificate))
    if told.certificate is not None and told.private_key is not None:
        tls["connect_certificate"] = str(_existing(told.certificate))
        tls["connect_private_key"] = str(_existing(told.private_key))
        tls["enable_mtls"] = True
    if tls:
        settings["transport/link/tls"] = tls
    return settings


def _config(settings: dict[str, Any]) -> zenoh.Config:
    config = zenoh.Config()
    quiet = {
        "scouting/multicast/enabled": False,
        "scouting/gossip/enabled": False,
        "scouting/delay": 0,
    }
    for key, value in {**quiet, **settings}.items():
        config.insert_json5(key, json.dumps(value))
    return config


def _size_limit(max_bytes: int) -> dict[str, Any]:
    """Cut larger messages in the transport; `rx/max_message_size` lets shared memory through."""
    return {
        "id": "max_message_bytes",
        "flows": ["ingress"],
        "messages": ["put", "reply"],  # a reply brings what a publisher kept for us
        "key_exprs": ["**"],
        "size_limit": max_bytes,
    }


def _tls(network: NetworkSection) -> dict[str, Any]:
    assert network.listen_certificate is not None
    assert network.listen_private_key is not None
    tls: dict[str, Any] = {
        "listen_certificate": str(_existing(network.listen_certificate)),
        "listen_private_key": str(_existing(network.listen_private_key)),
        "enable_mtls": network.mutual_tls,
        "close_link_on_expiration": True,
    }
    if network.root_ca_certificate is not None:
        tls["root_ca_certificate"] = str(_existing(network.root_ca_certificate))
    return tls


def _existing(path: Path) -> Path:
    """The path itself. Raises ConfigError when there is no such file: Zenoh would only time out."""
    if not path.is_file():
        raise ConfigError(f"{path}: no such file")
    return path


def client_endpoint(network: NetworkSection) -> str:
    """Where a client on this machine reaches the service."""
    return network.listen[0] if network.listen else network.connect[0]
