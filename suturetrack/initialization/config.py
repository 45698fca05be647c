"""What can be set about the initialisation."""

from __future__ import annotations

from dataclasses import dataclass

from suturetrack.types import check_ranges


@dataclass(frozen=True)
class InitializationConfig:
    """How one seed becomes a curve (Section V)."""

    rho: float = 2.0
    """Exponent of eq. (3): how strongly the growth prefers clear ridges."""
    low: float = 0.12
    """Length of the field's vectors below which a pixel is background."""
    high: float = 0.4
    """Length that a stretch of thread must reach somewhere."""
    step_px: float = 6.0
    """Step size: distance between the stereo points that are marked along the thread, px."""
    snap_px: float = 8.0
    """How far from the thread the seed may be, px."""
    gap_px: float = 25.0
    """Longest gap in the ridge that is bridged, px."""

    def __post_init__(self) -> None:
        check_ranges(
            self,
            "initialization",
            rho=(0.1, 10),
            low=(0.01, 0.99),
            high=(0.01, 0.99),
            step_px=(1, 100),
            snap_px=(1, 100),
            gap_px=(1, 500),
        )
