"""Ridges as segments: unbranched chains of sub-pixel points along the crest of ||V||."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import cv2
import numpy as np

from suturetrack.initialization.model import InitializationConfig
from suturetrack.kernels import crest
from suturetrack.types import Float32, Float64

_SHORTEST = 4
"""Points; what is shorter says nothing about direction."""
_DIRECTION_REACH = 7
"""Points from an end over which its direction is taken."""
_END_REACH = 15
"""Points from an end over which its strength is taken."""


@dataclass(frozen=True, eq=False)
class Ridges:
    """The ridges of one view."""

    field: Float32
    """(H, W, 2)."""
    magnitude: Float32
    """(H, W) ||V||."""
    segments: tuple[Float64, ...]
    """Each (k, 2) pixels."""

    def sample(self, pixels: Float64) -> Float64:
        """(k,) ||V|| at (k, 2) pixels, bilinear, 0 outside."""
        maps = np.asarray(pixels, np.float32).reshape(-1, 1, 2)
        return cv2.remap(self.magnitude, maps, None, cv2.INTER_LINEAR).ravel().astype(float)


def find_ridges(field: Float32, config: InitializationConfig) -> Ridges:
    """Crest lines of an (H, W, 2) field, split at junctions; weak and tiny ones are left out."""
    magnitude = cv2.magnitude(field[..., 0], field[..., 1])
    mask = crest.crest_pixels(field, magnitude, config.low)
    crest.thin(mask, magnitude)
    pixels, starts = crest.trace_chains(mask)
    if len(pixels) == 0:
        return Ridges(field, magnitude, ())
    refined = _sub_pixel(field, magnitude, pixels)
    strength = magnitude[pixels[:, 1], pixels[:, 0]]
    segments = tuple(
        refined[a:b]
        for a, b in pairwise(starts)
        if b - a >= _SHORTEST and strength[a:b].max() >= config.high
    )
    return Ridges(field, magnitude, segments)


@dataclass(frozen=True, eq=False)
class Ends:
    """The ends of all segments: end 2i is the start of segment i, 2i + 1 its end."""

    positions: Float64
    """(2n, 2) pixels."""
    outward: Float64
    """(2n, 2) unit vectors out of the segments."""
    strengths: Float64
    """(2n,) mean ||V|| of the last stretch."""


def find_ends(ridges: Ridges) -> Ends:
    """The ends of the segments, in order."""
    pieces = [
        piece for s in ridges.segments for piece in (s[:_END_REACH], s[: -_END_REACH - 1 : -1])
    ]
    positions = np.array([p[0] for p in pieces]).reshape(-1, 2)
    inside = np.array([p[min(_DIRECTION_REACH, len(p)) - 1] for p in pieces]).reshape(-1, 2)
    outward = positions - inside
    outward /= np.maximum(np.linalg.norm(outward, axis=1, keepdims=True), 1e-9)
    strengths = np.array([ridges.sample(p[len(p) // 4 :]).mean() for p in pieces])
    return Ends(positions, outward, strengths)


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
