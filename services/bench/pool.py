"""Cases of a benchmark side by side, each in a process of its own."""

from __future__ import annotations

import os
import threading
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from multiprocessing import get_context, parent_process
from typing import TypeVar

from suturetrack.types import InputError

Case = TypeVar("Case")
Result = TypeVar("Result")


def side_by_side(
    work: Callable[[Case], Result], cases: Sequence[Case], workers: int
) -> Iterator[Result]:
    """What `work` makes of every case, as they are done.

    Raises:
        InputError: fewer than one worker.
    """
    check_count("workers", workers)
    # Numba and OpenCV keep threads, which do not survive a fork.
    context = get_context("spawn")
    with ProcessPoolExecutor(workers, context, initializer=_end_with_parent) as pool:
        for future in as_completed([pool.submit(work, case) for case in cases]):
            yield future.result()


def check_count(name: str, count: int) -> None:
    """Raises InputError unless there is at least one of what a benchmark is asked for."""
    if count < 1:
        raise InputError(f"{name} {count}: use 1 or more")


def _end_with_parent() -> None:
    """Ends this worker as soon as the benchmark that started it is gone."""
    parent = parent_process()
    assert parent is not None

    def watch() -> None:
        parent.join()
        os._exit(1)

    threading.Thread(target=watch, daemon=True).start()
