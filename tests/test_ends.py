from dataclasses import replace

import numpy as np
import pytest

from suturetrack import nurbs
from suturetrack.camera import StereoRig
from suturetrack.segmentation import Segmenter
from suturetrack.stage import open_scene
from suturetrack.tracking import Tracker, TrackingConfig, gauss_newton
from suturetrack.tracking.end_watch import EndWatch
from suturetrack.tracking.ends import EndStep, end_shifts, find_ends, with_ends
from suturetrack.tracking.energies import measure_levels
from suturetrack.tracking.folds import doubled_ends
from suturetrack.tracking.images import Images
from suturetrack.tracking.length import KnownLength
from suturetrack.types import Seed, Stamp, StereoFrame
from tests.painting import curve_through, paint

FRAME_NS = 33_000_000
PIXEL = 0.0025


def step_at(offset_px: float) -> EndStep:
    return EndStep(offset_px, PIXEL, at_border=False)


def settled_watch(length: float) -> tuple[EndWatch, int]:
    watch, now = EndWatch(length, 0), 0
    for _ in range(40):
        now += FRAME_NS
        assert watch.moves(step_at(0.0), step_at(0.0), length, now) == (0.0, 0.0)
    assert watch.settled
    return watch, now


def test_ends_are_found_without_bias_in_what_the_filter_shows() -> None:
    offsets = []
    for seed in range(3):
        scene = open_scene("figure8-107", seed)
        segmenter = Segmenter(scene.rig)
        frame = StereoFrame(Stamp(0, 0, 0), *scene.render(0))
        segmenter.learn(frame, Seed(pixel=scene.seed_pixel(0)))
        field = segmenter.step(frame)
        curve = curve_through(scene.truth(0)[0].points)
        images = Images(field, scene.rig, measure_levels(curve, field, scene.rig))
        for found in find_ends(curve, images):
            assert found is not None
            offsets.append(found.offset_px)
    assert np.abs(offsets).max() < 1.0
    assert abs(np.mean(offsets)) < 0.2


def test_a_curve_of_one_span_is_drawn_out_as_any_other() -> None:
    points = np.array([[0.0, 0.0, 200.0], [2.0, 1.0, 200.0], [4.0, 1.0, 201.0], [6.0, 0.0, 202.0]])
    curve = nurbs.curve_from(3, nurbs.clamped_knots(np.zeros(0), 3), points)
    longer = with_ends(curve, -0.1, 1.2)
    s = np.linspace(-0.1, 1.2, 27)
    ends = nurbs.evaluate(longer, np.array([0.0, 1.0]))
    power = np.polynomial.Polynomial.fit
    inside = np.linspace(0, 1, 9)
    goes_on = [power(inside, c, 3)(s) for c in nurbs.evaluate(curve, inside).T]
    np.testing.assert_allclose(ends, np.array(goes_on).T[[0, -1]], atol=1e-9)


@pytest.mark.parametrize(("last_row", "at_border"), [(2, True), (-8, False)])
def test_an_end_that_the_border_cuts_at_a_small_angle_is_known_as_such(
    rig: StereoRig, last_row: int, at_border: bool
) -> None:
    """The filter shows less and less of the thread for many of its pixels before the border."""
    width, height = rig.image_size
    border = height - 1
    pixels = np.linspace([0.3 * width, border - 20], [0.8 * width, border + last_row], 200)
    truth = rig.triangulate(pixels, pixels - [30.0, 0.0])
    field = paint(rig, [truth], 0, noise=0.0)
    shown = np.clip((border - np.arange(height)) / 4, 0, 1)[:, None, None]
    field = replace(field, left=field.left * shown, right=field.right * shown)
    curve = curve_through(truth[pixels[:, 1] < border - 3])
    images = Images(field, rig, measure_levels(curve, field, rig))
    start, stop = find_ends(curve, images)
    assert start is not None
    assert stop is not None
    assert (start.at_border, stop.at_border) == (False, at_border)


@pytest.mark.parametrize(("wide_px", "widens"), [(0.0, False), (2.0, False), (12.0, True)])
def test_something_wider_that_goes_on_behind_an_end_is_told_from_a_hole(
    rig: StereoRig, wide_px: float, widens: bool
) -> None:
    pixel = 200.0 / rig.focal
    truth = np.linspace([-20.0, -10.0, 200.0], [20.0, 10.0, 200.0], 200)
    along = (truth[-1] - truth[0]) / np.linalg.norm(truth[-1] - truth[0])
    across = np.array([-along[1], along[0], 0.0])
    wide = truth[-1] + np.linspace(0.0, wide_px * pixel, 20)[:, None] * along
    bundle = [wide + aside * pixel * across for aside in (-2.0, 0.0, 2.0)] if wide_px else []
    field = paint(rig, [truth, *bundle], 0, noise=0.0)
    curve = curve_through(truth)
    images = Images(field, rig, measure_levels(curve, field, rig))
    start, stop = find_ends(curve, images)
    assert start is not None
    assert stop is not None
    assert (start.widens, stop.widens) == (False, widens)


def along_a_row(rig: StereoRig, depths: tuple[float, float]) -> np.ndarray:
    """(200, 3) points of a thread along a row of the left image, with these depths at its ends."""
    across = np.array([0.0, 0.25]) * depths
    ends = np.stack([across, 0.02 * np.array(depths), depths], axis=1)
    return np.linspace(ends[0], ends[1], 200)


def test_the_views_tell_the_depth_of_ends_that_run_along_an_epipolar_line() -> None:
    rig = open_scene("figure8-107", 0).rig
    truth = along_a_row(rig, (200.0, 200.0))
    guess = curve_through(along_a_row(rig, (197.0, 202.0)))
    field = paint(rig, [truth], 0, noise=0.0)
    images = Images(field, rig, measure_levels(curve_through(truth), field, rig))
    for end, told in enumerate(end_shifts(guess, images)):
        assert told is not None
        shift, row = told
        assert abs(shift) > 1.0
        missing = truth[-end] - guess.control_points[-end]
        assert shift == pytest.approx(float(row @ missing), abs=0.4)
    curve, config = guess, TrackingConfig()
    for _ in range(30):
        curve = gauss_newton.fit(curve, curve, images, 5.0, config).curve
    off = curve.control_points[[0, -1], 2] - truth[[0, -1], 2]
    assert np.abs(off).max() < 0.6


def test_an_end_beside_another_ridge_only_makes_good_what_is_lacking() -> None:
    watch, now = settled_watch(100.0)
    beside = replace(step_at(8.0), alone=False)
    assert watch.moves(step_at(0.0), beside, 100.0, now + FRAME_NS) == (0.0, 0.0)
    assert watch.seen == (True, False)
    start, stop = watch.moves(step_at(0.0), beside, 99.0, now + 2 * FRAME_NS)
    assert start == 0.0
    assert stop == pytest.approx(100 / 99 - 1)
    _, stop = watch.moves(step_at(0.0), beside, 90.0, now + 3 * FRAME_NS)
    assert stop == pytest.approx(8 * PIXEL)


@pytest.mark.parametrize(("is_known", "wanted"), [(False, 100 * (1 + 8 * PIXEL)), (True, 100.0)])
def test_what_goes_on_beyond_an_end_on_a_known_thread_is_not_wanted(
    is_known: bool, wanted: float
) -> None:
    watch, now = settled_watch(100.0)
    beside = replace(step_at(8.0), alone=False, on_another=is_known)
    assert watch.moves(step_at(0.0), beside, 100.0, now + FRAME_NS) == (0.0, 0.0)
    assert watch.wanted == pytest.approx(wanted)


def test_an_end_beside_another_ridge_gives_back_what_is_too_much() -> None:
    watch, now = settled_watch(100.0)
    beside = replace(step_at(1.0), alone=False)
    start, stop = watch.moves(step_at(0.0), beside, 101.0, now + FRAME_NS)
    assert (start, stop) == (0.0, pytest.approx(100 / 101 - 1))


@pytest.mark.parametrize(("ahead_px", "grown"), [(1.0, 110.0), (4.0, 100.0)])
def test_a_thread_is_drawn_out_steadily_and_not_in_leaps(ahead_px: float, grown: float) -> None:
    watch, now = settled_watch(100.0)
    length = 100.0
    for _ in range(40):
        now += FRAME_NS
        length *= 1 + sum(watch.moves(step_at(0.0), step_at(ahead_px), length, now))
    assert length == pytest.approx(grown, abs=1.0)


@pytest.mark.parametrize("fields", [0, 40])
def test_a_thread_is_not_drawn_out_along_something_wider(fields: int) -> None:
    watch, length, now = EndWatch(100.0, 0), 100.0, 0
    for i in range(fields + 40):
        now += FRAME_NS
        ahead = replace(step_at(0.0 if i < fields else 1.0), widens=i >= fields)
        moves = watch.moves(step_at(0.0), ahead, length, now, is_known=True)
        length *= 1 + sum(moves)
    assert length == pytest.approx(100.0)


@pytest.mark.parametrize("ahead_px", [5.0, 10.0])
def test_an_end_that_insists_for_long_is_believed_at_last(ahead_px: float) -> None:
    watch, now = settled_watch(100.0)
    moved_s = []
    for _ in range(200):
        now += FRAME_NS
        if watch.moves(step_at(0.0), step_at(ahead_px), 100.0, now)[1] > 2 * PIXEL:
            moved_s.append(now * 1e-9)
    assert 4.5 < moved_s[0] - 40 * FRAME_NS * 1e-9 < 5.5


@pytest.mark.parametrize("ahead_px", [5.0, 10.0])
@pytest.mark.parametrize(("hidden_s", "held_s"), [(0.3, 0.6), (0.6, 1.2)])
def test_a_thread_of_unknown_length_is_soon_drawn_out_in_leaps(
    ahead_px: float, hidden_s: float, held_s: float
) -> None:
    """What was hidden when the thread was found comes out at once, and insists for twice as long."""
    watch, now, grown_s = EndWatch(100.0, 0), 0, []
    for _ in range(100):
        now += FRAME_NS
        step = step_at(0.0 if now < hidden_s * 1e9 else ahead_px)
        if watch.moves(step_at(0.0), step, 100.0, now)[1] > 2 * PIXEL:
            grown_s.append(now * 1e-9)
    assert grown_s[0] - hidden_s == pytest.approx(held_s, abs=0.1)


def test_other_ridges_make_no_thread_shorter_at_once() -> None:
    watch, _ = settled_watch(98.0)
    known = KnownLength(100.0).watched(watch)
    assert known.learned(watch, 0.1, is_clear=True).now == pytest.approx(98.0, rel=1e-3)
    assert known.learned(watch, 0.1, is_clear=False).now > 99.9
    assert known.learned(watch, 30.0, is_clear=False).now == pytest.approx(98.0, rel=1e-3)


def test_a_loop_that_a_knot_has_drawn_in_may_show_again() -> None:
    drawn_in, _ = settled_watch(80.0)
    known = KnownLength(90.0).looped(90.0).looped(89.0).learned(drawn_in, 30.0, is_clear=True)
    assert known.now == pytest.approx(80.0, rel=1e-3)
    assert not known.watched(drawn_in).is_outgrown(90.0, 0.5)
    assert known.watched(drawn_in).is_outgrown(93.0, 0.5)
    assert not known.is_another(90.0, 80.0, 0.0, is_clear=False)
    assert replace(known, with_loops=0.0).watched(drawn_in).is_outgrown(90.0, 0.5)


def test_what_the_border_cuts_off_makes_the_rest_no_longer() -> None:
    whole, _ = settled_watch(140.0)
    cut, never_whole = EndWatch(110.0, 0), KnownLength(110.0)
    cut.at_border = True
    known = KnownLength(140.0).watched(whole).watched(cut)
    assert known.is_exceeded(146.0, 0.5)
    assert not known.is_exceeded(139.0, 0.5)
    assert not known.is_undercut(110.0, 0.5)
    assert KnownLength(140.0).watched(whole).is_undercut(134.0, 0.5)
    assert not known.is_outgrown(146.0, 0.5)
    assert not never_whole.watched(cut).is_exceeded(146.0, 0.5)


@pytest.mark.parametrize("ahead_px", [5.0, 10.0])
def test_a_held_end_does_not_settle_the_length(ahead_px: float) -> None:
    watch, now = EndWatch(100.0, 0), 0
    for number in range(45):
        now += FRAME_NS
        is_hidden = now < 0.4e9 or number % 5 == 0
        step = step_at(0.0 if is_hidden else ahead_px)
        assert watch.moves(step_at(0.0), step, 100.0, now) == (0.0, 0.0)
    assert not watch.settled


def test_a_loop_that_is_drawn_shut_moves_no_end() -> None:
    watch, now = settled_watch(100.0)
    for _ in range(10):
        now += FRAME_NS
        assert watch.moves(step_at(0.2), step_at(-0.3), 88.0, now) == (
            0.2 * PIXEL,
            -0.3 * PIXEL,
        )
        assert watch.seen == (True, True)
    assert watch.length == pytest.approx(88.0, rel=1e-3)


def test_a_detour_elsewhere_draws_no_end_in() -> None:
    """A knot that is drawn tight may lead the curve astray, and its ends are where the images show them."""
    watch, now = settled_watch(100.0)
    length, drawn_in = 107.0, 0.0
    for _ in range(30):
        now += FRAME_NS
        start, stop = watch.moves(step_at(0.2), step_at(0.1), length, now)
        drawn_in -= (start + stop) * length
        length *= 1.0 + start + stop
    assert drawn_in < 2 * PIXEL * length


def test_an_end_that_went_on_is_drawn_in_again() -> None:
    """It goes on along a tool, as far as the thread was long, and gives back what that was too much."""
    watch, now = settled_watch(100.0)
    for length in (99.0, 101.0):
        now += FRAME_NS
        start, stop = watch.moves(step_at(0.0), step_at(10.0), length, now)
        assert start == 0.0
        assert length * (1.0 + stop) == pytest.approx(100.0)


def test_a_thread_slides_along_itself_while_a_loop_of_it_is_drawn_shut() -> None:
    """What one end loses the other gains: nothing is hidden, though the curve became shorter meanwhile."""
    watch, now = settled_watch(100.0)
    start, stop = watch.moves(step_at(-10.0), step_at(10.0), 96.0, now + FRAME_NS)
    assert (start, stop) == pytest.approx((-10.0 * PIXEL, 10.0 * PIXEL))
    assert watch.seen == (True, True)


def test_an_end_that_steps_off_is_held_where_it_was() -> None:
    watch, now = settled_watch(100.0)
    start, stop = watch.moves(step_at(0.0), step_at(-30.0), 100.0, now + FRAME_NS)
    assert start == 0.0
    assert stop == pytest.approx(0.0)
    assert watch.seen == (True, False)


@pytest.mark.parametrize(("width", "is_fold"), [(0.6, True), (12.0, False)])
def test_an_end_on_its_own_thread_has_folded_if_it_turned_back_at_once(
    rig: StereoRig, width: float, is_fold: bool
) -> None:
    """A loop as wide as that leads its end back onto the thread, over the last 10 mm."""
    out = np.c_[np.linspace(0, 50, 200), np.zeros(200)]
    angle = np.linspace(-np.pi / 2, np.pi / 2, 60)[1:]
    turn = width / 2 * np.c_[np.cos(angle), 1 + np.sin(angle)] + [50, 0]
    back = np.linspace(0, 1, 120)[1:, None] * [-30.0, 0.0] + turn[-1]
    back[:, 1] *= np.clip((back[:, 0] - 30) / 20, 0, 1) ** 2
    flat = np.concatenate([out, turn, back]) - [25, 0]
    curve = curve_through(np.c_[flat, np.full(len(flat), 200.0)])
    free, tail = doubled_ends(curve, rig)
    assert free.part == 0.0
    assert tail.part > 0.1
    assert tail.is_fold == is_fold
    turned_round = doubled_ends(nurbs.reversed_curve(curve), rig)
    assert turned_round[0].part == pytest.approx(tail.part, abs=0.02)
    assert turned_round[0].is_fold == is_fold


@pytest.mark.parametrize(
    ("back_mm", "width", "cut"), [(1.5, 0.2, 1.5), (3.0, 0.2, 3.0), (3.0, 2.0, 0.0)]
)
def test_a_tip_that_has_begun_to_fold_is_cut_off_at_the_turn(
    rig: StereoRig, back_mm: float, width: float, cut: float
) -> None:
    """A tip that runs back beside the thread at a distance `width`; a hook is wider than a fold."""
    out = np.c_[np.linspace(0, 50, 400), np.zeros(400)]
    angle = np.linspace(-np.pi / 2, np.pi / 2, 30)[1:]
    turn = width / 2 * np.c_[np.cos(angle), 1 + np.sin(angle)] + [50, 0]
    back = np.linspace(0, 1, 30)[1:, None] * [-back_mm, 0.0] + turn[-1]
    flat = np.concatenate([out, turn, back]) - [25, 0]
    points = np.c_[flat, np.full(len(flat), 200.0)]
    travelled = np.r_[0.0, np.cumsum(np.linalg.norm(np.diff(points, axis=0), axis=1))]
    s = travelled / travelled[-1]
    knots = nurbs.clamped_knots(
        np.r_[np.linspace(0, 0.9, 12)[1:], np.linspace(0.9, 1, 21)[1:-1]], 3
    )
    curve = nurbs.fit(points, s, knots, 3)
    free, tail = doubled_ends(curve, rig)
    assert free.part == 0.0
    assert tail.is_fold == (cut > 0.0)
    assert tail.part * travelled[-1] == pytest.approx(cut, abs=0.5)
    turned_round, _ = doubled_ends(nurbs.reversed_curve(curve), rig)
    assert turned_round.part == pytest.approx(tail.part, abs=0.01)


@pytest.mark.parametrize("length", [0.5, 1.0, 2.0])
def test_a_stub_has_no_folded_ends(rig: StereoRig, length: float) -> None:
    x = np.linspace(0, length, 50)
    curve = curve_through(np.c_[x, 0 * x, 0 * x + 200.0])
    assert [tail.part for tail in doubled_ends(curve, rig)] == [0.0, 0.0]


def test_an_end_that_is_drawn_out_of_a_hole_does_not_fold() -> None:
    scene = open_scene("pull-through", 190)
    segmenter, tracker = Segmenter(scene.rig), Tracker(scene.rig)
    for number in range(180):
        frame = StereoFrame(Stamp(number, round(number * 1e9 / 30), 0), *scene.render(number))
        if number == 0:
            start = Seed("0", pixel=scene.seed_pixel(0))
            segmenter.learn(frame, start)
            tracker.seed(start)
        (state,) = tracker.step(segmenter.step(frame)).states
        (truth,) = scene.truth(number)
        assert state.length == pytest.approx(truth.length, rel=0.05)
