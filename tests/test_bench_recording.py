"""The benchmark of recordings measures what it says, of real processes."""

from __future__ import annotations

import pytest
from rich.console import Console

from services.bench.recording import RecordingBench, costs, run


def test_a_full_recording_takes_what_its_images_and_fields_take() -> None:
    config = RecordingBench(scenario="figure8-107", frames=12)
    light, full = (dict(costs(config, level)) for level in ("light", "full"))
    # Two views: three bytes a pixel of an image, two floats a pixel of a field.
    pixels = 2 * 640 * 480
    assert full["source"].kilobytes == pytest.approx(3 * pixels / 1e3, rel=0.05)
    assert full["segmenter"].kilobytes == pytest.approx(8 * pixels / 1e3, rel=0.05)
    assert 10 < light["source"].kilobytes < full["source"].kilobytes / 5
    assert light["segmenter"].kilobytes < full["segmenter"].kilobytes / 50
    for cost in (*light.values(), *full.values()):
        assert cost.thread_ms > 0
        assert cost.loop_ms > 0


@pytest.mark.long
def test_rates_stand_beside_those_without_a_recording() -> None:
    config = RecordingBench(scenario="figure8-107", frames=30, repeats=1)
    rows = run(config, Console(quiet=True))
    kinds = {(row.recording, row.process) for row in rows}
    assert kinds == {(k, p) for k in ("light", "full") for p in ("source", "segmenter", "tracker")}
    for row in rows:
        assert row.ratio == pytest.approx(row.lockstep_hz / row.unrecorded_hz)
        assert 0 < row.paced_hz < 45
        assert 0 < row.unrecorded_paced_hz < 45
