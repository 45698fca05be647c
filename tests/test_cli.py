from __future__ import annotations

import os
import signal
import subprocess
import sys
import tomllib
from collections.abc import Callable
from importlib import metadata
from pathlib import Path
from typing import Any

import pytest
import tyro

from services import arguments, cli
from services.launch import RunConfig
from services.ros2_graph import RosConfig
from services.segmenter import SegmenterConfig
from services.service import ServiceConfig, SharedConfig
from services.source import SourceConfig
from services.sources import InputConfig
from services.tracker import TrackerConfig
from suturetrack.calibration import save_calibration
from suturetrack.initialization import InitializationConfig
from suturetrack.segmentation import SegmentationConfig
from suturetrack.stage import open_scene
from suturetrack.tracking import TrackingConfig

STAGE = "stage:figure8-107"
Call = Callable[..., tuple[int, str]]


@pytest.fixture
def call(capsys: pytest.CaptureFixture[str], rig_name: str) -> Call:
    """Runs a verb in this process; its exit status and what it wrote to stderr."""
    del rig_name

    def run(*words: object) -> tuple[int, str]:
        try:
            status = cli.call([str(word) for word in words])
        except SystemExit as ended:
            status = int(ended.code or 0)
        return status, capsys.readouterr().err

    return run


@pytest.fixture
def calibration(tmp_path: Path) -> Path:
    save_calibration(tmp_path / "calibration.yaml", open_scene("figure8-107").rig)
    return tmp_path / "calibration.yaml"


def complaint(answer: tuple[int, str]) -> str:
    """The one line on stderr of a verb that ended with status 1."""
    status, err = answer
    assert status == 1
    assert err.count("\n") == 1, err
    return err


def test_without_a_verb_all_are_listed(capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.call([]) == 0
    out = capsys.readouterr().out
    assert all(f"\n  {verb} " in out for verb in cli.VERBS)


def test_it_tells_its_version(capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.call(["--version"]) == 0
    assert capsys.readouterr().out == f"suturetrack {metadata.version('suturetrack')}\n"


def test_an_unknown_verb_gets_the_list(call: Call) -> None:
    status, err = call("trak")
    assert status == 2
    assert "'trak'" in err
    assert "tracker" in err


@pytest.mark.parametrize("verb", ["demo", "run", "source", "segmenter", "tracker"])
def test_the_options_are_explained(verb: str, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as ended:
        cli.call([verb, "--help"])
    assert ended.value.code == 0
    out = capsys.readouterr().out
    assert "--rig" in out
    assert "Name of the rig; keeps several apart." in out


def test_run_without_a_source_is_a_wrong_call(call: Call) -> None:
    status, err = call("run")
    assert status == 2
    assert "--source" in err


@pytest.mark.parametrize(
    "words",
    [
        ["run", "--source", "film-\udcff.mkv"],
        ["run", "--source", STAGE, "--run-dir", "run-\udcff"],
        ["calibration", "check", "rig-\udcff.yaml"],
        ["\udcff"],
    ],
)
def test_a_name_that_is_not_utf_8_is_refused_in_one_line(call: Call, words: list[str]) -> None:
    status, err = call(*words)
    assert status == 2
    assert err.startswith("suturetrack: '")
    assert "\\udcff" in err
    assert err.endswith("' is not UTF-8; give files and folders names that are\n")


@pytest.mark.parametrize("columns", ["40", "200"])
@pytest.mark.parametrize(
    ("words", "reason"),
    [
        ("run --sorce x", "missing --source STR; unrecognized options: --sorce x; see"),
        ("run --source x --fps abc", "could not convert string to float: 'abc'; use --fps FLOAT;"),
        ("run --source", "missing value for argument '--source'"),
        ("seed 3", "no type matching {FLOAT FLOAT} could be instantiated from ['3'];"),
        ("inspect", "missing PATH (The run's folder); see"),
        ("bench trackin", "available subcommands: tracking, initialization"),
        ("bench tracking --seds 3", "perhaps you meant: --seeds INT"),
        ("replay r --from source", "Expected one of ('segmenter', 'tracker'); see"),
    ],
)
def test_a_wrong_call_gets_one_line_with_what_would_be_right(
    call: Call, monkeypatch: pytest.MonkeyPatch, columns: str, words: str, reason: str
) -> None:
    monkeypatch.setenv("COLUMNS", columns)
    status, err = call(*words.split())
    verb = words.split()[0]
    assert status == 2
    assert err.count("\n") == 1
    assert err.startswith(f"suturetrack {verb}: ")
    assert reason in err
    assert err.endswith(f"; see `suturetrack {verb} --help`\n")


@pytest.mark.parametrize(
    ("options", "reason"),
    [
        (["--source", "/nowhere/video.mkv"], "no such file or folder"),
        (["--source", "a,b,c"], "at most two"),
        (["--source", "99"], "camera 99"),
        (["--source", "stage:figure9"], "no scenario 'figure9'; use one of figure8-107"),
        (["--source", STAGE, "--scene-rig", "microscope"], "bench, endoscope"),
        (["--source", STAGE, "--scene-seed", "-1"], "seed -1"),
        (["--source", STAGE, "--fps", "0"], "fps 0"),
        (["--source", STAGE, "--frames", "0"], "frames 0"),
        (["--source", STAGE, "--seed", "900", "3"], "outside the 640x480 left image"),
        (["--source", STAGE, "--rig", "a/b"], "rig 'a/b'"),
        (["--source", STAGE, "--zenoh", "/nowhere.json5"], "no file /nowhere.json5"),
        (["--source", STAGE, "--calibration", "/nowhere.yaml"], "no file /nowhere.yaml"),
    ],
)
def test_bad_input_gets_one_clear_line_and_nothing_is_made(
    call: Call, calibration: Path, tmp_path: Path, options: list[str], reason: str
) -> None:
    if "stage:" not in options[1]:
        options = [*options, "--calibration", str(calibration)]
    line = complaint(call("run", *options, "--run-dir", tmp_path / "run"))
    assert line.startswith("suturetrack run: ")
    assert reason in line
    assert not (tmp_path / "run").exists()


@pytest.mark.parametrize(
    ("option", "value", "least", "greatest"),
    [
        ("initialization.step-px", "0.0", "1", "100"),
        ("initialization.low", "nan", "0.01", "0.99"),
        ("tracking.iterations", "-3", "1", "100"),
        ("tracking.paper.gain", "inf", "0", "1000"),
        ("segmentation.sigmas", "1.0 nan", "0.3", "20"),
    ],
)
def test_a_parameter_out_of_its_range_is_named(
    call: Call, option: str, value: str, least: str, greatest: str
) -> None:
    status, err = call("run", "--source", STAGE, f"--{option}", *value.split())
    assert status == 2
    assert f"--{option} {value}: use {least} to {greatest}" in err


def test_a_video_needs_a_calibration(call: Call, tmp_path: Path) -> None:
    assert "--calibration FILE is needed" in complaint(call("run", "--source", tmp_path))


def test_what_is_no_video_is_said_so(call: Call, calibration: Path) -> None:
    line = complaint(call("run", "--source", calibration, "--calibration", calibration))
    assert "not a video that can be read" in line


@pytest.mark.parametrize("verb", [["run", "--source", STAGE], ["demo"]])
def test_a_view_without_a_display_is_refused_before_the_run(
    call: Call, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, verb: list[str]
) -> None:
    monkeypatch.setenv("DISPLAY", "")
    monkeypatch.delenv("WAYLAND_DISPLAY", raising=False)
    monkeypatch.setattr("services.launch._watch", None)
    line = complaint(call(*verb, "--view", "--run-dir", tmp_path / "run"))
    assert "there is no display; leave --view out, and watch with `suturetrack console`" in line
    assert not (tmp_path / "run").exists()


def test_a_run_folder_is_used_once(call: Call, tmp_path: Path) -> None:
    (tmp_path / "source.rrd").touch()
    line = complaint(call("run", "--source", STAGE, "--run-dir", tmp_path))
    assert "holds a run already; give another --run-dir" in line


def test_a_run_folder_that_cannot_be_made(call: Call, tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    line = complaint(call("run", "--source", STAGE, "--run-dir", tmp_path / "file" / "run"))
    assert "Not a directory" in line


def test_a_process_refuses_a_bad_rig_name(call: Call) -> None:
    assert "rig 'a/b'" in complaint(call("tracker", "--rig", "a/b"))


SERVICE = ServiceConfig("lab", Path("/net.json5"), Path("/runs/1"), "full", True, 17)
CONFIGS: list[Any] = [
    SourceConfig(
        InputConfig(
            "a,b",
            Path("c.yaml"),
            "mm",
            scale=0.5,
            rectified=True,
            topics=("/l", "/r"),
            ros=RosConfig("tcp/x:1", 3),
            fps=12.5,
            frames=40,
            scene_seed=3,
            scene_rig="endoscope",
        ),
        SERVICE,
    ),
    SourceConfig(InputConfig("0")),
    SegmenterConfig(SERVICE, ((1.5, 2.25), (3.0, 4.0)), SegmentationConfig((1.0, 2.0), c=3.5)),
    TrackerConfig(
        SERVICE,
        ((0.1, 1e-7),),
        TrackingConfig("paper", iterations=5),
        InitializationConfig(snap_px=4.5),
    ),
    TrackerConfig(),
    RunConfig(InputConfig("x"), SharedConfig(), ((1.0, 2.0),), True),
]


@pytest.mark.parametrize("config", CONFIGS, ids=lambda c: type(c).__name__)
def test_options_give_back_the_configuration(config: Any) -> None:
    assert tyro.cli(type(config), args=arguments.arguments_of(config)) == config


@pytest.mark.parametrize("config", CONFIGS, ids=lambda c: type(c).__name__)
def test_the_configuration_is_written_with_its_defaults(config: Any, tmp_path: Path) -> None:
    arguments.write_config(config, tmp_path / "config.toml")
    written = tomllib.loads((tmp_path / "config.toml").read_text())
    assert written["service"]["rig"] == config.service.rig
    assert written["service"]["recording"] == config.service.recording
    if isinstance(config, TrackerConfig):
        assert written["tracking"]["method"] == config.tracking.method


def test_the_overview_loads_no_heavy_library() -> None:
    code = "import sys; from services import cli; cli.call([]); print('numpy' in sys.modules)"
    out = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert out.stdout.endswith("False\n")


INTERRUPTS = """
import os, signal
try:
    os.kill(os.getpid(), signal.SIGINT)
finally:
    raise ImportError
"""


@pytest.mark.parametrize("verb", ["status", "tracker"])
def test_an_interrupt_while_modules_are_loaded_ends_a_verb_without_a_word(
    tmp_path: Path, verb: str
) -> None:
    """A library that every verb needs is stood in for by one that interrupts, and hides it."""
    (tmp_path / "tyro.py").write_text(INTERRUPTS)
    path = os.pathsep.join([str(tmp_path), *sys.path])
    out = subprocess.run(
        [sys.executable, "-m", "services.cli", verb],
        env=os.environ | {"PYTHONPATH": path},
        capture_output=True,
        text=True,
    )
    assert (out.returncode, out.stdout, out.stderr) == (130, "", "")


def test_an_interrupt_is_an_exception_again_once_a_verb_runs(call: Call) -> None:
    before = signal.getsignal(signal.SIGINT)
    assert call("inspect", "none")[0] == 1
    assert signal.getsignal(signal.SIGINT) is before


@pytest.mark.parametrize("arguments", ["--help", "run --help", "scenes"])
def test_a_reader_that_has_seen_enough_gets_no_complaint(tmp_path: Path, arguments: str) -> None:
    command = [sys.executable, "-m", "services.cli", *arguments.split()]
    reading, writing = os.pipe()
    os.close(reading)
    out = subprocess.run(command, cwd=tmp_path, stdout=writing, stderr=subprocess.PIPE)
    os.close(writing)
    assert out.returncode == 1
    assert out.stderr == b""


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="there is no /dev/full here")
@pytest.mark.parametrize("arguments", ["--help", "scenes"])
def test_a_full_disk_behind_the_output_is_said_in_one_line(tmp_path: Path, arguments: str) -> None:
    command = [sys.executable, "-m", "services.cli", arguments]
    with Path("/dev/full").open("w") as full:
        out = subprocess.run(command, cwd=tmp_path, stdout=full, stderr=subprocess.PIPE, text=True)
    assert out.returncode == 1
    assert out.stderr == "suturetrack: cannot write: No space left on device\n"
