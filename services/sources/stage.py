"""The synthetic bench top."""

from __future__ import annotations

from services.sources.footage import Exposure
from suturetrack.stage import Picture, open_scene


class StageFootage:
    """A scene that is rendered as it is read."""

    live = False

    def __init__(self, name: str, seed: int, rig: str, fps: float, picture: Picture):
        self._scene = open_scene(name, seed, rig, fps, picture)
        self.rig = self._scene.rig
        self.size = self.rig.image_size
        self.fps = fps
        self.frame_count: int | None = self._scene.frame_count
        self.seeds = tuple(self._scene.seed_pixel(0, thread) for thread in self._scene.threads)

    def read(self, index: int) -> Exposure | None:
        """See `Footage`."""
        if index >= self._scene.frame_count:
            return None
        truths = self._scene.truth(index)
        return Exposure(truths[0].stamp.capture_ns, *self._scene.render(index), truths)

    def close(self) -> None:
        """See `Footage`."""
