"""Properties of the curve: what the formulas must hold for any knots and control points."""

from __future__ import annotations

import numpy as np
import pytest
from geomdl import NURBS as GeomdlNurbs
from geomdl import BSpline as GeomdlBSpline
from geomdl import operations
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from suturetrack import nurbs
from suturetrack.types import Nurbs

S = np.linspace(0, 1, 101)


@st.composite
def curves(draw: st.DrawFn) -> Nurbs:
    degree = draw(st.integers(2, 4))
    gaps = draw(st.lists(st.floats(0.05, 1.0), min_size=1, max_size=8))
    interior = np.cumsum(gaps)[:-1] / sum(gaps)
    count = len(interior) + degree + 1
    points = draw(arrays(np.float64, (count, 3), elements=st.floats(-100, 100, width=32)))
    return nurbs.curve_from(degree, nurbs.clamped_knots(interior, degree), points)


@given(curves())
def test_the_basis_is_a_partition_of_unity(curve: Nurbs) -> None:
    a = nurbs.basis(S, curve.knots, curve.degree)
    assert np.allclose(a.sum(axis=1), 1, atol=1e-12)
    assert a.min() >= 0
    assert np.allclose(a @ curve.control_points, nurbs.evaluate(curve, S), atol=1e-9)


@given(curves())
def test_the_curve_ends_on_its_end_control_points(curve: Nurbs) -> None:
    ends = nurbs.evaluate(curve, np.array([0.0, 1.0]))
    assert np.allclose(ends, curve.control_points[[0, -1]], atol=1e-9)


@given(curves(), arrays(np.float64, (3, 4), elements=st.floats(-2, 2)))
def test_affine_maps_of_the_control_points_map_the_curve(curve: Nurbs, affine: np.ndarray) -> None:
    moved = nurbs.curve_from(
        curve.degree, curve.knots, curve.control_points @ affine[:, :3].T + affine[:, 3]
    )
    expected = nurbs.evaluate(curve, S) @ affine[:, :3].T + affine[:, 3]
    assert np.allclose(nurbs.evaluate(moved, S), expected, atol=1e-8)


@given(curves(), st.floats(0.01, 0.99))
def test_inserting_a_knot_keeps_the_shape(curve: Nurbs, s: float) -> None:
    finer = nurbs.insert_knot(curve, s)
    assert len(finer.control_points) == len(curve.control_points) + 1
    assert np.allclose(nurbs.evaluate(finer, S), nurbs.evaluate(curve, S), atol=1e-9)


@given(curves(), st.floats(0.0, 0.4), st.floats(0.6, 1.0))
def test_a_part_is_that_part(curve: Nurbs, start: float, stop: float) -> None:
    piece = nurbs.part(curve, start, stop)
    expected = nurbs.evaluate(curve, start + S * (stop - start))
    assert np.allclose(nurbs.evaluate(piece, S), expected, atol=1e-7)


@given(curves())
def test_a_reversed_curve_runs_backwards(curve: Nurbs) -> None:
    back = nurbs.evaluate(nurbs.reversed_curve(curve), S)
    assert np.allclose(back[::-1], nurbs.evaluate(curve, S), atol=1e-8)


def test_derivatives_agree_with_differences(curve: Nurbs) -> None:
    rational = Nurbs(
        curve.degree, curve.knots, curve.control_points, np.linspace(0.5, 2, len(curve.weights))
    )
    s, h = np.linspace(0.01, 0.99, 57), 1e-5
    for c in (curve, rational):
        ahead, here, behind = (nurbs.evaluate(c, s + d) for d in (h, 0, -h))
        assert np.allclose(nurbs.derivative(c, s), (ahead - behind) / (2 * h), rtol=1e-4, atol=1e-3)
        second = (ahead - 2 * here + behind) / h**2
        assert np.allclose(nurbs.derivative(c, s, 2), second, rtol=1e-2, atol=0.5)


def test_it_agrees_with_geomdl(curve: Nurbs) -> None:
    weights = np.linspace(0.5, 2, len(curve.weights))
    rational = Nurbs(curve.degree, curve.knots, curve.control_points, weights)
    other = GeomdlNurbs.Curve()
    other.degree = curve.degree
    other.ctrlpts = curve.control_points.tolist()
    other.weights = weights.tolist()
    other.knotvector = curve.knots.tolist()
    assert np.allclose(nurbs.evaluate(rational, S), other.evaluate_list(S.tolist()), atol=1e-9)


def test_insertion_agrees_with_geomdl(curve: Nurbs) -> None:
    other = GeomdlBSpline.Curve()
    other.degree = curve.degree
    other.ctrlpts = curve.control_points.tolist()
    other.knotvector = curve.knots.tolist()
    operations.insert_knot(other, [0.4], [1])
    ours = nurbs.insert_knot(curve, 0.4)
    assert np.allclose(ours.knots, other.knotvector)
    assert np.allclose(ours.control_points, other.ctrlpts)


def test_length_of_a_straight_line_and_of_an_arc() -> None:
    line = nurbs.curve_from(1, np.array([0.0, 0, 1, 1]), np.array([[0.0, 0, 0], [3, 4, 0]]))
    assert nurbs.length(line) == pytest.approx(5)
    corner = np.array([[1.0, 0], [1, 1], [0, 1]])
    quarter = Nurbs(2, np.array([0.0, 0, 0, 1, 1, 1]), corner, np.array([1, np.sqrt(0.5), 1]))
    assert nurbs.length(quarter) == pytest.approx(np.pi / 2, rel=1e-9)
    assert nurbs.arc_lengths(quarter, S)[-1] == pytest.approx(np.pi / 2, rel=1e-9)


def test_evenly_spaced_points_are_evenly_spaced(curve: Nurbs) -> None:
    points = nurbs.evaluate(curve, nurbs.evenly_spaced(curve, 200))
    steps = np.linalg.norm(np.diff(points, axis=0), axis=1)
    assert steps.max() / steps.min() < 1.02


def test_a_fit_recovers_the_curve_it_was_sampled_from(curve: Nurbs) -> None:
    again = nurbs.fit(nurbs.evaluate(curve, S), S, curve.knots, curve.degree)
    assert np.allclose(again.control_points, curve.control_points, atol=1e-5)


def test_the_bending_matrix_is_the_integral_of_the_squared_second_derivative(curve: Nurbs) -> None:
    fine = np.linspace(0, 1, 20001)
    integral = np.trapezoid((nurbs.derivative(curve, fine, 2) ** 2).sum(1), fine)
    c = curve.control_points
    exact = np.einsum("id,ij,jd", c, nurbs.bending_matrix(curve.knots, 3), c)
    assert exact == pytest.approx(integral, rel=1e-4)


def test_a_wrong_number_of_knots_is_refused() -> None:
    with pytest.raises(ValueError, match="need 8 knots, not 7"):
        nurbs.curve_from(3, np.linspace(0, 1, 7), np.zeros((4, 3)))
