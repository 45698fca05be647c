"""The figures of a run as tables."""

from __future__ import annotations

from rich.console import Console
from rich.markup import escape
from rich.table import Table

from services.summary import WRONG_PX, ProcessSummary, RunSummary, ThreadSummary
from services.tables import new_table, number
from suturetrack.types import Status


def show(summary: RunSummary, console: Console) -> None:
    """Prints the tables of a run."""
    console.print(f"[bold]{escape(summary.name)}[/] ({escape(summary.about)})", highlight=False)
    for problem in summary.problems:
        console.print(f"[yellow]{escape(problem)}[/]", highlight=False)
    console.print(_processes(summary.processes))
    if not summary.threads:
        console.print(summary.no_thread)
        return
    for table in (_status(summary.threads), _lengths(summary.threads), _energies(summary.threads)):
        console.print(table)
    for thread in summary.threads:
        for loss in thread.losses:
            until = "to the end" if loss.recovered is None else f"until frame {loss.recovered}"
            console.print(f"thread {thread.thread} lost at frame {loss.frame} {until}")
    if any(t.error_mm.mean == t.error_mm.mean for t in summary.threads):
        console.print(_errors(summary.threads))


def _processes(processes: list[ProcessSummary]) -> Table:
    table = new_table(
        "Processes (latency from the release of the frame to the result, ms)",
        *("process", "frames", "per second", "latency p50", "p99", "max", "dropped", "memory MB"),
    )
    for p in processes:
        ms = p.latency_ms
        table.add_row(
            *(p.name, str(p.frames), number(p.rate_hz, 1)),
            *(f"{x:.1f}" for x in (ms.p50, ms.p99, ms.largest)),
            *(str(p.dropped), f"{p.memory_mb:.0f}"),
        )
    return table


def _status(threads: list[ThreadSummary]) -> Table:
    table = new_table(
        "Status (% of the frames since the seed)",
        "thread",
        "from frame",
        "frames",
        *Status,
        "skipped",
        "losses",
    )
    for t in threads:
        table.add_row(
            *(t.thread, str(t.first), str(t.frames)),
            *(f"{100 * share:.1f}" for share in (*t.shares.values(), t.skipped_share)),
            str(len(t.losses)),
        )
    return table


def _lengths(threads: list[ThreadSummary]) -> Table:
    table = new_table(
        "Length (mm; Table I)",
        *("thread", "true", "measured", "sigma", "error %", "control points"),
    )
    for t in threads:
        length, points = t.length_mm, t.control_points
        table.add_row(
            *(t.thread, number(t.true_length_mm, 1)),
            *(number(length.mean, 2), number(length.sigma, 2)),
            number(t.length_error_percent, 2),
            f"{number(points.smallest, 0)} to {number(points.largest, 0)}",
        )
    return table


def _energies(threads: list[ThreadSummary]) -> Table:
    table = new_table(
        "Energies (eqs. 4 and 7; best: -1 an image)",
        *("thread", "left mean", "left worst", "right mean", "right worst", "ends mean"),
        *("ends worst", "bending mean"),
    )
    for t in threads:
        e = t.energies
        numbers = [
            x for n in ("image_left", "image_right", "end") for x in (e[n].mean, e[n].largest)
        ]
        table.add_row(t.thread, *(number(x, 3) for x in (*numbers, e["internal"].mean)))
    return table


def _errors(threads: list[ThreadSummary]) -> Table:
    table = new_table(
        f"Distance from the truth, mean over the curve (wrong: over {WRONG_PX:g} px)",
        *("thread", "p50 mm", "p95 mm", "worst mm", "p50 px", "worst px", "at frame"),
        "wrong %",
    )
    for t in threads:
        mm, px = t.error_mm, t.error_px
        table.add_row(
            t.thread,
            *(number(x, 3) for x in (mm.p50, mm.p95, mm.largest)),
            *(number(x, 2) for x in (px.p50, px.largest)),
            *(str(t.worst_frame), number(100 * t.wrong_share, 1)),
        )
    return table
