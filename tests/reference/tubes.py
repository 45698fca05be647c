"""Literal twins of `suturetrack.kernels.tubes`, for strands that do not meet themselves."""

from __future__ import annotations

import numpy as np
from scipy.special import erf

from suturetrack.types import Float64


def strand(
    path: Float64, light: Float64, colour: Float64, gloss: Float64, size: tuple[int, int]
) -> tuple[Float64, Float64, Float64]:
    """(H, W) coverage and depth and (H, W, 3) colour of one strand, for every pixel."""
    width, height = size
    pixels = np.stack(np.meshgrid(np.arange(width), np.arange(height)), axis=-1)[:, :, None]
    start, end = path[:-1, :2], path[1:, :2]
    length = np.linalg.norm(end - start, axis=1)
    way = (end - start) / length[:, None]
    offset = pixels - start
    along = (offset * way).sum(-1)
    across = way[:, 0] * offset[..., 1] - way[:, 1] * offset[..., 0]
    low, high = np.zeros(len(way)), length.copy()
    low[0], high[-1] = -np.inf, np.inf
    place = np.clip(along, low, high)
    distance = np.hypot(across, along - place)
    nearest = distance.argmin(-1)[..., None]

    def take(values: Float64) -> Float64:
        return np.take_along_axis(np.broadcast_to(values, distance.shape), nearest, -1)[..., 0]

    t = take(place / length)
    inside = np.clip(t, 0, 1)
    depth, radius, blur = (
        take(path[:-1, k]) + inside * take(path[1:, k] - path[:-1, k]) for k in (2, 3, 4)
    )
    side = take(distance) * np.where(take(across) >= 0, 1, -1)
    scale = 1 / (np.sqrt(2) * blur)
    cover = 0.5 * (erf((side + radius) * scale) - erf((side - radius) * scale))
    first, last = nearest[..., 0] == 0, nearest[..., 0] == len(way) - 1
    cover *= np.where(first, 0.5 * (1 + erf(t * length[0] * scale)), 1)
    cover *= np.where(last, 0.5 * (1 - erf((t - 1) * length[-1] * scale)), 1)
    x = np.clip(side / (radius + 0.7 * blur), -1, 1)
    front = np.sqrt(1 - x**2)
    l0, l1, l2, l3 = (
        take(light[:-1, k]) + inside * take(light[1:, k] - light[:-1, k]) for k in range(4)
    )
    diffuse = np.maximum(x * l0 + front * l1, 0)
    shine = 255 * gloss[1] * np.maximum(x * l2 + front * l3, 0) ** gloss[2]
    shown = colour * (gloss[0] + (1 - gloss[0]) * diffuse)[..., None] + shine[..., None]
    return cover * gloss[3], depth, shown


def composite(layers: list[tuple[Float64, Float64, Float64]]) -> Float64:
    """(H, W, 4) colour times coverage, and coverage, of layers over one another."""
    cover, depth, colour = (np.stack(part) for part in zip(*layers, strict=True))
    order = np.argsort(depth, axis=0)
    cover = np.take_along_axis(cover, order, 0)
    colour = np.take_along_axis(colour, order[..., None], 0)
    clear = np.cumprod(np.concatenate([np.ones_like(cover[:1]), 1 - cover]), axis=0)
    share = clear[:-1] * cover
    return np.concatenate([(share[..., None] * colour).sum(0), share.sum(0)[..., None]], axis=-1)


def develop(
    background: Float64, layer: Float64, vignette: Float64, gain: Float64, noise: Float64
) -> Float64:
    """(H, W, 3) image of the layer over the background."""
    value = background * (1 - layer[..., 3:]) + layer[..., :3]
    return np.clip(np.floor(value * vignette[..., None] * gain + noise + 0.5), 0, 255)
