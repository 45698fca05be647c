from __future__ import annotations

import time

import pytest
from hypothesis import given
from hypothesis import strategies as st

from services.freshness import PERIODS, Freshness
from suturetrack.types import Stamp

MS = 1_000_000
PERIOD = 33_333_333
RELEASED = 1_700_000_000_000_000_000
STAMP = Stamp(7, 0, RELEASED, PERIOD)


def at(age_ms: float, silence_ms: float, stamp: Stamp = STAMP) -> Freshness:
    age, silence = round(age_ms * MS), round(silence_ms * MS)
    return Freshness.of(stamp, 5 * MS, now_ns=RELEASED + age, monotonic_ns=5 * MS + silence)


@pytest.mark.parametrize(
    ("age_ms", "silence_ms", "reason"),
    [
        (20, 0, ""),
        (66, 33, ""),
        (99.9, 60, ""),
        (100.1, 0, "100 ms old"),
        (50, 84, "nothing came for 84 ms"),
        (3_600_000, 0, "3600000 ms old"),
        (-5, 5, ""),
        (-34, 5, "34 ms ahead"),
        (-3_600_000, 5, "ahead"),
    ],
)
def test_live_until_the_frame_is_old_or_nothing_came(
    age_ms: float, silence_ms: float, reason: str
) -> None:
    found = at(age_ms, silence_ms)
    assert found.live is (reason == "")
    assert reason in found.reason


def test_without_a_promised_rate_nothing_is_live() -> None:
    found = at(1, 1, Stamp(7, 0, RELEASED))
    assert not found.live
    assert "no rate" in found.reason


@given(st.floats(0, 60), st.floats(0, 1000), st.floats(0.001, 10_000))
def test_stale_three_periods_after_any_silence(
    way_ms: float, since_last_ms: float, after_ms: float
) -> None:
    """A process falls silent some time after the last frame was released: no way misses it."""
    end = PERIODS * PERIOD / MS + after_ms
    assert not at(since_last_ms + end, since_last_ms + end - way_ms).live


@given(st.floats(-1e6, 1e6), st.floats(0, 1e5))
def test_clocks_that_disagree_never_keep_silence_live(skew_ms: float, after_ms: float) -> None:
    assert not at(skew_ms, 2.5 * PERIOD / MS + 0.001 + after_ms).live


def test_the_moment_is_now() -> None:
    fresh = Freshness.of(Stamp(0, 0, time.time_ns(), PERIOD), time.monotonic_ns())
    assert 0 <= fresh.age_ns < 1e9
    assert 0 <= fresh.silence_ns < 1e9
