"""What can be set about the initialisation."""

from __future__ import annotations

from dataclasses import dataclass


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
