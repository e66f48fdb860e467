"""`facet replay`: the map again from its log; and what `digest`, `export` and `demo` need of it."""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from facet.commands.outcome import print_result, require_scans
from facet.commands.play import parse_speed
from facet.commands.settings import (
    DetailOption,
    FrameOption,
    RejectJumpsOption,
    StrictOption,
    ThetaOption,
    VoxelOption,
    load_loops,
    make_mapper,
    mapping_overrides,
    recorded_settings,
    robots_overrides,
)
from facet.commands.terminal import (
    Exit,
    InputError,
    err,
    existing,
    out,
    out_file,
    out_folder,
    progress,
    table,
)
from facet.config import Config, load_config
from facet.cuts import logged_cuts, timed_cuts
from facet.outgoing import Outgoing
from facet.past import Past
from facet.robots import admission_of, dialects_of, recorded_robots, says_poses
from facet.sequences import SequenceLedger
from facet.sinks import Sink
from facet.sources.naming import is_input, is_scan, source_of
from facet.sources.recording import Recording, is_replayed, paced
from facet.status import Account
from facet_protocol.messages import Envelope

if TYPE_CHECKING:
    from facet.export.model import Model
    from facet.mapping.mapper import Mapper

POINTS_EVERY_NS = 500_000_000


@dataclass(slots=True)
class Replayed:
    """A replay that has ended."""

    mapper: Mapper
    recording: Recording
    account: Account
    wall_s: float
    log_s: float  # from the first message's log time to the last's
    num_scans: int
    num_missing: int  # scans that their sources have sent, by their numbers, and the log lacks

    @property
    def num_left_out(self) -> int:
        return sum(self.left_out.values())

    @property
    def left_out(self) -> dict[str, int]:
        """Messages that were no good scans, by reason."""
        counters = self.account.counters()
        return {
            name.removeprefix("rejected."): num
            for name, num in counters.items()
            if name.startswith("rejected.") and "[" not in name
        }

    @property
    def exit_code(self) -> Exit:
        return Exit.LOST if self.recording.is_damaged or self.num_left_out else Exit.CLEAN

    def model(self) -> Model:
        from facet.export.model import build_model

        settings = self.mapper.settings.as_dict()
        digest = self.mapper.digest()
        return build_model(self.mapper.snapshot(), self.mapper.counts(), settings, digest)


def replay_log(
    logs: Sequence[Path],
    config: Config,
    *,
    update_every: str = "log",
    speed: float = 0.0,
    sinks: Sequence[Sink] = (),
    points: bool = False,
    on_scan: Callable[[int], None] = lambda num: None,
) -> Replayed:
    """Rebuild a map from logs. `sinks` see what those of a running service see."""
    _require_one_map(existing(logs))
    head = Recording(logs).head()
    config = _as_recorded(config, head)
    past = Past(dialects_of(config.robots))
    recording = Recording(logs, dialects_of(config.robots), past.note_read)
    mapper = make_mapper(config, recorded_settings(head))
    load_loops(mapper.settings)
    account = Account()
    from facet.pipeline import AT_ONCE, Pipeline

    pipeline = Pipeline(
        mapper,
        admission_of(config, account, mapper.settings.reach_m, logged=says_poses(head), past=past),
        account,
        sinks,
        Outgoing(config.map.id, config.map.frame),
        POINTS_EVERY_NS if points else 0,
    )
    started, times, num = time.monotonic(), _LogTimes(), 0
    envelopes = times.watch(filter(is_replayed, recording))
    if speed:
        envelopes = paced(envelopes, speed, time.monotonic_ns, time.sleep)
    for batch in _batches(envelopes, update_every, recording):
        for source, count in Counter(map(source_of, filter(is_input, batch))).items():
            account.arrive(source, count)
        for start in range(0, len(batch), AT_ONCE):
            part = batch[start : start + AT_ONCE]
            pipeline.insert(*part)
            on_scan(num := num + sum(map(is_scan, part)))
        pipeline.update()
    pipeline.finish()
    for sink in sinks:
        sink.close()
    wall_s = time.monotonic() - started
    return Replayed(mapper, recording, account, wall_s, times.span_s, num, times.num_missing)


def _require_one_map(logs: Sequence[Path]) -> None:
    """Raises InputError for a folder with logs of more than one: what was two must not be one."""
    for folder in filter(Path.is_dir, logs):
        files = Recording([folder]).paths
        maps = sorted({Recording([file]).head().get("map", "") for file in files} - {""})
        if len(maps) > 1:
            raise InputError(
                f"{folder}: logs of {len(maps)} maps, {', '.join(maps)}: name the files of one, "
                f"{folder / maps[0]}-*.mcap"
            )


class _LogTimes:
    """First and last log time of what passes, and the numbers that do not."""

    def __init__(self) -> None:
        self._first = self._last = 0
        self._ledger = SequenceLedger()

    def watch(self, envelopes: Iterable[Envelope]) -> Iterator[Envelope]:
        for envelope in envelopes:
            self._first = self._first or envelope.received_ns
            self._last = max(self._last, envelope.received_ns)
            if is_scan(envelope):
                self._ledger.note(source_of(envelope), envelope.epoch, envelope.sequence)
            yield envelope

    @property
    def num_missing(self) -> int:
        return sum(self._ledger.missing().values())

    @property
    def span_s(self) -> float:
        return (self._last - self._first) * 1e-9


def _as_recorded(config: Config, head: dict[str, str]) -> Config:
    """Map, frame and robots as the log names them, where nothing else was asked for."""
    default = Config().map
    names = {
        "id": head.get("map", default.id) if config.map.id == default.id else config.map.id,
        "frame": head.get("frame", default.frame)
        if config.map.frame == default.frame
        else config.map.frame,
    }
    given = {name: getattr(config.robots, name) for name in config.robots.model_fields_set}
    robots = recorded_robots(head).model_copy(update=given)
    update = {"map": config.map.model_copy(update=names), "robots": robots}
    return config.model_copy(update=update)


def _batches(
    envelopes: Iterable[Envelope], update_every: str, recording: Recording
) -> Iterator[list[Envelope]]:
    if update_every == "log":
        return logged_cuts(envelopes, lambda: recording.has_cuts)
    return timed_cuts(envelopes, parse_every(update_every))


def parse_every(text: str) -> int:
    """ns of log time between updates; 0 for end. Raises typer.BadParameter."""
    if text == "end":
        return 0
    try:
        seconds = float(text)
    except ValueError:
        seconds = -1.0
    if not 0.0 < seconds < 1e9:
        raise typer.BadParameter(
            f"{text!r} is neither seconds above 0, nor log, nor end", param_hint="--update-every"
        )
    return int(seconds * 1e9)


def replay(
    logs: Annotated[list[Path], typer.Argument(help="Logs (.mcap), or folders of them.")],
    out_dir: Annotated[
        Path | None, typer.Option("--out", help="Folder for model.json and picture.png.")
    ] = None,
    speed: Annotated[
        str, typer.Option(help="max: as fast as it goes; 1: as recorded; N: N times.")
    ] = "max",
    update_every: Annotated[
        str, typer.Option(help="log: where the log says, else every 0.2 s; seconds; end: once.")
    ] = "log",
    viewer: Annotated[
        str, typer.Option(help="off | rrd (beside the model) | FILE.rrd, for Rerun.")
    ] = "off",
    updates: Annotated[
        Path | None, typer.Option(help="Write every update to this MCAP file.")
    ] = None,
    report: Annotated[bool, typer.Option("--report", help="The paper's four-stage table.")] = False,
    config: Annotated[
        Path | None, typer.Option(help="Settings (TOML): see `facet config`.")
    ] = None,
    frame: FrameOption = None,
    reject_jumps: RejectJumpsOption = None,
    strict: StrictOption = None,
    voxel: VoxelOption = None,
    theta: ThetaOption = None,
    detail_level: DetailOption = None,
) -> None:
    """Rebuild the map from its log. The same scans give the same map, bit for bit.

    \b
    facet replay out/log --report                  # the map again, and how it came about
    facet replay a.mcap --out out/a --viewer rrd   # with a picture and a recording for Rerun
    facet replay a.mcap --voxel 0.1 --update-every end

    A log that was cut off is read as far as it goes; its settings hold where no other is given.
    Exit code 3: something was lost or left out. 65: there is no scan in it.
    """
    overrides = {
        "map.frame": frame,
        **robots_overrides(reject_jumps, strict),
        **mapping_overrides(voxel, theta, detail_level),
    }
    settings = load_config(config, overrides)
    if update_every != "log":
        parse_every(update_every)
    rrd = _rrd_path(viewer, out_dir)
    existing(logs)
    if out_dir is not None:
        out_folder(out_dir)
    for file in filter(None, (rrd, updates)):
        out_file(file)
    sinks = _sinks(rrd, updates)
    with progress("replaying", _num_scans(logs)) as bar:
        result = replay_log(
            logs,
            settings,
            update_every=update_every,
            speed=parse_speed(speed),
            sinks=sinks,
            points=rrd is not None,
            on_scan=lambda num: bar.update(bar.task_ids[0], completed=num),
        )
    if not result.num_scans:
        require_scans(result)
    model = result.model()
    if out_dir is not None:
        write_outputs(model, out_dir)
    if report:
        _print_report(result.mapper.report())
    print_result(result, model)
    if rrd is not None:
        out.print(f"open it with: rerun {rrd}")
    raise typer.Exit(result.exit_code)


def _rrd_path(viewer: str, out_dir: Path | None) -> Path | None:
    if viewer == "off":
        return None
    if viewer == "rrd":
        return (out_dir or Path("out")) / "map.rrd"
    if viewer.endswith(".rrd"):
        return Path(viewer)
    raise typer.BadParameter(
        f"{viewer!r} is neither off, rrd nor a file that ends in .rrd", param_hint="--viewer"
    )


def _sinks(rrd: Path | None, updates: Path | None) -> list[Sink]:
    sinks: list[Sink] = []
    if updates is not None:
        from facet.sinks.log_file import UpdateLog

        sinks.append(UpdateLog(updates))
    if rrd is not None:
        from facet.sinks.dashboard import RrdViewer

        rrd.parent.mkdir(parents=True, exist_ok=True)
        sinks.append(RrdViewer(rrd))
    return sinks


def write_outputs(model: Model, folder: Path) -> None:
    """model.json and picture.png."""
    from facet.export.model import write_model
    from facet.export.picture import write_picture

    write_model(model, folder / "model.json")
    write_picture(model, folder / "picture.png")


def _print_report(report: Any) -> None:
    rows = report.rows
    table("stages", rows[0], rows[1:])


def _num_scans(logs: list[Path]) -> int | None:
    return sum(map(is_scan, Recording(existing(logs)))) if err.is_terminal else None
