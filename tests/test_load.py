"""More frames than the machine can take, beside consumers that are slow or stand still."""

from __future__ import annotations

from pathlib import Path

import pytest

from services.bench.load import BESIDE, measure
from services.bench.system import film


@pytest.mark.parametrize("seconds", [4.0, pytest.param(600.0, marks=pytest.mark.long)])
def test_a_flood_is_skipped_and_counted_and_delays_nothing(
    tmp_path: Path, rig_name: str, seconds: float
) -> None:
    options = film(tmp_path / "film", 10, 30.0)
    row = measure(f"flood {BESIDE}", 240.0, seconds, options, tmp_path)
    assert row.skipped > 0
    assert row.missed == 0
    assert row.answered_percent < 99
    assert row.rate_hz > 5
    # Frames that queued up somewhere would be seconds late by now.
    assert row.latency_p99_ms < 1000
    assert row.memory_mb < 2500
    assert not row.memory_percent_per_10_min > 10


@pytest.mark.long
def test_thirty_frames_a_second_are_kept_up_for_ten_minutes(tmp_path: Path, rig_name: str) -> None:
    row = measure("soak", 30.0, 600.0, film(tmp_path / "film", 30, 30.0), tmp_path)
    assert abs(row.rate_hz / 30 - 1) < 0.01
    assert row.largest_gap_ms <= 2000 / 30
    assert row.latency_p99_ms <= 33
    assert row.missed == 0
    assert row.memory_percent_per_10_min < 1
