"""`facet import`: scans in other formats to a recording, each with the pose it was taken from."""

from __future__ import annotations

import re
import zipfile
import zlib
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import numpy as np
import typer
from numpy.typing import NDArray

from facet.commands.simulate import envelope_of
from facet.commands.terminal import (
    InputError,
    as_typed,
    existing,
    megabytes,
    out,
    out_file,
    progress,
)
from facet.sinks.log_file import write_recording
from facet_protocol.messages import IDENTITY, Envelope, Pose, Scan, ScanKind

RIGID = 1e-3  # how far a rotation may be from one, in any element of R Rᵀ
CLOUDS = (".ply", ".pcd")
POSE_LINE = "stamp x y z qx qy qz qw"
_SECONDS = re.compile(r"[0-9]{1,10}(\.[0-9]*)?")
NONE = np.zeros((0, 3), dtype=np.float32)


@dataclass(frozen=True, slots=True, eq=False)
class PosedCloud:
    """One scan of a file: points in the sensor's frame and T_world_sensor."""

    stamp_ns: int
    pose: Pose
    points: NDArray[np.float32]  # (N, 3) m, sensor frame


def import_(
    context: typer.Context,
    source: Annotated[
        Path, typer.Argument(metavar="FILE|DIR", help=".npz, .ply or .pcd, or a folder of clouds.")
    ],
    recording: Annotated[Path, typer.Argument(metavar="OUT.mcap", help="The recording.")],
    poses: Annotated[
        Path | None,
        typer.Option(help=f"Lines `{POSE_LINE}` (TUM: seconds, metres), one a cloud."),
    ] = None,
    robot: Annotated[str, typer.Option(help="Name of the robot.")] = "import",
    sensor: Annotated[str, typer.Option(help="Name of the sensor.")] = "cloud",
    map_id: Annotated[str, typer.Option("--map", help="Name of the map.")] = "map",
) -> None:
    """Make a recording of scans from elsewhere.

    \b
    facet import corridor.npz corridor.mcap        # stamp_ns, T_world_sensor, points, lengths
    facet import clouds/ a.mcap --poses poses.txt  # *.ply or *.pcd in the order of their names
    facet import scan.ply a.mcap                   # one cloud: at the origin, stamped as the file

    Points are metres in the sensor's frame. The arrays of an .npz of S scans: stamp_ns (S,),
    T_world_sensor (S, 4, 4), points (N, 3) of all scans one after the other, lengths (S,).
    """
    existing([source] + ([poses] if poses else []))
    out_file(recording)
    num_scans, clouds = _open(source, poses)

    def envelopes() -> Iterator[Envelope]:
        with progress("importing", num_scans) as bar:
            for sequence, cloud in enumerate(clouds, start=1):
                yield envelope_of(_scan(cloud, robot, sensor, sequence), map_id)
                bar.update(bar.task_ids[0], completed=sequence)

    metadata = {"map": map_id, "frame": "map", "made_by": as_typed(context)}
    num = write_recording(recording, envelopes(), metadata)
    out.print(f"{recording}: {num:,} scans, {megabytes(recording.stat().st_size)}")


def _scan(cloud: PosedCloud, robot: str, sensor: str, sequence: int) -> Scan:
    return Scan(
        robot=robot,
        sensor=sensor,
        epoch=1,
        sequence=sequence,
        stamp_ns=cloud.stamp_ns,
        frame_id="map",
        kind=ScanKind.CLOUD,
        pose=cloud.pose,
        points=cloud.points,
        no_return=NONE,
    )


def _open(source: Path, poses: Path | None) -> tuple[int, Iterator[PosedCloud]]:
    """(how many, the clouds). Raises InputError."""
    if source.suffix == ".npz":
        return _read_npz(source)
    if source.suffix == ".mcap":
        raise InputError(f"{source} is a recording already: `facet replay` reads it as it is")
    if source.is_file() and source.suffix not in CLOUDS:
        raise InputError(f"{source}: its name ends in none of .npz, {', '.join(CLOUDS)}")
    files = [source] if source.is_file() else _clouds_in(source)
    if poses is None and len(files) > 1:
        raise InputError(f"{source}: {len(files)} clouds need their poses: --poses FILE")
    posed = _read_poses(poses) if poses else [_at_origin(source)]
    if len(posed) != len(files):
        raise InputError(f"{poses}: {len(posed)} poses for {len(files)} clouds")
    return len(files), (
        PosedCloud(stamp, pose, _read_cloud(f))
        for f, (stamp, pose) in zip(files, posed, strict=True)
    )


def _clouds_in(folder: Path) -> list[Path]:
    files = sorted(f for f in folder.iterdir() if f.suffix in CLOUDS)
    if not files:
        raise InputError(f"{folder}: no .ply or .pcd file in it")
    return files


def _read_npz(path: Path) -> tuple[int, Iterator[PosedCloud]]:
    """`stamp_ns` (S,), `T_world_sensor` (S, 4, 4), `points` (N, 3), `lengths` (S,)."""
    try:
        with path.open("rb") as file, np.load(file, allow_pickle=False) as data:
            stamps, transforms = data["stamp_ns"], data["T_world_sensor"]
            points, lengths = data["points"].astype(np.float32, copy=False), data["lengths"]
    except KeyError as error:
        raise InputError(
            f"{path}: {error.args[0]}; needed are stamp_ns, T_world_sensor, points, lengths"
        ) from error
    except (OSError, TypeError, ValueError, EOFError, zipfile.BadZipFile, zlib.error) as error:
        is_npz = zipfile.is_zipfile(path)
        raise InputError(f"{path}: {error if is_npz else 'not an .npz file'}") from error
    kinds = [(stamps, "iuf"), (transforms, "iuf"), (lengths, "iu")]
    if any(a.dtype.kind not in kind for a, kind in kinds) or not np.isfinite(stamps).all():
        raise InputError(f"{path}: stamp_ns and T_world_sensor need numbers, lengths whole ones")
    if (stamps < 0).any():
        raise InputError(f"{path}: stamp_ns {int(stamps.min())} lies before 1970")
    num, told = stamps.size, int(lengths.sum())
    shapes = (stamps.shape, transforms.shape, lengths.shape, points.shape)
    if shapes != ((num,), (num, 4, 4), (num,), (told, 3)) or (lengths < 0).any():
        raise InputError(
            f"{path}: stamp_ns {shapes[0]}, T_world_sensor {shapes[1]}, lengths {shapes[2]} that "
            f"sum to {told:,}, points {shapes[3]}: they do not fit each other"
        )
    _require_rigid(path, transforms)
    ends = np.cumsum(lengths)
    return num, (
        PosedCloud(int(stamps[k]), _pose_of(transforms[k]), points[ends[k] - lengths[k] : ends[k]])
        for k in range(num)
    )


def _require_rigid(path: Path, transforms: NDArray[np.float64]) -> None:
    """Raises InputError for a pose that turns the room inside out, or stretches it."""
    R = transforms[:, :3, :3].astype(np.float64)
    off = np.abs(R @ R.transpose(0, 2, 1) - np.eye(3)).max(axis=(1, 2))
    is_bad = ~(off < RIGID) | ~(np.linalg.det(R) > 0.0) | ~np.isfinite(transforms).all(axis=(1, 2))
    if is_bad.any():
        raise InputError(
            f"{path}: T_world_sensor[{np.flatnonzero(is_bad)[0]}] is no rotation and translation"
        )


def _at_origin(cloud: Path) -> tuple[int, Pose]:
    """Of a cloud by itself: taken when its file was written."""
    return cloud.stat().st_mtime_ns, IDENTITY


def _pose_of(T_world_sensor: NDArray[np.float64]) -> Pose:
    """The pose of a rigid (4, 4) transform."""
    from scipy.spatial.transform import Rotation

    xyzw = Rotation.from_matrix(T_world_sensor[:3, :3]).as_quat()
    return Pose(T_world_sensor[:3, 3].astype(np.float64), xyzw)


def _read_poses(path: Path) -> list[tuple[int, Pose]]:
    """(stamp in ns, pose) of every line `stamp x y z qx qy qz qw`; # starts a comment."""
    posed = []
    for number, line in enumerate(path.read_text("utf-8").splitlines(), start=1):
        words = line.split("#")[0].split()
        if not words:
            continue
        try:
            values = np.array([float(word) for word in words[1:]])
            stamp_ns = _nanoseconds(words[0])
        except ValueError as error:
            raise InputError(f"{path}:{number}: {error}; a line is {POSE_LINE}") from error
        if len(values) != 7:
            raise InputError(f"{path}:{number}: {len(words)} numbers, 8 are {POSE_LINE}")
        if not abs(np.linalg.norm(values[3:]) - 1.0) < RIGID:
            raise InputError(f"{path}:{number}: qx qy qz qw {values[3:]} has not the length 1")
        posed.append((stamp_ns, Pose(values[:3], values[3:])))
    return posed


def _nanoseconds(seconds: str) -> int:
    """Exactly: a float has no room for nanoseconds since 1970."""
    if not _SECONDS.fullmatch(seconds):
        raise ValueError(f"{seconds!r} are no seconds since 1970")
    whole, _, fraction = seconds.partition(".")
    return int(whole) * 10**9 + int((fraction + "0" * 9)[:9])


def _read_cloud(path: Path) -> NDArray[np.float32]:
    """(N, 3) m of a PLY or PCD file. Raises InputError."""
    try:
        if path.suffix == ".pcd":
            return _read_pcd(path)
        from plyfile import PlyData

        vertex = PlyData.read(path)["vertex"]
        return np.stack([np.asarray(vertex[axis], np.float32) for axis in "xyz"], axis=1)
    except InputError:
        raise
    except UnicodeDecodeError as error:
        raise InputError(f"{path}: not a {path.suffix} file") from error
    except Exception as error:
        raise InputError(f"{path}: {error}") from error


def _read_pcd(path: Path) -> NDArray[np.float32]:
    try:
        from pypcd4.pypcd4 import PointCloud
    except ImportError:
        raise InputError(f"{path}: reading PCD needs pypcd4: pip install 'facet[import]'") from None
    cloud = PointCloud.from_path(path)
    return np.asarray(cloud.numpy(("x", "y", "z")), dtype=np.float32)
