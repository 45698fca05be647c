"""What systemd hears of a process that it started: that it runs, and as long as it does not hang.

The protocol of sd_notify; without systemd nothing is said.
"""

from __future__ import annotations

import os
import socket
from contextlib import suppress

from services.messages import Health
from services.pulse import longest_still


class Watchdog:
    """Is fed at every heartbeat; a loop that hangs leaves the heartbeat alive, but is not fed for."""

    def __init__(self) -> None:
        self._progress: tuple[int, int, bool] | None = None
        self._still = 0

    def feed(self, health: Health, *, work_waits: bool) -> None:
        """To be called with every heartbeat, and whether there are messages that the loop has not taken."""
        progress = (health.frames, health.refused, health.ready)
        idle = bool(health.awaits) or (health.ready and not work_waits)
        self._still = 0 if idle or progress != self._progress else self._still + 1
        self._progress = progress
        if self._still <= longest_still(health):
            _tell("READY=1\nWATCHDOG=1")


def _tell(words: str) -> None:
    address = os.environ.get("NOTIFY_SOCKET", "")
    if address:
        with suppress(OSError), socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as systemd:
            systemd.setblocking(False)
            # An @ stands for the zero byte with which an abstract name begins.
            systemd.sendto(words.encode(), address.replace("@", "\0", 1))
