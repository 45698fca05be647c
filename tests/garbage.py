"""Messages that nobody should believe, of every kind and for every type."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator
from typing import Any

import msgspec
import numpy as np

from services import wire
from services.messages import Forget, GraspRequest, Health, Latency
from services.wire import Packet
from suturetrack.camera import StereoRig
from suturetrack.grasping import GraspPoint
from suturetrack.types import (
    Energies,
    RidgeField,
    Seed,
    Stamp,
    Status,
    StereoFrame,
    ThreadState,
    Truth,
)
from tests.test_wire import curve, header_of, rig

STAMP = Stamp(7, 233_333_333, 1_700_000_000_000_000_000, 33_333_333)
NAN = float("nan")
_LATENCY = Latency(1.0, NAN, 3.0)


def malformed(kind: type[Any], chance: np.random.Generator) -> Iterator[Packet]:
    """Packets of a type, without end, that must be refused."""
    good = wire.encode(_good(kind))
    while True:
        size = int(chance.integers(0, 2000))
        noise = chance.bytes(size)
        yield Packet(good.encoding, noise, good.attachment)
        yield Packet(good.encoding, noise, noise)
        yield Packet("application/octet-stream", noise, b"")
        yield dataclasses.replace(good, encoding=good.encoding[:-1] + "9")
        yield dataclasses.replace(good, payload=bytes(good.payload)[: len(good.payload) // 2])
        yield dataclasses.replace(good, payload=msgspec.msgpack.encode({"x": [1]}))
        yield header_of(good, number=-1)
        yield from map(wire.encode, _impossible(kind))
        if kind in (StereoFrame, RidgeField):
            yield header_of(good, shapes=[[8192, 8192, 3], [8192, 8192, 3]])
            yield header_of(good, shapes=[[2**62, 4], [4, 2**62]])
            yield header_of(good, dtype="O")
            yield header_of(good, stamp=[2**63, 0, 0])
            yield header_of(good, stamp=[-1, 0, 0])


def _good(kind: type[Any]) -> Any:
    image, view = np.zeros((48, 64, 3), np.uint8), np.zeros((48, 64, 2), np.float32)
    return {
        StereoFrame: StereoFrame(STAMP, image, image),
        RidgeField: RidgeField(STAMP, view, view),
        ThreadState: _state(),
        Truth: Truth(STAMP, "0", np.ones((4, 3)), 0.2, np.ones(4, bool)),
        Seed: Seed("0", pixel=(1.0, 2.0)),
        Stamp: STAMP,
        Health: Health("source", 1, STAMP, 1.0, Latency(), 1.0, Latency(), 1, 0, 0, 1.0),
        GraspRequest: GraspRequest("0", GraspPoint(from_start=0.01)),
        Forget: Forget("0"),
        StereoRig: rig(),
        type(None): None,
    }[kind]


def _state(**changes: Any) -> ThreadState:
    energies, sigma = Energies(-0.9, -0.8, -0.5, 2.0), np.full(5, 1e-4)
    whole = ThreadState(
        STAMP, "0", Status.TRACKING, curve(), 0.175, energies, sigma, np.ones(5, bool)
    )
    return dataclasses.replace(whole, **changes)


def _impossible(kind: type[Any]) -> list[Any]:
    """Messages that hold what is not finite, or do not fit together."""
    view = np.full((48, 64, 2), NAN, np.float32)
    image = np.zeros((48, 64, 3), np.uint8)
    broken = dataclasses.replace(curve(), control_points=np.full((6, 3), np.inf))
    return {
        StereoFrame: [StereoFrame(STAMP, image, image[:24])],
        RidgeField: [RidgeField(STAMP, view, view), RidgeField(STAMP, view * 0 + np.inf, view)],
        ThreadState: [
            _state(curve=broken),
            _state(length=NAN),
            _state(sigma=np.full(5, NAN)),
            _state(sigma=np.empty(0), seen=np.empty(0, bool)),
        ],
        Truth: [Truth(STAMP, "0", np.full((4, 3), NAN), 0.2, np.ones(4, bool))],
        Seed: [Seed("0", pixel=(NAN, 2.0)), Seed("0", point=(1.0, 2.0, np.inf)), Seed("0")],
        Stamp: [Stamp(-1, 0, 0)],
        Health: [Health("source", 1, STAMP, NAN, _LATENCY, 1.0, Latency(), 1, 0, 0, 1.0)],
    }.get(kind, [])
