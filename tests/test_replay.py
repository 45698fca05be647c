"""A full recording gives the same states to the bit; a changed parameter changes them."""

from __future__ import annotations

import shutil
import threading
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Literal

import numpy as np
import pytest
import rerun as rr

from services import segmenter, topics, tracker
from services.arguments import write_config
from services.bus import Bus, NoAnswer
from services.memory_transport import Hub
from services.messages import Forget
from services.recording import Recorder
from services.replay import Parameters, ReplayConfig, changed, run
from services.run_file import APPLICATION
from services.run_folder import RecordedState, RunFolder
from services.segmenter import SegmenterConfig
from services.service import Service, ServiceConfig
from services.tracker import TrackerConfig
from services.writer import Writer
from suturetrack import metrics, nurbs
from suturetrack.camera import StereoRig
from suturetrack.stage import Scene, open_scene
from suturetrack.types import InputError, Seed, Stamp, StereoFrame, ThreadState

FRAMES = 4


@pytest.fixture(scope="module")
def recorded(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run of the bench top, played once through the processes and recorded in full."""
    return played(tmp_path_factory.mktemp("runs"), open_scene("figure8-107"), "full")


def played(folder: Path, scene: Scene, level: Literal["light", "full"]) -> Path:
    """The run in `folder` of the first frames of a scene, which were recorded at a level before."""
    with Recorder(folder / "frames", "source", level, scene.rig) as recorder:
        for i in range(FRAMES):
            stamp = Stamp(3 * i, i * 33_000_000, 0)  # two of three frames were dropped
            recorder.frame(StereoFrame(stamp, *scene.render(i)))
    u, v = scene.seed_pixel()
    write_config(Parameters(seed=((float(u), float(v)),)), folder / "frames" / "config.toml")
    run(ReplayConfig(folder / "frames", folder / "played", recording="full"))
    return folder / "played"


def states(run_dir: Path) -> list[RecordedState]:
    """The recorded states, of which there is one a frame."""
    found = RunFolder(run_dir).states()
    assert [s.state.stamp.frame for s in found] == [3 * i for i in range(FRAMES)]
    assert all(s.state.curve is not None for s in found)
    return found


def bits(run_dir: Path) -> list[bytes]:
    """The states to the bit, without the times at which they were made."""
    found = [recorded.state for recorded in states(run_dir)]
    return [curve_bits(state) + str(state.energies).encode() for state in found]


def curve_bits(state: ThreadState) -> bytes:
    """Everything of a state that is an array."""
    arrays = [state.sigma, state.seen]
    if state.curve is not None:
        arrays += [state.curve.knots, state.curve.control_points]
    return b"".join(a.tobytes() for a in arrays)


@pytest.fixture(scope="module")
def seeded(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run whose threads are seeded while it goes on, one of them twice, and not all of whose frames
    reach every process."""
    run_dir: Path = tmp_path_factory.mktemp("seeded") / "run"
    hub, config = Hub(), ServiceConfig(run_dir=run_dir, recording="full", lockstep=True)
    scene = open_scene("two-threads")
    (run_dir).mkdir()
    write_config(Parameters(), run_dir / "config.toml")
    with (
        processes(hub, config, scene.rig) as bus,
        Recorder(run_dir, "source", "full", scene.rig) as recorder,
    ):
        steps = bus.every(topics.STEP)
        first, second = (scene.seed_pixel(0, name) for name in scene.threads)
        point = scene.truth(5)[0].points[140] * scene.rig.metres_per_unit
        seeds = {1: Seed("a", pixel=first), 3: Seed("b", pixel=second)}
        seeds |= {5: Seed("a", point=(float(point[0]), float(point[1]), float(point[2])))}
        for i in range(8):
            frame = StereoFrame(Stamp(i, i * 33_000_000, 0), *scene.render(i))
            recorder.frame(frame)
            if i in (2, 6):
                continue  # the segmenter never sees it
            with suppress(NoAnswer):
                if i in seeds:
                    bus.ask(topics.SEED, seeds[i], timeout=0)
                if i == 7:
                    bus.ask(topics.FORGET, Forget("b"), timeout=0)
            bus.publish(topics.FRAME, frame)
            step = steps.get(60)
            assert step is not None
            assert step.frame == i
    return run_dir


@contextmanager
def processes(hub: Hub, config: ServiceConfig, rig: StereoRig) -> Iterator[Bus]:
    """Segmenter and tracker as threads, and the source's end of the hub."""
    bodies = {
        "segmenter": lambda service: segmenter.run(service, SegmenterConfig(config)),
        "tracker": lambda service: tracker.run(service, TrackerConfig(config)),
    }
    bus = Bus(hub.connect(), config.rig, "source")
    bus.answer(topics.CALIBRATION, lambda _: rig)
    bus.every(topics.STEP)
    services = {
        name: Service(name, config, Bus(hub.connect(), config.rig, name)) for name in bodies
    }

    def play(name: str) -> None:
        with services[name]:
            bodies[name](services[name])

    threads = [threading.Thread(target=play, args=(name,), daemon=True) for name in bodies]
    for thread in threads:
        thread.start()
    for name in bodies:
        assert bus.wait_for_alive(name, 120)
    yield bus
    for service in services.values():
        service.bus.stop.set()
    for thread in threads:
        thread.join()
    bus.close()


def named_bits(run_dir: Path) -> list[tuple[int, str, str, bytes]]:
    """As `bits`, with frame and thread, of states that may have no curve."""
    return [
        (s.stamp.frame, s.thread, str(s.status), curve_bits(s) + str(s.energies).encode())
        for s in (recorded.state for recorded in RunFolder(run_dir).states())
    ]


@pytest.mark.parametrize("first", ["segmenter", "tracker"])
def test_seeds_sent_live_take_effect_at_the_same_frames_again(
    tmp_path: Path, seeded: Path, first: Literal["segmenter", "tracker"]
) -> None:
    folder = RunFolder(seeded)
    asked = [(frame, type(r).__name__, r.thread) for frame, r in folder.requests("tracker")]
    assert asked == [(1, "Seed", "a"), (3, "Seed", "b"), (5, "Seed", "a"), (7, "Forget", "b")]
    assert [frame for frame, _ in folder.requests("segmenter")] == [3, 4, 7]
    states = named_bits(seeded)
    assert [(frame, name) for frame, name, *_ in states] == [
        *((1, "a"), (3, "a"), (3, "b"), (4, "a"), (4, "b"), (5, "a"), (5, "b"), (7, "a"), (7, "b"))
    ]
    again = tmp_path / "again"
    run(ReplayConfig(seeded, again, first, recording="full"))
    assert named_bits(again) == states
    places = [
        [getattr(r, "point", None) for _, r in RunFolder(d).requests("tracker")]
        for d in (again, seeded)
    ]
    assert places[0] == places[1]
    assert places[0][2] is not None
    run(ReplayConfig(again, tmp_path / "once more", "tracker"))
    assert named_bits(tmp_path / "once more") == states


def test_without_its_seed_a_thread_is_not_found_again(tmp_path: Path, seeded: Path) -> None:
    deaf = tmp_path / "deaf"
    shutil.copytree(seeded, deaf)
    (deaf / "tracker.rrd").unlink()
    run(ReplayConfig(deaf, tmp_path / "again", "tracker"))
    assert named_bits(tmp_path / "again") == []


@pytest.mark.parametrize("first", ["segmenter", "tracker"])
def test_the_same_parameters_give_the_same_states_to_the_bit(
    tmp_path: Path, recorded: Path, first: Literal["segmenter", "tracker"]
) -> None:
    run(ReplayConfig(recorded, tmp_path / "again", first))
    assert bits(tmp_path / "again") == bits(recorded)
    names = sorted(p.name for p in (tmp_path / "again").iterdir())
    source = ["source.rrd"] if first == "segmenter" else []
    assert names == ["calibration.yaml", "config.toml", "segmenter.rrd", *source, "tracker.rrd"]


def test_a_changed_parameter_changes_the_states(tmp_path: Path, recorded: Path) -> None:
    new = tmp_path / "changed"
    run(ReplayConfig(recorded, new, "tracker", set=("tracking.smoothing=90.0",)))
    assert bits(new) != bits(recorded)
    assert "smoothing = 90.0" in (new / "config.toml").read_text()


def test_a_light_recording_shows_threads_where_they_were(tmp_path: Path) -> None:
    scene = open_scene("figure8-107")
    last = states(played(tmp_path, scene, "light"))[-1].state.curve
    assert last is not None
    curve = nurbs.evaluate(last, np.linspace(0, 1, 500))
    truth = scene.truth(FRAMES - 1)[0].points
    assert scene.rig.mm_per_unit * metrics.curve_error(curve, truth).rms < 0.12


def test_changes_are_checked() -> None:
    parameters = changed(Parameters(), ["tracking.method=paper", "segmentation.sigmas=[1.0, 2.0]"])
    assert parameters.tracking.method == "paper"
    assert parameters.segmentation.sigmas == (1.0, 2.0)
    for wrong, hint in {
        "tracking.serch_px=3": "did you mean search_px",
        "nothing.at=1": "no such parameter",
        "tracking.search_px": "use KEY=VALUE",
        "tracking.search_px=wide": "Expected `float`",
    }.items():
        with pytest.raises(InputError, match=hint):
            changed(Parameters(), [wrong])


def test_what_cannot_be_replayed_is_said(tmp_path: Path, recorded: Path) -> None:
    with pytest.raises(InputError, match="holds a run already"):
        run(ReplayConfig(recorded, recorded))
    light = tmp_path / "light"
    run(ReplayConfig(recorded, light, "tracker"))
    with pytest.raises(InputError, match="needs full"):
        run(ReplayConfig(light, tmp_path / "new", "tracker"))
    (light / "config.toml").unlink()
    with pytest.raises(InputError, match=r"config\.toml is missing"):
        run(ReplayConfig(light, tmp_path / "new"))
    with pytest.raises(InputError, match="Not a directory"):
        run(ReplayConfig(recorded, recorded / "config.toml" / "new"))


@pytest.mark.parametrize(
    ("first", "lost", "words"),
    [("segmenter", "source", "no frames .* source"), ("tracker", "segmenter", "no fields .* segm")],
)
def test_a_run_without_what_is_played_is_not_replayed(
    tmp_path: Path, recorded: Path, first: Literal["segmenter", "tracker"], lost: str, words: str
) -> None:
    shutil.copytree(recorded, tmp_path / "run", ignore=shutil.ignore_patterns(f"{lost}*.rrd"))
    with pytest.raises(InputError, match=f"run: {words}"):
        run(ReplayConfig(tmp_path / "run", tmp_path / "new", first))
    assert not (tmp_path / "new").exists()


def test_a_seed_that_is_not_found_by_the_end_fails_a_replay_too(
    tmp_path: Path, recorded: Path
) -> None:
    with pytest.raises(InputError, match=r"seed \(5\.0, 5\.0\)"):
        run(ReplayConfig(recorded, tmp_path / "new", set=("seed=[[5.0, 5.0]]",)))


def test_a_recording_that_tells_nothing_of_itself_is_not_replayed(
    tmp_path: Path, rig: StereoRig
) -> None:
    stream = rr.RecordingStream(APPLICATION, recording_id="bare")
    stream.set_sinks(rr.FileSink(str(tmp_path / "source.rrd")))
    Writer(stream, "source", "light", rig).describe()
    stream.disconnect()
    write_config(Parameters(), tmp_path / "config.toml")
    with pytest.raises(InputError, match="no recording tells at which level"):
        run(ReplayConfig(tmp_path, tmp_path / "new"))
