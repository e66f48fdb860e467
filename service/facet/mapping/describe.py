"""Planes as users see them: figures, outlines, holes with their kind, lasting surface ids."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from facet.mapping.contours import Contour
from facet.mapping.fitting import Fit
from facet.mapping.freespace import FreeSpace, blocks_of
from facet.mapping.openings import hole_kind, probes, samples
from facet.mapping.rings import Outline
from facet.mapping.settings import MapSettings
from facet.mapping.witness import Sighting
from facet_protocol.messages import Hole, HoleKind, Plane, Surface

SAME_SURFACE_M = 1.0  # centres of one surface in two updates are no farther apart


class Figures(NamedTuple):
    """What a plane's description is made of, besides its contour."""

    fit: Fit
    num_points: int
    num_voxels: int
    centroid: NDArray[np.float64]  # (3,) m
    sighting: Sighting


class Told(NamedTuple):
    """The figures of an update, and what they were made of."""

    ids: NDArray[np.int64]  # (K,)
    data: NDArray[np.float64]  # (K, ...)
    figures: dict[int, Figures]  # by plane id

    @classmethod
    def nothing(cls) -> Told:
        return cls(np.zeros(0, np.int64), np.zeros((0, 1)), {})

    def differ(self, ids: NDArray[np.int64], data: NDArray[np.float64]) -> NDArray[np.bool_]:
        """(K,) whether the planes of these ids were not there, or made of other data."""
        different = np.ones(len(ids), np.bool_)
        _, now, before = np.intersect1d(ids, self.ids, assume_unique=True, return_indices=True)
        if len(now):
            different[now] = np.any(data[now] != self.data[before], axis=1)
        return different


@dataclass(slots=True)
class _Entry:
    own: Figures
    key: tuple[bytes, ...]
    outlines: list[Outline]
    samples: list[list[NDArray[np.float64]]]  # by outline and hole
    probes: list[list[NDArray[np.int64]]]  # the same, lifted to the plane
    blocks: set[int]  # of free space, where these lie
    kinds: list[list[HoleKind]]
    plane: Plane

    def is_of(self, contour: Contour) -> bool:
        """Whether the contour is as it was."""
        return self.outlines is contour.outlines


class Describer:
    """Keeps the description of every plane, and says which changed."""

    def __init__(self, settings: MapSettings) -> None:
        self._settings = settings
        self._entries: dict[int, _Entry] = {}
        self._holed: defaultdict[int, set[int]] = defaultdict(set)  # planes with holes there, by
        # block of free space
        self._then = 0  # when free space was last looked at
        self._next_surface = 1

    @property
    def planes(self) -> list[Plane]:
        """All planes, by ascending id."""
        return [self._entries[i].plane for i in sorted(self._entries)]

    @property
    def next_surface(self) -> int:
        """The id of the next new surface."""
        return self._next_surface

    def restore(self, known: Mapping[int, tuple[int, list[int]]], next_surface: int) -> None:
        """Give planes just described the revisions and surface ids that they had, by plane id.

        Raises ValueError where they are others."""
        if known.keys() != self._entries.keys():
            raise ValueError(f"{len(known)} planes were described, now {len(self._entries)}")
        for plane_id, (revision, ids) in known.items():
            entry = self._entries[plane_id]
            surfaces = zip(entry.plane.surfaces, ids, strict=True)
            kept = tuple(replace(surface, id=i) for surface, i in surfaces)
            entry.plane = replace(entry.plane, revision=revision, surfaces=kept)
        self._next_surface = next_surface

    def __getitem__(self, plane_id: int) -> Plane:
        return self._entries[plane_id].plane

    def update(
        self, figures: dict[int, Figures], contours: dict[int, Contour], free: FreeSpace
    ) -> list[int]:
        """Describe all planes again where anything changed. Returns the changed ids, ascending."""
        for gone in self._entries.keys() - figures.keys():
            self._forget(gone)
        passed = (self._holed.get(key, set()) for key in free.passed_since(self._then))
        again = set[int]().union(*passed)
        self._then = free.now - 1
        for plane_id, own in figures.items():
            old = self._entries.get(plane_id)
            if old is None or old.own is not own or not old.is_of(contours[plane_id]):
                again.add(plane_id)
        return [i for i in sorted(again) if self._refresh(i, figures[i], contours[i], free)]

    def _forget(self, plane_id: int) -> None:
        for block in self._entries.pop(plane_id).blocks:
            self._holed[block].discard(plane_id)
            if not self._holed[block]:
                del self._holed[block]

    def _refresh(self, plane_id: int, own: Figures, contour: Contour, free: FreeSpace) -> bool:
        old = self._entries.get(plane_id)
        drawn = old if old is not None and old.is_of(contour) else None
        key = drawn.key if drawn is not None and drawn.own is own else _key(own, contour)
        same = drawn if drawn is not None and drawn.key == key else None
        points = drawn.samples if drawn is not None else _samples(contour, old)
        found = same.probes if same is not None else self._lift(points, own.fit, contour)
        kinds = [[hole_kind(p, free, self._settings) for p in holes] for holes in found]
        if same is not None and same.kinds == kinds:
            same.own = own
            return False
        blocks = same.blocks if same is not None else _blocks(found)
        revision = old.plane.revision + 1 if old is not None else 1
        surfaces = self._surfaces(contour, kinds, old)
        plane = _plane(plane_id, revision, own, contour, surfaces)
        if old is not None and same is None:
            self._forget(plane_id)
        for block in blocks:
            self._holed[block].add(plane_id)
        self._entries[plane_id] = _Entry(
            own, key, contour.outlines, points, found, blocks, kinds, plane
        )
        return True

    def _lift(
        self, points: list[list[NDArray[np.float64]]], fit: Fit, contour: Contour
    ) -> list[list[NDArray[np.int64]]]:
        on = contour.frame, fit.inside, fit.offset_m, self._settings
        return [[probes(own, *on) for own in holes] for holes in points]

    def _surfaces(
        self, contour: Contour, kinds: list[list[HoleKind]], old: _Entry | None
    ) -> tuple[Surface, ...]:
        step2 = contour.frame.step_m**2
        ids = self._surface_ids(contour, old)
        return tuple(
            Surface(
                id=surface_id,
                area_m2=outline.area * step2,
                outer=outline.outer,
                holes=tuple(
                    Hole(kind, ring) for kind, ring in zip(own, outline.holes, strict=True)
                ),
            )
            for surface_id, outline, own in zip(ids, contour.outlines, kinds, strict=True)
        )

    def _surface_ids(self, contour: Contour, old: _Entry | None) -> list[int]:
        """The nearest surface of the last description keeps its id, largest first."""
        if old is not None and old.is_of(contour):
            return [surface.id for surface in old.plane.surfaces]
        ids = [0] * len(contour.outlines)
        if old is not None:
            before = [(s.id, _centre(s.outer, old.plane.frame)) for s in old.plane.surfaces]
            now = [_centre(o.outer, contour.frame) for o in contour.outlines]
            order = sorted(
                (float(np.linalg.norm(c - b)), surface_id, index)
                for surface_id, b in before
                for index, c in enumerate(now)
            )
            taken = set()
            for distance, surface_id, index in order:
                if distance <= SAME_SURFACE_M and not ids[index] and surface_id not in taken:
                    ids[index] = surface_id
                    taken.add(surface_id)
        for index, known in enumerate(ids):
            if not known:
                ids[index] = self._next_surface
                self._next_surface += 1
        return ids


def _samples(contour: Contour, old: _Entry | None) -> list[list[NDArray[np.float64]]]:
    """Samples of the holes, taken again where no hole was the same before."""
    known = dict[bytes, NDArray[np.float64]]()
    for outline, own in zip(old.outlines, old.samples, strict=True) if old is not None else ():
        known.update(zip((hole.tobytes() for hole in outline.holes), own, strict=True))
    return [
        [known[k] if (k := hole.tobytes()) in known else samples(hole) for hole in outline.holes]
        for outline in contour.outlines
    ]


def _blocks(probes: list[list[NDArray[np.int64]]]) -> set[int]:
    """Blocks of free space that the probes of holes lie in."""
    each = (blocks_of(own).tolist() for holes in probes for own in holes)
    return set[int]().union(*each)


def _centre(ring: NDArray[np.int32], frame: object) -> NDArray[np.float64]:
    """Middle of a ring's box in the frame, lifted to no plane: good enough to compare."""
    middle = (ring.min(axis=0) + ring.max(axis=0)) / 2.0 * frame.step_m  # type: ignore[attr-defined]
    return np.asarray(middle[0] * frame.axis_u + middle[1] * frame.axis_v)  # type: ignore[attr-defined]


def _key(own: Figures, contour: Contour) -> tuple[bytes, ...]:
    fit, seen = own.fit, own.sighting
    return (
        fit.inside.tobytes(),
        np.array([fit.offset_m, fit.sigma_n_m, fit.thickness_angle_deg]).tobytes(),
        fit.covariance.tobytes(),
        own.centroid.tobytes(),
        repr(
            (own.num_points, own.num_voxels, contour.rounded, seen.first_ns, seen.last_ns)
        ).encode(),
        repr(sorted(seen.robots)).encode(),  # a set has an order of its own in every process
    )


def _plane(
    plane_id: int, revision: int, own: Figures, contour: Contour, surfaces: tuple[Surface, ...]
) -> Plane:
    fit = own.fit
    return Plane(
        id=plane_id,
        revision=revision,
        plane_class=fit.plane_class,
        normal=fit.normal,
        d=fit.d,
        facing=fit.facing,
        sigma_n_m=fit.sigma_n_m,
        thickness_angle_deg=fit.thickness_angle_deg,
        covariance=fit.covariance,
        num_points=own.num_points,
        num_voxels=own.num_voxels,
        centroid=own.centroid,
        rms_m=fit.sigma_n_m,
        frame=contour.frame,
        surfaces=surfaces,
        first_seen_ns=own.sighting.first_ns,
        last_seen_ns=own.sighting.last_ns,
        robots=tuple(sorted(own.sighting.robots)),
    )
