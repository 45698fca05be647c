"""Paths along segments that were joined at their ends; end 2i is the start of segment i, 2i + 1 its end."""

from __future__ import annotations


def follow(start: int, partner: dict[int, int]) -> list[int]:
    """The ends at which the segments of a thread are entered, in order, from one of its ends to the
    other; `start` is a segment on it."""
    entry = 2 * start
    seen = {start}
    while entry in partner and partner[entry] // 2 not in seen:
        entry = partner[entry] ^ 1
        seen.add(entry // 2)
    entries, seen = [entry], {entry // 2}
    while (leave := entries[-1] ^ 1) in partner and partner[leave] // 2 not in seen:
        entries.append(partner[leave])
        seen.add(entries[-1] // 2)
    return entries


def other_end(end: int, partner: dict[int, int]) -> int:
    """The free end at the other side of the chain of segments that begins at the free `end`."""
    end ^= 1
    while end in partner:
        end = partner[end] ^ 1
    return end


def is_ring(start: int, partner: dict[int, int]) -> bool:
    """Whether the segments joined to that of the end `start` lead back to it."""
    end = start ^ 1
    while end in partner:
        end = partner[end] ^ 1
        if end == start ^ 1:
            return True
    return False


def ring_from(start: int, partner: dict[int, int]) -> list[int]:
    """The ends, two a segment, of the ring that leads through the end `start`."""
    ends = [start, start ^ 1]
    while partner[ends[-1]] != start:
        ends += [partner[ends[-1]], partner[ends[-1]] ^ 1]
    return ends
