"""What a thread is looked for in."""

from __future__ import annotations

from dataclasses import dataclass

from suturetrack.camera import StereoRig
from suturetrack.types import Float32, RidgeField


@dataclass(frozen=True, eq=False)
class Images:
    """A field, the cameras that it is of, and how clearly it shows one thread."""

    field: RidgeField
    rig: StereoRig
    levels: tuple[float, float]
    """Response of a clear view of the thread, left and right."""

    @property
    def both(self) -> tuple[Float32, Float32]:
        """Each (H, W, 2), left and right."""
        return self.field.left, self.field.right
