import itertools
import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from suturetrack import nurbs
from suturetrack.grasping import GraspPoint, grasp
from suturetrack.types import Energies, InputError, Stamp, Status, ThreadState

RADIUS = 30.0


def state(**changes: object) -> ThreadState:
    """A quarter circle of radius 30 from (30, 0, 200) to (0, 30, 200)."""
    angle = np.linspace(0, math.pi / 2, 200)
    points = np.stack([RADIUS * np.cos(angle), RADIUS * np.sin(angle), 200 + 0 * angle], axis=1)
    curve = nurbs.fit(
        points, np.linspace(0, 1, 200), nurbs.clamped_knots(np.linspace(0, 1, 9)[1:-1], 3), 3
    )
    values = {
        "stamp": Stamp(4, 5, 6),
        "thread": "a",
        "status": Status.TRACKING,
        "curve": curve,
        "length": nurbs.length(curve),
        "energies": Energies(),
        "sigma": np.linspace(0.1, 0.3, 64),
        "seen": np.ones(64, bool),
    }
    return ThreadState(**(values | changes))  # type: ignore[arg-type]


def test_distances_count_from_either_end() -> None:
    places = [
        (GraspPoint(from_start=10.0), 10 / RADIUS),
        (GraspPoint(from_end=10.0), math.pi / 2 - 10 / RADIUS),
        (GraspPoint(from_start=0.0), 0.0),
        (GraspPoint(from_end=0.0), math.pi / 2),
    ]
    for where, angle in places:
        pose = grasp(state(), where)
        expected = [RADIUS * math.cos(angle), RADIUS * math.sin(angle), 200]
        np.testing.assert_allclose(pose.position, expected, atol=0.01)


def test_fraction_and_nearest_point_agree() -> None:
    middle = grasp(state(), GraspPoint(fraction=0.5))
    near = grasp(state(), GraspPoint(near=(40.0, 40.0, 210.0)))
    np.testing.assert_allclose(middle.position, near.position, atol=0.1)
    assert middle.sigma == pytest.approx(0.2, abs=1e-3)
    assert (middle.stamp, middle.thread) == (Stamp(4, 5, 6), "a")


@given(
    st.floats(0, 1),
    st.tuples(*[st.floats(-1, 1)] * 3).filter(lambda a: np.linalg.norm(a) > 0.1),
)
def test_the_pose_is_a_rotation_with_z_along_the_thread(
    fraction: float, approach: tuple[float, float, float]
) -> None:
    tangent = np.array([-math.sin(fraction * math.pi / 2), math.cos(fraction * math.pi / 2), 0])
    across = np.array(approach) - (np.array(approach) @ tangent) * tangent
    if np.linalg.norm(across) < 0.11 * np.linalg.norm(approach):
        return
    rotation = grasp(state(), GraspPoint(fraction=fraction), approach).rotation
    np.testing.assert_allclose(rotation.T @ rotation, np.eye(3), atol=1e-9)
    assert np.linalg.det(rotation) == pytest.approx(1)
    np.testing.assert_allclose(rotation[:, 2], tangent, atol=0.01)
    np.testing.assert_allclose(rotation[:, 0], across / np.linalg.norm(across), atol=0.1)


@pytest.mark.parametrize(
    ("where", "reason"),
    [
        (GraspPoint(), "exactly one"),
        (GraspPoint(from_end=1.0, fraction=0.5), "exactly one"),
        (GraspPoint(fraction=1.5), "from 0 to 1"),
        (GraspPoint(from_start=500.0), "off the thread"),
        (GraspPoint(from_end=-0.5), "off the thread"),
        (GraspPoint(from_end=math.nan), "off the thread"),
    ],
)
def test_a_place_off_the_thread_is_refused(where: GraspPoint, reason: str) -> None:
    with pytest.raises(InputError, match=reason):
        grasp(state(), where)


def test_no_curve_and_an_approach_along_the_thread_are_refused() -> None:
    with pytest.raises(InputError, match="not found yet"):
        grasp(state(curve=None), GraspPoint(fraction=0.5))
    with pytest.raises(InputError, match="along the thread"):
        grasp(state(), GraspPoint(fraction=0.0), (0.0, 1.0, 0.0))
    with pytest.raises(InputError, match="along the thread"):
        grasp(state(), GraspPoint(fraction=0.0), (0.05, 1.0, 0.0))


def test_a_lost_thread_and_an_unseen_stretch_are_refused() -> None:
    with pytest.raises(InputError, match="is lost"):
        grasp(state(status=Status.LOST), GraspPoint(fraction=0.5))
    seen = np.ones(64, bool)
    seen[20:40] = False
    half_seen = state(seen=seen, status=Status.OCCLUDED)
    with pytest.raises(InputError, match="not seen at 50 %"):
        grasp(half_seen, GraspPoint(fraction=0.5))
    for fraction in (0.0, 0.25, 0.7, 1.0):
        assert grasp(half_seen, GraspPoint(fraction=fraction)).sigma > 0


def test_the_pose_moves_no_more_than_the_thread() -> None:
    """A thread that shakes by a twentieth of its radius turns the frame by a few degrees at most."""
    poses = []
    rng = np.random.default_rng(0)
    curve = state().curve
    assert curve is not None
    for _ in range(40):
        shaken = curve.control_points + rng.normal(0, 0.05, curve.control_points.shape)
        moved = state(curve=nurbs.curve_from(3, curve.knots, shaken))
        poses.append(grasp(moved, GraspPoint(from_end=10.0), (0.3, 0.2, 1.0)))
    turns = [
        np.degrees(np.arccos((np.trace(a.rotation.T @ b.rotation) - 1) / 2))
        for a, b in itertools.pairwise(poses)
    ]
    assert max(turns) < 5
    steps = [np.linalg.norm(a.position - b.position) for a, b in itertools.pairwise(poses)]
    assert max(steps) < 0.5
