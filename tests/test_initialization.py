"""From one seed to the whole thread, on drawn scenes with an exact truth."""

from __future__ import annotations

import re
from dataclasses import replace

import cv2
import numpy as np
import pytest
from scipy.spatial import cKDTree
from scipy.stats import spearmanr

from suturetrack import nurbs
from suturetrack.camera import StereoRig
from suturetrack.initialization import (
    Initialization,
    InitializationError,
    initialize,
    remaining,
)
from suturetrack.initialization.arms import Arms
from suturetrack.initialization.colours import Tints, another_begins, darkening
from suturetrack.initialization.config import InitializationConfig
from suturetrack.initialization.crest import View, find_crest
from suturetrack.initialization.depth import Depth
from suturetrack.initialization.ends import read_end
from suturetrack.initialization.joints import Joints
from suturetrack.initialization.segments import Ridges, find_ridges, split_at_touches
from suturetrack.initialization.threads import _without_faint_ends
from suturetrack.initialization.topology import merge_ends
from suturetrack.metrics import curve_error
from suturetrack.polylines import polyline_distances, polyline_length
from suturetrack.segmentation import Segmenter
from suturetrack.stage import Picture, Scene, open_scene
from suturetrack.types import (
    Colours,
    Float64,
    Image,
    InputError,
    Nurbs,
    RidgeField,
    Seed,
    Stamp,
    StereoFrame,
)
from tests.conftest import make_rig
from tests.painting import paint

STAMP = Stamp(0, 0, 0)


def draw(
    pixels: Float64,
    rig: StereoRig,
    image: Image | None = None,
    width: int = 3,
    grey: int = 70,
) -> Image:
    """A dark thread through (k, 2) pixels, drawn four times as large and reduced."""
    scale = 4
    columns, rows = rig.image_size
    if image is None:
        image = np.full((rows, columns), 190, np.uint8)
    large = np.zeros((rows * scale, columns * scale), np.uint8)
    at = np.round(((pixels + 0.5) * scale - 0.5) * 16).astype(np.int32)
    cv2.polylines(large, [at], False, 255, width * scale * 3 // 4, cv2.LINE_AA, 4)
    share = cv2.resize(large, (columns, rows), interpolation=cv2.INTER_AREA) / 255
    return np.rint(image * (1 - share) + grey * share).astype(np.uint8)


def field_of(left: Image, right: Image, rig: StereoRig) -> RidgeField:
    return Segmenter(rig).step(StereoFrame(STAMP, left, right))


def field_and_seed(scene: Scene, thread: str = "0", frame: int = 0) -> tuple[RidgeField, Seed]:
    """A field of a scene, the first that is seen of it, and a seed that its segmenter has learned from."""
    seed, segmenter = Seed(pixel=scene.seed_pixel(frame, thread)), Segmenter(scene.rig)
    pair = StereoFrame(STAMP, *scene.render(frame))
    segmenter.learn(pair, seed)
    return segmenter.step(pair), seed


def assert_is_found_whole(scenario: str, seed: int, rig: str, frame: int = 0) -> None:
    """To 0.3 mm, its ends to 1 mm, and its length to 2 %."""
    scene = open_scene(scenario, seed, rig)
    field, start = field_and_seed(scene, frame=frame)
    truth = scene.truth(frame)[0].points
    error = curve_error(dense(initialize(field, scene.rig, start).curve), truth)
    assert error.rms < 0.3
    assert max(error.ends) < 1
    assert abs(error.length_percent) < 2


def dense(curve: Nurbs, count: int = 1500) -> Float64:
    return nurbs.evaluate(curve, nurbs.evenly_spaced(curve, count))


def field_of_curve(curve: Nurbs, rig: StereoRig) -> RidgeField:
    left, right = rig.project(dense(curve))
    return field_of(draw(left, rig), draw(right, rig), rig)


def test_the_whole_thread_is_found_from_its_middle(rig: StereoRig, curve: Nurbs) -> None:
    truth = dense(curve)
    found = initialize(
        field_of_curve(curve, rig), rig, Seed(pixel=tuple(rig.project(truth[700])[0]))
    )
    error = curve_error(dense(found.curve), truth)
    assert error.mean < 0.3
    assert max(error.ends) < 1.5
    assert abs(error.length_percent) < 2
    assert found.reprojection_px < 0.2


@pytest.mark.parametrize("width", [4, 7, 10])
def test_the_width_of_the_thread_does_not_matter(rig: StereoRig, curve: Nurbs, width: int) -> None:
    truth = dense(curve)
    views = [draw(pixels, rig, width=width) for pixels in rig.project(truth)]
    frame = StereoFrame(STAMP, *views)
    seed = Seed(pixel=tuple(rig.project(truth[700])[0]))
    segmenter = Segmenter(rig)
    segmenter.learn(frame, seed)
    found = initialize(segmenter.step(frame), rig, seed)
    error = curve_error(dense(found.curve), truth)
    assert error.mean < 0.5
    assert abs(error.length_percent) < 3
    assert found.growth.left.cost.shape == (480, 640)
    u, v = np.rint(rig.project(truth[700])[0]).astype(int)
    assert np.isfinite(found.growth.left.cost[v, u])
    marked = found.growth.marks[:, 0]
    assert polyline_distances(marked, rig.project(truth)[0]).max() < width


def test_a_seed_on_nothing_is_refused_with_the_nearest_ridge(rig: StereoRig, curve: Nurbs) -> None:
    field = field_of_curve(curve, rig)
    with pytest.raises(InitializationError, match="no thread within 8 px") as refusal:
        initialize(field, rig, Seed(pixel=(20.0, 20.0)))
    left = rig.project(dense(curve))[0]
    nearest = np.linalg.norm(left[:, None] - refusal.value.candidates, axis=2).min(0)
    assert len(nearest) >= 1
    assert nearest.max() < 2


def test_a_refusal_speaks_of_the_pixels_of_the_raw_image(
    distorted_rig: StereoRig, curve: Nurbs
) -> None:
    shown = distorted_rig.project_raw(dense(curve))
    field = field_of(*(draw(view, distorted_rig) for view in shown), distorted_rig)
    with pytest.raises(InitializationError) as refusal:
        initialize(field, distorted_rig, Seed(pixel=(60.0, 40.0)))
    said = re.findall(r"\((-?\d+), (-?\d+)\)", refusal.value.reason)
    seed, *near = np.array(said, float)
    assert seed.tolist() == [60, 40]
    assert len(near) >= 1
    assert polyline_distances(np.array(near), shown[0]).max() < 2


@pytest.mark.parametrize(
    ("seed", "words"),
    [
        (Seed(pixel=(700.0, 20.0)), "outside the 640x480 left image"),
        (Seed(point=(0.0, 0.0, -200.0)), "behind the camera"),
    ],
)
def test_a_seed_that_no_image_shows_is_refused(
    rig: StereoRig, curve: Nurbs, seed: Seed, words: str
) -> None:
    with pytest.raises(InputError, match=words):
        initialize(field_of_curve(curve, rig), rig, seed)


def test_a_seed_on_the_outermost_half_pixel_is_in_the_image(rig: StereoRig, curve: Nurbs) -> None:
    with pytest.raises(InitializationError, match="no thread within 8 px"):
        initialize(field_of_curve(curve, rig), rig, Seed(pixel=(639.3, 20.0)))


def test_a_right_view_without_the_thread_is_refused(rig: StereoRig, curve: Nurbs) -> None:
    left, _ = rig.project(dense(curve))
    blank = np.full((480, 640), 190, np.uint8)
    with pytest.raises(InitializationError, match="right view"):
        initialize(field_of(draw(left, rig), blank, rig), rig, Seed(pixel=tuple(left[700])))


def test_growth_tells_what_was_reached_and_marked(rig: StereoRig, curve: Nurbs) -> None:
    truth = dense(curve)
    seed = rig.project(truth[700])[0]
    found: Initialization = initialize(field_of_curve(curve, rig), rig, Seed(pixel=tuple(seed)))
    left = found.growth.left
    u, v = np.rint(seed).astype(int)
    assert left.cost[v, u] < 5
    assert np.isfinite(left.cost).sum() > 1000
    spacing = np.linalg.norm(np.diff(found.growth.marks[:, 0], axis=0), axis=1)
    assert abs(np.median(spacing) - 6) < 0.5


def test_any_seed_gives_the_same_curve(rig: StereoRig, curve: Nurbs) -> None:
    field, truth = field_of_curve(curve, rig), dense(curve)
    pixels = rig.project(truth)[0]
    rng = np.random.default_rng(3)
    middle = initialize(field, rig, Seed(pixel=tuple(pixels[700])))
    reference = rig.project(dense(middle.curve, 400))[0]
    for k in (12, 300, 1000, 1488):
        seed = pixels[k] + rng.uniform(-1, 1, 2) * 3
        found = initialize(field, rig, Seed(pixel=tuple(seed)))
        here = rig.project(dense(found.curve, 400))[0]
        assert polyline_distances(here, reference).max() < 0.5
        assert polyline_distances(reference, here).max() < 0.5


@pytest.mark.parametrize(("scenario", "seed"), [("crossings", 200), ("knot", 204)])
def test_any_seed_gives_the_same_curve_of_a_thread_that_crosses_itself(
    scenario: str, seed: int
) -> None:
    scene = open_scene(scenario, seed)
    field, start = field_and_seed(scene)
    reference = dense(initialize(field, scene.rig, start).curve, 400)
    lines = scene.rig.project(reference)
    for k in (1, 100, 300, 398):
        found = initialize(field, scene.rig, Seed(point=tuple(reference[k])))
        for here, there in zip(scene.rig.project(dense(found.curve, 400)), lines, strict=True):
            assert polyline_distances(here, there).max() < 0.5
            assert polyline_distances(there, here).max() < 0.5


def test_a_seed_in_space_is_as_good_as_a_pixel(rig: StereoRig, curve: Nurbs) -> None:
    field, point = field_of_curve(curve, rig), dense(curve)[700]
    by_point = initialize(field, rig, Seed(point=tuple(point)))
    by_pixel = initialize(field, rig, Seed(pixel=tuple(rig.project(point)[0])))
    np.testing.assert_allclose(by_point.curve.control_points, by_pixel.curve.control_points)


def test_a_seed_beside_the_thread_snaps_to_it(rig: StereoRig, curve: Nurbs) -> None:
    field, pixels = field_of_curve(curve, rig), rig.project(dense(curve))[0]
    along = pixels[701] - pixels[699]
    aside = np.array([-along[1], along[0]]) / np.linalg.norm(along)
    near = initialize(field, rig, Seed(pixel=tuple(pixels[700] + 7.5 * aside)))
    on = initialize(field, rig, Seed(pixel=tuple(pixels[700])))
    np.testing.assert_allclose(near.curve.control_points, on.curve.control_points, atol=1e-6)


def figure_eight() -> Float64:
    """A thread that crosses itself once, 195 mm before the camera, with relief."""
    t = np.linspace(0.35, 2 * np.pi - 0.35, 3000) + np.pi / 2
    return np.c_[10 + 28 * np.cos(t), 22 * np.sin(2 * t), 195 + 8 * np.sin(t + 0.4)]


def test_a_crossing_is_passed_straight_on(rig: StereoRig) -> None:
    truth = figure_eight()
    left, right = rig.project(truth)
    field = field_of(draw(left, rig), draw(right, rig), rig)
    found = initialize(field, rig, Seed(pixel=tuple(left[500])))
    points = dense(found.curve, 3000)
    error = curve_error(points, truth)
    assert error.rms < 0.5
    assert abs(error.length_percent) < 2
    assert max(error.ends) < 1.5
    nearest = cKDTree(truth).query(points[::100])[1]
    straight = np.array([n for n in nearest if np.linalg.norm(truth[n] - truth[1500]) > 15])
    assert len(straight) > 10
    assert abs(spearmanr(straight, np.arange(len(straight))).statistic) > 0.99


def loop_with_a_shared_run() -> Float64:
    """A thread that winds once and a quarter around a circle, the second time behind the first."""
    t = np.linspace(-0.35 * np.pi, 2.05 * np.pi, 2500)
    around = np.c_[14 * np.sin(t), 14 * np.cos(t), 195 + 6 * t / t[-1]]
    before, after = around[1] - around[0], around[-1] - around[-2]
    lead = np.linspace(1500, 1, 800)[:, None]
    return np.r_[around[0] - lead * before, around, around[-1] + lead[::-1] * after]


def random_thread(rig: StereoRig, seed: int) -> Float64:
    """(1500, 3) a smooth curve of a random shape, far from the cameras, that both show whole."""
    rng = np.random.default_rng(seed)
    while True:
        heading, corners = rng.normal(size=3), [np.zeros(3)]
        for _ in range(rng.integers(6, 9)):
            heading = heading / np.linalg.norm(heading) + 0.8 * rng.normal(size=3)
            corners.append(corners[-1] + heading * rng.uniform(0.5, 1.5))
        corners = np.array(corners) - np.mean(corners, axis=0) + [0, 0, 8.5]
        knots = nurbs.clamped_knots(np.linspace(0, 1, len(corners) - 2)[1:-1], 3)
        points = dense(nurbs.curve_from(3, knots, corners))
        left, right = rig.project(points)
        inside = (np.r_[left, right] > 10) & (np.r_[left, right] < [629, 469])
        if points[:, 2].min() > 5 and inside.all() and polyline_length(left) > 250:
            return points


def test_threads_of_any_shape_are_found_whole_from_far_away() -> None:
    """Bends in the line of sight, small loops and ends along epipolar lines; a pixel of disparity is a
    twelfth of the distance."""
    rig = make_rig(baseline=0.1)
    errors = []
    for seed in range(12):
        truth = random_thread(rig, seed)
        left, right = rig.project(truth)
        field = field_of(draw(left, rig, width=1), draw(right, rig, width=1), rig)
        found = initialize(field, rig, Seed(pixel=tuple(left[750])))
        errors.append(curve_error(dense(found.curve, 600), truth))
    assert max(error.mean for error in errors) < 0.1
    assert max(abs(error.length_percent) for error in errors) < 5


def bend_in_the_line_of_sight(rig: StereoRig, aside_px: float) -> Float64:
    """(1500, 3) a thread that turns round at one place of the left view, where both arms come together."""
    t = np.linspace(-1, 1, 1500)
    along, aside, depth = 220 * (1 - t**2), aside_px * t**3, 200 + 12 * t
    u, v = 220 + 0.87 * along - 0.5 * aside, 200 + 0.5 * along + 0.87 * aside
    centre = np.asarray(rig.left.projection)[:2, 2]
    return np.c_[(np.c_[u, v] - centre) / rig.focal * depth[:, None], depth]


@pytest.mark.parametrize("aside_px", [60.0, 120.0])
@pytest.mark.parametrize("seed_at", [150, 1350])
def test_a_thread_that_turns_round_in_the_line_of_sight_is_followed_back(
    rig: StereoRig, aside_px: float, seed_at: int
) -> None:
    truth = bend_in_the_line_of_sight(rig, aside_px)
    left, right = rig.project(truth)
    field = field_of(draw(left, rig), draw(right, rig), rig)
    found = initialize(field, rig, Seed(pixel=tuple(left[seed_at])))
    error = curve_error(dense(found.curve), truth)
    assert abs(error.length_percent) < 3
    assert max(error.ends) < 1
    assert any("sharp bend" in reason for reason in found.reasons)


def test_a_thread_that_ends_on_another_one_far_from_its_end_is_not_taken_for_a_bend(
    rig: StereoRig,
) -> None:
    t = np.linspace(0, 1, 800)[:, None]
    one = np.array([-50.0, -20.0, 200.0]) + t * [100.0, 30.0, 10.0]
    other = np.array([-45.0, 25.0, 215.0]) + t * (one[400] - [-45.0, 25.0, 215.0])
    left, right = (
        draw(b, rig, draw(a, rig))
        for a, b in zip(rig.project(one), rig.project(other), strict=True)
    )
    seed = tuple(rig.project(one[150])[0])
    found = initialize(field_of(left, right, rig), rig, Seed(pixel=seed))
    assert abs(curve_error(dense(found.curve), one).length_percent) < 3


def test_a_thread_that_ends_across_another_one_near_its_end_does_not_turn_round_there() -> None:
    """What leads from there to the other one's end looks like a stub."""
    assert_is_found_whole("clutter", 4410, "endoscope")


def sharp_corner(rig: StereoRig, arm_px: float) -> Float64:
    """(1400, 3) a thread that turns back at 60 degrees to an arm of that length."""
    t, tip = np.linspace(0, 1, 700)[:, None], np.array([220.0, 190.0])
    along, back = ([np.cos(a), np.sin(a)] for a in (0.5, 0.5 - np.pi / 3))
    pixels = np.r_[tip + 300 * t[::-1] * along, tip + arm_px * t * back]
    depth = np.r_[200 + 6 * t, 206 + 6 * t]
    centre = np.asarray(rig.left.projection)[:2, 2]
    return np.c_[(pixels - centre) / rig.focal * depth, depth]


@pytest.mark.parametrize("arm_px", [40.0, 60.0])
def test_an_arm_behind_a_sharp_corner_is_the_thread_where_it_is_alone(
    rig: StereoRig, arm_px: float
) -> None:
    truth = sharp_corner(rig, arm_px)
    left, right = rig.project(truth)
    field = field_of(draw(left, rig), draw(right, rig), rig)
    found = initialize(field, rig, Seed(pixel=tuple(left[300])))
    error = curve_error(dense(found.curve), truth)
    assert abs(error.length_percent) < 2
    assert max(error.ends) < 1


def test_crests_count_less_where_a_thread_comes_back_beside_itself(rig: StereoRig) -> None:
    there, back = np.arange(100.0, 300, 2), np.arange(300.0, 200, -2)
    pixels = np.r_[np.c_[there, 0 * there + 300], np.c_[back, 0 * back + 304.5]]
    image = draw(pixels, rig)
    view = View(field_of(image, image, rig).left, *np.empty((3, 0, 2)))
    crest = find_crest(view, pixels)
    assert crest.clear[:45].min() > 0.7
    assert crest.clear[55:90].max() < 0.2
    assert crest.clear[110:145].max() < 0.2


@pytest.mark.parametrize("crosses", [True, False])
def test_crest_lines_that_touch_where_both_turn_are_cut_there(crosses: bool) -> None:
    """A crossing may look like two bends back to back; what passes a bend straight is no crossing."""

    def bend(within: float, side: float) -> Float64:
        """Turns by a right angle within so many px; it touches the other one from a side."""
        heading = np.pi / 4 * np.tanh(np.arange(-60, 61) / within)
        line = np.cumsum(np.c_[np.sin(heading), np.cos(heading)], axis=0)
        return (line - line[60]) * [side, 1] + [1.5 * side, 0]

    other = bend(4.5, -1) if crosses else np.c_[np.full(121, -1.5), np.arange(-60.0, 61.0)]
    pieces = split_at_touches((bend(1.0, 1), other))
    assert len(pieces) == (4 if crosses else 3)
    for piece in pieces[2:]:
        assert (len(piece) < len(other)) == crosses


def test_strands_that_lie_on_each_other_are_both_followed(rig: StereoRig) -> None:
    truth = loop_with_a_shared_run()
    left, right = rig.project(truth)
    field = field_of(draw(left, rig), draw(right, rig), rig)
    found = initialize(field, rig, Seed(pixel=tuple(left[300])))
    error = curve_error(dense(found.curve, 3000), truth)
    assert abs(error.length_percent) < 5
    assert max(error.ends) < 2
    assert error.rms < 1.5


@pytest.mark.parametrize(("scenario", "seed"), [("knot", 200), ("crossings", 211)])
def test_strands_of_one_thread_are_told_apart(scenario: str, seed: int) -> None:
    """A loop whose ends run into its side, and one that crosses itself closely."""
    scene = open_scene(scenario, seed)
    field, start = field_and_seed(scene)
    found = initialize(field, scene.rig, start)
    truth = scene.truth(0)[0].points
    error = curve_error(dense(found.curve), truth)
    assert abs(error.length_percent) < 2
    assert error.rms < 0.3
    assert max(error.ends) < 1
    nearest = cKDTree(truth).query(dense(found.curve)[::50])[1]
    assert abs(spearmanr(nearest, np.arange(len(nearest))).statistic) > 0.9
    assert found.confidence > 0.5


@pytest.mark.parametrize("seed", [5014, 5210, 5303, 5305, 5308, 5313])
def test_strands_of_a_knot_keep_their_sides_between_the_places_where_they_cross(seed: int) -> None:
    """They run a few pixels apart, as one wide ridge, of which the crest is that of either."""
    assert_is_found_whole("knot", seed, "endoscope")


@pytest.mark.parametrize("seed", [1009, 1011, 1027])
def test_no_part_of_a_knot_is_left_out(seed: int) -> None:
    """A short stretch of it has the colour and the depth of both of its strands, which fits neither."""
    assert_is_found_whole("knot", seed, "endoscope")


@pytest.mark.parametrize("seed", [5233, 5241, 5242])
def test_a_loop_that_ends_on_the_side_of_a_segment_is_a_part_of_the_thread(seed: int) -> None:
    """Through the stretch of a small knot that both strands share the ridge runs on as one."""
    assert_is_found_whole("knot", seed, "bench", frame=240)


@pytest.mark.parametrize("seed", [1040, 1047, 5021])
def test_a_view_that_shows_a_knot_whole_is_believed(seed: int) -> None:
    """However many of its crossings are in doubt, the other view has a thread and a rest."""
    assert_is_found_whole("knot", seed, "bench")


@pytest.mark.parametrize("seed", [301, 313, 314, 362])
def test_strands_that_share_a_stretch_may_be_exchanged(seed: int) -> None:
    """A like thread joins this one for a while; both views take its way out for this one's."""
    scene = open_scene("clutter", seed)
    field, start = field_and_seed(scene)
    found = initialize(field, scene.rig, start)
    is_right = curve_error(dense(found.curve), scene.truth(0)[0].points).rms < 0.3
    assert is_right or found.confidence < 0.5
    assert any("another strand that it touches" in reason for reason in found.reasons)


def test_where_a_shared_stretch_leads_is_told_by_long_arms() -> None:
    """Of gray images: the colours of these two threads would tell it at once."""
    scene = open_scene("two-threads", 303)
    field, start = field_and_seed(scene)
    found = initialize(replace(field, colours=None), scene.rig, start)
    assert curve_error(dense(found.curve), scene.truth(0)[0].points).rms < 0.3
    assert found.confidence > 0.5
    assert any("another strand that it touches" in reason for reason in found.reasons)


def test_an_end_that_neither_view_shows_is_not_relied_on() -> None:
    """The curve ends in the middle of a stretch that it shares with another thread."""
    scene = open_scene("clutter", 358, "endoscope")
    field, start = field_and_seed(scene)
    found = initialize(field, scene.rig, start)
    assert max(curve_error(dense(found.curve), scene.truth(0)[0].points).ends) > 10
    assert found.confidence < 0.5
    assert "first end not seen as an end" in found.reasons


def test_a_crossing_that_neither_view_can_tell_is_doubtful() -> None:
    """Another thread runs beside this one, and leaves it more smoothly than it goes on itself."""
    scene = open_scene("clutter", 250)
    field, start = field_and_seed(scene)
    found = initialize(field, scene.rig, start)
    assert found.confidence < 0.5
    assert any("another strand that it touches" in reason for reason in found.reasons)


@pytest.mark.parametrize(
    ("scenario", "seed", "rig", "why"),
    [
        ("clutter", 3126, "endoscope", "a stretch that two strands share"),
        ("two-threads", 3110, "bench", "an end beside another ridge"),
    ],
)
def test_strands_that_look_like_one_near_by_are_doubtful_in_both_views(
    scenario: str, seed: int, rig: str, why: str
) -> None:
    """They touch at a small angle, and show only some way off that they are two; or one ends there."""
    scene = open_scene(scenario, seed, rig)
    field, start = field_and_seed(scene)
    found = initialize(field, scene.rig, start)
    is_right = curve_error(dense(found.curve), scene.truth(0)[0].points).rms < 0.3
    assert is_right or found.confidence < 0.5
    assert is_right or any(
        f"{why} in the {view} view" in " ".join(found.reasons) for view in ("left", "right")
    )


def test_the_gravest_doubt_of_the_graver_view_counts_in_full() -> None:
    assert remaining(((), ())) == 1.0
    assert remaining((((0.1, 0.4),), ((0.1, 0.9),))) == pytest.approx(0.4)
    assert remaining((((0.1, 0.64), (0.5, 0.25)), ((0.1, 0.3),))) == pytest.approx(0.25 * 0.8)


def test_a_loop_as_narrow_as_the_thread_is_passed_once() -> None:
    """Its ends lie beside two more of the thread, which might be those of a second strand in it."""
    assert_is_found_whole("knot", 5017, "endoscope")


def initialized(scene: Scene, *, is_alone: bool = True) -> Initialization:
    """The first curve of a scene, with or without another strand in both of its views."""
    field, seed = field_and_seed(scene)
    left, right = field.left.copy(), field.right.copy()
    for view in () if is_alone else (left, right):
        view[20:460, 30] = 0.0, 0.9
    return initialize(RidgeField(field.stamp, left, right), scene.rig, seed)


def is_found_right(found: Initialization, scene: Scene) -> bool:
    """Whether its points are 0.3 mm off at most (RMS)."""
    return bool(curve_error(dense(found.curve), scene.truth(0)[0].points).rms < 0.3)


@pytest.mark.parametrize("rig", ["bench", "endoscope"])
def test_how_a_thread_passes_itself_is_less_doubtful_where_it_is_alone(rig: str) -> None:
    """A way that leaves a part of it to nobody is a bad one; with others about, it may be theirs."""
    scene = open_scene("crossings", 5206, rig)
    alone, beside = (initialized(scene, is_alone=is_alone) for is_alone in (True, False))
    assert is_found_right(alone, scene)
    np.testing.assert_allclose(beside.curve.control_points, alone.curve.control_points)
    assert beside.confidence < 0.5 < alone.confidence


@pytest.mark.parametrize("seed", [1111, 1818, 5235, 5241])
@pytest.mark.parametrize("is_alone", [True, False])
def test_a_way_that_would_leave_a_closed_loop_makes_nothing_doubtful(
    is_alone: bool, seed: int
) -> None:
    """Where a knot passes itself, both times in the same direction, it can go on one way only."""
    scene = open_scene("knot", seed, "endoscope")
    found = initialized(scene, is_alone=is_alone)
    assert is_found_right(found, scene)
    assert found.confidence > 0.9


def look_at(strands: list[Float64], seed: Float64, rig: StereoRig) -> Initialization:
    """The thread through a seed (2,), among strands at one depth."""
    left, right = None, None
    for strand in strands:
        left, right = draw(strand, rig, left), draw(strand - [110, 0], rig, right)
    assert left is not None
    assert right is not None
    u, v = seed
    return initialize(field_of(left, right, rig), rig, Seed(pixel=(float(u), float(v))))


@pytest.mark.parametrize(
    ("away_px", "other", "is_shared"),
    [(0, True, True), (4, True, True), (40, True, False), (0, False, False)],
)
def test_a_seed_where_two_threads_cross_may_mean_either(
    rig: StereoRig, away_px: int, other: bool, is_shared: bool
) -> None:
    t = np.linspace(0, 1, 500)
    one = np.c_[310 + 60 * t, 60 + 360 * t]
    across = np.c_[180 + 320 * t, 300 - 120 * t]
    strands = [one, across] if other else [one]
    crossing = int(np.argmin(np.linalg.norm(one[:, None] - across, axis=2).min(axis=1)))
    found = look_at(strands, one[crossing - round(away_px * 500 / 365)], rig)
    assert found.is_seed_shared == is_shared
    assert any("the seed lies on another strand" in why for why in found.reasons) == is_shared
    assert (found.confidence < 0.5) == is_shared


def test_a_seed_where_a_thread_crosses_itself_means_it(rig: StereoRig) -> None:
    left, right = rig.project(figure_eight())
    field = field_of(draw(left, rig), draw(right, rig), rig)
    found = initialize(field, rig, Seed(pixel=tuple(left[1500])))
    assert not found.is_seed_shared


@pytest.mark.parametrize(("grey", "is_shared"), [(60, True), (150, False)])
def test_a_seed_between_two_veins_that_end_on_the_thread_means_the_thread(
    rig: StereoRig, grey: int, is_shared: bool
) -> None:
    """Where they are as clear as the thread they may be one strand, which shares a stretch with it."""
    t = np.linspace(0, 1, 500)
    thread = np.c_[180 + 320 * t, 240 + 30 * np.sin(4 * t)]
    first, last = thread[190], thread[310]
    come, go = first + np.c_[-110 * t, 45 * t**1.5], last + np.c_[110 * t, 45 * t**1.5]
    views = []
    for shift in ([0, 0], [110, 0]):
        view = None
        for vein in (come, go):
            view = draw(vein - shift, rig, view, grey=grey)
        views.append(draw(thread - shift, rig, view, grey=60))
    found = initialize(field_of(views[0], views[1], rig), rig, Seed(pixel=tuple(thread[250])))
    assert found.is_seed_shared == is_shared


@pytest.mark.parametrize("is_joined", [True, False])
@pytest.mark.parametrize(("aside_px", "length_px"), [(80, 150), (12, 110)])
def test_a_thread_that_may_have_run_into_another_one_is_doubtful(
    rig: StereoRig, aside_px: float, length_px: float, is_joined: bool
) -> None:
    """Two come, and one goes on: the one that does so more smoothly need not be the one."""
    t = np.linspace(0, 1, 500)
    straight = np.c_[np.full(500, 330.0), 255 - 190 * t]
    aside = np.c_[330 + aside_px * t**1.5, 250 - length_px * t]
    on = np.c_[np.full(500, 330.0), 250 + 170 * t]
    strands = [np.r_[aside[::-1], on], straight] if is_joined else [np.r_[straight[::-1], on]]
    found = look_at(strands, straight[370], rig)
    assert (found.confidence < 0.5) == is_joined
    assert any("another strand that ends on it" in why for why in found.reasons) == is_joined


@pytest.mark.parametrize(
    ("seed", "rig"),
    [(1708, "bench"), (1761, "bench"), (1748, "bench"), (1746, "endoscope")],
)
def test_a_thread_whose_end_lies_on_a_fainter_one_ends_there(seed: int, rig: str) -> None:
    """Where the two come together the other one seems to end, and behind the end it goes on."""
    assert_is_found_whole("two-threads", seed, rig)


def test_a_thread_that_goes_on_in_the_shade_is_found_whole() -> None:
    """It is far fainter there, as a vein is; but it has its colour, and is darker."""
    assert_is_found_whole("clutter", 4415, "endoscope")


@pytest.mark.parametrize("is_first", [False, True])
def test_what_lies_in_the_shade_is_kept_at_either_end(is_first: bool) -> None:
    """Behind the shade the thread is as bright as nowhere else, and as faint."""
    u = np.arange(700)
    strength, grey = np.where(u <= 400, 0.9, 0.3), np.select([u <= 400, u <= 520], [60, 40], 120)
    clear, faint = (
        np.c_[np.arange(a, b), np.full(b - a, 30.0)] for a, b in ((50, 400), (401, 650))
    )
    if is_first:
        strength, grey = strength[::-1], grey[::-1]
        clear, faint = (np.c_[699 - s[::-1, 0], s[::-1, 1]] for s in (clear, faint))
    field = np.zeros((60, 700, 2), np.float32)
    field[28:33, :, 0] = strength
    pixels = np.c_[u, np.full(700, 30)].astype(np.uint16)
    tints = Tints.of(Colours(pixels, np.repeat(grey[:, None], 3, axis=1).astype(np.uint8)))
    ridges = Ridges(field, np.linalg.norm(field, axis=2), (clear, faint), 0.1, tints)
    joints = Joints([clear, faint], {})
    joints.join(*((0, 3) if is_first else (1, 2)), 0.1)
    entries = _without_faint_ends(joints, ridges, joints.follow(0), 0)
    assert [entry // 2 for entry in entries] == ([1, 0] if is_first else [0, 1])


@pytest.mark.parametrize(("scenario", "seed"), [("fast", 6002), ("leaves-view", 6011)])
def test_a_thread_over_ground_of_several_colours_is_found_whole(scenario: str, seed: int) -> None:
    """Over darker ground it is fainter, and a thin one takes a part of its colour from the ground."""
    assert_is_found_whole(scenario, seed, "bench")


def painted(strands: list[tuple[Float64, tuple[int, int, int]]], rig: StereoRig) -> RidgeField:
    """The field of strands (k, 2) of some colours, the last one on top, at one depth, on gray ground."""
    views = []
    for shift in (0, 110):
        channels = [np.full((480, 640), 190, np.uint8) for _ in range(3)]
        for strand, colour in strands:
            channels = [
                draw(strand - [shift, 0], rig, channel, grey=grey)
                for channel, grey in zip(channels, colour, strict=True)
            ]
        views.append(np.stack(channels, axis=2))
    return field_of(views[0], views[1], rig)


BLUE, BROWN = (130, 60, 60), (60, 60, 130)


def test_a_thread_that_ends_on_one_of_another_colour_ends_there(rig: StereoRig) -> None:
    """Without their colours, what goes on in its direction would be a part of it."""
    t = np.linspace(0, 1, 400)
    own = np.c_[180 + 180 * t, 240 + 20 * np.sin(3 * t)]
    way = own[-1] - own[-2]
    on = own[-1] + 170 * t[:, None] * way / np.linalg.norm(way) + np.c_[0 * t, -30 * t**2]
    field = painted([(on, BROWN), (own, BLUE)], rig)
    seed = Seed(pixel=tuple(own[100]))
    found = initialize(field, rig, seed)
    ends = rig.project(nurbs.evaluate(found.curve, np.array([0.0, 1.0])))[0]
    assert np.linalg.norm(ends - own[-1], axis=1).min() < 2
    assert found.confidence < 0.5
    assert any("another colour" in reason for reason in found.reasons)
    gray = initialize(replace(field, colours=None), rig, seed)
    ends = rig.project(nurbs.evaluate(gray.curve, np.array([0.0, 1.0])))[0]
    assert np.linalg.norm(ends - on[-1], axis=1).min() < 2


def test_a_strand_of_another_colour_that_ends_on_a_thread_does_not_go_on_in_it(
    rig: StereoRig,
) -> None:
    """Without their colours, either of the two that come may be the one that goes on."""
    t = np.linspace(0, 1, 500)
    straight = np.c_[np.full(500, 330.0), 60 + 360 * t]
    aside = np.c_[335 + 80 * t**1.5, 250 - 150 * t]
    field = painted([(aside, BROWN), (straight, BLUE)], rig)
    seed = Seed(pixel=(330.0, 120.0))
    for colours, is_doubtful in ((field.colours, False), (None, True)):
        found = initialize(replace(field, colours=colours), rig, seed)
        assert (found.confidence < 0.5) == is_doubtful
        assert any("another strand that ends on it" in r for r in found.reasons) == is_doubtful


def bow() -> tuple[Float64, Float64, Float64, Float64]:
    """Parameters (k,) and pixels (k, 2) of a thread, and its direction and normal at its last end."""
    t: Float64 = np.linspace(0, 1, 500)
    own = np.c_[180 + 260 * t, 240 + 60 * np.sin(3 * t)]
    way = (own[-1] - own[-2]) / np.linalg.norm(own[-1] - own[-2])
    return t, own, way, np.array([-way[1], way[0]])


@pytest.mark.parametrize(
    ("ahead", "length", "grey", "is_doubtful"),
    [(3.5, 120, 110, True), (4.5, 120, 110, False), (3.5, 120, 165, False), (3.5, 12, 110, False)],
)
def test_an_end_is_doubted_beside_what_may_be_thread_only(
    rig: StereoRig, ahead: float, length: float, grey: int, is_doubtful: bool
) -> None:
    """Ridges behind ground, far fainter ones, and such as lead nowhere are not what it goes on as."""
    t, own, way, normal = bow()
    other = own[-1] + ahead * way + length * (t[:, None] - 0.5) * normal
    field = painted([(other, (grey, grey, grey)), (own, BLUE)], rig)
    found = initialize(field, rig, Seed(pixel=tuple(own[150])))
    assert any("an end beside another ridge" in why for why in found.reasons) == is_doubtful
    assert (found.confidence < 0.5) == is_doubtful


@pytest.mark.parametrize(
    ("turn", "aside", "ahead", "length", "grey"),
    [
        (0, 2, 6, 6, 120),
        (30, 4, 4, 9, 145),
        (70, 6, 6, 6, 120),
        (20, 4, 3, 8, 160),
        (40, 5, 3, 6, 135),
    ],
)
def test_specks_behind_an_end_make_nothing_doubtful(
    rig: StereoRig, turn: float, aside: float, ahead: float, length: float, grey: int
) -> None:
    """As the rims of highlights are."""
    t, own, way, normal = bow()
    heading = np.cos(np.radians(turn)) * way + np.sin(np.radians(turn)) * normal
    speck = own[-1] + ahead * way + aside * normal + length * t[:, None] * heading
    field = painted([(speck, (grey, grey, grey)), (own, BLUE)], rig)
    found = initialize(field, rig, Seed(pixel=tuple(own[150])))
    assert found.confidence > 0.9
    assert not found.reasons
    ends = rig.project(nurbs.evaluate(found.curve, np.array([0.0, 1.0])))[0]
    assert np.linalg.norm(ends - own[-1], axis=1).min() < 2


def test_where_threads_touch_each_goes_on_in_its_own_colour(rig: StereoRig) -> None:
    """By their shapes alone, both would cross."""
    t = np.linspace(-1, 1, 600)
    upper = np.c_[320 + 150 * t, 240 - 60 * np.abs(t) ** 1.3]
    lower = np.c_[320 + 150 * t, 240 + 60 * np.abs(t) ** 1.3]
    field = painted([(lower, BROWN), (upper, BLUE)], rig)
    seed = Seed(pixel=tuple(upper[100]))
    found = rig.project(dense(initialize(field, rig, seed).curve))[0]
    assert polyline_distances(found, upper).max() < 2
    gray = rig.project(dense(initialize(replace(field, colours=None), rig, seed).curve))[0]
    assert polyline_distances(gray, upper).max() > 20


def test_shade_is_told_from_another_colour() -> None:
    """Tints are two differences of colours, which light leaves alone, and the brightness."""
    lit, shade = np.tile([0.1, -0.2, 4.0], (40, 1)), np.tile([0.1, -0.2, 3.4], (100, 1))
    assert darkening(lit, shade) == pytest.approx(0.6)
    assert darkening(shade, lit) == pytest.approx(-0.6)
    assert np.isnan(darkening(lit, shade + np.array([0.3, 0, 0])))
    assert np.isnan(darkening(lit, shade[:5]))
    assert np.isnan(darkening(lit, shade * np.nan))


@pytest.mark.parametrize(
    ("step", "is_another"), [((0.1, 0.24, -0.33), False), ((0.5, -0.2, 0.3), True)]
)
def test_what_differs_as_parts_of_one_thread_do_is_no_other(
    step: tuple[float, float, float], is_another: bool
) -> None:
    """However steady its colour is before and behind."""
    tints = np.tile([0.1, -0.2, 4.0], (400, 1)) + np.random.default_rng(0).normal(0, 0.02, (400, 3))
    tints[250:] += step
    start = another_begins(tints, 100)
    assert start == (pytest.approx(250, abs=3) if is_another else 400)


def test_colours_are_known_of_views_that_are_reduced_or_raised() -> None:
    pixels = np.array([[4, 0], [6, 2], [7, 2], [6, 3], [8, 6]], np.uint16)
    colours = Colours(pixels, np.arange(15, dtype=np.uint8).reshape(5, 3))
    reduced, raised = colours.reduced(2), colours.raised(2)
    assert reduced.pixels.tolist() == [[2, 0], [3, 1], [4, 3]]
    assert reduced.bgr[:, 0].tolist() == [0, 3, 12]
    assert raised.pixels.tolist() == [[6, 0], [7, 0], [6, 1], [8, 4]]
    assert raised.bgr[:, 0].tolist() == [3, 6, 9, 12]
    assert raised.pixels.dtype == reduced.pixels.dtype == np.uint16


def test_an_end_that_one_view_shows_further_on_is_doubted() -> None:
    """The left view has the thread turn off at a crossing, just before its end."""
    scene = open_scene("two-threads", 1704)
    field, start = field_and_seed(scene)
    found = initialize(field, scene.rig, start)
    assert max(curve_error(dense(found.curve), scene.truth(0)[0].points).ends) > 3
    assert found.confidence < 0.5
    assert "the right view shows the last end further on" in found.reasons


def test_a_part_that_is_shorter_than_the_gap_before_it_may_be_something_else() -> None:
    """A highlight on the table lies where a white thread would go on."""
    scene = open_scene("two-threads", 598)
    field, seed = field_and_seed(scene, "1")
    found = initialize(field, scene.rig, seed)
    assert any("a part beyond a gap" in why for why in found.reasons)
    assert found.confidence < 0.5


def test_a_part_that_is_longer_than_the_gap_before_it_is_the_thread(rig: StereoRig) -> None:
    t = np.linspace(0, 1, 500)[:, None]
    thread, beyond = [330.0, 100.0] + t * [0.0, 200.0], [330.0, 315.0] + t * [0.0, 60.0]
    found = look_at([thread, beyond], thread[200], rig)
    assert rig.project(dense(found.curve))[0][:, 1].max() > 370
    assert found.confidence > 0.9


@pytest.mark.parametrize(("grey", "is_thread"), [(120, True), (175, False)])
def test_a_thread_may_have_run_into_one_of_another_colour_but_into_no_shadow(
    rig: StereoRig, grey: int, is_thread: bool
) -> None:
    t = np.linspace(0, 1, 500)
    straight = np.c_[np.full(500, 330.0), 60 + 360 * t]
    aside = np.c_[335 + 80 * t**1.5, 250 - 150 * t]
    views = [
        draw(aside - shift, rig, draw(straight - shift, rig), grey=grey)
        for shift in (np.zeros(2), np.array([110.0, 0.0]))
    ]
    found = initialize(field_of(views[0], views[1], rig), rig, Seed(pixel=(330.0, 120.0)))
    assert (found.confidence < 0.5) == is_thread
    assert any("another strand that ends on it" in why for why in found.reasons) == is_thread


@pytest.mark.parametrize("is_bent", [True, False])
def test_a_thread_that_may_end_where_another_one_begins_is_doubtful(
    rig: StereoRig, is_bent: bool
) -> None:
    """A gap in a bend is bridged without doubt, but not one between strands that do not bend."""
    t = np.linspace(0, 1, 500)
    come = np.c_[np.full(500, 330.0), 250 - 180 * t]
    turn = 1.7 * t[12:]
    if is_bent:
        go = [330.0, 255.0] + 170 * np.c_[np.sin(np.pi / 3) * t, np.cos(np.pi / 3) * t]
    else:
        go = [330.0, 250.0] + 140 * np.c_[1 - np.cos(turn), np.sin(turn)]
    found = look_at([come, go], come[370], rig)
    ends = rig.project(dense(found.curve))[0][[0, -1]]
    assert np.linalg.norm(ends - go[-1], axis=1).min() < 5
    assert (found.confidence < 0.5) == is_bent
    assert any("a bend as of two strands" in why for why in found.reasons) == is_bent


@pytest.mark.parametrize(("gap", "is_doubtful"), [(5.0, False), (1.0, True)])
def test_an_end_that_is_seen_to_stop_short_of_the_thread_is_not_doubtful(
    rig: StereoRig, gap: float, is_doubtful: bool
) -> None:
    """It comes back to its own side."""
    angle = np.linspace(0, np.pi, 400)
    turn = np.c_[np.sin(angle), np.cos(angle)]
    end = [340.0, 300 - gap]
    left = np.r_[
        np.linspace([150.0, 300], [420, 300], 800),
        [420, 260] + 40 * turn,
        [380, 260] - 40 * turn[:200],
        np.linspace([340.0, 260], end, 200),
    ]
    views = [draw(left, rig), draw(left - [110, 0], rig)]
    found = initialize(field_of(*views, rig), rig, Seed(pixel=(200.0, 300.0)))
    reached = rig.project(dense(found.curve))[0][[0, -1]]
    assert np.linalg.norm(reached - end, axis=1).min() < 5
    assert any("beside another ridge" in why for why in found.reasons) == is_doubtful
    assert (found.confidence < 0.7) == is_doubtful


@pytest.mark.parametrize(("apart", "is_doubtful"), [(4.7, False), (3.0, True)])
def test_an_end_beside_its_own_thread_is_seen_where_the_two_are_apart(
    rig: StereoRig, apart: float, is_doubtful: bool
) -> None:
    """It comes back along its own side."""
    angle = np.linspace(0, np.pi, 400)
    turn = np.c_[np.sin(angle), np.cos(angle)]
    left = np.r_[
        np.linspace([150.0, 300], [420, 300], 800),
        [420, 260] + 40 * turn,
        np.linspace([420.0, 220], [320, 220], 300),
        [320, 259 - apart / 2] - [1, 39 - apart / 2] * turn[:200] * [40, 1],
    ]
    left = np.r_[left, np.linspace([280.0, 300 - apart], [310, 300 - apart], 90)]
    views = [draw(left, rig), draw(left - [110, 0], rig)]
    found = initialize(field_of(*views, rig), rig, Seed(pixel=(200.0, 300.0)))
    assert any("beside another ridge" in why for why in found.reasons) == is_doubtful


def test_a_highlight_is_bridged(rig: StereoRig, curve: Nurbs) -> None:
    truth = dense(curve)
    views = []
    for pixels in rig.project(truth):
        dark = draw(pixels[:600], rig)
        views.append(draw(pixels[640:], rig, dark))
    found = initialize(field_of(*views, rig), rig, Seed(pixel=tuple(rig.project(truth[900])[0])))
    assert len(found.growth.left.merges) == 1
    assert abs(curve_error(dense(found.curve), truth).length_percent) < 2


@pytest.mark.parametrize(
    ("aside", "turned", "nearer", "is_one"),
    [
        (0.0, 0.0, 0.0, True),
        (25.0, 0.0, 0.0, False),
        (0.0, 1.2, 0.0, False),
        (0.0, 0.0, 25.0, False),
    ],
)
def test_a_stretch_behind_a_tool_is_bridged_where_both_sides_are_one_strand(
    rig: StereoRig, aside: float, turned: float, nearer: float, is_one: bool
) -> None:
    """Not where they do not point at each other, or lie at different depths."""
    t, angle = np.linspace(0, 180, 500), 0.8 + turned
    come = [160 + 180 * 0.7, 120 + 180 * 0.7] - 0.7 * t[::-1, None]
    gone = [t * np.cos(angle) + t**2 / 900, t * np.sin(angle)]
    go = come[-1] + [25 - aside, 25 + aside] + np.stack(gone, axis=1)
    left = draw(go, rig, draw(come, rig))
    right = draw(go - [40 + nearer, 0], rig, draw(come - [40, 0], rig))
    found = initialize(field_of(left, right, rig), rig, Seed(pixel=tuple(come[250])))
    ends = rig.project(dense(found.curve))[0][[0, -1]]
    reached = go[-1] if is_one else come[-1]
    assert np.linalg.norm(ends - reached, axis=1).min() < 3
    assert any("a hidden stretch" in why for why in found.reasons) == is_one
    assert 0.5 < found.confidence < 0.95 if is_one else True


def shining(pixels: Float64, rig: StereoRig, stretch: slice, width: int) -> Image:
    """A thread that is wider along a stretch, and there all highlight but for its rims."""
    image = draw(pixels[stretch], rig, draw(pixels, rig), width=width)
    core = slice(stretch.start + 5, stretch.stop - 5)
    share = (190.0 - draw(pixels[core], rig, width=3)) / 120
    return np.rint(image + share * (175.0 - image)).astype(np.uint8)


@pytest.mark.parametrize(
    ("stretch", "width", "is_found"), [(slice(400, 500), 6, True), (slice(500, 620), 7, False)]
)
def test_a_highlight_between_rims_is_no_crossing(
    rig: StereoRig, curve: Nurbs, stretch: slice, width: int, is_found: bool
) -> None:
    """It is relied on where the whole thread is found, and not where it ends at the highlight."""
    truth = dense(curve)
    left, right = (shining(p, rig, stretch, width) for p in rig.project(truth))
    found = initialize(
        field_of(left, right, rig), rig, Seed(pixel=tuple(rig.project(truth[900])[0]))
    )
    assert (abs(curve_error(dense(found.curve), truth).length_percent) < 2) == is_found
    assert (found.confidence > 0.7) == is_found


@pytest.mark.parametrize("ground", [0, 255])
def test_of_a_thread_that_was_cut_out_only_the_outline_counts(
    rig: StereoRig, curve: Nurbs, ground: int
) -> None:
    """It grows wide, and its middle and other stretches have the colour of the ground, nearly."""
    truth, stretch = dense(curve), slice(500, 620)
    near, far = abs(ground - 6), abs(ground - 180)
    views = []
    for pixels in rig.project(truth):
        outline = draw(pixels[stretch], rig, draw(pixels, rig), width=7) < 130
        core = draw(pixels[510:610], rig) < 130
        core |= draw(pixels[1000:1030], rig, width=7) < 130
        shade = np.where(core, near, far)
        views.append(np.where(outline, shade, ground).astype(np.uint8))
    frame, seed = StereoFrame(STAMP, *views), Seed(pixel=tuple(rig.project(truth[900])[0]))
    segmenter = Segmenter(rig)
    segmenter.learn(frame, seed)
    found = initialize(segmenter.step(frame), rig, seed)
    assert abs(curve_error(dense(found.curve), truth).length_percent) < 3
    assert found.confidence > 0.7


def test_straight_stretches_take_few_control_points(rig: StereoRig) -> None:
    line = np.linspace([-30.0, -25, 190], [40.0, 30, 205], 1500)
    left, right = rig.project(line)
    field = field_of(draw(left, rig), draw(right, rig), rig)
    found = initialize(field, rig, Seed(pixel=tuple(left[700])))
    assert len(found.curve.control_points) <= 8
    assert curve_error(dense(found.curve), line).rms < 0.1


def test_ends_cut_by_the_border_are_reported(rig: StereoRig) -> None:
    line = np.linspace([-20.0, -25, 190], [100.0, 30, 205], 1500)
    left, right = rig.project(line)
    inside = left[np.all((left > 0) & (left < [639, 479]), axis=1)]
    field = field_of(draw(left, rig), draw(right, rig), rig)
    found = initialize(field, rig, Seed(pixel=tuple(inside[len(inside) // 2])))
    assert any("cut by the image border" in reason for reason in found.reasons)


def test_a_thread_along_the_epipolar_lines_is_not_relied_on(rig: StereoRig) -> None:
    line = np.linspace([-40.0, -5, 195], [30.0, -3, 205], 1500)
    left, right = rig.project(line)
    field = field_of(draw(left, rig), draw(right, rig), rig)
    found = initialize(field, rig, Seed(pixel=tuple(left[700])))
    assert found.confidence < 0.5
    assert any("uncertain depth" in reason for reason in found.reasons)


def test_the_depth_of_a_thread_between_two_ends_that_are_seen_is_not_relied_on() -> None:
    """It runs along the epipolar lines: both ends are right, and places between them 2 mm off."""
    scene = open_scene("pull-through", 1800)
    field, seed = field_and_seed(scene)
    found = initialize(field, scene.rig, seed)
    assert found.confidence < 0.5
    assert any("uncertain depth" in reason for reason in found.reasons)


@pytest.mark.parametrize(("scenario", "seed"), [("fast", 1827), ("pull-through", 1824)])
def test_the_two_views_of_an_end_tell_its_depth(scenario: str, seed: int) -> None:
    """Along an epipolar line, where the crests do not, before cameras as close together as an endoscope's."""
    scene = open_scene(scenario, seed, "endoscope")
    field, start = field_and_seed(scene)
    found = initialize(field, scene.rig, start)
    truth = scene.truth(0)[0].points
    ends = curve_error(dense(found.curve), truth).ends
    assert max(ends) * 1000 * scene.rig.metres_per_unit < 0.8


def test_an_end_along_an_epipolar_line_keeps_its_depth_on_few_knots() -> None:
    """As the first end of thread 1 in this scene."""
    scene = open_scene("two-threads", 940)
    frame, segmenter = StereoFrame(STAMP, *scene.render(0)), Segmenter(scene.rig)
    seeds = [Seed(name, pixel=scene.seed_pixel(0, name)) for name in scene.threads]
    for seed in seeds:
        segmenter.learn(frame, seed)
    found = initialize(segmenter.step(frame).of("1"), scene.rig, seeds[1])
    truth = scene.truth(0)[1].points
    assert curve_error(dense(found.curve), truth).rms * 1000 * scene.rig.metres_per_unit < 0.2


def test_a_straight_thread_that_crosses_the_epipolar_lines_is_relied_on() -> None:
    """At 12 degrees, before cameras as close together as an endoscope's."""
    scene = open_scene("pull-through", 229, "endoscope")
    field, seed = field_and_seed(scene)
    found = initialize(field, scene.rig, seed)
    truth = scene.truth(0)[0].points
    assert curve_error(dense(found.curve), truth).rms * 1000 * scene.rig.metres_per_unit < 0.3
    assert found.confidence > 0.5


@pytest.mark.parametrize("share", [0.55, 0.85])
def test_views_that_disagree_lower_the_confidence(
    rig: StereoRig, curve: Nurbs, share: float
) -> None:
    left, right = rig.project(dense(curve))
    whole = draw(left, rig), draw(right, rig)
    sure = initialize(field_of(*whole, rig), rig, Seed(pixel=tuple(left[700])))
    part = draw(right[: round(share * len(right))], rig)
    unsure = initialize(field_of(whole[0], part, rig), rig, Seed(pixel=tuple(left[700])))
    assert unsure.confidence < 0.5 < sure.confidence
    assert any("agree" in reason for reason in unsure.reasons)


def test_a_view_of_noise_that_shows_no_ridge_at_all_lowers_the_confidence(
    rig: StereoRig, curve: Nurbs
) -> None:
    field = field_of_curve(curve, rig)
    seed = Seed(pixel=tuple(rig.project(dense(curve))[0][700]))
    clear = initialize(field, rig, seed)
    rng = np.random.default_rng(0)
    right = np.where(field.right, field.right, rng.normal(0, 0.1, field.right.shape))
    noisy = RidgeField(STAMP, field.left, right.astype(np.float32))
    assert not find_ridges(noisy.right, InitializationConfig()).segments
    found = initialize(noisy, rig, seed)
    assert curve_error(dense(found.curve), dense(curve)).mean < 1.0
    assert found.confidence < clear.confidence


@pytest.mark.parametrize(("scenario", "seed"), [("pull-through", 1104), ("pull-through", 1111)])
def test_a_thread_ends_where_it_goes_into_a_hole(scenario: str, seed: int) -> None:
    """The hole responds as a thread does, but is wider."""
    scene = open_scene(scenario, seed)
    field, _ = field_and_seed(scene)
    points = scene.truth(0)[0].points
    for view, pixels in zip((field.left, field.right), scene.rig.project(points), strict=True):
        fine = np.linspace(0, len(pixels) - 1, round(polyline_length(pixels)))
        chain = np.c_[[np.interp(fine, np.arange(len(pixels)), c) for c in pixels.T]].T
        assert abs(read_end(view, chain).offset_px) < 1.2


@pytest.mark.parametrize("baseline", [0.04, 4000.0])
def test_the_unit_does_not_matter(rig: StereoRig, curve: Nurbs, baseline: float) -> None:
    other, scale = make_rig(baseline=baseline), baseline / rig.baseline
    seed = Seed(pixel=tuple(rig.project(dense(curve))[0][700]))
    field = field_of_curve(curve, rig)
    here, there = initialize(field, rig, seed), initialize(field, other, seed)
    np.testing.assert_allclose(
        there.curve.control_points / scale, here.curve.control_points, rtol=1e-6, atol=1e-6
    )
    assert there.confidence == pytest.approx(here.confidence)


@pytest.mark.parametrize("rows", [-4.0, -2.0, -0.85, -0.6, 0.12, 0.4, 1.0])
def test_rows_off_the_calibration_are_measured_and_do_not_spoil_the_curve(rows: float) -> None:
    scene = open_scene("figure8-175", 3, picture=Picture("black", "plain"))
    left, right = scene.render(0)
    shift = np.array([[1.0, 0.0, 0.0], [0.0, 1.0, rows]])
    size = scene.rig.image_size
    moved = cv2.warpAffine(right, shift, size, flags=cv2.INTER_CUBIC, borderMode=cv2.BORDER_WRAP)
    seed = Seed(pixel=scene.seed_pixel(0))
    segmenter = Segmenter(scene.rig)
    found = {}
    for name, view in (("right", right), ("moved", moved)):
        frame = StereoFrame(Stamp(0, 0, 0), left, view)
        segmenter.learn(frame, seed)
        found[name] = initialize(segmenter.step(frame), scene.rig, seed)
    level, off = found["right"], found["moved"]
    assert level.row_offset_px == 0
    assert off.row_offset_px == pytest.approx(rows, abs=0.1)
    way = "lower" if rows > 0 else "higher"
    assert off.reasons[0].startswith(f"the right view lies {abs(off.row_offset_px):.1f} px {way}")
    assert nurbs.length(off.curve) == pytest.approx(nurbs.length(level.curve), rel=0.03)
    # Each view is taken to be off by half of it.
    truth, rig = scene.truth(0)[0].points, scene.rig
    shown = rig.with_row_offset(off.row_offset_px).project(dense(off.curve))
    places = zip(shown, rig.project(truth), (0.0, rows), strict=True)
    for curve, thread, lower in places:
        assert polyline_distances(curve, thread + np.array([0.0, lower])).max() < 1


@pytest.mark.parametrize(("rig", "number"), [("bench", 209), ("endoscope", 953)])
def test_rows_that_a_thread_cannot_show_are_those_of_the_calibration(rig: str, number: int) -> None:
    scene = open_scene("pull-through", number, rig)
    field, seed = field_and_seed(scene)
    assert initialize(field, scene.rig, seed).row_offset_px == 0


def test_a_thread_along_the_seam_of_another_is_not_drawn_off_it() -> None:
    scene = open_scene("clutter", 206)
    field, seed = field_and_seed(scene)
    found = initialize(field, scene.rig, seed)
    error = curve_error(dense(found.curve), scene.truth(0)[0].points)
    assert 1000 * scene.rig.metres_per_unit * error.rms < 0.3


def test_an_end_that_the_views_cut_on_different_rows_does_not_fold(rig: StereoRig) -> None:
    t = np.linspace(0, 1, 1500)[:, None]
    truth = np.c_[40 * t - 20 + 8 * np.sin(9 * t), 40 * t - 20, 200 + 10 * t]
    left, right = rig.project(truth)
    cut = right[right[:, 1] > right[0, 1] + 5]
    seed = Seed(pixel=tuple(left[700]))
    found = initialize(field_of(draw(left, rig), draw(cut, rig), rig), rig, seed)
    assert curve_error(dense(found.curve), truth).largest < 2


def tangle(rng: np.random.Generator) -> Float64:
    """(500, 3) points of a thread at random that crosses itself many times."""
    count = int(rng.integers(10, 22))
    places = rng.uniform(-1, 1, (count, 3)) * (36.0, 27.0, 4.8) + (-10.0, 0.0, 200.0)
    knots = nurbs.clamped_knots(np.linspace(0, 1, count - 2)[1:-1], 3)
    return nurbs.evaluate(nurbs.curve_from(3, knots, places), np.linspace(0, 1, 500))


def test_strands_are_asked_of_no_copies_but_their_own(monkeypatch: pytest.MonkeyPatch) -> None:
    """A run that was doubled has a neighbour twice: the arms of another segment, or of none, used to stand
    for its copy."""
    rng, rig, asked = np.random.default_rng(61), make_rig(), []
    threads = [tangle(rng) for _ in range(rng.integers(1, 4))]
    field = paint(rig, threads, 0)
    left, right = rig.project(threads[0])
    ridges = find_ridges(field.left, InitializationConfig())
    change = Arms.change

    def spy(arms: Arms, *ways: list[tuple[int, int]]) -> float | None:
        asked.extend(end for way in ways for pair in way for end in pair)
        return change(arms, *ways)

    monkeypatch.setattr(Arms, "change", spy)
    depth = Depth.around((left - right)[:, 0], field.left, field.right)
    merged = merge_ends(ridges, InitializationConfig(), depth)
    assert len(merged.segments) > len(ridges.segments)
    assert 0 < max(asked) < 2 * len(ridges.segments)
