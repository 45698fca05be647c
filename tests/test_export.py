"""The export says what was recorded, from whole and from broken recordings."""

from __future__ import annotations

import csv
import json
import shutil
import subprocess
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import rerun as rr

from services.export import ExportConfig, run
from services.recording import Recorder
from services.run_folder import rerun_program
from suturetrack import nurbs
from suturetrack.camera import StereoRig
from suturetrack.types import Energies, InputError, Nurbs, Stamp, Status, ThreadState

MS = 1_000_000


def make_state(curve: Nurbs | None, frame: int, thread: str = "0") -> ThreadState:
    """A state whose numbers depend on the frame."""
    count = 0 if curve is None else 50
    return ThreadState(
        stamp=Stamp(frame, 1000 + 33 * MS * frame, 7_000 + 34 * MS * frame),
        thread=thread,
        status=Status.LOST if curve is None else list(Status)[frame % 3],
        curve=curve,
        length=np.nan if curve is None else nurbs.length(curve) + frame / 7,
        energies=Energies() if curve is None else Energies(-0.9, -1 / 3, -1.7, 0.1 * frame),
        sigma=np.linspace(0.1, 0.3, count),
        seen=np.arange(count) % 7 < 5,
        events=("found",) if frame == 3 else (),
    )


def record(run_dir: Path, rig: StereoRig, states: list[ThreadState]) -> None:
    """Records states that were published 12.5 ms after their frames were released."""
    with Recorder(run_dir, "tracker", "light", rig) as recorder:
        for state in states:
            recorder.states([state], published_ns=state.stamp.released_ns + 12_500_000)


def exported(run_dir: Path) -> list[dict[str, Any]]:
    output = run_dir / "states.jsonl"
    run(ExportConfig(run_dir, output))
    return [json.loads(line) for line in output.read_text().splitlines()]


def test_every_state_comes_out_to_the_bit(tmp_path: Path, rig: StereoRig, curve: Nurbs) -> None:
    states = [make_state(None if i < 3 else curve, i) for i in range(20)]
    record(tmp_path, rig, states)
    lines = exported(tmp_path)
    assert [line["frame"] for line in lines] == list(range(20))
    assert list(lines[0]) == [
        *("frame", "capture_time_ns", "thread", "status", "degree", "knots", "control_points"),
        *("length", "energy", "latency_ms"),
    ]
    for line, state in zip(lines, states, strict=True):
        assert line["capture_time_ns"] == state.stamp.capture_ns
        assert (line["thread"], line["status"]) == ("0", str(state.status))
        assert line["latency_ms"] == 12.5
        if state.curve is None:
            assert (line["degree"], line["knots"], line["control_points"]) == (None, [], [])
            assert line["length"] is None
            continue
        assert line["degree"] == 3
        assert np.array_equal(line["knots"], curve.knots)
        assert np.array_equal(line["control_points"], curve.control_points)
        assert line["length"] == state.length
        assert line["energy"] == {"image_left": -0.9, "image_right": -1 / 3, "end": -1.7}


def test_threads_and_parts_are_merged_in_order(
    tmp_path: Path, rig: StereoRig, curve: Nurbs
) -> None:
    for first in (0, 10):  # a tracker that was started again writes a further part
        with Recorder(tmp_path, "tracker", "light", rig) as recorder:
            for i in range(first, first + 10):
                recorder.states([make_state(curve, i, name) for name in ("b", "a/0")])
    assert sorted(p.name for p in tmp_path.glob("*.rrd")) == ["tracker.1.rrd", "tracker.rrd"]
    lines = exported(tmp_path)
    assert [(x["frame"], x["thread"]) for x in lines] == [
        (i, name) for i in range(20) for name in ("a/0", "b")
    ]


def test_a_copy_and_a_merged_file_in_the_folder_add_nothing(
    tmp_path: Path, rig: StereoRig, curve: Nurbs
) -> None:
    record(tmp_path, rig, [make_state(curve, i) for i in range(20)])
    shutil.copy(tmp_path / "tracker.rrd", tmp_path / "tracker (copy).rrd")
    merge = [rerun_program(), "rrd", "merge", tmp_path / "tracker.rrd", "-o", tmp_path / "all.rrd"]
    subprocess.run(merge, check=True, capture_output=True)
    assert [line["frame"] for line in exported(tmp_path)] == list(range(20))


def test_a_name_with_an_unknown_ending_is_refused_and_not_written(
    tmp_path: Path, rig: StereoRig, curve: Nurbs
) -> None:
    record(tmp_path, rig, [make_state(curve, 0)])
    other = tmp_path / "states.xml"
    with pytest.raises(InputError, match=r"states\.xml: the name must end in \.jsonl or \.csv, or"):
        run(ExportConfig(tmp_path, other))
    assert not other.exists()
    for config in (ExportConfig(tmp_path, other, "jsonl"), ExportConfig(tmp_path, tmp_path / "a")):
        run(config)
        assert config.output is not None
        assert json.loads(config.output.read_text().splitlines()[0])["frame"] == 0


def test_csv_holds_the_same_numbers(tmp_path: Path, rig: StereoRig, curve: Nurbs) -> None:
    record(tmp_path, rig, [make_state(curve, i) for i in range(4)])
    run(ExportConfig(tmp_path, tmp_path / "states.csv"))
    with (tmp_path / "states.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert len(rows) == 4
    numbers = np.array(rows[2]["control_points"].split(), float).reshape(-1, 3)
    assert np.array_equal(numbers, curve.control_points)
    assert float(rows[2]["length"]) == make_state(curve, 2).length
    assert float(rows[2]["energy_image_right"]) == -1 / 3


@pytest.mark.parametrize("share", [0.5, 0.9])
def test_a_recording_that_is_cut_off_is_read_up_to_there(
    tmp_path: Path, rig: StereoRig, curve: Nurbs, share: float, capsys: pytest.CaptureFixture[str]
) -> None:
    rng = np.random.default_rng(0)
    file = tmp_path / "tracker.rrd"
    with Recorder(tmp_path, "tracker", "light", rig, flush_seconds=0) as recorder:
        for i in range(200):
            noise = rng.normal(0, 1, curve.control_points.shape)
            bent = nurbs.curve_from(3, curve.knots, curve.control_points + noise)
            recorder.states([make_state(bent, i)])
        unfinished = file.read_bytes()
    said = []
    # One of the two places is not where a message ends, which a file may well do.
    for place in (int(share * len(unfinished)), int(share * len(unfinished)) - 100):
        file.write_bytes(unfinished[:place])
        frames = [line["frame"] for line in exported(tmp_path)]
        assert frames == list(range(len(frames)))
        assert 0.5 * share < len(frames) / 200 < 1
        said.append("tracker.rrd is cut off" in capsys.readouterr().err)
    assert any(said)


def test_what_cannot_be_exported_is_said_in_one_line(tmp_path: Path, rig: StereoRig) -> None:
    def message(run_dir: Path) -> str:
        with pytest.raises(InputError) as caught:
            run(ExportConfig(run_dir, tmp_path / "out.jsonl"))
        assert "\n" not in str(caught.value)
        return str(caught.value)

    assert "no run folder" in message(tmp_path / "nothing")
    assert "no recordings" in message(tmp_path)
    (tmp_path / "tracker.rrd").write_bytes(b"something else entirely" * 100)
    assert "tracker.rrd is no recording" in message(tmp_path)
    Recorder(tmp_path, "source", "light", rig).close()
    assert "no states were recorded" in message(tmp_path)
    assert not (tmp_path / "out.jsonl").exists()


def test_an_output_that_cannot_be_written_is_named(
    tmp_path: Path, rig: StereoRig, curve: Nurbs
) -> None:
    record(tmp_path, rig, [make_state(curve, 0)])
    with pytest.raises(InputError, match="cannot write"):
        run(ExportConfig(tmp_path, tmp_path / "missing" / "states.jsonl"))


def test_recordings_of_others_and_of_the_future_are_named(
    tmp_path: Path,
    rig: StereoRig,
    curve: Nurbs,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.setattr("services.run_file.RECORDING_VERSION", 7)
    record(tmp_path, rig, [make_state(curve, i) for i in range(3)])
    stream = rr.RecordingStream("another_program")
    stream.set_sinks(rr.FileSink(str(tmp_path / "other.rrd")))
    stream.log("x", rr.Scalars(1.0))
    stream.disconnect()
    assert len(exported(tmp_path)) == 3
    said = capsys.readouterr().err
    assert "other.rrd is a recording of another_program" in said
    assert "recorded by a newer suturetrack (version 7" in said
