"""How far a first curve can be relied on, and why."""

from __future__ import annotations

import numpy as np

from suturetrack import nurbs
from suturetrack.camera import StereoRig
from suturetrack.initialization.fitting import Samples
from suturetrack.initialization.growth import Chain
from suturetrack.metrics import coverage
from suturetrack.types import Float64, Nurbs

_AGREED = 0.95
"""Share of the thread from which both views are said to agree."""
_NEAR_PX = 3.0
_SEEN = 0.1
"""Response from which a crest counts as seen."""
_VAGUE = 0.0125
"""Standard deviation of the best quarter of a curve, against its length, that halves the confidence:
single stretches along the epipolar lines are held by the rest, a whole thread along them is not."""
_SAME_PLACE_PX = 25.0


def judge(
    curve: Nurbs,
    samples: Samples,
    sigma: Float64,
    chains: tuple[Chain, Chain],
    rig: StereoRig,
    scale: int,
) -> tuple[float, tuple[str, ...]]:
    """Confidence in [0, 1] and its reasons.

    Args:
        curve: the result.
        samples: what the images say beside it.
        sigma: (k,) standard deviations of the samples.
        chains: the thread as each view by itself has it; their agreement is what counts most.
        rig: the cameras.
        scale: what makes the pixels of all these those of the whole image.
    """
    reasons = []
    pixels = rig.project(nurbs.evaluate(curve, np.linspace(0, 1, 8 * len(curve.control_points))))
    agreement = min(_agreement(p, c.pixels, rig) for p, c in zip(pixels, chains, strict=True))
    if agreement < _AGREED:
        reasons.append(f"left and right view agree about {agreement:.0%} of the thread only")
    seen = float(np.mean([(c.response > _SEEN).mean() for c in samples.crests]))
    if seen < 0.95:
        reasons.append(f"uncertain stretches: {1 - seen:.0%} of the thread is not seen")
    confidence = agreement**2 * seen
    vague = float(np.quantile(sigma, 0.25)) / nurbs.length(curve)
    if vague > _VAGUE / 2:
        reasons.append(f"uncertain depth: even its best parts to {vague:.1%} of the length only")
    confidence /= 1 + (vague / _VAGUE) ** 6
    lowest = 1.0
    for name, chain in zip(("left", "right"), chains, strict=True):
        doubts = _distinct(chain)
        lowest = min(lowest, clarity(chain))
        reasons += [
            f"{why} in the {name} view at ({scale * u:.0f}, {scale * v:.0f})"
            for (u, v), why, _ in doubts
        ]
    # Two views that come to the same by themselves are not both mistaken easily.
    confidence *= np.sqrt(lowest) if agreement >= _AGREED else lowest
    for end in (0, 1):
        readings = [samples.ends[view][end] for view in (0, 1)]
        if any(r.at_border for r in readings):
            reasons.append(f"{_ORDINAL[end]} end cut by the image border")
        elif all(np.isnan(r.offset_px) for r in readings):
            confidence *= 0.7
            reasons.append(f"{_ORDINAL[end]} end not seen as an end")
    return float(confidence), tuple(reasons)


_ORDINAL = ("first", "last")


def clarity(chain: Chain, places: Float64 | None = None) -> float:
    """What the doubts about a chain, or those near (k, 2) places, leave of the confidence in it."""
    return float(
        np.prod(
            [
                rest
                for where, _, rest in _distinct(chain)
                if places is None or _is_near(where, places)
            ]
        )
    )


def _is_near(where: Float64, places: Float64) -> bool:
    return bool((np.linalg.norm(places - where, axis=1) <= _SAME_PLACE_PX).any())


def _distinct(chain: Chain) -> list[tuple[Float64, str, float]]:
    """The doubts, the gravest first, one for each place."""
    kept: list[tuple[Float64, str, float]] = []
    for doubt in sorted(chain.doubts, key=lambda d: d[2]):
        if all(np.linalg.norm(doubt[0] - other[0]) > _SAME_PLACE_PX for other in kept):
            kept.append(doubt)
    return kept


def _agreement(pixels: Float64, chain: Float64, rig: StereoRig) -> float:
    """The lesser share, of the projected curve inside the image and of the chain, near the other."""
    inside = ((pixels >= 0) & (pixels <= np.array(rig.image_size) - 1)).all(1)
    if len(chain) < 2 or inside.sum() < 2:
        return 0.0
    return min(coverage(chain, pixels[inside], _NEAR_PX), coverage(pixels, chain, _NEAR_PX))
