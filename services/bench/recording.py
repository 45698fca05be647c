"""`suturetrack bench recording`: what recording costs each process, and the dataflow as a whole."""

from __future__ import annotations

import subprocess
import sys
import time
from collections import defaultdict
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path

from rich.console import Console
from rich.progress import track

from services import topics
from services.bench import report
from services.bench.system import private_folder, rig_name
from services.bus import Bus
from services.drawing import Level
from services.messages import Health
from services.recording import Recorder
from services.zenoh_transport import ZenohTransport, local_config, remove_sockets
from suturetrack.segmentation import Segmenter
from suturetrack.stage import Scene, open_scene
from suturetrack.tracking import Tracker
from suturetrack.types import InputError, Seed, Stamp, StereoFrame

_LEVELS: tuple[Level, ...] = ("light", "full")
_Key = tuple[Level | None, str]
"""Level and process."""
_RATE_HZ = 30.0
_LONGEST_S = 300.0


@dataclass(frozen=True)
class RecordingBench:
    """Time and bytes that recording takes, and the rate of the dataflow with it beside without."""

    scenario: str = "figure8-175"
    """Scene of the bench top."""
    frames: int = 150
    """Frames of each run."""
    repeats: int = 2
    """Runs without a recording and at each level, lock-step and at 30 Hz, taken in turns."""


@dataclass(frozen=True)
class Row:
    """One process at one level: alone, then within the whole dataflow."""

    recording: str
    process: str
    loop_ms: float
    """For which the process's loop waits, a frame."""
    thread_ms: float
    """Processor time of the recording's own thread, a frame."""
    kilobytes: float
    """Written, a frame."""
    mb_per_s_at_30_hz: float
    lockstep_hz: float
    """The best rate of this process in lock-step, recorded."""
    unrecorded_hz: float
    """The same without a recording, in the same benchmark."""
    ratio: float
    """Recorded over unrecorded rate; 1 where recording costs nothing."""
    paced_hz: float
    """The best rate of this process when frames are released at 30 Hz, recorded."""
    unrecorded_paced_hz: float
    """The same without a recording."""


def run(config: RecordingBench, console: Console) -> list[Row]:
    """Prints a row a process and level."""
    alone = {(level, name): cost for level in _LEVELS for name, cost in costs(config, level)}
    cases = [level for _ in range(config.repeats) for level in (None, *_LEVELS)]
    best, paced = defaultdict[_Key, float](float), defaultdict[_Key, float](float)
    for level in track(cases, "Lock-step and at 30 Hz", console=console, transient=True):
        for rates, lockstep in ((best, True), (paced, False)):
            for name, rate_hz in _rates(config, level, lockstep=lockstep).items():
                rates[level, name] = max(rate_hz, rates[level, name])
    table = [
        Row(
            level,
            name,
            cost.loop_ms,
            cost.thread_ms,
            cost.kilobytes,
            cost.kilobytes * _RATE_HZ / 1e3,
            best[level, name],
            best[None, name],
            best[level, name] / best[None, name],
            paced[level, name],
            paced[None, name],
        )
        for (level, name), cost in alone.items()
    ]
    report.print_rows(console, f"Recording, {config.scenario}", table)
    return table


@dataclass(frozen=True)
class Cost:
    """What one frame of a process costs; see `Row`."""

    loop_ms: float
    thread_ms: float
    kilobytes: float


def costs(config: RecordingBench, level: Level) -> Iterator[tuple[str, Cost]]:
    """What one frame of each process costs, measured within this process."""
    scene = open_scene(config.scenario)
    for name, hand_over in _loops(scene, config.frames).items():
        with private_folder() as folder:
            recorder = Recorder(Path(folder), name, level, scene.rig)
            empty_bytes = (Path(folder) / f"{name}.rrd").stat().st_size
            loop_s, thread_s = 0.0, time.process_time() - time.thread_time()
            for call in hand_over:
                began = time.perf_counter()
                call(recorder)
                loop_s += time.perf_counter() - began
                time.sleep(max(0.0, began + 1 / _RATE_HZ - time.perf_counter()))
            recorder.close()
            thread_s = time.process_time() - time.thread_time() - thread_s
            size = (Path(folder) / f"{name}.rrd").stat().st_size - empty_bytes
            count = len(hand_over)
            yield name, Cost(1e3 * loop_s / count, 1e3 * thread_s / count, size / 1e3 / count)


def _loops(scene: Scene, frames: int) -> dict[str, list[Callable[[Recorder], None]]]:
    """What the processes record, frame by frame; a few frames of the scene over and over."""
    segmenter, tracker = Segmenter(scene.rig), Tracker(scene.rig)
    seed = Seed(pixel=scene.seed_pixel(0))
    tracker.seed(seed)
    loops: dict[str, list[Callable[[Recorder], None]]] = {name: [] for name in topics.PROCESSES}
    for i in range(min(frames, 30)):
        frame = StereoFrame(Stamp(i, round(i * 1e9 / _RATE_HZ), time.time_ns()), *scene.render(i))
        if i == 0:
            segmenter.learn(frame, seed)
        field = segmenter.step(frame)
        states = tracker.step(field).states
        loops["source"].append(lambda recorder, frame=frame: recorder.frame(frame))  # type: ignore[misc]
        loops["segmenter"].append(lambda recorder, field=field: recorder.field(field))  # type: ignore[misc]
        loops["tracker"].append(lambda recorder, states=states: recorder.states(states))  # type: ignore[misc]
    return {name: calls * max(1, frames // 30) for name, calls in loops.items()}


def _rates(config: RecordingBench, level: Level | None, *, lockstep: bool) -> dict[str, float]:
    """Frames a second of each process in a run of real processes, lock-step or at 30 Hz."""
    seed = open_scene(config.scenario).seed_pixel(0)
    rig = rig_name("recording")
    shared = ["--rig", rig, *(["--lockstep"] if lockstep else [])]
    with ExitStack() as stack:
        if level is not None:
            folder = stack.enter_context(private_folder())
            shared += ["--run-dir", folder, "--recording", level]
        stack.callback(remove_sockets, rig)
        bus = Bus(ZenohTransport(local_config(rig, "bench")), rig, "bench")
        stack.callback(bus.close)
        healths = bus.every(topics.HEALTH)
        own = {
            "source": ["--source", f"stage:{config.scenario}", "--frames", str(config.frames)],
            "segmenter": ["--seed", *map(str, seed)],
            "tracker": ["--seed", *map(str, seed)],
        }
        running = {
            name: subprocess.Popen(
                [sys.executable, "-m", "services.cli", name, *shared, *options],
                stdout=subprocess.DEVNULL,
                stderr=subprocess.DEVNULL,
            )
            for name, options in own.items()
        }
        last: dict[str, Health] = {}
        try:
            deadline = time.monotonic() + _LONGEST_S
            while running["source"].poll() is None and time.monotonic() < deadline:
                health = healths.get(0.5)
                if health is not None:
                    last[health.process] = health
        finally:
            for process in running.values():
                process.terminate()
            for process in running.values():
                process.wait()
        while (health := healths.get(0.3)) is not None:
            last[health.process] = health
    done = [h.frames for h in last.values()]
    least = config.frames if lockstep else 2
    if set(last) != set(topics.PROCESSES) or min(done) < least:
        raise InputError(f"bench recording: a run did {done} of {config.frames} frames")
    return {name: health.run_rate_hz for name, health in last.items()}
