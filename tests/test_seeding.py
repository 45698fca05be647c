"""Seeds outlive the tracker that was given them, unless their thread was dropped."""

from __future__ import annotations

import numpy as np
import pytest

from services import topics
from services.bus import Bus
from services.memory_transport import Hub
from services.seeding import SeedDesk
from services.source import _is_worth_more
from services.wire import scaled
from suturetrack import nurbs
from suturetrack.camera import StereoRig
from suturetrack.initialization import Growth, Initialization, ViewGrowth
from suturetrack.tracking import Tracker
from suturetrack.tracking.thread import not_found
from suturetrack.tracking.tracker import FORGOTTEN
from suturetrack.types import InputError, Nurbs, Seed, Stamp


@pytest.mark.parametrize("again", [False, True])
def test_a_seed_is_taken_up_when_it_came_after_its_thread_was_dropped(
    rig: StereoRig, again: bool
) -> None:
    hub = Hub()
    source, before, after = (Bus(hub.connect(), "rig", n) for n in ("source", *2 * ("tracker",)))
    source.keep(topics.STATE, _is_worth_more)
    source.keep(topics.SEEDING)
    events: tuple[tuple[str, ...], ...] = ((), (FORGOTTEN,), *again * ((),))
    for i, each in enumerate(events):
        if not each:
            before.publish(topics.SEEDING, Seed("a", pixel=(320.0, 240.0)))
        state = not_found("a", Stamp(i, i, i), each)
        before.publish(topics.STATE, scaled(state, rig.metres_per_unit))
    before.close()
    tracker = Tracker(rig)
    SeedDesk(after, tracker, rig).resume([])
    assert tracker.is_sought("a") == again
    after.close()
    source.close()


@pytest.mark.parametrize("others", [False, True])
def test_a_given_seed_of_which_nothing_is_heard_beside_others_was_dropped(
    rig: StereoRig, others: bool
) -> None:
    """The source that kept its last word has died, and the tracker after it."""
    hub = Hub()
    source, before, after = (Bus(hub.connect(), "rig", n) for n in ("source", *2 * ("tracker",)))
    source.keep(topics.STATE, _is_worth_more)
    if others:
        state = not_found("b", Stamp(7, 7, 7), ())
        before.publish(topics.STATE, scaled(state, rig.metres_per_unit))
    before.close()
    tracker = Tracker(rig)
    SeedDesk(after, tracker, rig).resume([Seed("a", pixel=(320.0, 240.0))])
    assert tracker.is_sought("a") != others
    after.close()
    source.close()


@pytest.mark.parametrize(("depth", "said"), [(148_000.0, "148"), (0.148, "0.000148")])
def test_a_point_in_another_unit_than_metres_is_refused(
    rig: StereoRig, depth: float, said: str
) -> None:
    hub = Hub()
    bus = Bus(hub.connect(), "rig", "tracker")
    desk = SeedDesk(bus, Tracker(rig), rig)
    desk.seed(Seed("a", point=(12.0, -3.0, 148.0)))
    with pytest.raises(InputError) as caught:
        desk.seed(Seed("b", point=(depth / 12, -depth / 50, depth)))
    assert str(caught.value) == (
        f"the seed is {said} m away, but the cameras see from 0.0501 to 16 m; a point is in metres"
    )
    assert [*desk.seeds] == ["a"]
    bus.close()


def test_what_was_found_from_a_given_seed_is_said(
    rig: StereoRig, curve: Nurbs, caplog: pytest.LogCaptureFixture
) -> None:
    bus = Bus(Hub().connect(), "rig", "tracker")
    desk = SeedDesk(bus, Tracker(rig), rig)
    nothing = ViewGrowth(np.zeros((1, 1), np.float32), (), np.empty((0, 2, 2)), ())
    growth = Growth(nothing, nothing, np.empty((0, 2, 2)))
    desk.seed(Seed("a", pixel=(320.0, 240.0)))
    desk.seed(Seed("b", pixel=(320.0, 240.0)))
    plain = Initialization(curve, 1.0, (), 0.1, growth)
    doubtful = Initialization(curve, 0.25, tuple("vwxyz"), 0.1, growth)
    with caplog.at_level("INFO", logger="suturetrack"):
        desk.settle(Stamp(0, 0, 0), {"a": plain, "b": doubtful})
    length = f"{nurbs.length(curve):.1f} mm"
    assert [record.getMessage() for record in caplog.records] == [
        f"thread a: found {length} with confidence 1.00",
        f"thread b: found {length} with confidence 0.25; v; w; x; and 2 more",
    ]
    assert not desk.seeds
    bus.close()
