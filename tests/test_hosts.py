"""Three hosts, played by network namespaces: a camera's, a compute host with the router, a robot's."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path

import pytest

from suturetrack.stage import open_scene
from tests.conftest import wait_until

DEPLOY = Path(__file__).parents[1] / "services" / "deploy"
HOSTS = {"camera": "10.77.0.2", "compute": "10.77.0.3", "robot": "10.77.0.4"}
CONSUMER = """
import sys
from services.client import connect
from suturetrack.types import InputError
u, v = map(float, sys.argv[2:])
with connect(zenoh=sys.argv[1]) as client:
    while True:
        try:
            client.seed(pixel=(u, v))
            break
        except InputError:
            pass
    for seen in client.states():
        print(seen.state.stamp.frame, seen.state.status, seen.live, flush=True)
"""


def can_make_hosts() -> bool:
    if os.getuid() != 0 or not (shutil.which("ip") and shutil.which("tc")):
        return False
    probe = f"probe{os.getpid()}"
    made = subprocess.run(["ip", "netns", "add", probe], capture_output=True, check=False)
    subprocess.run(["ip", "netns", "del", probe], capture_output=True, check=False)
    return made.returncode == 0


pytestmark = [
    pytest.mark.long,
    pytest.mark.skipif(not can_make_hosts(), reason="needs root, iproute2 and network namespaces"),
]


@dataclass
class Consumer:
    """The states that the robot's host hears."""

    process: subprocess.Popen[str]
    heard: list[tuple[float, int, str, bool]] = field(default_factory=list)

    def __post_init__(self) -> None:
        self._thread = threading.Thread(target=self._read, daemon=True)
        self._thread.start()

    def _read(self) -> None:
        assert self.process.stdout is not None
        with self.process.stdout as lines:
            for line in lines:
                frame, status, live = line.split()
                self.heard.append((time.monotonic(), int(frame), status, live == "True"))

    def join(self) -> None:
        """Waits for the end of what the process says."""
        self._thread.join()

    def resumed_after(self, since: float) -> float:
        """Seconds until five live tracked states came after a moment."""
        wait_until(lambda: len(self._good(since)) >= 5, 30)
        return self._good(since)[0] - since

    def _good(self, since: float) -> list[float]:
        return [
            t for t, _, status, live in self.heard if t > since and live and status == "tracking"
        ]


class Network:
    """Namespaces on one bridge; `ip` and `tc` by host name."""

    def __init__(self) -> None:
        self.prefix = f"st{os.getpid()}"
        self.ip("netns", "add", self.ns("switch"))
        self.within("switch", "ip", "link", "add", "br0", "type", "bridge")
        self.within("switch", "ip", "link", "set", "br0", "up")
        for host, address in HOSTS.items():
            self.ip("netns", "add", self.ns(host))
            ends = ["ip", "link", "add", f"to-{host}", "type", "veth", "peer", "name", "eth0"]
            self.within("switch", *ends, "netns", self.ns(host))
            self.within("switch", "ip", "link", "set", f"to-{host}", "master", "br0", "up")
            self.within(host, "ip", "address", "add", f"{address}/24", "dev", "eth0")
            for device in ("lo", "eth0"):
                self.within(host, "ip", "link", "set", device, "up")

    def ns(self, host: str) -> str:
        return f"{self.prefix}-{host}"

    def ip(self, *words: str) -> None:
        subprocess.run(["ip", *words], check=True)

    def within(self, host: str, *words: str) -> None:
        self.ip("netns", "exec", self.ns(host), *words)

    def start(
        self, host: str, *words: object, out: int = subprocess.DEVNULL
    ) -> subprocess.Popen[str]:
        command = ["ip", "netns", "exec", self.ns(host), sys.executable, *map(str, words)]
        return subprocess.Popen(command, stdout=out, text=True)

    def disturb(self, host: str) -> str:
        """Delay and loss; by a link narrower than the frames need where the kernel has no netem."""
        add = ["tc", "qdisc", "add", "dev", "eth0", "root"]
        try:
            self.within(host, *add, "netem", "delay", "5ms", "2ms", "loss", "0.5%")
        except subprocess.CalledProcessError:
            self.within(host, *add, "tbf", "rate", "30mbit", "burst", "64kbit", "latency", "20ms")
            return "narrow link that drops"
        return "delay and loss"

    def cut(self, host: str) -> None:
        self.within("switch", "ip", "link", "set", f"to-{host}", "down")

    def mend(self, host: str) -> None:
        self.within("switch", "ip", "link", "set", f"to-{host}", "up")

    def close(self) -> None:
        for host in (*HOSTS, "switch"):
            subprocess.run(["ip", "netns", "del", self.ns(host)], check=False)


@pytest.fixture
def network() -> Iterator[Network]:
    network = Network()
    yield network
    network.close()


def test_states_cross_hosts_and_come_back_after_bad_links(network: Network, tmp_path: Path) -> None:
    """Frames from one host, segmenter and tracker on a second, a consumer on a third."""
    sock = tmp_path / "router.sock"
    for name in ("router", "compute", "host"):
        text = (DEPLOY / f"{name}.json5").read_text()
        text = text.replace("/run/suturetrack/router.sock", str(sock))
        text = text.replace("compute.local", HOSTS["compute"])
        (tmp_path / f"{name}.json5").write_text(text)
    host, compute = ["--zenoh", tmp_path / "host.json5"], ["--zenoh", tmp_path / "compute.json5"]
    cli = ("-m", "services.cli")
    scene = ["--source", "stage:figure8-107", "--fps", 10, "--picture.size", 320, 240]
    scene += ["--picture.noise", 1]
    seed = open_scene("figure8-107", fps=10).seed_pixel(0)
    running = [
        network.start("compute", *cli, "router", "--zenoh", tmp_path / "router.json5"),
        network.start("compute", *cli, "segmenter", *compute),
        network.start("compute", *cli, "tracker", *compute),
        network.start("camera", *cli, "source", *scene, *host),
        network.start(
            "robot",
            "-c",
            CONSUMER,
            tmp_path / "host.json5",
            seed[0] / 2,
            seed[1] / 2,
            out=subprocess.PIPE,
        ),
    ]
    consumer = Consumer(running[-1])
    took: dict[str, float] = {}
    try:
        wait_until(lambda: len(consumer.heard) > 5, 90)
        took["calm"] = consumer.resumed_after(time.monotonic())
        how = [network.disturb(name) for name in ("camera", "robot")]
        took[how[0]] = consumer.resumed_after(time.monotonic())
        for seconds in (1.0, 4.0):
            for cut in ("camera", "robot"):
                network.cut(cut)
                time.sleep(seconds)
                network.mend(cut)
                took[f"{cut} cut for {seconds:g} s"] = consumer.resumed_after(time.monotonic())
        assert [process.poll() for process in running] == [None] * len(running)
        print(json.dumps(took))
    finally:
        for process in running:
            process.terminate()
        for process in running:
            process.wait(20)
        consumer.join()
    assert max(took.values()) < 10
