"""`suturetrack bench segmentation`: time and centreline quality beside scikit-image's ridge filters."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Any, TypeVar

import cv2
import numpy as np
from numpy.typing import NDArray
from rich.console import Console
from scipy.spatial import cKDTree

from services.bench import report
from suturetrack.contrast import SIGMAS
from suturetrack.segmentation import Channel, SegmentationConfig, Segmenter
from suturetrack.stage import Scene, open_scene
from suturetrack.types import Image, InputError, Seed, Stamp, StereoFrame

T = TypeVar("T")
Response = NDArray[Any]
_REACH_PX = 2.0
_THRESHOLDS = 24


@dataclass(frozen=True)
class SegmentationBench:
    """Milliseconds a stereo pair, and precision and recall of the thread's centreline."""

    scenarios: tuple[str, ...] = ("figure8-175", "clutter", "crossings")
    """Scenes to segment."""
    seeds: int = 3
    """Fresh seeds of each."""
    first_seed: int = 100
    """The seeds count from here."""
    rig: str = "bench"
    """The rig of the scenes."""
    repeats: int = 30
    """Frames timed; the references are timed on a fifth of them, in turns."""


@dataclass(frozen=True)
class Row:
    """One filter over all scenes; the worst scene beside the mean."""

    filter: str
    pair_ms: float
    """Median time of a stereo pair."""
    times_as_fast_as_frangi: float
    precision: float
    """Share of the found centreline within 2 px of the thread, at the threshold with the best F1."""
    recall: float
    """Share of the thread within 2 px of the found centreline."""
    f1: float
    worst_f1: float


def rows(config: SegmentationBench) -> list[Row]:
    """Runs every filter over every scene; times all of them in turns in one go."""
    scenes = [
        open_scene(name, config.first_seed + k, config.rig)
        for name in config.scenarios
        for k in range(config.seeds)
    ]
    timings = _timings(scenes[0], config.repeats)
    reference = timings["frangi (scikit-image)"]
    table = []
    for name, respond in _filters().items():
        scores = np.array([_score(scene, respond) for scene in scenes])
        precision, recall, f1 = scores.mean(0)
        ms = timings[name]
        row = Row(name, ms, reference / ms, precision, recall, f1, float(scores[:, 2].min()))
        table.append(row)
    return table


def run(config: SegmentationBench, console: Console) -> list[Row]:
    """Prints the table."""
    table = rows(config)
    report.print_rows(console, "Segmentation, a stereo pair", table)
    return table


_CHANNELS: dict[str, Channel] = {"learned mix": "learned", "gray": "gray", "red": "red"}


def _filters() -> dict[str, Callable[[Scene], Response]]:
    """Name -> response of the left view of a scene's first frame, (H, W)."""
    filters: dict[str, Callable[[Scene], Response]] = {}
    for label, channel in _CHANNELS.items():
        filters[f"ours, {label}"] = partial(_ours, channel)
    for name, function in _references().items():
        filters[name] = partial(_theirs, function)
    return filters


def _ours(channel: Channel, scene: Scene) -> Response:
    segmenter = Segmenter(scene.rig, SegmentationConfig(channel=channel))
    frame = StereoFrame(Stamp(0, 0, 0), *scene.render(0))
    for name in scene.threads:
        segmenter.learn(frame, Seed(name, pixel=scene.seed_pixel(0, name)))
    return np.linalg.norm(segmenter.step(frame).left, axis=-1)


def _theirs(function: Callable[[Response], Response], scene: Scene) -> Response:
    return function(_gray(scene.render(0)[0]))


def _references() -> dict[str, Callable[[Response], Response]]:
    try:
        from skimage import filters
    except ModuleNotFoundError as error:
        raise InputError(
            "bench segmentation compares with scikit-image: pip install 'suturetrack[bench]'"
        ) from error
    sigma = SIGMAS[:1]
    return {
        f"{name} (scikit-image)": partial(getattr(filters, name), sigmas=sigma, black_ridges=True)
        for name in ("frangi", "sato", "meijering")
    }


def _timings(scene: Scene, repeats: int) -> dict[str, float]:
    """Median ms a pair of every filter, timed in turns so that all meet the same machine."""
    frames = [StereoFrame(Stamp(i, 0, 0), *scene.render(i)) for i in range(repeats)]
    ours = {
        f"ours, {label}": Segmenter(scene.rig, SegmentationConfig(channel=channel))
        for label, channel in _CHANNELS.items()
    }
    for segmenter in ours.values():
        segmenter.warm_up()
    taken: dict[str, list[float]] = {}
    for i, frame in enumerate(frames):
        for name, segmenter in ours.items():
            taken.setdefault(name, []).append(_milliseconds(segmenter.step, [frame]))
        for name, function in _references().items() if i % 5 == 0 else ():
            pair = [_gray(frame.left), _gray(frame.right)]
            taken.setdefault(name, []).append(_milliseconds(function, pair))
    return {name: float(np.median(values)) for name, values in taken.items()}


def _score(scene: Scene, respond: Callable[[Scene], Response]) -> tuple[float, float, float]:
    """Precision, recall and F1 of the left centreline at the threshold that suits the filter best."""
    from skimage.morphology import skeletonize

    response = respond(scene)
    truth = np.concatenate([scene.rig.project(t.points[t.visible])[0] for t in scene.truth(0)])
    best = (0.0, 0.0, 0.0)
    positive = response[response > 0]
    for q in np.linspace(0.5, 0.995, _THRESHOLDS):
        v, u = np.nonzero(skeletonize(response > np.quantile(positive, q)))
        if len(u) == 0:
            continue
        found = np.stack([u, v], axis=1).astype(float)
        precision = float(np.mean(cKDTree(truth).query(found)[0] <= _REACH_PX))
        recall = float(np.mean(cKDTree(found).query(truth)[0] <= _REACH_PX))
        f1 = 2 * precision * recall / max(precision + recall, 1e-9)
        best = max(best, (precision, recall, f1), key=lambda x: x[2])
    return best


def _gray(image: Image) -> Response:
    gray = image if image.ndim == 2 else cv2.cvtColor(image, cv2.COLOR_BGR2GRAY)
    return gray.astype(np.float64) / 255


def _milliseconds(function: Callable[[T], object], arguments: list[T]) -> float:
    began = time.perf_counter()
    for argument in arguments:
        function(argument)
    return 1000 * (time.perf_counter() - began)
