"""Beams against bounded planes, in numba: the nearest face each beam meets."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numba import njit
from numpy.typing import NDArray

from facet.simulate.surfaces import TruthSurface

Float = NDArray[np.float64]
NOTHING = -1  # the beam met no face
GLASS = -2  # the beam met glass first, and nothing came back


class Faces:
    """The surfaces of a scene as flat arrays, ready to be cast against."""

    def __init__(self, surfaces: Sequence[TruthSurface]) -> None:
        self.origin = np.array([s.origin for s in surfaces])  # (S, 3) m, world
        self.axes = np.array([[s.axis_u, s.axis_v, s.normal] for s in surfaces])  # (S, 3, 3)
        self.lower = np.array([s.outer.min(axis=0) for s in surfaces])  # (S, 2) m
        self.upper = np.array([s.outer.max(axis=0) for s in surfaces])  # (S, 2) m
        rings = [ring for s in surfaces for ring in (s.outer, *(h.ring for h in s.holes))]
        counts = [1 + len(s.holes) for s in surfaces]
        self.first_ring = np.concatenate([[0], np.cumsum(counts)])  # (S + 1,)
        self.first_vertex = np.concatenate([[0], np.cumsum([len(r) for r in rings])])
        self.vertices = np.concatenate(rings)  # (M, 2) m
        whats = [what for s in surfaces for what in ("", *(h.what for h in s.holes))]
        self.is_glass = np.array([what == "glass" for what in whats])  # one per ring

    def cast(
        self, origin: Float, directions: Float, *, two_sided: bool = False
    ) -> tuple[Float, NDArray[np.int32]]:
        """Ranges (N,) m, inf where nothing came back, and faces (N,), NOTHING or GLASS without one.

        `origin` (3,) m and unit `directions` (N, 3) in the world. Faces are met from the side of
        their normal only, unless `two_sided`.
        """
        local = np.einsum("sij,sj->si", self.axes, origin - self.origin)  # (S, 3) m, in each frame
        beyond = local[:, :2] - np.clip(local[:, :2], self.lower, self.upper)
        nearest = np.sqrt((beyond**2).sum(axis=1) + local[:, 2] ** 2)
        order = np.argsort(nearest, kind="stable")
        if not two_sided:
            order = order[local[order, 2] > 0.0]
        ranges = np.full(len(directions), np.inf)
        faces = np.full(len(directions), NOTHING, dtype=np.int32)
        _cast(
            np.ascontiguousarray(directions), order, nearest, local, self.axes, self.lower,
            self.upper, self.first_ring, self.first_vertex, self.vertices, self.is_glass,
            ranges, faces,
        )  # fmt: skip
        return ranges, faces


@njit(cache=True, nogil=True)
def _inside(vertices, first, last, u, v):  # type: ignore[no-untyped-def]
    """Even-odd rule over the ring of rows first..last."""
    inside = False
    j = last - 1
    for i in range(first, last):
        ui, vi = vertices[i]
        uj, vj = vertices[j]
        if (vi > v) != (vj > v) and u < (uj - ui) * (v - vi) / (vj - vi) + ui:
            inside = not inside
        j = i
    return inside


@njit(cache=True, nogil=True)
def _cast(  # type: ignore[no-untyped-def]
    directions, order, nearest, local, axes, lower, upper, first_ring, first_vertex, vertices,
    is_glass, ranges, faces,
):  # fmt: skip
    """Fill `ranges` and `faces`; `order` is by distance, so a beam stops at the first far face."""
    for k in range(directions.shape[0]):
        dx, dy, dz = directions[k]
        best = np.inf
        for s in order:
            if nearest[s] >= best:
                break
            a = axes[s]
            slope = a[2, 0] * dx + a[2, 1] * dy + a[2, 2] * dz
            height = local[s, 2]
            if slope * height >= 0.0:
                continue
            t = -height / slope
            if t >= best:
                continue
            u = local[s, 0] + t * (a[0, 0] * dx + a[0, 1] * dy + a[0, 2] * dz)
            if u < lower[s, 0] or u > upper[s, 0]:
                continue
            v = local[s, 1] + t * (a[1, 0] * dx + a[1, 1] * dy + a[1, 2] * dz)
            if v < lower[s, 1] or v > upper[s, 1]:
                continue
            ring = first_ring[s]
            if not _inside(vertices, first_vertex[ring], first_vertex[ring + 1], u, v):
                continue
            face = s
            for hole in range(ring + 1, first_ring[s + 1]):
                if _inside(vertices, first_vertex[hole], first_vertex[hole + 1], u, v):
                    face = -2 if is_glass[hole] else -1
                    break
            if face != -1:
                best = t
                faces[k] = face
        if faces[k] >= 0:
            ranges[k] = best
