"""What can be set about tracking."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from suturetrack.types import check_ranges


@dataclass(frozen=True)
class PaperConfig:
    """The parameters that the paper leaves open."""

    gain: float = 3.0
    """b of eq. (5), px per unit of the field's slope."""
    end_gain: float = 6.0
    """The same for the ends, eq. (8)."""
    iterations: int = 12
    """Updates a field."""
    samples_per_control_point: int = 5
    """Points of the curve that forces act on."""
    search_px: float = 6.0
    """How far active search looks to each side, and along the curve at its ends."""
    flat_px: float = 0.1
    """A force below this leaves the point to active search."""
    flat_slope: float = 0.1
    """Slope of the field along the tangent at an end below which the end is left to active search, per
    px, as a part of the cut-off of eq. (7)."""
    largest_step_px: float = 2.0
    """Longest step of a point in one update."""
    spacing_px: tuple[float, float] = (10.0, 26.0)
    """Range of the distances of neighbouring control points: beyond it they are spaced evenly again."""

    def __post_init__(self) -> None:
        check_ranges(
            self,
            "tracking.paper",
            gain=(0, 1000),
            end_gain=(0, 1000),
            iterations=(1, 1000),
            samples_per_control_point=(1, 50),
            search_px=(1, 100),
            flat_px=(0, 100),
            flat_slope=(0, 100),
            largest_step_px=(0.01, 100),
            spacing_px=(2, 1000),
        )


@dataclass(frozen=True)
class TrackingConfig:
    """How threads are followed from field to field."""

    method: Literal["gauss-newton", "paper"] = "gauss-newton"
    """gauss-newton: sub-pixel offsets along the normals and a banded least-squares step; paper: the
    forces and updates of eqs. (4)-(16)."""
    search_px: float = 5.0
    """How far to each side of the predicted curve the thread is looked for first, with its flanks: its
    middle is found 1.5 px less far; up to 6.5 times as far where it is not found."""
    iterations: int = 3
    """Gauss-Newton steps a field, at most."""
    noise_px: float = 0.1
    """Standard deviation of a centreline offset measured in the field."""
    drift_px: float = 2.0
    """How far the thread may leave the prediction from one field to the next, as a standard
    deviation; unseen stretches are held to the prediction by this."""
    smoothing: float = 100.0
    """Weight of the change of the curve's bending; without unit."""
    stretch: float = 0.02
    """Standard deviation of the local stretch of the curve, relative."""
    samples_per_span: int = 5
    """Places between two knots where the images are searched."""
    paper: PaperConfig = PaperConfig()
    """Parameters of the method `paper`."""
    patience: int = 30
    """Fields in which the thread is looked for after a seed before it is given up."""

    def __post_init__(self) -> None:
        check_ranges(
            self,
            "tracking",
            search_px=(1, 100),
            iterations=(1, 100),
            noise_px=(0.001, 10),
            drift_px=(0.01, 100),
            smoothing=(0, 1e6),
            stretch=(0.0001, 10),
            samples_per_span=(2, 50),
            patience=(1, 100_000),
        )
