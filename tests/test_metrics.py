"""Distances between curves whose true distance is known."""

from __future__ import annotations

import numpy as np
import pytest

from suturetrack import metrics
from suturetrack.polylines import coverage, polyline_distances, polyline_length

LINE = np.c_[np.linspace(0, 100, 501), np.zeros(501), np.full(501, 200.0)]


def test_a_curve_has_no_distance_from_itself() -> None:
    error = metrics.curve_error(LINE, LINE[::-1])
    assert error.largest == pytest.approx(0, abs=1e-12)
    assert error.ends == pytest.approx((0, 0))
    assert error.length_percent == pytest.approx(0)


def test_a_shifted_curve_is_its_shift_away() -> None:
    error = metrics.curve_error(LINE + np.array([0, 3, 4]), LINE)
    assert (error.mean, error.rms, error.p95, error.largest) == pytest.approx((5, 5, 5, 5))
    assert error.ends == pytest.approx((5, 5))


def test_distances_do_not_depend_on_the_sampling() -> None:
    assert polyline_distances(LINE, LINE[::50]).max() == pytest.approx(0, abs=1e-9)


def test_a_curve_that_misses_a_part_is_close_one_way_only() -> None:
    half = LINE[:251]
    assert polyline_distances(half, LINE).max() == pytest.approx(0, abs=1e-9)
    error = metrics.curve_error(half, LINE)
    assert error.length_percent == pytest.approx(-50)
    assert error.largest == pytest.approx(50)
    assert coverage(half, LINE, 1.0) == pytest.approx(0.51, abs=0.01)


def test_order_is_what_nearness_does_not_tell() -> None:
    """A loop that is walked the wrong way round is near the thread everywhere."""
    s = np.linspace(0, 1, 500)
    straight = np.stack([20 * s, 0 * s, 0 * s], axis=1)
    turn = 2 * np.pi * s
    loop = np.stack([20 + 4 * np.sin(turn), 4 - 4 * np.cos(turn), 0 * s], axis=1)
    truth = np.concatenate([straight, loop, straight + np.array([20, 0, 0])])
    backwards = np.concatenate([straight, loop[::-1], straight + np.array([20, 0, 0])])
    length = polyline_length(truth)
    assert polyline_distances(backwards, truth).max() < 0.01
    assert metrics.in_order(truth, truth, 0.01 * length) == 1
    assert metrics.in_order(truth[::-1] + np.array([0, 0.3, 0]), truth, 0.01 * length) == 1
    assert 0.5 < metrics.in_order(backwards, truth, 0.01 * length) < 0.75
    assert metrics.in_order(truth[: len(truth) // 3], truth, 0.01 * length) < 0.4


def test_walking_in_order_pays_the_least() -> None:
    """Against the recursion of dynamic time warping as it is written in books."""
    rng = np.random.default_rng(4)
    for shape in ((6, 9), (9, 6), (7, 7)):
        distances = rng.uniform(0, 1, shape)
        met = metrics._warped(distances)
        cost = np.full((shape[0] + 1, shape[1] + 1), np.inf)
        cost[0, 0] = 0
        for i, j in np.ndindex(*shape):
            before = min(cost[i, j], cost[i, j + 1], cost[i + 1, j])
            cost[i + 1, j + 1] = distances[i, j] + before
        i, j = shape
        expected = np.zeros(shape[1])
        while (i, j) != (0, 0):
            expected[j - 1] = max(expected[j - 1], distances[i - 1, j - 1])
            i, j = min(((i - 1, j - 1), (i - 1, j), (i, j - 1)), key=lambda at: float(cost[at]))
        np.testing.assert_allclose(met, expected)


def test_a_tight_knot_is_misplaced_by_what_the_free_parts_lack() -> None:
    turn = np.linspace(0, 2 * np.pi, 80)
    loop = np.stack([30 + 1.5 * np.sin(turn), 1.5 - 1.5 * np.cos(turn), 0.1 * turn], axis=1)
    before = np.linspace([0.0, 0, 0], [30, 0, 0], 200, endpoint=False)
    behind = np.linspace(loop[-1], [70.0, 0, 0.2 * np.pi], 300)[1:]
    truth = np.concatenate([before, loop, behind])
    passing = np.concatenate([before, behind])
    assert metrics.knot_shift(passing, truth, 1.0, 15.0) < 0.3
    assert metrics.knot_shift(passing[::-1], truth, 1.0, 15.0) < 0.3
    assert metrics.knot_shift(passing[:-30], truth, 1.0, 15.0) == pytest.approx(4.0, abs=0.4)
    assert np.isnan(metrics.knot_shift(passing, passing, 1.0, 15.0))
    assert np.isnan(metrics.knot_shift(passing, 5 * truth, 1.0, 15.0))
