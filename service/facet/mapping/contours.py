"""Outlines of every plane, by tile of its (u, v) frame: only dirty tiles are rolled over again."""

from __future__ import annotations

from collections import defaultdict
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
from numba import prange
from numpy.typing import NDArray

from facet.mapping.kernel import kernel
from facet.mapping.pivot import CELLS, HALO, SIDE, boundary_edges, mark_changes
from facet.mapping.rings import Outline, surfaces_of
from facet.mapping.runs import deal, starts_of
from facet.mapping.settings import STEPS, MapSettings
from facet.mapping.store import VoxelStore, centroid
from facet.mapping.tile import Tile
from facet_protocol.messages import PlaneFrame

UnitNormal = tuple[int, int, int]
FRAME_UNIT = 32  # a frame's normal is rounded to 1/32 a component: it moves rarely
SIZE = CELLS * STEPS  # grid units of a (u, v) tile's edge
PLACES = 64  # (u, v) tiles that a tile-plane falls into, at most
Place = tuple[int, int]  # of a (u, v) tile


def round_normal(normal: NDArray[np.float64]) -> UnitNormal:
    """The integers that name a plane's frame."""
    n = np.floor(normal * FRAME_UNIT + 0.5).astype(int)
    return int(n[0]), int(n[1]), int(n[2])


def make_frame(rounded: UnitNormal, voxel_m: float) -> PlaneFrame:
    """Axes from a rounded normal: u level wherever the plane is not."""
    n = np.array(rounded, np.float64)
    n /= np.sqrt(n @ n)
    up = np.array([0.0, 0.0, 1.0]) if abs(n[2]) < 0.9 else np.array([0.0, 1.0, 0.0])
    u = np.cross(up, n)
    u /= np.sqrt(u @ u)
    return PlaneFrame(axis_u=u, axis_v=np.cross(n, u), axis_n=n, step_m=voxel_m / STEPS)


@kernel
def _project(rows, blocks, columns, axes, out):  # type: ignore[no-untyped-def]
    """(u, v) in grid units of voxels, into out (N, 2)."""
    for m in range(rows.shape[0]):
        x, y, z = centroid(blocks, columns, rows[m])
        out[m, 0] = np.floor(x * axes[0, 0] + y * axes[0, 1] + z * axes[0, 2] + 0.5)
        out[m, 1] = np.floor(x * axes[1, 0] + y * axes[1, 1] + z * axes[1, 2] + 0.5)


@kernel
def _put(places, words, row, column, window):  # type: ignore[no-untyped-def]
    """Copy the cells of a tile that begins at (row, column) of a window, as far as they lie in
    it."""
    for n in range(places.shape[0]):
        r, c = row + (places[n] >> 6), column + (places[n] & 63)
        if 0 <= r < window.shape[0] and 0 <= c < window.shape[1]:
            window[r, c] = words[n]


@kernel
def _share(uv, points, corner, places):  # type: ignore[no-untyped-def]
    """Points (N, 2) from their least corner, given as (N, 2) uv, and the (u, v) tiles that they
    fall into, as tile_u * 2^32 + tile_v, each once. Returns how many tiles."""
    corner[0], corner[1] = uv[0, 0], uv[0, 1]
    count, last = 0, np.int64(-(2**62))
    for p in range(uv.shape[0]):
        corner[0], corner[1] = min(corner[0], uv[p, 0]), min(corner[1], uv[p, 1])
        key = (np.int64(uv[p, 0]) // SIZE) * (1 << 32) + np.int64(uv[p, 1]) // SIZE
        if key == last:
            continue
        last = key
        known = False
        for s in range(count):
            known |= places[s] == key
        if not known and count < PLACES:
            places[count] = key
            count += 1
    for p in range(uv.shape[0]):
        points[p, 0], points[p, 1] = uv[p, 0] - corner[0], uv[p, 1] - corner[1]
    return count


@kernel(parallel=True)
def _share_all(  # type: ignore[no-untyped-def]
    rows, starts, parts, blocks, columns, axes, points, corners, places, num_places
):
    """`_share` of S tile-planes, whose rows begin at starts (S + 1,), in frames with axes
    (S, 2, 3). parts: tile-planes that each thread begins with."""
    for part in prange(parts.shape[0] - 1):
        for s in range(parts[part], parts[part + 1]):
            low, high = starts[s], starts[s + 1]
            num_places[s] = 0
            if low < high:
                uv = np.empty((high - low, 2), np.int32)
                _project(rows[low:high], blocks, columns, axes[s], uv)
                num_places[s] = _share(uv, points[low:high], corners[s], places[s])


@kernel
def _paint(points, corner, tile_u, tile_v, cells):  # type: ignore[no-untyped-def]
    """Set the bits of the points (N, 2), relative to a corner, that lie in a (u, v) tile."""
    left, low = corner[0] - SIZE * tile_u, corner[1] - SIZE * tile_v
    for p in range(points.shape[0]):
        u, v = left + points[p, 0], low + points[p, 1]
        if 0 <= u < SIZE and 0 <= v < SIZE:
            bit = np.uint64(1) << np.uint64((u & 7) + 8 * (v & 7))
            cells[v >> 3, u >> 3] |= bit


class Cells(NamedTuple):
    """The cells of a (u, v) tile that hold points."""

    places: NDArray[np.int16]  # (N,) column + CELLS * row, ascending
    words: NDArray[np.uint64]  # (N,) a bit u + 8 v for each grid point


class Share(NamedTuple):
    """What one tile-plane gives to its plane's outline."""

    corner: Place  # grid units, the least of its points
    points: NDArray[np.int16]  # (N, 2) grid units from the corner: a tile is 888 across
    places: frozenset[Place]


@dataclass(slots=True)
class Contour:
    """The outline of one plane, with what is needed to change a part of it."""

    rounded: UnitNormal
    frame: PlaneFrame
    shares: dict[tuple[int, int], Share] = field(default_factory=dict)  # by (tile key, tile-plane)
    cells: dict[Place, Cells] = field(default_factory=dict)
    edges: dict[Place, NDArray[np.int32]] = field(default_factory=dict)
    outlines: list[Outline] = field(default_factory=list)


class ContourField:
    """Contours by plane id. An id only names a cache entry: every outline is a pure function of
    the plane's frame and voxels."""

    def __init__(self, settings: MapSettings) -> None:
        self._voxel_m = settings.voxel_m
        self._least = settings.min_surface_m2 / (settings.voxel_m / STEPS) ** 2
        self.contours: dict[int, Contour] = {}
        self.rolled = 0  # (u, v) tiles rolled over in the last update
        self._owners: dict[int, list[tuple[int, int]]] = {}  # by tile key: plane id, tile-plane

    def update(
        self,
        store: VoxelStore,
        tiles: dict[int, Tile],
        changed: set[int],
        normals: dict[int, NDArray[np.float64]],
    ) -> set[int]:
        """Bring the outlines up to date with the planes, whose inside normals these are, by id.
        `changed` are the tiles whose voxels, or plane ids, changed.

        Returns ids of the planes whose outlines changed."""
        for gone in self.contours.keys() - normals.keys():
            del self.contours[gone]
        wanted = self._reframe(normals, changed)
        stale: defaultdict[int, set[Place]] = defaultdict(set)
        for key in sorted(changed):
            tile = tiles[key]
            ids = tile.ids.tolist() if tile.num_planes else []
            stays = [(i, t) for t, i in enumerate(ids) if i]
            for plane_id, t in set(self._owners.get(key, ())) - set(stays):
                contour = self.contours.get(plane_id)
                share = contour.shares.pop((key, t), None) if contour else None
                if share is not None:
                    stale[plane_id] |= share.places
            self._owners[key] = stays
            wanted.extend((plane_id, key, t) for plane_id, t in stays)
        for (plane_id, key, t), share in zip(
            wanted, self._shares(store, tiles, wanted), strict=True
        ):
            stale[plane_id] |= _exchange(self.contours[plane_id].shares, (key, t), share)
        return self._redraw(stale)

    def _reframe(
        self, normals: dict[int, NDArray[np.float64]], changed: set[int]
    ) -> list[tuple[int, int, int]]:
        """Begin the contours of planes that are new, or whose frame turned. Returns (plane id, tile
        key, tile-plane) of what these had in tiles other than `changed`."""
        again = []
        for plane_id, normal in normals.items():
            rounded, contour = round_normal(normal), self.contours.get(plane_id)
            if contour is None or contour.rounded != rounded:
                old = contour.shares if contour else {}
                again += [(plane_id, key, t) for key, t in old if key not in changed]
                frame = make_frame(rounded, self._voxel_m)
                self.contours[plane_id] = Contour(rounded, frame)
        return again

    def _shares(
        self, store: VoxelStore, tiles: dict[int, Tile], wanted: list[tuple[int, int, int]]
    ) -> list[Share]:
        """What tile-planes give to the outlines of their planes."""
        own = [tiles[key].rows_of(t) for _, key, t in wanted]
        starts = starts_of([len(rows) for rows in own])
        rows = np.concatenate([np.zeros(0, np.int32), *own])
        frames = [self.contours[plane_id].frame for plane_id, _, _ in wanted]
        axes = np.array([(f.axis_u, f.axis_v) for f in frames], float).reshape(-1, 2, 3)
        points = np.empty((len(rows), 2), np.int16)
        corners = np.zeros((len(wanted), 2), np.int32)
        places, counts = np.empty((len(wanted), PLACES), np.int64), np.empty(len(wanted), np.int64)
        _share_all(
            rows, starts, deal(starts), store.blocks, store.columns, axes, points, corners, places,
            counts,
        )  # fmt: skip
        ends = starts.tolist()
        return [
            Share((u, v), points[low:high], _places(keys[:count]))
            for (u, v), low, high, keys, count in zip(
                corners.tolist(), ends, ends[1:], places.tolist(), counts.tolist(), strict=False
            )
        ]

    def _redraw(self, stale: dict[int, set[Place]]) -> set[int]:
        """Draw the (u, v) tiles of planes again. Returns the planes whose outlines changed."""
        near: dict[tuple[int, Place], NDArray[np.bool_]] = {}
        for plane_id, places in stale.items():
            own: dict[Place, NDArray[np.bool_]] = {}
            contour = self.contours[plane_id]
            for place in sorted(places):
                self._repaint(contour, place, own)
            held = contour.cells.keys() | contour.edges.keys()
            near.update({(plane_id, place): own[place] for place in sorted(own.keys() & held)})
        different = self._roll(near)
        for plane_id in different:
            contour = self.contours[plane_id]
            edges = [contour.edges[p] for p in sorted(contour.edges) if len(contour.edges[p])]
            whole = np.concatenate(edges) if edges else np.zeros((0, 4), np.int32)
            contour.outlines = surfaces_of(whole.astype(np.int64), self._least)
        return different

    def _repaint(
        self, contour: Contour, place: Place, near: dict[Place, NDArray[np.bool_]]
    ) -> None:
        """Draw a (u, v) tile again from all shares, and mark in `near`, by tile, the cells whose
        edges may have changed by it."""
        cells = np.zeros((CELLS, CELLS), np.uint64)
        drawn = False
        for share in contour.shares.values():
            if place in share.places:
                _paint(share.points, share.corner, place[0], place[1], cells)
                drawn = True
        old = np.zeros((CELLS, CELLS), np.uint64)
        if place in contour.cells:
            _put(*contour.cells.pop(place), 0, 0, old)
        if drawn:
            filled = np.flatnonzero(cells)
            contour.cells[place] = Cells(filled.astype(np.int16), cells.ravel()[filled])
        marked = np.zeros((SIDE, SIDE), np.bool_)
        if not mark_changes(old, cells, marked):
            return
        for b, rows, own_rows in _PARTS:
            for a, columns, own_columns in _PARTS:
                if marked[rows, columns].any():
                    other = (place[0] + a, place[1] + b)
                    wanted = near.setdefault(other, np.zeros((CELLS, CELLS), np.bool_))
                    wanted[own_rows, own_columns] |= marked[rows, columns]

    def _roll(self, near: dict[tuple[int, Place], NDArray[np.bool_]]) -> set[int]:
        """Find again the boundary edges that start in the cells `near`, by plane id and (u, v)
        tile. Returns the planes that have others now."""
        self.rolled = len(near)
        windows = np.zeros((len(near), SIDE, SIDE), np.uint64)
        for window, (plane_id, place) in zip(windows, near, strict=True):
            self._fill(window, self.contours[plane_id], place)
        wanted = np.array(list(near.values()), np.bool_).reshape(-1, CELLS, CELLS)
        different = set()
        for (plane_id, place), cells, new in zip(
            near, wanted, boundary_edges(windows, wanted), strict=True
        ):
            contour = self.contours[plane_id]
            corner = np.tile(np.array(place, np.int32) * SIZE, 2)
            old = contour.edges.get(place, _NO_EDGES)
            u, v = (old[:, :2] - corner[:2]).T // STEPS
            edges = np.concatenate([old[~cells[v, u]], new + corner])
            edges = edges[np.lexsort(edges.T)]
            if not np.array_equal(old, edges):
                different.add(plane_id)
            contour.edges[place] = edges
        return different

    @staticmethod
    def _fill(window: NDArray[np.uint64], contour: Contour, place: Place) -> None:
        """Copy a tile and its halo into a window."""
        for b in (-1, 0, 1):
            for a in (-1, 0, 1):
                cells = contour.cells.get((place[0] + a, place[1] + b))
                if cells is not None:
                    _put(*cells, HALO + CELLS * b, HALO + CELLS * a, window)


def _places(keys: list[int]) -> frozenset[Place]:
    return frozenset(((k + _HALF) >> 32, ((k + _HALF) & 0xFFFFFFFF) - _HALF) for k in keys)


def _exchange(
    shares: dict[tuple[int, int], Share], member: tuple[int, int], share: Share
) -> frozenset[Place]:
    """Put in a share for another. Returns the (u, v) tiles that look different now."""
    old = shares.get(member)
    if old is not None and old.corner == share.corner and np.array_equal(old.points, share.points):
        return frozenset()
    shares[member] = share._replace(points=share.points.copy())  # not all that came with it
    return share.places | (old.places if old is not None else frozenset())


_HALF = 1 << 31
_NO_EDGES = np.zeros((0, 4), np.int32)
_PARTS = (  # of a window: which tile, where in the window, and where in that tile
    (-1, slice(0, HALO), slice(CELLS - HALO, CELLS)),
    (0, slice(HALO, HALO + CELLS), slice(0, CELLS)),
    (1, slice(HALO + CELLS, 2 * HALO + CELLS), slice(0, HALO)),
)
