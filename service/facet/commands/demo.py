"""`facet demo`: a recording played by one process into the service in another, over Zenoh."""

from __future__ import annotations

import shutil
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from facet.commands.outcome import NO_SCAN_CURE, summary
from facet.commands.play import parse_speed
from facet.commands.replay import Replayed, replay_log, write_outputs
from facet.commands.talk import statuses
from facet.commands.terminal import (
    Exit,
    InputError,
    err,
    existing,
    megabytes,
    out,
    out_folder,
    progress,
    table,
)
from facet.config import Config
from facet.session import client_settings, open_session
from facet.sources.naming import is_scan
from facet.sources.recording import Recording
from facet_protocol import topics

if TYPE_CHECKING:
    import zenoh

    from facet.export.model import Model

RECORDINGS = Path(__file__).parents[3] / "recordings"
MAP = "demo"
MARK = "service.txt"  # what the service says: written first
WRITTEN = {MARK, "log", "model.json", "picture.png", "demo.rrd"}
READY_S = 900.0  # the first start compiles: minutes, on a busy machine
QUIET_S = 20.0  # nothing new is applied for so long: something is stuck
ENDING_S = 15.0


def demo(
    recording: Annotated[
        Path | None, typer.Option(help="A recording; the bundled one otherwise.")
    ] = None,
    out_dir: Annotated[Path, typer.Option("--out", help="Where everything is written.")] = Path(
        "out/demo"
    ),
    speed: Annotated[str, typer.Option(help="How fast it is played: N times, or max.")] = "20",
) -> None:
    """Watch a robot map a building. No robot, no building and no network needed.

    \b
    facet demo
    facet demo --recording my.mcap --speed max --out out/mine

    A robot's recording is played over Zenoh into the service, as a robot would send it; what comes
    out lies in out/demo: the log, the model, a picture, and a recording for Rerun.
    """
    source = recording or _bundled()
    existing([source])
    parse_speed(speed)
    scans = [envelope for envelope in Recording([source]) if is_scan(envelope)]
    num_bytes = sum(len(envelope.payload) for envelope in scans)
    if not scans:
        raise InputError(f"{source}: no scan in it; {NO_SCAN_CURE}")
    _make_room(out_dir, source)
    out.print(f"{source.name}: {len(scans):,} scans, {megabytes(num_bytes)} of raw scans")
    wall_s = _map_live(source, len(scans), out_dir, speed)
    model, result = _map_again(out_dir)
    table("demo", ("what", "value"), _rows(model, wall_s, result, num_bytes, out_dir))
    _print_paths(out_dir)
    raise typer.Exit(_verdict(model, out_dir, result, len(scans)))


def _make_room(folder: Path, source: Path) -> None:
    """Empty the folder of a demo before, or make one. Raises InputError for any other: what it
    holds would be gone."""
    out_folder(folder)
    names = {path.name for path in folder.iterdir()}
    if names and (MARK not in names or names - WRITTEN):
        other = min(names - WRITTEN or names)
        raise InputError(
            f"{folder} holds {other!r}, not from a demo: --out needs a folder of its own"
        )
    if source.resolve().is_relative_to(folder.resolve()):
        raise InputError(f"{source} lies in {folder}, which is emptied: --out needs another folder")
    shutil.rmtree(folder)
    folder.mkdir()


def _bundled() -> Path:
    recordings = sorted(RECORDINGS.glob("office*.mcap")) or sorted(RECORDINGS.glob("*.mcap"))
    if not recordings:
        raise InputError(
            f"no recording in {RECORDINGS}: `facet simulate a.mcap` makes one, "
            "`facet demo --recording a.mcap` plays it"
        )
    return recordings[0]


def _map_live(source: Path, num_scans: int, out_dir: Path, speed: str) -> float:
    """Service and robot as processes of their own; how long the mapping took, in s."""
    endpoint = f"tcp/127.0.0.1:{_free_port()}"
    service = ["run", "--map", MAP, "--listen", endpoint, "--record", str(out_dir / "log")]
    robot = ["play", str(source), "--map", MAP, "--connect", endpoint, "--speed", speed]
    log = out_dir / MARK
    with log.open("wb") as service_out, _child(service, service_out) as running:
        with _connected(endpoint, running, log) as session:
            started = time.monotonic()
            with _child(robot, subprocess.DEVNULL) as playing:
                _follow(session, num_scans, playing, running)
            wall_s = time.monotonic() - started
        running.send_signal(signal.SIGTERM)
        code = running.wait(ENDING_S)
    if code not in (Exit.CLEAN, Exit.LOST):
        raise InputError(f"the service ended with code {code}: see {log}")
    return wall_s


@contextmanager
def _child(arguments: list[str], stdout: Any) -> Iterator[subprocess.Popen[bytes]]:
    """`facet` in a process of its own, ended whatever happens."""
    command = [sys.executable, "-m", "facet", *arguments]
    process = subprocess.Popen(command, stdout=stdout, stderr=subprocess.STDOUT)
    try:
        yield process
    finally:
        if process.poll() is None:
            process.terminate()
            with suppress(subprocess.TimeoutExpired):
                process.wait(ENDING_S)
        if process.poll() is None:
            process.kill()
            process.wait()


@contextmanager
def _connected(
    endpoint: str, running: subprocess.Popen[bytes], log: Path
) -> Iterator[zenoh.Session]:
    """A session with the service, once it is up."""
    import zenoh

    deadline = time.monotonic() + READY_S
    err.print("starting the service; the first time it compiles, for a minute or more")
    while running.poll() is None and time.monotonic() < deadline:
        try:
            with open_session(client_settings(endpoint)) as session:
                if _is_alive(session, running, deadline):
                    yield session
                    return
        except zenoh.ZError:
            time.sleep(0.1)
    why = f"is not there after {READY_S:.0f} s" if running.poll() is None else "did not start"
    raise InputError(f"the service {why}: see {log}")


def _is_alive(session: zenoh.Session, running: subprocess.Popen[bytes], deadline: float) -> bool:
    while running.poll() is None and time.monotonic() < deadline:
        if list(session.liveliness().get(topics.alive_key(MAP), timeout=1.0)):
            return True
        time.sleep(0.05)
    return False


def _follow(
    session: zenoh.Session,
    num_scans: int,
    playing: subprocess.Popen[bytes],
    running: subprocess.Popen[bytes],
) -> None:
    """Show what is applied until it is all of it, or nothing more comes."""
    applied, last_news = 0, time.monotonic()
    with progress("mapping", num_scans) as bar:
        for status in statuses(session, MAP):
            now = status.counters.get("applied", 0) if status else applied
            if now > applied:
                applied, last_news = now, time.monotonic()
            bar.update(bar.task_ids[0], completed=applied)
            stuck = time.monotonic() - last_news > QUIET_S and playing.poll() is not None
            if applied >= num_scans or stuck or running.poll() is not None:
                return


def _map_again(out_dir: Path) -> tuple[Model, Replayed]:
    """Replay the log that the service wrote: with a picture, and a recording for Rerun."""
    from facet.sinks.dashboard import RrdViewer

    log = out_dir / "log"
    total = sum(map(is_scan, Recording([log])))
    with progress("replaying its log", total) as bar:
        result = replay_log(
            [log],
            Config(),
            sinks=[RrdViewer(out_dir / "demo.rrd")],
            points=True,
            on_scan=lambda num: bar.update(bar.task_ids[0], completed=num),
        )
    model = result.model()
    write_outputs(model, out_dir)
    return model, result


def _rows(
    model: Model, wall_s: float, result: Replayed, num_bytes: int, out_dir: Path
) -> list[tuple[str, Any]]:
    size = (out_dir / "model.json").stat().st_size
    driven_s = _driven_s(out_dir / "log")
    return [
        *summary(model, wall_s, driven_s),
        ("replay", f"{result.wall_s:.1f} s"),
        ("model", f"{megabytes(size)}, 1/{num_bytes / size:.0f} of the raw scans"),
    ]


def _driven_s(log: Path) -> float:
    """How long the robot drove, by its own stamps."""
    stamps = [envelope.stamp_ns for envelope in Recording([log]) if is_scan(envelope)]
    return (max(stamps) - min(stamps)) * 1e-9 if stamps else 0.0


def _print_paths(out_dir: Path) -> None:
    for path in sorted((out_dir / "log").glob("*.mcap")):
        out.print(f"log      {path}")
    out.print(f"model    {out_dir / 'model.json'}")
    out.print(f"picture  {out_dir / 'picture.png'}")
    out.print(f"open it  {Path(sys.executable).parent / 'rerun'} {out_dir / 'demo.rrd'}")


def _verdict(model: Model, out_dir: Path, result: Replayed, num_scans: int) -> Exit:
    """Whether the live map and the replayed one are the same, to the bit."""
    from facet.export.model import read_model

    live = read_model(out_dir / "log" / "model.json")
    if live["digest"] != model["digest"]:
        err.print("the replay of the log gave another map than the service", style="bold red")
        return Exit.FAULT
    out.print(f"digest   {model['digest']['derived'][:16]}, live and replayed alike")
    applied = result.account["applied"]
    if applied < num_scans:
        err.print(f"{num_scans - applied:,} of {num_scans:,} scans did not arrive")
        return Exit.LOST
    return Exit.CLEAN


def _free_port() -> int:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])
