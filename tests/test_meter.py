"""The rate and the latency that a heartbeat tells."""

from __future__ import annotations

import tracemalloc

import numpy as np
import pytest

from services.meter import Meter
from suturetrack.types import Stamp


def count(meter: Meter, latencies_ms: list[float]) -> None:
    for i, latency_ms in enumerate(latencies_ms):
        now_ns = 1_000_000_000 + i * 10_000_000
        meter.count(Stamp(i, 0, now_ns - round(latency_ms * 1e6)), now_ns)


def test_before_any_frame_all_is_nought() -> None:
    meter = Meter()
    for figures in (meter.whole(), meter.window()):
        assert (figures.frames, figures.rate_hz) == (0, 0.0)
        assert (figures.latency.p50_ms, figures.latency.max_ms) == (0.0, 0.0)


def test_the_latencies_of_a_run_are_told_within_half_a_percent() -> None:
    chance, meter = np.random.default_rng(0), Meter()
    latencies = chance.lognormal(3, 0.5, 5000)
    count(meter, latencies.tolist())
    whole = meter.whole()
    p50, p99 = np.percentile(latencies, (50, 99), method="inverted_cdf")
    assert whole.frames == 5000
    assert whole.rate_hz == pytest.approx(100)
    assert whole.latency.p50_ms == pytest.approx(p50, rel=0.0051)
    assert whole.latency.p99_ms == pytest.approx(p99, rel=0.0051)
    assert whole.latency.max_ms == pytest.approx(latencies.max())


def test_a_window_holds_what_came_since_the_last_one() -> None:
    meter = Meter()
    count(meter, [10.0, 20.0, 30.0])
    assert meter.window().latency.p50_ms == pytest.approx(20)
    count(meter, [40.0])
    window = meter.window()
    assert (window.frames, window.latency.max_ms) == (1, pytest.approx(40))
    assert meter.window().frames == 0
    assert meter.whole().frames == 4


def test_clocks_that_disagree_and_frames_that_took_for_ever_are_counted() -> None:
    meter = Meter()
    count(meter, [-5.0, -5.0, 5e8])
    latency = meter.whole().latency
    assert latency.p50_ms <= 0.02
    assert latency.max_ms == pytest.approx(5e8)
    # Within the range of the bins.
    assert 0.99e7 < latency.p99_ms < 1.01e7


def test_hours_take_no_more_memory_than_the_first_minute() -> None:
    meter = Meter()
    count(meter, [20.0] * 1000)
    meter.window()
    tracemalloc.start()
    for _ in range(20):
        count(meter, [20.0] * 1000)
        meter.window()
    grown, _ = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert grown < 20_000
