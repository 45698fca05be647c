"""The beginning of any recorded source there and back, without end: for soaks and for loads."""

from __future__ import annotations

from dataclasses import replace

import psutil

from services.sources.footage import Exposure, Footage
from suturetrack.types import InputError

_SHARE = 0.5
"""Of the free memory that the images may fill; who works on them needs some, too."""


class LoopFootage:
    """The first frames of another source, from memory, so that releasing one costs next to nothing."""

    live = False
    frame_count: int | None = None

    def __init__(self, footage: Footage, count: int):
        """Raises InputError for a camera, or for more frames than there are or than memory holds."""
        if footage.live:
            raise InputError("--loop needs recorded input; a camera never ends")
        self._footage, self._count = footage, count
        if not 2 <= count <= (footage.frame_count or count):
            raise self._fault(footage.frame_count)
        width, height = footage.size
        frame_bytes = 2 * 3 * width * height  # both images, in colour
        most = int(_SHARE * psutil.virtual_memory().available / frame_bytes)
        if count > most:
            raise InputError(
                f"--loop {count}: {count * frame_bytes / 1e9:.1f} GB of images do not fit into half of the "
                f"memory that is free; use {most} or fewer"
            )
        self._exposures: list[Exposure] = []
        self.size, self.fps, self.seeds = footage.size, footage.fps, footage.seeds

    def read(self, index: int) -> Exposure:
        """See `Footage`; that there are too few frames may show only here."""
        there = index % (2 * self._count - 2)
        place = min(there, 2 * self._count - 2 - there)
        while len(self._exposures) <= place:
            exposure = self._footage.read(len(self._exposures))
            if exposure is None:
                raise self._fault(len(self._exposures))
            self._exposures.append(exposure)
        exposure = self._exposures[place]
        skipped = exposure.skipped if index == place else 0  # counted on the first way there
        return replace(exposure, capture_ns=round(index * 1e9 / self.fps), skipped=skipped)

    def _fault(self, there: int | None) -> InputError:
        limit = "" if there is None else f", and no more than the {there} frames that there are"
        return InputError(f"--loop {self._count}: use 2 or more{limit}")

    def close(self) -> None:
        """See `Footage`."""
        self._footage.close()
