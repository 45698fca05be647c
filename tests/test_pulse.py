"""Who hangs is noticed by what is heard of it, and nobody is blamed for what others do."""

from __future__ import annotations

from dataclasses import replace

import pytest

from services.messages import Health, Latency
from services.pulse import Pulse
from suturetrack.types import Stamp

FEEDS = ("source", "segmenter", "tracker")


def beat(
    process: str, frames: int, restarts: int = 0, awaits: str = "", period_ns: int = 33_333_333
) -> Health:
    stamp = Stamp(frames, frames, frames, period_ns) if frames else None
    figures = (1.0, Latency(), 1.0, Latency())
    return Health(process, 1, stamp, *figures, frames, 0, 0, 1.0, "", restarts, awaits=awaits)


def unready(process: str, restarts: int = 0, awaits: str = "") -> Health:
    return replace(beat(process, 0, restarts, awaits), ready=False)


class Run:
    """A second at a time, with looks in between."""

    def __init__(self) -> None:
        self.pulse = Pulse()
        self.now = 100.0

    def pass_second(self, *beats: Health) -> None:
        for health in beats:
            self.pulse.hear(health, self.now)
        for _ in range(5):
            self.now += 0.2
            self.pulse.look(self.now)

    def troubles(self) -> dict[str, str]:
        found = {name: self.pulse.trouble(name, 0) for name in FEEDS}
        return {name: trouble for name, trouble in found.items() if trouble}


def test_silence_is_noticed_after_five_seconds_and_ends_with_a_new_life() -> None:
    run = Run()
    for second in range(1, 30):
        talking = [beat(name, 30 * second) for name in FEEDS if name != "tracker" or second < 4]
        run.pass_second(*talking)
        if second != 7:  # the fifth after the last beat
            assert set(run.troubles()) == ({"tracker"} if second > 7 else set()), second
    assert run.troubles()["tracker"] == "nothing was heard of it for 27 s"
    assert run.pulse.trouble("tracker", 1) == ""
    run.pass_second(beat("tracker", 1, restarts=1))
    assert run.pulse.trouble("tracker", 1) == ""


def test_a_process_that_was_never_heard_of_is_noticed_after_ten_seconds() -> None:
    run = Run()
    for second in range(1, 20):
        run.pass_second(*(beat(name, 30 * second) for name in FEEDS[:2]))
        if second != 11:  # the tenth after the first look
            assert set(run.troubles()) == ({"tracker"} if second > 11 else set()), second
    assert "nothing was heard of it for" in run.troubles()["tracker"]
    run.pass_second(unready("tracker"))
    assert run.troubles() == {}
    assert not run.pulse.is_ready("tracker", 0)
    for _ in range(6):
        run.pass_second(*(beat(name, 900) for name in FEEDS[:2]))
    assert set(run.troubles()) == {"tracker"}


def test_a_process_that_never_gets_ready_is_noticed_unless_it_waits_for_another() -> None:
    run = Run()
    for second in range(1, 400):
        waits = unready("tracker", awaits="source" if second < 200 else "")
        run.pass_second(
            unready("source", awaits="segmenter"), beat("segmenter", 30 * second), waits
        )
        if second != 380:
            assert set(run.troubles()) == ({"tracker"} if second > 380 else set()), second
    assert "not ready after" in run.troubles()["tracker"]
    run.pass_second(unready("source"), beat("segmenter", 1), beat("tracker", 0))
    assert run.troubles() == {}
    assert run.pulse.is_ready("tracker", 0)


@pytest.mark.parametrize("warning", ["", "recording stopped: the disk is full"])
def test_a_loop_that_stands_still_is_noticed_though_its_heart_beats(warning: str) -> None:
    for stuck in FEEDS:
        run = Run()
        for second in range(1, 15):
            frames = dict.fromkeys(FEEDS, 30 * second)
            for name in FEEDS[FEEDS.index(stuck) :]:
                frames[name] = 30 * min(second, 2)
            beats = (beat(name, count) for name, count in frames.items())
            run.pass_second(*(replace(b, warning=warning) for b in beats))
        assert set(run.troubles()) == {stuck}
        assert "finished no frame for" in run.troubles()[stuck]


def test_nobody_is_blamed_for_a_stalled_camera_or_lock_step_or_a_slow_source() -> None:
    for awaits, period_ns in (("camera", 33_333_333), ("", 0), ("", 20_000_000_000)):
        run = Run()
        for _ in range(30):
            run.pass_second(*(beat(name, 7, 0, awaits, period_ns) for name in FEEDS))
            assert run.troubles() == {}


def test_nobody_is_blamed_when_the_launcher_stood_still() -> None:
    run = Run()
    for second in range(1, 20):
        run.pass_second(*(beat(name, 30 * second) for name in FEEDS))
    run.now += 60.0
    run.pulse.look(run.now)
    assert run.troubles() == {}
    for _ in range(6):
        run.pass_second()
    assert set(run.troubles()) == set(FEEDS)
