from __future__ import annotations

import dataclasses
import math
import resource
from dataclasses import dataclass
from typing import Any

import msgspec
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from services import topics, wire
from services.messages import (
    Forget,
    Forgotten,
    GraspReply,
    GraspRequest,
    Health,
    Latency,
    SeedReply,
    ToolPose,
    ToolSnap,
)
from services.wire import Packet, WireError
from suturetrack.camera import StereoRig
from suturetrack.grasping import GraspPoint
from suturetrack.segmentation import joined
from suturetrack.types import (
    Colours,
    Energies,
    Grasp,
    Nurbs,
    RidgeField,
    Seed,
    Stamp,
    Status,
    StereoFrame,
    ThreadState,
    Truth,
)

STAMP = Stamp(7, 233_333_333, 1_700_000_000_000_000_000, 33_333_333)
RNG = np.random.default_rng(3)


def curve(n: int = 6) -> Nurbs:
    knots = np.r_[np.zeros(3), np.linspace(0, 1, n - 2), np.ones(3)]
    return Nurbs(3, knots, RNG.normal(size=(n, 3)), np.ones(n))


def state(**changes: Any) -> ThreadState:
    energies = Energies(-0.9, -0.8, -0.5, 2.0)
    whole = ThreadState(
        STAMP, "0", Status.TRACKING, curve(), 0.175, energies, np.full(5, 1e-4), np.ones(5, bool)
    )
    return dataclasses.replace(whole, **changes)


def rig() -> StereoRig:
    k, d = np.array([[800.0, 0, 320], [0, 800, 240], [0, 0, 1]]), np.zeros(5)
    return StereoRig.from_calibration(
        (640, 480), (k, d), (k, d), np.eye(3), np.r_[-0.04, 0, 0], 1.0
    )


def frame(shape: tuple[int, ...] = (48, 64, 3)) -> StereoFrame:
    left, right = RNG.integers(0, 256, (2, *shape), dtype=np.uint8)
    return StereoFrame(STAMP, left, right)


def field(shape: tuple[int, ...] = (48, 64, 2), own: tuple[str, ...] = ()) -> RidgeField:
    views = RNG.uniform(-0.7, 0.7, (1 + len(own), 2, *shape)).astype(np.float32)
    if own:
        return joined(STAMP, dict(zip(own, map(tuple, views[1:]), strict=True)))
    return RidgeField(STAMP, *views[0])


def colours(*places: tuple[int, int]) -> Colours:
    pixels = np.array(places, np.uint16).reshape(-1, 2)
    return Colours(pixels, RNG.integers(0, 256, (len(pixels), 3), np.uint8))


def coloured(*places: tuple[int, int], own: tuple[str, ...] = ()) -> RidgeField:
    """A field with the colours of a pixel of the left view, and of these of the right one."""
    return dataclasses.replace(field(own=own), colours=(colours((5, 7)), colours(*places)))


LATENCY = Latency(1.0, 2.0, 3.0)
HEALTH = Health("source", 1, STAMP, 30.0, LATENCY, 29.9, LATENCY, 600, 0, 1, 80.5)

MESSAGES: list[Any] = [
    frame(),
    frame((48, 64)),
    field(),
    field(own=("0", "left-hand")),
    coloured((63, 0), (0, 1), (4, 1), (4, 47)),
    coloured(own=("0", "left-hand")),
    state(),
    state(status=Status.LOST, curve=None, length=math.nan, energies=Energies(), events=("lost",)),
    state(sigma=np.array([0.1, np.inf]), seen=np.zeros(2, bool)),
    Seed("0", pixel=(3.5, 4.25)),
    Seed("left-hand", point=(0.1, 0.2, 0.3)),
    SeedReply("0", True, "found 175 mm", STAMP, curve()),
    SeedReply("0", False, "no ridge there", candidates=((1.0, 2.0), (3.0, 4.0))),
    Grasp(STAMP, "0", np.ones(3), np.eye(3), 1e-4),
    ToolPose("needle", 99, np.ones(3), np.eye(3), True),
    ToolSnap(STAMP, "needle", np.ones(3), (0.1, 0.2, 0.3), "2.0 mm away"),
    ToolSnap(STAMP, "needle", np.ones(3), None, "no thread within 8 mm"),
    Forget("0"),
    Forgotten("0", True),
    GraspRequest("0", GraspPoint(from_end=0.01)),
    GraspRequest("a", GraspPoint(near=(0.1, 0.2, 0.3)), (1.0, 0.0, 0.0)),
    GraspReply("0", Grasp(STAMP, "0", np.ones(3), np.eye(3), 1e-4)),
    GraspReply("0", None, "thread '0' is lost"),
    Truth(STAMP, "0", RNG.normal(size=(9, 3)), 0.2, np.ones(9, bool)),
    STAMP,
    HEALTH,
    rig(),
    None,
]


def assert_same(a: Any, b: Any) -> None:
    assert type(a) is type(b)
    if dataclasses.is_dataclass(a):
        for part in dataclasses.fields(a):
            assert_same(getattr(a, part.name), getattr(b, part.name))
    elif isinstance(a, dict):
        assert list(a) == list(b)
        for key in a:
            assert_same(a[key], b[key])
    elif isinstance(a, tuple):
        assert len(a) == len(b)
        for x, y in zip(a, b, strict=True):
            assert_same(x, y)
    elif isinstance(a, np.ndarray):
        assert a.dtype == b.dtype
        np.testing.assert_array_equal(a, b)
    elif isinstance(a, float):
        assert a == b or (math.isnan(a) and math.isnan(b))
    else:
        assert a == b


@pytest.mark.parametrize("message", MESSAGES, ids=lambda m: type(m).__name__)
def test_every_message_comes_back_to_the_bit(message: Any) -> None:
    packet = wire.encode(message, "source-1", 41, 99)
    back, header = wire.decode(packet, type(message))
    assert_same(back, message)
    assert (header.publisher, header.number, header.sent_ns) == ("source-1", 41, 99)


def test_every_topic_has_a_form_on_the_wire() -> None:
    kinds = {topic.kind for topic in topics.TOPICS}
    kinds |= {kind for question in topics.QUESTIONS for kind in (question.kind, question.answer)}
    assert kinds <= {type(message) for message in MESSAGES}


@given(
    hnp.arrays(np.float64, (8, 3), elements=st.floats(-1e6, 1e6)),
    st.floats(1e-6, 1e6),
    st.sampled_from(Status),
)
def test_states_keep_every_digit(points: np.ndarray, length: float, status: Status) -> None:
    sent = state(curve=dataclasses.replace(curve(8), control_points=points), length=length)
    sent = dataclasses.replace(sent, status=status)
    assert_same(wire.decode(wire.encode(sent), ThreadState)[0], sent)


def test_images_travel_as_raw_pixels_that_any_language_can_read() -> None:
    sent = frame((48, 64, 3))
    packet = wire.encode(sent)
    assert packet.encoding == "application/octet-stream;frame/1"
    assert packet.payload == sent.left.tobytes() + sent.right.tobytes()
    header = msgspec.msgpack.decode(packet.attachment)
    assert header["shapes"] == [[48, 64, 3], [48, 64, 3]]
    assert header["stamp"] == [STAMP.frame, STAMP.capture_ns, STAMP.released_ns]
    assert header["period_ns"] == STAMP.period_ns


def test_views_that_are_not_contiguous_are_sent_right() -> None:
    wide = frame((48, 128, 3)).left
    sent = StereoFrame(STAMP, wide[:, :64], wide[:, 64:])
    assert_same(wire.decode(wire.encode(sent), StereoFrame)[0].right, wide[:, 64:].copy())


def test_lengths_are_scaled_to_metres_and_back() -> None:
    in_mm = state(curve=curve(), length=175.0, sigma=np.full(5, 0.25))
    in_m = wire.scaled(in_mm, 0.001)
    assert in_m.length == pytest.approx(0.175)
    np.testing.assert_allclose(in_m.sigma, 0.25e-3)
    assert in_m.curve is not None
    assert in_mm.curve is not None
    np.testing.assert_allclose(in_m.curve.control_points, in_mm.curve.control_points / 1000)
    np.testing.assert_array_equal(in_m.curve.knots, in_mm.curve.knots)
    assert wire.scaled(Seed("0", point=(1.0, 2.0, 3.0)), 0.5).point == (0.5, 1.0, 1.5)
    assert wire.scaled(Seed("0", pixel=(1.0, 2.0)), 0.5).pixel == (1.0, 2.0)


def refused(packet: Packet, kind: type[Any], reason: str) -> None:
    with pytest.raises(WireError, match=reason):
        wire.decode(packet, kind)


def test_another_version_or_schema_is_refused_with_both_names() -> None:
    packet = wire.encode(state())
    newer = dataclasses.replace(packet, encoding="application/msgpack;state/2")
    refused(newer, ThreadState, r"state/2.*expected.*state/1")
    refused(packet, Truth, r"state/1.*expected.*truth/1")


def header_of(packet: Packet, **changes: Any) -> Packet:
    header = {**msgspec.msgpack.decode(packet.attachment), **changes}
    return dataclasses.replace(packet, attachment=msgspec.msgpack.encode(header))


@pytest.mark.parametrize(
    ("changes", "reason"),
    [
        ({"shapes": [[48, 64, 3], [48, 63, 3]]}, "bytes for shapes"),
        ({"shapes": [[48, 64, 3]]}, "two shapes"),
        ({"shapes": [[96, 32, 3], [48, 64, 3]]}, "left is"),
        ({"shapes": [[48, 192], [48, 64, 3]]}, "left is"),
        ({"shapes": [[9216], [9216]]}, "shapes"),
        ({"shapes": [[8192] * 4, [8192] * 4]}, "bytes for shapes"),
        ({"shapes": [[8192] * 1000, [0]]}, "shapes"),
        ({"shapes": [[2**62, 4], [4, 2**62]]}, "shapes"),
        ({"shapes": [[-48, -64, 3], [48, 64, 3]]}, "shapes"),
        ({"shapes": "48x64"}, "shapes"),
        ({"dtype": "<f4"}, "dtype"),
        ({"dtype": "O"}, "dtype"),
        ({"stamp": None}, "stamp"),
        ({"stamp": [-1, 0, 0]}, "stamp"),
        ({"stamp": [0, 2**63, 0]}, "stamp"),
        ({"stamp": [0.5, 0, 0]}, "stamp"),
        ({"publisher": "x" * 1000}, "publisher"),
        ({"threads": ["0"]}, "only fields"),
        ({"colours": [0, 0]}, "only fields"),
    ],
)
def test_headers_that_lie_are_refused(changes: dict[str, Any], reason: str) -> None:
    refused(header_of(wire.encode(frame()), **changes), StereoFrame, reason)


@pytest.mark.parametrize(
    ("changes", "reason"),
    [
        ({"threads": []}, "two shapes"),
        ({"threads": ["0", "1", "2"]}, "two shapes"),
        ({"threads": ["0", "0"]}, "twice"),
        ({"threads": ["0", 7]}, "threads"),
        ({"threads": ["0", "x" * 1000]}, "threads"),
        ({"threads": ["0"] * 1000}, "threads"),
        ({"shapes": [[48, 64, 2]] * 3 + [[64, 48, 2]]}, "all alike"),
        ({"shapes": [[48, 128]] * 4}, "all alike"),
        ({"shapes": [[48, 64, 2]] * 1000}, "shapes"),
    ],
)
def test_headers_that_lie_of_single_threads_are_refused(
    changes: dict[str, Any], reason: str
) -> None:
    packet = wire.encode(field(own=("0", "1")))
    refused(header_of(packet, **changes), RidgeField, reason)


@pytest.mark.parametrize("counts", [[], [1, 1], [3], [1, 2, 3], [-1, 4], [2**62, 1], [2**63, 0]])
def test_colours_that_do_not_fit_their_counts_are_refused(counts: list[int]) -> None:
    packet = wire.encode(coloured((1, 1), (2, 2)))
    refused(header_of(packet, colours=counts), RidgeField, "bytes for shapes|one view|colours")


@pytest.mark.parametrize("places", [[(64, 0)], [(0, 48)], [(3, 2), (3, 2)], [(3, 2), (2, 2)]])
def test_colours_outside_the_view_or_out_of_order_are_refused(
    places: list[tuple[int, int]],
) -> None:
    refused(wire.encode(coloured(*places)), RidgeField, "outside the view|not in order")


@dataclass(frozen=True)
class Huge:
    """A payload that must be refused by its size, without being read."""

    size: int

    def __len__(self) -> int:
        return self.size

    def __bytes__(self) -> bytes:
        raise AssertionError("a refused payload was read")


def test_a_payload_of_hostile_size_is_not_even_read() -> None:
    for message in (frame(), state()):
        packet = dataclasses.replace(wire.encode(message), payload=Huge(1 << 40))
        refused(packet, type(message), "bytes")


@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf, 1.5])
def test_fields_hold_only_unit_components(bad: float) -> None:
    broken, of_a_thread = field(), field(own=("0",))
    broken.right[5, 6, 1] = of_a_thread.own["0"][1][5, 6, 1] = bad
    for message in (broken, of_a_thread):
        refused(wire.encode(message), RidgeField, r"\[-1, 1\]")


def with_points(value: float) -> Nurbs:
    points = curve().control_points.copy()
    points[2, 1] = value
    return dataclasses.replace(curve(), control_points=points)


@pytest.mark.parametrize(
    "broken",
    [
        state(curve=with_points(math.nan)),
        state(curve=with_points(math.inf)),
        state(curve=dataclasses.replace(curve(), degree=0)),
        state(curve=dataclasses.replace(curve(), degree=4)),
        state(curve=dataclasses.replace(curve(), knots=curve().knots[::-1].copy())),
        state(curve=dataclasses.replace(curve(), knots=np.zeros(10))),
        state(curve=dataclasses.replace(curve(), weights=np.zeros(6))),
        state(curve=dataclasses.replace(curve(), control_points=np.zeros((6, 2)))),
        state(curve=dataclasses.replace(curve(), control_points=np.zeros(0))),
        state(length=math.nan),
        state(length=-1.0),
        state(curve=None, length=0.1),
        state(sigma=np.full(5, math.nan)),
        state(sigma=np.full(5, -1.0)),
        state(seen=np.ones(4, bool)),
        state(energies=Energies(image_left=math.inf)),
        state(thread="a/b"),
        state(thread="**"),
        state(thread=""),
        state(stamp=Stamp(-1, 0, 0)),
        Seed("0"),
        Seed("0", pixel=(1, 2), point=(1, 2, 3)),
        Seed("0", pixel=(math.nan, 2)),
        Seed("0", point=(1, 2, math.inf)),
        Grasp(STAMP, "0", np.ones(3), 2 * np.eye(3), 0.1),
        GraspRequest("0", GraspPoint()),
        GraspRequest("0", GraspPoint(from_start=0.1, fraction=0.5)),
        GraspRequest("0", GraspPoint(from_end=math.nan)),
        GraspRequest("0", GraspPoint(fraction=0.5), (0.0, 0.0, 0.0)),
        GraspRequest("0", GraspPoint(fraction=0.5), (0.0, math.nan, 1.0)),
        ToolPose("a b", 99, np.ones(3), np.eye(3)),
        ToolPose("needle", 99, np.ones(3), 2 * np.eye(3)),
        ToolPose("needle", 99, np.full(3, math.nan), np.eye(3)),
        ToolSnap(STAMP, "needle", np.ones(3), (0.1, math.inf, 0.3), ""),
        GraspReply("0", None),
        GraspReply("0", Grasp(STAMP, "0", np.full(3, np.inf), np.eye(3), 0.1)),
        Truth(STAMP, "0", np.ones((4, 3)), 0.2, np.ones(5, bool)),
        dataclasses.replace(rig(), metres_per_unit=0.0),
        dataclasses.replace(rig(), metres_per_unit=math.nan),
        dataclasses.replace(rig(), right=rig().left),
        dataclasses.replace(rig(), image_size=(0, 480)),
        dataclasses.replace(rig(), image_size=(9216, 480)),
        dataclasses.replace(HEALTH, rate_hz=math.nan),
        dataclasses.replace(HEALTH, process="a b"),
    ],
)
def test_impossible_values_are_refused(broken: Any) -> None:
    refused(wire.encode(broken), type(broken), ".")


@pytest.mark.parametrize(
    "payload",
    [
        b"",
        b"\xc0",
        b"\x91" * 100_000,
        b"\xdd\xff\xff\xff\xff",
        b"\xdf\xff\xff\xff\xff" * 20,
        b"\xc6\xff\xff\xff\xff",
        msgspec.msgpack.encode({"frame": "7", "capture_ns": 1, "released_ns": 2}),
        msgspec.msgpack.encode({"frame": 7}),
    ],
)
def test_malformed_small_messages_are_refused(payload: bytes) -> None:
    for kind in (Stamp, ThreadState):
        packet = Packet(wire.encoding_of(kind), payload, wire.encode(None).attachment)
        refused(packet, kind, ".")


def tampered(text: str) -> Packet:
    content = msgspec.msgpack.decode(wire.encode(state()).payload)
    content["curve"]["control_points"] = text
    packet = wire.encode(state())
    return dataclasses.replace(packet, payload=msgspec.msgpack.encode(content))


@pytest.mark.parametrize(
    "points", [[["1", "2", "3"]] * 6, [[1, 2], [3]], [[2**80 % 2**64] * 3, {}], 5]
)
def test_arrays_of_anything_but_numbers_are_refused(points: Any) -> None:
    refused(tampered(points), ThreadState, ".")


GOOD = [wire.encode(message) for message in MESSAGES]
KINDS = [type(message) for message in MESSAGES]


def decoded(packet: Packet, kind: type[Any]) -> Any:
    """The message, or the WireError that refuses it; anything else goes through."""
    try:
        return wire.decode(packet, kind)[0]
    except WireError as error:
        return error


@settings(max_examples=300)
@given(st.sampled_from(KINDS), st.binary(max_size=300), st.binary(max_size=99))
def test_garbage_is_refused(kind: type[Any], payload: bytes, attachment: bytes) -> None:
    back = decoded(Packet(wire.encoding_of(kind), payload, attachment), kind)
    assert isinstance(back, (WireError, kind))


@settings(max_examples=400)
@given(st.data())
def test_mutated_messages_are_refused_or_still_valid(data: st.DataObject) -> None:
    """A flipped, cut or doubled part of a good message never raises anything but a WireError."""
    index = data.draw(st.integers(0, len(GOOD) - 1))
    packet, kind = GOOD[index], KINDS[index]
    parts = {"payload": bytes(packet.payload), "attachment": packet.attachment}
    name = data.draw(st.sampled_from(sorted(parts)))
    content = bytearray(parts[name])
    start = data.draw(st.integers(0, len(content)))
    stop = data.draw(st.integers(start, min(len(content), start + 16)))
    content[start:stop] = data.draw(st.binary(max_size=16))
    back = decoded(dataclasses.replace(packet, **{name: bytes(content)}), kind)
    if not isinstance(back, WireError):
        assert_same(decoded(wire.encode(back), kind), back)


def test_ten_thousand_refusals_keep_no_memory() -> None:
    packet = dataclasses.replace(wire.encode(frame()), payload=bytes(1 << 20))
    with pytest.raises(WireError):
        wire.decode(packet, StereoFrame)
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    for _ in range(10_000):
        with pytest.raises(WireError):
            wire.decode(packet, StereoFrame)
    assert resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before < 5_000  # kB
