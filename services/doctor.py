"""`suturetrack doctor`: what is wrong with an installation or a running system, and what to do."""

from __future__ import annotations

import datetime
import ipaddress
import json
import os
import shutil
import sys
import time
from collections.abc import Iterator
from dataclasses import dataclass
from importlib import metadata
from pathlib import Path

import numpy as np
import psutil
from cryptography import x509
from rich.console import Console
from rich.text import Text

from services.status import RigWatch, nothing_runs, watch_rigs
from services.tables import new_table
from services.topics import PROCESSES
from services.zenoh_transport import load_config, socket_root
from suturetrack.types import InputError

OK, WARNING, ERROR = "ok", "warning", "error"
_STYLES = {OK: "green", WARNING: "yellow", ERROR: "red"}
_LISTEN_S = 2.2
_LEAST_SHARED_MB = 128
_LEAST_DISK_GB = 5
_EXPIRES_DAYS = 30
_SKEW_S = 0.05
_SLOW = 0.9
_MESSAGES_LATE_MS = 33.0
_OURS = ("source", "segmenter", "tracker", "console", "ros2", "tooltip")


@dataclass(frozen=True)
class DoctorConfig:
    """Checks this installation and, if something runs, the running system. Ends with status 1 when
    something has to be mended."""

    rig: str | None = None
    """Name of the rig; every rig of this user on this machine without it."""
    zenoh: Path | None = None
    """The Zenoh configuration file of the rig: its certificates are checked too."""


@dataclass(frozen=True)
class Finding:
    """What one check found."""

    level: str
    subject: str
    text: str
    advice: str = ""


def run(config: DoctorConfig) -> None:
    """Prints the findings; raises InputError when one is an error."""
    table = new_table("suturetrack doctor", "check")
    for column in ("", "found", "what to do"):
        table.add_column(column, overflow="fold")
    findings = list(examine(config))
    for finding in findings:
        mark = Text(finding.level, style=_STYLES[finding.level])
        table.add_row(finding.subject, mark, finding.text, finding.advice)
    Console().print(table)
    errors = [f.subject for f in findings if f.level == ERROR]
    if errors:
        raise InputError(f"to be mended: {', '.join(errors)}")


def examine(config: DoctorConfig) -> Iterator[Finding]:
    """All findings, the installation's first."""
    yield from _versions()
    yield _kernels()
    yield _shared_memory()
    yield _sockets()
    yield _disk(Path.cwd())
    if config.zenoh is not None:
        yield from certificates(config.zenoh)
    try:
        watches = watch_rigs(config.rig, config.zenoh, _LISTEN_S)
    except InputError as error:
        yield _fault(str(error))
        return
    try:
        running = [watch for watch in watches.values() if watch.health]
        if not running and config.rig is None:
            yield Finding(OK, "running system", "none")
        elif not running:
            yield _fault(nothing_runs(config.rig))
        for watch in running:
            yield from _system(watch)
        if running:
            yield from _open_ports()
    finally:
        for watch in watches.values():
            watch.close()


def _fault(text: str) -> Finding:
    found, _, advice = text.partition("; ")
    return Finding(ERROR, "running system", found, advice)


def certificates(zenoh: Path) -> Iterator[Finding]:
    """The certificates that a Zenoh configuration names.

    Raises:
        InputError: the file cannot be read.
    """
    tls = json.loads(load_config(zenoh).get_json("transport/link/tls"))
    paths = {Path(v) for k, v in tls.items() if k.endswith("certificate") and v is not None}
    if not paths:
        yield Finding(WARNING, "certificates", f"{zenoh.name} names none", "suturetrack keys init")
    for path in sorted(paths):
        yield _certificate(path)


def _certificate(path: Path) -> Finding:
    subject = f"certificate {path.name}"
    try:
        certificate = x509.load_pem_x509_certificate(path.read_bytes())
    except (OSError, ValueError) as error:
        return Finding(ERROR, subject, str(error), "make new ones: suturetrack keys init")
    left = certificate.not_valid_after_utc - datetime.datetime.now(datetime.UTC)
    text = f"{certificate.subject.rfc4514_string()}, {left.days} days left"
    if left.days < 0:
        return Finding(ERROR, subject, text, "make new ones: suturetrack keys init")
    if left.days < _EXPIRES_DAYS:
        return Finding(WARNING, subject, text, "make new ones soon: suturetrack keys init")
    return Finding(OK, subject, text)


def _versions() -> Iterator[Finding]:
    yield Finding(OK, "Python", sys.version.split()[0])
    for name in ("suturetrack", "eclipse-zenoh", "rerun-sdk", "numpy", "numba"):
        try:
            yield Finding(OK, name, metadata.version(name))
        except metadata.PackageNotFoundError:
            yield Finding(ERROR, name, "missing", "pip install -c constraints.txt .")


def _kernels() -> Finding:
    from suturetrack.camera import StereoRig
    from suturetrack.segmentation import Segmenter

    k = np.array([[400.0, 0, 159.5], [0, 400.0, 119.5], [0, 0, 1]])
    lens, apart = np.zeros(5), np.array([-40.0, 0, 0])
    rig = StereoRig.from_calibration((320, 240), (k, lens), (k, lens), np.eye(3), apart, 1e-3)
    began = time.monotonic()
    Segmenter(rig).warm_up()
    seconds = time.monotonic() - began
    if seconds > 5:
        advice = "they should be cached now; let the package's folder be writable if they are not"
        return Finding(WARNING, "kernels", f"compiled in {seconds:.1f} s", advice)
    return Finding(OK, "kernels", f"loaded in {seconds:.1f} s")


def _shared_memory() -> Finding:
    try:
        free_mb = shutil.disk_usage("/dev/shm").free / 1e6
    except OSError:
        return Finding(WARNING, "shared memory", "no /dev/shm", "images will be copied by sockets")
    if free_mb < _LEAST_SHARED_MB:
        advice = "images will be copied by sockets; in a container give --shm-size=512m"
        return Finding(WARNING, "shared memory", f"{free_mb:.0f} MB free", advice)
    return Finding(OK, "shared memory", f"{free_mb:.0f} MB free")


def _sockets() -> Finding:
    try:
        root = socket_root()
    except InputError as error:
        return Finding(ERROR, "sockets", str(error), "XDG_RUNTIME_DIR names another place")
    return Finding(OK, "sockets", f"in {root}, this user's alone")


def _disk(folder: Path) -> Finding:
    free_gb = shutil.disk_usage(folder).free / 1e9
    text = f"{free_gb:.0f} GB free here"
    if free_gb < _LEAST_DISK_GB:
        return Finding(WARNING, "disk", text, "a light recording takes 11 GB an hour")
    return Finding(OK, "disk", text)


def _system(watch: RigWatch) -> Iterator[Finding]:
    yield from _processes(watch)
    yield from _rates(watch)
    yield from _troubles(watch)
    yield from _clocks(watch)


def _processes(watch: RigWatch) -> Iterator[Finding]:
    subject = f"rig {watch.rig}"
    for name in watch.unheard:
        advice = f"start it: suturetrack {name} --rig {watch.rig}; if it runs, it hangs: kill it"
        yield Finding(ERROR, subject, f"no {name}", advice)
    if not watch.unheard:
        yield Finding(OK, subject, ", ".join(sorted(watch.health)))


def _rates(watch: RigWatch) -> Iterator[Finding]:
    if "source" not in watch.health:
        return
    wanted = watch.health["source"][0].rate_hz
    for name, (health, _) in sorted(watch.health.items()):
        if health.awaits:
            continue
        if name in ("segmenter", "tracker") and health.rate_hz < _SLOW * wanted:
            text = f"{health.rate_hz:.1f} Hz of {wanted:.1f} Hz"
            advice = "too slow for this rate: lower it, or give the process a core of its own"
            yield Finding(WARNING, f"{watch.rig}: {name}", text, advice)
        elif health.latency.p99_ms > _MESSAGES_LATE_MS:
            text = f"p99 latency {health.latency.p99_ms:.0f} ms"
            yield Finding(WARNING, f"{watch.rig}: {name}", text, "is another job on its core?")
        else:
            text = f"{health.rate_hz:.1f} Hz, p99 {health.latency.p99_ms:.0f} ms"
            yield Finding(OK, f"{watch.rig}: {name}", text)


def _troubles(watch: RigWatch) -> Iterator[Finding]:
    for name, (health, _) in sorted(watch.health.items()):
        subject = f"{watch.rig}: {name}"
        if health.awaits in PROCESSES:
            advice = f"it goes on by itself; if it does not, see the log of the {health.awaits}"
            if health.awaits in watch.unheard:
                advice = f"start the {health.awaits}, as above; this process then goes on by itself"
            yield Finding(WARNING, subject, health.warning, advice)
        elif health.warning:
            yield Finding(ERROR, subject, health.warning, "see its log")
        if health.refused:
            text = f"{health.refused} bad messages refused"
            yield Finding(WARNING, subject, text, "its log names the key; do all versions agree?")
        if health.frames and health.dropped > 0.05 * health.frames:
            text = f"{health.dropped} of {health.frames + health.dropped} frames passed over"
            yield Finding(WARNING, subject, text, "the machine is short of time")
        if health.restarts:
            yield Finding(WARNING, subject, f"started again {health.restarts}x", "see its log")


def _clocks(watch: RigWatch) -> Iterator[Finding]:
    """A heartbeat carries its sender's clock; between clocks that agree it takes a few ms."""
    for name, (health, arrived_ns) in sorted(watch.health.items()):
        ahead_s = (health.time_ns - arrived_ns) / 1e9
        if abs(ahead_s) > _SKEW_S:
            way = "ahead of" if ahead_s > 0 else "behind"
            text = f"its clock is {abs(ahead_s):.2f} s {way} this one"
            yield Finding(ERROR, f"{watch.rig}: {name}", text, "let chrony or ptp keep the hosts")


def _open_ports() -> Iterator[Finding]:
    for port in sorted(listening()):
        text = f"a process of suturetrack listens on {port}"
        yield Finding(WARNING, "network", text, "is that meant? only routers and consoles have to")


def listening() -> set[str]:
    """Addresses beyond this machine on which this user's processes of the dataflow listen."""
    found = set()
    for process in psutil.process_iter(["name", "uids"]):
        uids = process.info["uids"]
        if process.info["name"] not in _OURS or uids is None or uids.real != os.getuid():
            continue
        try:
            connections = process.net_connections("inet")
        except psutil.Error:
            continue
        for connection in connections:
            if connection.status == psutil.CONN_LISTEN:
                address, port = connection.laddr
                if not ipaddress.ip_address(address).is_loopback:
                    found.add(f"{address}:{port}")
    return found
