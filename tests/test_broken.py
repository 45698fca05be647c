"""Broken and foreign recordings: whatever can be read is read, and the rest is said in one line."""

from __future__ import annotations

import shutil
import struct
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import rerun as rr

from services.arguments import write_config
from services.compare import CompareConfig
from services.compare import run as compare
from services.export import ExportConfig
from services.export import run as export
from services.inspect import InspectConfig
from services.inspect import run as inspect
from services.recording import Recorder
from services.replay import Parameters, ReplayConfig
from services.replay import run as replay
from services.run_folder import RunFolder
from services.view import files
from suturetrack import nurbs
from suturetrack.camera import StereoRig
from suturetrack.types import (
    Energies,
    InputError,
    Nurbs,
    RidgeField,
    Seed,
    Stamp,
    Status,
    StereoFrame,
    ThreadState,
    Truth,
)

FRAMES = 6
NAMES = ("source.rrd", "segmenter.rrd", "tracker.rrd")


@pytest.fixture
def whole(tmp_path: Path, rig: StereoRig, curve: Nurbs) -> Path:
    """A run of which every file could be the next to break."""
    folder = tmp_path / "whole"
    rng = np.random.default_rng(0)
    points = nurbs.evaluate(curve, np.linspace(0, 1, 50))
    bits = np.full(9, 0.1), np.ones(9, bool)
    with (
        Recorder(folder, "source", "light", rig, flush_seconds=0) as source,
        Recorder(folder, "segmenter", "light", rig, flush_seconds=0) as segmenter,
        Recorder(folder, "tracker", "light", rig, flush_seconds=0) as tracker,
    ):
        for i in range(FRAMES):
            stamp = Stamp(i, 33_000_000 * i, 10**18)
            images = rng.integers(0, 256, (2, 480, 640, 3), np.uint8)
            source.frame(StereoFrame(stamp, *images))
            source.truth(Truth(stamp, "0", points, 200.0, np.ones(50, bool)))
            segmenter.field(RidgeField(stamp, *np.zeros((2, 480, 640, 2), np.float32)))
            tracker.request(stamp, Seed("0", pixel=(3.0, 4.0)))
            energies = Energies(-0.9, -0.9, -1, 2)
            state = ThreadState(stamp, "0", Status.TRACKING, curve, 200.0, energies, *bits)
            tracker.states([state])
    write_config(Parameters(), folder / "config.toml")
    return folder


def readers(whole: Path, broken: Path, new: Path) -> dict[str, Callable[[], object]]:
    """Everything that reads a run."""
    return {
        "inspect": lambda: inspect(InspectConfig(broken, new.with_suffix(".html"))),
        "compare": lambda: compare(CompareConfig((broken, whole))),
        "compare the other way": lambda: compare(CompareConfig((whole, broken))),
        "export": lambda: export(ExportConfig(broken, new.with_suffix(".jsonl"))),
        "replay": lambda: replay(ReplayConfig(broken, new, "tracker")),
        "view": lambda: files(RunFolder(broken)),
    }


def outcomes(whole: Path, broken: Path, new: Path) -> dict[str, str]:
    """What each of them says: "" for done, else one line."""
    said = {}
    for name, read in readers(whole, broken, new).items():
        try:
            read()
        except InputError as error:
            said[name] = str(error)
            assert said[name]
            assert "\n" not in said[name]
        else:
            said[name] = ""
    return said


@pytest.mark.parametrize("name", NAMES)
def test_a_file_cut_anywhere_is_read_as_far_as_it_goes(
    tmp_path: Path, whole: Path, name: str
) -> None:
    size = (whole / name).stat().st_size
    rows = len(list(RunFolder(whole).rows("/**")))
    rng = np.random.default_rng(len(name))
    kept = []
    for cut in (0, 40, *sorted(rng.integers(100, size, 4).tolist()), size - 1):
        broken = tmp_path / f"cut-{cut}"
        shutil.copytree(whole, broken)
        (broken / name).write_bytes((whole / name).read_bytes()[:cut])
        said = outcomes(whole, broken, tmp_path / f"new-{cut}")
        for verb in ("inspect", "compare", "view"):
            assert said[verb] == "", (cut, verb)
        folder = RunFolder(broken)
        # Cut between two messages, or in the 16 bytes that open one, a file shows no damage.
        if not any(problem.startswith(name) for problem in folder.problems):
            assert len(list(folder.rows("/**"))) < rows
        kept.append(len(folder.handled(name.removesuffix(".rrd"))))
    assert kept == sorted(kept)
    assert kept[0] == 0
    assert kept[-1] >= FRAMES - 1
    assert len(set(kept)) > 1


def damaged(content: bytes) -> bytes:
    """A recording whose largest message is nonsense in its second half, and whole around it."""
    messages, at = [], 12
    while at + 16 <= len(content):
        size = struct.unpack_from("<8xQ", content, at)[0]
        messages.append((size, at + 16))
        at += 16 + size
    size, at = max(messages)
    return content[: at + size // 2] + b"\xff" * (size - size // 2) + content[at + size :]


def test_a_file_that_is_damaged_inside_is_named(tmp_path: Path, whole: Path) -> None:
    broken = tmp_path / "broken"
    shutil.copytree(whole, broken)
    (broken / "tracker.rrd").write_bytes(damaged((whole / "tracker.rrd").read_bytes()))
    said = outcomes(whole, broken, tmp_path / "new")
    del said["view"]
    for line in said.values():
        assert "tracker.rrd is damaged (" in line
        assert line.endswith("; move it out of the folder to have the rest read")


def test_folders_without_a_recording_are_named(tmp_path: Path, whole: Path) -> None:
    empty = tmp_path / "empty"
    empty.mkdir()
    for folder, words in ((tmp_path / "none", "no run folder"), (empty, "no recordings")):
        for said in outcomes(whole, folder, tmp_path / "new").values():
            assert words in said
    for name in NAMES:
        (empty / name).write_bytes(b"not a recording at all " * 99)
    for said in outcomes(whole, empty, tmp_path / "new").values():
        assert "no recording can be read" in said


@pytest.mark.parametrize("kept", NAMES)
def test_one_process_alone_is_read(
    tmp_path: Path, whole: Path, kept: str, capsys: pytest.CaptureFixture[str]
) -> None:
    alone = tmp_path / "alone"
    alone.mkdir()
    shutil.copy(whole / kept, alone)
    said = outcomes(whole, alone, tmp_path / "new")
    assert [said[name] for name in ("inspect", "compare", "view")] == ["", "", ""]
    assert ("no states" in said["export"]) == (kept != "tracker.rrd")
    shown = capsys.readouterr()
    for words in (shown.out, shown.err):
        assert ("no recording of the tracker is here" in words) == (kept != "tracker.rrd")
    assert "no thread was seeded" not in shown.out


def test_a_foreign_recording_is_left_alone(
    tmp_path: Path, whole: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    stream = rr.RecordingStream("another_program")
    stream.set_sinks(rr.FileSink(str(whole / "other.rrd")))
    stream.set_time("frame", sequence=1)
    stream.log("/rig/thread/0/nurbs", rr.Scalars(1.0))
    stream.disconnect()
    said = outcomes(whole, whole, tmp_path / "new")
    assert {name: said[name] for name in said if name != "replay"} == dict.fromkeys(
        (name for name in said if name != "replay"), ""
    )
    assert "needs full" in said["replay"]
    assert "other.rrd is a recording of another_program" in capsys.readouterr().out


def test_a_run_of_the_future_is_read_as_far_as_it_can_be(
    tmp_path: Path,
    whole: Path,
    rig: StereoRig,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    """States of which this version knows nothing but the name are left out, and said to be."""
    monkeypatch.setattr("services.run_file.RECORDING_VERSION", 7)
    future = tmp_path / "future"
    with Recorder(future, "tracker", "light", rig) as recorder:
        recorder.log("hello")
    monkeypatch.undo()
    stream = rr.RecordingStream("suturetrack", recording_id="future")
    stream.set_sinks(rr.FileSink(str(future / "tracker.1.rrd")))
    stream.set_time("frame", sequence=1)
    for entity in ("/rig/thread/0/nurbs", "/rig/truth/0", "/run/tracker/request"):
        stream.log(entity, rr.DynamicArchetype("ThreadState", components={"splines": [1, 2]}))
    stream.disconnect()
    said = outcomes(whole, future, tmp_path / "new")
    assert [said[name] for name in ("inspect", "compare", "view")] == ["", "", ""]
    assert "no states" in said["export"]
    assert "recorded by a newer suturetrack (version 7" in capsys.readouterr().out
