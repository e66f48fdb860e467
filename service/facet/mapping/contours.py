"""Outlines of every plane, by tile of its (u, v) frame: only dirty tiles are rolled over again."""

from __future__ import annotations

import itertools
from collections import defaultdict
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from facet.mapping.cells import (
    AROUND,
    PLACES,
    Cells,
    Share,
    fill_windows,
    part_of,
    repaint,
    replace_edges,
    share_all,
)
from facet.mapping.ends import before_end
from facet.mapping.pivot import CELLS, SIDE, boundary_edges
from facet.mapping.rings import Outline, surfaces_of
from facet.mapping.runs import deal, starts_of
from facet.mapping.settings import STEPS, MapSettings
from facet.mapping.store import VoxelStore
from facet.mapping.tile import Tile
from facet_protocol.messages import PlaneFrame

UnitNormal = tuple[int, int, int]
TILES_AT_ONCE = 128  # (u, v) tiles that are rolled over before the next: as many as caches hold
FRAME_UNIT = 32  # a frame's normal is rounded to 1/32 a component: it moves rarely
Place = int  # of a (u, v) tile
Member = tuple[int, int]  # tile key, stamp of a tile-plane there
Drawn = tuple[int, Place]  # plane id, (u, v) tile
Wanted = tuple[int, int, int, int]  # plane id, tile key, stamp, tile-plane
Cuts = dict[tuple[int, int], tuple[tuple[int, ...], ...]]  # of a tile-plane: see `ends`
Members = tuple[NDArray[np.int32], NDArray[np.int32], NDArray[np.int16]]  # of a tile-plane: rows,
# blocks of its runs, and voxels in each


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


@dataclass(slots=True)
class Contour:
    """The outline of one plane, with what is needed to change a part of it."""

    rounded: UnitNormal
    frame: PlaneFrame
    shares: dict[Member, Share] = field(default_factory=dict)
    drawn: dict[Place, set[Member]] = field(default_factory=dict)  # whose shares fall there
    cells: dict[Place, Cells] = field(default_factory=dict)
    edges: dict[Place, NDArray[np.int32]] = field(default_factory=dict)
    outlines: list[Outline] = field(default_factory=list)
    normal: NDArray[np.float64] | None = None  # that was rounded last

    def put(self, member: Member, share: Share) -> list[Place]:
        """Take a share in. Returns where it falls."""
        self.shares[member] = share
        for place in share.places:
            self.drawn.setdefault(place, set()).add(member)
        return share.places

    def drop(self, member: Member) -> list[Place]:
        """Forget a share, if it is there. Returns where it fell."""
        share = self.shares.pop(member, None)
        places = share.places if share else []
        for place in places:
            self.drawn[place].remove(member)
            if not self.drawn[place]:
                del self.drawn[place]
        return places


class ContourField:
    """Contours by plane id. An id only names a cache entry: every outline is a pure function of
    the plane's frame and voxels."""

    def __init__(self, settings: MapSettings) -> None:
        self._voxel_m = settings.voxel_m
        self._least = settings.min_surface_m2 / (settings.voxel_m / STEPS) ** 2
        self.contours: dict[int, Contour] = {}
        self.rolled = 0  # (u, v) tiles rolled over in the last update
        self._owners: dict[int, set[tuple[int, int]]] = {}  # by tile key: plane id, stamp
        self._cuts: Cuts = {}  # by tile key and stamp

    def update(
        self,
        store: VoxelStore,
        tiles: dict[int, Tile],
        changed: set[int],
        normals: dict[int, NDArray[np.float64]],
        cuts: Cuts,
    ) -> set[int]:
        """Bring the outlines up to date with the planes, whose inside normals these are, by id.
        `changed` are the tiles whose voxels, or plane ids, changed; `cuts` say where planes end, by
        tile key and tile-plane.

        Returns ids of the planes whose outlines changed."""
        for gone in self.contours.keys() - normals.keys():
            del self.contours[gone]
        stale: defaultdict[int, set[Place]] = defaultdict(set)
        cut = {(key, int(tiles[key].stamps[t])): own for (key, t), own in cuts.items()}
        changed = changed | self._end(cut, stale)
        wanted = self._reframe(normals, changed, tiles)
        for key in sorted(changed):
            tile = tiles[key]
            ids = tile.ids.tolist() if tile.num_planes else []
            named = zip(ids, tile.stamps.tolist(), strict=False)
            stays = {(i, stamp): t for t, (i, stamp) in enumerate(named) if i}
            for plane_id, stamp in self._owners.get(key, set()) - stays.keys():
                if plane_id in self.contours:
                    stale[plane_id].update(self.contours[plane_id].drop((key, stamp)))
            self._owners[key] = set(stays)
            wanted.extend(
                (plane_id, key, stamp, t)
                for (plane_id, stamp), t in stays.items()
                if (key, stamp) not in self.contours[plane_id].shares
            )
        shares = self._shares(store, tiles, wanted)
        for (plane_id, key, stamp, _), share in zip(wanted, shares, strict=True):
            stale[plane_id].update(self.contours[plane_id].put((key, stamp), share))
        return self._redraw(stale)

    def _end(self, cuts: Cuts, stale: dict[int, set[Place]]) -> set[int]:
        """Drop the shares of tile-planes that end elsewhere than they did. Returns their tiles."""
        different = {member for member, _ in self._cuts.items() ^ cuts.items()}
        self._cuts = cuts
        for key, stamp in different:
            for plane_id, own in self._owners.get(key, set()):
                if own == stamp and plane_id in self.contours:
                    stale[plane_id].update(self.contours[plane_id].drop((key, stamp)))
        return {key for key, _ in different}

    def _reframe(
        self, normals: dict[int, NDArray[np.float64]], changed: set[int], tiles: dict[int, Tile]
    ) -> list[Wanted]:
        """Begin the contours of planes that are new, or whose frame turned. Returns what these had
        in tiles other than `changed`."""
        again = []
        for plane_id, normal in normals.items():
            contour = self.contours.get(plane_id)
            if contour is not None and contour.normal is normal:
                continue
            rounded = round_normal(normal)
            if contour is None or contour.rounded != rounded:
                for key, stamp in contour.shares if contour else ():
                    if key not in changed:
                        t = int(np.flatnonzero(tiles[key].stamps == stamp)[0])
                        again.append((plane_id, key, stamp, t))
                contour = Contour(rounded, make_frame(rounded, self._voxel_m))
                self.contours[plane_id] = contour
            contour.normal = normal
        return again

    def _shares(
        self, store: VoxelStore, tiles: dict[int, Tile], wanted: list[Wanted]
    ) -> list[Share]:
        """What tile-planes give to the outlines of their planes."""
        own = self._members(store, tiles, wanted)
        rows, block, size = (np.concatenate([_NO_ROWS, *(one[n] for one in own)]) for n in range(3))
        starts, run_starts = (starts_of([len(each[n]) for each in own]) for n in (0, 1))
        frames = [self.contours[plane_id].frame for plane_id, *_ in wanted]
        axes = np.array([(f.axis_u, f.axis_v) for f in frames], float).reshape(-1, 2, 3)
        points = np.empty((len(rows), 2), np.int16)
        corners = np.zeros((len(wanted), 2), np.int32)
        places, counts = np.empty((len(wanted), PLACES), np.int64), np.empty(len(wanted), np.int64)
        share_all(
            rows, starts, block, size, run_starts, deal(starts), store.blocks, store.columns, axes,
            points, corners, places, counts,
        )  # fmt: skip
        ends = starts.tolist()
        return [
            Share((u, v), points[low:high].copy(), keys[:count].tolist())
            for (u, v), low, high, keys, count in zip(
                corners.tolist(), ends, ends[1:], places, counts.tolist(), strict=False
            )
        ]

    def _members(
        self, store: VoxelStore, tiles: dict[int, Tile], wanted: list[Wanted]
    ) -> list[Members]:
        """Voxel rows of tile-planes, but for those beyond where their plane ends."""
        keys = dict.fromkeys(key for _, key, _, _ in wanted)
        row_ends = {key: tiles[key].starts.tolist() for key in keys}
        run_ends = {key: tiles[key].run_starts.tolist() for key in keys}
        members = []
        for _, key, stamp, t in wanted:
            rows = tiles[key].rows[row_ends[key][t] : row_ends[key][t + 1]]
            own = slice(run_ends[key][t], run_ends[key][t + 1])
            block, size = tiles[key].runs.block[own], tiles[key].runs.size[own]
            cuts = self._cuts.get((key, stamp))
            if cuts is not None:
                rows = before_end(rows, store.blocks, store.columns, np.array(cuts, np.int64))
                block, size = store.columns.block[rows], np.ones(len(rows), np.int16)
            members.append((rows, block, size))
        return members

    def _redraw(self, stale: dict[int, set[Place]]) -> set[int]:
        """Draw the (u, v) tiles of planes again. Returns the planes whose outlines changed."""
        different = self._roll(self._repaint([(i, p) for i in stale for p in sorted(stale[i])]))
        for plane_id in different:
            contour = self.contours[plane_id]
            edges = [contour.edges[p] for p in sorted(contour.edges) if len(contour.edges[p])]
            whole = np.concatenate(edges) if edges else np.zeros((0, 4), np.int32)
            contour.outlines = surfaces_of(whole.astype(np.int64), self._least)
        return different

    def _repaint(self, stale: list[Drawn]) -> dict[Drawn, NDArray[np.bool_]]:
        """Draw (u, v) tiles again from all shares. Returns the cells (CELLS, CELLS) whose edges may
        have changed by it, by plane id and tile."""
        number: dict[tuple[int, Member], int] = {}
        drawn_by: list[list[int]] = []
        for plane_id, place in stale:
            members = self.contours[plane_id].drawn.get(place, ())
            drawn_by.append([number.setdefault((plane_id, m), len(number)) for m in members])
        held = [self.contours[plane_id].shares[member] for plane_id, member in number]
        old = [self.contours[plane_id].cells.pop(place, _NO_CELLS) for plane_id, place in stale]
        places = np.empty((len(stale), CELLS * CELLS), np.int16)
        words, counts = np.empty(places.shape, np.uint64), np.empty(len(stale), np.int64)
        marked = np.zeros((len(stale), SIDE, SIDE), np.bool_)
        touched = np.empty((len(stale), len(AROUND)), np.bool_)
        repaint(
            np.array([place for _, place in stale], np.int64),
            np.concatenate([_NO_POINTS, *(share.points for share in held)]),
            starts_of([len(share.points) for share in held]),
            np.array([share.corner for share in held], np.int64).reshape(-1, 2),
            np.array(list(itertools.chain.from_iterable(drawn_by)), np.int64),
            starts_of([len(n) for n in drawn_by]),
            *_lined_up(old), places, words, counts, marked, touched,
        )  # fmt: skip
        for (plane_id, place), p, w, count in zip(
            stale, places, words, counts.tolist(), strict=True
        ):
            if count:
                self.contours[plane_id].cells[place] = Cells(p[:count].copy(), w[:count].copy())
        near: dict[Drawn, NDArray[np.bool_]] = {}
        for n, part in np.argwhere(touched).tolist():
            plane_id, place = stale[n][0], stale[n][1] + AROUND[part]
            contour = self.contours[plane_id]
            if place in contour.cells or place in contour.edges:
                wanted = near.setdefault((plane_id, place), np.zeros((CELLS, CELLS), np.bool_))
                part_of(marked[n], part, wanted)
        return near

    def _roll(self, near: dict[Drawn, NDArray[np.bool_]]) -> set[int]:
        """Find again the boundary edges that start in the cells `near`, by plane id and (u, v)
        tile. Returns the planes that have others now."""
        self.rolled = len(near)
        wanted = np.array(list(near.values()), np.bool_).reshape(-1, CELLS, CELLS)
        drawn, new = list(near), list[NDArray[np.int32]]()
        for start in range(0, len(drawn), TILES_AT_ONCE):
            part = slice(start, start + TILES_AT_ONCE)
            new += boundary_edges(self._windows(drawn[part]), wanted[part])
        old = [self.contours[plane_id].edges.get(place, _NO_EDGES) for plane_id, place in near]
        old_starts, new_starts = (starts_of([len(own) for own in each]) for each in (old, new))
        edges = np.empty((old_starts[-1] + new_starts[-1], 4), np.int32)
        counts, same = np.empty(len(near), np.int64), np.empty(len(near), np.bool_)
        replace_edges(
            np.array([place for _, place in near], np.int64),
            np.concatenate([_NO_EDGES, *old]), old_starts,
            np.concatenate([_NO_EDGES, *new]), new_starts, wanted, edges, counts, same,
        )  # fmt: skip
        firsts = (old_starts + new_starts).tolist()
        for (plane_id, place), first, count in zip(near, firsts, counts.tolist(), strict=False):
            self.contours[plane_id].edges[place] = edges[first : first + count].copy()
        return {
            plane_id for (plane_id, _), as_before in zip(near, same, strict=True) if not as_before
        }

    def _windows(self, drawn: list[Drawn]) -> NDArray[np.uint64]:
        """(W, SIDE, SIDE) cells of (u, v) tiles and their halos."""
        number: dict[Drawn, int] = {}
        held: list[Cells] = []
        around = np.full((len(drawn), len(AROUND)), -1, np.int64)
        for w, (plane_id, place) in enumerate(drawn):
            cells = self.contours[plane_id].cells
            for part, step in enumerate(AROUND):
                if place + step in cells:
                    at = number.setdefault((plane_id, place + step), len(held))
                    if at == len(held):
                        held.append(cells[place + step])
                    around[w, part] = at
        windows = np.empty((len(drawn), SIDE, SIDE), np.uint64)
        fill_windows(*_lined_up(held), around, windows)
        return windows


def _lined_up(
    cells: list[Cells],
) -> tuple[NDArray[np.int16], NDArray[np.uint64], NDArray[np.int64]]:
    """Cells of (u, v) tiles, one after another, and where those of each begin."""
    starts = starts_of([len(own.places) for own in cells])
    places = np.concatenate([_NO_CELLS.places, *(own.places for own in cells)])
    return places, np.concatenate([_NO_CELLS.words, *(own.words for own in cells)]), starts


_NO_ROWS, _NO_POINTS = np.zeros(0, np.int32), np.zeros((0, 2), np.int16)
_NO_EDGES = np.zeros((0, 4), np.int32)
_NO_CELLS = Cells(np.zeros(0, np.int16), np.zeros(0, np.uint64))
