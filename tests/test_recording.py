"""What was logged is read back and compared with what was published; nothing is lost in trouble."""

from __future__ import annotations

import os
import shutil
import signal
import subprocess
import sys
import textwrap
from dataclasses import replace
from itertools import chain
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from rerun.chunk import RrdReader
from rerun.error_utils import RerunWarning

from services.bus import Bus
from services.drawing import Level
from services.memory_transport import Hub
from services.messages import Health, Latency
from services.recording import Recorder
from services.run_folder import RunFolder
from services.service import Service, ServiceConfig
from suturetrack import nurbs
from suturetrack.camera import StereoRig
from suturetrack.initialization import Growth, Initialization, InitializationError, ViewGrowth
from suturetrack.segmentation import joined
from suturetrack.types import (
    Colours,
    Energies,
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

STAMP = Stamp(7, 1_234_567_890_123, 1_700_000_000_000_000_000)
PUBLISHED = STAMP.released_ns + 12_500_000


def make_state(curve: Nurbs, status: Status = Status.TRACKING, stamp: Stamp = STAMP) -> ThreadState:
    """A state of which the middle third is not seen."""
    s = np.linspace(0, 1, 61)
    return ThreadState(
        stamp=stamp,
        thread="0",
        status=status,
        curve=curve,
        length=nurbs.length(curve),
        energies=Energies(-0.9, -0.8, -1.5, 2.5),
        sigma=np.linspace(0.01, 0.5, 61),
        seen=abs(s - 0.5) > 1 / 6,
        events=("one control point inserted",),
    )


def rows(folder: RunFolder, entity: str) -> list[dict[str, Any]]:
    """The rows of one entity that are not static."""
    return [row for row in folder.rows(entity) if "frame" in row]


def row(folder: RunFolder, entity: str) -> dict[str, Any]:
    """The only row of one entity."""
    (only,) = rows(folder, entity)
    assert only["frame"] == STAMP.frame
    assert only["capture"] == STAMP.capture_ns
    return only


@pytest.fixture
def frame() -> StereoFrame:
    rng = np.random.default_rng(1)
    smooth = [cv2.blur(rng.integers(0, 256, (480, 640, 3), np.uint8), (9, 9)) for _ in range(2)]
    return StereoFrame(STAMP, *smooth)


@pytest.fixture(params=[(), ("0", "left-hand")], ids=["one", "several"])
def ridges(request: pytest.FixtureRequest) -> RidgeField:
    rng, own = np.random.default_rng(2), request.param
    views = rng.normal(0, 0.3, (1 + len(own), 2, 480, 640, 2)).astype(np.float32)
    if own:
        of_each = dict(zip(own, map(tuple, views[1:]), strict=True))
        pixels = np.array([[2, 0], [639, 0], [0, 479]], np.uint16)
        left, right = (Colours(pixels[:k], rng.integers(0, 256, (k, 3), np.uint8)) for k in (3, 0))
        return joined(STAMP, of_each, (left, right))
    return RidgeField(STAMP, *views[0])


def test_full_images_and_fields_come_back_to_the_bit_though_buffers_are_used_again(
    tmp_path: Path, rig: StereoRig, frame: StereoFrame, ridges: RidgeField
) -> None:
    images = {"left": frame.left.copy(), "right": frame.right.copy()}
    pairs = [*ridges.own.values()] or [(ridges.left, ridges.right)]
    fields = np.array([(ridges.left, ridges.right), *ridges.own.values()])
    with Recorder(tmp_path, "source", "full", rig) as recorder:
        recorder.frame(frame, PUBLISHED)
        recorder.field(ridges, PUBLISHED)
        for buffer in (frame.left, frame.right, *chain(*pairs)):
            buffer[:] = 0
    folder = RunFolder(tmp_path)
    for view in ("left", "right"):
        image = row(folder, f"/rig/{view}/image")
        assert np.array_equal(image["Image:buffer"][0], images[view].ravel())
    (again,) = folder.frames()
    assert again.stamp == Stamp(STAMP.frame, STAMP.capture_ns, 0)
    assert np.array_equal(again.left, images["left"])
    assert np.array_equal(again.right, images["right"])
    (field,) = folder.fields()
    assert field.left.dtype == np.float32
    assert list(field.own) == list(ridges.own)
    assert np.array_equal([(field.left, field.right), *field.own.values()], fields)
    assert (field.colours is None) == (ridges.colours is None)
    for of_view, given in zip(field.colours or (), ridges.colours or (), strict=True):
        assert np.array_equal(of_view.pixels, given.pixels)
        assert np.array_equal(of_view.bgr, given.bgr)


def test_light_images_are_close_and_in_the_right_colours(
    tmp_path: Path, rig: StereoRig, frame: StereoFrame
) -> None:
    frame.left[..., 2] = 255  # red, in BGR
    with Recorder(tmp_path, "source", "light", rig) as recorder:
        recorder.frame(frame, PUBLISHED)
    folder = RunFolder(tmp_path)
    for view, image in (("left", frame.left), ("right", frame.right)):
        blob = np.asarray(row(folder, f"/rig/{view}/image")["EncodedImage:blob"][0], np.uint8)
        decoded = np.asarray(cv2.imdecode(blob, cv2.IMREAD_COLOR))
        assert decoded.shape == image.shape
        assert abs(decoded.astype(int) - image).mean() < 4
    latency = row(folder, "/plots/latency_ms/source")["Scalars:scalars"]
    assert latency.tolist() == [12.5]


def test_gray_images_are_recorded_in_both_levels(tmp_path: Path, rig: StereoRig) -> None:
    gray = np.tile(np.arange(640, dtype=np.uint8), (480, 1))
    for level in ("light", "full"):
        with Recorder(tmp_path / level, "source", level, rig) as recorder:
            recorder.frame(StereoFrame(STAMP, gray, gray))
    image = row(RunFolder(tmp_path / "full"), "/rig/left/image")
    assert np.array_equal(image["Image:buffer"][0], gray.ravel())
    assert "EncodedImage:blob" in row(RunFolder(tmp_path / "light"), "/rig/left/image")


def test_the_direction_picture_lies_on_the_raw_image(
    tmp_path: Path, distorted_rig: StereoRig
) -> None:
    point = np.array([55.0, 35.0, 200.0])  # near a corner, where distortion is strong
    rectified, raw = distorted_rig.project(point)[0], distorted_rig.project_raw(point)[0]
    assert np.linalg.norm(rectified - raw) > 5
    field = np.zeros((480, 640, 2), np.float32)
    u, v = np.rint(rectified).astype(int)
    field[v - 3 : v + 4, u - 3 : u + 4] = (1, 0)
    with Recorder(tmp_path, "segmenter", "light", distorted_rig) as recorder:
        recorder.field(RidgeField(STAMP, field, field))
    blob = row(RunFolder(tmp_path), "/rig/left/image/direction")["EncodedImage:blob"][0]
    picture = np.asarray(cv2.imdecode(np.asarray(blob, np.uint8), cv2.IMREAD_COLOR))
    lit = np.argwhere(picture.max(axis=2) > 128)[:, ::-1]
    assert len(lit) > 10
    assert np.linalg.norm(lit.mean(axis=0) - raw) < 1.0


@pytest.mark.parametrize(
    ("level", "pictured"), [("light", [0, 3, 8, 11]), ("full", [0, 1, 2, 3, 8, 9, 10, 11])]
)
def test_light_recordings_keep_ten_pictures_of_the_field_a_second(
    tmp_path: Path, rig: StereoRig, ridges: RidgeField, level: Level, pictured: list[int]
) -> None:
    """Latencies are there at every frame; where frames were dropped, the next picture is not late."""
    frames = [0, 1, 2, 3, 8, 9, 10, 11]
    with Recorder(tmp_path, "segmenter", level, rig) as recorder:
        for i in frames:
            at_ns = i * 33_333_333
            recorder.field(replace(ridges, stamp=Stamp(i, at_ns, at_ns)), at_ns + 1_000_000)
    folder = RunFolder(tmp_path)
    pictures = rows(folder, "/rig/left/image/direction")
    assert sorted(r["frame"] for r in pictures) == pictured
    latencies = rows(folder, "/plots/latency_ms/segmenter")
    assert sorted(r["frame"] for r in latencies) == frames
    assert {r["Scalars:scalars"][0] for r in latencies} == {1.0}


def test_curves_lie_where_the_cameras_see_them(
    tmp_path: Path, distorted_rig: StereoRig, curve: Nurbs
) -> None:
    state = make_state(curve)
    with Recorder(tmp_path, "tracker", "light", distorted_rig) as recorder:
        recorder.states([state], PUBLISHED)
    folder = RunFolder(tmp_path)
    dense = nurbs.evaluate(curve, np.linspace(0, 1, 20_000))
    for k, view in enumerate(("left", "right")):
        overlay = row(folder, f"/rig/{view}/image/curve")
        strips = [np.array(strip) for strip in overlay["LineStrips2D:strips"]]
        expected = distorted_rig.project_raw(dense)[k]
        distances = [np.linalg.norm(expected - p, axis=1).min() for s in strips for p in s]
        assert max(distances) < 0.05
        green = overlay["LineStrips2D:colors"] == (70 << 24 | 220 << 16 | 90 << 8 | 255)
        solid = np.concatenate([s for s, g in zip(strips, green, strict=True) if g])
        unseen = distorted_rig.project_raw(nurbs.evaluate(curve, np.array([0.5])))[k]
        assert np.linalg.norm(solid - unseen, axis=1).min() > 10
        control_points = distorted_rig.project_raw(curve.control_points)[k]
        assert np.allclose(overlay["Points2D:positions"], control_points, atol=1e-3)


def test_the_curve_in_space_and_its_numbers_come_back(
    tmp_path: Path, rig: StereoRig, curve: Nurbs
) -> None:
    state = make_state(curve, Status.OCCLUDED)
    with Recorder(tmp_path, "tracker", "light", rig) as recorder:
        recorder.states([state], PUBLISHED)
    folder = RunFolder(tmp_path)
    (recorded,) = folder.states()
    assert recorded.latency_ms == 12.5
    again = recorded.state
    assert (again.stamp, again.thread, again.status) == (STAMP, "0", Status.OCCLUDED)
    assert (again.length, again.energies, again.events) == (
        *(state.length, state.energies, state.events),
    )
    assert again.curve is not None
    for name in ("knots", "control_points", "weights"):
        assert np.array_equal(getattr(again.curve, name), getattr(curve, name))
    assert np.array_equal(again.sigma, state.sigma)
    assert np.array_equal(again.seen, state.seen)

    root = "/rig/thread/0"
    points = row(folder, f"{root}/control_points")["Points3D:positions"]
    assert np.allclose(points, curve.control_points, atol=1e-4)
    samples = row(folder, f"{root}/reliability")
    on_curve = nurbs.evaluate(curve, np.linspace(0, 1, 61))
    assert np.allclose(samples["Points3D:positions"], on_curve, atol=1e-4)
    assert len(set(samples["Points3D:colors"].tolist())) > 10
    arrows = row(folder, f"{root}/tangent")["Arrows3D:vectors"]
    unit = arrows / np.linalg.norm(arrows, axis=1, keepdims=True)
    assert np.allclose(unit, nurbs.tangents(curve, np.linspace(0, 1, len(arrows))), atol=1e-5)
    assert row(folder, f"{root}/curve")["LineStrips3D:strips"]


def test_a_thread_without_a_curve_yet_is_recorded_as_such(
    tmp_path: Path, distorted_rig: StereoRig, curve: Nurbs
) -> None:
    nothing = ThreadState(
        *(STAMP, "0", Status.LOST, None, np.nan, Energies()),
        *(np.full(61, np.inf), np.zeros(61, bool)),
    )
    with Recorder(tmp_path, "tracker", "light", distorted_rig) as recorder:
        recorder.states([nothing], PUBLISHED)
    folder = RunFolder(tmp_path)
    (recorded,) = folder.states()
    assert recorded.state.curve is None
    assert np.isnan(recorded.state.length)
    assert len(row(folder, "/rig/left/image/curve")["LineStrips2D:strips"]) == 0
    assert len(row(folder, "/rig/thread/0/curve")["LineStrips3D:strips"]) == 0
    assert len(row(folder, "/rig/thread/0/reliability")["Points3D:positions"]) == 0


def test_plots_carry_their_units_and_the_log_tells_events(tmp_path: Path, curve: Nurbs) -> None:
    k = np.array([[800.0, 0, 319.5], [0, 800.0, 239.5], [0, 0, 1]])
    none, shift = np.zeros(5), np.array([-0.04, 0, 0])
    rig = StereoRig.from_calibration((640, 480), (k, none), (k, none), np.eye(3), shift, 1.0)
    metric = nurbs.curve_from(3, curve.knots, curve.control_points / 1000)
    health = Health("tracker", 0, STAMP, 29.5, Latency(), 29.0, Latency(), 10, 3, 0, 123.0)
    with Recorder(tmp_path, "tracker", "light", rig) as recorder:
        recorder.states([make_state(metric)], PUBLISHED)
        recorder.health(health)
        recorder.log("all is well", "WARN")
    folder = RunFolder(tmp_path)
    expected = {
        "0/energy/image": [-0.9, -0.8],
        "0/energy/end": [-1.5],
        "0/energy/internal": [2.5],
        "0/length": [nurbs.length(metric) * 1000],
        "0/control_points": [9],
        "latency_ms/tracker": [12.5],
        "rate_hz/tracker": [29.5],
        "dropped/tracker": [3],
        "memory_mb/tracker": [123.0],
    }
    for name, values in expected.items():
        assert row(folder, f"/plots/{name}")["Scalars:scalars"].tolist() == values
    assert row(folder, "/plots/0/status")["StateChange:state"].tolist() == ["tracking"]
    texts = [r["TextLog:text"][0] for r in rows(folder, "/log/tracker")]
    events = ["thread 0: one control point inserted", "thread 0: tracking", "all is well"]
    assert texts == [f"tracker: {event}" for event in events]


def test_the_log_warns_of_every_loss(tmp_path: Path, rig: StereoRig, curve: Nurbs) -> None:
    course = [*[Status.TRACKING] * 3, *[Status.LOST] * 2, Status.OCCLUDED, *[Status.LOST] * 2]
    with Recorder(tmp_path, "tracker", "light", rig) as recorder:
        for i, status in enumerate(course):
            recorder.states([make_state(curve, status, Stamp(i, i, i))])
    lines = rows(RunFolder(tmp_path), "/log/tracker")
    warnings = [r["frame"] for r in lines if r["TextLog:level"][0] == "WARN"]
    assert warnings == [3, 6]


def test_warnings_are_recorded_though_no_frame_is_finished(
    tmp_path: Path, rig: StereoRig, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("services.service._COMPLAINT_INTERVAL_S", 0)
    bus = Bus(Hub().connect(), "rig", "segmenter")
    with Service("segmenter", ServiceConfig(run_dir=tmp_path), bus) as service:
        bus.complain("no kernels were cached")
        service.record(rig, None)
        bus.complain("refused a message: it is of another rig")
    lines = [row for row in RunFolder(tmp_path).rows("/log/segmenter") if "TextLog:text" in row]
    assert [(line["TextLog:text"][0], line["TextLog:level"][0]) for line in lines] == [
        ("segmenter: no kernels were cached", "WARN"),
        ("segmenter: refused a message: it is of another rig", "WARN"),
    ]


def test_the_growth_can_be_followed_step_by_step(
    tmp_path: Path, rig: StereoRig, curve: Nurbs, ridges: RidgeField
) -> None:
    cost = np.full((480, 640), np.inf, np.float32)
    cost[100:110, 50:250] = np.arange(200)
    line = np.c_[np.arange(50.0, 250.0), np.full(200, 105.0)]
    view = ViewGrowth(
        cost, (line,), np.array([[[1.0, 2], [3, 4]]]), ((line[:9] + 50, "too short"),)
    )
    growth = Growth(view, view, np.stack([line[::10], line[::10] - [20, 0]], axis=1))
    found = Initialization(curve, 0.75, ("one end is hidden",), 0.3, growth)
    nothing = InitializationError("no ridge", line[:3])
    seeds = {"0": Seed("0", pixel=(60.0, 105.0)), "1": Seed("1", pixel=(9.0, 9.0))}
    with Recorder(tmp_path, "tracker", "light", rig) as recorder:
        recorder.initializations(ridges, seeds, {"0": found, "1": nothing})
    folder = RunFolder(tmp_path)
    root = "/rig/right/image/growth/0"
    fronts = sorted(rows(folder, f"{root}/front"), key=lambda r: r["growth"])
    reached = [np.count_nonzero(f["SegmentationImage:buffer"][0]) for f in fronts]
    assert reached == sorted(set(reached))
    assert reached[-1] == 2000
    assert len(reached) == 10
    assert np.allclose(row(folder, f"{root}/marks")["Points2D:positions"], growth.marks[:, 1])
    assert np.allclose(row(folder, f"{root}/segments")["LineStrips2D:strips"][0], line)
    assert np.allclose(row(folder, f"{root}/merges")["LineStrips2D:strips"][0], [[1, 2], [3, 4]])
    rejected = row(folder, f"{root}/rejected")
    assert rejected["LineStrips2D:labels"].tolist() == ["too short"]
    begun = row(folder, "/rig/left/image/growth/0/seed")["Points2D:positions"]
    assert begun.tolist() == [[60.0, 105.0]]
    words = row(folder, "/log/initialization/0")["TextDocument:text"][0]
    for said in ("frame 7", "confidence 0.75", "one end is hidden", "Rejected, right: 1"):
        assert said in words
    assert "1x too short" in words
    candidates = row(folder, "/rig/left/image/growth/1/candidates")["Points2D:positions"]
    assert np.allclose(candidates, line[:3])
    texts = [r["TextLog:text"][0] for r in rows(folder, "/log/tracker")]
    assert texts[0].endswith("thread 0 found with confidence 0.75; one end is hidden")
    assert texts[1].endswith("thread 1 not found: no ridge")


def test_cameras_truth_and_parameters_come_back(
    tmp_path: Path, distorted_rig: StereoRig, curve: Nurbs
) -> None:
    points = nurbs.evaluate(curve, np.linspace(0, 1, 40))
    truth = Truth(STAMP, "0", points, 123.456789, np.arange(40) % 2 == 0)
    with Recorder(tmp_path, "source", "light", distorted_rig, config=truth.stamp) as recorder:
        recorder.truth(truth)
    folder = RunFolder(tmp_path)
    (again,) = folder.truths()
    assert (again.stamp, again.thread, again.length) == (STAMP, "0", truth.length)
    assert np.allclose(again.points, points, atol=1e-4)
    assert np.array_equal(again.visible, truth.visible)
    rig = folder.rig()
    assert (rig.image_size, rig.metres_per_unit) == ((640, 480), 1e-3)
    assert np.array_equal(rig.project_raw(points), distorted_rig.project_raw(points))
    (parameters,) = folder.rows("/run/source/parameters")
    assert f"capture_ns: {STAMP.capture_ns}" in parameters["TextDocument:text"][0]
    about = folder.about()["source"]
    assert about["level"] == "light"
    assert about["suturetrack"]


def test_the_cameras_stand_in_space_as_calibrated(tmp_path: Path, distorted_rig: StereoRig) -> None:
    Recorder(tmp_path, "source", "light", distorted_rig).close()
    point = np.array([10.0, -20.0, 200.0])
    for k, view in enumerate(("left", "right")):
        (pose,) = RunFolder(tmp_path).rows(f"/rig/{view}")
        (pinhole,) = RunFolder(tmp_path).rows(f"/rig/{view}/image")
        rotation = np.reshape(pose["Transform3D:mat3x3"][0], (3, 3)).T  # stored by columns
        in_camera = rotation.T @ (point - pose["Transform3D:translation"][0])
        matrix = np.reshape(pinhole["Pinhole:image_from_camera"][0], (3, 3)).T
        pixel = matrix @ in_camera
        camera = (distorted_rig.left, distorted_rig.right)[k]
        expected, _ = cv2.projectPoints(in_camera, np.zeros(3), np.zeros(3), camera.matrix, None)
        raw = distorted_rig.project_raw(point)[k]
        undistorted = cv2.undistortPoints(raw, camera.matrix, camera.distortion, P=camera.matrix)
        assert np.allclose(pixel[:2] / pixel[2], expected.ravel(), atol=1e-2)
        assert np.allclose(expected.ravel(), undistorted.ravel(), atol=1e-2)


def test_without_a_run_folder_nothing_is_recorded(
    tmp_path: Path, rig: StereoRig, curve: Nurbs, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    with Recorder(None, "tracker", "light", rig) as recorder:
        recorder.states([make_state(curve)])
        recorder.log("unheard")
    assert list(tmp_path.iterdir()) == []


def test_a_long_run_rolls_over_into_parts_that_each_explain_themselves(
    tmp_path: Path, rig: StereoRig, curve: Nurbs
) -> None:
    with Recorder(
        tmp_path, "tracker", "light", rig, flush_seconds=0, part_bytes=200_000
    ) as recorder:
        for i in range(60):
            recorder.states([make_state(curve, stamp=Stamp(i, i, i))])
    parts = sorted(tmp_path.glob("*.rrd"))
    assert len(parts) >= 3
    assert [s.state.stamp.frame for s in RunFolder(tmp_path).states()] == list(range(60))
    for k, part in enumerate(parts):
        alone = tmp_path / str(k)
        alone.mkdir()
        shutil.copy(part, alone / "tracker.rrd")
        folder = RunFolder(alone)
        assert folder.rig().focal == rig.focal
        assert [r for r in folder.rows("/plots/0/length") if "SeriesLines:names" in r]
        # A footer would be an index that grows in memory.
        with pytest.warns(RerunWarning, match="no footer"):
            assert len(RrdReader(part).recordings()) == 1


def test_a_removed_folder_stops_the_recording_and_nothing_else(
    tmp_path: Path, rig: StereoRig, curve: Nurbs, caplog: pytest.LogCaptureFixture
) -> None:
    with Recorder(tmp_path / "run", "tracker", "light", rig, flush_seconds=0) as recorder:
        recorder.states([make_state(curve)])
        assert not recorder.problem
        shutil.rmtree(tmp_path / "run")
        recorder.states([make_state(curve)])
        wait_until(lambda: "removed" in str(recorder.problem))
        recorder.states([make_state(curve)])
    assert len([r for r in caplog.records if "recording stopped" in r.message]) == 1


WRITER = """
    import resource, signal, sys, time
    import numpy as np
    from pathlib import Path
    from services.recording import Recorder
    from suturetrack.types import Stamp, StereoFrame
    from tests.conftest import make_rig
    run, limit = Path(sys.argv[1]), int(sys.argv[2])
    if limit:
        resource.setrlimit(resource.RLIMIT_FSIZE, (limit, limit))
    rng = np.random.default_rng(0)
    image = rng.integers(0, 256, (480, 640, 3), np.uint8)
    recorder = Recorder(
        run, "source", "full", make_rig(), patient=False, flush_seconds=0.2 if limit else 0.3
    )
    begin = time.monotonic()
    for i in range(10_000):
        recorder.frame(StereoFrame(Stamp(i, i, i), image, image))
        recorder.log(f"line {i}")
        print(i, time.monotonic() - begin, recorder.problem or "", flush=True)
        time.sleep(max(0.0, begin + (i + 1) / 30 - time.monotonic()))
"""


def writer(run: Path, limit: int = 0) -> subprocess.Popen[str]:
    """A process that records noise at 30 frames per second and tells what it has recorded."""
    command = [sys.executable, "-c", textwrap.dedent(WRITER), str(run), str(limit)]
    return subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)


LOW = """
    import os, sys, threading
    from pathlib import Path
    from services.recording import Recorder
    from tests.conftest import make_rig
    low = os.nice(10)
    with Recorder(Path(sys.argv[1]), "source", "light", make_rig()) as recorder:
        [thread] = [t for t in threading.enumerate() if t.name == "recording"]
        while (nice := os.getpriority(os.PRIO_PROCESS, thread.native_id)) == low:
            pass
        print(nice - low)
"""


@pytest.mark.skipif(sys.platform != "linux", reason="threads have no priorities of their own")
def test_recording_gives_way_to_a_process_of_low_priority_too(tmp_path: Path) -> None:
    command = [sys.executable, "-c", textwrap.dedent(LOW), str(tmp_path / "run")]
    assert subprocess.run(command, stdout=subprocess.PIPE, text=True, check=True).stdout == "5\n"


@pytest.mark.parametrize(
    "seconds", [3.7, *(pytest.param(0.3 + 0.21 * k, marks=pytest.mark.long) for k in range(20))]
)
def test_a_killed_process_loses_at_most_a_second(tmp_path: Path, seconds: float) -> None:
    process = writer(tmp_path)
    assert process.stdout is not None
    written: list[tuple[int, float]] = []
    for line in process.stdout:
        number, at = line.split()
        written.append((int(number), float(at)))
        if written[-1][1] > seconds:
            break
    os.kill(process.pid, signal.SIGKILL)
    for line in process.stdout:
        number, at = line.split()
        written.append((int(number), float(at)))
    process.communicate()
    folder = RunFolder(tmp_path)
    logged = sorted(r["frame"] for r in rows(folder, "/log/source"))
    assert logged == list(range(len(logged)))
    last = dict(written)[logged[-1]] if logged else 0.0
    assert written[-1][1] - last <= 1.0


ENDING = """
    import sys
    from pathlib import Path
    from services.service import ServiceConfig, run
    from suturetrack.types import Stamp
    from tests.conftest import make_rig

    def body(service):
        recorder = service.record(make_rig(), None)
        service.ready()
        for i in range(10_000):
            service.finished(Stamp(i, i, i))
            recorder.passed(Stamp(i, i, i), i)
            print(i, flush=True)
            if sys.argv[2] == "exception" and i == 40:
                raise RuntimeError("out of thread")
            if service.bus.stop.wait(0.01):
                return

    run("tracker", ServiceConfig(rig=sys.argv[3], run_dir=Path(sys.argv[1])), body)
"""


@pytest.mark.parametrize("end", ["SIGTERM", "SIGINT", "exception"])
def test_a_process_that_ends_in_order_loses_nothing(tmp_path: Path, end: str) -> None:
    command = [sys.executable, "-c", textwrap.dedent(ENDING), str(tmp_path), end, f"end-{end}"]
    process = subprocess.Popen(
        command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, bufsize=1
    )
    assert process.stdout is not None
    for line in process.stdout:
        if int(line) == 40 and end != "exception":
            process.send_signal(getattr(signal, end))
    last = int(line)
    process.communicate()
    assert last >= 40
    folder = RunFolder(tmp_path)
    assert folder.problems == []
    assert folder.handled("tracker") == set(range(last + 1))
    told = [r["TextLog:text"][0] for r in rows(folder, "/log/tracker")]
    assert told == (["tracker: RuntimeError: out of thread"] if end == "exception" else [])
    assert rows(folder, "/plots/rate_hz/tracker")


def test_a_full_disk_stops_the_recording_and_nothing_else(tmp_path: Path) -> None:
    process = writer(tmp_path, limit=40_000_000)
    assert process.stdout is not None
    after = 0
    for line in process.stdout:
        after += "disk is full" in line
        if after > 10:
            break
    assert process.poll() is None
    process.kill()
    _, errors = process.communicate()
    assert errors.count("recording stopped: the disk is full") == 1
    assert after > 10
    assert len(rows(RunFolder(tmp_path), "/log/source")) > 2


def test_recording_goes_on_while_a_reader_looks(
    tmp_path: Path, rig: StereoRig, curve: Nurbs
) -> None:
    with Recorder(tmp_path, "tracker", "light", rig, flush_seconds=0) as recorder:
        for i in range(20):
            recorder.states([make_state(curve, stamp=Stamp(i, i, i))])
        wait_until(lambda: len(RunFolder(tmp_path).states()) == 20, 10)
        recorder.states([make_state(curve, stamp=Stamp(20, 20, 20))])
    assert len(RunFolder(tmp_path).states()) == 21
