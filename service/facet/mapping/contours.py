"""Outlines of every plane, by tile of its (u, v) frame: only dirty tiles are rolled over again."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from facet.mapping.blocks import unpack
from facet.mapping.kernel import kernel
from facet.mapping.pivot import CELLS, HALO, SIDE, boundary_edges, mark_changes
from facet.mapping.rings import Outline, surfaces_of
from facet.mapping.settings import STEPS, MapSettings
from facet.mapping.store import VoxelStore
from facet.mapping.tiles import Tile
from facet_protocol.messages import PlaneFrame

UnitNormal = tuple[int, int, int]
FRAME_UNIT = 32  # a frame's normal is rounded to 1/32 a component: it moves rarely
SIZE = CELLS * STEPS  # grid units of a (u, v) tile's edge
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
def _project(rows, blocks, block_of, local_of, observable, axis_u, axis_v, out):  # type: ignore[no-untyped-def]
    """(u, v) in grid units of voxels."""
    for m in range(rows.shape[0]):
        row = rows[m]
        i, j, k = unpack(blocks.keys[block_of[row]])
        local = local_of[row]
        seen = observable[row]
        x = 64 * i + 8 * (local & 7) + (seen & 15)
        y = 64 * j + 8 * ((local >> 3) & 7) + ((seen >> 4) & 15)
        z = 64 * k + 8 * (local >> 6) + ((seen >> 8) & 15)
        out[m, 0] = np.floor(x * axis_u[0] + y * axis_u[1] + z * axis_u[2] + 0.5)
        out[m, 1] = np.floor(x * axis_v[0] + y * axis_v[1] + z * axis_v[2] + 0.5)


@kernel
def _paint(points, corner, tile_u, tile_v, cells):  # type: ignore[no-untyped-def]
    """Set the bits of the points (N, 2), relative to a corner, that lie in a (u, v) tile."""
    left, low = corner[0] - SIZE * tile_u, corner[1] - SIZE * tile_v
    for p in range(points.shape[0]):
        u, v = left + points[p, 0], low + points[p, 1]
        if 0 <= u < SIZE and 0 <= v < SIZE:
            bit = np.uint64(1) << np.uint64((u & 7) + 8 * (v & 7))
            cells[v >> 3, u >> 3] |= bit


@kernel
def _places(points):  # type: ignore[no-untyped-def]
    """(u, v) tiles that points (N, 2) fall into, as tile_u * 2^32 + tile_v, each once."""
    seen = np.empty(64, np.int64)
    count = 0
    last = np.int64(-(2**62))
    for p in range(points.shape[0]):
        key = (np.int64(points[p, 0]) // SIZE) * (1 << 32) + np.int64(points[p, 1]) // SIZE
        if key == last:
            continue
        last = key
        known = False
        for s in range(count):
            if seen[s] == key:
                known = True
                break
        if not known and count < 64:
            seen[count] = key
            count += 1
    return seen[:count]


@dataclass(slots=True)
class Share:
    """What one tile-plane gives to its plane's outline."""

    corner: tuple[int, int]  # grid units, the least of its points
    points: NDArray[np.int16]  # (N, 2) grid units from the corner: a tile is 888 across
    places: frozenset[Place]


@dataclass(slots=True)
class Contour:
    """The outline of one plane, with what is needed to change a part of it."""

    rounded: UnitNormal
    frame: PlaneFrame
    shares: dict[tuple[int, int], Share] = field(default_factory=dict)  # by (tile key, tile-plane)
    cells: dict[Place, NDArray[np.uint64]] = field(default_factory=dict)
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

    def update(
        self,
        store: VoxelStore,
        tiles: dict[int, Tile],
        changed: set[int],
        planes: dict[int, tuple[NDArray[np.float64], list[tuple[int, int]]]],
    ) -> set[int]:
        """Bring the outlines up to date with `planes`: by id, the inside normal and the tile-planes
        (tile key, number). `changed` are the tiles whose voxels changed.

        Returns ids of the planes whose outlines changed."""
        self.rolled = 0
        for gone in self.contours.keys() - planes.keys():
            del self.contours[gone]
        different = set()
        for plane_id in sorted(planes):
            normal, members = planes[plane_id]
            rounded = round_normal(normal)
            contour = self.contours.get(plane_id)
            if contour is None or contour.rounded != rounded:
                contour = Contour(rounded, make_frame(rounded, self._voxel_m))
                self.contours[plane_id] = contour
                different.add(plane_id)
            if self._refresh(contour, store, tiles, changed, members):
                different.add(plane_id)
        return different

    def _refresh(
        self,
        contour: Contour,
        store: VoxelStore,
        tiles: dict[int, Tile],
        changed: set[int],
        members: list[tuple[int, int]],
    ) -> bool:
        stale: set[Place] = set()
        wanted = set(members)
        for member in sorted(contour.shares.keys() - wanted):
            stale |= contour.shares.pop(member).places
        for member in members:
            old = contour.shares.get(member)
            if old is not None and member[0] not in changed:
                continue
            share = self._share(contour.frame, store, tiles[member[0]], member[1])
            if old is not None:
                if old.corner == share.corner and np.array_equal(old.points, share.points):
                    continue
                stale |= old.places
            stale |= share.places
            contour.shares[member] = share
        near: dict[Place, NDArray[np.bool_]] = {}
        for place in sorted(stale):
            self._repaint(contour, place, near)
        if not near or not self._roll(contour, near):
            return False
        edges = [contour.edges[p] for p in sorted(contour.edges) if len(contour.edges[p])]
        whole = np.concatenate(edges) if edges else np.zeros((0, 4), np.int32)
        contour.outlines = surfaces_of(whole.astype(np.int64), self._least)
        return True

    def _share(self, frame: PlaneFrame, store: VoxelStore, tile: Tile, plane: int) -> Share:
        rows = tile.rows_of(plane)
        points = np.empty((len(rows), 2), np.int32)
        _project(
            rows, store.blocks, store.columns.block, store.columns.local,
            store.columns.observable, frame.axis_u, frame.axis_v, points,
        )  # fmt: skip
        keys = _places(points)
        places = frozenset(
            (int((k + (1 << 31)) >> 32), int(((k + (1 << 31)) & 0xFFFFFFFF) - (1 << 31)))
            for k in keys.tolist()
        )
        u, v = points.min(axis=0).tolist() if len(points) else (0, 0)
        return Share((u, v), (points - np.array([u, v], np.int32)).astype(np.int16), places)

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
        old = contour.cells.get(place, _NOTHING)
        if drawn:
            contour.cells[place] = cells
        else:
            contour.cells.pop(place, None)
        marked = np.zeros((SIDE, SIDE), np.bool_)
        if not mark_changes(old, cells, marked):
            return
        for b, rows, own_rows in _PARTS:
            for a, columns, own_columns in _PARTS:
                if marked[rows, columns].any():
                    other = (place[0] + a, place[1] + b)
                    wanted = near.setdefault(other, np.zeros((CELLS, CELLS), np.bool_))
                    wanted[own_rows, own_columns] |= marked[rows, columns]

    def _roll(self, contour: Contour, near: dict[Place, NDArray[np.bool_]]) -> bool:
        """Find the boundary edges that start in the cells `near` again. Whether any changed."""
        places = sorted(near.keys() & (contour.cells.keys() | contour.edges.keys()))
        self.rolled += len(places)
        windows = np.zeros((len(places), SIDE, SIDE), np.uint64)
        for window, place in zip(windows, places, strict=True):
            self._fill(window, contour, place)
        wanted = np.array([near[place] for place in places]).reshape(-1, CELLS, CELLS)
        moved = False
        for place, new in zip(places, boundary_edges(windows, wanted), strict=True):
            corner = np.tile(np.array(place, np.int32) * SIZE, 2)
            old = contour.edges.get(place, _NO_EDGES)
            u, v = (old[:, :2] - corner[:2]).T // STEPS
            stays = ~near[place][v, u]
            edges = np.concatenate([old[stays], new + corner])
            edges = edges[np.lexsort(edges.T)]
            moved |= not np.array_equal(old, edges)
            contour.edges[place] = edges
        return moved

    @staticmethod
    def _fill(window: NDArray[np.uint64], contour: Contour, place: Place) -> None:
        """Copy a tile and its halo into a window."""
        for b, rows, own_rows in _PARTS:
            for a, columns, own_columns in _PARTS:
                cells = contour.cells.get((place[0] + a, place[1] + b))
                if cells is not None:
                    window[rows, columns] = cells[own_rows, own_columns]


_NOTHING = np.zeros((CELLS, CELLS), np.uint64)
_NO_EDGES = np.zeros((0, 4), np.int32)
_PARTS = (  # of a window: which tile, where in the window, and where in that tile
    (-1, slice(0, HALO), slice(CELLS - HALO, CELLS)),
    (0, slice(HALO, HALO + CELLS), slice(0, CELLS)),
    (1, slice(HALO + CELLS, 2 * HALO + CELLS), slice(0, HALO)),
)
