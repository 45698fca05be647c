from __future__ import annotations

import numpy as np

from services.gate import Gate
from suturetrack.camera import StereoRig
from suturetrack.types import RidgeField, Stamp

PERIOD = 33_333_333
FAR = 10**18


def field(frame: int, capture_ns: int | None = None, width: int = 640) -> RidgeField:
    capture_ns = frame * PERIOD if capture_ns is None else capture_ns
    view = np.zeros((480, width, 2), np.float32)
    return RidgeField(Stamp(frame, capture_ns, 0), view, view)


def refusal(gate: Gate, ridges: RidgeField) -> str:
    return gate.refusal(ridges, 0)


def passed(gate: Gate, fields: list[RidgeField]) -> list[int]:
    return [f.stamp.frame for f in fields if not refusal(gate, f)]


def test_fields_of_another_size_are_refused(rig: StereoRig) -> None:
    gate = Gate(rig, ordered=True)
    assert "(480, 320, 2)" in refusal(gate, field(0, width=320))
    assert refusal(gate, field(0)) == ""


def test_stamps_from_the_past_and_the_future_harm_nothing(rig: StereoRig) -> None:
    gate = Gate(rig, ordered=True)
    good = [field(i) for i in range(100, 120)]
    bad = [field(7, 0), field(8, FAR), field(9, 2**63 - 1), field(99, 100 * PERIOD), field(1, 1)]
    mixed = [f for i, g in enumerate(good) for f in (g, bad[i % len(bad)])]
    assert passed(gate, mixed) == [g.stamp.frame for g in good]
    assert not gate.began_anew
    assert "+999" in refusal(gate, field(8, FAR))


def test_many_bad_stamps_that_do_not_follow_one_another_harm_nothing(rig: StereoRig) -> None:
    gate = Gate(rig, ordered=True)
    chance = np.random.default_rng(0)
    refusal(gate, field(0, FAR))
    noise = [field(1, int(t)) for t in chance.integers(0, 2**62, 1000)]
    assert passed(gate, noise) == []
    assert refusal(gate, field(2, FAR + PERIOD)) == ""


def test_a_source_that_begins_anew_is_believed_after_a_few_frames(rig: StereoRig) -> None:
    gate = Gate(rig, ordered=True)
    assert refusal(gate, field(5000)) == ""
    anew = [bool(not refusal(gate, field(i)) and gate.began_anew) for i in range(10)]
    assert anew == [False] * 4 + [True] + [False] * 5


def test_what_comes_after_a_long_silence_does_not_lie_far_ahead(rig: StereoRig) -> None:
    silence = 3600 * 10**9
    gate = Gate(rig, ordered=True)
    assert gate.refusal(field(0), 5) == ""
    assert "+3600" in gate.refusal(field(1, silence), 6)
    assert gate.refusal(field(2, silence + PERIOD), 5 + silence) == ""
    assert not gate.began_anew


def test_in_lock_step_the_source_sees_to_the_order(rig: StereoRig) -> None:
    gate = Gate(rig, ordered=False)
    assert passed(gate, [field(5), field(3), field(4)]) == [5, 3, 4]
