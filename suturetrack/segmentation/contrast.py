"""What tells a thread from its surroundings: a mix of the colour channels, and the thread's width.

The second derivatives that eq. (1) looks at are linear in the channels. Across the thread they are
a vector h, one number a channel; everywhere else they scatter with a covariance C. Then
w = C^-1 h is Fisher's mix: in no other does the thread stand out more from texture, noise, and the
highlights that make h itself vary along the thread. In it the thread is dark.

A highlight on wet tissue is white, and in a mix of differences, as of blue from red, may be as dark as
the thread. Where there are some, the best of the mixes is taken in which they are not, if the thread stays
clear in that one.

What is learned is kept relative to the mean of each channel, so that it holds under another exposure
and white balance, and in the other camera.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import cv2
import numpy as np
from scipy.spatial import cKDTree

from suturetrack.kernels.ridge import gaussian_taps
from suturetrack.polylines import unit
from suturetrack.segmentation.smear import SCALES
from suturetrack.types import Float64, Image, Int64

SIGMAS = (1.2, 2.4, 4.8, 9.6)
"""Scales at which a thread is looked for, px: the first one in the image and its halves."""
GRAY = np.array([29.0, 150.0, 77.0]) / 256
"""The usual weights of blue, green and red, in 256ths."""

# Half the width of the windows in which the thread is followed, so that what varies along it counts,
# and in which all else is clutter: a thread that crosses near the seed is much of what is near.
_WINDOW_PX, _NEAR_PX = 128, 64
_SNAP_PX = 8
# Fewest pixels of a halved image within which a ridge is looked for.
_LEAST_SNAP_PX = 2
# Pixels from which ridges are followed, and px between them.
_STARTS, _APART_PX = 4, 2
_ROUNDS = 2
_SHORTEST_PX = 20
# Threads stand out from the clutter by 2.1 to 6.6 (median 4), textures by up to 2.2 (median 0.5).
_LEAST_SCORE = 1.9
# Variance of the second derivatives that even a flawless picture is taken to have, grey levels^2, and the
# brightness below which one has less in which nothing stands out from that.
_FLOOR, _BRIGHT = 1.0, 70.0
# Second derivative across the edge of a shadow, as a share of the brightness.
_SHADOW = 0.05
# Scales that show the thread by less than this share of the clearest one are too small or too large.
_CLEAR = 0.7
# How far beside the middle of a wider ridge one runs that is a half of it, in scales of the wider one: pixels
# that are rounded leave 0.33 between middles.
_ASIDE = 0.45
# Of the scale that responds most, the share at which the middle is seen best.
_BELOW = 0.8
# Places beside a ridge, against the scale, at which its rims are.
_BESIDE = (-3, -2.5, -2, -1.5, 1.5, 2, 2.5, 3)
# A mix that is not better than gray by this factor is not worth its noise.
_WORTH = 1.1
# A ridge found in gray that is not better than one of another mix by this factor is not taken for it.
_BETTER = 1.04
# What of its distinctness a thread keeps, at least, in a mix that is blind to highlights: white ones do not.
_KEPT = 0.667
# A highlight's second derivative is about a third of what it differs from the ground; below 0.4 of the
# thread's, an end is seen before it.
_FAINTER = 1.2
# Grey levels of a highlight in every channel, and the share of the picture below which there are none.
_WHITE, _SCARCE = 225, 2e-4
# Along a curve: how many windows are looked at, and half their width, in pixels and for wide threads in
# sigmas; and how far from the rim, in sigmas, the filter does not look beyond it.
_WINDOWS, _HALF_PX, _HALF, _FROM_RIM = 10, 32, 4.0, 3.0
# Least cosine between two looks at one thread, or two places on it: 0.88 and more on one ground,
# elsewhere any; other colours give up to 0.64.
_ALIKE = 0.5
# What a thread that is lost keeps of the contrast with which it was seen last.
_FAINTEST = 0.25


@dataclass(frozen=True, eq=False)
class Contrast:
    """How to see a thread; grey levels are counted in means of their channel."""

    weights: Float64
    """(3,) of blue, green and red: the mix in which the thread is dark; magnitudes add up to 1."""
    across: Float64
    """(3,) second derivative across the thread in its middle, times sigma^2: positive where the
    thread is dark."""
    clutter: Float64
    """(3, 3) covariance of the second derivatives around the thread."""
    sigma: float
    """Scale that suits the thread's width, px."""
    wider: tuple[float, ...] = (0.4, 0.73)
    """What of `across` each of the SCALES for smears shows; of a bare band, two sigmas wide, unless seen."""

    @property
    def strength(self) -> float:
        """Length of `across`."""
        return float(np.linalg.norm(self.across))

    def stands_out(self, weights: Float64) -> float:
        """By how many deviations of the clutter the thread is darker in a mix."""
        return float(weights @ self.across / math.sqrt(weights @ self.clutter @ weights))

    def follow(self, seen: Contrast, share: float) -> Contrast:
        """`share` of the way to what was `seen`; this one where that was hardly the same thread."""
        metric = np.linalg.inv(self.clutter + seen.clutter)
        ours, theirs = (across @ metric @ across for across in (self.across, seen.across))
        both = self.across @ metric @ seen.across
        distinct = seen.stands_out(seen.weights) >= _LEAST_SCORE
        if not distinct or both < _ALIKE * math.sqrt(ours * theirs):
            return self

        def between(old: Float64, new: Float64) -> Float64:
            return (1 - share) * old + share * new

        weights = between(self.weights, seen.weights)
        across, clutter = between(self.across, seen.across), between(self.clutter, seen.clutter)
        weights = weights / np.abs(weights).sum()
        return replace(self, weights=weights, across=across, clutter=clutter)

    def fainter(self, share: float, clear: Contrast) -> Contrast:
        """As if it stood out by a `share` only, or by a quarter of what was `clear`, if that is more."""
        least = min(_FAINTEST * clear.strength / self.strength, 1.0)
        return replace(self, across=max(share, least) * self.across)


def channel_means(image: Image) -> Float64:
    """(3,) means of blue, green and red, at least 1; thrice the same for a gray image."""
    means = np.maximum(image[::16, ::16].mean((0, 1), keepdims=image.ndim == 2), 1.0)
    return np.array(np.broadcast_to(means.ravel(), 3))


def contrast_at(image: Image, pixel: Float64) -> Contrast | None:
    """The contrast of the thread that runs within 8 px of `pixel`; None where nothing does.

    Args:
        image: (H, W, 3) BGR or (H, W) gray, uint8.
        pixel: (2,) in that image.
    """
    contrast = _contrast_at(image, pixel, _FLOOR)
    if contrast is not None:
        return contrast
    brightness = max(float(_window(image, pixel)[0].mean((0, 1)).max()), 1.0)
    if brightness >= _BRIGHT:
        return None
    return _contrast_at(image, pixel, _FLOOR * (brightness / _BRIGHT) ** 2)


def _contrast_at(image: Image, pixel: Float64, floor: float) -> Contrast | None:
    """As `contrast_at`, in a picture whose second derivatives have that variance at least."""
    shown = [_shown(image, pixel, octave, floor) for octave in range(len(SIGMAS))]
    found = [s for s in shown if s is not None and s.score >= _LEAST_SCORE]
    if not found:
        return None
    clearest = max(s.score for s in found)
    clear = [s for s in found if s.score >= _CLEAR * clearest]
    whole = [s for s in clear if not any(s.is_half_of(wider) for wider in clear)]
    # The response is strongest where sigma is half the width. Of scales that respond alike the
    # smaller one keeps neighbours apart.
    best = max(whole, key=lambda s: s.response * SIGMAS[s.octave] ** -0.4)
    # The middle is seen best below that scale: in the image that is twice as large.
    octave, sigma, zoom = 0, SIGMAS[0], 1
    if best.octave:
        octave, sigma, zoom = best.octave - 1, _BELOW * SIGMAS[1], 2
    crop, seed = _window(*_shrunk(image, pixel, octave), zoom * _WINDOW_PX)
    scene = _Scene.of(crop, sigma, floor)
    ridge = _Ridge(zoom * best.ridge.pixels + seed, best.ridge.normals)
    across = _of_one_thread(scene, ridge, seed)
    clutter = scene.clutter_near(seed, zoom * _NEAR_PX)
    contrast = _contrast(clutter, across, sigma * 2**octave, image)
    return replace(contrast, wider=tuple(_shown_at(s.times, crop, ridge, scene) for s in SCALES))


def _shown_at(times: int, image: Image, ridge: _Ridge, scene: _Scene) -> float:
    """How much of a ridge in a scene of the image a scale shows that is so many times wider."""
    own, wide = (
        np.median(ridge.across(seen), axis=0)
        for seen in (scene, _Scene.of(image, times * scene.sigma, scene.floor))
    )
    return float(wide @ own / (own @ own))


def contrast_along(image: Image, pixels: Float64, sigma: float) -> Contrast:
    """The contrast of the thread whose middle runs through `pixels`, from windows along it.

    Args:
        image: (H, W, 3) BGR or (H, W) gray, uint8.
        pixels: (N, 2) inside that image, in order along the thread, N >= 8.
        sigma: scale that suits the thread's width, px.
    """
    normals = unit(np.gradient(pixels, axis=0))[:, ::-1] * (-1, 1)
    across, clutter = [], []
    half = max(_HALF_PX, math.ceil(_HALF * sigma))
    for i in np.linspace(0, len(pixels) - 1, min(_WINDOWS, len(pixels))).round().astype(int):
        crop, centre = _window(image, pixels[i], half)
        scene = _Scene.of(crop, sigma, _FLOOR)
        near = np.abs(pixels - pixels[i]).max(1) <= half - _FROM_RIM * sigma
        ridge = _Ridge(pixels[near] - pixels[i] + centre, normals[near])
        across.append(ridge.across(scene))
        clutter.append(scene.clutter)
    middle = np.concatenate(across)
    return _contrast(np.mean(clutter, axis=0), middle, sigma, image)


@dataclass(frozen=True, eq=False)
class _Shown:
    """What one scale shows of the thread at the seed."""

    octave: int
    """How often the image was halved."""
    ridge: _Ridge
    """In pixels of that image, from the seed."""
    score: float
    response: float
    """Length of the second derivative across, over the channels."""

    def is_half_of(self, wider: _Shown) -> bool:
        """Whether a wider scale shows the thread, and this one what runs on one side of the shine on it."""
        if wider.octave <= self.octave or wider.response <= self.response:
            return False
        own, whole = (s.ridge.pixels * 2**s.octave for s in (self, wider))
        near = own[np.argsort(_away(own, np.zeros(2)))[:_SHORTEST_PX]]
        aside = float(np.median(cKDTree(whole).query(near)[0]))
        return aside > _ASIDE * SIGMAS[wider.octave]


def _shown(image: Image, pixel: Float64, octave: int, floor: float) -> _Shown | None:
    """The ridge that stands out most near the seed, in the image halved `octave` times."""
    crop, seed = _window(*_shrunk(image, pixel, octave))
    scene = _Scene.of(crop, SIGMAS[0], floor)
    reach = max(_SNAP_PX / 2**octave, _LEAST_SNAP_PX)

    def standing(weights: Float64, ridge: _Ridge) -> float:
        near = float(_nearness(ridge.pixels, seed, reach).max())
        return near * _score(scene, weights, ridge, scene.nuisance)

    ridges = [(standing(*ridge), *ridge) for ridge in _ridges_near(scene, seed, reach)]
    # A lens colours the rims of a black thread, which are less like the nuisance than itself.
    in_gray = _followed(scene, *_clearest_in_gray(scene, seed, reach))
    ridges += [(standing(*ridge) / _BETTER, *ridge) for ridge in in_gray]
    # What was followed from near the seed may pass further away, such as a tool beside the thread.
    away = _SNAP_PX / 2**octave + 0.5
    ridges = [r for r in ridges if _away(r[2].pixels, seed).min() <= away]
    if not ridges:
        return None
    _, weights, ridge = max(ridges, key=lambda r: r[0])
    response = float(np.linalg.norm(np.median(ridge.across(scene), axis=0)))
    score = _score(scene, weights, ridge, scene.clutter)
    return _Shown(octave, _Ridge(ridge.pixels - seed, ridge.normals), score, response)


def _shrunk(image: Image, pixel: Float64, octave: int) -> tuple[Image, Float64]:
    """The image halved `octave` times, and where the pixel is in it."""
    height, width = image.shape[:2]
    size = max(width >> octave, 1), max(height >> octave, 1)
    small = cv2.resize(image, size, interpolation=cv2.INTER_AREA) if octave else image
    return small, (pixel + 0.5) * np.array(size) / (width, height) - 0.5


@dataclass(frozen=True, eq=False)
class _Scene:
    """Second derivatives of the image around a thread."""

    hessian: Float64
    """(3, H, W, channels): d2/du2, d2/dudv and d2/dv2 of the smoothed image, times sigma^2."""
    clutter: Float64
    """(channels, channels): their covariance."""
    nuisance: Float64
    """(channels, channels): the clutter and, whether the image shows one or not, a shadow."""
    sigma: float
    floor: float
    """Of the variances in them, grey levels^2."""

    @classmethod
    def of(cls, image: Image, sigma: float, floor: float) -> _Scene:
        planes = np.atleast_3d(image).astype(np.float64)
        smooth, slope, curve = gaussian_taps(sigma).astype(np.float64)
        smooth, curve = np.r_[smooth[:0:-1], smooth], np.r_[curve[:0:-1], curve]
        slope = np.r_[-slope[:0:-1], slope]
        hessian = np.array(
            [
                cv2.sepFilter2D(planes, cv2.CV_64F, *taps, borderType=cv2.BORDER_REPLICATE)
                for taps in ((curve, smooth), (slope, slope), (smooth, curve))
            ]
        ).reshape(3, *planes.shape)
        clutter = _scatter(hessian, floor)
        shadow = _SHADOW * planes.mean((0, 1))
        return cls(hessian, clutter, clutter + np.outer(shadow, shadow), sigma, floor)

    def clutter_near(self, pixel: Float64, half: int) -> Float64:
        """(channels, channels): the clutter in a window around a pixel."""
        u, v = np.rint(pixel).astype(int)
        near = slice(max(v - half, 0), v + half), slice(max(u - half, 0), u + half)
        return _scatter(self.hessian[:, *near], self.floor)


@dataclass(frozen=True, eq=False)
class _Ridge:
    """Pixels in the middle of a ridge."""

    pixels: Float64
    """(N, 2)."""
    normals: Float64
    """(N, 2), unit."""

    def across(self, scene: _Scene, offset: float = 0.0) -> Float64:
        """(N, channels) second derivative along the normal, `offset` px beside the middle."""
        height, width = scene.hessian.shape[1:3]
        at = np.rint(self.pixels + offset * self.normals).astype(int)
        u, v = np.clip(at, 0, (width - 1, height - 1)).T
        uu, uv, vv = scene.hessian[:, v, u]
        nu, nv = self.normals[:, :1], self.normals[:, 1:]
        return nu * nu * uu + 2 * nu * nv * uv + nv * nv * vv


def _scatter(hessian: Float64, floor: float) -> Float64:
    """(channels, channels): the covariance of second derivatives, (3, H, W, channels), with a floor."""
    uu, uv, vv = hessian.reshape(3, -1, hessian.shape[-1])
    scatter = (uu.T @ uu + 2 * uv.T @ uv + vv.T @ vv) / (2 * len(uu))
    return np.asarray(scatter + floor * np.eye(len(scatter)))


def _window(image: Image, pixel: Float64, half: int = _WINDOW_PX) -> tuple[Image, Float64]:
    """The image around a pixel, and where the pixel is in it."""
    u, v = (round(float(x)) for x in pixel)
    left, top = max(u - half, 0), max(v - half, 0)
    return image[top : v + half, left : u + half], pixel - (left, top)


def _starts(scene: _Scene, seed: Float64, reach: float) -> list[tuple[int, int]]:
    """(v, u) of pixels near the seed whose second derivatives are least like the nuisance."""
    v, u = _pixels_near(scene, seed, reach)
    unlike = _most_unlike(scene, v, u)[0]
    unlike *= _nearness(np.stack([u, v], axis=1), seed, reach) ** 2
    return [(int(v[i]), int(u[i])) for i in _peaks(unlike, v, u)]


def _clearest_in_gray(
    scene: _Scene, seed: Float64, reach: float
) -> tuple[tuple[int, int], Float64]:
    """(v, u) of the pixel near the seed whose second derivative is largest in gray, and the (channels,) mix
    in which it is dark."""
    v, u = _pixels_near(scene, seed, reach)
    gray = GRAY if scene.hessian.shape[-1] > 1 else np.ones(1)
    uu, uv, vv = scene.hessian[:, v, u] @ gray
    root = np.sqrt((uu - vv) ** 2 + 4 * uv**2)
    across = (uu + vv + np.where(uu + vv < 0, -root, root)) / 2
    best = int(np.argmax(abs(across) * _nearness(np.stack([u, v], axis=1), seed, reach)))
    return (int(v[best]), int(u[best])), gray * np.sign(across[best])


def _pixels_near(scene: _Scene, seed: Float64, reach: float) -> tuple[Int64, Int64]:
    """v and u, (N,) each, of the pixels up to a distance from the seed."""
    height, width = scene.hessian.shape[1:3]
    whole = math.ceil(reach)
    v, u = (
        np.mgrid[-whole : whole + 1, -whole : whole + 1]
        + np.rint(seed[::-1]).astype(int)[:, None, None]
    )
    near = (np.hypot(u - seed[0], v - seed[1]) <= reach) & (u >= 0) & (v >= 0)
    near &= (u < width) & (v < height)
    return v[near], u[near]


def _nearness(pixels: Float64, seed: Float64, reach: float) -> Float64:
    """(N,) what pixels count: 1 at the seed, 0.6 at the end of its reach."""
    return np.asarray(np.exp(-((_away(pixels, seed) / reach) ** 2) / 2))


def _away(pixels: Float64, seed: Float64) -> Float64:
    """(N,) distances of pixels from the seed."""
    return np.asarray(np.linalg.norm(pixels - seed, axis=1))


def _peaks(values: Float64, v: Int64, u: Int64) -> list[int]:
    """Which of the (N,) pixels have the highest values, one after the other."""
    left, peaks = values.copy(), []
    for _ in range(_STARTS):
        best = int(np.argmax(left))
        peaks.append(best)
        left[np.hypot(u - u[best], v - v[best]) <= _APART_PX] = 0
    return peaks


def _most_unlike(scene: _Scene, v: Int64, u: Int64) -> tuple[Float64, Float64]:
    """(N,) how unlike the nuisance pixels are, and (N, channels) second derivatives that show it."""
    theta = (np.arange(16) * math.pi / 16)[:, None, None]
    uu, uv, vv = scene.hessian[:, v, u]
    across = np.cos(theta) ** 2 * uu + np.sin(2 * theta) * uv + np.sin(theta) ** 2 * vv
    unlike = np.einsum("anc,cd,and->an", across, np.linalg.inv(scene.nuisance), across)
    best = unlike.argmax(0), np.arange(unlike.shape[1])
    return unlike[best], across[best]


def _ridges_near(scene: _Scene, seed: Float64, reach: float) -> list[tuple[Float64, _Ridge]]:
    """Ridges near the seed, each with the mix that suits it."""
    ridges: list[tuple[Float64, _Ridge]] = []
    for start in _starts(scene, seed, reach):
        offsets = [ridge.pixels - start[::-1] for _, ridge in ridges]
        if not any((np.abs(offset).max(1) <= 1).any() for offset in offsets):
            weights = _fisher(scene.nuisance, _most_unlike(scene, *np.array(start)[:, None])[1])
            ridges += _followed(scene, start, weights)
    return ridges


def _followed(
    scene: _Scene, start: tuple[int, int], weights: Float64
) -> list[tuple[Float64, _Ridge]]:
    """The mix that suits the ridge that a first mix shows at `start`, and the ridge in it, if any."""
    ridge = _dark_ridge(scene, weights, start)
    for _ in range(_ROUNDS):
        if ridge is None:
            return []
        weights = _fisher(scene.nuisance, ridge.across(scene))
        ridge = _dark_ridge(scene, weights, start)
    return [] if ridge is None else [(weights, ridge)]


def _fisher(nuisance: Float64, across: Float64) -> Float64:
    scatter = np.atleast_2d(np.cov(across.T)) if len(across) > 1 else 0.0
    weights = np.linalg.solve(nuisance + scatter, np.median(across, axis=0))
    return weights / max(np.abs(weights).sum(), 1e-9)


def _score(scene: _Scene, weights: Float64, ridge: _Ridge, covariance: Float64) -> float:
    """How far the ridge stands out; not above 0 for the rim of a stronger ridge of other sign, and less for
    the coloured rim of one that is stronger in other mixes."""
    middle = np.median(ridge.across(scene), axis=0)
    beside = [np.median(ridge.across(scene, scene.sigma * k), axis=0) for k in _BESIDE]
    rim = max(-float(b @ weights) for b in beside)
    stronger = max(float(np.linalg.norm(b)) for b in (middle, *beside))
    share = float(np.linalg.norm(middle)) / max(stronger, 1e-9)
    spread = max(math.sqrt(weights @ covariance @ weights), 1e-9)
    return share * (float(middle @ weights) - max(rim, 0.0)) / spread


def _of_one_thread(scene: _Scene, ridge: _Ridge, seed: Float64) -> Float64:
    """(N, channels) second derivatives across the ridge where it is like it is near the seed.

    A ridge may turn onto another thread where the two cross.
    """
    across, metric = ridge.across(scene), np.linalg.inv(scene.clutter)
    away = _away(ridge.pixels, seed)
    near = np.median(across[away <= away.min() + _SNAP_PX], axis=0)
    lengths = np.sqrt(np.einsum("ij,jk,ik->i", across, metric, across) * (near @ metric @ near))
    alike = across @ metric @ near >= _ALIKE * lengths
    return across[alike] if np.count_nonzero(alike) >= _SHORTEST_PX else across


def _contrast(clutter: Float64, across: Float64, sigma: float, image: Image) -> Contrast:
    """From the (channels, channels) clutter and (N, channels) derivatives across, grey levels."""
    means = channel_means(image)
    middle, weights = np.median(across, axis=0), _fisher(clutter, across)
    if len(weights) == 1:
        weights, middle, clutter = weights * GRAY, np.repeat(middle, 3), np.full((3, 3), clutter)
        clutter = clutter + 1e-3 * clutter[0, 0] * np.eye(3)
    else:
        total = clutter + np.cov(across.T)
        gray = GRAY * np.sign(middle @ GRAY)
        shown = [middle @ w / math.sqrt(w @ total @ w) for w in (weights, gray)]
        if shown[0] < _WORTH * shown[1]:
            weights = gray
        highlight, shadow = _highlight(image, means), _SHADOW * means
        if highlight is not None:
            nuisance = total + np.outer(shadow, shadow)
            weights = _without_highlights(weights, middle, nuisance, highlight)
    weights = weights * means
    clutter = clutter / np.outer(means, means)
    return Contrast(weights / np.abs(weights).sum(), middle / means, clutter, sigma)


def _highlight(image: Image, means: Float64) -> Float64 | None:
    """(3,) by how much brighter than the ground the highlights are, grey levels; None without any."""
    pixels = image[::4, ::4].reshape(-1, 3)
    white = pixels[pixels.min(axis=1) >= _WHITE]
    return white.mean(axis=0) - means if len(white) > _SCARCE * len(pixels) else None


def _without_highlights(
    weights: Float64, middle: Float64, nuisance: Float64, highlight: Float64
) -> Float64:
    """The mix in which a `highlight`, (channels,) of grey levels above the ground, is not dark as well.

    It is the best one of these for a thread with second derivatives `middle` among those of the
    `nuisance`; the old mix where a highlight is fainter, or the thread too much like one.
    """
    dark = -float(weights @ highlight)
    if dark <= _FAINTER * middle @ weights:
        return weights
    drawn = np.linalg.solve(nuisance, highlight)
    blind = weights + dark / float(highlight @ drawn) * drawn
    before, after = (middle @ w / math.sqrt(w @ nuisance @ w) for w in (weights, blind))
    return blind if after > _KEPT * before else weights


def _dark_ridge(scene: _Scene, weights: Float64, start: tuple[int, int]) -> _Ridge | None:
    """The middle of the dark ridge that passes within 2 px of `start` in a mix."""
    uu, uv, vv = scene.hessian @ weights
    height, width = uu.shape
    trace, root = uu + vv, np.sqrt((uu - vv) ** 2 + 4 * uv**2)
    lambda_2 = (trace + root) / 2
    around = tuple(slice(max(x - 2, 0), x + 3) for x in start)
    least = 0.4 * lambda_2[around].max()
    v, u = np.nonzero((lambda_2 > max(least, 0)) & (2 * np.abs(trace - root) < trace + root))
    angle = 0.5 * np.arctan2(2 * uv[v, u], uu[v, u] - vv[v, u])
    normals = np.stack([np.cos(angle), np.sin(angle)], 1)
    du, dv = np.rint(normals).astype(int).T
    beside = [
        lambda_2[np.clip(v + s * dv, 0, height - 1), np.clip(u + s * du, 0, width - 1)]
        for s in (-1, 1)
    ]
    crest = np.all(beside <= lambda_2[v, u], axis=0)
    v, u, normals = v[crest], u[crest], normals[crest]
    shown = np.zeros((height, width), np.uint8)
    shown[v, u] = 1
    labels = cv2.connectedComponents(shown, connectivity=8)[1]
    best = np.argmax(np.where(labels[around], lambda_2[around], -np.inf))
    label = labels[around].flat[best]
    ours = labels[v, u] == label
    if label == 0 or np.count_nonzero(ours) < _SHORTEST_PX:
        return None
    return _Ridge(np.stack([u, v], 1)[ours].astype(float), normals[ours])
