"""`facet run`: the service, from the first connection to the last byte of the log."""

from __future__ import annotations

import logging
import os
import signal
import subprocess
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from types import FrameType
from typing import TYPE_CHECKING, Annotated

import typer

from facet.commands.settings import (
    DetailOption,
    RejectJumpsOption,
    StrictOption,
    ThetaOption,
    VoxelOption,
    load_loops,
    make_mapper,
    mapping_overrides,
    robots_overrides,
)
from facet.commands.terminal import Exit, InputError, out, table
from facet.config import Config, load_config
from facet.logbook import Logbook, keep_log
from facet.session import client_endpoint, open_session, service_settings

if TYPE_CHECKING:
    from facet.export.model import Model
    from facet.mapping.mapper import Mapper
    from facet.resume import Resumed
    from facet.service import Service

logger = logging.getLogger(__name__)

WATCH_S = 0.5
VIEWER_EXIT_S = 1.5


def run(
    config: Annotated[
        Path | None, typer.Option(help="Settings (TOML): see `facet config`.")
    ] = None,
    map_id: Annotated[
        str | None, typer.Option("--map", help="Name of the map.", show_default="map")
    ] = None,
    listen: Annotated[
        list[str] | None,
        typer.Option(
            help="Endpoint to listen on; again for more.", show_default="tcp/127.0.0.1:7447"
        ),
    ] = None,
    connect: Annotated[
        list[str] | None, typer.Option(help="Router to connect to; again for more.")
    ] = None,
    record: Annotated[
        Path | None, typer.Option(help="Folder of the log.", show_default="out/log")
    ] = None,
    viewer: Annotated[
        str | None,
        typer.Option(
            help="off | web | native | connect:URL of a Rerun viewer.", show_default="off"
        ),
    ] = None,
    on_full: Annotated[
        str | None,
        typer.Option(help="When the disk fails: retry | exit (with 74).", show_default="retry"),
    ] = None,
    fast: Annotated[
        bool, typer.Option("--fast", help="Do not wait for the disk: no power cut is survived.")
    ] = False,
    fresh: Annotated[
        bool, typer.Option("--fresh", help="Begin a new map; its log so far is set aside.")
    ] = False,
    reject_jumps: RejectJumpsOption = None,
    strict: StrictOption = None,
    voxel: VoxelOption = None,
    theta: ThetaOption = None,
    detail_level: DetailOption = None,
) -> None:
    """Map what robots send, until SIGTERM or Ctrl-C.

    \b
    facet run                                      # on tcp/127.0.0.1:7447, log in out/log
    facet run --viewer web                         # and a dashboard in the browser
    facet run --config facet.toml --map hall --record /data/hall
    facet run --fresh                              # not going on with the map that is there

    Scans come in on facet/v1/<map>/robot/<robot>/scan/<sensor>. What is not in the log is not in
    the map. A folder that holds this map's log is gone on with: from the last checkpoint, else from
    the whole log, to the same map with the same ids; other settings than the log's are applied to
    all of it. At the end the log is finished, with a checkpoint and model.json beside it. The
    first start compiles for a minute or two. Exit code 3: scans were lost, the table says how many.
    """
    overrides = {
        "map.id": map_id,
        "network.listen": listen or None,
        "network.connect": connect or None,
        "record.directory": record,
        "record.on_full": on_full,
        "record.mode": "fast" if fast else None,
        "record.resume": False if fresh else None,
        "viewer": viewer,
        **robots_overrides(reject_jumps, strict),
        **mapping_overrides(voxel, theta, detail_level),
    }
    raise typer.Exit(serve(load_config(config, overrides)))


def serve(config: Config) -> Exit:
    """Run the service until a signal; the exit code."""
    from facet.export.model import write_model
    from facet.resume import Stopped
    from facet.service import Service
    from facet.sinks.recorder import ACKNOWLEDGED, maps_in, single_writer

    book = keep_log()
    if config.record.directory.is_file():
        raise InputError(f"{config.record.directory} is a file: the log needs a folder")
    maps = sorted(maps_in(config.record.directory))
    if maps and config.map.id not in maps:  # model.json is of one
        text = (
            f"{config.record.directory} holds the log of map {maps[0]!r}: --map {maps[0]} goes on"
        )
        raise InputError(f"{text} with it; for {config.map.id!r} give --record another folder")
    mapper = make_mapper(config)
    with single_writer(config.record.directory), stop_signals() as stop:
        load_loops(mapper.settings, logger.info)
        try:
            resumed = _resume(config, mapper, stop)
        except Stopped:
            logger.warning("ended before the map was there again: its log is as it was")
            return Exit.LOST
        with open_session(service_settings(config.network)) as session:
            service = Service(session, config, resumed.mapper, resumed)
            service.start()
            logger.info("acknowledged is what is %s", ACKNOWLEDGED[config.record.mode])
            logger.info("ready: map %s on %s", config.map.id, ", ".join(config.network.listen))
            try:
                _watch(service, config, stop, book)
            finally:
                model = service.stop()
                if model is not None:
                    write_model(model, config.record.directory / "model.json")
        service.account.set_counter("log_lines_dropped", book.num_dropped)
        return _conclude(service, model)


def _resume(config: Config, mapper: Mapper, stop: threading.Event) -> Resumed:
    """The map that is there, or with --fresh a new one, the other's log set aside."""
    from facet.resume import resume, set_aside

    if not config.record.resume:
        folder = set_aside(config.record.directory, config.map.id)
        if folder is not None:
            logger.info("a new map; the log of the one before lies in %s", folder)
    return resume(config, mapper, stop.is_set)


@contextmanager
def stop_signals() -> Iterator[threading.Event]:
    """Set by the first SIGTERM or SIGINT; a second one ends the process at once."""
    stop = threading.Event()

    def on_signal(number: int, frame: FrameType | None) -> None:
        if stop.is_set():
            os._exit(128 + number)
        stop.set()

    previous = {n: signal.signal(n, on_signal) for n in (signal.SIGTERM, signal.SIGINT)}
    try:
        yield stop
    finally:
        for number, handler in previous.items():
            signal.signal(number, handler)


def _watch(service: Service, config: Config, stop: threading.Event, book: Logbook) -> None:
    """Wait for the end; the viewer may come and go, the log's reader too."""
    viewer = _start_viewer(config)
    try:
        while not stop.wait(WATCH_S) and not service.ended.is_set():
            service.account.set_counter("log_lines_dropped", book.num_dropped)
            if viewer is not None and viewer.poll() is not None:
                logger.warning("the viewer ended with code %d; the map goes on", viewer.returncode)
                service.account.count("viewer_ended")
                viewer = None
    finally:
        if viewer is not None:
            _end(viewer)


def _start_viewer(config: Config) -> subprocess.Popen[bytes] | None:
    if config.viewer == "off":
        return None
    endpoint = client_endpoint(config.network)
    command = [sys.executable, "-m", "facet.sinks.viewer", endpoint, config.map.id, config.viewer]
    return subprocess.Popen([*command, "--tied"], start_new_session=True)


def _end(child: subprocess.Popen[bytes]) -> None:
    child.terminate()
    with suppress(subprocess.TimeoutExpired):
        child.wait(VIEWER_EXIT_S)
        return
    child.kill()
    child.wait()


def _conclude(service: Service, model: Model | None) -> Exit:
    """The last word: what was recorded, what was lost."""
    account = service.account
    received, recorded = account["received"], account["recorded"]
    left_out = account["not_applied"]
    lost = received - recorded + account["lost_upstream"] + left_out
    share = 100.0 * recorded / received if received else 100.0
    table("counters", ("counter", "value"), account.counters().items())
    for path in service.recorder.paths:
        out.print(f"log    {path}")
    out.print(
        f"recorded {recorded:,} of {received:,} received ({share:.1f} %), "
        f"lost upstream {account['lost_upstream']:,}"
    )
    if left_out:
        out.print(f"{left_out:,} of them came too late for the model: facet replay maps them")
    if service.fault is not None:
        return Exit.FAULT
    if account.failure:
        return Exit.IO
    return Exit.LOST if lost or model is None else Exit.CLEAN
