"""What `suturetrack doctor` and `suturetrack status` tell of an installation and of a running system."""

from __future__ import annotations

import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import closing
from dataclasses import replace
from pathlib import Path
from subprocess import PIPE

import numpy as np
import pytest

from services import topics
from services.bus import Bus
from services.doctor import (
    ERROR,
    OK,
    WARNING,
    DoctorConfig,
    Finding,
    certificates,
    examine,
    listening,
)
from services.keys import KeysConfig, init
from services.messages import Health, Latency
from services.status import StatusConfig, run, watch_rigs
from services.zenoh_transport import ZenohTransport, local_config, local_rigs
from suturetrack.types import Energies, InputError, Stamp, Status, ThreadState
from tests.test_deploy import DEPLOY

HEALTHY = Health(
    process="source",
    time_ns=0,
    stamp=Stamp(30, 1, 1),
    rate_hz=30.0,
    latency=Latency(1.0, 2.0, 3.0),
    run_rate_hz=30.0,
    run_latency=Latency(1.0, 2.0, 3.0),
    frames=30,
    dropped=0,
    refused=0,
    memory_mb=200.0,
)
WAITING = replace(HEALTHY, frames=0, rate_hz=0.0)


@pytest.fixture
def rig(rig_name: str) -> Iterator[Bus]:
    """A bus on which a running system is played."""
    bus = Bus(ZenohTransport(local_config(rig_name, "source")), rig_name, "source")
    yield bus
    bus.close()


def say(rig: Bus, *healths: Health) -> None:
    """Publishes heartbeats as soon as somebody listens."""

    def speak() -> None:
        if rig.wait_for_readers(topics.HEALTH, 20):
            for health in healths:
                shift = health.time_ns
                rig.publish(topics.HEALTH, replace(health, time_ns=time.time_ns() + shift))

    threading.Thread(target=speak, daemon=True).start()


def findings(rig: Bus, *healths: Health) -> dict[str, list[tuple[str, str]]]:
    say(rig, *healths)
    found: dict[str, list[tuple[str, str]]] = {}
    for finding in examine(DoctorConfig(rig.rig)):
        found.setdefault(finding.subject, []).append((finding.level, finding.text))
    return found


def test_a_healthy_system_has_nothing_to_mend(rig: Bus) -> None:
    names = ("source", "segmenter", "tracker")
    found = findings(rig, *(replace(HEALTHY, process=name) for name in names))
    assert found[f"rig {rig.rig}"] == [(OK, "segmenter, source, tracker")]
    assert found[f"{rig.rig}: tracker"] == [(OK, "30.0 Hz, p99 2 ms")]
    assert [f for f in found.values() for level, _ in f if level == ERROR] == []


def test_troubles_of_a_running_system_are_named(rig: Bus) -> None:
    slow = replace(HEALTHY, process="tracker", rate_hz=11.0, dropped=40, refused=3, restarts=2)
    ahead = replace(HEALTHY, time_ns=3_000_000_000, warning="the disk is full")
    found = findings(rig, ahead, slow)
    assert found[f"rig {rig.rig}"] == [(ERROR, "no segmenter")]
    assert found[f"{rig.rig}: tracker"] == [
        (WARNING, "11.0 Hz of 30.0 Hz"),
        (WARNING, "3 bad messages refused"),
        (WARNING, "40 of 70 frames passed over"),
        (WARNING, "started again 2x"),
    ]
    (level, text), *rest = [f for f in found[f"{rig.rig}: source"] if f[0] == ERROR]
    assert (level, text) == (ERROR, "the disk is full")
    assert any(
        t.startswith("its clock is 3.0") and t.endswith("ahead of this one") for _, t in rest
    )


def test_a_process_that_waits_for_another_is_no_trouble_of_its_own(rig: Bus) -> None:
    alone = replace(WAITING, process="tracker", warning="waits for the source", awaits="source")
    found = _advice(rig, "tracker", alone)
    assert (found.level, found.text) == (WARNING, "waits for the source")
    assert found.advice == "start the source, as above; this process then goes on by itself"


def test_a_process_that_waits_for_one_that_runs_goes_on_by_itself(rig: Bus) -> None:
    unready = replace(
        WAITING, process="segmenter", warning="waits for the tracker", awaits="tracker"
    )
    found = _advice(rig, "segmenter", WAITING, unready, replace(WAITING, process="tracker"))
    assert (found.level, found.text) == (WARNING, "waits for the tracker")
    assert found.advice == "it goes on by itself; if it does not, see the log of the tracker"


def _advice(rig: Bus, process: str, *healths: Health) -> Finding:
    """What the doctor finds last about one process; once a bus, for an earlier reader goes late."""
    say(rig, *healths)
    return {f.subject: f for f in examine(DoctorConfig(rig.rig))}[f"{rig.rig}: {process}"]


def test_certificates_near_their_end_are_named(tmp_path: Path) -> None:
    for days, level in ((1, WARNING), (365, OK)):
        folder = tmp_path / str(days)
        init(KeysConfig("init", folder, days=days))
        found = list(certificates(folder / "rig-tracker.json5"))
        assert {f.level for f in found if "tracker" in f.subject} == {level}
    (folder / "rig-tracker.pem").write_text("nonsense")
    levels = {f.subject: f.level for f in certificates(folder / "rig-tracker.json5")}
    assert levels["certificate rig-tracker.pem"] == ERROR
    with pytest.raises(InputError, match="no file"):
        list(certificates(tmp_path / "none.json5"))


def test_a_configuration_with_comments_is_read() -> None:
    (found,) = certificates(DEPLOY / "host.json5")
    assert (found.level, found.text) == (WARNING, "host.json5 names none")


def test_a_rig_may_have_the_doctors_name(rig_name: str) -> None:
    bus = Bus(ZenohTransport(local_config("doctor", "source")), "doctor", "source")
    levels = {f.subject: f.level for f in examine(DoctorConfig("doctor"))}
    assert levels["sockets"] == OK
    bus.close()


@pytest.mark.parametrize(
    ("name", "text", "advice"),
    [
        ("nobody", "no process of rig 'nobody' runs", "name a rig that is here: test"),
        ("a/b", "rig 'a/b': use 1 to 64 of A-Z a-z 0-9 _ -", ""),
        ("", "rig '': use 1 to 64 of A-Z a-z 0-9 _ -", ""),
    ],
)
def test_a_rig_that_was_named_has_to_run(rig: Bus, name: str, text: str, advice: str) -> None:
    del rig  # it is here, and not the one that was named
    found = list(examine(DoctorConfig(name)))[-1]
    assert (found.level, found.text) == (ERROR, text)
    assert found.advice.endswith(advice)


def test_what_others_can_reach_is_told_once_for_all_rigs(
    rig: Bus, monkeypatch: pytest.MonkeyPatch
) -> None:
    with closing(Bus(ZenohTransport(local_config("other", "source")), "other", "source")) as other:
        monkeypatch.setattr("services.doctor.listening", lambda: {"0.0.0.0:7447"})
        say(rig, HEALTHY)
        say(other, HEALTHY)
        subjects = [finding.subject for finding in examine(DoctorConfig())]
    assert {f"{rig.rig}: source", "other: source"} < set(subjects)
    assert subjects.count("network") == 1


def test_status_shows_processes_and_threads(rig: Bus, capsys: pytest.CaptureFixture[str]) -> None:
    none = np.ones(4)
    now = time.time_ns()
    state = ThreadState(
        Stamp(7, now, now), "a", Status.LOST, None, float("nan"), Energies(), none, none > 0
    )
    say(rig, replace(HEALTHY, warning="cable loose"))
    watches = watch_rigs(rig.rig, None, 1.0)
    assert rig.wait_for_readers(topics.STATE, 10)
    rig.publish(topics.STATE, state)
    watch = watches[rig.rig]
    deadline = time.monotonic() + 10
    while not (watch.threads and watch.health) and time.monotonic() < deadline:
        watch.listen()
    watch.close()
    assert watch.health["source"][0].warning == "cable loose"
    assert watch.threads["a"].state.status is Status.LOST
    assert watch.unheard == ["segmenter", "tracker"]
    assert [table.row_count for table in watch.tables()] == [3, 1]
    assert rig.rig in local_rigs()
    rig.close()
    with pytest.raises(InputError, match=r"no process of rig 'nobody' runs; start some"):
        run(StatusConfig("nobody", once=True))
    with pytest.raises(InputError, match="--zenoh needs --rig"):
        run(StatusConfig(zenoh=Path("x")))
    assert capsys.readouterr().out == ""


def test_status_cuts_nothing_where_there_is_no_terminal(
    rig: Bus, capsys: pytest.CaptureFixture[str]
) -> None:
    trouble = 3 * "the left image is all but black; is the lens covered? "
    say(rig, replace(HEALTHY, process=64 * "p", warning=trouble))
    run(StatusConfig(rig.rig, once=True))
    out = capsys.readouterr().out
    assert 64 * "p" in out
    assert trouble in out


def test_a_process_that_others_can_reach_is_named() -> None:
    code = (
        "import socket, sys; open('/proc/self/comm', 'w').write('tracker');"
        "s = socket.create_server((sys.argv[1], 0)); print(s.getsockname()[1], flush=True);"
        "sys.stdin.read()"
    )
    ports = {}
    for address in ("127.0.0.1", "0.0.0.0"):
        words = [sys.executable, "-c", code, address]
        server = subprocess.Popen(words, stdin=PIPE, stdout=PIPE, text=True)
        assert server.stdout is not None
        ports[address] = server.stdout.readline().strip()
        assert (f"0.0.0.0:{ports[address]}" in listening()) == (address == "0.0.0.0")
        server.communicate()
    assert f"127.0.0.1:{ports['127.0.0.1']}" not in listening()
