"""Literal twins of the kernels that follow crest lines."""

from __future__ import annotations

import numpy as np
from scipy.ndimage import map_coordinates
from skimage.measure import euler_number

from suturetrack.types import Bool, Float32

Place = tuple[int, int]


def crest_pixels(field: Float32, magnitude: Float32, low: float) -> Bool:
    """See `suturetrack.kernels.crest.crest_pixels`."""
    y, x = np.indices(magnitude.shape)
    u, v = np.moveaxis(field / magnitude[..., None], -1, 0)
    one, other = (
        map_coordinates(magnitude, (y + side * u, x - side * v), float, order=1, mode="nearest")
        for side in (1, -1)
    )
    return _without_border((magnitude >= low) & (magnitude >= one) & (magnitude >= other))


def thin(mask: Bool, magnitude: Float32) -> Bool:
    """The mask as `suturetrack.kernels.crest.thin` leaves it."""
    kept, before = _without_border(mask), None
    while before != kept.sum():
        before = kept.sum()
        for y, x in sorted(np.argwhere(kept), key=lambda place: magnitude[tuple(place)]):
            around = kept[y - 1 : y + 2, x - 1 : x + 2].copy()
            around[1, 1] = False
            is_in_one_piece = euler_number(around, connectivity=2) == 1
            kept[y, x] = around.sum() < 2 or not is_in_one_piece
    return kept


def _without_border(mask: Bool) -> Bool:
    inner = np.zeros_like(mask)
    inner[1:-1, 1:-1] = mask[1:-1, 1:-1]
    return inner


def chains(mask: Bool) -> list[list[Place]]:
    """Places (x, y) of the chains, open ones first; see `suturetrack.kernels.crest.trace_chains`."""
    every = [(int(x), int(y)) for y, x in np.argwhere(mask)]
    left = [place for place in every if len(_beside(place, every)) <= 2]
    found = []
    for most in (1, 2):
        while starts := [place for place in left if len(_beside(place, left)) <= most]:
            chain, ahead = [], starts
            while ahead:
                chain.append(ahead[0])
                left.remove(ahead[0])
                ahead = _beside(ahead[0], left)
            found.append(chain)
    return found


def _beside(place: Place, others: list[Place]) -> list[Place]:
    """The others that touch the place: those beside its edges, then those at its corners."""
    x, y = place
    return [(u, v) for d in (1, 2) for u, v in others if (u - x) ** 2 + (v - y) ** 2 == d]
