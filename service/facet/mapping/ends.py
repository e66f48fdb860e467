"""Where planes end because the surface goes on in an arc: a wall that runs into a curved one.

The strips of a curved wall are no planes (`bends`), but the first of its voxels lie as near to the
flat wall as that one's own. What tells them apart is the arc: all strips of it lie on one circle
that touches the plane, and where the two touch the plane ends.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from facet.mapping.claims import LEFTOVER_REACH
from facet.mapping.eigen import smallest
from facet.mapping.kernel import kernel
from facet.mapping.merging import NARROW
from facet.mapping.normals import UNIT
from facet.mapping.planes import FREE, PlaneSet, PointFit, pool_points
from facet.mapping.settings import STEPS, MapSettings
from facet.mapping.store import centroid
from facet.mapping.table import Table

CUT = 11  # origin (3), 1/8 voxels; unit vectors away from the plane's bulk (3) and along its end
# (3), times UNIT; how far beyond members may be, and half the end's length, 1/8 voxels
OUTWARD = (
    STEPS // 4
)  # rings are moved outward by so much: the outline shall end where the plane does
BESIDE = 1.0  # voxels off the plane: no patch of it is farther off
STEEPEST = 1.0  # squared slope of a strip that touches its plane
ENOUGH_POINTS = 200  # pure points that say where a strip lies
LEAST_STRIPS = 3  # of an arc: the two faces of a bevelled edge lie on one, too
ROUNDS = 12
TINY = 1e-6  # voxels^2
SETTLED = 0.05  # voxels by which the last round may have moved the arc


class Ends(NamedTuple):
    """Where tile-planes end."""

    nodes: NDArray[np.int64]  # (E,) of the table
    cuts: NDArray[np.int64]  # (E, CUT) what lies beyond is not theirs

    def by_tile(self, table: Table) -> dict[tuple[int, int], tuple[tuple[int, ...], ...]]:
        """The cuts by (tile key, tile-plane in its tile)."""
        at = table.tile_of[self.nodes]
        keys, numbers = table.tile_keys[at].tolist(), (self.nodes - table.starts[at]).tolist()
        out: dict[tuple[int, int], tuple[tuple[int, ...], ...]] = {}
        for key, number, cut in zip(keys, numbers, self.cuts.tolist(), strict=True):
            out[key, number] = (*out.get((key, number), ()), tuple(cut))
        return out


class Strip(NamedTuple):
    """Strips seen along the end of a plane, C of them, in voxels."""

    weight: NDArray[np.float64]  # (C,) points
    s: NDArray[np.float64]  # (C,) mean distance from an origin, away from the plane's bulk
    h: NDArray[np.float64]  # (C,) and height over the plane
    ss: NDArray[np.float64]  # (C,) their covariance
    sh: NDArray[np.float64]
    hh: NDArray[np.float64]


@kernel(allocates=False)
def _quadratic(m, a, b):  # type: ignore[no-untyped-def]
    """a . M b of a symmetric matrix (xx, xy, xz, yy, yz, zz)."""
    return (
        a[0] * (m[0] * b[0] + m[1] * b[1] + m[2] * b[2])
        + a[1] * (m[1] * b[0] + m[3] * b[1] + m[4] * b[2])
        + a[2] * (m[2] * b[0] + m[4] * b[1] + m[5] * b[2])
    )


@kernel(allocates=False)
def _dot(a, b):  # type: ignore[no-untyped-def]
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


@kernel
def _side_view(num, mean, scatter, which, origin, along, normal):  # type: ignore[no-untyped-def]
    """The strips `which`, seen along the end of a plane."""
    count = which.shape[0]
    out = Strip(
        np.empty(count), np.empty(count), np.empty(count), np.empty(count), np.empty(count),
        np.empty(count),
    )  # fmt: skip
    for c in range(count):
        k = which[c]
        away = mean[k] - origin
        out.weight[c] = float(num[k])
        out.s[c], out.h[c] = _dot(away, along), _dot(away, normal)
        out.ss[c] = _quadratic(scatter[k], along, along) / num[k]
        out.sh[c] = _quadratic(scatter[k], along, normal) / num[k]
        out.hh[c] = _quadratic(scatter[k], normal, normal) / num[k]
    return out


@kernel
def _begin(strip, c):  # type: ignore[no-untyped-def]
    """(s where the parabola of strip c touches the plane, its radius, negative where it falls); the
    radius is 0 where it does not rise or fall away from there, or is no larger than its noise.

    Of a parabola s^2 / 2R the mean height is (far^2 + variance) / 2R, the mean slope far / R."""
    slope = strip.sh[c] / max(strip.ss[c], TINY)
    if slope * strip.h[c] <= 0.0 or slope * slope > STEEPEST:
        return 0.0, 0.0
    half = strip.h[c] / slope
    far = half + np.sqrt(max(0.0, half * half - strip.ss[c]))
    if far < NARROW * abs(slope):
        return 0.0, 0.0
    return strip.s[c] - far, far / slope


@kernel(allocates=False)
def _arc(strip, start, height):  # type: ignore[no-untyped-def]
    """(s, height, rms) of the centre of the circle that touches the plane and fits all strips best,
    by Gauss and Newton, and how far their points are off; rms is inf where it does not settle.

    A strip's points are off by its mean, which lies inside its arc by variance / 2 R, and by their
    spread along the radius there: |L^T u| for the covariance L L^T."""
    side = 1.0 if height > 0.0 else -1.0
    rms, moved = np.inf, np.inf
    for _ in range(ROUNDS):
        a, b, c, p, q, cost, total = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
        for k in range(strip.s.shape[0]):
            ds, dh = strip.s[k] - start, strip.h[k] - height
            r = np.sqrt(max(ds * ds + dh * dh, TINY))
            us, uh = ds / r, dh / r
            one = np.sqrt(max(strip.ss[k], TINY))
            two = strip.sh[k] / one
            three = np.sqrt(max(0.0, strip.hh[k] - two * two))
            chord = 0.5 * (strip.ss[k] + two * two)
            off = r + chord / abs(height) - abs(height), one * us + two * uh, three * uh
            by_s = -us, (two * us - one * uh) * uh / r, three * us * uh / r
            by_h = (
                -uh - side * (1.0 + chord / (height * height)),
                (one * uh - two * us) * us / r,
                -three * us * us / r,
            )
            w = strip.weight[k]
            total += w
            for i in range(3):
                a += w * by_s[i] * by_s[i]
                b += w * by_s[i] * by_h[i]
                c += w * by_h[i] * by_h[i]
                p += w * by_s[i] * off[i]
                q += w * by_h[i] * off[i]
                cost += w * off[i] * off[i]
        det = a * c - b * b
        if det <= 0.0:
            return start, height, np.inf
        ds, dh = (c * p - b * q) / det, (a * q - b * p) / det
        start, height = start - ds, height - dh
        rms, moved = np.sqrt(cost / total), max(abs(ds), abs(dh))
        if side * height < NARROW:  # it has curled up
            return start, height, np.inf
    return start, height, rms if moved <= SETTLED else np.inf


@kernel
def _where(view, touching, max_rms):  # type: ignore[no-untyped-def]
    """(s where the plane ends, how far beyond it may have members), from a side view in which
    `touching` is the strip that begins there; (0, 0) where they are no arc that touches it."""
    start, height = _begin(view, touching)
    if height == 0.0:
        return 0.0, 0.0
    start, height, rms = _arc(view, start, height)
    if rms > max_rms or view.s[touching] <= start:
        return 0.0, 0.0
    far = min(abs(height), np.sqrt(2.0 * BESIDE * abs(height)) + LEFTOVER_REACH)
    return start, far


@kernel
def _components(count, edges):  # type: ignore[no-untyped-def]
    """(C,) the least of the strips that each hangs together with along edges (E, 2)."""
    out = np.arange(count)
    changed = True
    while changed:
        changed = False
        for e in range(edges.shape[0]):
            a, b = edges[e, 0], edges[e, 1]
            least = min(out[a], out[b])
            changed |= out[a] != least or out[b] != least
            out[a], out[b] = least, least
    return out


@kernel
def _cuts(num, mean, scatter, unit, edges, pairs, normals, centres, max_rms):  # type: ignore[no-untyped-def]
    """(Q, CUT) for each pair of a strip and a plane beside it; all 0 where the plane does not end.

    num, mean, scatter: points of the C strips; unit: sums of their normals; edges: of strips that
    touch one another; normals, centres: of the planes."""
    out = np.zeros((pairs.shape[0], CUT), np.int64)
    component = _components(num.shape[0], edges)
    for q in range(pairs.shape[0]):
        strip, plane = pairs[q, 0], pairs[q, 1]
        which = np.flatnonzero((component == component[strip]) & (num >= ENOUGH_POINTS))
        if num[strip] < ENOUGH_POINTS or which.shape[0] < LEAST_STRIPS:
            continue
        normal = normals[plane]
        along = np.zeros(3)
        for k in which:
            along += unit[k]
        along -= _dot(along, normal) * normal
        length = np.sqrt(_dot(along, along))
        if length == 0.0:
            continue
        height = _dot(mean[strip] - centres[plane], normal)
        # normals turn towards the plane's bulk where the arc rises, and away where it falls
        along *= (-1.0 if _dot(unit[strip], along) * height > 0.0 else 1.0) / length
        origin = mean[strip] - height * normal
        view = _side_view(num, mean, scatter, which, origin, along, normal)
        start, far = _where(view, np.searchsorted(which, strip), max_rms)
        if far == 0.0:
            continue
        end = np.cross(normal, along)
        half = np.sqrt(3.0 * _quadratic(scatter[strip], end, end) / num[strip]) + LEFTOVER_REACH
        for a in range(3):
            out[q, a] = np.floor(STEPS * (origin[a] + start * along[a]) + 0.5)
            out[q, 3 + a] = np.floor(UNIT * along[a] + 0.5)
            out[q, 6 + a] = np.floor(UNIT * end[a] + 0.5)
        out[q, 9], out[q, 10] = np.int64(STEPS * far), np.int64(STEPS * half)
    return out


@kernel
def _normals(scatter, unit):  # type: ignore[no-untyped-def]
    """(K, 3) least-squares normals on the side of the members' own."""
    out = np.empty((scatter.shape[0], 3))
    for k in range(scatter.shape[0]):
        _, x, y, z, _, _ = smallest(scatter[k])
        side = 1.0 if x * unit[k, 0] + y * unit[k, 1] + z * unit[k, 2] > 0.0 else -1.0
        out[k, 0], out[k, 1], out[k, 2] = side * x, side * y, side * z
    return out


@kernel
def _edges_of(edges, held):  # type: ignore[no-untyped-def]
    """(N, 2) those of edges (E, 2) that begin at nodes that are held (T,), or end there: turned."""
    out, count = np.empty((2 * edges.shape[0], 2), np.int64), 0
    for e in range(edges.shape[0]):
        for way in range(2):
            if held[edges[e, way]]:
                out[count, 0], out[count, 1] = edges[e, way], edges[e, 1 - way]
                count += 1
    return out[:count]


class Touching(NamedTuple):
    """Pairs of a strip and a plane that touch, Q of them, in canonical order."""

    pairs: NDArray[np.int64]  # (Q, 2) strip, plane
    pair: NDArray[np.int64]  # (N,) of each tile-plane that it has there
    nodes: NDArray[np.int64]  # (N,) and the tile-plane


def _touching(
    label: NDArray[np.int64], bent: NDArray[np.int64], edges: NDArray[np.int64]
) -> Touching:
    """Which planes touch strips, along edges (E, 2) that begin at these."""
    beside = (bent[edges[:, 1]] == FREE) & (label[edges[:, 1]] != FREE)
    own = np.unique(bent[edges[beside, 0]] << 32 | edges[beside, 1])
    strip, node = own >> 32, own & 0xFFFFFFFF
    both, pair = np.unique(strip << 32 | label[node], return_inverse=True)
    return Touching(np.stack([both >> 32, both & 0xFFFFFFFF], axis=1), pair, node)


def find_ends(
    table: Table,
    planes: PlaneSet,
    bent: NDArray[np.int64],
    points: PointFit,
    settings: MapSettings,
) -> Ends:
    """Where tile-planes end beside strips that are bent. bent: (T,) the strip that each tile-plane
    is part of, FREE where it is of none; points: the planes'."""
    count, held = int(bent.max(initial=FREE)) + 1, bent != FREE
    num, mean, scatter = pool_points(table, bent, count)
    unit = np.zeros((count, 3))
    np.add.at(unit, bent[held], table.nodes.unit[held])
    edges = _edges_of(table.edges, held)
    touching = _touching(planes.label, bent, edges)
    cuts = _cuts(
        num, mean, scatter, unit, bent[edges[held[edges[:, 1]]]], touching.pairs,
        _normals(points.scatter, planes.nodes.unit), points.centroid / settings.voxel_m,
        settings.max_merged_sigma,
    )  # fmt: skip
    nodes = [np.zeros(0, np.int64)]
    ended = np.flatnonzero(cuts[:, 9])
    for q in ended.tolist():
        strip, plane = touching.pairs[q]
        adopted = np.flatnonzero((bent == strip) & (planes.label == plane))
        nodes.append(np.concatenate([touching.nodes[touching.pair == q], adopted]))
    sizes = [len(own) for own in nodes[1:]]
    return Ends(np.concatenate(nodes), np.repeat(cuts[ended], sizes, axis=0))


@kernel
def before_end(rows, blocks, columns, cuts):  # type: ignore[no-untyped-def]
    """Those of the voxel rows (M,) that lie beyond none of the cuts (C, CUT)."""
    out = np.empty_like(rows)
    count = 0
    for m in range(rows.shape[0]):
        x, y, z = centroid(blocks, columns, rows[m])
        beyond = False
        for c in range(cuts.shape[0]):
            cut = cuts[c]
            x0, y0, z0 = x - cut[0], y - cut[1], z - cut[2]
            s = cut[3] * x0 + cut[4] * y0 + cut[5] * z0
            a = cut[6] * x0 + cut[7] * y0 + cut[8] * z0
            beyond |= -OUTWARD * UNIT < s <= cut[9] * UNIT and abs(a) <= cut[10] * UNIT
        if not beyond:
            out[count] = rows[m]
            count += 1
    return out[:count]
