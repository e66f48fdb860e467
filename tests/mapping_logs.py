"""Small logs of scans for tests of the core, and the laws that any log must keep.

A law takes a log and raises AssertionError where the core breaks it: `test_exactness` holds the
core to the laws, `test_mutants` holds the laws to broken cores."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from functools import cache

import numpy as np
from numpy.typing import NDArray

from facet.mapping.digest import Digest
from facet.mapping.mapper import Mapper
from facet.mapping.quantise import Ticks
from facet.mapping.settings import MapSettings
from facet.simulate import simulate
from facet_protocol.maps import encode_update
from facet_protocol.messages import MapUpdate, Pose, Scan, ScanKind
from facet_protocol.mirror import MapMirror
from scenes import driven, recorded, small

SIMULATED = {
    "room-lidar3d": ("room", "lidar3d", 10, 0.05),
    "room-pushbroom": ("room", "pushbroom", 48, 0.1),
    "room-depth": ("room", "depth", 12, 0.05),
}
LOGS = (*SIMULATED, "office-lidar3d", "real-corridor")


NOBODY, ORIGIN = np.zeros((0, 3), np.int64), np.zeros(3, np.int64)


@dataclass(frozen=True, eq=False)
class Log:
    """Scans, and the settings they are mapped with."""

    scans: tuple[Scan, ...]
    settings: MapSettings

    def shuffled(self, seed: int) -> Log:
        order = np.random.default_rng(seed).permutation(len(self.scans))
        return replace(self, scans=tuple(self.scans[i] for i in order))

    def split(self, seed: int, share: float) -> tuple[Log, Log]:
        """Two logs of a random part of the scans and of the others, in order."""
        first = np.random.default_rng(seed).random(len(self.scans)) < share
        one = tuple(s for s, of in zip(self.scans, first, strict=True) if of)
        two = tuple(s for s, of in zip(self.scans, first, strict=True) if not of)
        return replace(self, scans=one), replace(self, scans=two)


@cache
def log(name: str) -> Log:
    """One of LOGS: a few thousand points a scan, ten to fifty scans."""
    if name == "real-corridor":
        kept = [s for k, s in enumerate(recorded("corridor", 60)) if k % 5 == 0]
        thin = tuple(replace(s, points=s.points[::4]) for s in kept)
        return Log(thin, MapSettings(voxel_m=0.08))
    if name == "office-lidar3d":  # the first metres of the drive
        scans = simulate("office", small("lidar3d"), duration_s=1.2)
        return Log(tuple(scans), MapSettings(voxel_m=0.1))
    scene, sensor, count, voxel_m = SIMULATED[name]
    return Log(driven(scene, sensor, count).scans, MapSettings(voxel_m=voxel_m))


def cloud(
    points: NDArray[np.floating],
    *,
    at: Sequence[float] = (0.0, 0.0, 0.0),
    no_return: NDArray[np.floating] | None = None,
    kind: ScanKind = ScanKind.CLOUD,
    sequence: int = 1,
) -> Scan:
    """A scan of world points (N, 3) m seen from `at`, the sensor's axes along the world's."""
    position = np.array(at, np.float64)
    ends = np.zeros((0, 3)) if no_return is None else no_return
    return Scan(
        "robot", "sensor", 1, sequence, sequence * 100_000_000, "map", kind,
        Pose(position, np.array([0.0, 0.0, 0.0, 1.0])),
        (points - position).astype(np.float32), (ends - position).astype(np.float32).reshape(-1, 3),
    )  # fmt: skip


def ticks_of_one(
    points: NDArray[np.integer],
    views: NDArray[np.integer],
    beams: NDArray[np.integer] = NOBODY,
    sensor: NDArray[np.integer] = ORIGIN,
    pose_hash: int = -1,
) -> Ticks:
    """One scan in ticks."""
    starts, beam_starts = np.array([0, len(points)]), np.array([0, len(beams)])
    hashes = np.array([pose_hash])
    return Ticks(points, views, starts, beams, beam_starts, sensor[None], hashes, ({},))


def wall(
    rng: np.random.Generator, count: int, size: tuple[float, float], sigma: float = 0.0
) -> NDArray[np.float64]:
    """Points (N, 3) m of the wall x = 2.03, from y, z = 0.5 on, `size` wide and high."""
    y, z = 0.5 + rng.random(count) * size[0], 0.5 + rng.random(count) * size[1]
    return np.stack([2.03 + sigma * rng.normal(size=count), y, z], axis=1)


def mapped(scans: Iterable[Scan], settings: MapSettings | None = None, *, every: int = 0) -> Mapper:
    """A map of the scans: derived at the end, and after each `every` scans if that is not 0."""
    mapper = Mapper(settings)
    for number, scan in enumerate(scans, start=1):
        mapper.insert(scan)
        if every and number % every == 0:
            mapper.update()
    mapper.update()
    return mapper


@cache
def truth_of(name: str) -> Digest:
    """Digests of a log mapped at once."""
    whole = log(name)
    return mapped(whole.scans, whole.settings).digest()


def keeps_order(one: Log, *, every: int, seed: int, expected: Digest | None = None) -> Mapper:
    """Any order of scans and any batching give the same map."""
    told = expected or mapped(one.scans, one.settings).digest()
    mapper = mapped(one.shuffled(seed).scans, one.settings, every=every)
    assert mapper.digest() == told, f"order {seed} with an update every {every} gives another map"
    return mapper


def undoes(one: Log, *, seed: int, share: float = 0.4) -> Mapper:
    """Scans inserted and taken out again, with updates in between, were never there."""
    rng = np.random.default_rng(seed)
    gone, kept = one.split(seed, share)
    mapper = Mapper(one.settings)
    for scan in one.shuffled(seed).scans:
        mapper.insert(scan)
        if rng.random() < 0.4:
            mapper.update()
    for scan in gone.shuffled(seed + 1).scans:
        mapper.retract(scan)
        if rng.random() < 0.4:
            mapper.update()
    mapper.update()
    told = mapped(kept.scans, one.settings).digest()
    assert mapper.digest() == told, f"{len(gone.scans)} scans taken out left a trace"
    return mapper


def stream(scans: Iterable[Scan], settings: MapSettings, *, every: int = 1) -> list[MapUpdate]:
    """The updates of a run."""
    mapper, updates = Mapper(settings), []
    for number, scan in enumerate(scans, start=1):
        mapper.insert(scan)
        if number % every == 0:
            updates.append(mapper.update())
    return [*updates, mapper.update()]


def folds(one: Log, *, every: int) -> None:
    """A client that folds the updates holds the mapper's snapshot, byte for byte, at every step."""
    mapper, mirror = Mapper(one.settings), MapMirror()
    for number, scan in enumerate(one.scans, start=1):
        mapper.insert(scan)
        if number % every == 0:
            assert mirror.apply(mapper.update()), "an update leaves a gap"
            told, known = encode_update(mapper.snapshot()), encode_update(mirror.snapshot())
            assert told == known, f"mirror and map differ at revision {mapper.revision}"
