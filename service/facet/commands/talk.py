"""`facet status`, `top` and `cmd`: what a running service says, and what it can be told."""

from __future__ import annotations

import json
import time
from collections.abc import Iterator
from itertools import zip_longest
from pathlib import Path
from typing import Annotated

import typer
import zenoh
from rich.live import Live
from rich.table import Table
from rich.text import Text

from facet.commands.terminal import Exit, InputError, err, out
from facet.session import DEFAULT_ENDPOINT, client_settings, open_session
from facet.status import balance_of
from facet_protocol import topics
from facet_protocol.messages import ProtocolError, Status
from facet_protocol.records import decode_status

WAIT_S = 3.0  # the service speaks once a second
EVERYONE = topics.alive_key("_").replace("/_/", "/*/")
MapOption = Annotated[str, typer.Option("--map", help="Name of the map.")]
ConnectOption = Annotated[str, typer.Option(help="The service's endpoint.")]
CredentialsOption = Annotated[
    Path | None,
    typer.Option(envvar="FACET_CREDENTIALS", help="What to show at a guarded endpoint (TOML)."),
]


def statuses(session: zenoh.Session, map_id: str) -> Iterator[Status | None]:
    """What the service says of itself, as it says it; None when it is silent for WAIT_S."""
    handler: zenoh.handlers.RingChannel[zenoh.Sample] = zenoh.handlers.RingChannel(4)
    with session.declare_subscriber(topics.status_key(map_id), handler) as subscriber:
        while True:
            yield _next(subscriber)


def _next(subscriber: zenoh.Subscriber[zenoh.handlers.Handler[zenoh.Sample]]) -> Status | None:
    deadline = time.monotonic() + WAIT_S
    while time.monotonic() < deadline:
        sample = subscriber.try_recv()
        if sample is not None:
            return decode_status(sample.payload.to_bytes())
        time.sleep(0.02)
    return None


def maps_at(session: zenoh.Session) -> list[str]:
    """The maps whose services are there, by name."""
    place = EVERYONE.split("/").index("*")
    replies = session.liveliness().get(EVERYONE, timeout=WAIT_S)
    return sorted({str(r.ok.key_expr).split("/")[place] for r in replies if r.ok is not None})


def has_service(session: zenoh.Session, map_id: str) -> bool:
    """Whether somebody makes this map; an access table may hide the others."""
    replies = session.liveliness().get(topics.alive_key(map_id), timeout=WAIT_S)
    return any(reply.ok is not None for reply in replies)


def no_service(session: zenoh.Session, map_id: str, endpoint: str) -> str:
    """That nobody makes this map, and which maps somebody makes."""
    maps = maps_at(session)
    instead = f"; --map {' or '.join(maps)} would find one" if maps else ""
    return f"no service maps {map_id!r} at {endpoint}{instead}"


def status(
    map_id: MapOption = "map",
    connect: ConnectOption = DEFAULT_ENDPOINT,
    credentials: CredentialsOption = None,
) -> None:
    """Tell how a running service is. What it has counted, what it holds, what its stages take.

    \b
    facet status
    facet status --map hall --connect tcp/127.0.0.1:7448

    Exit code 3: it lives, but its health is not OK; 65: somebody answers, but does not make this
    map; 74: nobody answers.
    """
    with open_session(client_settings(connect, credentials=credentials)) as session:
        current = next(statuses(session, map_id))
        if current is None:
            raise InputError(no_service(session, map_id, connect))
        out.print(_table(current))
    raise typer.Exit(Exit.CLEAN if current.health == "OK" else Exit.LOST)


def top(
    map_id: MapOption = "map",
    connect: ConnectOption = DEFAULT_ENDPOINT,
    credentials: CredentialsOption = None,
) -> None:
    """Watch a running service, until Ctrl-C. Every second what `facet status` says.

    \b
    facet top
    facet top --map hall --connect tcp/127.0.0.1:7448
    """
    with (
        open_session(client_settings(connect, credentials=credentials)) as session,
        Live(console=out, screen=out.is_terminal, auto_refresh=False) as live,
    ):
        for current in statuses(session, map_id):
            if current is None:
                err.print(no_service(session, map_id, connect))
            else:
                live.update(_table(current), refresh=True)


def cmd(
    name: Annotated[str, typer.Argument(help=" | ".join(topics.COMMANDS))],
    parameters: Annotated[list[str] | None, typer.Argument(help="key=value, as above.")] = None,
    map_id: MapOption = "map",
    connect: ConnectOption = DEFAULT_ENDPOINT,
    credentials: CredentialsOption = None,
) -> None:
    """Tell a running service what to do.

    \b
    facet cmd pause                  # scans are recorded, but wait: the map stays as it is
    facet cmd resume                 # they are mapped again
    facet cmd checkpoint             # the next start goes on from here
    facet cmd record                 # start a new log file; the others can be copied
    facet cmd export format=glb      # json (the default), ply, glb or png, beside the log
    facet cmd erase robot=r1 first=40 last=90   # take scans out, as if they had never come

    erase needs robot=; sensor=, epoch=, first= and last= (numbers of scans, both included) narrow
    it: without them all scans of the robot go. Exit code 65: the service refuses, and says why.
    """
    try:
        selector = topics.cmd_key(map_id, name)
    except ProtocolError as error:
        raise typer.BadParameter(str(error), param_hint="name") from error
    for parameter in parameters or ():
        if "=" not in parameter:
            raise typer.BadParameter(f"{parameter!r} is not key=value", param_hint="parameters")
    if parameters:
        selector += "?" + ";".join(parameters)
    with open_session(client_settings(connect, credentials=credentials)) as session:
        replies = list(session.get(selector, timeout=15.0))
        if not replies:
            raise InputError(no_service(session, map_id, connect))
    for reply in replies:
        if reply.ok is None:
            assert reply.err is not None
            raise InputError(reply.err.payload.to_string())
        for key, value in json.loads(reply.ok.payload.to_string()).items():
            out.print(f"{key}: {value}")


def _figure(value: float) -> str:
    """A whole number whole: a robot may forget what is acknowledged up to it."""
    is_whole = float(value).is_integer() or abs(value) >= 1000
    return f"{value:,.0f}" if is_whole else f"{value:.3g}"


def _table(current: Status) -> Table:
    balance = balance_of(current.counters, current.gauges)
    grid = Table(
        title=f"map {current.map_id}, revision {current.revision}: {current.health}",
        caption=f"received {balance.received:,} = applied {balance.applied:,} + rejected "
        f"{balance.rejected:,} + left out {balance.left_out:,} + in flight {balance.in_flight:,}; "
        f"lost upstream {current.counters.get('lost_upstream', 0):,}",
    )
    for column in ("counter", "value", "gauge", "value", "stage", "ms"):
        grid.add_column(column, justify="right" if column in ("value", "ms") else "left")
    columns = [
        [(name, f"{num:,}") for name, num in current.counters.items()],
        [(name, _figure(value)) for name, value in current.gauges.items()],
        [(name, f"{value:.1f}") for name, value in current.stage_ms.items()],
    ]
    for cells in zip_longest(*columns, fillvalue=("", "")):
        grid.add_row(*(Text(text) for cell in cells for text in cell))  # no markup in names
    return grid
