"""What the field shows beside a curve: response profiles, the best path through them, its peaks."""

from __future__ import annotations

import numba
import numpy as np

from suturetrack.types import Bool, Float32, Float64, Int64

# A strand claims the ridge so far to its sides; two that are nearer than this make one ridge.
_CLAIM_PX, APART_PX = 4.0, 2.0
# Points of a strand that are looked at, or passed over, together.
_BLOCK = 8
# Cosine of the angle up to which two strands may be mistaken for one another.
_PARALLEL = 0.8
# The line along a thread: its price of roughness, by squared px, its largest step from sample to sample
# and the half width of a peak in places, its least response and its shortest run.
_ROUGHNESS, _REACH, _PEAK_HALF = 0.2, 4, 3
_LEAST_RESPONSE, _SHORTEST_RUN_PX = 0.2, 10.0


@numba.njit(cache=True, nogil=True)
def response_at(field: Float32, u: float, v: float, tu: float, tv: float) -> float:
    """(t.V)^2 / |V| of eq. (4) at pixel (u, v), bilinear; 0 outside the image.

    The interpolated quantity has no sign to wrap, unlike V itself.
    """
    height, width = field.shape[0], field.shape[1]
    if not (0 <= u <= width - 1 and 0 <= v <= height - 1):
        return 0.0
    column, row = min(int(u), width - 2), min(int(v), height - 2)
    fu, fv = u - column, v - row
    total = 0.0
    for i in range(2):
        for j in range(2):
            x, y = field[row + i, column + j, 0], field[row + i, column + j, 1]
            squared = x * x + y * y
            if squared > 0:
                share = (fv if i else 1 - fv) * (fu if j else 1 - fu)
                along = tu * x + tv * y
                total += share * along * along / np.sqrt(squared)
    return total


@numba.njit(cache=True, nogil=True)
def responses(field: Float32, pixels: Float64, tangents: Float64) -> Float64:
    """(k,) responses at (k, 2) pixels for (k, 2) unit tangents."""
    out = np.empty(len(pixels))
    for j in range(len(pixels)):
        out[j] = response_at(field, pixels[j, 0], pixels[j, 1], tangents[j, 0], tangents[j, 1])
    return out


@numba.njit(cache=True, nogil=True)
def shifted_responses(
    field: Float32, pixels: Float64, tangents: Float64, shifts: Float64, most: float
) -> Float64:
    """(n,) mean response, each of `most` at most, at (k, 2) pixels under each of (n, 2) shifts."""
    out = np.zeros(len(shifts))
    for i in range(len(shifts)):
        for j in range(len(pixels)):
            u, v = pixels[j, 0] + shifts[i, 0], pixels[j, 1] + shifts[i, 1]
            out[i] += min(response_at(field, u, v, tangents[j, 0], tangents[j, 1]), most)
    return out / len(pixels)


@numba.njit(cache=True, nogil=True)
def magnitudes(field: Float32, pixels: Float64) -> Float64:
    """(k,) bilinear |V| at (k, 2) pixels; 0 outside the image."""
    height, width = field.shape[0], field.shape[1]
    out = np.zeros(len(pixels))
    for j in range(len(pixels)):
        u, v = pixels[j, 0], pixels[j, 1]
        if not (0 <= u <= width - 1 and 0 <= v <= height - 1):
            continue
        column, row = min(int(u), width - 2), min(int(v), height - 2)
        fu, fv = u - column, v - row
        for i in range(2):
            for h in range(2):
                x, y = field[row + i, column + h, 0], field[row + i, column + h, 1]
                share = (fv if i else 1 - fv) * (fu if h else 1 - fu)
                out[j] += share * np.sqrt(x * x + y * y)
    return out


@numba.njit(cache=True, nogil=True)
def normal_profiles(
    field: Float32, pixels: Float64, tangents: Float64, offsets: Float64, leniency: float
) -> Float64:
    """(k, m) responses at the m offsets along the normals (-tv, tu) of the k samples.

    `leniency` is the share of |V| itself, whatever its direction, in the response.
    """
    out = np.empty((len(pixels), len(offsets)))
    vectors, shares = np.empty((4, 2, len(offsets)), np.float32), np.empty((4, len(offsets)))
    across = np.empty(len(offsets))
    for j in range(len(pixels)):
        tu, tv = tangents[j, 0], tangents[j, 1]
        _gather(field, pixels[j], tangents[j], offsets, vectors, shares)
        _respond(vectors, shares, tu, tv, out[j])
        if leniency > 0:
            _respond(vectors, shares, -tv, tu, across)
            for i in range(len(offsets)):
                any_way = out[j, i] + across[i]
                out[j, i] += leniency * (any_way - out[j, i])
    return out


@numba.njit(cache=True, nogil=True)
def _gather(
    field: Float32,
    pixel: Float64,
    tangent: Float64,
    offsets: Float64,
    vectors: Float32,
    shares: Float64,
) -> None:
    """The four vectors around each place along a normal and what they count; 0 outside the image."""
    height, width = field.shape[0], field.shape[1]
    for i in range(len(offsets)):
        u, v = pixel[0] - offsets[i] * tangent[1], pixel[1] + offsets[i] * tangent[0]
        if not (0 <= u <= width - 1 and 0 <= v <= height - 1):
            vectors[:, :, i] = 0.0
            shares[:, i] = 0.0
            continue
        column, row = min(int(u), width - 2), min(int(v), height - 2)
        fu, fv = u - column, v - row
        for c in range(4):
            down, right = c >> 1, c & 1
            vectors[c, 0, i] = field[row + down, column + right, 0]
            vectors[c, 1, i] = field[row + down, column + right, 1]
            shares[c, i] = (fv if down else 1 - fv) * (fu if right else 1 - fu)


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _respond(vectors: Float32, shares: Float64, tu: float, tv: float, out: Float64) -> None:
    """`response_at` for the places of `_gather`, without a branch, so that many go at a time."""
    out[:] = 0.0
    for c in range(4):
        x, y, share = vectors[c, 0], vectors[c, 1], shares[c]
        for i in range(len(out)):
            squared = x[i] * x[i] + y[i] * y[i]
            along = tu * x[i] + tv * y[i]
            response = share[i] * along * along / np.sqrt(squared)
            out[i] += response if squared > 0 else 0.0


@numba.njit(cache=True, nogil=True)
def best_path(gain: Float64, stiffness: float, reach: int) -> Int64:
    """The path of indices, one a row of `gain`, of the largest sum of gains less its roughness.

    Args:
        gain: (k, m) what each choice is worth.
        stiffness: price of the squared step, in indices, from a row to the next.
        reach: the largest step.
    """
    count, width = gain.shape
    origin = np.empty((count, width), np.int64)
    padded = np.full(width + 2 * reach, -np.inf)
    best, top = padded[reach : reach + width], np.empty(width)
    best[:] = gain[0]
    for j in range(1, count):
        where = origin[j]
        top[:] = -np.inf
        for step in range(-reach, reach + 1):
            before, price = padded[reach + step :], stiffness * step * step
            for i in range(width):
                value = before[i] - price
                better = value > top[i]
                top[i] = value if better else top[i]
                where[i] = i + step if better else where[i]
        for i in range(width):
            best[i] = top[i] + gain[j, i]
    path = np.empty(count, np.int64)
    path[count - 1] = np.argmax(best)
    for j in range(count - 1, 0, -1):
        path[j - 1] = origin[j, path[j]]
    return path


@numba.njit(cache=True, nogil=True)
def peaks(profiles: Float64, path: Int64, half: int) -> tuple[Float64, Float64]:
    """Sub-sample peaks beside the path.

    From the path the nearest summit is climbed, and a parabola fitted to `half` samples on each side
    of it.

    Returns:
        (k,) positions in indices, nan where there is no summit inside the profile; (k,) responses
        there.
    """
    count, width = profiles.shape
    position = np.full(count, np.nan)
    height = np.zeros(count)
    square = 0.0
    fourth = 0.0
    for x in range(-half, half + 1):
        square += x * x
        fourth += x**4
    n = 2 * half + 1
    for j in range(count):
        i = path[j]
        while i + 1 < width and profiles[j, i + 1] > profiles[j, i]:
            i += 1
        while i > 0 and profiles[j, i - 1] > profiles[j, i]:
            i -= 1
        height[j] = profiles[j, i]
        if i < half or i >= width - half or profiles[j, i] <= 0:
            continue
        total = 0.0
        linear = 0.0
        quadratic = 0.0
        for x in range(-half, half + 1):
            y = profiles[j, i + x]
            total += y
            linear += x * y
            quadratic += x * x * y
        bend = (n * quadratic - square * total) / (n * fourth - square * square)
        if bend < 0:
            position[j] = i + min(max(-linear / square / (2 * bend), -1.0), 1.0)
    return position, height


@numba.njit(cache=True, nogil=True)
def _boxes(points: Float64) -> Float64:
    """(n, 4) lowest and highest u, lowest and highest v of each `_BLOCK` points in a row."""
    count = (len(points) + _BLOCK - 1) // _BLOCK
    boxes = np.empty((count, 4))
    for b in range(count):
        block = points[b * _BLOCK : (b + 1) * _BLOCK]
        for a in range(2):
            boxes[b, 2 * a], boxes[b, 2 * a + 1] = block[:, a].min(), block[:, a].max()
    return boxes


@numba.njit(cache=True, nogil=True)
def _is_far(box: Float64, pixel: Float64, far: float) -> bool:
    """Whether all points in a box lie further from the pixel than `far`, in u or in v."""
    u, v = pixel[0], pixel[1]
    return box[0] - u > far or u - box[1] > far or box[2] - v > far or v - box[3] > far


@numba.njit(cache=True, nogil=True)
def claimed(
    strand: tuple[Float64, Float64, Float64],
    others: tuple[Float64, Float64, Float64],
    offsets: Float64,
    apart: float,
) -> Bool:
    """(k, m) places beside a strand that belong to another one: what is predicted nearest has them.

    Args:
        strand: (k, 2) pixels, (k, 2) unit tangents and (k,) px along the strand of its samples.
        others: the same of the q samples that may claim places.
        offsets: (m,) places along the normals (-tv, tu) of the samples.
        apart: what is nearer than this along the strand is the strand itself.
    """
    pixels, tangents, along = strand
    other_pixels, other_tangents, other_along = others
    out = np.zeros((len(pixels), len(offsets)), np.bool_)
    far, boxes = np.abs(offsets).max() + _CLAIM_PX, _boxes(other_pixels)
    for j in range(len(pixels)):
        tu, tv = tangents[j, 0], tangents[j, 1]
        for b in range(len(boxes)):
            if _is_far(boxes[b], pixels[j], far):
                continue
            for q in range(b * _BLOCK, min((b + 1) * _BLOCK, len(other_pixels))):
                du, dv = other_pixels[q, 0] - pixels[j, 0], other_pixels[q, 1] - pixels[j, 1]
                if abs(du) > far or abs(dv) > far or abs(other_along[q] - along[j]) < apart:
                    continue
                across, ahead = dv * tu - du * tv, du * tu + dv * tv
                parallel = abs(tu * other_tangents[q, 0] + tv * other_tangents[q, 1])
                if abs(ahead) > _CLAIM_PX or abs(across) < APART_PX or parallel < _PARALLEL:
                    continue
                for i in range(len(offsets)):
                    away = abs(offsets[i] - across)
                    if away < _CLAIM_PX and away < abs(offsets[i]):
                        out[j, i] = True
    return out


@numba.njit(cache=True, nogil=True)
def doubled(
    strand: tuple[Float64, Float64, Float64],
    others: tuple[Float64, Float64, Float64],
    apart: float,
    near: float,
) -> Bool:
    """(k,) samples of a strand that lie on another one, less than `near` px beside it.

    The other arguments are those of `claimed`.
    """
    pixels, tangents, along = strand
    other_pixels, other_tangents, other_along = others
    out = np.zeros(len(pixels), np.bool_)
    far, boxes = max(near, _CLAIM_PX), _boxes(other_pixels)
    for j in range(len(pixels)):
        tu, tv = tangents[j, 0], tangents[j, 1]
        for b in range(len(boxes)):
            if out[j] or _is_far(boxes[b], pixels[j], far):
                continue
            for q in range(b * _BLOCK, min((b + 1) * _BLOCK, len(other_pixels))):
                du, dv = other_pixels[q, 0] - pixels[j, 0], other_pixels[q, 1] - pixels[j, 1]
                if abs(du) > far or abs(dv) > far or abs(other_along[q] - along[j]) < apart:
                    continue
                parallel = abs(tu * other_tangents[q, 0] + tv * other_tangents[q, 1])
                out[j] |= abs(dv * tu - du * tv) < near and parallel > _PARALLEL
    return out


@numba.njit(cache=True, nogil=True)
def best_line(
    field: Float32,
    strand: tuple[Float64, Float64, Float64],
    others: tuple[Float64, Float64, Float64],
    apart: float,
    lengths: Float64,
    level: Float64,
    reach: float,
    step: float,
    leniency: float,
) -> tuple[Float64, Float64, Bool]:
    """The thread beside its samples, as one continuous line.

    Args:
        field: (H, W, 2).
        strand, others, apart: of `claimed`; what belongs to others is not taken.
        lengths: (k,) px of the curve that each sample stands for.
        level: (k,) response of a clear view of the thread.
        reach, step: px to each side of a sample, and from one place to the next.
        leniency: of `normal_profiles`.

    Returns:
        (k,) px along the normal, 0 where nothing was found; (k,) responses there; (k,) whether the
        thread was found.
    """
    pixels, tangents, _ = strand
    half = int(np.round(reach / step))
    places = step * np.arange(-half, half + 1)
    profiles = normal_profiles(field, pixels, tangents, places, leniency)
    taken = claimed(strand, others, places, apart)
    gain = np.empty_like(profiles)
    for j in range(len(pixels)):
        for i in range(len(places)):
            clear = 0.0 if taken[j, i] else min(profiles[j, i] / level[j], 1.0)
            away = places[i] / reach
            gain[j, i] = clear - 0.1 * (away * away)
    path = best_path(gain, _ROUGHNESS * step**2, _REACH)
    offset, response = peaks(profiles, path, _PEAK_HALF)
    found = np.zeros(len(pixels), np.bool_)
    for j in range(len(pixels)):
        if np.isfinite(offset[j]) and response[j] > _LEAST_RESPONSE * level[j]:
            is_taken = taken[j, int(np.round(offset[j]))]
            found[j] = _is_inside(field, pixels[j]) and not is_taken
        offset[j] = (offset[j] - half) * step
    found = solid(found, lengths, _SHORTEST_RUN_PX)
    return np.where(found, offset, 0.0), response, found


@numba.njit(cache=True, nogil=True)
def _is_inside(field: Float32, pixel: Float64) -> bool:
    """Whether a pixel lies within the image, and not on its border."""
    height, width = field.shape[0], field.shape[1]
    return 1 <= pixel[0] <= width - 2 and 1 <= pixel[1] <= height - 2


@numba.njit(cache=True, nogil=True)
def covered(
    pixels: Float64, tangents: Float64, offsets: Float64, points: Float64, near: float
) -> Bool:
    """(k, m) places along the normals of the samples that are nearer than `near` to a point."""
    out = np.zeros((len(pixels), len(offsets)), np.bool_)
    far, boxes = np.abs(offsets).max() + near, _boxes(points)
    for j in range(len(pixels)):
        for b in range(len(boxes)):
            if _is_far(boxes[b], pixels[j], far):
                continue
            for q in range(b * _BLOCK, min((b + 1) * _BLOCK, len(points))):
                du, dv = points[q, 0] - pixels[j, 0], points[q, 1] - pixels[j, 1]
                if abs(du) > far or abs(dv) > far:
                    continue
                across = dv * tangents[j, 0] - du * tangents[j, 1]
                ahead = du * tangents[j, 0] + dv * tangents[j, 1]
                if abs(ahead) >= near:
                    continue
                for i in range(len(offsets)):
                    if (offsets[i] - across) ** 2 + ahead * ahead < near * near:
                        out[j, i] = True
    return out


@numba.njit(cache=True, nogil=True)
def solid(flags: Bool, lengths: Float64, least: float) -> Bool:
    """(k,) `flags` without the runs whose total of `lengths` is below `least`."""
    kept = flags.copy()
    j = 0
    while j < len(flags):
        if not flags[j]:
            j += 1
            continue
        start, total = j, 0.0
        while j < len(flags) and flags[j]:
            total += lengths[j]
            j += 1
        if total < least:
            kept[start:j] = False
    return kept
