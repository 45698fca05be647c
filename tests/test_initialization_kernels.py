"""The kernels of the initialisation against their literal twins and against scikit-image."""

from __future__ import annotations

import itertools

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter
from skimage.measure import euler_number, label

from suturetrack.kernels import crest, growth, matching
from suturetrack.types import Bool
from tests.reference import crest as crest_reference
from tests.reference import growth as reference


@pytest.mark.parametrize("size", [(14, 17), (1, 9), (6, 1)])
@pytest.mark.parametrize("seed", range(5))
def test_growth_has_the_cost_of_eq_3(seed: int, size: tuple[int, int]) -> None:
    rng = np.random.default_rng(seed)
    magnitude = rng.uniform(0, 1, size).astype(np.float32)
    u, v = size[1] // 2, size[0] // 2
    cost = np.full(size, np.inf, np.float32)
    growth.grow(magnitude, u, v, 0.0, 2.0, 0.3, cost)
    expected = reference.grow(magnitude, u, v, 2.0, 0.3)
    np.testing.assert_array_equal(np.isfinite(cost), np.isfinite(expected))
    assert np.isfinite(cost).sum() > 50 or min(size) == 1
    np.testing.assert_allclose(cost, expected, rtol=1e-4)


def test_growth_goes_on_from_a_second_origin_where_that_is_cheaper() -> None:
    magnitude = np.ones((5, 40), np.float32)
    magnitude[:, 20] = 0
    cost = np.full(magnitude.shape, np.inf, np.float32)
    growth.grow(magnitude, 0, 2, 0.0, 2.0, 0.1, cost)
    assert np.isinf(cost[:, 20:]).all()
    growth.grow(magnitude, 21, 2, 30.0, 2.0, 0.1, cost)
    assert cost[2, 39] == pytest.approx(48.0)
    assert cost[2, 10] == pytest.approx(10.0)


@pytest.mark.parametrize("size", [(12, 40), (1, 9), (7, 1)])
@pytest.mark.parametrize(
    ("first", "step", "count"), [(0.0, 1.0, 40), (-40.0, 1.0, 41), (3.3, 0.5, 30), (2.0, 1.0, 1)]
)
def test_matching_costs_are_one_less_the_response(
    first: float, step: float, count: int, size: tuple[int, int]
) -> None:
    rng = np.random.default_rng(count)
    height, width = size
    field = rng.uniform(-0.7, 0.7, (height, width, 2)).astype(np.float32)
    field[rng.uniform(size=size) < 0.3] = 0
    pixels = rng.uniform((-1, -1), (width + 1, height), (30, 2))
    pixels = np.r_[pixels, [[width - 1, 0], [width - 1, height - 1], [0, height]]]
    angles = rng.uniform(0, np.pi, len(pixels))
    arguments = field, pixels, np.c_[np.cos(angles), np.sin(angles)], first, step, count, 0.6
    costs = matching.matching_costs(*arguments)
    np.testing.assert_allclose(costs, reference.matching_costs(*arguments), atol=1e-6)
    if min(size) > 1:
        assert (costs < 0.9).any()
        assert (costs == 1).any()


@pytest.mark.parametrize("size", [(6, 4), (1, 4), (6, 1)])
@pytest.mark.parametrize(("reach", "penalty"), [(0, 0.2), (1, 0.2), (3, 0.1), (5, 0.0)])
@pytest.mark.parametrize("seed", range(5))
def test_the_cheapest_path_is_the_cheapest_of_all(
    seed: int, reach: int, penalty: float, size: tuple[int, int]
) -> None:
    costs = np.random.default_rng(seed).uniform(0, 1, size).astype(np.float32)
    states = matching.cheapest_path(costs, reach, penalty)
    paths = itertools.product(range(size[1]), repeat=size[0])
    possible = [p for p in paths if all(abs(a - b) <= reach for a, b in itertools.pairwise(p))]
    best = min(reference.path_cost(costs, p, penalty) for p in possible)
    assert tuple(states) in possible
    assert reference.path_cost(costs, tuple(states), penalty) == pytest.approx(best, abs=1e-5)


SIZES = [(24, 31), (3, 9), (2, 2), (1, 5)]


def blots(seed: int, size: tuple[int, int]) -> Bool:
    """Noise of spots of several pixels, up to the border."""
    noise = np.random.default_rng(seed).normal(size=size)
    return gaussian_filter(noise, 1.0) > 0.0


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize("size", SIZES)
def test_crest_pixels_are_those_of_the_twin(seed: int, size: tuple[int, int]) -> None:
    rng = np.random.default_rng(seed)
    field = gaussian_filter(rng.normal(size=(*size, 2)), (1.0, 1.0, 0.0)).astype(np.float32)
    magnitude = np.linalg.norm(field, axis=2)
    found = crest.crest_pixels(field, magnitude, 0.2)
    np.testing.assert_array_equal(found, crest_reference.crest_pixels(field, magnitude, 0.2))
    assert found.any() or min(size) < 10


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize("size", SIZES)
def test_thinning_leaves_what_the_twin_leaves(seed: int, size: tuple[int, int]) -> None:
    mask = blots(seed, size)
    magnitude = np.random.default_rng(seed).uniform(0, 1, size).astype(np.float32)
    thinned = mask.copy()
    crest.thin(thinned, magnitude)
    np.testing.assert_array_equal(thinned, crest_reference.thin(mask, magnitude))


@pytest.mark.parametrize("seed", range(8))
@pytest.mark.parametrize("size", SIZES)
def test_chains_are_those_of_the_twin(seed: int, size: tuple[int, int]) -> None:
    mask = crest_reference.thin(blots(seed, size), np.ones(size, np.float32))
    # Some of it touches the border, or itself.
    mask |= np.random.default_rng(seed).random(size) < 0.1
    pixels, starts = crest.trace_chains(mask)
    found = [pixels[a:b].tolist() for a, b in itertools.pairwise(starts)]
    assert found == [[list(place) for place in chain] for chain in crest_reference.chains(mask)]


@pytest.mark.parametrize("seed", range(8))
def test_thinning_keeps_the_topology_and_leaves_nothing_to_thin(seed: int) -> None:
    rng = np.random.default_rng(seed)
    mask = np.zeros((40, 40), bool)
    for _ in range(6):
        y, x = rng.integers(4, 30, 2)
        mask[y : y + rng.integers(2, 8), x : x + rng.integers(2, 8)] = True
    thinned = mask.copy()
    crest.thin(thinned, rng.uniform(0, 1, mask.shape).astype(np.float32))
    assert not (thinned & ~mask).any()
    assert thinned.sum() < mask.sum()
    assert label(thinned, connectivity=2).max() == label(mask, connectivity=2).max()
    assert euler_number(thinned, connectivity=2) == euler_number(mask, connectivity=2)
    again = thinned.copy()
    crest.thin(again, np.ones(mask.shape, np.float32))
    np.testing.assert_array_equal(again, thinned)


def test_chains_end_at_junctions_and_hold_every_other_pixel_once() -> None:
    mask = np.zeros((30, 30), bool)
    mask[15, 3:27] = True
    mask[5:15, 14] = True
    pixels, starts = crest.trace_chains(mask)
    chains = [pixels[a:b] for a, b in itertools.pairwise(starts)]
    assert len(chains) == 3
    assert len({tuple(p) for p in pixels.tolist()}) == len(pixels)
    assert mask[pixels[:, 1], pixels[:, 0]].all()
    assert len(pixels) >= mask.sum() - 5
    for chain in chains:
        assert abs(np.diff(chain, axis=0)).max() == 1


def test_a_closed_chain_is_followed_around() -> None:
    mask = np.zeros((30, 30), bool)
    mask[5, 5:20] = mask[19, 5:20] = True
    mask[5:20, 5] = mask[5:20, 19] = True
    crest.thin(mask, np.ones(mask.shape, np.float32))
    pixels, starts = crest.trace_chains(mask)
    assert starts.tolist() == [0, int(mask.sum())]
    assert abs(np.diff(pixels, axis=0)).max() == 1


def test_the_crest_of_a_line_is_its_middle() -> None:
    v, _ = np.mgrid[0:30, 0:40]
    magnitude = np.exp(-0.5 * ((v - 14.3) / 1.5) ** 2).astype(np.float32)
    field = np.dstack([magnitude, np.zeros_like(magnitude)])
    mask = crest.crest_pixels(field, magnitude, 0.1)
    assert mask[14, 1:39].all()
    assert mask.sum() == 38
