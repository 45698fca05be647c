"""One synthetic sequence: a scenario varied by a seed, seen by a rig."""

from __future__ import annotations

import numpy as np

from suturetrack.camera import StereoRig
from suturetrack.kernels import tubes
from suturetrack.stage import appearance
from suturetrack.stage.appearance import COLOURS, DEFAULT_PICTURE, Picture
from suturetrack.stage.background import TEXTURES, look
from suturetrack.stage.cameras import RIGS, choose_viewpoint, make_rig
from suturetrack.stage.motion import Motion, Warp, load_motion, smoothing_matrix, with_length
from suturetrack.stage.scenarios import SCENARIOS, Scenario
from suturetrack.types import Bool, Float64, Image, InputError, Stamp, Truth

_LENS_BLUR_PX = 0.55
_SAMPLES_PER_PX = 0.8


def open_scene(
    name: str,
    seed: int = 0,
    rig: str = "bench",
    size: tuple[int, int] = (640, 480),
    fps: float = 30.0,
    picture: Picture = DEFAULT_PICTURE,
) -> Scene:
    """The scenario `name`, varied by `seed`, seen by the rig with that name.

    Args:
        name: one of `SCENARIOS`.
        seed: a number from 0 up; every one gives another shape, viewpoint, timing and look.
        rig: one of `RIGS`.
        size: width and height of the images, px.
        fps: frames a second.
        picture: how the images look.

    Raises:
        InputError: there is no such scenario, rig, colour or background, or the seed is negative.
    """
    if name not in SCENARIOS:
        raise InputError(f"no scenario {name!r}; use one of {', '.join(SCENARIOS)}")
    if seed < 0:
        raise InputError(f"seed {seed} of the scene: use a whole number from 0 up")
    for what, known in ((picture.thread, COLOURS), (picture.background, TEXTURES)):
        if what is not None and what not in known:
            raise InputError(f"no look {what!r}; use one of {', '.join(known)}")
    return Scene(SCENARIOS[name], seed, rig, size, fps, picture)


class Scene:
    """Frames and the truth behind them; the same to the bit for the same arguments.

    Attributes:
        rig: the calibrated cameras; lengths in mm.
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
        rig: str,
        size: tuple[int, int],
        fps: float,
        picture: Picture,
    ) -> None:
        rng = np.random.default_rng(seed)
        self.rig, self.fps = make_rig(rig, size), fps
        self.threads = tuple(str(i) for i in range(len(scenario.threads)))
        self._models = dict(zip(self.threads, scenario.threads, strict=True))
        self._motion = load_motion(scenario.motion)
        self._warp = Warp.draw(rng)
        self._rate, self._start = self._timing(rng, scenario)
        self.frame_count = round(scenario.seconds * fps)
        everywhere = np.concatenate(
            [self._warp(t).reshape(-1, 3) for t in self._motion.tracks.values()]
        )
        distances = RIGS[rig].distances
        self._view = choose_viewpoint(rng, self.rig, distances, everywhere, margin=0.05)
        pixels_per_mm = self.rig.focal / distances[0]
        self._smoothing = {
            thread: smoothing_matrix(
                self._motion.tracks[f"thread{thread}"].shape[1],
                int(model.length * pixels_per_mm * _SAMPLES_PER_PX),
            )
            for thread, model in self._models.items()
        }
        self._light = appearance.Light.draw(rng)
        self._shadow = self._light.shadow if picture.shadow is None else picture.shadow
        self._colours = {
            t: picture.thread or rng.choice(m.colours) for t, m in self._models.items()
        }
        texture = TEXTURES[picture.background or rng.choice(scenario.backgrounds)](rng)
        self._backgrounds = look(texture, self.rig, self._view, _LENS_BLUR_PX)
        self._vignette = appearance.vignetting(size, rng.uniform(0.05, 0.25))
        self._noise = appearance.noise_pool(rng, size)
        self._fragments = tubes.make_fragments(size)
        self._layer = np.zeros((size[1], size[0], 4), np.float32)
        self._seed, self._picture = seed, picture

    def truth(self, i: int) -> tuple[Truth, ...]:
        """Where every thread is in frame `i`, in the order of `threads`."""
        capture = round(i * 1e9 / self.fps)
        stamp = Stamp(i, capture, capture)
        truths = []
        for thread in self.threads:
            points = self._view.to_camera(self._centreline(thread, i / self.fps))
            length = float(np.linalg.norm(np.diff(points, axis=0), axis=1).sum())
            truths.append(Truth(stamp, thread, points, length, self._visible(points)))
        return tuple(truths)

    def seed_pixel(self, i: int = 0, thread: str | None = None) -> tuple[float, float]:
        """(u, v) in the raw left image of frame `i` of a visible point well inside the thread.

        Raises:
            InputError: there is no such thread.
        """
        thread = self.threads[0] if thread is None else thread
        if thread not in self.threads:
            raise InputError(f"no thread {thread!r}; use one of {', '.join(self.threads)}")
        truth = self.truth(i)[self.threads.index(thread)]
        pixels = self.rig.project_raw(truth.points)[0]
        inner = np.arange(len(pixels) // 5, len(pixels) - len(pixels) // 5)
        shown = inner[truth.visible[inner]]
        chosen = shown[len(shown) // 2] if len(shown) else len(pixels) // 2
        return float(pixels[chosen, 0]), float(pixels[chosen, 1])

    def render(self, i: int) -> tuple[Image, Image]:
        """The images of frame `i`: (H, W, 3) uint8 BGR, left and right."""
        rng = np.random.default_rng([self._seed, i])
        strands = [(t, self._centreline(t, i / self.fps)) for t in self.threads]
        left, right_image = (self._expose(strands, right, rng) for right in (False, True))
        return left, right_image

    def _expose(
        self, strands: list[tuple[str, Float64]], right: bool, rng: np.random.Generator
    ) -> Image:
        for thread, points in strands:
            if self._shadow:
                self._draw_shadow(points, self._models[thread].diameter / 2, right)
            self._draw(points, thread, right)
        tubes.composite(self._fragments, self._layer, 1.0)
        height, width = self._vignette.shape
        row, column = rng.integers(0, 64, 2)
        picture = np.empty((height, width, 3), np.uint8)
        tubes.develop(
            self._backgrounds[right],
            self._layer,
            self._vignette,
            np.ones(3, np.float32),
            self._noise[row : row + height, column : column + width],
            np.float32(self._picture.noise / 16),
            picture,
        )
        return picture

    def _draw(self, table_points: Float64, thread: str, right: bool) -> None:
        points = self._view.to_camera(table_points)
        colour, gloss = appearance.COLOURS[self._colours[thread]]
        path = self._path(points, self._models[thread].diameter / 2, right)
        light = self._view.rotation @ self._light.direction
        first = self._fragments.used[0]
        tubes.splat(0, path, 24, self._fragments)
        tubes.shade(
            first,
            path,
            appearance.shading(points, light),
            np.tile(np.array(colour), (len(points), 1)),
            np.array(gloss),
            self._fragments,
        )

    def _draw_shadow(self, table_points: Float64, radius: float, right: bool) -> None:
        height = table_points[::4, 2]
        light = self._light.direction
        fallen = table_points[::4] - light * (height / light[2])[:, None]
        path = self._path(self._view.to_camera(fallen), radius, right)
        path[:, 4] = np.minimum(np.hypot(path[:, 4], 0.12 * height * path[:, 3] / radius), 3.0)
        path[:, 2] = np.inf
        first = self._fragments.used[0]
        tubes.splat(1, path, 10, self._fragments)
        tubes.shade(
            first,
            path,
            np.zeros((len(path), 4)),
            np.zeros((len(path), 3)),
            np.array([1.0, 0.0, 1.0]),
            self._fragments,
        )
        self._fragments.value[first : self._fragments.used[0], 3] *= self._shadow

    def _path(self, points: Float64, radius: float, right: bool) -> Float64:
        """(n, 5) for `tubes.splat`."""
        pixels = self.rig.project_raw(points)[right]
        depth = points[:, 2]
        radius_px = radius * self.rig.focal / depth
        blur = np.full(len(points), np.hypot(_LENS_BLUR_PX, np.sqrt(1 / 12)))
        return np.ascontiguousarray(np.column_stack([pixels, depth, radius_px, blur]))

    def _centreline(self, thread: str, time: float) -> Float64:
        """(N, 3) points of the thread at `time` in seconds, table's frame."""
        nodes = self._motion.at(f"thread{thread}", self._start + self._rate * time)
        points = self._smoothing[thread] @ self._warp(nodes)
        return with_length(points, self._models[thread].length)

    def _visible(self, points: Float64) -> Bool:
        size = np.array(self.rig.image_size)
        inside = [
            np.all((view >= -0.5) & (view <= size - 0.5), axis=1)
            for view in self.rig.project_raw(points)
        ]
        return np.asarray(inside[0] & inside[1])

    def _timing(self, rng: np.random.Generator, scenario: Scenario) -> tuple[float, float]:
        """How fast the motion is played, and from which second on."""
        rate = rng.uniform(0.85, 1.0)
        if scenario.top_speed is not None:
            fastest = max(_top_speed(self._motion, n, self._warp) for n in self._motion.tracks)
            rate *= min(1.0, scenario.top_speed / fastest)
        spare = max(self._motion.duration - rate * scenario.seconds, 0.0)
        return rate, rng.uniform(0, spare)


def _top_speed(motion: Motion, name: str, warp: Warp) -> float:
    """Fastest speed of the ends of a track, mm/s."""
    ends = warp(motion.tracks[name][:, [0, -1]])
    return float(np.linalg.norm(np.diff(ends, axis=0), axis=2).max()) * motion.rate_hz
