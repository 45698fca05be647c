"""Real processes over real Zenoh."""

from __future__ import annotations

import json
import os
import select
import shlex
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import cv2
import psutil
import pytest

from services import launch, service, topics
from services.bus import Bus
from services.export import ExportConfig
from services.export import run as export
from services.run_folder import RunFolder
from services.service import ServiceConfig
from services.sources import InputConfig
from services.zenoh_transport import ZenohTransport, local_config
from suturetrack.calibration import save_calibration
from suturetrack.stage import open_scene
from suturetrack.types import InputError, Status, ThreadState
from tests.conftest import wait_until

FRAMES = 10
PROCESSES = {"source", "segmenter", "tracker"}
STAGE = ("--source", "stage:figure8-107", "--loop", "30", "--fps", "5")


def command(*arguments: object) -> list[str]:
    return [sys.executable, "-m", "services.cli", *map(str, arguments)]


@pytest.fixture
def start(rig_name: str) -> Iterator[Callable[..., subprocess.Popen[str]]]:
    """Starts `suturetrack ...`; what still runs at the end is killed."""
    started: list[subprocess.Popen[str]] = []

    def begin(*arguments: object) -> subprocess.Popen[str]:
        pipe = subprocess.PIPE
        process = subprocess.Popen(command(*arguments), stdout=pipe, stderr=pipe, text=True)
        started.append(process)
        return process

    yield begin
    for process in started:
        process.kill()
        process.communicate()


def sockets() -> list[Path]:
    return list(Path(os.environ["XDG_RUNTIME_DIR"]).rglob("*.sock"))


def children(process: subprocess.Popen[str]) -> dict[str, psutil.Process]:
    """The processes that a launcher has started, by name; the nursery is none of them."""
    found = {child.name(): child for child in psutil.Process(process.pid).children()}
    return {name: child for name, child in found.items() if name in PROCESSES}


def wait_for_state(*processes: subprocess.Popen[str], rig: str = ServiceConfig.rig) -> ThreadState:
    """The first state of a rig that a consumer sees, while the processes live."""
    bus = Bus(ZenohTransport(local_config(rig, "viewer")), rig, "viewer")
    states = bus.every(topics.STATE)
    try:
        for _ in range(120):
            state = states.get(0.5)
            if state is not None:
                return state
            for process in processes:
                assert process.poll() is None, process.communicate()[1]
    finally:
        bus.close()
    raise AssertionError("no state came")


@pytest.fixture(scope="module")
def pairs(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, tuple[float, float]]:
    """A folder of image pairs with calibration.yaml, and a seed."""
    folder = tmp_path_factory.mktemp("pairs")
    scene = open_scene("figure8-107", seed=3)
    for side in ("left", "right"):
        (folder / side).mkdir()
    for i in range(FRAMES):
        for side, image in zip(("left", "right"), scene.render(i), strict=True):
            cv2.imwrite(str(folder / side / f"{i:03}.png"), image)
    save_calibration(folder / "calibration.yaml", scene.rig)
    return folder, scene.seed_pixel(0)


def run_pairs(pairs: tuple[Path, tuple[float, float]], run_dir: Path) -> list[object]:
    folder, seed = pairs
    options = ["--source", folder, "--calibration", folder / "calibration.yaml"]
    return ["run", *options, "--seed", *seed, "--lockstep", "--run-dir", run_dir]


def test_a_run_in_lock_step_is_recorded_whole_and_leaves_nothing_behind(
    start: Callable[..., subprocess.Popen[str]],
    pairs: tuple[Path, tuple[float, float]],
    tmp_path: Path,
) -> None:
    run_dir = tmp_path / "a run of the [/lab]"
    process = start(*run_pairs(pairs, run_dir))
    out, err = process.communicate(timeout=90)
    assert process.returncode == 0, err
    assert "rate Hz" in out
    assert f"Recording to {run_dir}\n" in out
    assert shlex.split(out.splitlines()[-1])[-3:] == ["suturetrack", "view", str(run_dir)]
    assert not list(Path(os.environ["XDG_RUNTIME_DIR"]).rglob("*.*"))
    assert (run_dir / "config.toml").read_text().count("lockstep = true") == 1
    original = (pairs[0] / "calibration.yaml").read_bytes()
    assert (run_dir / "calibration.yaml").read_bytes() == original
    export(ExportConfig(run_dir, output=tmp_path / "a.jsonl"))
    lines = [json.loads(line) for line in (tmp_path / "a.jsonl").read_text().splitlines()]
    assert [line["frame"] for line in lines] == list(range(FRAMES))
    assert {line["status"] for line in lines} == {"tracking"}
    assert [line["capture_time_ns"] for line in lines] == [
        round(i * 1e9 / 30) for i in range(FRAMES)
    ]


def test_a_seed_that_footage_was_too_short_to_find_fails_the_run(
    start: Callable[..., subprocess.Popen[str]],
    pairs: tuple[Path, tuple[float, float]],
    tmp_path: Path,
) -> None:
    process = start(*run_pairs((pairs[0], (20.0, 20.0)), tmp_path / "a"))
    _, err = process.communicate(timeout=90)
    assert process.returncode == 1
    assert err.startswith("suturetrack run: seed (20.0, 20.0): no thread within 8 px of the seed")


def test_the_source_may_start_first(start: Callable[..., subprocess.Popen[str]]) -> None:
    """The launcher starts the tracker first; processes that depend on nobody's order do this too."""
    options = ("--lockstep", "--rig", "test")
    source = start("source", *STAGE, "--frames", 4, *options)
    wait_until(lambda: len(sockets()) == 1)
    others = [start("tracker", *options)]
    wait_until(lambda: len(sockets()) == 2)
    others.append(start("segmenter", *options))
    assert source.wait(60) == 0
    for process in others:
        assert process.poll() is None
        process.terminate()
        assert process.wait(5) == 0


def test_signals_end_each_process_cleanly_and_soon(
    start: Callable[..., subprocess.Popen[str]], tmp_path: Path
) -> None:
    options = ("--rig", "test", "--run-dir", tmp_path)
    seed = open_scene("figure8-107").seed_pixel(0)
    processes = [
        start("tracker", *options, "--seed", *seed),
        start("segmenter", *options, "--seed", *seed),
        start("source", *STAGE, *options),
    ]
    wait_for_state(*processes, rig="test")
    for process, number in zip(
        processes, (signal.SIGTERM, signal.SIGINT, signal.SIGTERM), strict=True
    ):
        began = time.monotonic()
        process.send_signal(number)
        assert process.wait(10) == 0, process.communicate()[1]
        assert time.monotonic() - began < 2
    folder = RunFolder(tmp_path)
    assert len(folder.files) == 3
    assert not folder.problems
    assert folder.states()


def test_a_source_that_comes_back_with_another_calibration_ends_the_others(
    start: Callable[..., subprocess.Popen[str]], rig_name: str
) -> None:
    options = ("--rig", rig_name)
    seed = open_scene("figure8-107").seed_pixel(0)
    tracker = start("tracker", *options, "--seed", *seed)
    segmenter = start("segmenter", *options, "--seed", *seed)
    source = start("source", *STAGE, *options)
    wait_for_state(tracker, segmenter, source, rig=rig_name)
    source.kill()
    source.wait()
    start("source", *STAGE, *options, "--scene-rig", "endoscope")
    for process, name in ((tracker, "tracker"), (segmenter, "segmenter")):
        _, err = process.communicate(timeout=20)
        assert process.returncode == 1
        assert f"suturetrack {name}: the source has another calibration now" in err


def test_without_a_budget_a_process_that_is_killed_ends_the_run_with_a_clear_line(
    start: Callable[..., subprocess.Popen[str]], tmp_path: Path
) -> None:
    run = start("run", *STAGE, "--run-dir", tmp_path, "--restarts", 0)
    wait_for_state(run)
    family = children(run)
    assert set(family) == PROCESSES
    family["segmenter"].send_signal(signal.SIGKILL)
    _, err = run.communicate(timeout=20)
    assert run.returncode == 1
    assert "suturetrack run: the segmenter was killed by signal 9" in err
    assert not any(child.is_running() for child in family.values())
    assert not sockets()
    states = [s.state for s in RunFolder(tmp_path).states()]
    assert states
    assert {s.status for s in states} <= set(Status)


def test_ctrl_c_ends_a_run_with_its_table(
    start: Callable[..., subprocess.Popen[str]], tmp_path: Path
) -> None:
    run = start("run", *STAGE, "--run-dir", tmp_path)
    wait_for_state(run)
    family = children(run)
    run.send_signal(signal.SIGINT)
    out, err = run.communicate(timeout=20)
    assert run.returncode == 0, err
    assert "tracking %" in out
    assert not any(child.is_running() for child in family.values())
    assert not RunFolder(tmp_path).problems


def test_what_was_wrong_to_the_end_is_told_with_the_table(
    start: Callable[..., subprocess.Popen[str]], tmp_path: Path
) -> None:
    run = start("run", *STAGE, "--run-dir", tmp_path / "a")
    wait_for_state(run)
    shutil.rmtree(tmp_path / "a")
    bus = Bus(ZenohTransport(local_config(ServiceConfig.rig, "viewer")), "rig", "viewer")
    stopped = "recording stopped: the file or its folder was removed"
    told = set[str]()
    for health in bus.every(topics.HEALTH):
        told |= {health.process} if stopped in health.warning else set()
        if told == PROCESSES:
            break
    bus.close()
    run.send_signal(signal.SIGINT)
    out, err = run.communicate(timeout=20)
    assert run.returncode == 0, err
    last_words = out[out.index("refused") :]
    assert all(f"{name}: {stopped}" in last_words for name in PROCESSES)


def test_processes_end_when_their_launcher_is_killed(
    start: Callable[..., subprocess.Popen[str]], tmp_path: Path
) -> None:
    run = start("run", *STAGE, "--run-dir", tmp_path)
    wait_for_state(run)
    family = children(run)
    run.kill()
    _, alive = psutil.wait_procs(list(family.values()), timeout=10)
    assert not alive
    assert not RunFolder(tmp_path).problems


def test_two_runs_at_once_keep_apart_and_a_name_is_used_once(
    start: Callable[..., subprocess.Popen[str]],
    pairs: tuple[Path, tuple[float, float]],
    tmp_path: Path,
) -> None:
    first = start("run", *STAGE, "--run-dir", tmp_path / "a", "--rig", "bench")
    wait_until(lambda: len(sockets()) == 4)
    second = start(*run_pairs(pairs, tmp_path / "c"))
    again = ServiceConfig("bench", run_dir=tmp_path / "b")
    with pytest.raises(InputError, match="rig 'bench' runs already"):
        launch.run(launch.RunConfig(InputConfig(STAGE[1]), again))
    assert not (tmp_path / "b").exists()
    with pytest.raises(InputError, match="a process named 'source' is running already"):
        service.run("source", again, lambda _: None)
    _, err = second.communicate(timeout=60)
    assert second.returncode == 0, err
    first.terminate()
    assert first.wait(20) == 0
    frames = [s.state.stamp.frame for s in RunFolder(tmp_path / "c").states()]
    assert frames == list(range(FRAMES))


def test_a_process_that_waits_says_for_whom(
    start: Callable[..., subprocess.Popen[str]], rig_name: str
) -> None:
    waiting = start("record", "--rig", rig_name)
    assert waiting.stderr is not None
    assert select.select([waiting.stderr], [], [], 15)[0]
    assert waiting.stderr.readline() == "record: waits for the source\n"


def test_garbage_is_not_looked_for_in_what_a_process_has_loaded(rig_name: str) -> None:
    code = (
        "import gc; from services import service; service.run("
        "'viewer', service.ServiceConfig('test'), lambda _: print(gc.get_freeze_count()))"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert int(done.stdout) > 10_000
