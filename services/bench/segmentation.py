"""`suturetrack bench segmentation`: time and centreline quality beside scikit-image's ridge filters."""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from dataclasses import astuple, dataclass, field, replace
from functools import partial
from typing import Any, TypeVar

import cv2
import numpy as np
from numpy.typing import NDArray
from rich.console import Console
from scipy.spatial import cKDTree

from services.bench import report
from services.bench.pool import check_count
from suturetrack.segmentation import SegmentationConfig, Segmenter
from suturetrack.segmentation.contrast import SIGMAS
from suturetrack.stage import Picture, Scene, open_scene
from suturetrack.types import Float64, Image, InputError, Seed, Stamp, StereoFrame

T = TypeVar("T")
Response = NDArray[Any]
_REACH_PX = 2.0
_THRESHOLDS = 24
_SWING, _MOMENTS_S = 0.4, (0, 1, 2, 3, 4, 5, 6, 7)
"""How far light and white balance swing, and when it is looked how well the threads are seen."""


@dataclass(frozen=True)
class SegmentationBench:
    """Milliseconds a stereo pair, and precision and recall of the threads' centrelines."""

    scenarios: tuple[str, ...] = ("figure8-175", "clutter", "crossings", "two-threads")
    """Scenes to segment."""
    seeds: int = 3
    """Fresh seeds of each."""
    first_seed: int = 100
    """The seeds count from here."""
    rig: str = "bench"
    """The rig of the scenes."""
    picture: Picture = field(default_factory=Picture)
    """How the scenes are filmed."""
    repeats: int = 30
    """Frames timed; the references are timed on a fifth of them, in turns."""


@dataclass(frozen=True)
class Row:
    """One filter over all scenes; the worst scene beside the mean."""

    filter: str
    pair_ms: float
    """Median processor time of a stereo pair, all threads."""
    times_as_fast_as_frangi: float
    precision: float
    """Share of the found centreline within 2 px of a thread, at the threshold with the best F1."""
    recall: float
    """Share of the threads within 2 px of the found centreline; of several, the worst thread's."""
    f1: float
    worst_f1: float
    strength: float
    """Median length of the vectors on the threads while light and white balance swing by 40 %."""
    least_strength: float
    """That of the thread that is seen least, at its worst moment."""
    flicker_percent: float
    """Standard deviation of a thread's strength over the moments, of its mean; the mean of all."""


def rows(config: SegmentationBench) -> list[Row]:
    """Runs every filter over every scene; times all of them in turns in one go."""
    check_count("seeds", config.seeds)
    check_count("repeats", config.repeats)
    scenes = [
        open_scene(name, config.first_seed + k, config.rig, picture=config.picture)
        for name in config.scenarios
        for k in range(config.seeds)
    ]
    pictures = [_Picture.of(scene) for scene in scenes]
    swings = _swings(config)
    timings = _timings(scenes[0], config.repeats)
    reference = timings["frangi (scikit-image)"]
    table = []
    for name, respond in _filters().items():
        scores = np.array([_score(picture, respond(picture)) for picture in pictures])
        precision, recall, f1 = scores.mean(0)
        ms = timings[name]
        worst = float(scores[:, 2].min())
        swing = swings.get(name, _Swing())
        row = Row(name, ms, reference / ms, precision, recall, f1, worst, *astuple(swing))
        table.append(row)
    return table


def run(config: SegmentationBench, console: Console) -> list[Row]:
    """Prints the table."""
    table = rows(config)
    report.print_rows(console, "Segmentation, a stereo pair", table)
    return table


_TWO = (SIGMAS[0], SIGMAS[1])
_OPTIONS = {
    "ours": SegmentationConfig(),
    "ours, both polarities": SegmentationConfig(polarity="both"),
    "ours, two scales": SegmentationConfig(_TWO),
    "ours, c = 10": SegmentationConfig(c=10.0),
    "ours, no adaptation": SegmentationConfig(adapt=False),
    "ours, gray": SegmentationConfig(channel="gray"),
    "ours, red": SegmentationConfig(channel="red"),
    "ours, green": SegmentationConfig(channel="green"),
    "ours, blue": SegmentationConfig(channel="blue"),
    "ours, gray, dark, no seed": SegmentationConfig(channel="gray", polarity="dark"),
    "ours, gray, bright, no seed": SegmentationConfig(channel="gray", polarity="bright"),
    "ours, gray, both, no seed": SegmentationConfig(channel="gray", polarity="both"),
}
"""What each option is worth: the defaults, then one changed at a time, then nothing learned."""


@dataclass(frozen=True)
class _Swing:
    """The last columns of a row; nan for filters whose response has no scale."""

    strength: float = math.nan
    least_strength: float = math.nan
    flicker_percent: float = math.nan


@dataclass(frozen=True, eq=False)
class _Picture:
    """The first frame of a scene, and where its threads are."""

    scene: Scene
    frame: StereoFrame
    threads: tuple[Float64, ...]
    """(N, 2) pixels of the left view where both cameras see each thread."""

    @classmethod
    def of(cls, scene: Scene) -> _Picture:
        threads = [scene.rig.project(t.points[t.visible])[0] for t in scene.truth(0)]
        return cls(scene, StereoFrame(Stamp(0, 0, 0), *scene.render(0)), tuple(threads))


def _filters() -> dict[str, Callable[[_Picture], Response]]:
    """Name -> response of the left view, (H, W)."""
    filters: dict[str, Callable[[_Picture], Response]] = {
        name: partial(_ours, config, "no seed" not in name) for name, config in _OPTIONS.items()
    }
    for name, function in _references().items():
        filters[name] = partial(_theirs, function)
    return filters


def _ours(config: SegmentationConfig, seeded: bool, picture: _Picture) -> Response:
    segmenter = Segmenter(picture.scene.rig, config)
    for name in picture.scene.threads if seeded else ():
        seed = Seed(name, pixel=picture.scene.seed_pixel(0, name))
        segmenter.learn(picture.frame, seed)
    return np.linalg.norm(segmenter.step(picture.frame).left, axis=-1)


def _theirs(function: Callable[[Response], Response], picture: _Picture) -> Response:
    return function(_gray(picture.frame.left))


def _references() -> dict[str, Callable[[Response], Response]]:
    try:
        from skimage import filters
    except ModuleNotFoundError as error:
        raise InputError(
            "bench segmentation compares with scikit-image: pip install 'suturetrack[bench]'"
        ) from error

    def reference(name: str, sigmas: tuple[float, ...]) -> Callable[[Response], Response]:
        return partial(getattr(filters, name), sigmas=sigmas, black_ridges=True)

    return {
        **{f"{n} (scikit-image)": reference(n, _TWO[:1]) for n in ("frangi", "sato", "meijering")},
        "frangi, two scales (scikit-image)": reference("frangi", _TWO),
    }


def _timings(scene: Scene, repeats: int) -> dict[str, float]:
    """Median ms a pair of every filter, timed in turns so that all meet the same machine."""
    frames = [StereoFrame(Stamp(i, 0, 0), *scene.render(i)) for i in range(repeats)]
    ours = {name: Segmenter(scene.rig, config) for name, config in _OPTIONS.items()}
    for name, segmenter in ours.items():
        segmenter.warm_up()
        if "no seed" not in name:
            segmenter.learn(frames[0], Seed(pixel=scene.seed_pixel(0)))
    taken: dict[str, list[float]] = {}
    for i, frame in enumerate(frames):
        for name, segmenter in ours.items():
            taken.setdefault(name, []).append(_milliseconds(segmenter.step, [frame]))
        for name, function in _references().items() if i % 5 == 0 else ():
            pair = [_gray(frame.left), _gray(frame.right)]
            taken.setdefault(name, []).append(_milliseconds(function, pair))
    return {name: float(np.median(values)) for name, values in taken.items()}


def _swings(config: SegmentationBench) -> dict[str, _Swing]:
    """How strongly and steadily every option shows the threads of all scenes while the light swings."""
    look = replace(config.picture, drift=_SWING)
    seen: dict[str, list[Float64]] = {name: [] for name in _OPTIONS}
    for scenario in config.scenarios:
        for k in range(config.seeds):
            scene = open_scene(scenario, config.first_seed + k, config.rig, picture=look)
            for name, strengths in _strengths(scene).items():
                seen[name] += strengths
    return {
        name: _Swing(
            float(np.median(strengths)),
            float(min(s.min() for s in strengths)),
            float(np.mean([100 * s.std() / s.mean() for s in strengths])),
        )
        for name, strengths in seen.items()
    }


def _strengths(scene: Scene) -> dict[str, list[Float64]]:
    """By option and thread: median length of the vectors on the thread at every moment."""
    segmenters = {name: Segmenter(scene.rig, config) for name, config in _OPTIONS.items()}
    taken: dict[str, dict[str, list[float]]] = {
        name: {thread: [] for thread in scene.threads} for name in _OPTIONS
    }
    largest = np.array(scene.rig.image_size) - 1
    for moment in _MOMENTS_S:
        i = round(moment * scene.fps)
        frame = StereoFrame(Stamp(i, 0, 0), *scene.render(i))
        shown = {t.thread: t.points[t.visible] for t in scene.truth(i)}
        for name, segmenter in segmenters.items():
            for thread in scene.threads if i == 0 and "no seed" not in name else ():
                segmenter.learn(frame, Seed(thread, pixel=scene.seed_pixel(0, thread)))
            length = np.linalg.norm(segmenter.step(frame).left, axis=-1)
            for thread, points in shown.items():
                pixels = np.rint(scene.rig.project(points)[0]).astype(int)
                u, v = np.clip(pixels, 0, largest).T
                taken[name][thread].append(float(np.median(length[v, u])))
                segmenter.adapt(frame, scene.rig.project_raw(points)[0], thread)
    return {
        name: [np.array(values) for values in threads.values()] for name, threads in taken.items()
    }


def _score(picture: _Picture, response: Response) -> tuple[float, float, float]:
    """Precision, recall and F1 of the left centreline at the threshold that suits the filter best."""
    from skimage.morphology import skeletonize

    truth = cKDTree(np.concatenate(picture.threads))
    best = (0.0, 0.0, 0.0)
    positive = response[response > 0]
    for q in np.linspace(0.5, 0.995, _THRESHOLDS):
        v, u = np.nonzero(skeletonize(response > np.quantile(positive, q)))
        if len(u) == 0:
            continue
        found = np.stack([u, v], axis=1).astype(float)
        precision = float(np.mean(truth.query(found)[0] <= _REACH_PX))
        tree = cKDTree(found)
        recall = min(float(np.mean(tree.query(t)[0] <= _REACH_PX)) for t in picture.threads)
        f1 = 2 * precision * recall / max(precision + recall, 1e-9)
        best = max(best, (precision, recall, f1), key=lambda x: x[2])
    return best


def _gray(image: Image) -> Response:
    gray = image if image.ndim == 2 else cv2.cvtColor(image, cv2.COLOR_BGR2GRAY)
    return gray.astype(np.float64) / 255


def _milliseconds(function: Callable[[T], object], arguments: list[T]) -> float:
    """Processor time, which is the same on a busy machine."""
    began = time.process_time()
    for argument in arguments:
        function(argument)
    return 1000 * (time.process_time() - began)
