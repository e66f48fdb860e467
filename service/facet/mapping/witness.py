"""Who saw which tile, and when. Facts about the log, outside every digest."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from facet.mapping.blocks import pack
from facet.mapping.kernel import kernel
from facet.mapping.quantise import Ticks
from facet_protocol.messages import Scan


@dataclass(slots=True)
class Sighting:
    """First and last stamp, and the robots."""

    first_ns: int
    last_ns: int
    robots: set[str] = field(default_factory=set)


@kernel(allocates=False)
def _tile_runs(points, starts, out, ends):  # type: ignore[no-untyped-def]
    """Tile keys of points (N, 3) ticks of scans that begin at starts (S + 1,), runs of equal ones
    shortened to one, into out (N,): those of each scan up to ends (S,)."""
    count = 0
    for s in range(ends.shape[0]):
        last = np.int64(-1)
        for p in range(starts[s], starts[s + 1]):
            key = pack(points[p, 0] >> 16, points[p, 1] >> 16, points[p, 2] >> 16)
            if key != last:
                out[count] = last = key
                count += 1
        ends[s] = count


class Witness:
    """Sightings by tile key."""

    def __init__(self) -> None:
        self._sightings: dict[int, Sighting] = {}
        self._fresh: set[int] = set()

    def note(self, ticks: Ticks, scans: Sequence[Scan]) -> None:
        """Scans saw the tiles of their points."""
        runs, ends = np.empty(len(ticks.points), np.int64), np.empty(len(scans), np.int64)
        _tile_runs(ticks.points, ticks.starts, runs, ends)
        start = 0
        for scan, end in zip(scans, ends.tolist(), strict=True):
            self._see(set(runs[start:end].tolist()), scan)
            start = end

    def _see(self, keys: set[int], scan: Scan) -> None:
        """A scan saw these tiles."""
        self._fresh |= keys
        for key in keys:
            seen = self._sightings.get(key)
            if seen is None:
                self._sightings[key] = Sighting(scan.stamp_ns, scan.stamp_ns, {scan.robot})
                continue
            seen.first_ns = min(seen.first_ns, scan.stamp_ns)
            seen.last_ns = max(seen.last_ns, scan.stamp_ns)
            seen.robots.add(scan.robot)

    def fresh(self) -> NDArray[np.int64]:
        """Tiles that were seen since it was asked this last."""
        keys = np.array(sorted(self._fresh), np.int64)
        self._fresh.clear()
        return keys

    def items(self) -> list[tuple[int, Sighting]]:
        """Sightings by tile, ascending."""
        return sorted(self._sightings.items())

    def restore(self, sightings: dict[int, Sighting]) -> None:
        """Go on from `items`."""
        self._sightings = sightings

    def of(self, tile_keys: Iterable[int]) -> Sighting:
        """What was seen of a set of tiles."""
        seen = [self._sightings[k] for k in tile_keys if k in self._sightings]
        if not seen:
            return Sighting(0, 0)
        return Sighting(
            min(s.first_ns for s in seen),
            max(s.last_ns for s in seen),
            set().union(*(s.robots for s in seen)),
        )
