import importlib
import inspect
import pkgutil

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numba.core.dispatcher import Dispatcher

from suturetrack import kernels, nurbs
from suturetrack.camera import StereoRig
from suturetrack.kernels import rows, search, spline, widths
from suturetrack.kernels.boundary import outer_boundary
from tests.reference import boundary as boundary_reference
from tests.reference import curve_fit as reference
from tests.reference import strands as strands_reference
from tests.reference import widths as widths_reference

RNG = np.random.default_rng(3)
KNOTS = nurbs.clamped_knots(np.array([0.07, 0.2, 0.45, 0.5, 0.81]), 3)
S = np.sort(np.r_[0.0, RNG.uniform(0, 1, 40), 1.0])
CURVES = pytest.mark.parametrize(
    "knots", [KNOTS, *(nurbs.clamped_knots(np.array(k), 3) for k in ([], [0.3, 0.3, 0.6]))]
)


def test_no_kernel_has_defaults() -> None:
    """For a call that leaves one out, it is compiled anew, in the midst of a run."""
    modules = [
        importlib.import_module(f"{kernels.__name__}.{module.name}")
        for module in pkgutil.iter_modules(kernels.__path__)
    ]
    found = [f for m in modules for f in vars(m).values() if isinstance(f, Dispatcher)]
    assert len(found) > 20
    for kernel in found:
        parameters = inspect.signature(kernel.py_func).parameters.values()
        assert all(p.default is p.empty for p in parameters), kernel


@CURVES
def test_the_local_basis_is_that_of_scipy(knots: np.ndarray) -> None:
    s = np.sort(np.r_[S, knots])
    first, table = spline.local_basis(s, knots)
    for times in range(3):
        dense = np.zeros((len(s), len(knots) - 4))
        np.put_along_axis(dense, first[:, None] + np.arange(4), table[times], 1)
        np.testing.assert_allclose(dense, reference.design(s, knots, times), atol=1e-8)


def test_points_and_their_transpose_agree_with_dense_matrices() -> None:
    first, table = spline.local_basis(S, KNOTS)
    a = reference.design(S, KNOTS)
    control, points = RNG.normal(size=(9, 3)), RNG.normal(size=(len(S), 2))
    np.testing.assert_allclose(spline.combine(first, table[0], control), a @ control, atol=1e-12)
    np.testing.assert_allclose(spline.gather(first, table[0], points), a.T @ points, atol=1e-12)


def test_a_curve_is_evaluated_as_by_dense_matrices() -> None:
    control = RNG.normal(size=(9, 3))
    values = spline.evaluate(S, KNOTS, control)
    for times in range(3):
        expected = reference.design(S, KNOTS, times) @ control
        np.testing.assert_allclose(values[times], expected, atol=1e-7)


@CURVES
def test_banded_least_squares_is_dense_least_squares(knots: np.ndarray) -> None:
    first, table = spline.local_basis(S, knots)
    count = 3 * (len(knots) - 4)
    rows = RNG.normal(size=(len(S), 3, 3))
    information = rows @ rows.transpose(0, 2, 1)
    pull = RNG.normal(size=(len(S), 3))
    band, right = np.zeros((count, spline.BANDWIDTH)), np.zeros(count)
    spline.add_rows(first, table[0], information, pull, band, right)
    matrix, dense_right = reference.normal_equations(reference.design(S, knots), information, pull)
    inverse = np.linalg.inv(matrix)
    assert spline.factorize(band)
    np.testing.assert_allclose(
        spline.solve_factorized(band, right), inverse @ dense_right, rtol=1e-6
    )
    covariance = spline.sample_covariance(first, table[0], spline.band_of_inverse(band))
    for j, row in enumerate(reference.design(S, knots)):
        spread = np.kron(row[:, None], np.eye(3))
        np.testing.assert_allclose(
            covariance[j], spread.T @ inverse @ spread, rtol=1e-6, atol=1e-12
        )


def test_a_band_that_is_not_positive_definite_is_told() -> None:
    band = np.zeros((6, spline.BANDWIDTH))
    band[:, 0] = [1, 1, -1, 1, 1, 1]
    assert not spline.factorize(band)


@CURVES
@pytest.mark.parametrize("count", [1, 4])
def test_samples_are_even_within_each_span(knots: np.ndarray, count: int) -> None:
    for found, wanted in zip(
        spline.even_samples(knots, count), reference.even_samples(knots, count), strict=True
    ):
        np.testing.assert_allclose(found, wanted)


@CURVES
def test_the_length_is_that_of_gauss_s_rule_on_each_span(knots: np.ndarray) -> None:
    control = RNG.normal(size=(len(knots) - 4, 3))
    expected = reference.arc_length(knots, control)
    assert spline.arc_length(knots, control) == pytest.approx(expected, rel=1e-12)


def test_the_length_is_the_integral_of_the_speed() -> None:
    control = RNG.normal(size=(9, 3))
    curve = nurbs.curve_from(3, KNOTS, control)
    dense = nurbs.evaluate(curve, np.linspace(0, 1, 100_001))
    expected = np.linalg.norm(np.diff(dense, axis=0), axis=1).sum()
    assert spline.arc_length(KNOTS, control) == pytest.approx(expected, rel=1e-2)


def test_rows_are_those_of_stacked_matrices() -> None:
    jacobians = RNG.normal(size=(2, 30, 2, 3))
    goal, first = RNG.normal(size=(2, 30, 3))
    tangents = RNG.normal(size=(30, 2))
    weights, others = RNG.uniform(0, 2, (2, 30)) * (RNG.random((2, 30)) > 0.3)
    offset = RNG.normal(size=30)
    both = jacobians[0], jacobians[1]
    information, pull = rows.held_rows(both, goal, weights, others)
    expected = reference.held_rows(both, goal, weights, others)
    np.testing.assert_allclose(information, expected[0], atol=1e-12)
    np.testing.assert_allclose(pull, expected[1], atol=1e-12)
    rows.add_measured_rows(tangents, jacobians[0], others, offset, information, pull)
    measured = reference.measured_rows(tangents, jacobians[0], others, offset)
    np.testing.assert_allclose(information, expected[0] + measured[0], atol=1e-12)
    np.testing.assert_allclose(pull, expected[1] + measured[1], atol=1e-12)
    shape = rows.shape_rows(first, goal, weights, others)
    for found, wanted in zip(
        shape, reference.shape_rows(first, goal, weights, others), strict=True
    ):
        np.testing.assert_allclose(found, wanted, atol=1e-12)


@given(st.floats(-1, 12), st.floats(-1, 9), st.floats(0, 2 * np.pi))
def test_responses_are_bilinear_and_blind_to_the_sign_of_the_field(
    u: float, v: float, angle: float
) -> None:
    field = np.random.default_rng(5).normal(size=(8, 11, 2)).astype(np.float32)
    flipped = field * np.random.default_rng(6).choice([-1, 1], (8, 11, 1)).astype(np.float32)
    tangent = np.array([np.cos(angle), np.sin(angle)])
    expected = reference.response(field, u, v, tangent)
    for f in (field, flipped):
        assert search.response_at(f, u, v, *tangent) == pytest.approx(expected, abs=1e-5)


@given(
    st.integers(0, 10_000), st.integers(1, 9), st.integers(1, 12), st.sampled_from([0.0, 0.4, 1.0])
)
def test_what_lies_beside_a_curve_is_what_the_twins_see(
    seed: int, height: int, width: int, leniency: float
) -> None:
    rng = np.random.default_rng(seed)
    field = rng.normal(size=(height, width, 2)) * (rng.random((height, width, 1)) > 0.2)
    field = field.astype(np.float32)
    pixels = rng.uniform(-1.5, (width + 0.5, height + 0.5), (12, 2))
    angles = rng.uniform(0, 2 * np.pi, 12)
    # Some places lie on the pixels, those of the border among them.
    pixels[::2], angles[::4] = np.round(pixels[::2]), 0.0
    tangents, offsets = np.c_[np.cos(angles), np.sin(angles)], np.arange(-3, 3.1, 0.5)
    np.testing.assert_allclose(
        search.magnitudes(field, pixels),
        [reference.magnitude(field, *pixel) for pixel in pixels],
        atol=1e-5,
    )
    np.testing.assert_allclose(
        search.responses(field, pixels, tangents),
        [reference.response(field, *p, t) for p, t in zip(pixels, tangents, strict=True)],
        atol=1e-5,
    )
    np.testing.assert_allclose(
        search.normal_profiles(field, pixels, tangents, offsets, leniency),
        reference.normal_profiles(field, pixels, tangents, offsets, leniency),
        atol=1e-5,
    )


@given(
    st.integers(0, 10_000),
    st.integers(1, 4),
    st.integers(1, 5),
    st.floats(0, 0.5),
    st.integers(1, 4),
)
def test_the_best_path_is_the_best_of_all(
    seed: int, count: int, width: int, stiffness: float, reach: int
) -> None:
    gain = np.random.default_rng(seed).integers(0, 21, (count, width)) / 20
    path = search.best_path(gain, stiffness, reach)
    steps = np.diff(path)
    worth = gain[np.arange(count), path].sum() - stiffness * (steps**2).sum()
    assert np.all(np.abs(steps) <= reach)
    assert worth == pytest.approx(reference.best_path(gain, stiffness, reach))


@given(st.integers(0, 10_000), st.floats(0.1, 1.0))
def test_responses_under_shifts_are_those_at_shifted_pixels(seed: int, most: float) -> None:
    rng = np.random.default_rng(seed)
    field = rng.normal(0, 0.5, (30, 40, 2)).astype(np.float32)
    pixels, angle = rng.uniform(-3, 40, (7, 2)), rng.uniform(0, 2 * np.pi, 7)
    tangents, shifts = np.c_[np.cos(angle), np.sin(angle)], rng.uniform(-9, 9, (5, 2))
    means = search.shifted_responses(field, pixels, tangents, shifts, most)
    for mean, shift in zip(means, shifts, strict=True):
        responses = search.responses(field, pixels + shift, tangents)
        assert mean == pytest.approx(np.minimum(responses, most).mean())


@given(st.floats(-2, 2), st.floats(1.2, 2.5))
def test_peaks_are_found_below_the_sample(centre: float, sigma: float) -> None:
    grid = 0.5 * np.arange(-10, 11)
    profile = np.exp(-0.5 * ((grid - centre) / sigma) ** 2)[None, :]
    position, height = search.peaks(profile, np.array([10]), 3)
    assert 0.5 * (position[0] - 10) == pytest.approx(centre, abs=0.05)
    assert height[0] > 0.95


@given(st.integers(0, 10_000), st.integers(1, 16), st.integers(1, 3))
def test_peaks_are_those_of_fitted_parabolas(seed: int, width: int, half: int) -> None:
    rng = np.random.default_rng(seed)
    profiles, path = rng.normal(0.3, 1, (20, width)), rng.integers(0, width, 20)
    profiles[::2] = np.cumsum(profiles[::2], axis=1)
    for found, wanted in zip(
        search.peaks(profiles, path, half), reference.peaks(profiles, path, half), strict=True
    ):
        np.testing.assert_allclose(found, wanted, atol=1e-6)


def test_no_peak_at_the_rim_or_on_nothing() -> None:
    rising, empty = np.linspace(0, 1, 21), np.zeros(21)
    position, _ = search.peaks(np.stack([rising, empty]), np.array([10, 10]), 3)
    assert np.isnan(position).all()


def test_views_are_those_of_the_rig(rig: StereoRig) -> None:
    points = RNG.normal(0, 20, (30, 3)) + np.array([0, 0, 200])
    derivatives = RNG.normal(size=(30, 3))
    pixels = rig.project(points)
    jacobians = rig.projection_jacobian(points)
    for camera, pixel, jacobian in zip((rig.left, rig.right), pixels, jacobians, strict=True):
        view = spline.project_samples(camera.projection, points, derivatives)
        along = (jacobian @ derivatives[:, :, None])[:, :, 0]
        np.testing.assert_allclose(view[0], pixel, rtol=1e-12)
        np.testing.assert_allclose(view[1] * view[2][:, None], along, atol=1e-12)
        np.testing.assert_allclose(view[3], jacobian, atol=1e-12)
        np.testing.assert_allclose(np.linalg.norm(view[1], axis=1), 1.0)


def test_short_runs_are_dropped() -> None:
    flags = np.array([1, 1, 0, 1, 1, 1, 0, 1], bool)
    kept = search.solid(flags, np.full(8, 2.0), 5.0)
    np.testing.assert_array_equal(kept, [0, 0, 0, 1, 1, 1, 0, 0])


@given(st.lists(st.tuples(st.booleans(), st.integers(0, 8))), st.integers(0, 20))
def test_runs_are_as_long_as_those_of_the_twin(steps: list[tuple[bool, int]], least: int) -> None:
    flags = np.array([flag for flag, _ in steps], bool)
    lengths = np.array([length for _, length in steps], float)
    np.testing.assert_array_equal(
        search.solid(flags, lengths, float(least)), boundary_reference.solid(flags, lengths, least)
    )


@given(st.integers(0, 10_000))
def test_a_thread_ends_where_the_twin_has_it_end(seed: int) -> None:
    rng = np.random.default_rng(seed)
    x = np.arange(-40.0, 10.1, 0.5)
    end, softness, fading = rng.uniform(-30, 12), rng.uniform(0.3, 4), rng.uniform(0, 0.02)
    mean = (1 + fading * x) / (1 + np.exp((x - end) / softness)) + 0.1 * rng.normal(size=len(x))
    mean *= rng.choice([0.0, 0.3, 1.0])
    mean[rng.integers(0, len(x), 4)] = 0.0
    least = mean - rng.uniform(0, 0.3)
    found, expected = (
        f(x, mean, least) for f in (outer_boundary, boundary_reference.outer_boundary)
    )
    np.testing.assert_allclose(found, expected, atol=1e-9)


@given(st.integers(0, 10_000))
def test_ridges_are_as_wide_as_their_twins(seed: int) -> None:
    rng = np.random.default_rng(seed)
    count, across = int(rng.integers(1, 30)), np.arange(-4.0, 4.1, 0.5)
    profiles = rng.uniform(0, 1, (count, len(across))) * rng.integers(0, 2, (count, 1))
    offsets = np.sort(rng.normal(0, 3, profiles.shape), axis=1)
    for found, expected in zip(
        widths.moments(profiles, offsets),
        widths_reference.moments(profiles, offsets),
        strict=True,
    ):
        np.testing.assert_allclose(found, expected, atol=1e-9)
    # A ridge that becomes wider.
    v, u = np.mgrid[:25, :60]
    field = np.zeros((25, 60, 2), np.float32)
    field[..., 0] = np.exp(-0.5 * ((v - 12) / (1.5 + (u > 30) * rng.uniform(0, 2))) ** 2)
    pixels = np.c_[np.arange(60.0), np.full(60, rng.uniform(11, 13))]
    tangents, alone = np.tile([1.0, 0.0], (60, 1)), np.arange(60) < rng.integers(1, 60)
    arguments = field, pixels, tangents, across, alone
    narrow = widths.narrowness(*arguments)
    np.testing.assert_allclose(narrow, widths_reference.narrowness(*arguments), atol=1e-6)
    assert (widths.narrowness(*arguments[:4], np.zeros(60, bool)) == 1).all()


def random_strand(rng: np.random.Generator, count: int) -> strands_reference.Strand:
    """A wavy line through a small image."""
    t = np.linspace(0, 1, count)
    pixels = np.c_[60 * t, 20 + 12 * np.sin(rng.uniform(2, 9) * t + rng.uniform(0, 6))]
    tangents = np.gradient(pixels, axis=0)
    tangents /= np.linalg.norm(tangents, axis=1, keepdims=True)
    return pixels, tangents, 60 * t


@given(st.integers(0, 10_000))
def test_strands_are_kept_apart_as_their_twins_do(seed: int) -> None:
    rng = np.random.default_rng(seed)
    own, other = random_strand(rng, 40), random_strand(rng, 55)
    offsets = np.arange(-8, 8.1, 0.5)
    for apart in (0.0, 25.0):
        np.testing.assert_array_equal(
            search.claimed(own, other, offsets, apart),
            strands_reference.claimed(own, other, offsets, apart),
        )
        for near in (2.0, 5.5):
            np.testing.assert_array_equal(
                search.doubled(own, other, apart, near),
                strands_reference.doubled(own, other, apart, near),
            )
    np.testing.assert_array_equal(
        search.covered(own[0], own[1], offsets, other[0], 3.0),
        strands_reference.covered(own[0], own[1], offsets, other[0], 3.0),
    )


@given(st.integers(0, 10_000), st.sampled_from([(5.0, 0.4), (3.0, 0.0), (6.25, 0.4)]))
def test_the_line_beside_a_strand_is_that_of_its_twin(seed: int, how: tuple[float, float]) -> None:
    rng = np.random.default_rng(seed)
    own, other = random_strand(rng, 40), random_strand(rng, 55)
    # A ridge beside the strand, on noise.
    v, u = np.mgrid[:45, :64]
    middle = np.interp(u[0], own[0][:, 0], own[0][:, 1] + rng.uniform(-3, 3))
    field = rng.normal(0, 0.05, (45, 64, 2))
    field[..., 0] += np.exp(-0.5 * ((v - middle) / 1.5) ** 2)
    lengths, level = np.full(40, 1.5), rng.uniform(0.5, 1.0, 40)
    arguments = (field.astype(np.float32), own, other, 25.0, lengths, level)
    reach, leniency = how
    line = search.best_line(*arguments, reach, 0.5, leniency)
    for found, wanted in zip(
        line, reference.best_line(*arguments, reach, 0.5, leniency), strict=True
    ):
        np.testing.assert_array_equal(found, wanted)


def test_the_line_lies_where_the_ridge_is_within_the_image() -> None:
    along = np.arange(0.0, 64.0)
    own = np.c_[along, np.full(64, 20.0)], np.tile([1.0, 0.0], (64, 1)), along
    field = np.zeros((45, 64, 2), np.float32)
    field[..., 0] = np.exp(-0.5 * ((np.arange(45) - 21.3) / 1.5) ** 2)[:, None]
    one = np.ones(64)
    offset, response, found = search.best_line(field, own, own, 45.0, one, one, 5.0, 0.5, 0.4)
    np.testing.assert_array_equal(found, (along >= 1) & (along <= 62))
    np.testing.assert_allclose(offset[found], 1.3, atol=0.1)
    assert (response[found] > 0.9).all()
    assert not offset[~found].any()


def test_a_place_belongs_to_the_strand_that_is_nearest() -> None:
    along = np.arange(0.0, 40.0)
    east = np.tile([1.0, 0.0], (40, 1))
    own = np.c_[along, np.zeros(40)], east, along
    beside = np.c_[along, np.full(40, 6.0)], east, np.full(40, np.inf)
    offsets = np.arange(-8.0, 8.1, 1.0)
    taken = search.claimed(own, beside, offsets, 45.0)[20]
    assert offsets[taken].tolist() == [4.0, 5.0, 6.0, 7.0, 8.0]
    assert not search.doubled(own, beside, 45.0, 2.0).any()
    assert search.doubled(own, beside, 45.0, 6.5).all()
    assert search.doubled(own, (own[0], east, np.full(40, np.inf)), 45.0, 2.0).all()
    assert not search.doubled(own, own, 45.0, 2.0).any()
