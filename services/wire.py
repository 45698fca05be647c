"""Types <-> bytes.

Frames and fields travel as their raw arrays, left then right; those of several threads one after the
other, and behind them the colours: the pixels of both views, then what is seen there. The header in
the attachment gives shapes, dtype, stamp, threads and counts. Everything else travels as MessagePack,
arrays as nested lists. The encoding names the schema and its version:
`application/octet-stream;frame/1`, `application/msgpack;state/1`. Lengths on the wire are in metres.
"""

from __future__ import annotations

import dataclasses
import itertools
import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Annotated, Any, Protocol, TypeVar

import msgspec
import numpy as np

from services import checks
from services.messages import (
    Forget,
    Forgotten,
    GraspReply,
    GraspRequest,
    Health,
    SeedReply,
    ToolPose,
    ToolSnap,
)
from suturetrack.camera import LARGEST_SIDE, StereoRig
from suturetrack.segmentation import joined
from suturetrack.types import (
    Colours,
    Grasp,
    Nurbs,
    RidgeField,
    Seed,
    Stamp,
    StereoFrame,
    ThreadState,
    Truth,
)

T = TypeVar("T")

LARGEST_SMALL_MESSAGE = 1 << 20
"""Bytes of a MessagePack payload and of an attachment; a state of 100 control points has 5 kB."""
MOST_THREADS = 64
"""With a field of their own."""

_RAW: dict[type[Any], tuple[str, np.dtype[Any]]] = {
    StereoFrame: ("frame/1", np.dtype("<u1")),
    RidgeField: ("field/3", np.dtype("<f4")),
}
_PLACE = np.dtype("<u2")
_COLOURED = 2 * _PLACE.itemsize + 3
"""Bytes of a pixel's place and colour."""
_SMALL: dict[type[Any], str] = {
    ThreadState: "state/1",
    Truth: "truth/1",
    Seed: "seed/1",
    SeedReply: "seed-reply/1",
    Grasp: "grasp/1",
    Forget: "forget/1",
    Forgotten: "forgotten/1",
    GraspRequest: "grasp-request/1",
    GraspReply: "grasp-reply/1",
    Stamp: "stamp/1",
    ToolPose: "tool-pose/1",
    ToolSnap: "tool-snap/1",
    Health: "health/1",
    StereoRig: "rig/1",
    type(None): "nothing/1",
}


class WireError(ValueError):
    """A message that is refused; the text says why."""


class Payload(Protocol):
    """Bytes, or what turns into bytes when it is read."""

    def __len__(self) -> int: ...
    def __bytes__(self) -> bytes: ...


@dataclass(frozen=True)
class Packet:
    """A message as it travels."""

    encoding: str
    payload: Payload
    attachment: bytes


_Count = Annotated[int, msgspec.Meta(ge=0, le=2**63 - 1)]
_Side = Annotated[int, msgspec.Meta(ge=1, le=LARGEST_SIDE)]
_Name = Annotated[str, msgspec.Meta(max_length=64)]


class Header(msgspec.Struct, frozen=True):
    """The attachment of every message, in MessagePack."""

    publisher: _Name = ""
    """Which run of which process sent it."""
    number: _Count = 0
    """Counts the publisher's messages under this key from 0, so that a reader sees gaps."""
    sent_ns: _Count = 0
    """Wall clock when it was sent."""
    stamp: tuple[_Count, _Count, _Count] | None = None
    """Frame number, capture time and release time of raw arrays."""
    period_ns: _Count = 0
    """Of raw arrays: time until the next frame is due; 0 where nothing is promised."""
    dtype: _Name = ""
    shapes: Annotated[list[list[_Side]], msgspec.Meta(max_length=2 * MOST_THREADS)] = []
    """Of the arrays in the payload, one after another."""
    threads: Annotated[list[_Name], msgspec.Meta(max_length=MOST_THREADS)] = []
    """Of a field, where several have one of their own: whose left and right follow one another. The
    field of all has the longest of their vectors at each pixel."""
    colours: Annotated[list[_Count], msgspec.Meta(max_length=2)] = []
    """Of a field of colour images: of how many pixels of the left and of the right view they follow the
    shapes. First come the (u, v) of both views, two bytes each, then their blue, green and red."""


def encoding_of(kind: type[Any]) -> str:
    """The encoding under which a type travels."""
    if kind in _RAW:
        return f"application/octet-stream;{_RAW[kind][0]}"
    return f"application/msgpack;{_SMALL[kind]}"


def encode(message: object, publisher: str = "", number: int = 0, sent_ns: int = 0) -> Packet:
    """A message as bytes; the arguments beside it go into its header."""
    kind = type(message)
    if isinstance(message, StereoFrame | RidgeField):
        own = message.own if isinstance(message, RidgeField) else {}
        colours = (message.colours or ()) if isinstance(message, RidgeField) else ()
        pairs: list[tuple[Any, Any]] = [*own.values()] or [(message.left, message.right)]
        views = [np.ascontiguousarray(v, _RAW[kind][1]) for v in itertools.chain(*pairs)]
        stamp = (message.stamp.frame, message.stamp.capture_ns, message.stamp.released_ns)
        shapes = [list(v.shape) for v in views]
        dtype, period_ns = views[0].dtype.str, message.stamp.period_ns
        counts = [len(of_view.pixels) for of_view in colours]
        header = Header(
            publisher, number, sent_ns, stamp, period_ns, dtype, shapes, list(own), counts
        )
        views += [np.ascontiguousarray(of_view.pixels, _PLACE) for of_view in colours]
        views += [np.ascontiguousarray(of_view.bgr) for of_view in colours]
        payload = b"".join(view.data for view in views)
    else:
        header = Header(publisher, number, sent_ns)
        payload = _ENCODER.encode(message)
    return Packet(encoding_of(kind), payload, _ENCODER.encode(header))


def decode_header(packet: Packet) -> Header:
    """The header alone; raises WireError."""
    if len(packet.attachment) > LARGEST_SMALL_MESSAGE:
        raise WireError(f"header of {len(packet.attachment)} bytes")
    try:
        return _HEADER_DECODER.decode(packet.attachment)
    except (ValueError, RecursionError) as error:
        raise WireError(f"header: {error}") from error


def decode(packet: Packet, kind: type[T]) -> tuple[T, Header]:
    """A message of the expected type, checked, and its header.

    Raises:
        WireError: it has another schema or version, is malformed, or holds impossible values.
    """
    if packet.encoding != encoding_of(kind):
        raise WireError(f"encoding {packet.encoding[:80]!r}, expected {encoding_of(kind)!r}")
    header = decode_header(packet)
    try:
        raw = kind in _RAW
        message = _decode_raw(packet, kind, header) if raw else _decode_small(packet, kind)
        checks.check(message)
    except (ValueError, RecursionError, OverflowError) as error:
        raise WireError(str(error)) from error
    return message, header


def _decode_raw(packet: Packet, kind: type[Any], header: Header) -> Any:
    dtype = _RAW[kind][1]
    _check_raw(packet, kind, header)
    payload = bytes(packet.payload)
    sizes = [math.prod(shape) for shape in header.shapes]
    data = np.frombuffer(payload, dtype, sum(sizes))
    parts = np.split(data, np.cumsum(sizes)[:-1])
    views = [p.reshape(s) for p, s in zip(parts, header.shapes, strict=True)]
    assert header.stamp is not None  # as was checked
    stamp, pairs = Stamp(*header.stamp, header.period_ns), zip(views[::2], views[1::2], strict=True)
    if kind is StereoFrame:
        return StereoFrame(stamp, *next(pairs))
    colours = _colours(payload[data.nbytes :], header.colours)
    if not header.threads:
        return RidgeField(stamp, *next(pairs), colours=colours)
    if any(view.shape != views[0].shape or view.shape[2:] != (2,) for view in views):
        raise WireError(f"fields of shapes {header.shapes}, expected (H, W, 2) all alike")
    return joined(stamp, dict(zip(header.threads, pairs, strict=True)), colours)


def _check_raw(packet: Packet, kind: type[Any], header: Header) -> None:
    dtype = _RAW[kind][1]
    if header.dtype != dtype.str:
        raise WireError(f"dtype {header.dtype!r}, expected {dtype.str!r}")
    if header.stamp is None or len(header.shapes) != 2 * max(len(header.threads), 1):
        raise WireError("the header lacks the stamp or two shapes, of a field two for each thread")
    size = sum(map(math.prod, header.shapes)) * dtype.itemsize
    if len(packet.payload) != size + sum(header.colours) * _COLOURED:
        more = f" and {sum(header.colours)} colours" if header.colours else ""
        raise WireError(f"{len(packet.payload)} bytes for shapes {header.shapes} of {dtype}{more}")
    if (header.threads or header.colours) and kind is not RidgeField:
        raise WireError("the header names threads or colours, which only fields have")
    if len(header.colours) == 1:
        raise WireError("the header counts the colours of one view, expected two or none")
    if len(set(header.threads)) < len(header.threads):
        raise WireError("the header names a thread twice")


def _colours(payload: bytes, counts: list[int]) -> tuple[Colours, Colours] | None:
    if not counts:
        return None
    total = sum(counts)
    pixels = np.frombuffer(payload, _PLACE, 2 * total).reshape(-1, 2)
    bgr = np.frombuffer(payload, np.uint8, offset=pixels.nbytes).reshape(-1, 3)
    left, right = slice(counts[0]), slice(counts[0], None)
    return Colours(pixels[left], bgr[left]), Colours(pixels[right], bgr[right])


def _decode_small(packet: Packet, kind: type[Any]) -> Any:
    if len(packet.payload) > LARGEST_SMALL_MESSAGE:
        raise WireError(f"{len(packet.payload)} bytes, at most {LARGEST_SMALL_MESSAGE} are taken")
    return _DECODERS[kind].decode(bytes(packet.payload))


def _array_to_list(value: object) -> object:
    if isinstance(value, np.ndarray):
        return value.tolist()
    raise TypeError(f"{type(value).__name__} has no form on the wire")


def _list_to_array(kind: Any, value: object) -> object:
    dtype = np.dtype(kind.__args__[1].__args__[0])
    array = np.array(value)
    if array.size and array.dtype.kind not in ("b" if dtype.kind == "b" else "fiu"):
        raise ValueError(f"an array of {array.dtype}, expected {dtype}")
    return array.astype(dtype)


_ENCODER = msgspec.msgpack.Encoder(enc_hook=_array_to_list)
_HEADER_DECODER = msgspec.msgpack.Decoder(Header)
_DECODERS: dict[type[Any], msgspec.msgpack.Decoder[Any]] = {
    kind: msgspec.msgpack.Decoder(kind, dec_hook=_list_to_array) for kind in _SMALL
}


def scaled(message: T, factor: float) -> T:
    """The message with every length multiplied: from the calibration's unit to metres, or back."""
    return _SCALE[type(message)](message, factor)


def _scale_curve(curve: Nurbs, factor: float) -> Nurbs:
    return dataclasses.replace(curve, control_points=curve.control_points * factor)


def _scale_state(state: ThreadState, factor: float) -> ThreadState:
    return dataclasses.replace(
        state,
        curve=state.curve and _scale_curve(state.curve, factor),
        length=state.length * factor,
        sigma=state.sigma * factor,
    )


def _scale_truth(truth: Truth, factor: float) -> Truth:
    return dataclasses.replace(truth, points=truth.points * factor, length=truth.length * factor)


def _scale_seed(seed: Seed, factor: float) -> Seed:
    if seed.point is None:
        return seed
    return dataclasses.replace(seed, point=_scale_point(seed.point, factor))


def _scale_grasp_request(request: GraspRequest, factor: float) -> GraspRequest:
    where = request.where
    lengths = {
        name: None if value is None else value * factor
        for name, value in (("from_start", where.from_start), ("from_end", where.from_end))
    }
    near = None if where.near is None else _scale_point(where.near, factor)
    return dataclasses.replace(request, where=dataclasses.replace(where, near=near, **lengths))


def _scale_grasp(grasp: Grasp, factor: float) -> Grasp:
    return dataclasses.replace(grasp, position=grasp.position * factor, sigma=grasp.sigma * factor)


def _scale_point(point: tuple[float, float, float], factor: float) -> tuple[float, float, float]:
    x, y, z = point
    return x * factor, y * factor, z * factor


_SCALE: dict[type[Any], Callable[[Any, float], Any]] = {
    Nurbs: _scale_curve,
    ThreadState: _scale_state,
    Truth: _scale_truth,
    Seed: _scale_seed,
    GraspRequest: _scale_grasp_request,
    Grasp: _scale_grasp,
}
