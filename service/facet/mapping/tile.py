"""A tile of 64^3 voxels and its tile-planes, and which of these touch."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from facet.mapping.membership import CLAIMED, Runs
from facet.mapping.merging import Nodes
from facet.mapping.runs import starts_of
from facet.mapping.sums import MOMENTS


@dataclass(slots=True)
class Tile:
    """One tile and its tile-planes (T of them), in canonical order."""

    key: int
    blocks: NDArray[np.int32]  # of the tile, by ascending block key
    nodes: Nodes  # (T, ...) voxels, about the map's origin
    points: NDArray[np.int64]  # (T, 10) exact moments of pure voxels' points, tile corner; pure:
    # near its tile-plane, not at a border, and claimed by no plane at an angle
    total: NDArray[np.int64]  # (T,) points of all their voxels
    occupation: NDArray[np.int64]  # (T,) voxels, leftovers included
    facing: NDArray[np.float64]  # (T, 5) unit normal, offset from the tile corner, width; voxels
    planes: NDArray[
        np.float64
    ]  # (T, 4) what their voxels are near: unit normal, offset, tile corner
    stamps: NDArray[np.int64]  # (T,) others as soon as other voxels, or centroids, are on them
    rows: NDArray[np.int32]  # (M,) voxel rows of its tile-planes, one after another
    state: NDArray[np.int8]  # (M,) what each is: pure, not, or only a claim on a corner voxel
    # that belongs elsewhere
    runs: Runs  # (R, ...) the rows by tile-plane and block
    pairs: NDArray[np.int64] = field(default_factory=lambda: np.zeros(0, np.int64))
    # pairs: adjacent tile-planes, own << 32 | place of the other tile among the 27 << 16 | other
    ids: NDArray[np.int64] = field(default_factory=lambda: np.zeros(0, np.int64))
    heritage: NDArray[np.int64] = field(default_factory=lambda: np.zeros((0, 3), np.int64))
    # ids: (T,) at the last update; heritage: (plane id then, tile-plane now, voxels they share)
    named: bool = False  # the heritage is that of its ids
    abroad: NDArray[np.int64] = field(default_factory=lambda: np.zeros(0, np.int64))
    # abroad: voxels that lie in other tiles, as row << 32 | plane id, at the last update

    @property
    def num_planes(self) -> int:
        return len(self.nodes.votes)

    @property
    def starts(self) -> NDArray[np.int64]:
        """(T + 1,) where the rows of each tile-plane begin."""
        return starts_of(np.bincount(self.runs.plane, self.runs.size, self.num_planes))

    @property
    def run_starts(self) -> NDArray[np.int64]:
        """(T + 1,) where the runs of each tile-plane begin."""
        return starts_of(np.bincount(self.runs.plane, minlength=self.num_planes))

    @property
    def corner(self) -> NDArray[np.bool_]:
        """(M,) which rows are only claimed."""
        return np.asarray(self.state == CLAIMED)

    def members_of(self, plane: int) -> NDArray[np.int32]:
        """Rows of one of its tile-planes that belong to no other, a copy."""
        low, high = np.searchsorted(self.runs.plane, (plane, plane + 1)).tolist()
        start = int(self.runs.size[:low].sum())
        part = slice(start, start + int(self.runs.size[low:high].sum()))
        return np.compress(self.state[part] != CLAIMED, self.rows[part])

    @property
    def owner(self) -> NDArray[np.int64]:
        """(M,) tile-plane of each row."""
        return np.repeat(np.arange(self.num_planes), np.diff(self.starts))


def empty_tile(key: int, blocks: NDArray[np.int32]) -> Tile:
    """A tile without tile-planes."""
    nodes = Nodes(np.zeros(0), np.zeros((0, 3)), np.zeros((0, 6)), np.zeros((0, 3)))
    none = np.zeros(0, np.int16)
    runs = Runs(np.zeros(0, np.int32), none, none, np.zeros(0, np.float32))
    return Tile(
        key, blocks, nodes, np.zeros((0, MOMENTS), np.int64), np.zeros(0, np.int64),
        np.zeros(0, np.int64), np.zeros((0, 5)), np.zeros((0, 4)), np.zeros(0, np.int64),
        np.zeros(0, np.int32), np.zeros(0, np.int8), runs,
    )  # fmt: skip
