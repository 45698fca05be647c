"""The compiled drawing of threads agrees with its literal twin."""

from __future__ import annotations

import numpy as np
import pytest

from suturetrack.kernels import tubes
from suturetrack.types import Float32, Float64
from tests.reference import tubes as twin

SIZE = (90, 70)


def make_strand(rng: np.random.Generator, heading: float) -> tuple[Float64, Float64]:
    """A gently bent path through the image's middle, and light on it."""
    s = np.linspace(-32, 32, 80)
    bend = 6 * np.sin(s / 14 + rng.uniform(0, 6))
    u = 45 + s * np.cos(heading) - bend * np.sin(heading)
    v = 35 + s * np.sin(heading) + bend * np.cos(heading)
    depth = 200 + rng.uniform(-4, 4) + 2 * np.sin(s / 20)
    path = np.column_stack([u, v, depth, np.linspace(0.7, 2.2, 80), np.linspace(0.6, 1.0, 80)])
    return path, np.linspace(*rng.uniform(0.2, 1.0, (2, 4)), 80)


def drawn(strands: list[tuple[Float64, Float64]], colours: Float64, gloss: Float64) -> Float32:
    fragments = tubes.make_fragments(SIZE)
    layer = np.zeros((SIZE[1], SIZE[0], 4), np.float32)
    for number, ((path, light), colour) in enumerate(zip(strands, colours, strict=True)):
        first = int(fragments.used[0])
        tubes.splat(number, path, 30, fragments)
        tubes.shade(first, path, light, colour, gloss, fragments)
    tubes.composite(fragments, layer, 1.0)
    assert fragments.used.max() == 0
    assert fragments.head.max() == -1
    return layer


@pytest.mark.parametrize("seed", range(4))
def test_strands_over_one_another_agree_with_the_twin(seed: int) -> None:
    rng = np.random.default_rng(seed)
    headings = rng.uniform(0, 3) + np.array([0.0, 0.9, 1.8])
    strands = [make_strand(rng, heading) for heading in headings]
    colours, gloss = rng.uniform(0, 255, (3, 3)), np.array([0.4, 0.2, 8.0, 0.9])
    layers = [
        twin.strand(path, light, colour, gloss, SIZE)
        for (path, light), colour in zip(strands, colours, strict=True)
    ]
    expected, layer = twin.composite(layers), drawn(strands, colours, gloss)
    assert expected[..., 3].max() > 0.8
    assert np.abs(layer[..., 3] - expected[..., 3]).max() < 0.03
    assert np.abs(layer[..., :3] - expected[..., :3]).max() < 6
    assert np.abs(layer - expected).mean() < 0.05


def test_strand_on_top_of_itself_shows_both_passes() -> None:
    angle = np.linspace(0.25, 2 * np.pi - 0.25, 160)
    loop = np.column_stack([45 + 25 * np.sin(angle) * np.cos(angle / 2), 35 - 25 * np.cos(angle)])
    path = np.column_stack([loop, np.linspace(200, 190, 160), np.full(160, 1.5), np.full(160, 0.6)])
    light = np.tile([0.0, 1.0, 0.0, 0.0], (160, 1))
    half = drawn([(path, light)], np.array([[90.0, 90, 90]]), np.array([1.0, 0.0, 1.0, 0.5]))
    distance = np.linalg.norm(loop[:, None] - loop[None], axis=2) + 1e3 * (
        np.abs(np.subtract.outer(np.arange(160), np.arange(160))) < 40
    )
    i, j = np.unravel_index(distance.argmin(), distance.shape)
    assert distance[i, j] < 1
    u, v = loop[i].round().astype(int)
    assert half[v, u, 3] == pytest.approx(0.75, abs=0.06)
    assert half[10, 45, 3] <= 0.55


def test_developed_image_agrees_with_the_twin() -> None:
    rng = np.random.default_rng(5)
    shape = (SIZE[1], SIZE[0])
    background = rng.uniform(0, 255, (*shape, 3)).astype(np.float32)
    cover = rng.uniform(0, 1, (*shape, 1)) * (rng.uniform(size=(*shape, 1)) < 0.3)
    layer = np.concatenate([cover * rng.uniform(0, 255, (*shape, 3)), cover], -1).astype(np.float32)
    vignette = rng.uniform(0.7, 1, shape).astype(np.float32)
    gain = np.array([0.9, 1.1, 1.3], np.float32)
    noise = rng.integers(-60, 60, (*shape, 3)).astype(np.int8)
    expected = twin.develop(background, layer, vignette, gain, noise * 0.125)
    picture = np.zeros((*shape, 3), np.uint8)
    tubes.develop(background, layer, vignette, gain, noise, np.float32(0.125), picture)
    assert np.abs(picture.astype(int) - expected).max() <= 1
    assert (picture != expected).mean() < 0.01
    assert not layer.any()
