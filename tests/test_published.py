"""Every entity of every process's recording, read back and compared with what was published."""

from __future__ import annotations

import platform
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from services import segmenter, source, topics, tracker
from services.bus import Bus, Reader
from services.memory_transport import Hub
from services.run_folder import Row, RunFolder
from services.segmenter import SegmenterConfig
from services.service import Service, ServiceConfig
from services.source import SourceConfig
from services.sources import InputConfig, open_input
from services.tracker import TrackerConfig
from services.wire import scaled
from suturetrack import nurbs
from suturetrack.camera import StereoRig
from suturetrack.initialization import Initialization, ViewGrowth
from suturetrack.tracking import Tracker
from suturetrack.types import Seed, ThreadState

FRAMES = 4
PROCESSES = ("source", "segmenter", "tracker")
Run = tuple[RunFolder, dict[str, list[Any]], StereoRig]


@contextmanager
def running(config: ServiceConfig, hub: Hub, seed: tuple[float, float]) -> Iterator[None]:
    """The three processes as threads."""
    scene = InputConfig("stage:figure8-107", fps=30.0, frames=FRAMES)
    bodies = {
        "source": lambda s: source.run(s, SourceConfig(scene, config)),
        "segmenter": lambda s: segmenter.run(s, SegmenterConfig(config, (seed,))),
        "tracker": lambda s: tracker.run(s, TrackerConfig(config, (seed,))),
    }
    services = {
        name: Service(name, config, Bus(hub.connect(), config.rig, name)) for name in bodies
    }

    def play(name: str) -> None:
        with services[name]:
            bodies[name](services[name])

    threads = {name: threading.Thread(target=play, args=(name,), daemon=True) for name in bodies}
    for thread in threads.values():
        thread.start()
    threads["source"].join(120)
    yield
    for service in services.values():
        service.bus.stop.set()
    for thread in threads.values():
        thread.join(20)
        assert not thread.is_alive()


def drained(reader: Reader[Any]) -> list[Any]:
    return list(iter(lambda: reader.get(0), None))


@pytest.fixture(scope="module")
def played(tmp_path_factory: pytest.TempPathFactory) -> Run:
    """A full recording, and all that was published meanwhile, in the calibration's unit."""
    run_dir: Path = tmp_path_factory.mktemp("published") / "run"
    footage, rig = open_input(InputConfig("stage:figure8-107", fps=30.0, frames=FRAMES))
    (seed,) = footage.seeds
    footage.close()
    hub, config = Hub(), ServiceConfig(run_dir=run_dir, recording="full", lockstep=True)
    bus = Bus(hub.connect(), config.rig, "listener")
    listened = (topics.FRAME, topics.FIELD, topics.STATE, topics.TRUTH)
    readers = {topic.key: bus.every(topic) for topic in listened}
    healths = bus.every(topics.HEALTH)
    with running(config, hub, seed):
        pass
    heard = {key: drained(reader) for key, reader in readers.items()}
    for topic in (topics.STATE, topics.TRUTH):
        heard[topic.key] = [scaled(m, 1 / rig.metres_per_unit) for m in heard[topic.key]]
    assert {key: len(messages) for key, messages in heard.items()} == dict.fromkeys(heard, FRAMES)
    heard[topics.HEALTH.key] = drained(healths)
    bus.close()
    return RunFolder(run_dir), heard, rig


def rows(folder: RunFolder, entity: str) -> list[Row]:
    """The rows of an entity that are not static, by frame."""
    return sorted((r for r in folder.rows(entity) if "frame" in r), key=lambda r: r["frame"])


def test_every_entity_is_known_and_stands_at_the_time_of_its_frame(played: Run) -> None:
    folder, heard, _ = played
    image = [f"/rig/{view}/image" for view in ("left", "right")]
    growth = ("field", "0/front", "0/segments", "0/merges", "0/rejected", "0/marks")
    expected = {
        *("/key/direction", "/rig", "/rig/left", "/rig/right", "/run/calibration", "/rig/truth/0"),
        *(f"{i}{layer}" for i in image for layer in ("", "/direction", "/curve", "/truth/0")),
        *(f"{i}/growth/{part}" for i in image for part in growth),
        *(f"{i}/growth" for i in image),
        *("/rig/left/field", "/rig/right/field", "/rig/left/image/growth/0/seed"),
        *(f"/rig/thread/0/{x}" for x in ("curve", "control_points", "tangent", "reliability")),
        *("/rig/thread/0/nurbs", "/rig/thread/0/velocity", "/log/initialization/0"),
        *(f"/plots/0/energy/{x}" for x in ("image", "end", "internal")),
        *(f"/plots/0/{x}" for x in ("length", "control_points", "status", "speed", "event")),
        *(f"/plots/0/energy/event/{x}" for x in ("seed", "found", "lost", "forgotten")),
        *(f"/plots/0/energy/event/{x}" for x in ("inserted", "removed")),
        *(f"/plots/latency_ms/{p}" for p in PROCESSES),
        *(f"/plots/{q}/{p}" for p in PROCESSES for q in ("rate_hz", "dropped", "memory_mb")),
        *(f"/run/{p}" for p in PROCESSES),
        *(f"/run/{p}/parameters" for p in PROCESSES),
        "/log/tracker",
    }
    captures = {frame.stamp.frame: frame.stamp.capture_ns for frame in heard[topics.FRAME.key]}
    found = set()
    for row in folder.rows("/**"):
        found.add(row["entity"])
        if "frame" in row:
            assert row["capture"] == captures[row["frame"]], row["entity"]
    assert {e for e in found if not e.startswith("/__")} == expected


def test_images_and_fields_are_those_published(played: Run) -> None:
    folder, heard, _ = played
    pairs = zip(folder.frames(), heard[topics.FRAME.key], strict=True)
    for recorded, published in pairs:
        assert recorded.stamp.frame == published.stamp.frame
        assert np.array_equal(recorded.left, published.left)
        assert np.array_equal(recorded.right, published.right)
    for field, sent in zip(folder.fields(), heard[topics.FIELD.key], strict=True):
        assert np.array_equal(field.left, sent.left)
        assert np.array_equal(field.right, sent.right)
    for view in ("left", "right"):
        pictures = rows(folder, f"/rig/{view}/image/direction")
        for picture, sent in zip(pictures, heard[topics.FIELD.key], strict=True):
            blob = np.asarray(picture["EncodedImage:blob"][0], np.uint8)
            bright = np.asarray(cv2.imdecode(blob, cv2.IMREAD_COLOR)).max(axis=2).astype(float)
            length = np.linalg.norm(getattr(sent, view), axis=2)
            assert np.corrcoef(bright.ravel(), length.ravel())[0, 1] > 0.8


def test_states_and_truths_are_those_published(played: Run) -> None:
    folder, heard, rig = played
    for recorded, state in zip(folder.states(), heard[topics.STATE.key], strict=True):
        same_state(recorded.state, state)
    truths = zip(folder.truths(), heard[topics.TRUTH.key], strict=True)
    assert folder.problems == []
    for truth, sent in truths:
        assert (truth.stamp, truth.thread) == (sent.stamp, sent.thread)
        assert np.allclose(truth.points, sent.points, atol=1e-4)
        assert truth.length == pytest.approx(sent.length, rel=1e-12)
        assert np.array_equal(truth.visible, sent.visible)
        for k, view in enumerate(("left", "right")):
            drawn = rows(folder, f"/rig/{view}/image/truth/0")[sent.stamp.frame]
            strip = np.asarray(drawn["LineStrips2D:strips"][0])
            all_pixels = rig.project_raw(sent.points)[k]
            apart = np.linalg.norm(strip[:, None] - all_pixels, axis=2).min(axis=1)
            assert apart.max() < 1e-2


def same_state(recorded: ThreadState, sent: ThreadState) -> None:
    assert (recorded.stamp, recorded.status, recorded.events) == (
        *(sent.stamp, sent.status, sent.events),
    )
    assert recorded.energies == sent.energies
    assert recorded.curve is not None
    assert sent.curve is not None
    assert np.array_equal(recorded.curve.knots, sent.curve.knots)
    assert np.allclose(recorded.curve.control_points, sent.curve.control_points, rtol=1e-13)
    assert np.array_equal(recorded.seen, sent.seen)
    assert np.allclose(recorded.sigma, sent.sigma, rtol=1e-13)


def test_what_is_drawn_and_plotted_is_the_state(played: Run) -> None:
    folder, heard, rig = played
    for i, state in enumerate(heard[topics.STATE.key]):
        assert state.curve is not None
        plots = {
            "energy/image": [state.energies.image_left, state.energies.image_right],
            "energy/end": [state.energies.end],
            "energy/internal": [state.energies.internal],
            "length": [state.length * rig.metres_per_unit * 1000],
            "control_points": [len(state.curve.control_points)],
        }
        for name, values in plots.items():
            plotted = rows(folder, f"/plots/0/{name}")[i]["Scalars:scalars"]
            assert np.allclose(plotted, values, rtol=1e-12), name
        path = nurbs.evaluate(state.curve, np.linspace(0, 1, 5000))
        for k, view in enumerate(("left", "right")):
            overlay = rows(folder, f"/rig/{view}/image/curve")[i]
            drawn = np.concatenate([np.asarray(s) for s in overlay["LineStrips2D:strips"]])
            pixels = rig.project_raw(path)[k]
            assert np.linalg.norm(drawn[:, None] - pixels, axis=2).min(axis=1).max() < 0.1
        in_space = rows(folder, "/rig/thread/0/curve")[i]["LineStrips3D:strips"]
        points = np.concatenate([np.asarray(s) for s in in_space])
        assert np.linalg.norm(points[:, None] - path, axis=2).min(axis=1).max() < 0.05
    velocity = rows(folder, "/rig/thread/0/velocity")
    assert [len(r["Arrows3D:vectors"]) for r in velocity] == [0, 25, 25, 25]
    before, after = (s.curve for s in heard[topics.STATE.key][1:3])
    assert before is not None
    assert after is not None
    s = np.linspace(0, 1, 25)
    moved = (nurbs.evaluate(after, s) - nurbs.evaluate(before, s)) * 30 * 0.1
    tangents = nurbs.tangents(after, s)
    moved -= (moved * tangents).sum(axis=1, keepdims=True) * tangents
    assert np.allclose(velocity[2]["Arrows3D:vectors"], moved, atol=1e-4)


def test_tangents_and_reliability_are_those_of_the_state(played: Run) -> None:
    folder, heard, _ = played
    for i, state in enumerate(heard[topics.STATE.key]):
        assert state.curve is not None
        arrows = rows(folder, "/rig/thread/0/tangent")[i]
        s = np.linspace(0, 1, len(arrows["Arrows3D:vectors"]))
        assert np.allclose(arrows["Arrows3D:origins"], nurbs.evaluate(state.curve, s), atol=1e-4)
        slope = nurbs.derivative(state.curve, s)
        assert np.allclose(len(s) * arrows["Arrows3D:vectors"], slope, rtol=1e-4, atol=1e-3)
        samples = rows(folder, "/rig/thread/0/reliability")[i]
        on_curve = nurbs.evaluate(state.curve, np.linspace(0, 1, len(state.sigma)))
        assert np.allclose(samples["Points3D:positions"], on_curve, atol=1e-4)
        gray = samples["Points3D:colors"] == (150 << 24 | 150 << 16 | 150 << 8 | 255)
        assert np.array_equal(gray, ~state.seen)
        points = rows(folder, "/rig/thread/0/control_points")[i]["Points3D:positions"]
        assert np.allclose(points, state.curve.control_points, atol=1e-4)


def test_the_growth_is_that_of_the_published_field(played: Run) -> None:
    folder, heard, rig = played
    footage, _ = open_input(InputConfig("stage:figure8-107"))
    (seed,) = footage.seeds
    again = Tracker(rig)
    again.seed(Seed("0", pixel=seed))
    field = heard[topics.FIELD.key][0]
    found = again.step(field).initializations["0"]
    assert isinstance(found, Initialization)
    assert found.growth is not None
    for k, view in enumerate(("left", "right")):
        root = f"/rig/{view}/image/growth/0"
        grown: ViewGrowth = getattr(found.growth, view)
        rejected = [line for line, _ in grown.rejected]
        for name, lines in (
            *(("segments", grown.segments), ("merges", grown.merges), ("rejected", rejected)),
        ):
            (drawn,) = rows(folder, f"{root}/{name}")
            strips = drawn["LineStrips2D:strips"]
            for strip, line in zip(strips, lines, strict=True):
                assert np.allclose(strip, rig.raw_pixels(line, right=k == 1), atol=1e-3)
        reasons = [reason for _, reason in grown.rejected]
        assert list(drawn.get("LineStrips2D:labels", ())) == reasons
        (marks,) = rows(folder, f"{root}/marks")
        expected = rig.raw_pixels(found.growth.marks[:, k], right=k == 1)
        assert np.allclose(marks["Points2D:positions"], expected, atol=1e-3)
        fronts = sorted(rows(folder, f"{root}/front"), key=lambda row: row["growth"])
        reached = [np.count_nonzero(row["SegmentationImage:buffer"][0]) for row in fronts]
        assert reached == sorted(reached)
        assert reached[-1] == np.isfinite(grown.cost).sum() > 0
        (picture,) = rows(folder, f"/rig/{view}/image/growth/field")
        blob = np.asarray(picture["EncodedImage:blob"][0], np.uint8)
        bright = np.asarray(cv2.imdecode(blob, cv2.IMREAD_COLOR)).max(axis=2).astype(float)
        length = np.linalg.norm(getattr(field, view), axis=2)
        assert np.corrcoef(bright.ravel(), length.ravel())[0, 1] > 0.8
    (begun,) = rows(folder, "/rig/left/image/growth/0/seed")
    assert np.allclose(begun["Points2D:positions"], [seed], atol=1e-3)
    (words,) = rows(folder, "/log/initialization/0")
    for said in (f"confidence {found.confidence:.2f}", *found.reasons):
        assert said in words["TextDocument:text"][0]


def test_process_plots_are_the_published_health_and_the_times_of_the_results(played: Run) -> None:
    folder, heard, _ = played
    for process in PROCESSES:
        healths = [h for h in heard[topics.HEALTH.key] if h.process == process and h.stamp]
        assert healths
        for quantity in ("rate_hz", "dropped", "memory_mb"):
            plotted = [
                r["Scalars:scalars"][0] for r in rows(folder, f"/plots/{quantity}/{process}")
            ]
            assert plotted == [getattr(h, quantity) for h in healths], (quantity, process)
        latencies = rows(folder, f"/plots/latency_ms/{process}")
        assert [row["frame"] for row in latencies] == list(range(FRAMES))
        assert all(row["Scalars:scalars"][0] > 0 for row in latencies)
    plotted = [row["Scalars:scalars"][0] for row in latencies]
    assert plotted == [recorded.latency_ms for recorded in folder.states()]
    status = rows(folder, "/plots/0/status")
    told = [row["StateChange:state"][0] for row in status]
    assert told == [str(state.status) for state in heard[topics.STATE.key]]


def test_the_moment_of_the_seed_is_marked(played: Run) -> None:
    folder, heard, _ = played
    energies = heard[topics.STATE.key][0].energies
    mean = (energies.image_left + energies.image_right) / 2
    for kind in ("seed", "found"):
        (mark,) = rows(folder, f"/plots/0/energy/event/{kind}")
        assert mark["frame"] == 0
        assert mark["Scalars:scalars"].tolist() == [mean]
    assert rows(folder, "/plots/0/event")[0]["StateChange:state"].tolist() == ["found"]


def test_parameters_calibration_versions_and_machine_are_in_the_recording(played: Run) -> None:
    folder, _, rig = played
    again = folder.rig()
    for view in ("left", "right"):
        for name, value in vars(getattr(rig, view)).items():
            assert np.array_equal(getattr(getattr(again, view), name), value), (view, name)
    for process in PROCESSES:
        about = folder.about()[process]
        assert about["level"] == "full"
        assert about["python"] == platform.python_version()
        assert platform.node() in about["machine"]
        assert about["suturetrack"]
        assert about["numpy"] == np.__version__
        (parameters,) = folder.rows(f"/run/{process}/parameters")
        text = parameters["TextDocument:text"][0]
        assert "lockstep: true" in text
        assert {"source": "figure8-107", "segmenter": "sigmas", "tracker": "search"}[
            process
        ] in text
