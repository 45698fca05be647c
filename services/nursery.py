"""The process from which those of a run are forked, so that each begins at once.

Nearly all of a process's start is the loading of libraries and the compiling of kernels, the same for
each. Here both happen once, for those that begin with the run and for those that take a dead one's place.
"""

from __future__ import annotations

import gc
import json
import os
import socket
import sys
import time
from contextlib import suppress
from pathlib import Path

from services import cli  # first, as it keeps the libraries to one thread

LONGEST_REQUEST = 1 << 16


def main() -> None:
    """Forks a process for each request on the socket that is its standard input, until that closes.

    A request is the arguments of the process as a JSON list, with the pipe for what it says. That all is
    loaded, it says by one byte.
    """
    with suppress(OSError):
        Path("/proc/self/comm").write_text("nursery")
    desk = socket.socket(fileno=os.dup(0))
    _load()
    with suppress(BrokenPipeError):
        desk.send(b"!")
    while True:
        request, pipes, _, _ = socket.recv_fds(desk, LONGEST_REQUEST, 1)
        if not request:
            return
        if _fork(pipes[0]):
            desk.close()
            sys.argv[1:] = json.loads(request)
            cli.main()
            return
        os.close(pipes[0])


def _load() -> None:
    import numpy as np

    from services import recording, segmenter, source, tracker
    from services.service import compiling
    from suturetrack.camera import StereoRig

    del recording, source
    camera = np.array([[800.0, 0, 320], [0, 800, 240], [0, 0, 1]]), np.zeros(5)
    rig = StereoRig.from_calibration(
        (640, 480), camera, camera, np.eye(3), np.array([-0.04, 0, 0]), 1.0
    )
    with compiling():
        segmenter.warm_up(rig, segmenter.SegmenterConfig())
        tracker.warm_up(rig, tracker.TrackerConfig())
    # What is there now stays, and its pages stay shared.
    gc.collect()
    gc.freeze()


def _fork(pipe: int) -> bool:
    """Whether this is the new process. Its parent is the launcher, which takes in orphans."""
    between = os.fork()
    if between:
        os.waitpid(between, 0)
        return False
    between = os.getpid()
    if os.fork():
        os._exit(0)
    while os.getppid() == between:
        time.sleep(0.001)
    os.setsid()
    os.dup2(pipe, 2)
    os.close(pipe)
    nothing = os.open(os.devnull, os.O_RDWR)
    os.dup2(nothing, 0)
    os.close(nothing)
    os.write(2, f"{os.getpid()}\n".encode())
    return True


if __name__ == "__main__":
    main()
