"""A run as one self-contained page: tables, plots and key frames."""

from __future__ import annotations

import base64
import html
import io
from collections.abc import Iterable, Sequence
from itertools import pairwise

import cv2
import numpy as np
from rich.console import Console

from services.course import Course
from services.report import show
from services.run_folder import RecordedState, RunFolder
from services.summary import RunSummary, ThreadSummary
from suturetrack import nurbs
from suturetrack.camera import StereoRig
from suturetrack.types import Float64, Image, Status

_COLORS = {Status.TRACKING: "#2ca84a", Status.OCCLUDED: "#e6a023", Status.LOST: "#d63a2f"}
_LINES = ("#2f6fd0", "#d9702b", "#8a4fc4")
_MOST_LOSSES = 6
_WIDTH, _HEIGHT, _LEFT, _TOP, _BOTTOM = 1000, 180, 64, 6, 22
_STYLE = """
body { font: 15px/1.45 system-ui, sans-serif; max-width: 1080px; margin: 2rem auto; color: #222; }
pre { font-size: 12.5px; line-height: 1.25; overflow-x: auto; }
h2 small, h3 small { font-weight: normal; margin-left: 0.7em; }
svg { width: 100%; } svg text { font-size: 11px; fill: #555; }
figure { margin: 1rem 0; } figure img { width: 100%; } figcaption { color: #555; }
"""


def page(folder: RunFolder, summary: RunSummary) -> str:
    """The page's HTML; needs no other file and no network."""
    parts = [f"<h1>{html.escape(summary.name)}</h1>", _tables(summary)]
    rig = folder.rig()
    for thread, course in zip(summary.threads, summary.courses, strict=True):
        parts.append(f"<h2>Thread {html.escape(thread.thread)}{_key(_COLORS.items())}</h2>")
        parts += _plots(course)
        parts += _key_frames(folder, thread, course, rig)
    head = f"<meta charset='utf-8'><title>{html.escape(summary.name)}</title>"
    return f"<!doctype html><html lang='en'><head>{head}<style>{_STYLE}</style></head><body>" + (
        "\n".join(parts) + "</body></html>\n"
    )


def _tables(summary: RunSummary) -> str:
    console = Console(record=True, width=120, file=io.StringIO())
    show(summary, console)
    return f"<pre>{html.escape(console.export_text())}</pre>"


def _plots(course: Course) -> list[str]:
    latency = np.array([recorded.latency_ms for recorded in course.states])
    e = course.energies
    plots = [
        _plot("Length, mm", course, {"measured": course.length_mm, "true": course.true_length_mm}),
        _plot(
            "Image energy (best: -1)", course, {"left": e["image_left"], "right": e["image_right"]}
        ),
        _plot("End energy", course, {"both views": e["end"]}),
        _plot("Distance from the truth, mm", course, {"mean over the curve": course.error_mm}),
        _plot("Latency, ms", course, {"release to state": latency}),
    ]
    return [plot for plot in plots if plot]


def _plot(title: str, course: Course, lines: dict[str, Float64]) -> str:
    """An SVG of values over frames, on a ground that tells the status; empty without values."""
    lines = {name: y for name, y in lines.items() if np.isfinite(y).any()}
    if not lines:
        return ""
    every = np.concatenate(list(lines.values()))
    low, high = float(np.nanmin(every)), float(np.nanmax(every))
    pad = 0.05 * (high - low) or 0.05 * abs(high) or 1.0
    low, high = low - pad, high + pad
    first, last = int(course.frames[0]), int(course.frames[-1])
    x = _LEFT + (course.frames - first) / max(last - first, 1) * (_WIDTH - _LEFT)

    def height(y: Float64) -> Float64:
        return (high - y) / (high - low) * (_HEIGHT - _BOTTOM)

    drawn = [_strip(course, x)]
    for level in _ticks(low, high):
        at = float(height(np.array(level)))
        drawn.append(
            f"<line x1='{_LEFT}' x2='{_WIDTH}' y1='{at:.1f}' y2='{at:.1f}' stroke='#ddd'/>"
            f"<text x='{_LEFT - 6}' y='{at + 4:.1f}' text-anchor='end'>{level:g}</text>"
        )
    colors = dict(zip(lines, _LINES, strict=False))
    drawn += [_line(x, height(y), colors[name]) for name, y in lines.items()]
    drawn += [
        f"<text x='{_LEFT}' y='{_HEIGHT - 2}'>frame {first}</text>",
        f"<text x='{_WIDTH}' y='{_HEIGHT - 2}' text-anchor='end'>frame {last}</text>",
    ]
    heading = f"<h3>{title}{_key(colors.items())}</h3>"
    box = f"0 {-_TOP} {_WIDTH} {_TOP + _HEIGHT}"  # room for half a label above the uppermost value
    return f"{heading}<svg viewBox='{box}'>{''.join(drawn)}</svg>"


def _key(colors: Iterable[tuple[str, str]]) -> str:
    """Names in their colours, beside a heading."""
    return "".join(f" <small style='color:{color}'>{name}</small>" for name, color in colors)


def _line(x: Float64, y: Float64, color: str) -> str:
    """The pieces of a line between its gaps."""
    known = np.isfinite(y)
    pieces = np.split(np.arange(len(y)), np.flatnonzero(np.diff(known)) + 1)
    return "".join(
        f"<polyline fill='none' stroke='{color}' stroke-width='1.5' points='"
        + " ".join(f"{x[i]:.1f},{y[i]:.1f}" for i in piece)
        + "'/>"
        for piece in pieces
        if known[piece[0]]
    )


def _strip(course: Course, x: Float64) -> str:
    """A line of colour at the foot of a plot: the status."""
    edges = np.flatnonzero(course.status[1:] != course.status[:-1]) + 1
    bounds = np.r_[0, edges, len(x) - 1].tolist()
    return "".join(
        f"<rect x='{x[a]:.1f}' y='{_HEIGHT - _BOTTOM}' height='5' "
        f"width='{max(x[b] - x[a], 1.5):.1f}' fill='{_COLORS[Status(course.status[a])]}'/>"
        for a, b in pairwise(bounds)
    )


def _ticks(low: float, high: float) -> list[float]:
    """Three to six round numbers between two."""
    raw = (high - low) / 5
    power = 10.0 ** np.floor(np.log10(raw))
    step = next(m * power for m in (1, 2, 5, 10) if m * power >= raw)
    first, last = np.ceil(low / step), np.floor(high / step)
    return [round(k * step, 12) for k in range(int(first), int(last) + 1)]


def _key_frames(
    folder: RunFolder, thread: ThreadSummary, course: Course, rig: StereoRig
) -> Iterable[str]:
    """Pictures of the initialisation, the worst frame and the losses."""
    with_curve = [int(f) for f, y in zip(course.frames, course.length_mm, strict=True) if y == y]
    moments: dict[int, str] = {}
    if with_curve:
        moments[with_curve[0]] = "initialisation"
    if thread.worst_frame is not None:
        moments.setdefault(thread.worst_frame, "the worst frame that is not lost")
    for loss in thread.losses[:_MOST_LOSSES]:
        moments.setdefault(loss.frame, "lost")
    images = folder.images(moments)
    states = dict(zip(course.frames.tolist(), course.states, strict=True))
    for frame, what in sorted(moments.items()):
        pair = [images[key] for key in ((frame, "left"), (frame, "right")) if key in images]
        if len(pair) == 2:
            picture = _encoded(_overlaid(pair, states[frame], rig))
            status = states[frame].state.status
            caption = f"Frame {frame}: {what} ({status})"
            yield f"<figure>{picture}<figcaption>{caption}</figcaption></figure>"


def _overlaid(pair: Sequence[Image], recorded: RecordedState, rig: StereoRig) -> Image:
    """Both views side by side with the curve and its control points."""
    curve = recorded.state.curve
    views = [cv2.cvtColor(i, cv2.COLOR_GRAY2BGR) if i.ndim == 2 else i.copy() for i in pair]
    if curve is not None:
        path = rig.project_raw(nurbs.evaluate(curve, np.linspace(0, 1, 400)))
        points = rig.project_raw(curve.control_points)
        for image, pixels, dots in zip(views, path, points, strict=True):
            fixed = np.rint(16 * np.clip(pixels, -1e4, 1e4)).astype(np.int32)
            cv2.polylines(image, [fixed], False, (90, 220, 70), 1, cv2.LINE_AA, 4)
            for u, v in np.clip(dots, -1e4, 1e4):
                cv2.circle(image, (round(u), round(v)), 2, (50, 60, 240), -1, cv2.LINE_AA)
    return np.hstack(views)


def _encoded(image: Image) -> str:
    _, data = cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, 88])
    return f"<img alt='' src='data:image/jpeg;base64,{base64.b64encode(data.tobytes()).decode()}'>"
