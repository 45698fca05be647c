"""What several tests share: rigs in different units and a curve to look at."""

from __future__ import annotations

import faulthandler
import signal
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, settings

from suturetrack import nurbs
from suturetrack.camera import StereoRig
from suturetrack.types import Nurbs

settings.register_profile(
    "default", max_examples=50, deadline=None, suppress_health_check=[HealthCheck.too_slow]
)
settings.load_profile("default")

# A shell has its jobs in the background ignore interrupts, and so would the programs under test.
signal.signal(signal.SIGINT, signal.default_int_handler)

_LONGEST_END_S = 60.0


def pytest_unconfigure() -> None:
    """Ends a run that hangs when its tests are done, and says where."""
    faulthandler.dump_traceback_later(_LONGEST_END_S, exit=True, file=sys.__stderr__)


def make_rig(baseline: float = 40.0, metres_per_unit: float = 1e-3) -> StereoRig:
    """A rectified 640x480 rig with a focal length of 800 px."""
    k = np.array([[800.0, 0, 319.5], [0, 800.0, 239.5], [0, 0, 1]])
    none = np.zeros(5)
    translation = np.array([-baseline, 0, 0])
    return StereoRig.from_calibration(
        (640, 480), (k, none), (k, none), np.eye(3), translation, metres_per_unit
    )


def wait_until(
    condition: Callable[[], object], seconds: float = 30.0, tell: Callable[[], str] = lambda: ""
) -> None:
    """Returns as soon as the condition holds; fails when it does not in time, and tells of it."""
    deadline = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < deadline, f"waited in vain {tell()}"
        time.sleep(0.005)


@pytest.fixture
def rig() -> StereoRig:
    return make_rig()


@pytest.fixture
def distorted_rig() -> StereoRig:
    """Cameras with barrel distortion, turned towards each other by a few degrees."""
    k1 = np.array([[790.0, 0, 331.0], [0, 792.0, 236.0], [0, 0, 1]])
    k2 = np.array([[801.0, 0, 309.0], [0, 799.0, 247.0], [0, 0, 1]])
    d1 = np.array([-0.21, 0.05, 0.001, -0.002, 0.0])
    d2 = np.array([-0.18, 0.03, -0.001, 0.001, 0.0])
    angle = np.radians(3.0)
    rotation = np.array(
        [[np.cos(angle), 0, np.sin(angle)], [0, 1, 0], [-np.sin(angle), 0, np.cos(angle)]]
    )
    return StereoRig.from_calibration(
        (640, 480), (k1, d1), (k2, d2), rotation, np.array([-40.0, 0.6, 0.9]), 1e-3
    )


@pytest.fixture
def curve() -> Nurbs:
    """A cubic of nine control points that bends in all directions, 150 to 240 mm before the camera."""
    rng = np.random.default_rng(7)
    x = np.linspace(-50, 50, 9)
    points = np.c_[x, 30 * np.sin(x / 15), 195 + rng.normal(0, 12, 9)]
    knots = nurbs.clamped_knots(np.array([0.15, 0.3, 0.5, 0.6, 0.85]), 3)
    return nurbs.curve_from(3, knots, points)


@contextmanager
def private_sockets() -> Iterator[Path]:
    """Has all sockets lie in a directory of the test's own, with a short path."""
    made = tempfile.TemporaryDirectory(prefix="suturetrack-", ignore_cleanup_errors=True)
    with made as directory, pytest.MonkeyPatch.context() as patch:
        patch.setenv("XDG_RUNTIME_DIR", directory)
        yield Path(directory)


@pytest.fixture
def rig_name() -> Iterator[str]:
    """Name of a rig with `private_sockets`."""
    with private_sockets():
        yield "test"
