"""Who saw which tile, and when. Facts about the log, outside every digest."""

from __future__ import annotations

from collections.abc import Iterable
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


@kernel
def _tile_runs(ticks):  # type: ignore[no-untyped-def]
    """Tile keys of points (N, 3) ticks, runs of equal ones shortened to one."""
    out = np.empty(ticks.shape[0], np.int64)
    count = 0
    for p in range(ticks.shape[0]):
        key = pack(ticks[p, 0] >> 16, ticks[p, 1] >> 16, ticks[p, 2] >> 16)
        if count == 0 or out[count - 1] != key:
            out[count] = key
            count += 1
    return out[:count]


class Witness:
    """Sightings by tile key."""

    def __init__(self) -> None:
        self._sightings: dict[int, Sighting] = {}
        self._fresh: set[int] = set()

    def note(self, ticks: Ticks, scan: Scan) -> None:
        """A scan saw the tiles of its points."""
        keys = np.unique(_tile_runs(ticks.points)).tolist()
        self._fresh.update(keys)
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
