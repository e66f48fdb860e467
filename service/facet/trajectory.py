"""Where scans were taken from, as the map has them now: of those whose message does not say it."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from facet_protocol.messages import Pose

MAX_POSES = 1 << 20  # of all sensors together: 65 bytes each
FIRST_ROWS = 16
Name = tuple[str, int]  # source, epoch


class Track:
    """Poses of one sensor's epoch, ascending by sequence; room doubles as it is needed."""

    def __init__(self) -> None:
        self._sequences = np.zeros(FIRST_ROWS, np.uint64)
        self._poses = np.zeros((FIRST_ROWS, 7))  # position, orientation xyzw
        self._is_moved = np.zeros(FIRST_ROWS, np.bool_)
        self._num = 0

    def __len__(self) -> int:
        return self._num

    def rows(self) -> tuple[NDArray[np.uint64], NDArray[np.float64], NDArray[np.bool_]]:
        """(N,) sequences, (N, 7) poses, (N,) whether a correction gave it."""
        n = self._num
        return self._sequences[:n], self._poses[:n], self._is_moved[:n]

    def find(self, sequence: int) -> NDArray[np.float64] | None:
        k = int(np.searchsorted(self._sequences[: self._num], np.uint64(sequence)))
        return self._poses[k] if k < self._num and self._sequences[k] == sequence else None

    def is_moved(self, sequence: int) -> bool:
        k = int(np.searchsorted(self._sequences[: self._num], np.uint64(sequence)))
        is_there = k < self._num and self._sequences[k] == sequence
        return bool(is_there and self._is_moved[k])

    def put(
        self, sequences: NDArray[np.uint64], poses: NDArray[np.float64], *, is_moved: bool
    ) -> None:
        """Poses (K, 7) for sequences (K,), in place of what was known of them."""
        moved = np.full(len(sequences), is_moved)
        last = self._sequences[self._num - 1] if self._num else -1
        if len(sequences) == 1 and int(sequences[0]) > int(last):
            self._append(sequences, poses, moved)
            return
        merged = [
            np.concatenate(pair)
            for pair in zip(self.rows(), (sequences, poses, moved), strict=True)
        ]
        order = np.argsort(merged[0], kind="stable")
        is_last = np.append(np.diff(merged[0][order]) > 0, True)  # of equal ones the newest counts
        self.replace(*(column[order[is_last]] for column in merged))

    def replace(
        self,
        sequences: NDArray[np.uint64],
        poses: NDArray[np.float64],
        is_moved: NDArray[np.bool_],
    ) -> None:
        """Know these rows, ascending, and no others."""
        self._sequences, self._poses, self._is_moved = sequences, poses, is_moved
        self._num = len(sequences)

    def _append(
        self,
        sequences: NDArray[np.uint64],
        poses: NDArray[np.float64],
        is_moved: NDArray[np.bool_],
    ) -> None:
        n = self._num
        if n == len(self._sequences):
            more = max(FIRST_ROWS, n)
            self._sequences = np.concatenate([self._sequences, np.zeros(more, np.uint64)])
            self._poses = np.concatenate([self._poses, np.zeros((more, 7))])
            self._is_moved = np.concatenate([self._is_moved, np.zeros(more, np.bool_)])
        self._sequences[n], self._poses[n], self._is_moved[n] = sequences[0], poses[0], is_moved[0]
        self._num = n + 1


class Trajectories:
    """Current poses by scan, bounded: of a scan that came apart from its pose, the one that was
    found; of a corrected one, the last it was given. The rest is in the messages themselves.

    What was found is forgotten, the older half of it, when there is no more room; what a
    correction gave never is, for without it the scan could not be taken out again.
    """

    def __init__(self, max_poses: int = MAX_POSES) -> None:
        self._max_poses = max_poses
        self._tracks: dict[Name, Track] = {}
        self._num = 0

    def __len__(self) -> int:
        return self._num

    def find(self, source: str, epoch: int, sequence: int) -> Pose | None:
        track = self._tracks.get((source, epoch))
        row = track.find(sequence) if track is not None else None
        return Pose(row[:3].copy(), row[3:].copy()) if row is not None else None

    def corrected(self, source: str, epoch: int, sequence: int) -> Pose | None:
        """The pose that a correction gave it."""
        track = self._tracks.get((source, epoch))
        is_moved = track is not None and track.is_moved(sequence)
        return self.find(source, epoch, sequence) if is_moved else None

    def note(self, source: str, epoch: int, sequence: int, pose: Pose) -> None:
        """A pose that was found for a scan."""
        if sequence and (self._num < self._max_poses or self._forget()):
            self._put((source, epoch), [sequence], [pose], is_moved=False)

    def move(self, moved: Mapping[Name, Sequence[tuple[int, Pose]]]) -> bool:
        """New poses, by sequence; False, and nothing is changed, when there is no room."""
        num = sum(map(len, moved.values()))
        if self._num + num > self._max_poses and not self._forget(num):
            return False
        for name, rows in moved.items():
            self._put(name, [s for s, _ in rows], [p for _, p in rows], is_moved=True)
        return True

    def freeze(self) -> dict[str, NDArray[Any]]:
        """All of it as arrays."""
        tracks = sorted(self._tracks.items())
        names = json.dumps([[*name, len(track)] for name, track in tracks]).encode()
        none = Track().rows()
        columns = zip(none, *(track.rows() for _, track in tracks), strict=True)
        sequences, poses, is_moved = (np.concatenate(column) for column in columns)
        return {
            "tracks": np.frombuffer(names, np.uint8),
            "track_sequences": sequences,
            "track_poses": poses,
            "track_moved": is_moved,
        }

    def thaw(self, frozen: Mapping[str, NDArray[Any]]) -> None:
        """Become what was frozen. Raises KeyError, TypeError, ValueError for anything else."""
        columns = [frozen[f"track_{name}"] for name in ("sequences", "poses", "moved")]
        names = json.loads(frozen["tracks"].tobytes())
        num = sum(n for _, _, n in names)
        if [column.shape for column in columns] != [(num,), (num, 7), (num,)]:
            raise ValueError(f"{num} poses in {[column.shape for column in columns]}")
        at = 0
        for source, epoch, n in names:
            track = self._tracks[str(source), int(epoch)] = Track()
            track.replace(*(column[at : at + n].copy() for column in columns))
            at += n
        self._num = num

    def _put(
        self, name: Name, sequences: Sequence[int], poses: Sequence[Pose], *, is_moved: bool
    ) -> None:
        track = self._tracks.setdefault(name, Track())
        before = len(track)
        rows = np.array([[*p.position, *p.orientation_xyzw] for p in poses], np.float64)
        track.put(np.array(sequences, np.uint64), rows, is_moved=is_moved)
        self._num += len(track) - before

    def _forget(self, num: int = 1) -> bool:
        """Whether there is room for `num` now."""
        for track in self._tracks.values():
            sequences, poses, is_moved = track.rows()
            found = np.flatnonzero(~is_moved)
            kept = is_moved.copy()
            kept[found[(len(found) + 1) // 2 :]] = True
            track.replace(sequences[kept], poses[kept], is_moved[kept])
        self._num = sum(map(len, self._tracks.values()))
        return self._num + num <= self._max_poses
