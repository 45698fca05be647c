"""How fast a thread may move and still be seen: the exposure decides it, and nobody tells the exposure."""

from __future__ import annotations

import numpy as np

from suturetrack.types import Bool, Float64

SLOWEST_PX = 5.0
"""So far a thread may move across itself between two frames and is always seen."""

# Width and number of the classes of steps, px; the last one is of all that are longer.
_WIDTH, _CLASSES = 0.5, 80
# What is left of what was learned when both views of a second, at 30 frames, were learned on top of it.
_KEPT_OF_A_SECOND = 0.6
# So many more places that were fast and not shown than shown prove that the exposure is to blame.
_PROVEN = 64


class Shutter:
    """Learns, from what was shown of a thread at which speed, from which speed on it is smeared.

    Things in the way hide what is fast no more than what is slower; the exposure does.
    """

    def __init__(self) -> None:
        self._balance = np.zeros(_CLASSES)
        """Of the places that moved by so many px, those that were shown less those that were not."""

    def learn(self, steps: Float64, shown: Bool) -> None:
        """What a field shows of a thread.

        Args:
            steps: (k,) px by which places of the thread moved across themselves between two frames.
            shown: (k,) whether the field shows them at the thread's own scale.
        """
        fast = steps >= SLOWEST_PX
        if fast.any():
            classes = np.minimum((steps[fast] - SLOWEST_PX) / _WIDTH, _CLASSES - 1).astype(int)
            self._balance *= _KEPT_OF_A_SECOND ** (1 / 60)
            self._balance += np.bincount(classes, np.where(shown[fast], 1.0, -1.0), _CLASSES)

    @property
    def fastest_clear(self) -> float:
        """The step, px, that best parts what was shown from what was not, at least `SLOWEST_PX`; infinite
        where hardly anything fast was not."""
        gained = np.cumsum(np.r_[0.0, self._balance])
        best = int(gained.argmax())
        proven = gained[best] - gained[-1] >= _PROVEN
        return SLOWEST_PX + best * _WIDTH if proven else np.inf
