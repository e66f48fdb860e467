"""The map's account of itself: counts, and the four-stage report of the paper's Table 3."""

from __future__ import annotations

from dataclasses import asdict, dataclass, field
from typing import Any


@dataclass(slots=True)
class MapCounts:
    """Voxels, except where the name says points or scans."""

    scans: int = 0
    points_in: int = 0
    points_stored: int = 0
    points_rejected: dict[str, int] = field(default_factory=dict)
    voxels: int = 0
    valid: int = 0
    aligned: int = 0
    thick: int = 0
    sparse: int = 0
    mixed: int = 0
    discarded: int = 0  # on no plane
    discarded_points: int = 0  # in discarded voxels
    sigma_n_m: float = 0.0

    def as_dict(self) -> dict[str, Any]:
        return asdict(self)


@dataclass(frozen=True, slots=True)
class StageReport:
    """Planes and figures after each of the four stages (method.md 5.1)."""

    planes: tuple[int, int, int, int]  # seeds, merged, after the detail level, final
    aligned_percent: float
    thick_percent: float
    average_two_sigma_m: float
    detail_level_reached: float
    min_occupation: int  # voxels
    discarded_percent: float  # of voxels
    discarded_points_percent: float  # of points, by their voxel's fate

    @property
    def rows(self) -> list[tuple[str, str, str, str, str]]:
        """A row each for planes and report, under the stages' names."""
        a, b, c, d = self.planes
        return [
            ("", "1 local normals", "2 merging", "3 detail level", "4 final"),
            ("planes", str(a), str(b), str(c), str(d)),
            (
                "report",
                f"aligned {self.aligned_percent:.1f} %, thick {self.thick_percent:.1f} %",
                f"average 2 sigma_n {100 * self.average_two_sigma_m:.1f} cm",
                f"reached {100 * self.detail_level_reached:.1f} %, "
                f"min. occupation {self.min_occupation}",
                f"discarded {self.discarded_points_percent:.2f} % of points, "
                f"{self.discarded_percent:.2f} % of voxels",
            ),
        ]

    def as_dict(self) -> dict[str, Any]:
        return asdict(self)
