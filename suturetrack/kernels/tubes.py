"""Draws threads as anti-aliased tubes: compiled loops over the pixels near them.

A strand covers a pixel with the integral of a box of the strand's width under the Gaussian of the
lens and the pixel. Each strand leaves a fragment in each pixel it covers; fragments are sorted by
depth and laid over one another, so that a thread crosses itself properly.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numba
import numpy as np
from numpy.typing import NDArray

from suturetrack.types import Float32, Float64, Image

Int32 = NDArray[np.int32]

_LEAST_CAPACITY = 1 << 18
# Standard deviations of the blur at which a strand's coverage is cut off.
_REACH = 2.6


class Fragments(NamedTuple):
    """What covers the pixels: a linked list of fragments for each pixel."""

    head: Int32
    """(H, W) first fragment of the pixel, -1 for none."""
    touched: Int32
    """(2, H * W) rows and columns of pixels that hold fragments."""
    link: Int32
    """(capacity, 3) next fragment, strand, segment."""
    value: Float32
    """(capacity, 7) place along the segment, offset across, depth, coverage, blue, green, red."""
    used: Int32
    """(2,) fragments in use, pixels touched."""


def make_fragments(size: tuple[int, int]) -> Fragments:
    """Empty fragments for images of `size` (width, height)."""
    width, height = size
    capacity = max(width * height // 2, _LEAST_CAPACITY)
    return Fragments(
        np.full((height, width), -1, np.int32),
        np.zeros((2, width * height), np.int32),
        np.zeros((capacity, 3), np.int32),
        np.zeros((capacity, 7), np.float32),
        np.zeros(2, np.int32),
    )


@numba.njit(cache=True, fastmath=True, nogil=True)
def splat(strand: int, path: Float64, window: int, fragments: Fragments) -> None:
    """Leaves the fragments of one strand.

    Args:
        strand: its number.
        path: (n, 5) u, v, depth, radius and blur (standard deviation), all but the depth in px.
        window: samples nearer than that along the path are the same pass of the strand.
        fragments: where to.
    """
    head, touched, link, value, used = fragments
    height, width = head.shape
    last = len(path) - 2
    for i in range(last + 1):
        u0, v0 = path[i, 0], path[i, 1]
        du, dv = path[i + 1, 0] - u0, path[i + 1, 1] - v0
        length = math.sqrt(du * du + dv * dv)
        if length < 1e-9:
            continue
        du, dv = du / length, dv / length
        reach = path[i, 3] + _REACH * path[i, 4]
        first_row = max(math.ceil(min(v0, path[i + 1, 1]) - reach), 0)
        last_row = min(math.floor(max(v0, path[i + 1, 1]) + reach), height - 1)
        first_column = max(math.ceil(min(u0, path[i + 1, 0]) - reach), 0)
        last_column = min(math.floor(max(u0, path[i + 1, 0]) + reach), width - 1)
        for row in range(first_row, last_row + 1):
            left, right = first_column, last_column
            if abs(dv) > 1e-3:
                middle, half = u0 + (row - v0) * du / dv, reach / abs(dv)
                left = max(left, math.ceil(middle - half))
                right = min(right, math.floor(middle + half))
            for column in range(left, right + 1):
                along = (column - u0) * du + (row - v0) * dv
                across = (row - v0) * du - (column - u0) * dv
                place = along
                if i > 0:
                    place = max(place, 0.0)
                if i < last:
                    place = min(place, length)
                distance = math.sqrt(across * across + (along - place) ** 2)
                if distance > reach or place < -reach or place > length + reach:
                    continue
                entry = head[row, column]
                while entry >= 0 and (link[entry, 1] != strand or abs(link[entry, 2] - i) > window):
                    entry = link[entry, 0]
                if entry < 0:
                    if used[0] == len(link):
                        continue
                    entry = used[0]
                    used[0] += 1
                    if head[row, column] < 0:
                        touched[0, used[1]], touched[1, used[1]] = row, column
                        used[1] += 1
                    link[entry, 0], link[entry, 1] = head[row, column], strand
                    head[row, column] = entry
                elif abs(value[entry, 1]) <= distance:
                    continue
                link[entry, 2] = i
                value[entry, 0] = place / length
                value[entry, 1] = distance if across >= 0 else -distance


@numba.njit(cache=True, fastmath=True, nogil=True, inline="always")
def _between(table: Float64, row: int, column: int, share: float) -> float:
    return table[row, column] + share * (table[row + 1, column] - table[row, column])


@numba.njit(cache=True, fastmath=True, nogil=True)
def shade(
    first: int, path: Float64, light: Float64, colour: Float64, gloss: Float64, fragments: Fragments
) -> None:
    """Fills in coverage, depth and colour of the fragments of the strand drawn last.

    Args:
        first: number of its first fragment.
        path: as for `splat`.
        light: (n, 4) cosines of the light, then of the highlight, with the direction across the strand
            and with the direction to the viewer.
        colour: (3,) BGR of the strand, 0 to 255.
        gloss: (4,) share of ambient light, strength and exponent of the highlight, opacity.
        fragments: where they are.
    """
    _, _, link, value, used = fragments
    last = len(path) - 2
    for entry in range(first, used[0]):
        i, t = link[entry, 2], value[entry, 0]
        inside = min(max(t, 0.0), 1.0)
        radius = _between(path, i, 3, inside)
        blur = _between(path, i, 4, inside)
        offset = value[entry, 1]
        scale = 1.0 / (math.sqrt(2.0) * blur)
        cover = 1.0
        if abs(offset) > radius - 3.0 * blur:
            cover = 0.5 * (
                math.erf((offset + radius) * scale) - math.erf((offset - radius) * scale)
            )
        length = math.hypot(path[i + 1, 0] - path[i, 0], path[i + 1, 1] - path[i, 1])
        if i == 0:
            cover *= 0.5 * math.erfc(-t * length * scale)
        if i == last:
            cover *= 0.5 * math.erfc((t - 1.0) * length * scale)
        x = min(max(offset / (radius + 0.7 * blur), -1.0), 1.0)
        front = math.sqrt(1.0 - x * x)
        diffuse = x * _between(light, i, 0, inside) + front * _between(light, i, 1, inside)
        shine = x * _between(light, i, 2, inside) + front * _between(light, i, 3, inside)
        shine = 0.0 if gloss[1] == 0.0 else max(shine, 0.0) ** gloss[2] * gloss[1] * 255.0
        value[entry, 2] = _between(path, i, 2, inside)
        value[entry, 3] = cover * gloss[3]
        for c in range(3):
            value[entry, 4 + c] = (
                colour[c] * (gloss[0] + (1.0 - gloss[0]) * max(diffuse, 0.0)) + shine
            )


@numba.njit(cache=True, fastmath=True, nogil=True)
def composite(fragments: Fragments, layer: Float32, weight: float) -> None:
    """Lays the fragments of each pixel over one another, adds them to the layer, and forgets them.

    Args:
        fragments: shaded ones.
        layer: (H, W, 4) BGR times coverage, and coverage, of what is before the background.
        weight: share of the exposure.
    """
    head, touched, link, value, used = fragments
    for k in range(used[1]):
        row, column = touched[0, k], touched[1, k]
        clear = 1.0
        while head[row, column] >= 0 and clear > 0.002:
            nearest, before = head[row, column], -1
            previous, entry = head[row, column], link[head[row, column], 0]
            while entry >= 0:
                if value[entry, 2] < value[nearest, 2]:
                    nearest, before = entry, previous
                previous, entry = entry, link[entry, 0]
            if before < 0:
                head[row, column] = link[nearest, 0]
            else:
                link[before, 0] = link[nearest, 0]
            share = clear * value[nearest, 3] * weight
            for c in range(3):
                layer[row, column, c] += share * value[nearest, 4 + c]
            layer[row, column, 3] += share
            clear *= 1.0 - value[nearest, 3]
        head[row, column] = -1
    used[0] = used[1] = 0


@numba.njit(cache=True, fastmath=True, nogil=True)
def develop(
    background: Float32,
    layer: Float32,
    vignette: Float32,
    gain: Float32,
    noise: NDArray[np.int8],
    amplitude: float,
    picture: Image,
) -> None:
    """The image that the sensor gives: the layer over the background, exposed, noisy; clears the layer.

    Args:
        background: (H, W, 3) BGR, 0 to 255.
        layer: as `composite` leaves it.
        vignette: (H, W) share of the light that arrives.
        gain: (3,) exposure and white balance.
        noise: (H, W, 3) with a standard deviation of 16.
        amplitude: standard deviation of the noise in gray levels, divided by 16.
        picture: (H, W, 3) BGR, written.
    """
    height, width = vignette.shape
    for row in range(height):
        for column in range(width):
            clear = np.float32(1.0) - layer[row, column, 3]
            light = vignette[row, column]
            for c in range(3):
                value = background[row, column, c] * clear + layer[row, column, c]
                value = value * light * gain[c] + noise[row, column, c] * amplitude
                picture[row, column, c] = np.uint8(min(max(value + 0.5, 0.0), 255.0))
            if clear != 1.0:
                layer[row, column, :] = 0.0
