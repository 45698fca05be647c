"""The beginning of any recorded source there and back, without end: for soaks and for loads."""

from __future__ import annotations

from dataclasses import replace

from services.sources.footage import Exposure, Footage
from suturetrack.types import InputError


class LoopFootage:
    """The first frames of another source, from memory, so that releasing one costs next to nothing."""

    live = False
    frame_count: int | None = None

    def __init__(self, footage: Footage, count: int):
        """Raises InputError for a camera, or where there are too few frames."""
        if footage.live:
            raise InputError("--loop needs recorded input; a camera never ends")
        if not 2 <= count <= (footage.frame_count or count):
            raise InputError(f"--loop {count}: use 2 or more, and no more frames than there are")
        self._footage, self._count = footage, count
        self._exposures: list[Exposure] = []
        self.size, self.fps, self.seeds = footage.size, footage.fps, footage.seeds

    def read(self, index: int) -> Exposure | None:
        """See `Footage`."""
        there = index % (2 * self._count - 2)
        place = min(there, 2 * self._count - 2 - there)
        while len(self._exposures) <= place:
            exposure = self._footage.read(len(self._exposures))
            if exposure is None:
                return None
            self._exposures.append(exposure)
        exposure = self._exposures[place]
        skipped = exposure.skipped if index == place else 0  # counted on the first way there
        return replace(exposure, capture_ns=round(index * 1e9 / self.fps), skipped=skipped)

    def close(self) -> None:
        """See `Footage`."""
        self._footage.close()
