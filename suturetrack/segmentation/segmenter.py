"""From a stereo pair to the ridge vector field: eq. (1) and Algorithm 1 (Section III)."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

from suturetrack.camera import StereoRig
from suturetrack.kernels import ridge, smears
from suturetrack.segmentation.colours import Colouring
from suturetrack.segmentation.config import SegmentationConfig
from suturetrack.segmentation.contrast import SIGMAS, Contrast, contrast_along, contrast_at
from suturetrack.segmentation.sight import SLOTS, Pair, Sight, first_look, learned_look
from suturetrack.segmentation.silhouette import is_cut_out, silhouette_scale, silhouettes
from suturetrack.segmentation.smear import Course
from suturetrack.types import (
    Colours,
    Float32,
    Float64,
    InputError,
    RidgeField,
    Seed,
    Stamp,
    StereoFrame,
)

# Share of the way that a learned contrast goes at each step.
_ADAPT = 0.2
# What is left at each step of the contrast of a thread that stays lost.
_FADE = 0.5
# Fewest pixels of a curve from which contrast is learned.
_FEWEST_PIXELS = 8


@dataclass(eq=False)
class _Learned:
    """A thread that was learned."""

    contrast: Contrast
    clear: Contrast
    """As it was when it was seen last."""
    sight: Sight
    course: Course


class Segmenter:
    """Turns stereo frames into ridge vector fields.

    Each learned thread is looked for in a field of its own; of several, the longest vectors make the
    field of all. Where a thread is known to move fast and does not show, it is looked for as a smear.
    The buffers of a field are used again four steps later; who keeps a field longer copies it.
    """

    def __init__(self, rig: StereoRig, config: SegmentationConfig = SegmentationConfig()) -> None:
        self._rig = rig
        self._config = config
        self._learned: dict[str, _Learned] = {}
        self._seeded: set[str] = set()
        self._before: dict[str, tuple[Contrast, Contrast]] = {}
        """Of threads that are looked for from another seed: both contrasts, as they were before it."""
        self._first = Sight(rig, config, first_look(config))
        self._colouring = Colouring(rig)
        self._all: Float32 | None = None
        self._steps = 0
        self._is_cut_out = False

    @property
    def threads(self) -> tuple[str, ...]:
        """Names of the threads that were learned."""
        return tuple(self._learned)

    @property
    def unlearned(self) -> frozenset[str]:
        """Names of the threads whose seeds have taught nothing."""
        return frozenset(self._seeded - self._learned.keys())

    def check(self, frame: StereoFrame) -> None:
        """Raises InputError unless the images are uint8, gray or BGR, of the rig's size, and alike."""
        width, height = self._rig.image_size
        for name, image in (("left", frame.left), ("right", frame.right)):
            if image.dtype != np.uint8:
                raise InputError(f"{name} image: {image.dtype} pixels; 8-bit pixels are expected")
            if image.shape[:2] != (height, width) or image.shape[2:] not in ((), (3,)):
                raise InputError(
                    f"{name} image: shape {image.shape}; ({height}, {width}) gray or "
                    f"({height}, {width}, 3) BGR fits the calibration"
                )
        if frame.left.ndim != frame.right.ndim:
            raise InputError("one image is gray and the other in colour; both must be alike")

    def step(self, frame: StereoFrame) -> RidgeField:
        """The field of `frame`, in rectified pixels.

        Raises:
            InputError: as `check`.
        """
        self.check(frame)
        frame = self._seen(frame)
        slot = self._steps % SLOTS
        self._steps += 1
        now_ns = frame.stamp.capture_ns
        own = {
            name: thread.sight.step(frame, slot, thread.course.bands(now_ns, self._rig))
            for name, thread in self._learned.items()
        }
        if len(own) > 1:
            field = joined(frame.stamp, own, out=self._room_for_all(slot))
        else:
            pair = own.popitem()[1] if own else self._first.step(frame, slot)
            field = RidgeField(frame.stamp, *pair)
        return replace(field, colours=self._colouring.of(frame, field.left, field.right))

    def learn(self, frame: StereoFrame, seed: Seed) -> None:
        """Learn at `seed` what tells its thread from the surroundings: colours, width, contrast.

        A seed with no ridge within 8 px teaches nothing. Where the thread was cut out of its picture,
        only its outline counts from then on.

        Raises:
            InputError: as `check`, or the seed is outside the left image, or behind the camera.
        """
        self.check(frame)
        own = self._config.channel == "learned" and self._config.polarity == "auto"
        self._is_cut_out = own and is_cut_out(frame)
        frame = self._seen(frame)
        image = self._rig.rectify(frame.left, frame.right)[0]
        contrast = contrast_at(image, self._rig.locate(seed))
        self._seeded.add(seed.thread)
        if contrast is not None:
            if self._is_cut_out:
                contrast = replace(contrast, sigma=max(silhouette_scale(frame.left), SIGMAS[0]))
            self._look_for(seed.thread, contrast, contrast)

    def remember(self, thread: str) -> None:
        """Keep aside what was learned of a thread, until another seed at it is settled."""
        known = self._learned.get(thread)
        if known is not None:
            self._before.setdefault(thread, (known.contrast, known.clear))

    def settle(self, thread: str, *, is_found: bool) -> None:
        """Keep what the seed has taught, if the thread was found from it, else what was remembered."""
        before = self._before.pop(thread, None)
        if before is not None and not is_found:
            self._look_for(thread, *before)

    def forget(self, thread: str) -> None:
        """Look for a thread no more; without any, look as before the first was learned."""
        self._seeded.discard(thread)
        self._before.pop(thread, None)
        if self._learned.pop(thread, None) is not None:
            self._is_cut_out &= bool(self._learned)

    def adapt(self, frame: StereoFrame, pixels: Float64, thread: str = "0") -> None:
        """Follow slow changes of the light: go a part of the way to what a held curve shows.

        Args:
            frame: the frame that the curve belongs to.
            pixels: (N, 2) raw left pixels along the curve, where the thread is seen.
            thread: which thread this is; one that was never learned is left alone, and every one
            where the configuration says so.

        Raises:
            InputError: as `check`.
        """
        self.check(frame)
        frame = self._seen(frame)
        width, height = self._rig.image_size
        inside = (pixels >= 0).all(1) & (pixels <= (width - 1, height - 1)).all(1)
        known = self._learned.get(thread) if self._config.adapt else None
        if known is None or np.count_nonzero(inside) < _FEWEST_PIXELS:
            return
        seen = contrast_along(frame.left, pixels[inside], known.contrast.sigma)
        # What was lost may be as clear as before, or as faint as it was found again.
        nearer = min(known.contrast, known.clear, key=lambda c: abs(c.strength - seen.strength))
        followed = nearer.follow(seen, _ADAPT)
        if followed is not nearer:
            self._look_for(thread, followed, followed)

    def follow(self, capture_ns: int, points: Float64, thread: str = "0") -> None:
        """Know where a thread was, and so how fast it moves.

        Args:
            capture_ns: when.
            points: (k, 3) evenly along its curve, rectified left frame, calibration's unit; always as many.
            thread: which thread this is; one that was never learned is left alone.
        """
        if thread in self._learned:
            self._learned[thread].course.learn(capture_ns, points)

    def fade(self, thread: str = "0") -> None:
        """Look for a thread that is lost as if it stood out less than before, down to a quarter of what
        it did when it was seen last.

        Focus, smoke or light may have changed at once, when no curve is held that could show it.
        """
        known = self._learned.get(thread) if self._config.adapt else None
        if known is not None:
            self._look_for(thread, known.contrast.fainter(_FADE, known.clear), known.clear)

    def warm_up(self) -> None:
        """Compile (or load) the kernels, so that the first frame is as quick as the next."""
        width, height = self._rig.image_size
        # Learned, so that rims fade as well.
        sight = Sight(self._rig, self._config, replace(self._first.look, relative=True))
        for shape in ((height, width, 3), (height, width)):
            black = np.zeros(shape, np.uint8)
            frame = StereoFrame(Stamp(0, 0, 0), black, black)
            field = sight.step(frame, 0)
            ridge.keep_longer(field[0], field[1])
            self._colouring.of(frame, *field)
        smears.find_longer_than(1.0, field[0], black)
        smears.keep_longer_of_half(field[0], black, (1.0, 2.0), black, field[1])

    def _seen(self, frame: StereoFrame) -> StereoFrame:
        return silhouettes(frame) if self._is_cut_out else frame

    def _look_for(self, thread: str, contrast: Contrast, clear: Contrast) -> None:
        look, known = learned_look(self._config, contrast), self._learned.get(thread)
        if known is None:
            sight = Sight(self._rig, self._config, look)
            self._learned[thread] = _Learned(contrast, clear, sight, Course())
        else:
            known.contrast, known.clear, known.sight.look = contrast, clear, look

    def _room_for_all(self, slot: int) -> Pair:
        width, height = self._rig.image_size
        if self._all is None:
            self._all = np.empty((SLOTS, 2, height, width, 2), np.float32)
        left, right = self._all[slot]
        return left, right


def joined(
    stamp: Stamp,
    own: Mapping[str, Pair],
    colours: tuple[Colours, Colours] | None = None,
    out: Pair | None = None,
) -> RidgeField:
    """The field of several threads: at each pixel the longest of their vectors.

    Args:
        stamp: of the frame.
        own: by thread, left and right, (H, W, 2) float32 each.
        colours: of the left and the right view.
        out: where to put left and right; without it, new arrays that nobody may write to.
    """
    first, *others = own.values()
    left, right = out or (np.empty_like(first[0]), np.empty_like(first[1]))
    for side, longest in enumerate((left, right)):
        np.copyto(longest, first[side])
        for other in others:
            ridge.keep_longer(other[side], longest)
        longest.flags.writeable = out is not None
    return RidgeField(stamp, left, right, own, colours)
