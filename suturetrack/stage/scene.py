"""One synthetic sequence: a scenario varied by a seed, seen by a rig."""

from __future__ import annotations

import numpy as np

from suturetrack.camera import LARGEST_SIDE, StereoRig
from suturetrack.kernels import tubes
from suturetrack.polylines import polyline_length
from suturetrack.stage import appearance, background, clutter
from suturetrack.stage.appearance import COLOURS, LIMITS, Look, Picture
from suturetrack.stage.background import TEXTURES
from suturetrack.stage.cameras import (
    RIGS,
    Viewpoint,
    choose_viewpoint,
    folds_back,
    make_rig,
    misalign,
    push_out,
)
from suturetrack.stage.painter import Painter, Strand, gripper_strands
from suturetrack.stage.play import Play
from suturetrack.stage.scenarios import SCENARIOS, Scenario
from suturetrack.types import Bool, Float32, Float64, Image, InputError, Stamp, Truth

DEFAULT_PICTURE = Picture()
# How finely centrelines are sampled: by the pixel, and never finer than that by the mm.
_SAMPLES_PER_PX, _MOST_SAMPLES_PER_MM = 0.6, 4.0
_MARGIN = 0.05
_HOLE_RADIUS = 0.9
_MOST_EXPOSURES = 12
# How far other strands stay from a seed.
_CLEAR_PX = 10.0


def open_scene(
    name: str,
    seed: int = 0,
    rig: str = "bench",
    fps: float = 30.0,
    picture: Picture = DEFAULT_PICTURE,
) -> Scene:
    """The scenario `name`, varied by `seed`, seen by the rig with that name.

    Args:
        name: one of `SCENARIOS`.
        seed: a number from 0 up; every one gives another shape, viewpoint, timing and look.
        rig: one of `RIGS`.
        fps: frames a second.
        picture: how the images are taken and look.

    Raises:
        InputError: there is no such scenario, rig, colour or background, or a number is impossible.
    """
    if name not in SCENARIOS:
        raise InputError(f"no scenario {name!r}; use one of {', '.join(SCENARIOS)}")
    if seed < 0:
        raise InputError(f"seed {seed} of the scene: use a whole number from 0 up")
    if min(picture.size) < 64 or max(picture.size) > LARGEST_SIDE or fps <= 0:
        width, height = picture.size
        raise InputError(
            f"images of {width}x{height} at {fps} fps: use sides of 64 to {LARGEST_SIDE} px, above 0 fps"
        )
    for setting, (lowest, highest) in LIMITS.items():
        value = getattr(picture, setting)
        if value is not None and not lowest <= value <= highest:
            raise InputError(f"picture.{setting} {value:g}: use {lowest:g} to {highest:g}")
    for what, known in ((picture.thread, COLOURS), (picture.background, TEXTURES)):
        if what is not None and what not in known:
            raise InputError(f"no look {what!r}; use one of {', '.join(known)}")
    told = make_rig(rig, picture.size, picture.distortion)
    rng = np.random.default_rng([seed, 1])
    real = told
    if picture.calibration_error_px or picture.half_pixel:
        real = misalign(told, rng, picture.calibration_error_px, picture.half_pixel)
    return Scene(SCENARIOS[name], seed, told, real, RIGS[rig].distances, fps, picture)


class Scene:
    """Frames and the truth behind them; the same to the bit for the same arguments.

    Attributes:
        rig: the cameras as calibrated; lengths in mm.
        fps: frames a second.
        frame_count: how many frames there are.
        threads: names of the threads.
    """

    rig: StereoRig
    fps: float
    frame_count: int
    threads: tuple[str, ...]

    def __init__(
        self,
        scenario: Scenario,
        seed: int,
        rig: StereoRig,
        real_rig: StereoRig,
        distances: tuple[float, float],
        fps: float,
        picture: Picture,
    ) -> None:
        rng = np.random.default_rng(seed)
        self.rig, self.fps, self._real_rig = rig, fps, real_rig
        self.frame_count = round(scenario.seconds * fps)
        self._seed, self._scenario = seed, scenario
        per_mm = min(_SAMPLES_PER_PX * rig.focal / distances[1], _MOST_SAMPLES_PER_MM)
        self._play = Play(scenario, rng, per_mm)
        self.threads = self._play.threads
        self._view = self._choose_view(rng, distances)
        self._look = Look.draw(rng, picture)
        self._surfaces = {
            thread: COLOURS[picture.thread or rng.choice(model.colours)]
            for thread, model in zip(self.threads, scenario.threads, strict=True)
        }
        self._shutter = scenario.shutter if picture.shutter is None else picture.shutter
        self._noise = appearance.noise_pool(rng, rig.image_size)
        texture = TEXTURES[picture.background or rng.choice(scenario.backgrounds)](rng)
        self._painters = self._set_the_table(rng, texture)

    def truth(self, i: int) -> tuple[Truth, ...]:
        """Where every thread is in frame `i`, in the order of `threads`."""
        capture = round(i * 1e9 / self.fps)
        stamp = Stamp(i, capture, capture)
        tools = [s for s in self._strands(i / self.fps) if s.is_tool]
        truths = []
        for thread in self.threads:
            points = self._view.to_camera(self._play.centreline(thread, i / self.fps))
            visible = self._visible(points, tools)
            truths.append(Truth(stamp, thread, points, polyline_length(points), visible))
        return tuple(truths)

    def seed_pixel(self, i: int = 0, thread: str | None = None) -> tuple[float, float]:
        """(u, v) in the raw left image of frame `i`, on the thread, where a person would click.

        Near the middle of what is seen of the thread, clear of other strands where that is possible.

        Raises:
            InputError: there is no such thread.
        """
        thread = self.threads[0] if thread is None else thread
        if thread not in self.threads:
            raise InputError(f"no thread {thread!r}; use one of {', '.join(self.threads)}")
        truths = self.truth(i)
        pixels = [self._real_rig.project_raw(t.points)[0] for t in truths]
        own = self.threads.index(thread)
        strands = np.concatenate([pixels.pop(own), *pixels])
        visible = truths[own].visible
        count = len(visible)
        gap = np.linalg.norm(strands[:count, None] - strands, axis=2)
        travelled = np.r_[0, np.cumsum(np.linalg.norm(np.diff(strands[:count], axis=0), axis=1))]
        gap[:, :count][np.abs(np.subtract.outer(travelled, travelled)) < 3 * _CLEAR_PX] = np.inf
        off_centre = np.abs(np.linspace(-0.5, 0.5, count))
        crowded = np.maximum(_CLEAR_PX - gap.min(axis=1), 0)
        chosen = int(np.argmin(off_centre + crowded + 1e3 * ~visible))
        return float(strands[chosen, 0]), float(strands[chosen, 1])

    def render(self, i: int) -> tuple[Image, Image]:
        """The images of frame `i`: (H, W, 3) uint8 BGR, left and right."""
        rng = np.random.default_rng([self._seed, i])
        time = i / self.fps
        moments = [self._strands(t) for t in self._moments(time)]
        gain = self._look.gain(time)
        left, right = (self._expose(painter, moments, gain, rng) for painter in self._painters)
        return left, right

    def _expose(
        self,
        painter: Painter,
        moments: list[list[Strand]],
        gain: Float32,
        rng: np.random.Generator,
    ) -> Image:
        for strands in moments:
            painter.expose(strands, 1 / len(moments))
        width, height = self.rig.image_size
        row, column = rng.integers(0, 64, 2)
        picture = painter.develop(gain, self._noise[row : row + height, column : column + width])
        return appearance.compressed(picture, self._look.jpeg)

    def _moments(self, time: float) -> Float64:
        """Times spread over the exposure around `time`, one for every 2 px that something moves."""
        open_for = self._shutter / self.fps
        marks = [_marks(self._strands(time + way * open_for / 2)) for way in (-1, 1)]
        pixels = [self._real_rig.project_raw(self._view.to_camera(m))[0] for m in marks]
        shown = np.all((pixels[0] >= 0) & (pixels[0] < self.rig.image_size), axis=1)
        moved = np.linalg.norm(pixels[1] - pixels[0], axis=1) * shown
        count = int(np.clip(np.ceil(moved.max() / 2), 1, _MOST_EXPOSURES))
        return time + open_for * ((np.arange(count) + 0.5) / count - 0.5)

    def _strands(self, time: float) -> list[Strand]:
        strands = [
            Strand(
                self._play.centreline(thread, time),
                np.array([model.diameter / 2]),
                self._surfaces[thread],
            )
            for thread, model in zip(self.threads, self._scenario.threads, strict=True)
        ]
        gripper = self._play.gripper(time)
        return strands if gripper is None else strands + gripper_strands(gripper)

    def _visible(self, points: Float64, tools: list[Strand]) -> Bool:
        """(N,) whether both cameras see (N, 3) points: inside the images and behind no tool."""
        size = np.array(self.rig.image_size)
        visible = np.ones(len(points), bool)
        aside = folds_back(self._real_rig, points)
        for view, is_aside in zip(self._real_rig.project_raw(points), aside, strict=True):
            visible &= np.all((view >= -0.5) & (view <= size - 0.5), axis=1) & ~is_aside
        for painter in self._painters:
            for tool in tools:
                visible &= ~painter.hides(tool, points)
        return visible

    def _choose_view(self, rng: np.random.Generator, distances: tuple[float, float]) -> Viewpoint:
        scenario = self._scenario
        until = 0.0 if scenario.end_leaves else scenario.seconds
        points = self._play.everywhere(until)
        view = choose_viewpoint(rng, self.rig, distances, points, _MARGIN)
        if not scenario.end_leaves:
            return view
        ends = np.array([self._play.centreline("0", t)[-1] for t in np.arange(0, 20, 0.25)])
        farthest = ends[np.argmax(np.linalg.norm(ends - ends[0], axis=1))]
        return push_out(view, self.rig, points, np.array([ends[0], farthest]), _MARGIN)

    def _set_the_table(self, rng: np.random.Generator, texture: Float32) -> list[Painter]:
        start = self._play.centreline("0", 0.0)
        strays: list[Strand] = []
        if any(model.length is None for model in self._scenario.threads):
            texture = background.with_hole(texture, self._play.hole()[:2], _HOLE_RADIUS)
        if self._scenario.clutter:
            lines = clutter.misleading_lines(rng, start)
            texture = background.with_veins(texture, rng, lines, (0.5, 0.8))
            radius = self._scenario.threads[0].diameter / 2
            strays = clutter.stray_threads(rng, start, self._surfaces["0"], radius)
        views = background.look_at(texture, self._real_rig, self._view, self._look.blur_px)
        focus = float(self._view.to_camera(start)[:, 2].mean())
        fragments = tubes.make_fragments(self.rig.image_size)
        painters = []
        for right, image in enumerate(views):
            painter = Painter(
                self._real_rig, bool(right), self._view, self._look, image, focus, fragments
            )
            if strays:
                painter.expose(strays, 1.0)
                painter.bake()
            painters.append(painter)
        return painters


def _marks(strands: list[Strand]) -> Float64:
    """(16 k, 3) points spread over k strands."""
    spread = [np.linspace(0, len(s.points) - 1, 16).astype(int) for s in strands]
    return np.concatenate([s.points[i] for s, i in zip(strands, spread, strict=True)])
