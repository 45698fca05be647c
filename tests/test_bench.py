"""The benchmarks' scoring: known errors come out as known figures, and nothing is left out."""

from __future__ import annotations

import json
import math
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from rich.console import Console

from services.bench import BenchConfig, footage, initialization, report, segmentation
from services.bench import run as bench
from services.bench.footage import FootageBench
from services.bench.initialization import InitializationBench
from services.bench.initialization import rows as initialization_rows
from services.bench.segmentation import SegmentationBench
from services.bench.spoils import SPOILS, Gripper
from services.bench.tracking import Case, FrameScore, TrackingBench, score, summarise
from services.bench.tracking import rows as tracking_rows
from services.sources import InputConfig
from suturetrack import metrics, nurbs
from suturetrack.camera import StereoRig
from suturetrack.polylines import polyline_distances
from suturetrack.stage import Picture
from suturetrack.types import Energies, InputError, Nurbs, Stamp, Status, ThreadState, Truth
from tests.conftest import make_rig, wait_until

STAMP = Stamp(0, 0, 0)
CASE = Case("figure8-175", 1, methods=("paper",))
GOOD = FrameScore(
    status=Status.TRACKING,
    energy=-0.9,
    true_length=175.0,
    limit=0.1,
    milliseconds=3.0,
    whole=True,
    rms=0.2,
    p95=0.4,
    largest=0.6,
    lateral=0.1,
    depth=0.17,
    length=175.35,
    ends=(0.5, 0.7),
    coverage=1.0,
)
LOST = replace(GOOD, status=Status.LOST)
WRONG = replace(GOOD, p95=2.1)


def state_of(curve: Nurbs | None, status: Status = Status.TRACKING) -> ThreadState:
    length = nurbs.length(curve) if curve is not None else math.nan
    none = np.zeros(0)
    return ThreadState(STAMP, "0", status, curve, length, Energies(-0.9), none, none > 0)


def truth_of(curve: Nurbs) -> Truth:
    points = nurbs.evaluate(curve, nurbs.evenly_spaced(curve, 800))
    return Truth(STAMP, "0", points, nurbs.length(curve), np.ones(800, bool))


def moved(curve: Nurbs, by: tuple[float, float, float]) -> Nurbs:
    return replace(curve, control_points=curve.control_points + np.array(by))


def test_a_curve_pushed_away_from_the_camera_is_wrong_in_depth(
    rig: StereoRig, curve: Nurbs
) -> None:
    line = nurbs.curve_from(1, np.array([0.0, 0, 1, 1]), np.array([[-30.0, 0, 200], [30, 0, 200]]))
    s = score(state_of(moved(line, (0, 0, 1))), truth_of(line), rig, 0.05, 2.0)
    assert s.rms == pytest.approx(1.0, rel=1e-3)
    assert s.depth == pytest.approx(1.0, rel=0.02)
    assert s.lateral < 0.15
    assert s.ends == pytest.approx((1, 1))
    assert score(state_of(curve), truth_of(curve), rig, 0.05, 2.0).rms < 1e-3


def test_distances_are_in_mm_whatever_the_calibrations_unit(curve: Nurbs) -> None:
    metres = replace(curve, control_points=curve.control_points / 1000)
    rig = make_rig(0.04, metres_per_unit=1.0)
    s = score(state_of(moved(metres, (0, 0.001, 0))), truth_of(metres), rig, 5e-5, 2.0)
    assert s.ends == pytest.approx((1, 1))
    assert s.length == pytest.approx(nurbs.length(curve))
    assert s.limit == pytest.approx(0.05)


def test_a_missing_half_costs_coverage_and_length(rig: StereoRig, curve: Nurbs) -> None:
    s = score(state_of(nurbs.part(curve, 0, 0.5)), truth_of(curve), rig, 0.05, 2.0)
    assert 0.3 < s.coverage < 0.7
    assert s.length < 0.7 * s.true_length
    assert s.largest > 20


def test_a_lost_thread_without_a_curve_covers_nothing(rig: StereoRig, curve: Nurbs) -> None:
    s = score(state_of(None, Status.LOST), truth_of(curve), rig, 0.05, 2.0)
    assert s.coverage == 0
    assert math.isnan(s.rms)


def test_every_frame_counts_and_wrong_ones_are_false_only_while_called_tracking() -> None:
    scores = (
        [GOOD] * 5 + [LOST] * 3 + [GOOD] * 4 + [WRONG] * 2 + [replace(WRONG, status=Status.LOST)]
    )
    row = summarise(CASE, "paper", "0", scores)
    assert row.frames == 15
    assert row.tracked_percent == pytest.approx(100 * 11 / 15)
    assert row.false_percent == pytest.approx(100 * 2 / 15)
    assert row.losses == 2
    assert math.isinf(row.longest_recovery_s)
    assert row.length_error_percent == pytest.approx(0.2)
    assert row.sigma == pytest.approx(0)
    assert row.limit_ratio == pytest.approx(2)


def test_a_thread_that_was_never_found_is_a_loss() -> None:
    row = summarise(CASE, "paper", "0", [replace(LOST, rms=math.nan, p95=math.nan)] * 4)
    assert (row.tracked_percent, row.false_percent, row.losses) == (0, 0, 1)


def test_the_time_to_recover_is_that_of_the_longest_loss() -> None:
    row = summarise(CASE, "paper", "0", [GOOD] + [LOST] * 3 + [GOOD] + [LOST] * 6 + [GOOD])
    assert (row.losses, row.longest_recovery_s) == (2, pytest.approx(0.2))


def test_the_physical_limit_grows_with_noise_and_distance(curve: Nurbs) -> None:
    points = truth_of(curve).points
    rig = make_rig()
    fine, coarse = (metrics.physical_limit(rig, points, noise) for noise in (0.05, 0.1))
    assert 1.3 * fine < coarse < 2.1 * fine
    farther = metrics.physical_limit(rig, points * 1.5, 0.05)
    assert farther > 1.2 * fine
    scaled = metrics.physical_limit(make_rig(0.04), points / 1000, 0.05)
    assert scaled == pytest.approx(fine / 1000, rel=1e-6)


def test_the_physical_limit_is_reached_by_the_best_estimate(rig: StereoRig) -> None:
    """Noise of 0.05 px along the normals of an upright thread, fitted over and over."""
    y = np.linspace(-40, 40, 400)
    points = np.c_[6 * np.sin(y / 8), y, np.full(400, 200.0)]
    along_u = np.c_[0.05 * np.hypot(1, 0.75 * np.cos(y / 8)), np.zeros(400)]
    knots = nurbs.clamped_knots(np.linspace(0, 1, 22)[1:-1], 3)
    rng = np.random.default_rng(0)
    left, right = rig.project(points)
    errors = []
    for _ in range(20):
        noisy = [p + rng.normal(0, 1, (400, 1)) * along_u for p in (left, right)]
        fitted = nurbs.fit(rig.triangulate(*noisy), np.linspace(0, 1, 400), knots, 3)
        curve = nurbs.evaluate(fitted, np.linspace(0, 1, 400))
        errors.append(polyline_distances(curve, points))
    achieved = float(np.sqrt(np.mean(np.square(errors))))
    assert 0.5 * achieved < metrics.physical_limit(rig, points, 0.05) < 1.1 * achieved


def test_an_unknown_scenario_gets_the_list() -> None:
    with pytest.raises(InputError, match="figure8-107"):
        next(tracking_rows(TrackingBench(scenarios=("nowhere",), seeds=1)))


@pytest.mark.parametrize("seeds", [0, -1])
def test_a_bench_without_seeds_is_refused(seeds: int) -> None:
    for rows in (
        lambda: next(tracking_rows(TrackingBench(seeds=seeds))),
        lambda: next(initialization_rows(InitializationBench(seeds=seeds))),
        lambda: segmentation.rows(SegmentationBench(seeds=seeds)),
    ):
        with pytest.raises(InputError, match=f"seeds {seeds}: use 1 or more"):
            rows()


def test_a_folder_without_pairs_is_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"no <name>/calibration\.yaml"):
        next(initialization_rows(InitializationBench(pairs=tmp_path)))


def test_first_curves_are_judged_by_their_order_however_they_are_filmed() -> None:
    picture = Picture(size=(480, 360), distortion=-0.2)
    config = InitializationBench(("figure8-107",), seeds=1, picture=picture)
    (row,) = initialization_rows(config)
    assert row.solved
    assert row.right
    assert row.in_order_percent > 95
    assert row.mean < 0.3


def test_first_curves_that_mislead_are_counted(monkeypatch: pytest.MonkeyPatch) -> None:
    """A curve that is right, one with an end off that says so, and one that does not."""
    config = InitializationBench(("figure8-107",), seeds=1)
    (row,) = initialization_rows(config)
    wrong = replace(row, right=False)
    three = [row, replace(wrong, confidence=0.2), replace(wrong, confidence=0.9)]
    monkeypatch.setattr(initialization, "rows", lambda _: iter(three))
    console = Console(width=400, record=True)
    initialization.run(config, console)
    assert "1 of 3 right" in (text := console.export_text())
    assert "1 of the others with a confidence of 0.5 or more" in text


def test_the_bench_shows_what_an_automatic_c_is_worth(monkeypatch: pytest.MonkeyPatch) -> None:
    options = ("ours", "ours, c = 10")
    monkeypatch.setattr(segmentation, "_OPTIONS", {o: segmentation._OPTIONS[o] for o in options})
    monkeypatch.setattr(segmentation, "_MOMENTS_S", (0, 1, 2))
    swings = segmentation._swings(SegmentationBench(("figure8-107",), seeds=1))
    ours, fixed = (swings[o] for o in options)
    assert 0 < ours.flicker_percent < fixed.flicker_percent
    assert 0.3 < ours.least_strength <= ours.strength < 1


def test_rows_are_printed_and_written_whole(tmp_path: Path) -> None:
    rows = [summarise(CASE, "paper", str(i), [GOOD] * 3) for i in range(30)]
    console = Console(width=400, record=True)
    report.print_rows(console, "Tracking", rows)
    assert console.export_text().count("figure8-175") == 30
    report.write_json(tmp_path / "rows.json", {"tracking": rows})
    content = json.loads((tmp_path / "rows.json").read_text())
    assert len(content["tracking"]) == 30
    assert content["tracking"][7]["length"] == pytest.approx(175.35)
    plots = {"tracking": (report.Plot("rms", "scenario"),)}
    report.write_page(tmp_path / "rows.html", "Figures", {"tracking": rows}, plots)
    page = (tmp_path / "rows.html").read_text()
    assert page.count("<tr>") == 31
    assert "data:image/png;base64," in page
    assert "http" not in page
    gone = tmp_path / "none" / "rows"
    for write in (
        lambda: report.write_json(gone, {"tracking": rows}),
        lambda: report.write_page(gone, "Figures", {"tracking": rows}, {}),
    ):
        with pytest.raises(InputError, match="cannot write"):
            write()


@pytest.mark.parametrize("path", [".", "none/rows"])
@pytest.mark.parametrize("option", ["json", "page"])
def test_what_cannot_be_written_is_said_before_the_work(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, option: str, path: str
) -> None:
    monkeypatch.setattr("services.bench.tracking.run", lambda *_: pytest.fail("it began"))
    with pytest.raises(InputError, match="cannot write"):
        bench(BenchConfig(TrackingBench(), **{option: tmp_path / path}))


def test_workers_end_with_a_killed_benchmark() -> None:
    words = ["bench", "tracking", "--scenarios", "fast", "--seeds", "2"]
    bench = subprocess.Popen(
        [sys.executable, "-m", "services.cli", *words], stdout=subprocess.DEVNULL
    )
    children = Path(f"/proc/{bench.pid}/task/{bench.pid}/children")
    # Two workers and multiprocessing's resource tracker.
    wait_until(lambda: len(children.read_text().split()) == 3, 60)
    workers = [Path("/proc") / pid / "stat" for pid in children.read_text().split()]
    bench.kill()
    bench.wait()
    wait_until(lambda: not any(runs(stat) for stat in workers))


def runs(stat: Path) -> bool:
    try:
        return stat.read_text().rpartition(")")[2].split()[0] != "Z"
    except OSError:
        return False


FOOTAGE = FootageBench(
    InputConfig("stage:figure8-175", frames=8), spoils=("nothing", "noise", "backwards")
)


def test_spoiled_footage_is_judged_by_the_footage_as_it_is() -> None:
    table = footage.run(FOOTAGE, Console(quiet=True))
    assert [row.spoil for row in table] == ["nothing", "noise", "backwards"]
    for row in table:
        assert row.frames == 8
        assert row.tracked_percent == row.right_percent == 100
        assert row.false_percent == 0
        assert row.mean_px < 0.3
        assert row.largest_px < 2
    assert table[1].mean_px > 0


def test_a_curve_elsewhere_is_false() -> None:
    table = footage.run(
        replace(FOOTAGE, spoils=("noise",), false_beyond_px=1e-6), Console(quiet=True)
    )
    assert table[0].false_percent == table[0].tracked_percent == 100
    assert table[0].right_percent == 0


@pytest.mark.parametrize(
    ("change", "told"),
    [
        ({"spoils": ("rain",)}, "no spoil 'rain'; there are nothing, noise"),
        ({"seeds": 0}, "seeds 0"),
        ({"workers": 0}, "workers 0"),
        ({"input": InputConfig("stage:figure8-175", loop=5)}, "use footage with an end"),
        ({"seed": (5.0, 5.0)}, "nothing is tracked in the footage as it is"),
    ],
)
def test_footage_that_cannot_be_judged_is_refused(change: dict[str, object], told: str) -> None:
    with pytest.raises(InputError, match=told):
        footage.run(replace(FOOTAGE, **change), Console(quiet=True))  # type: ignore[arg-type]


def test_frames_of_which_none_can_be_judged_are_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    curves = [None, np.zeros((200, 3)), None, None]
    monkeypatch.setattr(footage, "_as_it_is", lambda _: iter(curves))
    with pytest.raises(InputError, match="nothing is tracked"):
        footage.run(replace(FOOTAGE, spoils=("every-third",)), Console(quiet=True))


@pytest.mark.parametrize("shape", [(480, 640, 3), (480, 640)])
def test_spoils_change_images_and_keep_what_they_are(shape: tuple[int, ...]) -> None:
    image = np.random.default_rng(0).integers(0, 256, shape, np.uint8)
    draw = np.array([0.2, 0.4, 0.6, 0.8])
    for name, spoil in SPOILS.items():
        if spoil.image is None:
            continue
        made = spoil.image(image, 0.5, draw)
        assert made.dtype == np.uint8
        assert made.shape == (shape[:2] if name == "gray" else shape)
        if name != "gray" or len(shape) == 3:
            assert not np.array_equal(made, image)


def test_the_gripper_covers_what_it_is_said_to_hide() -> None:
    rig = make_rig()
    thread = np.linspace([-40.0, 0.0, 200.0], [40.0, 10.0, 200.0], 400)
    empty = np.full((480, 640), 255, np.uint8)
    gripper = Gripper(rig, np.array([0.1, 0.2, 0.3, 0.9]))
    left, right = gripper.over((empty, empty), thread, 0.0)
    hidden = gripper.hides((empty, empty), thread, 0.0)
    assert 0.02 < hidden.mean() < 0.5
    pixels = [np.rint(view).astype(int).T for view in rig.project_raw(thread)]
    covered = (left[pixels[0][1], pixels[0][0]] < 250) | (right[pixels[1][1], pixels[1][0]] < 250)
    assert (covered == hidden).mean() > 0.95
