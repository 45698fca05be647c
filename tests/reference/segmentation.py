"""Eq. (1) and Algorithm 1 to the letter, in float64."""

from __future__ import annotations

import math

import numpy as np


def gaussian_derivatives(sigma):
    """Taps, for correlation, of the Gaussian, sigma times its first and sigma^2 times its second
    derivative, made exact for parabolas: each (2r + 1,)."""
    radius = math.ceil(3 * sigma)
    x = np.arange(-radius, radius + 1, dtype=float)
    g = np.exp(-(x**2) / (2 * sigma**2))
    g /= g.sum()
    first = x * g / (x**2 * g).sum()
    second = (x**2 / sigma**2 - 1) * g
    second -= second.sum() * g
    second *= 2 / (x**2 * second).sum()
    return g, sigma * first, sigma**2 * second


def correlate(plane, taps_v, taps_u):
    radius = len(taps_v) // 2
    padded = np.pad(plane, radius, mode="edge")
    rows = sum(t * padded[k : k + plane.shape[0]] for k, t in enumerate(taps_v))
    return sum(t * rows[:, k : k + plane.shape[1]] for k, t in enumerate(taps_u))


def curvatures(plane, sigma):
    """lambda_1, lambda_2 and v_1 of the Hessian: (H, W), (H, W) and (H, W, 2)."""
    plane = np.asarray(plane, np.float64)
    g, g1, g2 = gaussian_derivatives(sigma)
    hessian = np.empty((*plane.shape, 2, 2))
    hessian[..., 0, 0] = correlate(plane, g, g2)
    hessian[..., 0, 1] = hessian[..., 1, 0] = correlate(plane, g1, g1)
    hessian[..., 1, 1] = correlate(plane, g2, g)
    values, directions = np.linalg.eigh(hessian)
    order = np.argsort(np.abs(values), axis=-1)
    lambda_1, lambda_2 = np.moveaxis(np.take_along_axis(values, order, -1), -1, 0)
    v_1 = np.take_along_axis(directions, order[..., None, :1], -1)[..., 0]
    return lambda_1, lambda_2, v_1


def strength(plane, sigma, signs):
    """S^2 of eq. (1), 0 where the sign of lambda_2 is not in the closed range: (H, W)."""
    lambda_1, lambda_2, _ = curvatures(plane, sigma)
    sign = np.sign(lambda_2)
    return np.where((sign >= signs[0]) & (sign <= signs[1]), lambda_1**2 + lambda_2**2, 0)


def ridge_vectors(plane, sigma, beta, c, polarity):
    """Eq. (1): (H, W, 2)."""
    lambda_1, lambda_2, v_1 = curvatures(plane, sigma)
    v_1 = np.where((v_1[..., 1:] < 0) | ((v_1[..., 1:] == 0) & (v_1[..., :1] < 0)), -v_1, v_1)
    with np.errstate(divide="ignore", invalid="ignore"):
        ratio = np.nan_to_num(lambda_1 / lambda_2)
    strength = np.sqrt(lambda_1**2 + lambda_2**2)
    length = np.exp(-(ratio**2) / (2 * beta**2)) * (1 - np.exp(-(strength**2) / (2 * c**2)))
    if polarity == "dark":
        length[lambda_2 < 0] = 0
    if polarity == "bright":
        length[lambda_2 > 0] = 0
    return length[..., None] * v_1


def strongest(fields):
    """At every pixel the longest vector of several scales."""
    fields = np.stack(fields)
    best = np.argmax(np.linalg.norm(fields, axis=-1), axis=0)
    return np.take_along_axis(fields, best[None, ..., None], 0)[0]


def quantile(values, share):
    """The value below which `share` of every second column lie."""
    every = np.sort(values[:, ::2], axis=None)
    return every[-math.ceil((1 - share) * len(every))]


def blur_angles(v_r, kernel):
    """Algorithm 1, for all pixels at a time, the taps in raster order."""
    height, width, _ = v_r.shape
    radius = len(kernel) // 2
    padded = np.pad(v_r, ((radius, radius), (radius, radius), (0, 0)), mode="edge")
    v_t = kernel[radius, radius] * v_r
    for row in range(len(kernel)):
        for column in range(len(kernel)):
            if row == column == radius:
                continue
            neighbour = padded[row : row + height, column : column + width]
            d = np.sum(v_t * neighbour, axis=-1, keepdims=True)
            weighted = kernel[row, column] * neighbour
            v_t = np.where(d > 0, v_t + weighted, v_t - weighted)
    return v_t


def gaussian_kernel(sigma):
    """G of Algorithm 1."""
    offsets = np.arange(-2, 3, dtype=float)
    kernel = np.exp(-(offsets[:, None] ** 2 + offsets**2) / (2 * sigma**2))
    return kernel / kernel.sum()


def fade_rims(plane, field, reach, faint=0.1, fades_from=0.55, gone_at=0.85):
    """The field without ridges of which only one side is brighter."""
    length = np.linalg.norm(field, axis=-1)
    u, v = np.moveaxis(field / np.maximum(length, 1e-9)[..., None], -1, 0)
    row, column = np.indices(length.shape)

    def across(distance):
        y = np.clip(np.rint(row + distance * u).astype(int), 0, length.shape[0] - 1)
        x = np.clip(np.rint(column - distance * v).astype(int), 0, length.shape[1] - 1)
        return plane[y, x]

    middle = np.min([across(k * reach) for k in (-0.5, 0, 0.5)], axis=0)
    sides = np.array([[across(s * k * reach) for k in (1, 1.5, 2)] for s in (1, -1)]).max(1)
    sides = np.maximum(sides, middle)
    depth = sides.sum(0) - 2 * middle
    with np.errstate(divide="ignore", invalid="ignore"):
        uneven = np.abs(sides[0] - sides[1]) / depth
    kept = np.clip((gone_at - uneven) / (gone_at - fades_from), 0, 1)
    kept[(length < faint) | (depth == 0)] = 1
    margin = int(np.ceil(2 * reach)) + 1
    border = np.ones(length.shape, bool)
    border[margin:-margin, margin:-margin] = False
    kept[border] = 1
    return kept[..., None] * field


def longer_than(least, vectors):
    """(k, 2) pixels (u, v), row by row, at which vectors are longer than that."""
    v, u = np.nonzero(vectors[..., 0] ** 2 + vectors[..., 1] ** 2 > np.float32(least * least))
    return np.stack([u, v], axis=1)


def keep_longer_of_half(half, dark, bounds, mask, field):
    """The field with the longer vectors of one of half the size, where the mask says so, and the mask."""
    out, left = field.copy(), mask.copy()
    fades_from, gone_at = bounds
    (height, width), (rows, columns) = mask.shape, half.shape[:2]
    for y, x in np.argwhere(mask):
        v = np.clip((y + 0.5) * rows / height - 0.5, 0, rows - 1)
        u = np.clip((x + 0.5) * columns / width - 0.5, 0, columns - 1)
        row, column = np.arange(rows), np.arange(columns)
        share = np.outer(np.maximum(1 - abs(row - v), 0), np.maximum(1 - abs(column - u), 0))
        place = np.unravel_index(share.argmax(), share.shape)
        if dark[place]:
            left[y, x] = 0
            continue
        nearest = half[place]
        signed = half * np.where(half @ nearest < 0, -1, 1)[..., None]
        vector = (share[..., None] * signed).sum((0, 1))
        length = np.linalg.norm(vector)
        vector = vector * np.clip((gone_at - length) / (gone_at - fades_from), 0, 1)
        if np.linalg.norm(vector) > np.linalg.norm(field[y, x]):
            out[y, x] = vector
    return out, left
