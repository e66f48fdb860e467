"""The normal of one voxel by the paper's adaptive cubic region (eq. 1-25).

A region is the cube of half-side r voxels round the voxel; each occupied voxel seen from the same
side votes at its rounded centroid with weight min(points, 8). The radius follows the sign of the
paper's stationarity condition (eq. 22) from `start_radius` until it repeats: the fixed point that
eq. 16 approaches, without its dependence on the order of points (method.md 4.1, design 3.2).
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from facet.mapping.eigen import eigenvalues, eigenvector
from facet.mapping.kernel import kernel
from facet.mapping.region import covariance, is_one_pose, shape
from facet.mapping.settings import STEPS, MapSettings
from facet.mapping.traces import (
    COUNT,
    FARTHEST,
    KNOWN,
    SLAB,
    SLAB_UNIT,
    THIN_SLAB,
    ask,
    list_votes,
    slab_key,
)

EMPTY, VALID, ALIGNED, THICK, SPARSE, MIXED = range(6)
WIDER = 255  # no class: the voxel must look farther than its halo
UNIT = 256  # normals are integers: a unit vector times this
OUTLIER = 6  # a voxel with so many times fewer points than those round it has no normal
MIN_VOTES = 4  # fewer votes than this say nothing


class Rule(NamedTuple):
    """The method's constants as the kernel wants them."""

    sigma_target: float  # w_sigma * Lambda
    w_sigma: float
    w_points: float
    growth: NDArray[np.float64]  # R_N / R (eq. 19) by number of votes, clamped
    floor2: float  # squared sigma floor, (1/8 voxel)^2
    tan_theta: float
    epsilon: float
    offset: float  # 1/8 voxels, of a voxel from the plane of its own region
    border: float  # 1/8 voxels per voxel of radius, in the plane, from the centroid of the region
    slab: float  # 1/8 voxels / SLAB_UNIT, half width of the slab that votes in the second look
    thin_slab: float  # likewise in the last look, where surfaces meet
    thin_passes: int
    thin_points: int
    thin_share: int
    tan_mixed: float
    passes: int
    shrink: int
    least_first: int
    start: int
    largest: int
    sparse: int
    outlier: int


def make_rule(settings: MapSettings) -> Rule:
    """Tabulate eq. 19-20; eq. 25 gives the weights from epsilon and Lambda."""
    w_sigma = settings.gain * settings.epsilon / settings.lambda_target
    counts = np.arange(4 * settings.n_max + 1)
    few = (settings.n_0 - counts) / (settings.n_0 - settings.n_min)
    many = -(counts - settings.n_0) / (settings.n_max - settings.n_0)
    alpha = np.clip(
        np.where(counts < settings.n_0, few, many), -settings.alpha_clip, settings.alpha_clip
    )
    growth = settings.tan_base ** np.tan(settings.tan_slope * math.pi / 2 * alpha)
    return Rule(
        sigma_target=w_sigma * settings.lambda_target,
        w_sigma=w_sigma,
        w_points=settings.gain - w_sigma,
        growth=growth,
        floor2=(settings.sigma_floor * STEPS) ** 2,
        tan_theta=math.tan(math.radians(settings.theta_deg)),
        epsilon=settings.epsilon,
        offset=settings.own_offset * STEPS,
        border=settings.border * STEPS,
        slab=settings.slab * STEPS * SLAB_UNIT,
        thin_slab=settings.thin_slab * STEPS * SLAB_UNIT,
        thin_passes=settings.thin_passes,
        thin_points=settings.thin_points,
        thin_share=settings.thin_share,
        tan_mixed=math.tan(math.radians(settings.mixed_deg)),
        passes=settings.passes,
        shrink=settings.shrink,
        least_first=settings.least_first,
        start=settings.start_radius,
        largest=settings.max_radius,
        sparse=MIN_VOTES,
        outlier=OUTLIER,
    )


@kernel(allocates=False)
def _step(sums, r, rule):  # type: ignore[no-untyped-def]
    """The next radius by eq. 16-20: at least one voxel up or down, at most double or half."""
    votes = min(sums[0], rule.growth.shape[0] - 1)
    growth = rule.growth[votes]
    ratio = 1e-3
    if sums[0] >= 4:
        ratio, _ = shape(eigenvalues(*covariance(sums)), rule.floor2)
    factor = 1.0 + rule.sigma_target / ratio - rule.w_sigma + rule.w_points * (growth - 1.0)
    factor = min(2.0, max(0.5, factor))
    r_next = np.int64(np.floor(r * factor + 0.5))
    if r_next == r:
        r_next = r + 1 if factor > 1.0 else r - 1
    return min(rule.largest, max(1, r_next))


@kernel(allocates=False)
def _find_radius(at, rule, scratch):  # type: ignore[no-untyped-def]
    """Follow the radius until it repeats; of a cycle the smallest. (radius, reach): reach is the
    largest radius that was looked at; radius 0 where it would leave the halo."""
    sums, state = scratch[2], scratch[4]
    r = rule.start
    reach = r
    visited = np.int64(0)
    while ask(at, r, reach, scratch):
        visited |= np.int64(1) << r
        r_next = _step(sums, r, rule)
        if r_next == r or (visited >> r_next) & 1:
            if r_next < r and not ask(at, r_next, reach, scratch):
                break
            return min(r, r_next), reach
        r = r_next
        reach = max(r, reach)
        if reach > FARTHEST:
            state[KNOWN] = 0
    return 0, reach


@kernel(allocates=False)
def estimate(at, scratch):  # type: ignore[no-untyped-def]
    """(class, nx, ny, nz, gamma in half degrees, at a border, reach) of a voxel; class WIDER where
    its halo is too narrow to tell.

    at: halo, its margin, the voxel's place in the block, its observable, rule."""
    _, _, _, seen, rule = at
    lists, votes, sums, _, state, _ = scratch
    if seen == 0:
        return EMPTY, 0, 0, 0, 0, False, 0
    r, reach = _find_radius(at, rule, scratch)
    one_line = seen >> 32 != 0
    if r == 0 or (one_line and not list_votes(at, reach, scratch)):
        return WIDER, 0, 0, 0, 0, False, 0
    if sums[0] < rule.sparse:
        return SPARSE, 0, 0, 0, 0, False, reach
    one_pose = one_line and is_one_pose(lists, votes, state[COUNT], r)
    kind, nx, ny, nz, tan_gamma = _classify(sums, seen, one_pose, rule)
    every, whole = sums[0], tan_gamma  # of all that the region holds
    outlier = rule.outlier * ((seen >> 12) & 15) * sums[0] <= sums[1]  # of few points, among many
    beside = kind == THICK and tan_gamma <= rule.tan_theta  # a plane, not on it: a noise shell
    if kind != ALIGNED and (outlier or beside):
        return THICK, 0, 0, 0, 255, False, reach
    region = at, r, reach, one_pose
    first = r  # radius of the region of the first normal: smaller where the full one is thick
    while kind != ALIGNED:
        passes = 1 if kind == VALID else rule.passes
        kind, nx, ny, nz, tan_gamma = _look_again(
            region, nx, ny, nz, SLAB, passes, rule.sparse, scratch
        )
        if kind == WIDER:
            return WIDER, 0, 0, 0, 0, False, 0
        if kind == SPARSE:
            return SPARSE, 0, 0, 0, 0, False, reach
        first -= 1
        if kind == VALID or first < max(1, r - rule.shrink):
            break
        if not ask(at, first, reach, scratch):
            return WIDER, 0, 0, 0, 0, False, 0
        if sums[0] < rule.least_first:
            break
        _, nx, ny, nz, _ = _classify(sums, seen, one_pose, rule)
        kind = THICK
    dense = sums[1] >= rule.thin_points * sums[0]  # centroids are sure enough for a thinner slab
    nearly = kind == THICK and tan_gamma < rule.tan_mixed < whole
    if nearly and dense and r > 1:  # a step: a narrow face between two
        least = (every + rule.thin_share - 1) // rule.thin_share
        kind, nx, ny, nz, tan_gamma = _look_again(
            region, nx, ny, nz, THIN_SLAB, rule.thin_passes, least, scratch
        )
        if kind == WIDER:
            return WIDER, 0, 0, 0, 0, False, 0
        if kind == SPARSE:  # a slice of a lump
            return THICK, 0, 0, 0, 255, False, reach
    if kind == VALID and (seen >> 31) & 1 == 1 and _towards(seen, nx, ny, nz) < 4.0:
        kind = MIXED  # both sides of a thin thing, not one side from two directions
    half_degrees = np.int64(np.floor(np.arctan(tan_gamma) * 114.59155902616465 + 0.5))
    return (
        kind,
        np.int64(np.floor(nx * UNIT + 0.5)),
        np.int64(np.floor(ny * UNIT + 0.5)),
        np.int64(np.floor(nz * UNIT + 0.5)),
        half_degrees,
        _at_border(sums, seen, r, nx, ny, nz, rule),
        reach,
    )


@kernel(allocates=False)
def _look_again(region, nx, ny, nz, slab, passes, least, scratch):  # type: ignore[no-untyped-def]
    """Class and normal again, and again: of the votes on the voxel's own side, by the last normal,
    and in its own slab; SPARSE where these are fewer than `least`."""
    at, r, reach, one_pose = region
    seen, rule, sums = at[3], at[4], scratch[2]
    kind, tan_gamma = SPARSE, 0.0
    last = np.int64(-1)
    for _ in range(passes):
        key = slab_key(r, slab, nx, ny, nz)
        if key == last:  # and so on for ever
            break
        last = key
        if not ask(at, key, reach, scratch):
            return WIDER, nx, ny, nz, 0.0
        if sums[0] < least:
            return SPARSE, nx, ny, nz, 0.0
        kind, nx, ny, nz, tan_gamma = _classify(sums, seen, one_pose, rule)
    return kind, nx, ny, nz, tan_gamma


@kernel(allocates=False)
def _at_border(sums, seen, r, nx, ny, nz, rule):  # type: ignore[no-untyped-def]
    """Whether the votes lie to one side of the voxel, in the plane."""
    w = float(sums[1])
    dx = sums[2] / w - (seen & 15)
    dy = sums[3] / w - ((seen >> 4) & 15)
    dz = sums[4] / w - ((seen >> 8) & 15)
    along = nx * dx + ny * dy + nz * dz
    return (dx * dx + dy * dy + dz * dz) - along * along > (rule.border * r) ** 2


@kernel(allocates=False)
def _towards(seen, nx, ny, nz):  # type: ignore[no-untyped-def]
    """The normal along the view direction of the voxel with observable `seen`."""
    return (
        nx * (((seen >> 16) & 31) - 8)
        + ny * (((seen >> 21) & 31) - 8)
        + nz * (((seen >> 26) & 31) - 8)
    )


@kernel(allocates=False)
def _classify(sums, seen, one_pose, rule):  # type: ignore[no-untyped-def]
    """(class, normal towards the view, tan gamma) of the voxel with observable `seen`."""
    a, b, c, d, e, f = covariance(sums)
    variances = eigenvalues(a, b, c, d, e, f)
    ratio, tan_gamma = shape(variances, rule.floor2)
    nx, ny, nz = eigenvector(a, b, c, d, e, f, variances[2])
    if _towards(seen, nx, ny, nz) < 0.0:
        nx, ny, nz = -nx, -ny, -nz
    if ratio < rule.epsilon or one_pose:
        return ALIGNED, nx, ny, nz, tan_gamma
    one = 1.0 / sums[1]  # the voxel itself must lie on the plane of its region: no noise shells
    own = (
        nx * ((seen & 15) - sums[2] * one)
        + ny * (((seen >> 4) & 15) - sums[3] * one)
        + nz * (((seen >> 8) & 15) - sums[4] * one)
    )
    if tan_gamma > rule.tan_theta or abs(own) > rule.offset:
        return THICK, nx, ny, nz, tan_gamma
    return VALID, nx, ny, nz, tan_gamma
