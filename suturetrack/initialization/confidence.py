"""How far a first curve can be relied on, and why."""

from __future__ import annotations

import numpy as np
from scipy.spatial import cKDTree

from suturetrack import nurbs
from suturetrack.camera import StereoRig
from suturetrack.initialization.doubts import (
    BENT,
    BEYOND,
    CROSSING,
    FOREIGN,
    HIDDEN,
    SHARED,
    SHARP,
    TOUCHES,
    Doubt,
)
from suturetrack.initialization.result import ENDS, PlacedDoubts, in_words, remaining
from suturetrack.initialization.samples import Samples
from suturetrack.initialization.segments import ARM, Ridges
from suturetrack.initialization.threads import NEXT_TO_NOTHING, Chain
from suturetrack.polylines import (
    arc_lengths,
    coverage,
    nearest_index,
    polyline_at,
    polyline_distances,
    polyline_length,
    unit,
)
from suturetrack.types import Float64, Int64, Nurbs

AGREED = 0.95
"""Share of the thread from which two views are said to agree."""
_DISAGREED = 0.5
"""What is left of the confidence where they do not: of such starts that nothing else made doubtful, seven
of eight were wrong."""
NEAR_PX = 3.0
"""How far apart they run there, at most."""
_SEEN = 0.1
"""Response from which a crest counts as seen."""
_VAGUE = 0.0026
"""Standard deviation of the best quarter of a curve, against its length, that halves the confidence:
single stretches along the epipolar lines are held by the rest, a whole thread along them is not. Of
straight threads before an endoscope (pull-through, 62 starts) 44 of the 50 right ones are below, and
4 of the 12 wrong ones."""
_HELD = 0.9
"""What is left of the confidence, at most, where that is a reason to give."""
_SAME_PLACE_PX = 25.0
_AROUND_PX = 50.0
"""How far around a place another strand shows that may lie on the thread at the place itself."""
_ONE_PASS = 3.0
"""Length of a curve near a place, against the radius, from which it passes there more than once."""
_BESIDE_PX = 5.0
"""Distance from a curve up to which a ridge is the rim of the thread or its highlight."""
_FAINT = 0.4
"""Strength of a ridge, against the thread's, below which it is not another thread's."""
_ALONE = 4.0
"""How many times better the odds are that a thread that is alone goes on as it was found to: another way
would leave a part of it to nobody. Of 171 such starts, 169 were right and as many in order, however much
was in doubt."""
_SAME_WAY = 0.3
"""Cosine of the angle between two passes of a thread from which both run the same way."""
_SHARP_REST = 0.5
"""What is left of the confidence at a sharp bend, at least, where no other ridge is near."""
_SHARP_COSINE = 0.5
_BEND_REACH = 8
"""Pixels on both sides of a place between which the curve bends there."""
_NO_END = 0.4
"""What an end that neither view shows as one leaves of the confidence."""
_FURTHER_PX, _FURTHER = 8, 0.4
"""By how many pixels one view's thread may go on behind an end of the curve, and what more leaves of the
confidence: of 226 right starts that were sure none had it."""
_STUB = 0.5
"""Strength of what goes on, against the thread's, below which it may be too short to have a direction: the
rim of a highlight."""
_GRAVE = 0.53
"""What a grave doubt leaves of the confidence at most."""
_FEW = 6
"""Points of another ridge that say nothing."""


def judge(
    curve: Nurbs,
    samples: Samples,
    sigma: Float64,
    chains: tuple[Chain, Chain],
    ridges: tuple[Ridges, Ridges],
    rig: StereoRig,
    scale: int,
) -> tuple[float, tuple[str, ...], PlacedDoubts, bool]:
    """Confidence in [0, 1], its reasons, the doubts that it is lowered by, and whether the thread is alone.

    Args:
        curve: the result.
        samples: what the images say beside it.
        sigma: (k,) standard deviations of the samples.
        chains: the thread as each view by itself has it; their agreement is what counts most.
        ridges: of both views.
        rig: the cameras.
        scale: what makes the pixels of all these those of the whole image.
    """
    fine = np.linspace(0, 1, 32 * len(curve.control_points))
    pixels = rig.project(nurbs.evaluate(curve, fine))
    agreement = min(_agreement(p, c.pixels, rig) for p, c in zip(pixels, chains, strict=True))
    confidence, reasons = _of_the_whole(agreement, samples, sigma, nurbs.length(curve))
    others = max(_others(line, r) for line, r in zip(pixels, ridges, strict=True))
    is_alone = others <= NEXT_TO_NOTHING
    doubts = _left_in_doubt(pixels, chains, ridges, is_alone=is_alone)
    reasons += _in_words(doubts, rig, scale)
    further = [
        _ends_further_on(p, c.pixels, r) for p, c, r in zip(pixels, chains, ridges, strict=True)
    ]
    left, right = (
        (*_placed(view, doubts, pixels, chains), *((float(end), _FURTHER) for end in further[view]))
        for view in (0, 1)
    )
    confidence *= remaining((left, right))
    for end in (0, 1):
        kept, whys = _of_an_end(end, samples, further)
        confidence *= kept
        reasons += whys
    return float(confidence), tuple(reasons), (left, right), is_alone


def _of_the_whole(
    agreement: float, samples: Samples, sigma: Float64, length: float
) -> tuple[float, list[str]]:
    """The confidence in a curve of this length before its doubts, and what lowers it."""
    confidence, reasons = agreement**2, []
    if agreement < AGREED:
        reasons.append(f"left and right view agree about {agreement:.0%} of the thread only")
        confidence *= _DISAGREED
    seen = float(np.mean([(c.response > _SEEN).mean() for c in samples.crests]))
    if seen < 0.95:
        reasons.append(f"uncertain stretches: {1 - seen:.0%} of the thread is not seen")
    vague = float(np.quantile(sigma, 0.25)) / length
    held = 1 / (1 + (vague / _VAGUE) ** 6)
    if held < _HELD:
        reasons.append(f"uncertain depth: even its best parts to {vague:.1%} of the length only")
    return confidence * seen * held, reasons


def _left_in_doubt(
    lines: tuple[Float64, Float64],
    chains: tuple[Chain, Chain],
    ridges: tuple[Ridges, Ridges],
    *,
    is_alone: bool,
) -> list[list[Doubt]]:
    """What each view still doubts once the whole curve is known; `lines` are the curve in both views."""
    doubts = [_settled(_distinct(c), p, r) for c, p, r in zip(chains, lines, ridges, strict=True)]
    doubts = [_confirmed(view, doubts, lines) for view in (0, 1)]
    doubts = [_without_loops(d, p) for d, p in zip(doubts, lines, strict=True)]
    if not is_alone:
        return doubts
    return [[_of_itself(d, p) for d in of_view] for of_view, p in zip(doubts, lines, strict=True)]


def _in_words(doubts: list[list[Doubt]], rig: StereoRig, scale: int) -> list[str]:
    """What each view doubts, and where."""
    words = []
    for view, name in enumerate(("left", "right")):
        places = np.array([doubt.place for doubt in doubts[view]]).reshape(-1, 2)
        said = in_words(places, rig, scale, right=bool(view))
        words += [
            f"{doubt.why} in the {name} view at {place}"
            for doubt, place in zip(doubts[view], said, strict=True)
        ]
    return words


def _of_an_end(end: int, samples: Samples, further: list[list[int]]) -> tuple[float, list[str]]:
    """What an end (0 or 1) leaves of the confidence, and what is said of it; `further` are the ends behind
    which the left and the right view's own thread goes on."""
    reasons = [
        f"the {name} view shows the {ENDS[end]} further on"
        for name, ends in zip(("left", "right"), further, strict=True)
        if end in ends
    ]
    readings = [of_view[end] for of_view in samples.ends]
    if any(reading.at_border for reading in readings):
        return 1.0, [*reasons, f"{ENDS[end]} cut by the image border"]
    if all(np.isnan(reading.offset_px) for reading in readings):
        return _NO_END, [*reasons, f"{ENDS[end]} not seen as an end"]
    return 1.0, reasons


def clarity(chain: Chain, places: Float64) -> float:
    """What the doubts of one view about a chain near (k, 2) places leave of the confidence in it."""
    doubts = [doubt for doubt in _distinct(chain) if doubt.why not in FOREIGN]
    return float(np.prod([doubt.rest for doubt in doubts if _is_near(doubt.place, places)]))


def _settled(doubts: list[Doubt], line: Float64, ridges: Ridges) -> list[Doubt]:
    """The doubts that are left once the whole curve is known.

    Where a single pass of the curve, (k, 2) pixels, is all the ridge near a place, there is no other
    way that the thread might take: at most it is another thread that goes on behind a sharp bend.
    """
    kept = []
    for doubt in doubts:
        near = _near(doubt, line)
        if (
            doubt.why in (*FOREIGN, BEYOND, HIDDEN, TOUCHES)
            or not _is_one_pass(line, near)
            or not _is_all_ridge(doubt.place, line, near, ridges)
        ):
            kept.append(doubt)
        elif _bends_sharply(line[near]):
            kept.append(Doubt(doubt.place, SHARP, max(doubt.rest, _SHARP_REST)))
    return kept


def _placed(
    view: int,
    doubts: list[list[Doubt]],
    lines: tuple[Float64, Float64],
    chains: tuple[Chain, Chain],
) -> tuple[tuple[float, float], ...]:
    """Where on the curve a view is in doubt, and what that leaves; `lines` are the curve in both views.

    Two views that come to the same by themselves are not both mistaken easily, but what neither
    could tell stays doubtful. Where strands share a stretch both are mistaken alike.
    """
    line, counterpart = lines[view], lines[1 - view]
    placed = []
    for place, why, rest in doubts[view]:
        at = nearest_index(line, place)
        there = counterpart[at]
        both = max(rest, min(_same(why, there, doubts[1 - view]), default=1.0))
        if why in (SHARED, TOUCHES) or not _is_shared(
            place, line, counterpart, chains[1 - view].pixels
        ):
            left = rest
        elif why != SHARP and both < _GRAVE:
            left = both
        else:
            left = float(np.sqrt(rest))
        placed.append((at / (len(line) - 1), left))
    return tuple(placed)


def _ends_further_on(line: Float64, chain: Float64, ridges: Ridges) -> list[int]:
    """The ends (0 or 1) of a curve, (k, 2) pixels, behind which a view's own thread goes on."""
    ends = []
    for points in (chain, chain[::-1]):
        near = np.flatnonzero(polyline_distances(points, line) < NEAR_PX)
        if not len(near) or near[0] <= _FURTHER_PX:
            continue
        strength = ridges.sample(points)
        is_strong = np.median(strength[: near[0]]) > _STUB * np.median(strength)
        if is_strong or near[0] >= ARM:
            ends.append(round(nearest_index(line, points[near[0]]) / (len(line) - 1)))
    return ends


def _confirmed(view: int, doubts: list[list[Doubt]], lines: tuple[Float64, Float64]) -> list[Doubt]:
    """The doubts of a view, and whether a part is another thread's only where the other view doubts it
    as well: strands meet, or draw each other aside, in one view alone."""
    kept = []
    for doubt in doubts[view]:
        there = lines[1 - view][nearest_index(lines[view], doubt.place)]
        if doubt.why not in FOREIGN or _same(doubt.why, there, doubts[1 - view]):
            kept.append(doubt)
    return kept


def _same(why: str, place: Float64, doubts: list[Doubt]) -> list[float]:
    """What doubts of a kind near a place of their view leave of the confidence."""
    kinds = FOREIGN if why in FOREIGN else (why,)
    return [d.rest for d in doubts if d.why in kinds and _is_near(d.place, place[None])]


def _is_shared(place: Float64, line: Float64, counterpart: Float64, chain: Float64) -> bool:
    """Whether the other view's chain, too, runs along the curve near a place: `line` and `counterpart`,
    each (k, 2), are the curve in both views."""
    near = np.linalg.norm(line - place, axis=1) <= _SAME_PLACE_PX
    if not near.any() or len(chain) < 2:
        return False
    return coverage(chain, counterpart[near], NEAR_PX) >= AGREED


def _others(line: Float64, ridges: Ridges) -> float:
    """Length of all clear ridges away from a thread, (k, 2) pixels, against its own."""
    points = np.concatenate([np.empty((0, 2)), *ridges.segments])
    away = points[cKDTree(line).query(points)[0] > _BESIDE_PX]
    level = _FAINT * float(np.median(ridges.sample(line)))
    return int((ridges.sample(away) > level).sum()) / max(polyline_length(line), 1.0)


def _of_itself(doubt: Doubt, line: Float64) -> Doubt:
    """A doubt about where the thread, (k, 2) pixels, goes on, of one that is alone: it meets nothing but
    itself, and where it ends at a crossing, another one would have to begin."""
    is_bent = doubt.why == BENT and not _is_one_pass(line, _near(doubt, line))
    if not is_bent and doubt.why not in (CROSSING, SHARED):
        return doubt
    return doubt._replace(rest=_ALONE * doubt.rest / (_ALONE * doubt.rest + 1 - doubt.rest))


def _without_loops(doubts: list[Doubt], line: Float64) -> list[Doubt]:
    """The doubts without those of places that the curve, (k, 2) pixels, passes twice the same way.

    Another way there would leave a closed loop, which no thread is, unless that changed with another strand.
    """
    passes = [_passes(doubt, line) for doubt in doubts]
    single = [of_doubt[0][0] for of_doubt in passes if len(of_doubt) == 1]
    kept = []
    for doubt, of_doubt in zip(doubts, passes, strict=True):
        is_loop = doubt.why in (CROSSING, SHARED, BENT) and _run_the_same_way(of_doubt, line)
        if not is_loop or any(of_doubt[0][0] < at < of_doubt[1][-1] for at in single):
            kept.append(doubt)
    return kept


def _passes(doubt: Doubt, line: Float64) -> list[Int64]:
    """Which points of the curve, (k, 2) pixels, are near the place of a doubt, each time that it passes."""
    near = _near(doubt, line)
    return np.split(near, np.flatnonzero(np.diff(near) > 1) + 1) if len(near) else []


def _run_the_same_way(passes: list[Int64], line: Float64) -> bool:
    """Whether there are two passes of the curve, (k, 2) pixels, that run the same way."""
    if len(passes) != 2:
        return False
    one, two = (unit(line[near[-1]] - line[near[0]]) for near in passes)
    return bool(one @ two > _SAME_WAY)


def _near(doubt: Doubt, line: Float64) -> Int64:
    """Which points of the curve, (k, 2) pixels, are near the place of a doubt."""
    return np.flatnonzero(np.linalg.norm(line - doubt.place, axis=1) <= _SAME_PLACE_PX)


def _is_one_pass(line: Float64, near: Int64) -> bool:
    """Whether the curve passes a place, with those of its samples that are near, once."""
    if len(near) < 2 or (np.diff(near) > 1).any():
        return False
    return polyline_length(line[near]) <= _ONE_PASS * _SAME_PLACE_PX


def _is_all_ridge(place: Float64, line: Float64, near: Int64, ridges: Ridges) -> bool:
    points = np.concatenate(ridges.segments)
    apart = np.linalg.norm(points - place, axis=1)
    is_foreign = (apart <= _AROUND_PX) & (cKDTree(line).query(points)[0] > _BESIDE_PX)
    is_clear = ridges.sample(points) > _FAINT * float(np.median(ridges.sample(line)))
    if near[0] == 0 or near[-1] == len(line) - 1:
        is_clear |= apart <= _SAME_PLACE_PX
    return int((is_foreign & is_clear).sum()) < _FEW


def _bends_sharply(passing: Float64) -> bool:
    even = polyline_at(passing, np.arange(0.0, arc_lengths(passing)[-1], 1.0))
    steps = unit(even[_BEND_REACH:] - even[:-_BEND_REACH])
    return bool(((steps[_BEND_REACH:] * steps[:-_BEND_REACH]).sum(1) < _SHARP_COSINE).any())


def _is_near(where: Float64, places: Float64) -> bool:
    return bool((np.linalg.norm(places - where, axis=1) <= _SAME_PLACE_PX).any())


def _distinct(chain: Chain) -> list[Doubt]:
    """The doubts, the gravest first, one of a kind for each place: about other threads, about strands
    that touch or share a stretch, about parts beyond gaps, and all the rest."""
    kept: list[Doubt] = []
    for doubt in sorted(chain.doubts, key=lambda d: d.rest):
        alike = [d.place for d in kept if _kind(d.why) == _kind(doubt.why)]
        if all(np.linalg.norm(doubt.place - place) > _SAME_PLACE_PX for place in alike):
            kept.append(doubt)
    return kept


def _kind(why: str) -> str:
    if why in FOREIGN:
        return FOREIGN[0]
    return why if why in (BEYOND, SHARED, TOUCHES) else CROSSING


def _agreement(pixels: Float64, chain: Float64, rig: StereoRig) -> float:
    """The lesser share, of the projected curve inside the image and of the chain, near the other."""
    inside = ((pixels >= 0) & (pixels <= np.array(rig.image_size) - 1)).all(1)
    if len(chain) < 2 or inside.sum() < 2:
        return 0.0
    return min(coverage(chain, pixels[inside], NEAR_PX), coverage(pixels, chain, NEAR_PX))
