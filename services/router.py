"""`suturetrack router`: a Zenoh router between the hosts of one or more rigs."""

from __future__ import annotations

import json
import signal
import threading
from dataclasses import dataclass
from pathlib import Path

import zenoh

from services import RUST_LOG
from services.zenoh_session import configured
from services.zenoh_transport import endpoints, explain, load_config
from suturetrack.types import InputError

_OPEN = {
    "mode": "router",
    "scouting/multicast/enabled": False,
    "listen/endpoints": ["tcp/127.0.0.1:7447"],
}
"""A router for the programs of this machine."""
_LONGEST_WAIT_S = 0.25


@dataclass(frozen=True)
class RouterConfig:
    """Passes messages between hosts until it is stopped; what passes, its configuration says."""

    zenoh: Path | None = None
    """A Zenoh configuration file, as `suturetrack keys init` makes one; without it, the router listens
    on tcp/127.0.0.1:7447 and lets everything pass."""


def run(config: RouterConfig) -> None:
    """Runs until SIGINT or SIGTERM; raises InputError."""
    settings = configured(_OPEN) if config.zenoh is None else load_config(config.zenoh)
    if json.loads(settings.get_json("mode")) != "router":
        raise InputError(f'zenoh {config.zenoh}: a router needs mode: "router"')
    zenoh.init_log_from_env_or(RUST_LOG)
    stop = threading.Event()

    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, lambda *_: stop.set())
    try:
        with zenoh.open(settings):
            print(f"router: listening on {endpoints(settings, 'listen')}", flush=True)
            # A signal may reach another thread than this one, which handles it when it wakes up.
            while not stop.wait(_LONGEST_WAIT_S):
                pass
    except zenoh.ZError as error:
        raise InputError(explain(error, settings)) from error
