"""`suturetrack console`: the operator's page, a process of its own that only listens and asks."""

from __future__ import annotations

import ipaddress
import os
import secrets
from dataclasses import dataclass
from pathlib import Path

from services.console.feed import Feed
from services.console.recording import Recording
from services.console.server import serve
from services.service import Service, ServiceConfig
from services.service import run as run_service
from suturetrack.types import InputError

_NICE = 5


@dataclass(frozen=True)
class ConsoleConfig:
    """Serves a page with the live images, on which threads are seeded and watched."""

    rig: str = "rig"
    """Name of the rig."""
    zenoh: Path | None = None
    """The Zenoh configuration file of the running system, if it has one."""
    host: str = "127.0.0.1"
    """Address to serve on. Beyond this machine the page asks for the token that is printed, and goes
    over the network in the clear: put a tunnel or a TLS proxy before it."""
    port: int = 8470
    """Port to serve on; 0 takes a free one."""
    resume: int = 0
    """How many consoles died before this one; only told in its health."""


def run(config: ConsoleConfig) -> None:
    """Serves until SIGINT or SIGTERM.

    Raises:
        InputError: the address or the configuration cannot be used.
    """
    if not 0 <= config.port <= 65535:
        raise InputError(f"port {config.port}: use 1 to 65535, or 0 for a free one")
    token = "" if _is_loopback(config.host) else secrets.token_urlsafe(16)

    def body(service: Service) -> None:
        # Whatever else the machine has to do comes first.
        os.nice(_NICE)
        recording = Recording(config.rig, config.zenoh)
        feed = Feed(service.bus, recording)
        service.ready()
        try:
            serve(feed, config.host, config.port, token)
        finally:
            recording.close()

    service = ServiceConfig(rig=config.rig, zenoh=config.zenoh, resume=config.resume)
    run_service("console", service, body)


def _is_loopback(host: str) -> bool:
    if host == "localhost":
        return True
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError as error:
        raise InputError(f"host {host!r}: use an address such as 127.0.0.1 or 0.0.0.0") from error
