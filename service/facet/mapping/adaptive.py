"""The normal of one voxel by the paper's adaptive cubic region (eq. 1-25).

A region is the cube of half-side r voxels round the voxel; each occupied voxel seen from the same
side votes at its rounded centroid with weight min(points, 8). The radius follows the sign of the
paper's stationarity condition (eq. 22) from `start_radius` until it repeats: the fixed point that
eq. 16 approaches, without its dependence on the order of points (method.md 4.1, design 3.2).
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from facet.mapping.kernel import kernel
from facet.mapping.principal import LAMBDA, NX, NY, NZ, TAN_GAMMA
from facet.mapping.region import is_one_pose
from facet.mapping.settings import STEPS, MapSettings
from facet.mapping.traces import (
    FARTHEST,
    KNOWN,
    POSES,
    RADIUS,
    REACH,
    SLAB,
    SLAB_UNIT,
    THIN_SLAB,
    VISITED,
    WANTED,
    ask,
    slab_key,
)

EMPTY, VALID, ALIGNED, THICK, SPARSE, MIXED = range(6)
OPEN = 255  # no class: sums are wanted, or poses
UNIT = 256  # normals are integers: a unit vector times this
OUTLIER = 6  # a voxel with so many times fewer points than those round it has no normal
GROWTHS = 1024  # numbers of votes that eq. 19 is tabulated for: beyond n_max it is the same
MIN_VOTES = 4  # fewer votes than this say nothing


RULE = np.dtype(  # the method's constants as the kernel wants them
    [
        ("sigma_target", np.float64),  # w_sigma * Lambda
        ("w_sigma", np.float64),
        ("w_points", np.float64),
        ("growth", np.float64, (GROWTHS,)),  # R_N / R (eq. 19) by number of votes, clamped
        ("floor2", np.float64),  # squared sigma floor, (1/8 voxel)^2
        ("tan_theta", np.float64),
        ("epsilon", np.float64),
        ("offset", np.float64),  # 1/8 voxels, of a voxel from the plane of its own region
        ("border", np.float64),  # 1/8 voxels per voxel of radius, in the plane, from the centroid
        # of the region
        ("slab", np.float64),  # 1/8 voxels / SLAB_UNIT, half width of the slab that votes in the
        # second look
        ("thin_slab", np.float64),  # likewise in the last look, where surfaces meet
        ("thin_passes", np.int64),
        ("thin_points", np.int64),
        ("thin_share", np.int64),
        ("tan_mixed", np.float64),
        ("passes", np.int64),
        ("shrink", np.int64),
        ("least_first", np.int64),
        ("start", np.int64),
        ("largest", np.int64),
        ("sparse", np.int64),
        ("outlier", np.int64),
    ],
    align=True,
)


def make_rule(settings: MapSettings) -> NDArray[np.void]:
    """(1,) RULE: eq. 19-20 tabulated; eq. 25 gives the weights from epsilon and Lambda. Raises
    ValueError for an n_max that the table has no room for."""
    w_sigma = settings.gain * settings.epsilon / settings.lambda_target
    counts = np.arange(GROWTHS)
    few = (settings.n_0 - counts) / (settings.n_0 - settings.n_min)
    many = -(counts - settings.n_0) / (settings.n_max - settings.n_0)
    alpha = np.clip(
        np.where(counts < settings.n_0, few, many), -settings.alpha_clip, settings.alpha_clip
    )
    if alpha[-1] > -settings.alpha_clip:
        raise ValueError(f"n_max = {settings.n_max} is too many votes: {GROWTHS} are tabulated")
    rule = np.recarray(1, RULE)
    rule.sigma_target = w_sigma * settings.lambda_target
    rule.w_sigma = w_sigma
    rule.w_points = settings.gain - w_sigma
    rule.growth = settings.tan_base ** np.tan(settings.tan_slope * math.pi / 2 * alpha)
    rule.floor2 = (settings.sigma_floor * STEPS) ** 2
    rule.tan_theta = math.tan(math.radians(settings.theta_deg))
    rule.epsilon = settings.epsilon
    rule.offset = settings.own_offset * STEPS
    rule.border = settings.border * STEPS
    rule.slab = settings.slab * STEPS * SLAB_UNIT
    rule.thin_slab = settings.thin_slab * STEPS * SLAB_UNIT
    rule.thin_passes = settings.thin_passes
    rule.thin_points = settings.thin_points
    rule.thin_share = settings.thin_share
    rule.tan_mixed = math.tan(math.radians(settings.mixed_deg))
    rule.passes = settings.passes
    rule.shrink = settings.shrink
    rule.least_first = settings.least_first
    rule.start = settings.start_radius
    rule.largest = settings.max_radius
    rule.sparse = MIN_VOTES
    rule.outlier = OUTLIER
    return rule


@kernel(allocates=False)
def _step(number, ratio, r, rule):  # type: ignore[no-untyped-def]
    """The next radius by eq. 16-20: at least one voxel up or down, at most double or half."""
    growth = rule.growth[min(number, rule.growth.shape[0] - 1)]
    if number < MIN_VOTES:
        ratio = 1e-3
    factor = 1.0 + rule.sigma_target / ratio - rule.w_sigma + rule.w_points * (growth - 1.0)
    factor = min(2.0, max(0.5, factor))
    r_next = np.int64(np.floor(r * factor + 0.5))
    if r_next == r:
        r_next = r + 1 if factor > 1.0 else r - 1
    return min(rule.largest, max(1, r_next))


@kernel(allocates=False)
def _find_radius(at, rule, look):  # type: ignore[no-untyped-def]
    """Follow the radius until it repeats, on from where it is; of a cycle the smallest. The place
    of its sums, -1 where they are wanted."""
    kept, principal, state = look.kept, look.principal, look.state
    r, visited = state[RADIUS], state[VISITED]
    e = ask(at, r, look)
    while e >= 0 and (visited >> r) & 1 == 0:
        visited |= 1 << r
        r_next = _step(np.int64(kept[e, 0]), principal[LAMBDA + e], r, rule)
        if (visited >> r_next) & 1:
            if r_next < r:
                r = r_next
                e = ask(at, r, look)
            break
        r = r_next
        if r > state[REACH]:
            state[REACH] = r
            if r > FARTHEST:
                state[KNOWN] = 0
        e = ask(at, r, look)
    state[RADIUS], state[VISITED] = r, visited
    return e


@kernel(allocates=False)
def estimate(at, look):  # type: ignore[no-untyped-def]
    """(class, nx, ny, nz, gamma in half degrees, at a border, reach) of a voxel; class OPEN where
    sums are wanted first: then it goes on from there.

    at: halo, its margin, the voxel's place in the block, its observable, rule."""
    halo, margin, local, seen, rule = at
    kept, state = look.kept, look.state
    if seen == 0:
        return EMPTY, 0, 0, 0, 0, False, 0
    whole, one_line = _find_radius(at, rule, look), seen >> 32 != 0
    r, reach = state[RADIUS], state[REACH]
    if whole < 0:
        return OPEN, 0, 0, 0, 0, False, 0
    if one_line and margin < reach:
        state[WANTED] = POSES
        return OPEN, 0, 0, 0, 0, False, 0
    if kept[whole, 0] < rule.sparse:
        return SPARSE, 0, 0, 0, 0, False, reach
    one_pose = one_line and is_one_pose(
        halo, margin, local & 7, (local >> 3) & 7, local >> 6, r, seen
    )
    region = at, r, one_pose
    kind, nx, ny, nz, tan_gamma = _classify(whole, seen, one_pose, rule, look)
    e = whole
    if kind != ALIGNED:
        kind, nx, ny, nz, tan_gamma, e = _look_closer(
            region, kind, nx, ny, nz, tan_gamma, whole, look
        )
    if e < 0:
        return kind, 0, 0, 0, 255 if kind == THICK else 0, False, reach
    if kind == VALID and (seen >> 31) & 1 == 1 and _towards(seen, nx, ny, nz) < 4.0:
        kind = MIXED  # both sides of a thin thing, not one side from two directions
    half_degrees = np.int64(np.floor(np.arctan(tan_gamma) * 114.59155902616465 + 0.5))
    return (
        kind,
        np.int64(np.floor(nx * UNIT + 0.5)),
        np.int64(np.floor(ny * UNIT + 0.5)),
        np.int64(np.floor(nz * UNIT + 0.5)),
        half_degrees,
        _at_border(kept[e], seen, r, nx, ny, nz, rule),
        reach,
    )


@kernel(allocates=False)
def _look_closer(region, kind, nx, ny, nz, tan_gamma, whole, look):  # type: ignore[no-untyped-def]
    """Class and normal by the votes in the voxel's own slab: across the normal of the whole region,
    where that is thick of a smaller one, and where two surfaces meet in a thinner slab.

    Returns (class, normal, tan gamma, place of the sums that they are of, -1: there is none)."""
    at, r, one_pose = region
    _, _, _, seen, rule = at
    kept = look.kept
    number, of_whole = np.int64(kept[whole, 0]), tan_gamma  # of all that the region holds
    outlier = rule.outlier * ((seen >> 12) & 15) * number <= kept[whole, 1]  # few among many
    beside = kind == THICK and tan_gamma <= rule.tan_theta  # a plane, not on it: a noise shell
    if outlier or beside:
        return THICK, 0.0, 0.0, 0.0, 0.0, -1
    first = r  # radius of the region of the first normal: smaller where the full one is thick
    while True:
        passes = 1 if kind == VALID else rule.passes
        kind, nx, ny, nz, tan_gamma, e = _look_again(
            region, nx, ny, nz, SLAB, passes, rule.sparse, look
        )
        first -= 1
        if e < 0 or kind == VALID or first < max(1, r - rule.shrink):
            break
        e = ask(at, first, look)
        if e < 0:
            kind = OPEN
        if e < 0 or kept[e, 0] < rule.least_first:
            break
        _, nx, ny, nz, _ = _classify(e, seen, one_pose, rule, look)
        kind = THICK
    nearly = kind == THICK and tan_gamma < rule.tan_mixed < of_whole
    dense = e >= 0 and kept[e, 1] >= rule.thin_points * kept[e, 0]  # sure enough for a thinner slab
    if nearly and dense and r > 1:  # a step: a narrow face between two
        least = (number + rule.thin_share - 1) // rule.thin_share
        kind, nx, ny, nz, tan_gamma, e = _look_again(
            region, nx, ny, nz, THIN_SLAB, rule.thin_passes, least, look
        )
        if kind == SPARSE:  # a slice of a lump
            kind = THICK
    return kind, nx, ny, nz, tan_gamma, e


@kernel(allocates=False)
def _look_again(region, nx, ny, nz, slab, passes, least, look):  # type: ignore[no-untyped-def]
    """Class and normal again, and again: of the votes on the voxel's own side, by the last normal,
    and in its own slab. Returns what `_look_closer` does; SPARSE where these are fewer than
    `least`."""
    at, r, one_pose = region
    seen, rule, kept = at[3], at[4], look.kept
    kind, tan_gamma, e = SPARSE, 0.0, -1
    last = np.int64(-1)
    for _ in range(passes):
        key = slab_key(r, slab, nx, ny, nz)
        if key == last:  # and so on for ever
            break
        last = key
        e = ask(at, key, look)
        if e < 0:
            return OPEN, nx, ny, nz, 0.0, -1
        if kept[e, 0] < least:
            return SPARSE, nx, ny, nz, 0.0, -1
        kind, nx, ny, nz, tan_gamma = _classify(e, seen, one_pose, rule, look)
    return kind, nx, ny, nz, tan_gamma, e


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
def _classify(e, seen, one_pose, rule, look):  # type: ignore[no-untyped-def]
    """(class, normal towards the view, tan gamma) of the voxel with observable `seen`, by the sums
    at a place."""
    sums, principal = look.kept[e], look.principal
    nx, ny, nz = principal[NX + e], principal[NY + e], principal[NZ + e]
    tan_gamma = principal[TAN_GAMMA + e]
    if _towards(seen, nx, ny, nz) < 0.0:
        nx, ny, nz = -nx, -ny, -nz
    if principal[LAMBDA + e] < rule.epsilon or one_pose:
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
