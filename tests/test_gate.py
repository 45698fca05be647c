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


def passed(gate: Gate, fields: list[RidgeField]) -> list[int]:
    return [f.stamp.frame for f in fields if not gate.refusal(f)]


def test_fields_of_another_size_are_refused(rig: StereoRig) -> None:
    gate = Gate(rig, ordered=True)
    assert "(480, 320, 2)" in gate.refusal(field(0, width=320))
    assert gate.refusal(field(0)) == ""


def test_stamps_from_the_past_and_the_future_harm_nothing(rig: StereoRig) -> None:
    gate = Gate(rig, ordered=True)
    good = [field(i) for i in range(100, 120)]
    bad = [field(7, 0), field(8, FAR), field(9, 2**63 - 1), field(99, 100 * PERIOD), field(1, 1)]
    mixed = [f for i, g in enumerate(good) for f in (g, bad[i % len(bad)])]
    assert passed(gate, mixed) == [g.stamp.frame for g in good]
    assert not gate.began_anew
    assert "+999" in gate.refusal(field(8, FAR))


def test_many_bad_stamps_that_do_not_follow_one_another_harm_nothing(rig: StereoRig) -> None:
    gate = Gate(rig, ordered=True)
    chance = np.random.default_rng(0)
    gate.refusal(field(0, FAR))
    noise = [field(1, int(t)) for t in chance.integers(0, 2**62, 1000)]
    assert passed(gate, noise) == []
    assert gate.refusal(field(2, FAR + PERIOD)) == ""


def test_a_source_that_begins_anew_is_believed_after_a_few_frames(rig: StereoRig) -> None:
    gate = Gate(rig, ordered=True)
    assert gate.refusal(field(5000)) == ""
    anew = [bool(not gate.refusal(field(i)) and gate.began_anew) for i in range(10)]
    assert anew == [False] * 4 + [True] + [False] * 5


def test_in_lock_step_the_source_sees_to_the_order(rig: StereoRig) -> None:
    gate = Gate(rig, ordered=False)
    assert passed(gate, [field(5), field(3), field(4)]) == [5, 3, 4]
