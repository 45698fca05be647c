"""A full recording gives the same states to the bit; a changed parameter changes them."""

from __future__ import annotations

from pathlib import Path
from typing import Literal

import pytest

from services.arguments import write_config
from services.recording import Recorder
from services.replay import Parameters, ReplayConfig, changed, run
from services.run_folder import RecordedState, RunFolder
from suturetrack.stage import open_scene
from suturetrack.types import InputError, Stamp, StereoFrame

FRAMES = 4


@pytest.fixture(scope="module")
def recorded(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run of the bench top, played once through the processes and recorded in full."""
    folder: Path = tmp_path_factory.mktemp("runs")
    scene = open_scene("figure8-107")
    frames, played = folder / "frames", folder / "played"
    with Recorder(frames, "source", "full", scene.rig) as recorder:
        for i in range(FRAMES):
            stamp = Stamp(3 * i, i * 33_000_000, 0)  # two of three frames were dropped
            recorder.frame(StereoFrame(stamp, *scene.render(i)))
    u, v = scene.seed_pixel()
    write_config(Parameters(seed=((float(u), float(v)),)), frames / "config.toml")
    run(ReplayConfig(frames, played, recording="full"))
    return played


def states(run_dir: Path) -> list[RecordedState]:
    """The recorded states, of which there is one a frame."""
    found = RunFolder(run_dir).states()
    assert [s.state.stamp.frame for s in found] == [3 * i for i in range(FRAMES)]
    assert all(s.state.curve is not None for s in found)
    return found


def bits(run_dir: Path) -> list[bytes]:
    """The states to the bit, without the times at which they were made."""
    kept = []
    for state in (recorded.state for recorded in states(run_dir)):
        assert state.curve is not None
        arrays = (state.curve.knots, state.curve.control_points, state.sigma, state.seen)
        kept.append(b"".join(a.tobytes() for a in arrays) + str(state.energies).encode())
    return kept


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
