"""What is odd about a scan: counted, and said once in a while. A jump may be refused. No clock."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from facet_protocol.messages import Pose, Scan

FUTURE_NS = 2 * 10**9  # a stamp further ahead of its receipt comes from a wrong clock
OLDEST_NS = 946_684_800 * 10**9  # 2000-01-01: an earlier stamp comes from no clock
JUMP_NS = 10**8  # poses closer than this in time and
JUMP_M = 5.0  # farther than this apart,
JUMP_COS = math.cos(math.radians(90.0) / 2.0)  # or turned by more than 90 degrees: a jump


class _Last(NamedTuple):
    stamp_ns: int  # the newest
    pose: Pose


class Plausibility:
    """Compares each scan with the last that was taken of its source: in the order of the log."""

    def __init__(self) -> None:
        self._last: dict[str, _Last] = {}

    def oddities(self, scan: Scan, received_ns: int) -> dict[str, str]:
        """What is odd, by the name it is counted under, and in words: `bad_stamp` (0, before the
        year 2000, or ahead of its receipt), `out_of_order`, `pose_jump`."""
        odd: dict[str, str] = {}
        last = self._last.get(scan.source)
        if scan.stamp_ns < OLDEST_NS:
            odd["bad_stamp"] = f"stamp {scan.stamp_ns} ns is before the year 2000"
        elif received_ns and scan.stamp_ns > received_ns + FUTURE_NS:
            ahead_s = (scan.stamp_ns - received_ns) * 1e-9
            odd["bad_stamp"] = f"stamp is {ahead_s:.1f} s ahead of its receipt"
        if last is not None:
            if scan.stamp_ns < last.stamp_ns:
                behind_s = (last.stamp_ns - scan.stamp_ns) * 1e-9
                odd["out_of_order"] = f"stamp is {behind_s:.3f} s behind the one before"
            if abs(scan.stamp_ns - last.stamp_ns) <= JUMP_NS:
                odd |= _jump(last.pose, scan.pose)
        return odd

    def take(self, scan: Scan) -> None:
        """It is in the map: the next is compared with it."""
        source, newest_ns = scan.source, scan.stamp_ns
        last = self._last.get(source)
        if last is not None and last.stamp_ns > newest_ns:
            newest_ns = last.stamp_ns
        self._last[source] = _Last(newest_ns, scan.pose)

    def freeze(self) -> dict[str, NDArray[Any]]:
        """What the next scans are compared with, for a checkpoint."""
        poses = [(*k.pose.position, *k.pose.orientation_xyzw) for k in self._last.values()]
        return {
            "last_sources": np.frombuffer(json.dumps(list(self._last)).encode(), np.uint8),
            "last_stamps": np.array([k.stamp_ns for k in self._last.values()], np.int64),
            "last_poses": np.array(poses, np.float64).reshape(-1, 7),
        }

    def thaw(self, frozen: Mapping[str, NDArray[Any]]) -> None:
        """Compare with what was frozen. Raises KeyError, TypeError, ValueError for all else."""
        sources = json.loads(frozen["last_sources"].tobytes())
        rows = zip(
            sources, frozen["last_stamps"].tolist(), frozen["last_poses"].copy(), strict=True
        )
        for source, stamp_ns, row in rows:
            self._last[str(source)] = _Last(stamp_ns, Pose(row[:3], row[3:]))


def _jump(one: Pose, two: Pose) -> dict[str, str]:
    distance = math.dist(one.position.tolist(), two.position.tolist())
    cosine = abs(float(one.orientation_xyzw @ two.orientation_xyzw))  # of half the angle
    if distance > JUMP_M or cosine < JUMP_COS:
        turn = math.degrees(2.0 * math.acos(min(1.0, cosine)))
        return {"pose_jump": f"moved {distance:.2f} m and turned {turn:.0f} degrees at once"}
    return {}
