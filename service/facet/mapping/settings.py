"""Every number the map depends on. Two are the user's: `theta_deg` and `detail_level`."""

from __future__ import annotations

from dataclasses import asdict, dataclass

TICKS = 1024  # ticks per voxel edge
STEPS = 8  # steps of a rounded centroid, and of a contour's (u, v), per voxel edge
BLOCK = 8  # voxels per block edge
VOXELS = BLOCK**3  # of a block
PER_BLOCK = 12  # patches of a block; what finds no place is a leftover
TILE = 64  # voxels per tile edge
ALPHA2 = 1603  # squared alpha radius of contours, (1/8 voxel)^2: 5.005 voxels.
# 1603 = 7 * 229 is no sum of two rational squares, so no circle of this radius goes through three
# points of the grid: every test of contours.py is strict, and ties cannot happen.


@dataclass(frozen=True, slots=True)
class MapSettings:
    """Settings of one map. Lengths without `_m` are in voxels; angles are degrees here only."""

    voxel_m: float = 0.05
    theta_deg: float = 15.0  # thickness angle above which a normal is refused (paper: 9 to 15)
    detail_level: float = 0.98  # share of the occupied voxels that the kept planes must hold

    # scans
    min_range_m: float = 0.05
    max_range_m: float = 120.0
    reach_m: float = 8.0  # a line scanner's empty beam is free this far
    # normals: eq. 16-25; tables of method.md 3
    lambda_target: float = 10.0
    epsilon: float = 0.5
    tan_base: float = 1.05  # b of eq. 19
    tan_slope: float = 0.9  # m of eq. 19
    alpha_clip: float = 1.10
    gain: float = 0.5  # w_sigma + w_N
    n_min: int = 12
    n_0: int = 40
    n_max: int = 120
    start_radius: int = 3
    max_radius: int = 20
    sigma_floor: float = 0.2
    own_offset: float = 0.4  # of a voxel from the plane of its own region
    border: float = 0.35  # in-plane offset from its region's centroid, radii, at a border
    slab: float = 1.0
    passes: int = 4
    thin_slab: float = 0.75  # of the last look where surfaces meet, if voxels hold points enough
    thin_passes: int = 8
    mixed_deg: float = 25.0  # thickness angle of a region in which surfaces meet
    thin_points: int = 6  # mean of a region's voxels, each counted as 8 at most
    thin_share: int = 2  # one vote of so many at least must lie in it
    shrink: int = 2
    least_first: int = 6
    # patches and their leftovers
    patch_angle_deg: float = 15.0
    patch_offset: float = 0.5
    leftover_offset: float = 0.7
    # planes
    edge_angle_deg: float = 15.0
    merge_angle_deg: float = 10.0
    bridge_angle_deg: float = 4.0  # phi_c: merged normal against the members' own
    tilt_offset: float = 0.25
    cross_sigmas: float = 1.0  # between planes that do not touch
    cross_reach: float = 8.0  # extents of the larger one between their middles
    merge_sigmas: float = 3.0
    max_merged_sigma: float = 0.5
    min_area_m2: float = 0.25  # n_occ is never above this many square metres of voxels
    min_width: float = 2.5  # a narrower strip has no normal of its own
    strip_width: float = 24.0  # a narrower plane is a strip, which may be one of something curved
    member_share: float = 0.5  # of n_occ, that must be voxels with a valid normal
    min_surface_m2: float = 0.05
    # free space
    passed_beams: int = 3
    opening_share: float = 0.3

    def __post_init__(self) -> None:
        for name, low, high in (
            ("voxel_m", 0.005, 1.0),
            ("theta_deg", 1.0, 45.0),
            ("detail_level", 0.5, 1.0),
            ("reach_m", 0.1, 1000.0),
        ):
            value = getattr(self, name)
            if not low <= value <= high:
                raise ValueError(f"{name} = {value} is outside [{low}, {high}]")
        if self.max_radius > 3 * BLOCK - 4:
            raise ValueError(f"max_radius = {self.max_radius} is over {3 * BLOCK - 4} voxels")

    @property
    def tick_m(self) -> float:
        return self.voxel_m / TICKS

    def as_dict(self) -> dict[str, float | int]:
        return asdict(self)
