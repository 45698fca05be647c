"""Two strands of one colour that run together: which side of their ridge is the thread's."""

from __future__ import annotations

import numpy as np
import pytest

from suturetrack.camera import StereoRig
from suturetrack.initialization import initialize
from suturetrack.initialization.abreast import tell_apart
from suturetrack.polylines import polyline_distances, polyline_length, resample
from suturetrack.types import Float64, RidgeField, Seed
from tests.test_initialization import dense, draw, field_of

DISPARITY = 160.0
LENS = 30.0
"""Half the length between the places where the strands cross, px."""
ALONG = np.linspace(-160, 160, 1281)


def at(along: Float64, aside: Float64, turned: float) -> Float64:
    """(k, 2) left pixels along and aside of a line through the middle of the picture."""
    c, s = np.cos(turned), np.sin(turned)
    return np.c_[400 + c * along - s * aside, 240 + s * along + c * aside]


def bow(along: Float64, height: float) -> Float64:
    """How far a thread runs aside of a line that it crosses twice, px."""
    return height * (1 - (along / LENS) ** 2)


def field_of_both(thread: Float64, other: Float64, nearer: float, rig: StereoRig) -> RidgeField:
    """The field of two strands, of which the other one has a greater disparity."""
    left = draw(thread, rig, draw(other, rig))
    right = draw(thread - [DISPARITY, 0], rig, draw(other - [DISPARITY + nearer, 0], rig))
    return field_of(left, right, rig)


@pytest.mark.parametrize("turned", [0.9, 2.0])
@pytest.mark.parametrize("height", [-5.0, -2.5, 2.5, 5.0])
@pytest.mark.parametrize("follows_other", [False, True])
def test_the_thread_is_told_from_a_strand_that_it_crosses_twice(
    rig: StereoRig, height: float, turned: float, follows_other: bool
) -> None:
    thread = at(ALONG, bow(ALONG, height), turned)
    other = at(ALONG, 0 * ALONG, turned)
    field = field_of_both(thread, other, 0.0, rig)
    run = np.arange(-100.0, 101.0, 2.0)
    aside = bow(run, height)
    if follows_other:
        aside[np.abs(run) < LENS] = 0
    path = at(run, aside, turned)
    beyond = np.abs(run) > LENS
    others = [at(run, 0 * run, turned)[beyond & (run * side > 0)] for side in (-1, 1)]
    shifted = [piece - [DISPARITY, 0] for piece in others]
    left, right = tell_apart(
        (field.left, field.right), np.c_[path, path - [DISPARITY, 0]], (others, shifted)
    )
    for told in (left.told[:, :2], right.told[:, :2] + [DISPARITY, 0]):
        inside = polyline_distances(told, at(np.linspace(-20, 20, 161), np.zeros(161), turned)) < 7
        assert inside.sum() > 10
        assert polyline_distances(told, thread).max() < 0.5


@pytest.mark.parametrize("turned", [0.9, 2.0])
@pytest.mark.parametrize("height", [-5.0, -2.5, 2.5, 5.0])
@pytest.mark.parametrize("comes_back", [False, True])
def test_a_thread_is_told_from_itself_where_it_crosses_itself_twice(
    rig: StereoRig, height: float, turned: float, comes_back: bool
) -> None:
    """Where the path takes both of its strands to be the straight one."""
    run = np.arange(-100.0, 100.5, 0.5)[:: -1 if comes_back else 1]
    aside, beyond = bow(run, height), np.sign(run[0]) * 170
    first, second = at(np.sort(run), 0 * run, turned), at(run, aside, turned)
    corners = np.array([[170, 0], [170, 12 * height], [beyond, 12 * height], [beyond, aside[0]]])
    loop = resample(np.r_[first[-1:], at(*corners.T, turned), second[:1]], 800)
    taken = at(run, np.where(np.abs(run) < LENS, 0, aside), turned)
    thread, path = (np.concatenate([first, loop, last]) for last in (second, taken))
    field = field_of_both(thread, thread, 0.0, rig)
    path = resample(path, int(polyline_length(path) / 2))
    views = tell_apart((field.left, field.right), np.c_[path, path - [DISPARITY, 0]], ([], []))
    for view, shift in zip(views, (0, DISPARITY), strict=True):
        for strand, is_its in ((first, view.told[:, 2] < 0.5), (second, view.told[:, 2] > 0.5)):
            told = view.told[is_its, :2] + [shift, 0]
            assert (np.linalg.norm(told - [400, 240], axis=1) < 20).sum() > 10
            assert polyline_distances(told, strand).max() < 0.6


def test_a_thread_alone_is_left_as_it_is(rig: StereoRig) -> None:
    thread = at(ALONG, bow(ALONG, 5), 0.9)
    field = field_of_both(thread, thread, 0.0, rig)
    pixels = np.c_[thread, thread - [DISPARITY, 0]][::8]
    for view in tell_apart((field.left, field.right), pixels, ([], [])):
        assert not len(view.told)
        assert not len(view.blurred)
        assert view.clear(thread).all()


@pytest.mark.parametrize(("height", "nearer"), [(2.5, 3.0), (2.5, -3.0), (4.0, -3.0), (5.0, 3.0)])
def test_a_strand_alongside_does_not_draw_the_curve_aside(
    rig: StereoRig, height: float, nearer: float
) -> None:
    thread, other = at(ALONG, bow(ALONG, height), 0.9), at(ALONG, 0 * ALONG, 0.9)
    found = initialize(
        field_of_both(thread, other, nearer, rig), rig, Seed(pixel=tuple(thread[200]))
    )
    left, right = rig.project(dense(found.curve))
    alongside = np.linalg.norm(left - [400, 240], axis=1) < LENS + 10
    assert polyline_distances(left[alongside], thread).max() < 0.35
    disparity = (left - right)[alongside, 0]
    np.testing.assert_allclose(disparity, DISPARITY, atol=0.2)
