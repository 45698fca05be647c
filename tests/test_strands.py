"""Which ridges that meet are one strand: by depth, by how they bend, and by their strength."""

from __future__ import annotations

import numpy as np
import pytest

from suturetrack.camera import StereoRig
from suturetrack.initialization import InitializationConfig, initialize
from suturetrack.initialization.arms import Arms
from suturetrack.initialization.depth import Depth
from suturetrack.initialization.pricing import Merges
from suturetrack.initialization.segments import find_ridges
from suturetrack.initialization.smoothness import ROUGHEST, bend, roughness
from suturetrack.metrics import curve_error
from suturetrack.types import Float32, Float64, Nurbs, Seed
from tests.test_initialization import dense, draw, field_of

DISPARITY = 160.0


def two_views(
    arms: list[Float64], disparities: list[float], rig: StereoRig
) -> tuple[Float32, Float32]:
    left, right = None, None
    for arm, disparity in zip(arms, disparities, strict=True):
        left = draw(arm, rig, left)
        right = draw(arm - [disparity, 0.0], rig, right)
    assert left is not None
    assert right is not None
    field = field_of(left, right, rig)
    return field.left, field.right


def crossing() -> list[Float64]:
    """One arm from above, and two below it that go on as well in the image."""
    run = np.arange(0.0, 61.0)
    above = np.c_[np.full(61, 400.0), 200 - run]
    ways = [np.c_[400 + side * (2 + 0.15 * run), 212 + run] for side in (-1, 1)]
    return [above, *ways]


def test_an_arm_is_found_in_the_other_view(rig: StereoRig) -> None:
    arms = crossing()
    left, right = two_views(arms, [DISPARITY, DISPARITY + 4.3, DISPARITY - 2.6], rig)
    depth = Depth.around(np.full(10, DISPARITY), left, right)
    for arm, disparity in zip(arms, (0.0, 4.3, -2.6), strict=True):
        found = depth.along(arm)
        assert found is not None
        assert np.abs(found.value - DISPARITY - disparity).max() < 0.3
    assert depth.along(np.c_[300 + np.arange(61.0), np.full(61, 100.0)]) is None


@pytest.mark.parametrize(("steps", "dearer"), [((0.0, 4.0), 1), ((-4.0, 0.0), 0)])
def test_a_step_in_depth_makes_a_merge_dearer(
    rig: StereoRig, steps: tuple[float, float], dearer: int
) -> None:
    arms = crossing()
    left, right = two_views(arms, [DISPARITY, *(DISPARITY + s for s in steps)], rig)
    merges = Merges(np.array([[0, 2], [0, 4]]), np.array([0.3, 0.3]), np.zeros(2, bool))
    depth = Depth.around(np.full(10, DISPARITY), left, right)
    cost = Arms(tuple(arms), {}, merges, depth, None).with_steps(merges).cost
    assert cost[dearer] > cost[1 - dearer] + 0.2
    assert cost[1 - dearer] == pytest.approx(0.3, abs=0.1)
    np.testing.assert_array_equal(
        Arms(tuple(arms), {}, merges, None, None).with_steps(merges).cost, merges.cost
    )


def test_strands_that_cross_go_straight_on() -> None:
    run = np.arange(8.0, 69.0)
    ends = [np.c_[300 + way * run, 200 + side * 0.7 * run] for way in (-1, 1) for side in (-1, 1)]
    merges = Merges(np.empty((0, 2), np.int64), np.empty(0), np.empty(0, bool))
    crossing_arms = Arms(tuple(ends), {}, merges, None, None)
    straight, touching = [(0, 6), (2, 4)], [(0, 4), (2, 6)]
    change = crossing_arms.change(straight, touching)
    assert change is not None
    assert change > 0.2
    assert crossing_arms.change(touching, straight) == pytest.approx(-change)
    short = Arms(tuple(e[:5] for e in ends), {}, merges, None, None)
    assert short.change(straight, touching) is None


def waves(pixels: float) -> Float64:
    """A line that swings to and fro, once in so many pixels, by 12 px."""
    run = np.arange(0.0, 400.0, 0.5)
    return np.c_[120 + run, 240 + 12 * np.sin(2 * np.pi * run / pixels)]


def test_strands_are_as_rough_as_they_bend(rig: StereoRig) -> None:
    views = [field_of(draw(waves(p), rig), draw(waves(p), rig), rig).left for p in (90, 160, 400)]
    rough, even, smooth = (roughness(find_ridges(v, InitializationConfig())) for v in views)
    assert rough == ROUGHEST
    assert smooth < even < rough
    one, other = waves(400)[200:120:-2], waves(400)[200:280:2]
    assert abs(bend(one, other, smooth)) < 2
    # What costs a smooth strand much is little to a rough one.
    turned = other[0] + (other - other[0]) @ np.array([[0.9, -0.436], [0.436, 0.9]])
    assert bend(one, turned, smooth) > 2 * bend(one, turned, rough) > 0


def test_without_a_long_strand_nothing_tells_how_rough_one_is(rig: StereoRig) -> None:
    short = draw(waves(140)[:60], rig)
    assert (
        roughness(find_ridges(field_of(short, short, rig).left, InitializationConfig())) == ROUGHEST
    )


def test_a_merge_that_leaves_a_piece_out_is_no_rival() -> None:
    run = np.arange(0.0, 60.0)
    strand = np.c_[300 + run, np.full(60, 200.0)]
    before = [np.c_[290 - run, 200 + side * 0.7 * run] for side in (-1, 1)]
    pieces = strand[:24], strand[25:35], strand[36:]
    # Two strands may come before its first piece; its last piece would be joined to that about as well.
    pairs, costs = np.array([[0, 6], [0, 8], [1, 2], [3, 4], [1, 4]]), [0.2, 0.25, 0.1, 0.1, 0.15]
    merges = Merges(pairs, np.array(costs), np.zeros(5, bool))
    arms = Arms([*pieces, *before], {1: 2, 2: 1, 3: 4, 4: 3}, merges, None, None)
    assert arms.change([(0, 6)], [(0, 8)]) is not None
    apart = Arms([*pieces, *before], {3: 4, 4: 3}, merges, None, None)
    assert apart.change([(0, 6)], [(0, 8)]) is None


def test_a_faint_ridge_behind_an_end_is_no_thread(rig: StereoRig, curve: Nurbs) -> None:
    truth = dense(curve)
    views = []
    for pixels in rig.project(truth):
        vein = draw(pixels[1000:], rig).astype(float)
        faint = np.rint(190 + 0.35 * (vein - 190)).astype(np.uint8)
        views.append(draw(pixels[:1000], rig, faint))
    seed = Seed(pixel=tuple(rig.project(truth[500])[0]))
    found = initialize(field_of(views[0], views[1], rig), rig, seed)
    error = curve_error(dense(found.curve), truth[:1000])
    assert max(error.ends) < 1.6
    assert abs(error.length_percent) < 2
    assert any("a fainter ridge behind an end" in reason for reason in found.reasons)
