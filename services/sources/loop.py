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
        self._footage, self._count = footage, count
        if not 2 <= count <= (footage.frame_count or count):
            raise self._fault(footage.frame_count)
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
