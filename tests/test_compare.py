"""Runs side by side: what differs is told, what is equal is equal."""

from __future__ import annotations

import csv
from pathlib import Path

import numpy as np
import pytest

from services.compare import CompareConfig, run
from services.inspect import InspectConfig
from services.inspect import run as inspect
from services.recording import Recorder
from suturetrack import nurbs
from suturetrack.camera import StereoRig
from suturetrack.types import Energies, InputError, Nurbs, Stamp, Status, ThreadState


def record(run_dir: Path, rig: StereoRig, curve: Nurbs, shift_mm: float, lost: int = 0) -> None:
    """Twenty frames; the curve moves away by `shift_mm` in frame 12, and is lost in the last ones."""
    away = nurbs.curve_from(3, curve.knots, curve.control_points + np.array([0, 0, shift_mm]))
    with Recorder(run_dir, "tracker", "light", rig) as recorder:
        for i in range(20):
            status = Status.LOST if i >= 20 - lost else Status.TRACKING
            bits = np.full(9, 0.1), np.ones(9, bool)
            shape = away if i == 12 else curve
            stamp, energies = Stamp(i, i, 10**18), Energies(-0.9, -0.9, -1, 2)
            state = ThreadState(stamp, "0", status, shape, 200.0, energies, *bits)
            recorder.states([state], published_ns=10**18 + 1)


@pytest.fixture
def runs(tmp_path: Path, rig: StereoRig, curve: Nurbs) -> tuple[Path, Path, Path]:
    for name, shift_mm, lost in (("first", 0.0, 0), ("moved", 2.0, 0), ("lost", 0.0, 5)):
        record(tmp_path / name, rig, curve, shift_mm, lost)
    return tmp_path / "first", tmp_path / "moved", tmp_path / "lost"


def test_equal_runs_pass_the_strictest_check(
    tmp_path: Path, runs: tuple[Path, Path, Path], capsys: pytest.CaptureFixture[str]
) -> None:
    run(CompareConfig((runs[0], runs[0]), tolerance_mm=0.0, tolerance_tracking=0.0))
    distances = next(x for x in capsys.readouterr().out.splitlines() if " 0.000 " in x)
    assert distances.split()[:5] == ["run", "2", "0", "20", "20"]


def test_a_moved_curve_is_measured_and_fails_its_tolerance(
    tmp_path: Path, runs: tuple[Path, Path, Path]
) -> None:
    table = tmp_path / "distances.csv"
    run(CompareConfig(runs[:2], tolerance_mm=2.1, output=table))
    with table.open() as file:
        mm = [float(line["distance_mm"]) for line in csv.DictReader(file)]
    assert len(mm) == 20
    assert 0.5 < mm.pop(12) <= 2.0
    assert max(mm) == 0.0
    with pytest.raises(SystemExit, match=r"moved: thread 0 is up to [\d.]+ mm from first"):
        run(CompareConfig(runs[:2], tolerance_mm=0.4))


def test_fewer_tracked_frames_fail_their_tolerance(runs: tuple[Path, Path, Path]) -> None:
    run(CompareConfig((runs[0], runs[2]), tolerance_tracking=26.0))
    with pytest.raises(SystemExit, match=r"lost: thread 0 is tracked in 75\.0 % .* not 100\.0 %"):
        run(CompareConfig((runs[0], runs[2]), tolerance_tracking=24.0))


@pytest.mark.parametrize("option", ["tolerance_mm", "tolerance_tracking"])
@pytest.mark.parametrize("tolerance", [float("nan"), float("inf"), -1.0])
def test_a_tolerance_that_is_none_is_refused(option: str, tolerance: float) -> None:
    words = f"{option.replace('_', '-')} {tolerance:g}: use a number of 0 or more"
    with pytest.raises(InputError, match=words):
        run(CompareConfig((Path("first"), Path("other")), **{option: tolerance}))


def test_one_run_is_nothing_to_compare(runs: tuple[Path, Path, Path]) -> None:
    with pytest.raises(InputError, match="two or more"):
        run(CompareConfig(runs[:1]))


def test_a_thread_that_a_run_lacks_fails_the_check(
    tmp_path: Path, runs: tuple[Path, Path, Path], rig: StereoRig
) -> None:
    with Recorder(tmp_path / "empty", "tracker", "light", rig) as recorder:
        recorder.states([], published_ns=10**18)
    run(CompareConfig((runs[0], tmp_path / "empty")))
    with pytest.raises(SystemExit, match=r"empty: thread 0 has no curve at the frames of first"):
        run(CompareConfig((runs[0], tmp_path / "empty"), tolerance_mm=1.0))
    with pytest.raises(SystemExit, match="empty: no thread was seeded"):
        run(CompareConfig((tmp_path / "empty", runs[0]), tolerance_tracking=5.0))


def test_runs_of_one_name_in_different_folders_are_told_apart(
    tmp_path: Path, rig: StereoRig, curve: Nurbs, capsys: pytest.CaptureFixture[str]
) -> None:
    folders = tuple(tmp_path / name / "[/run]" for name in ("first", "empty", "equal"))
    for folder in (folders[0], folders[2]):
        record(folder, rig, curve, 0.0)
    with Recorder(folders[1], "tracker", "light", rig) as recorder:
        recorder.states([], published_ns=10**18)
    with pytest.raises(SystemExit, match=r"empty/\[/run\]: thread 0 has no curve") as caught:
        run(CompareConfig(folders, tolerance_mm=1.0))
    assert "equal/" not in str(caught.value)
    shown = capsys.readouterr().out
    assert all(f" {folder} " in shown for folder in folders)


def test_a_recording_that_is_cut_is_not_taken_for_a_run_without_a_thread(
    runs: tuple[Path, Path, Path], rig: StereoRig, capsys: pytest.CaptureFixture[str]
) -> None:
    whole, cut, _ = runs
    with Recorder(cut, "segmenter", "light", rig):
        pass
    with (cut / "tracker.rrd").open("r+b") as file:
        file.truncate(1000)
    inspect(InspectConfig(cut))
    assert "no thread in what can be read" in capsys.readouterr().out
    with pytest.raises(SystemExit, match="moved: no thread in what can be read"):
        run(CompareConfig((cut, whole), tolerance_mm=1.0))
    assert "run 1: tracker.rrd is " in capsys.readouterr().out
