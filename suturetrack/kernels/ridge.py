"""Eq. (1) and Algorithm 1, row by row, so that what one step writes is still in cache for the next."""

from __future__ import annotations

import math
from functools import cache
from typing import Any

import numpy as np
from numba import njit

from suturetrack.kernels import FAST
from suturetrack.types import Float32, Image, Int32, Int64, UInt16

# As FAST, without licence to mix up +0 and -0.
_exact = {"fastmath": {"contract"}, "error_model": "numpy"}
_sign_bit = np.int32(-(1 << 31))
_zero, _half, _one, _two = np.float32(0), np.float32(0.5), np.float32(1), np.float32(2)
_tiny = np.float32(1e-20)


@cache
def gaussian_taps(sigma: float) -> Float32:
    """(3, r + 1) the right halves, centre first, of a Gaussian and of its first two derivatives.

    The derivatives are those of unit parabolas exactly, multiplied by sigma and sigma^2 so that
    scales compare. Cut at 3 sigma and filled up with zeros to r, a multiple of 4.
    """
    radius = math.ceil(3 * sigma)
    x = np.arange(-(-radius // 4) * 4 + 1, dtype=float)
    smooth = np.where(x <= radius, np.exp(-(x**2) / (2 * sigma**2)), 0)
    smooth /= smooth[0] + 2 * smooth[1:].sum()
    slope = x * smooth
    slope *= sigma / (2 * (x * slope).sum())
    curve = (x**2 / sigma**2 - 1) * smooth
    curve -= smooth * (curve[0] + 2 * curve[1:].sum())
    curve *= sigma**2 / (x**2 * curve).sum()
    return np.array([smooth, slope, curve], np.float32)


@njit(cache=True, **FAST)
def mix_channels(blue: Image, green: Image, red: Image, weights: Float32, plane: Float32) -> None:
    """plane = weights . (blue, green, red), each (H, W)."""
    for y in range(plane.shape[0]):
        b, g, r, target = blue[y], green[y], red[y], plane[y]
        for x in range(len(target)):
            target[x] = weights[0] * b[x] + weights[1] * g[x] + weights[2] * r[x]


@cache
def taps_of(sigmas: tuple[float, ...]) -> tuple[Float32, Int64]:
    """(k, 3, r + 1) `gaussian_taps` of k scales, filled up with zeros, and (k,) their own radii."""
    every = [gaussian_taps(sigma) for sigma in sigmas]
    radii = np.array([taps.shape[1] - 1 for taps in every])
    largest = radii.max()
    return np.array([np.pad(t, [(0, 0), (0, largest + 1 - t.shape[1])]) for t in every]), radii


@njit(cache=True, **FAST)
def ridge_field(
    plane: Float32,
    taps: Float32,
    radii: Int64,
    shape: tuple[float, float],
    signs: tuple[float, float],
    kernel: Float32,
    out: Float32,
    strength: Float32,
) -> None:
    """Eq. (1) and Algorithm 1 for every pixel of `plane`, edges replicated.

    Args:
        plane: (H, W).
        taps: with `radii`, of `taps_of`; of several scales the longest vector counts.
        shape: (1 / (2 beta^2), 1 / (2 c^2)).
        signs: lambda_2 / |lambda_2| must lie in this closed range: (1, 1) finds dark ridges,
            (-1, -1) bright ones, (-1, 1) both.
        kernel: (5, 5), G.
        out: (H, W, 2), written: V_o.
        strength: (ceil(H / 4), W), written: S^2 of every fourth row, 0 where the sign is refused.
    """
    height, width = plane.shape
    radius = taps.shape[2] - 1
    rings = np.empty((len(taps), 2 * radius + 1, width), np.float32)
    padded = np.empty((3, width + 2 * radius), np.float32)
    hessian = np.empty((3, width), np.float32)
    vectors = np.empty((2, 5, width + 4), np.float32)
    sums = np.empty((2, width), np.float32)
    for row in range(height + 2):
        if row < height:
            u, v = vectors[0, row % 5], vectors[1, row % 5]
            for scale in range(len(taps)):
                ring = rings[scale, : 2 * radii[scale] + 1]
                _hessian_row(plane, row, taps[scale], radii[scale], ring, padded, hessian)
                _ridge_row(hessian, shape, signs, scale > 0, u[2:], v[2:], strength[row // 4])
            for line in (u, v):
                line[0] = line[1] = line[2]
                line[width + 2] = line[width + 3] = line[width + 1]
        if row >= 2:
            blur_row(vectors, row - 2, height, kernel, sums, out[row - 2])


@njit(cache=True, **FAST)
def keep_longer(vectors: Float32, out: Float32) -> None:
    """At every pixel of (H, W, 2) fields, the longer of both vectors into `out`."""
    for y in range(len(out)):
        row, kept = vectors[y], out[y]
        for x in range(len(kept)):
            u, v, p, q = row[x, 0], row[x, 1], kept[x, 0], kept[x, 1]
            is_longer = u * u + v * v > p * p + q * q
            kept[x, 0] = u if is_longer else p
            kept[x, 1] = v if is_longer else q


@njit(cache=True, **FAST)
def longer_than(least: float, vectors: Float32, places: Int32) -> UInt16:
    """(k, 2) pixels (u, v), row by row, at which (H, W, 2) vectors are longer than that; (H * W,) is room."""
    height, width, _ = vectors.shape
    flat = vectors.reshape(height * width, 2)
    squared, count = np.float32(least * least), 0
    for i in range(len(flat)):
        # Without a branch, this goes on however the vectors are.
        places[count] = i
        count += flat[i, 0] * flat[i, 0] + flat[i, 1] * flat[i, 1] > squared
    pixels = np.empty((count, 2), np.uint16)
    for k in range(count):
        pixels[k, 0], pixels[k, 1] = places[k] % width, places[k] // width
    return pixels


@njit(cache=True, **FAST)
def _hessian_row(
    plane: Float32,
    row: int,
    taps: Float32,
    radius: int,
    ring: Float32,
    padded: Float32,
    hessian: Float32,
) -> None:
    """Second derivatives in one row; `ring` keeps those along u of the rows around it."""
    height, width = plane.shape
    smooth, slope, curve = taps[0, : radius + 1], taps[1, : radius + 1], taps[2, : radius + 1]
    size = width + 2 * radius
    line, first, second = padded[0, :size], padded[1, :size], padded[2, :size]
    for y in range(row + radius if row else -radius, row + radius + 1):
        _pad(plane[min(max(y, 0), height - 1)], radius, line)
        _second_difference(line, curve, ring[(y + radius) % len(ring)])
    _smooth_ring(ring, row + radius, smooth, hessian[0])
    _vertical_derivatives(plane, row, slope, curve, first, second)
    _smooth_row(second, smooth, hessian[2])
    _first_difference(first, slope, hessian[1])


@njit(cache=True, **FAST)
def _pad(row: Float32, radius: int, padded: Float32) -> None:
    width = len(row)
    inside = padded[radius:]
    for x in range(width):
        inside[x] = row[x]
    for x in range(radius):
        padded[x] = row[0]
        padded[radius + width + x] = row[width - 1]


# Differences are taken before they are weighted: grey values are exact in float32, so the
# derivatives are accurate relative to themselves and not to the brightness. The loops take four
# taps at a time, for which `taps` is filled up with zeros.


@njit(cache=True, **FAST)
def _second_difference(padded: Float32, taps: Float32, out: Float32) -> None:
    radius = len(taps) - 1
    centre = padded[radius:]
    for x in range(len(out)):
        out[x] = _zero
    for k in range(1, radius + 1, 4):
        a, b = padded[radius - k - 3 :], padded[radius + k :]
        t0, t1, t2, t3 = taps[k], taps[k + 1], taps[k + 2], taps[k + 3]
        for x in range(len(out)):
            c = centre[x]
            near = t0 * ((a[x + 3] - c) + (b[x] - c)) + t1 * ((a[x + 2] - c) + (b[x + 1] - c))
            far = t2 * ((a[x + 1] - c) + (b[x + 2] - c)) + t3 * ((a[x] - c) + (b[x + 3] - c))
            out[x] += near + far


@njit(cache=True, **FAST)
def _first_difference(padded: Float32, taps: Float32, out: Float32) -> None:
    radius = len(taps) - 1
    for x in range(len(out)):
        out[x] = _zero
    for k in range(1, radius + 1, 4):
        a, b = padded[radius - k - 3 :], padded[radius + k :]
        t0, t1, t2, t3 = taps[k], taps[k + 1], taps[k + 2], taps[k + 3]
        for x in range(len(out)):
            near = t0 * (b[x] - a[x + 3]) + t1 * (b[x + 1] - a[x + 2])
            out[x] += near + (t2 * (b[x + 2] - a[x + 1]) + t3 * (b[x + 3] - a[x]))


@njit(cache=True, **FAST)
def _smooth_row(padded: Float32, taps: Float32, out: Float32) -> None:
    radius = len(taps) - 1
    centre = padded[radius:]
    for x in range(len(out)):
        out[x] = taps[0] * centre[x]
    for k in range(1, radius + 1, 4):
        a, b = padded[radius - k - 3 :], padded[radius + k :]
        t0, t1, t2, t3 = taps[k], taps[k + 1], taps[k + 2], taps[k + 3]
        for x in range(len(out)):
            near = t0 * (a[x + 3] + b[x]) + t1 * (a[x + 2] + b[x + 1])
            out[x] += near + (t2 * (a[x + 1] + b[x + 2]) + t3 * (a[x] + b[x + 3]))


@njit(cache=True, **FAST)
def _smooth_ring(ring: Float32, row: int, taps: Float32, out: Float32) -> None:
    size = len(ring)
    centre = ring[row % size]
    for x in range(len(out)):
        out[x] = taps[0] * centre[x]
    for k in range(1, len(taps), 4):
        a0, a1 = ring[(row - k) % size], ring[(row - k - 1) % size]
        a2, a3 = ring[(row - k - 2) % size], ring[(row - k - 3) % size]
        b0, b1 = ring[(row + k) % size], ring[(row + k + 1) % size]
        b2, b3 = ring[(row + k + 2) % size], ring[(row + k + 3) % size]
        t0, t1, t2, t3 = taps[k], taps[k + 1], taps[k + 2], taps[k + 3]
        for x in range(len(out)):
            near = t0 * (a0[x] + b0[x]) + t1 * (a1[x] + b1[x])
            far = t2 * (a2[x] + b2[x]) + t3 * (a3[x] + b3[x])
            out[x] = out[x] + near + far


@njit(cache=True, **FAST)
def _vertical_derivatives(
    plane: Float32,
    row: int,
    slope: Float32,
    curve: Float32,
    padded_first: Float32,
    padded_second: Float32,
) -> None:
    height, width = plane.shape
    radius = len(slope) - 1
    centre = plane[row]
    first, second = padded_first[radius:], padded_second[radius:]
    for x in range(width):
        first[x] = second[x] = _zero
    for k in range(1, radius + 1, 2):
        a0, b0 = plane[max(row - k, 0)], plane[min(row + k, height - 1)]
        a1, b1 = plane[max(row - k - 1, 0)], plane[min(row + k + 1, height - 1)]
        s0, s1, c0, c1 = slope[k], slope[k + 1], curve[k], curve[k + 1]
        for x in range(width):
            up0, down0 = a0[x] - centre[x], b0[x] - centre[x]
            up1, down1 = a1[x] - centre[x], b1[x] - centre[x]
            first[x] = first[x] + s0 * (down0 - up0) + s1 * (down1 - up1)
            second[x] = second[x] + c0 * (up0 + down0) + c1 * (up1 + down1)
    for line in (padded_first, padded_second):
        for x in range(radius):
            line[x] = line[radius]
            line[radius + width + x] = line[radius + width - 1]


@njit(cache=True, **FAST)
def _ridge_row(
    hessian: Float32,
    shape: tuple[float, float],
    signs: tuple[float, float],
    keep_longer: bool,
    out_u: Float32,
    out_v: Float32,
    strength: Float32,
) -> None:
    huu, huv, hvv = hessian[0], hessian[1], hessian[2]
    ratio_scale, strength_scale = np.float32(shape[0]), np.float32(shape[1])
    lowest, highest = np.float32(signs[0]), np.float32(signs[1])
    for x in range(len(strength)):
        trace, difference, twist = huu[x] + hvv[x], huu[x] - hvv[x], _two * huv[x]
        discriminant = difference * difference + twist * twist
        root = np.sqrt(discriminant)
        # 2 lambda_2 = sign (|trace| + root), 2 lambda_1 = sign (|trace| - root)
        sign = _one if trace > _zero else -_one
        wanted = _one if (sign >= lowest) & (sign <= highest) else _zero
        ratio = (abs(trace) - root) / (abs(trace) + root + _tiny)
        s2 = wanted * _half * (trace * trace + discriminant)
        length = _decay(ratio * ratio * ratio_scale) * (_one - _decay(s2 * strength_scale))
        # v_1 is half the angle whose cosine and sine these are, taken in [0, pi).
        scale = -sign / (root + _tiny)
        cosine, sine = difference * scale if root > _zero else _one, twist * scale
        major = np.sqrt(_half + _half * abs(cosine))
        minor = _half * abs(sine) / major
        u = length * (major if cosine >= _zero else minor)
        v = length * (minor if cosine >= _zero else major)
        u = u if sine >= _zero else -u
        old_u, old_v = out_u[x], out_v[x]
        keep = keep_longer & (old_u * old_u + old_v * old_v >= length * length)
        out_u[x] = old_u if keep else u
        out_v[x] = old_v if keep else v
        strength[x] = s2


@njit(inline="always", **FAST)
def _decay(x: Any) -> Any:
    """exp(-x) for x >= 0, within 2e-7: 2^n by its bits, the rest by a series."""
    exponent = max(x * np.float32(-1 / math.log(2)), np.float32(-126))
    n = np.int32(exponent - _half)
    t = (exponent - np.float32(n)) * np.float32(math.log(2))
    p = np.float32(1 / 120) + t * np.float32(1 / 720)
    p = np.float32(1 / 6) + t * (np.float32(1 / 24) + t * p)
    p = _one + t * (_one + t * (_half + t * p))
    return p * np.int32((n + 127) << 23).view(np.float32)


@njit(cache=True, **FAST)
def blur_row(
    vectors: Float32, row: int, height: int, kernel: Float32, sums: Float32, out: Float32
) -> None:
    """Algorithm 1 for one row, taps in raster order, edges replicated.

    Args:
        vectors: (2, n, W + 4), V_r and two replicated columns on both sides; row y at y % n.
        row: the row.
        height: of the image.
        kernel: (5, 5), G.
        sums: (2, W), overwritten.
        out: (W, 2), written: V_o.
    """
    kept, width = vectors.shape[1], len(out)
    for axis in range(2):
        centre, total = vectors[axis, row % kept, 2:], sums[axis]
        for x in range(width):
            total[x] = kernel[2, 2] * centre[x]
    for k in range(5):
        beside = min(max(row + k - 2, 0), height - 1) % kept
        u, v = vectors[0, beside], vectors[1, beside]
        _add_taps(u, v, kernel[k], k == 2, sums[0], sums[1])
    for x in range(width):
        out[x, 0] = sums[0, x]
        out[x, 1] = sums[1, x]


@njit(cache=True, **_exact)
def _add_taps(
    u: Float32, v: Float32, taps: Float32, skip_centre: bool, sum_u: Float32, sum_v: Float32
) -> None:
    t0, t1, t2, t3, t4 = taps
    if skip_centre:
        t2 = _zero
    for x in range(len(sum_u)):
        a, b = _add_tap(sum_u[x], sum_v[x], u[x], v[x], t0)
        a, b = _add_tap(a, b, u[x + 1], v[x + 1], t1)
        a, b = _add_tap(a, b, u[x + 2], v[x + 2], t2)
        a, b = _add_tap(a, b, u[x + 3], v[x + 3], t3)
        sum_u[x], sum_v[x] = _add_tap(a, b, u[x + 4], v[x + 4], t4)


@njit(inline="always", **_exact)
def _add_tap(a: Any, b: Any, u: Any, v: Any, tap: Any) -> Any:
    # -d, and +0 where d = 0: its sign bit says whether to add.
    minus_d = (_zero - a * u) - b * v
    flip = np.int32(np.float32(minus_d).view(np.int32) & _sign_bit)
    signed = np.int32(np.float32(-tap).view(np.int32) ^ flip).view(np.float32)
    return a + signed * u, b + signed * v


@njit(cache=True, **FAST)
def quantile(values: Float32, share: float) -> float:
    """The value below which `share` of `values` (2-D, not negative) lie, within 0.4 %.

    Counts the leading 16 bits of the numbers, every second one of a row.
    """
    counts = np.zeros(1 << 15, np.int32)
    total = 0
    for row in values.view(np.int32):
        for x in range(0, len(row), 2):
            counts[row[x] >> 16] += 1
        total += (len(row) + 1) // 2
    wanted = math.ceil((1 - share) * total)
    bits = len(counts) - 1
    above = counts[bits]
    while above < wanted:
        bits -= 1
        above += counts[bits]
    return float(np.int32((bits << 16) + (1 << 15)).view(np.float32)) if bits else 0.0
