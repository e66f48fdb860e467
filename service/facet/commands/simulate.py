"""`facet simulate`: a recording of a scene that is known exactly, with its truth beside it."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Annotated

import typer

from facet.commands.terminal import as_typed, megabytes, out, out_file, progress
from facet.sinks.log_file import write_recording
from facet_protocol.codec import encode
from facet_protocol.messages import Envelope, LineFan, Scan
from facet_protocol.topics import scan_key

LEAST = 0.001  # m/s, and scans a second: nothing moves at 0


def simulate(
    context: typer.Context,
    recording: Annotated[Path, typer.Argument(metavar="OUT.mcap", help="The recording.")],
    scene: Annotated[str, typer.Option(help="office | corridor | hall | hall85k")] = "office",
    sensor: Annotated[str, typer.Option(help="lidar3d | pushbroom | depth")] = "pushbroom",
    range_noise: Annotated[
        float, typer.Option(min=0.0, max=10.0, help="m, standard deviation along a beam.")
    ] = 0.012,
    pose_noise: Annotated[
        float,
        typer.Option(min=0.0, max=10.0, help="m, standard deviation of each axis of a position."),
    ] = 0.008,
    heading_noise: Annotated[
        float,
        typer.Option(min=0.0, max=180.0, help="degrees, standard deviation of the heading."),
    ] = 0.0,
    seed: Annotated[int, typer.Option(min=0, help="The same seed, the same recording.")] = 0,
    duration: Annotated[
        float | None, typer.Option(min=0.0, max=1e6, help="s.", show_default="the whole drive")
    ] = None,
    max_points: Annotated[
        int | None, typer.Option(min=1, help="Spread so many points over the whole drive.")
    ] = None,
    speed: Annotated[
        float | None,
        typer.Option(
            min=LEAST, max=1e3, help="m/s, how fast it drives.", show_default="the sensor's own"
        ),
    ] = None,
    rate: Annotated[
        float | None,
        typer.Option(min=LEAST, max=1e5, help="Scans a second.", show_default="the sensor's own"),
    ] = None,
    robot: Annotated[str, typer.Option(help="Name of the robot.")] = "sim",
    map_id: Annotated[str, typer.Option("--map", help="Name of the map.")] = "map",
    compression: Annotated[str, typer.Option(help="lz4 | zstd | none")] = "lz4",
) -> None:
    """Simulate a robot's drive. The truth is written beside the recording, as OUT.truth.json.

    \b
    facet simulate office.mcap                                  # push-broom through an office
    facet simulate hall.mcap --scene hall --sensor lidar3d --duration 30
    facet simulate exact.mcap --range-noise 0 --pose-noise 0
    """
    from facet.simulate import SCENES, SENSORS, Noise, Observer, Simulation
    from facet.sinks.log_file import COMPRESSIONS

    out_file(recording)
    _check("scene", scene, SCENES)
    _check("sensor", sensor, SENSORS)
    _check("compression", compression, COMPRESSIONS)
    simulation = Simulation(
        scene,
        sensor,
        seed=seed,
        noise=Noise(range_noise, pose_noise, heading_noise),
        max_points=max_points,
        duration_s=duration,
        speed_mps=speed,
        rate_hz=rate,
        robot=robot,
    )
    observer = Observer(simulation)

    def envelopes() -> Iterator[Envelope]:
        with progress("simulating", len(simulation)) as bar:
            for index in range(len(simulation)):
                look = simulation.look(index)
                observer.watch(look)
                yield envelope_of(simulation.message(look), map_id)
                bar.update(bar.task_ids[0], completed=index + 1)

    metadata = {
        "map": map_id,
        "frame": "map",
        "made_by": as_typed(context),
    }
    num = write_recording(recording, envelopes(), metadata, compression)
    truth_file = recording.with_suffix(".truth.json")
    observer.truth().write(truth_file)
    out.print(f"{recording}: {num:,} scans, {megabytes(recording.stat().st_size)}")
    out.print(f"{truth_file}: what is true of the scene")


def envelope_of(message: Scan | LineFan, map_id: str) -> Envelope:
    """A scan as its robot would send it; received when it was taken."""
    schema, payload = encode(message)
    return Envelope(
        key=scan_key(map_id, message.robot, message.sensor),
        schema=schema,
        encoding="protobuf",
        payload=payload,
        stamp_ns=message.stamp_ns,
        epoch=message.epoch,
        sequence=message.sequence,
        received_ns=message.stamp_ns,
    )


def _check(name: str, value: str, known: object) -> None:
    names = list(known)  # type: ignore[call-overload]
    if value not in names:
        raise typer.BadParameter(
            f"{value!r} is not one of {', '.join(names)}", param_hint=f"--{name}"
        )
