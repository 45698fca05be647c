"""The look of tables in reports."""

from __future__ import annotations

from rich import box
from rich.console import Console
from rich.table import Table

_FILE_WIDTH = 1000


def report_console() -> Console:
    """Standard output; where it is a file, so wide that nothing is cut."""
    console = Console()
    return console if console.is_terminal else Console(width=_FILE_WIDTH)


def new_table(title: str, first: str, *others: str) -> Table:
    """A plain table with names at the left and numbers at the right."""
    made = Table(title=title, title_justify="left", title_style="bold", box=box.SIMPLE_HEAD)
    made.add_column(first, no_wrap=True)
    for name in others:
        made.add_column(name, justify="right", no_wrap=True)
    return made


def number(value: float, digits: int, *, signed: bool = False) -> str:
    """The number, with a plus where it is `signed`, or a dash for nan."""
    return f"{value:{'+' if signed else '-'}.{digits}f}" if value == value else "-"
