"""Zenoh sessions as Facet opens them: nothing listens that was not asked for, nothing scouts."""

from __future__ import annotations

import json
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import zenoh

from facet.config import NetworkSection

DEFAULT_ENDPOINT = "tcp/127.0.0.1:7447"
CONNECT_TIMEOUT_MS = 3000


@contextmanager
def open_session(settings: dict[str, Any]) -> Iterator[zenoh.Session]:
    """A session that is closed whatever happens: an open one keeps the process from ending."""
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
        "transport/shared_memory/enabled": network.shared_memory,
    }
    if network.listen_certificate is not None:
        settings["transport/link/tls"] = _tls(network)
    if network.users_file is not None:
        settings["transport/auth/usrpwd"] = {"dictionary_file": str(network.users_file)}
    if network.access_control is not None:
        settings["access_control"] = json.loads(network.access_control.read_text("utf-8"))
    return settings


def client_settings(endpoint: str = DEFAULT_ENDPOINT, shared_memory: bool = True) -> dict[str, Any]:
    """A client of a running service; fails when nobody answers within CONNECT_TIMEOUT_MS."""
    return {
        "mode": "client",
        "listen/endpoints": [],
        "connect/endpoints": [endpoint],
        "connect/timeout_ms": CONNECT_TIMEOUT_MS,
        "transport/shared_memory/enabled": shared_memory,
        "timestamping/enabled": True,  # the advanced publisher needs it
    }


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
    tls: dict[str, Any] = {
        "listen_certificate": str(network.listen_certificate),
        "listen_private_key": str(network.listen_private_key),
        "enable_mtls": network.mutual_tls,
    }
    if network.root_ca_certificate is not None:
        tls["root_ca_certificate"] = str(network.root_ca_certificate)
    return tls


def client_endpoint(network: NetworkSection) -> str:
    """Where a client on this machine reaches the service."""
    return network.listen[0] if network.listen else network.connect[0]
