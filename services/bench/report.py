"""What every benchmark does with its rows: a table in the terminal, JSON, and one page with plots."""

from __future__ import annotations

import base64
import html
import io
import json
import os
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, fields
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console
from rich.table import Table

from services.output import opened
from suturetrack.types import InputError


@dataclass(frozen=True)
class Plot:
    """One picture of the page: a dot a row, by group along x."""

    column: str
    group: str
    reference: str | None = None
    """A column whose values are drawn beside, as what was published or what physics allows."""
    logarithmic: bool = False


def print_rows(console: Console, title: str, rows: Sequence[Any]) -> None:
    """A table of dataclass rows, a column a field; fields that are nan in every row are left out."""
    if not rows:
        console.print(f"{title}: no rows")
        return
    names = [f.name for f in fields(rows[0]) if not _is_empty([getattr(r, f.name) for r in rows])]
    table = Table(title=title, title_justify="left", header_style="bold", pad_edge=False)
    for name in names:
        is_text = isinstance(getattr(rows[0], name), str)
        table.add_column(
            name.replace("_", "\n"), justify="left" if is_text else "right", no_wrap=True
        )
    for row in rows:
        table.add_row(*(_text(getattr(row, name)) for name in names))
    width = console.width
    # A narrow terminal may wrap the lines, but no figure is cut.
    console.width = max(
        width, console.measure(table, options=console.options.update(width=999)).maximum
    )
    console.print(table, crop=False)
    console.width = width


def check_writable(path: Path) -> None:
    """Raises InputError, before the work is done, where a file could not be written."""
    is_file = path.is_file() or not path.exists()
    place = Path(os.path.realpath(path)).parent if is_file else path
    if path.is_dir() or not os.access(place, os.W_OK):
        raise InputError(f"cannot write {path}: name a file in a folder that is there")


def write_json(path: Path, tables: Mapping[str, Sequence[Any]]) -> None:
    """All rows at full precision, `{table: [row, ...]}`; nan is null. Raises InputError."""
    content = {
        name: [{k: _finite(v) for k, v in asdict(row).items()} for row in rows]
        for name, rows in tables.items()
    }
    with opened(path) as file:
        file.write(json.dumps(content, indent=1) + "\n")


def write_page(
    path: Path, title: str, tables: Mapping[str, Sequence[Any]], plots: Mapping[str, Sequence[Plot]]
) -> None:
    """One HTML page without outside resources: each table with its plots above it. Raises InputError."""
    parts = [f"<h1>{html.escape(title)}</h1>"]
    for name, rows in tables.items():
        parts.append(f"<h2>{html.escape(name)}</h2>")
        parts += [
            f'<img alt="{html.escape(p.column)}" src="data:image/png;base64,{_picture(rows, p)}">'
            for p in plots.get(name, ())
            if rows
        ]
        parts.append(_html_table(rows))
    style = (
        "body{font:15px/1.4 system-ui,sans-serif;margin:2rem;color:#222}"
        "table{border-collapse:collapse}td,th{padding:.2rem .6rem;border-bottom:1px solid #ddd;"
        "text-align:right}td:first-child,th:first-child{text-align:left}img{max-width:100%}"
    )
    head = f'<meta charset="utf-8"><title>{html.escape(title)}</title><style>{style}</style>'
    with opened(path) as file:
        file.write(f"<!doctype html>{head}" + "\n".join(parts))


def _picture(rows: Sequence[Any], plot: Plot) -> str:
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot

    groups = list(dict.fromkeys(getattr(r, plot.group) for r in rows))
    figure, axes = pyplot.subplots(figsize=(max(6, 0.9 * len(groups)), 3.2), layout="constrained")
    for i, group in enumerate(groups):
        members = [r for r in rows if getattr(r, plot.group) == group]
        values = [getattr(r, plot.column) for r in members]
        axes.scatter(np.linspace(i - 0.2, i + 0.2, len(values)), values, s=14, color="#1f77b4")
        if plot.reference is not None:
            reference = [getattr(r, plot.reference) for r in members]
            axes.scatter(
                np.linspace(i - 0.2, i + 0.2, len(values)),
                reference,
                s=30,
                marker="_",
                color="#d62728",
            )
    axes.set_xticks(range(len(groups)), groups, rotation=30, ha="right")
    axes.set_ylabel(plot.column.replace("_", " "))
    axes.grid(axis="y", alpha=0.3)
    if plot.logarithmic:
        axes.set_yscale("log")
    buffer = io.BytesIO()
    figure.savefig(buffer, dpi=110)
    pyplot.close(figure)
    return base64.b64encode(buffer.getvalue()).decode()


def _html_table(rows: Sequence[Any]) -> str:
    if not rows:
        return "<p>No rows.</p>"
    names = [f.name for f in fields(rows[0])]
    head = "".join(f"<th>{html.escape(n.replace('_', ' '))}</th>" for n in names)
    body = "".join(
        "<tr>" + "".join(f"<td>{html.escape(_text(getattr(r, n)))}</td>" for n in names) + "</tr>"
        for r in rows
    )
    return f"<table><tr>{head}</tr>{body}</table>"


def _is_empty(values: list[Any]) -> bool:
    return all(isinstance(v, float) and np.isnan(v) for v in values)


def _finite(value: Any) -> Any:
    return None if isinstance(value, float) and not np.isfinite(value) else value


def _text(value: Any) -> str:
    if isinstance(value, float):
        return "-" if np.isnan(value) else f"{value:.3g}" if abs(value) < 100 else f"{value:.1f}"
    return str(value)
