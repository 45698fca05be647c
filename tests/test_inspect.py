"""The figures of a run against runs whose figures are known."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest
from rich.console import Console

from services.course import Loss, losses
from services.inspect import InspectConfig, run
from services.messages import Health, Latency
from services.recording import Recorder
from services.report import show
from services.run_folder import RunFolder
from services.summary import RunSummary, summarize
from suturetrack import nurbs
from suturetrack.camera import StereoRig
from suturetrack.types import (
    Energies,
    Float64,
    Nurbs,
    Stamp,
    Status,
    StereoFrame,
    ThreadState,
    Truth,
)

T, HIDDEN, LOST = Status.TRACKING, Status.OCCLUDED, Status.LOST
DIGIT = 8
"""Height of a digit in a plot, px."""
COURSE = [T, T, T, HIDDEN, LOST, LOST, T, T, LOST, T]
"""Of frames 5, 7, 9, ..., 23 of a run of 30 frames."""


def record(run_dir: Path, rig: StereoRig, curve: Nurbs, shift_mm: float) -> None:
    """A run in which the curve is `shift_mm` behind the true thread in frame 11 and right elsewhere."""
    points = nurbs.evaluate(curve, np.linspace(0, 1, 500))
    behind = curve.control_points + np.array([0, 0, shift_mm])
    black = np.zeros((480, 640), np.uint8)
    with (
        Recorder(run_dir, "source", "light", rig) as source,
        Recorder(run_dir, "tracker", "light", rig) as tracker,
    ):
        for i in range(30):
            stamp = Stamp(i, i, 10**18)
            source.truth(Truth(stamp, "0", points, 200.0, np.ones(500, bool)))
            source.frame(StereoFrame(stamp, black, black), 10**18 + 1_000_000 * i)
        for k, status in enumerate(COURSE):
            stamp = Stamp(5 + 2 * k, 0, 10**18)
            moved = nurbs.curve_from(
                3, curve.knots, behind if stamp.frame == 11 else curve.control_points
            )
            state = ThreadState(
                *(stamp, "0", status, moved, 198.0 + 4 * (k % 2), Energies(-0.9, -0.1 * k, -1, 2)),
                *(np.full(9, 0.1), np.ones(9, bool)),
            )
            tracker.states([state], published_ns=10**18 + 20_000_000)
        health = Health("tracker", 0, stamp, 30, Latency(), 30, Latency(), 10, 15, 0, 321.0)
        tracker.health(health)


@pytest.fixture
def summary(tmp_path: Path, rig: StereoRig, curve: Nurbs) -> RunSummary:
    record(tmp_path, rig, curve, shift_mm=50.0)
    return summarize(RunFolder(tmp_path))


def test_processes(summary: RunSummary) -> None:
    source, tracker = summary.processes
    assert (source.name, source.frames) == ("source", 30)
    assert source.latency_ms.p50 == 14.5
    assert source.latency_ms.largest == 29.0
    assert (tracker.frames, tracker.latency_ms.p99) == (10, 20.0)
    assert (tracker.dropped, tracker.memory_mb) == (15, 321.0)


def test_a_thread_is_judged_over_all_frames_since_its_seed(summary: RunSummary) -> None:
    (thread,) = summary.threads
    assert (thread.first, thread.frames) == (5, 25)
    assert thread.shares == {T: 6 / 25, HIDDEN: 1 / 25, LOST: 3 / 25}
    assert thread.skipped_share == 15 / 25
    assert thread.losses == [Loss(13, 17), Loss(21, 23)]
    lengths = [198.0, 202.0, 198.0, 198.0, 202.0, 202.0]
    assert thread.length_mm.mean == pytest.approx(np.mean(lengths))
    assert thread.length_mm.sigma == pytest.approx(np.std(lengths))
    assert thread.length_error_percent == pytest.approx(0.0, abs=1e-9)
    assert thread.energies["image_right"].largest == 0.0


def test_errors_are_those_against_the_truth(summary: RunSummary) -> None:
    (thread,) = summary.threads
    assert thread.error_mm.p50 < 0.01
    assert 10 < thread.error_mm.largest <= 50  # occluded, 50 mm behind the truth
    assert thread.error_px.largest == pytest.approx(thread.error_mm.largest * 800 / 195, rel=0.2)
    assert thread.worst_frame == 11
    assert thread.wrong_share == 0.0


def test_the_report_prints_the_figures(summary: RunSummary) -> None:
    console = Console(record=True, width=120)
    show(summary, console)
    text = console.export_text()
    for words in ("sigma", "200.00", "24.0", "60.0", "thread 0 lost at frame 13 until frame 17"):
        assert words in text


def test_the_page_holds_plots_and_key_frames_and_needs_nothing_else(
    tmp_path: Path, rig: StereoRig, curve: Nurbs
) -> None:
    record(tmp_path, rig, curve, shift_mm=50.0)
    output = tmp_path / "run.html"
    run(InspectConfig(tmp_path, output))
    text = output.read_text()
    for plot in ("Length, mm", "Image energy", "Distance from the truth, mm", "Latency, ms"):
        assert f"<h3>{plot}" in text
    for moment in ("5: initialisation", "11: the worst frame", "13: lost", "21: lost"):
        assert f"Frame {moment}" in text
    assert text.count("<img alt='' src='data:image/jpeg;base64,") == 4
    for top, plot in re.findall(r"<svg viewBox='0 (\S+) (.*?)</svg>", text):
        baselines = [float(y) for y in re.findall(r"<text x='58' y='(\S+)'", plot)]
        assert min(baselines) - DIGIT >= float(top)
    outside = text.replace("data:image/jpeg", "").replace("http://www.w3.org", "")
    assert "http" not in outside
    assert "<script" not in text


def test_losses_before_the_first_sight_do_not_count() -> None:
    status = [LOST, LOST, T, LOST, LOST]
    assert losses([0, 1, 2, 3, 4], status) == [Loss(3, None)]


def test_states_that_were_written_while_the_run_was_read_are_frames_of_it(
    tmp_path: Path, rig: StereoRig, curve: Nurbs
) -> None:
    class Growing(RunFolder):
        """What is plotted was read when the run had hardly begun."""

        def series(self, *contents: str) -> dict[str, tuple[Float64, Float64]]:
            read = super().series(*contents)
            return {name: (x[:3], y[:3]) for name, (x, y) in read.items()}

    record(tmp_path, rig, curve, shift_mm=0.0)
    (thread,) = summarize(Growing(tmp_path)).threads
    assert thread.frames == 19
    assert sum(thread.shares.values()) + thread.skipped_share == pytest.approx(1.0)
