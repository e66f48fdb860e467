"""The model drawn as a dolls' house: parallel projection, exact hidden surfaces by a depth buffer.

A one-sided plane is drawn only where its facing side looks at the viewer, so near walls and
ceilings open by themselves; of those only the outlines stay, thin.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageDraw

from facet.export.colours import CLASS_COLOURS, HOLE_COLOURS, Rgb
from facet.export.triangles import inward_normal
from facet.export.viewpoint import corners, is_overhead, view_rotation
from facet_protocol.messages import HoleKind, Plane

Points = NDArray[np.float64]
PAPER: Rgb = (255, 255, 255)
INK: Rgb = (58, 62, 70)
OVERSAMPLE = 2
LIGHT = np.array([-0.62, 0.35, 0.70])  # towards the lamp, view: upper left, behind the viewer
LIFT_M = 0.02  # outlines lie this much nearer to the viewer than their plane


def render(planes: Sequence[Plane], width: int, height: int) -> Image.Image:
    """A picture of the planes, fitted to width x height pixels."""
    shown = [plane for plane in planes if plane.surfaces]
    R_view_world = view_rotation(shown)
    below = [plane for plane in shown if not is_overhead(plane)]
    canvas = Canvas.fit(corners(below), R_view_world, width, height)
    near = [plane for plane in shown if inward_normal(plane) @ R_view_world[2] > 0.02]
    far = [plane for plane in below if plane not in near]
    for plane in near:
        canvas.fill(plane)
    for plane in near:
        canvas.tint_holes(plane)
        canvas.outline(plane)
    for plane in far:
        canvas.ghost(plane)
    return canvas.picture(width, height)


@dataclass
class Canvas:
    """Colour and depth of every pixel, and the projection onto them."""

    R_view_world: NDArray[np.float64]
    scale: float  # pixels a metre
    shift: NDArray[np.float64]  # (2,) pixels
    colour: NDArray[np.float32]  # (H, W, 3)
    depth: NDArray[np.float32] = field(init=False)  # (H, W) m towards the viewer

    def __post_init__(self) -> None:
        self.depth = np.full(self.colour.shape[:2], -np.inf, dtype=np.float32)

    @classmethod
    def fit(cls, points: Points, R_view_world: Points, width: int, height: int) -> Canvas:
        size = np.array([width, height]) * OVERSAMPLE
        blank = np.broadcast_to(np.array(PAPER, dtype=np.float32), (size[1], size[0], 3)).copy()
        flat = (points @ R_view_world.T)[:, :2] if len(points) else np.zeros((1, 2))
        low, high = flat.min(axis=0), flat.max(axis=0)
        scale = float(np.min(size * 0.95 / np.maximum(high - low, 1e-3)))
        middle = (low + high) / 2.0 * np.array([1.0, -1.0])
        return cls(R_view_world, scale, size / 2.0 - scale * middle, blank)

    def project(self, ring: Points) -> Points:
        """(M, 2) pixels, y down, of world points (M, 3)."""
        flat = (ring @ self.R_view_world.T)[:, :2]
        return np.asarray(flat * np.array([self.scale, -self.scale]) + self.shift)

    def fill(self, plane: Plane) -> None:
        lit = float(self.R_view_world @ inward_normal(plane) @ LIGHT)
        shade = 0.72 + 0.36 * max(0.0, lit)
        colour = shade * np.array(CLASS_COLOURS[plane.plane_class], dtype=np.float32)
        for surface in plane.surfaces:
            holes = [plane.lift(hole.ring) for hole in surface.holes]
            self._paint(plane, plane.lift(surface.outer), holes, colour, 1.0, keep_depth=True)

    def tint_holes(self, plane: Plane) -> None:
        for surface in plane.surfaces:
            for hole in surface.holes:
                colour = np.array(HOLE_COLOURS[hole.kind], dtype=np.float32)
                opacity = 0.30 if hole.kind is HoleKind.OPENING else 0.45
                self._paint(plane, plane.lift(hole.ring), [], colour, opacity, keep_depth=False)

    def _paint(
        self,
        plane: Plane,
        outer: Points,
        holes: list[Points],
        colour: NDArray[np.float32],
        opacity: float,
        keep_depth: bool,
    ) -> None:
        rings = [self.project(ring) for ring in (outer, *holes)]
        window = self._window(rings[0], 0)
        mask = self._mask(rings, window)
        depth = self._plane_depth(plane, window)
        seen = mask & (depth >= self.depth[window])
        self.colour[window][seen] += opacity * (colour - self.colour[window][seen])
        if keep_depth:
            self.depth[window][seen] = depth[seen]

    def outline(self, plane: Plane) -> None:
        """Edges of what is visible; the holes' in their own colours."""
        for ring, colour, width in _edges(plane):
            self._stroke(plane, ring, colour, width, 0.9, hidden=False)

    def ghost(self, plane: Plane) -> None:
        """The outlines of a wall that is seen from behind: faint, and through everything."""
        for ring, colour, _ in _edges(plane):
            self._stroke(plane, ring, colour, 2, 0.28, hidden=True)

    def _stroke(
        self, plane: Plane, ring: Points, colour: Rgb, width: int, opacity: float, hidden: bool
    ) -> None:
        line = self.project(ring)
        window = self._window(line, width)
        origin = np.array([window[1].start, window[0].start])
        image = Image.new("L", _size(window), 0)
        closed = np.vstack([line, line[:1]]) - origin
        ImageDraw.Draw(image).line(closed.ravel().tolist(), fill=255, width=width, joint="curve")
        mask = np.asarray(image) > 0
        if not hidden:
            mask &= self._plane_depth(plane, window) + LIFT_M >= self.depth[window]
        ink = np.array(colour, dtype=np.float32)
        self.colour[window][mask] += opacity * (ink - self.colour[window][mask])

    def _window(self, line: Points, margin: int) -> tuple[slice, slice]:
        """Rows and columns that hold the line."""
        top = np.array(self.colour.shape[1::-1])
        low = np.clip(np.floor(line.min(axis=0)).astype(int) - margin, 0, top - 1)
        high = np.clip(np.ceil(line.max(axis=0)).astype(int) + margin + 1, low + 1, top)
        return slice(int(low[1]), int(high[1])), slice(int(low[0]), int(high[0]))

    def _mask(self, rings: list[Points], window: tuple[slice, slice]) -> NDArray[np.bool_]:
        origin = np.array([window[1].start, window[0].start])
        image = Image.new("1", _size(window), 0)
        draw = ImageDraw.Draw(image)
        for k, ring in enumerate(rings):
            draw.polygon((ring - origin).ravel().tolist(), fill=int(k == 0))
        return np.asarray(image)

    def _plane_depth(self, plane: Plane, window: tuple[slice, slice]) -> NDArray[np.float32]:
        """Depth at each pixel of the window: n . x = d solved for the third view coordinate."""
        n_view = self.R_view_world @ plane.normal
        column = (np.arange(window[1].start, window[1].stop) + 0.5 - self.shift[0]) / self.scale
        row = -(np.arange(window[0].start, window[0].stop) + 0.5 - self.shift[1]) / self.scale
        depth = (plane.d - n_view[0] * column[None, :] - n_view[1] * row[:, None]) / n_view[2]
        return np.asarray(depth, dtype=np.float32)

    def picture(self, width: int, height: int) -> Image.Image:
        whole = Image.fromarray(np.clip(self.colour, 0, 255).astype(np.uint8))
        return whole.resize((width, height), Image.Resampling.BOX)


def _size(window: tuple[slice, slice]) -> tuple[int, int]:
    return window[1].stop - window[1].start, window[0].stop - window[0].start


def _edges(plane: Plane) -> list[tuple[Points, Rgb, int]]:
    edges = []
    for surface in plane.surfaces:
        edges.append((plane.lift(surface.outer), INK, 3))
        edges += [(plane.lift(h.ring), HOLE_COLOURS[h.kind], 3) for h in surface.holes]
    return edges
