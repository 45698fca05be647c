"""Distances between curves whose true distance is known."""

from __future__ import annotations

import numpy as np
import pytest

from suturetrack import metrics

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
    assert metrics.polyline_distances(LINE, LINE[::50]).max() == pytest.approx(0, abs=1e-9)


def test_a_curve_that_misses_a_part_is_close_one_way_only() -> None:
    half = LINE[:251]
    assert metrics.polyline_distances(half, LINE).max() == pytest.approx(0, abs=1e-9)
    error = metrics.curve_error(half, LINE)
    assert error.length_percent == pytest.approx(-50)
    assert error.largest == pytest.approx(50)
    assert metrics.coverage(half, LINE, 1.0) == pytest.approx(0.51, abs=0.01)
