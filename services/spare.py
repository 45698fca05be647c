"""A process in waiting: all is loaded, so that it takes a dead one's place at once.

Nearly all of a process's start is the loading of libraries and compiled kernels, the same for each.
"""

from __future__ import annotations

import json
import sys
from contextlib import suppress
from pathlib import Path

from services import cli  # first, as it keeps the libraries to one thread


def main() -> None:
    """Loads all, waits for the arguments of a process on one line, and becomes that process."""
    import numpy as np

    from services import segmenter, source, tracker
    from suturetrack.camera import StereoRig

    del source
    camera = np.array([[800.0, 0, 320], [0, 800, 240], [0, 0, 1]]), np.zeros(5)
    rig = StereoRig.from_calibration(
        (640, 480), camera, camera, np.eye(3), np.array([-0.04, 0, 0]), 1.0
    )
    segmenter.warm_up(rig, segmenter.SegmenterConfig())
    tracker.warm_up(rig, tracker.TrackerConfig())
    with suppress(OSError):
        Path("/proc/self/comm").write_text("spare")
    line = sys.stdin.readline()
    if line:
        sys.argv[1:] = json.loads(line)
        cli.main()


if __name__ == "__main__":
    main()
