"""The layout shows what was recorded, and the viewer has nothing to complain about."""

from __future__ import annotations

import ctypes.util
import socket
import subprocess
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import cv2
import numpy as np
import pytest
import rerun.blueprint as rrb
from rerun.experimental import ViewerClient

from services.blueprint import blueprint
from services.messages import Health, Latency
from services.recording import Recorder
from services.run_folder import RunFolder
from services.view import command, files
from suturetrack import nurbs
from suturetrack.camera import StereoRig
from suturetrack.initialization import Growth, Initialization, ViewGrowth
from suturetrack.types import (
    Energies,
    Float32,
    Nurbs,
    RidgeField,
    Seed,
    Stamp,
    Status,
    StereoFrame,
    ThreadState,
    Truth,
)
from tests.conftest import wait_until

FRAMES = 12
GRAPHICS = (
    "mesa-vulkan-drivers libvulkan1 libgl1-mesa-dri libegl1 libxkbcommon-x11-0 libxcursor1 libxi6"
)


def record_run(run_dir: Path, rig: StereoRig, curve: Nurbs) -> None:
    """A short run of three processes with everything that can be recorded in it."""
    path = [np.rint(p).astype(np.int32) for p in rig.project_raw(_points(curve))]
    images = [np.full((480, 640, 3), (60, 90, 190), np.uint8) for _ in path]
    for image, pixels in zip(images, path, strict=True):
        cv2.polylines(image, [pixels], False, (60, 20, 20), 5)
    field = np.zeros((480, 640, 2), np.float32)
    with (
        Recorder(run_dir, "source", "light", rig) as source,
        Recorder(run_dir, "segmenter", "light", rig) as segmenter,
        Recorder(run_dir, "tracker", "light", rig) as tracker,
    ):
        for i in range(FRAMES):
            stamp = Stamp(i, i * 33_000_000, 10**18 + i)
            source.frame(StereoFrame(stamp, *images))
            source.truth(Truth(stamp, "0", _points(curve), 1.0, np.ones(300, bool)))
            segmenter.field(RidgeField(stamp, field, field))
            if i == 0:
                seeds = {"0": Seed("0", pixel=(300.0, 205.0))}
                found = {"0": _initialization(curve, rig)}
                tracker.initializations(RidgeField(stamp, field, field), seeds, found)
            tracker.states([_state(curve, stamp)])
        for recorder in (source, segmenter, tracker):
            name = recorder.process
            recorder.health(Health(name, 0, stamp, 30.0, Latency(), 30.0, Latency(), 1, 0, 0, 99.0))
            recorder.log("done")


def _points(curve: Nurbs) -> np.ndarray:
    return nurbs.evaluate(curve, np.linspace(0, 1, 300))


def _state(curve: Nurbs, stamp: Stamp) -> ThreadState:
    energies, length = Energies(-0.9, -0.8, -1.5, 2.5), nurbs.length(curve)
    sigma, seen = np.full(50, 0.1), np.ones(50, bool)
    return ThreadState(stamp, "0", Status.TRACKING, curve, length, energies, sigma, seen)


def _initialization(curve: Nurbs, rig: StereoRig) -> Initialization:
    cost: Float32 = np.full((480, 640), np.inf, np.float32)
    cost[200:210, 100:500] = np.arange(400)
    line = rig.project(_points(curve))[0]
    view = ViewGrowth(cost, (line,), line[None, [0, -1]], ((line[:20] + 9, "too short"),))
    return Initialization(curve, 1.0, (), 0.1, Growth(view, view, np.stack([line, line], axis=1)))


def views(part: rrb.Container | rrb.View) -> Iterator[rrb.View]:
    """All views of a layout."""
    if isinstance(part, rrb.View):
        yield part
    else:
        for inner in part.contents:
            yield from views(inner)


def shown(view: rrb.View, entities: set[str]) -> set[str]:
    """The entities that a view asks for, by the rules of Rerun's filters."""
    contents = [view.contents] if isinstance(view.contents, str) else list(view.contents)
    chosen: set[str] = set()
    for rule in contents:
        pattern = rule.removeprefix("+ ").removeprefix("- ").replace("$origin", str(view.origin))
        root = pattern.removesuffix("/**")
        inside = {e for e in entities if e == root or e.startswith(f"{root}/")}
        matched = inside if pattern.endswith("/**") else {pattern} & entities
        chosen = chosen - matched if rule.startswith("- ") else chosen | matched
    return chosen


def test_every_view_shows_something_and_everything_is_shown(
    tmp_path: Path, distorted_rig: StereoRig, curve: Nurbs
) -> None:
    record_run(tmp_path, distorted_rig, curve)
    entities = {row["entity"] for row in RunFolder(tmp_path).rows("/**")}
    layout = list(views(blueprint(["0"], _points(curve)).root_container))
    by_view = {f"{view.name} {view.contents}": shown(view, entities) for view in layout}
    assert all(by_view.values()), by_view
    unseen = entities - set().union(*by_view.values())
    poses = {"/rig/left", "/rig/right"}
    assert unseen == poses | {e for e in unseen if e.startswith(("/run", "/__"))}


@contextmanager
def headless_viewer(run_dir: Path) -> Iterator[ViewerClient]:
    """The viewer without a window, with the run in it."""
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    call = command(False, "--headless", "--hide-welcome-screen", "--port", str(port))
    process = subprocess.Popen(call, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    try:
        client = _connected(port)
        client.open(files(RunFolder(run_dir)))
        wait_until(lambda: client.get_state().active_recording is not None, 60)
        yield client
    finally:
        process.kill()
        process.wait()


def _connected(port: int) -> ViewerClient:
    clients: list[ViewerClient] = []

    def answers() -> bool:
        try:
            clients.append(ViewerClient.connect(f"rerun+http://127.0.0.1:{port}/proxy"))
            clients[-1].get_state()
        except (ConnectionError, RuntimeError, TimeoutError):
            return False
        return True

    wait_until(answers, 60)
    return clients[-1]


@pytest.mark.skipif(
    ctypes.util.find_library("vulkan") is None
    or not list(Path("/usr/share/vulkan").glob("icd.d/*")),
    reason=f"the viewer needs a graphics driver: apt-get install {GRAPHICS}",
)
def test_the_viewer_shows_the_curve_on_the_thread(
    tmp_path: Path, distorted_rig: StereoRig, curve: Nurbs
) -> None:
    record_run(tmp_path, distorted_rig, curve)
    picture = tmp_path / "view.png"

    def green_share() -> float:
        client.set_time("frame", sequence=FRAMES - 1, play_state="paused")
        client.save_screenshot(str(picture))
        image = np.asarray(cv2.imread(str(picture))).astype(int)
        upper = image[: image.shape[0] // 2, : image.shape[1] * 7 // 10]
        return float((abs(upper - (90, 220, 70)).max(axis=2) < 40).mean())

    with headless_viewer(tmp_path) as client:
        wait_until(lambda: green_share() > 1e-3, 60)
        for frame in (FRAMES - 1, FRAMES // 2, 0):
            client.set_time("frame", sequence=frame, play_state="paused")
            client.save_screenshot(str(picture))
            state = client.get_state()
            assert len(state.views) > 10
            assert [report for view in state.views for report in view.reports] == []
