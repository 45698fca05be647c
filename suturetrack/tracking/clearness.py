"""When the views show as much again as they showed of a thread that is lost."""

from __future__ import annotations

import numpy as np

from suturetrack.types import Bool, Float32, RidgeField

# What is as clear as the thread, of its own response; every how many pixels, and fields while it is held,
# are looked at for that.
_CLEAR, _SPARSE, _EVERY = 0.7, 3, 5
# What is as much, of the most there was; that is forgotten by this share a field.
_AS_MUCH, _FORGOTTEN = 0.75, 0.001
# Fields in a row that are clear; what stays so shows something else.
_ROW = 3


def clear(view: Float32, level: float) -> Bool:
    """(H, W) what an (H, W, 2) view shows about as clearly as a thread of this response."""
    return np.asarray(view[..., 0] ** 2 + view[..., 1] ** 2 > (_CLEAR * level) ** 2)


class Clearness:
    """Tells the moments in which a lost thread can be found: one that moves fast is clear where it turns."""

    def __init__(self) -> None:
        self._most, self._row = 0.0, 0

    def step(self, field: RidgeField, levels: tuple[float, float], *, is_lost: bool) -> None:
        """Takes the next field.

        Args:
            levels: response of a clear view of the thread, left and right.
        """
        if not is_lost and field.stamp.frame % _EVERY:
            return
        views = zip((field.left, field.right), levels, strict=True)
        shown = min(clear(v[::_SPARSE, ::_SPARSE], level).mean() for v, level in views)
        self._most = max(float(shown), (1 - _FORGOTTEN) * self._most)
        self._row = self._row + 1 if is_lost and shown > _AS_MUCH * self._most else 0

    @property
    def is_back(self) -> bool:
        """Whether the last field was one of the first in a row that are clear."""
        return 0 < self._row <= _ROW
