"""Ridges as segments: unbranched chains of sub-pixel points along the crest of ||V||."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import cv2
import numpy as np
from scipy.spatial import cKDTree

from suturetrack.initialization.model import InitializationConfig
from suturetrack.kernels import crest
from suturetrack.types import Float32, Float64

ARM = 14
"""Points of a segment that tell where it is heading."""
_SHORTEST = 4
"""Points; what is shorter says nothing about direction."""
_NEAR_PX = 6.0
"""How near an end comes to the side of the segment that it runs into."""
_GLANCING = 0.7
"""Cosine of the angle below which an end runs into the side of a segment rather than along it."""
_NOISE_QUANTILE = 0.9
_ABOVE_NOISE = 2.0


@dataclass(frozen=True, eq=False)
class Ridges:
    """The ridges of one view."""

    field: Float32
    """(H, W, 2)."""
    magnitude: Float32
    """(H, W) ||V||."""
    segments: tuple[Float64, ...]
    """Each (k, 2) pixels."""
    low: float
    """||V|| below which a pixel is background."""

    def sample(self, pixels: Float64) -> Float64:
        """(k,) ||V|| at (k, 2) pixels, bilinear, 0 outside."""
        maps = np.asarray(pixels, np.float32).reshape(-1, 1, 2)
        return cv2.remap(self.magnitude, maps, None, cv2.INTER_LINEAR).ravel().astype(float)


def find_ridges(field: Float32, config: InitializationConfig) -> Ridges:
    """Crest lines of an (H, W, 2) field, split at junctions; weak and tiny ones are left out."""
    # cv2.magnitude would make the last bits depend on where the arrays lie in memory.
    magnitude = np.sqrt(field[..., 0] ** 2 + field[..., 1] ** 2)
    background = float(np.quantile(magnitude[::4, ::4], _NOISE_QUANTILE))
    low = float(np.clip(_ABOVE_NOISE * background, config.low / 4, config.low))
    mask = crest.crest_pixels(field, magnitude, low)
    crest.thin(mask, magnitude)
    pixels, starts = crest.trace_chains(mask)
    if len(pixels) == 0:
        return Ridges(field, magnitude, (), low)
    refined = _sub_pixel(field, magnitude, pixels)
    strength = magnitude[pixels[:, 1], pixels[:, 0]]
    segments = tuple(
        refined[a:b]
        for a, b in pairwise(starts)
        if b - a >= _SHORTEST and (b - a >= ARM or strength[a:b].max() >= config.high)
    )
    return Ridges(field, magnitude, split_at_touches(segments), low)


def split_at_touches(segments: tuple[Float64, ...]) -> tuple[Float64, ...]:
    """Cuts segments where the end of another runs into them at a small angle, so that what two
    strands share becomes a segment of its own."""
    if not segments:
        return ()
    points = np.concatenate(segments)
    owner = np.repeat(np.arange(len(segments)), [len(s) for s in segments])
    index = np.concatenate([np.arange(len(s)) for s in segments])
    tree = cKDTree(points)
    cuts: dict[int, set[int]] = {}
    for k, segment in enumerate(segments):
        for arm, at in ((segment[:ARM], 0), (segment[::-1][:ARM], len(segment) - 1)):
            heading = arm[0] - arm[-1]
            heading = heading / max(float(np.linalg.norm(heading)), 1e-9)
            near = np.array(tree.query_ball_point(arm[0] + 2 * heading, _NEAR_PX), dtype=int)
            apart = (owner[near] != k) | (abs(index[near] - at) > 2 * ARM)
            near = near[apart]
            if len(near) == 0:
                continue
            hit = near[np.argmin(np.linalg.norm(points[near] - arm[0], axis=1))]
            other, i = segments[owner[hit]], int(index[hit])
            if min(i, len(other) - 1 - i) < _NEAR_PX:
                continue
            along = other[min(i + 4, len(other) - 1)] - other[max(i - 4, 0)]
            if abs(along @ heading) > _GLANCING * np.linalg.norm(along):
                cuts.setdefault(int(owner[hit]), set()).add(i)
    return tuple(
        piece
        for k, s in enumerate(segments)
        for piece in np.split(s, _apart(sorted(cuts.get(k, ()))))
        if len(piece) >= _SHORTEST
    )


def _apart(cuts: list[int]) -> list[int]:
    return [c for i, c in enumerate(cuts) if i == 0 or c - cuts[i - 1] > _NEAR_PX]


def _sub_pixel(field: Float32, magnitude: Float32, pixels: Float64) -> Float64:
    """Moves pixels along the normal to the vertex of the parabola through three values of ||V||."""
    v = field[pixels[:, 1], pixels[:, 0]]
    centre = magnitude[pixels[:, 1], pixels[:, 0]].astype(float)
    normals = np.c_[-v[:, 1], v[:, 0]] / centre[:, None]
    before, after = (
        cv2.remap(
            magnitude, (pixels + side * normals).astype(np.float32)[:, None], None, cv2.INTER_LINEAR
        ).ravel()
        for side in (-1, 1)
    )
    bend = before + after - 2 * centre
    shift = np.where(bend < 0, (before - after) / np.where(bend < 0, 2 * bend, 1), 0)
    return pixels + np.clip(shift, -1, 1)[:, None] * normals
