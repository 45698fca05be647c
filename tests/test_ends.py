import pytest

from suturetrack.tracking.ends import EndStep, EndWatch

FRAME_NS = 33_000_000
PIXEL = 0.0025


def step_at(offset_px: float) -> EndStep:
    return EndStep(offset_px, PIXEL, at_border=False)


def settled_watch(length: float) -> tuple[EndWatch, int]:
    watch, now = EndWatch(length, 0), 0
    for _ in range(40):
        now += FRAME_NS
        assert watch.moves(step_at(0.0), step_at(0.0), length, now) == (0.0, 0.0)
    assert watch.settled
    return watch, now


def test_a_loop_that_is_drawn_shut_moves_no_end() -> None:
    watch, now = settled_watch(100.0)
    for _ in range(10):
        now += FRAME_NS
        assert watch.moves(step_at(0.2), step_at(-0.3), 88.0, now) == (
            0.2 * PIXEL,
            -0.3 * PIXEL,
        )
        assert watch.seen == (True, True)
    assert watch.length == pytest.approx(88.0, rel=1e-3)


def test_an_end_that_steps_off_is_held_where_it_was() -> None:
    watch, now = settled_watch(100.0)
    start, stop = watch.moves(step_at(0.0), step_at(-30.0), 100.0, now + FRAME_NS)
    assert start == 0.0
    assert stop == pytest.approx(0.0)
    assert watch.seen == (True, False)
