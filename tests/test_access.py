"""Who may do what across machines: every role, key and verb, through a real router with mutual TLS."""

from __future__ import annotations

import json
import socket
import subprocess
import sys
from collections import defaultdict
from collections.abc import Iterator
from contextlib import closing
from pathlib import Path
from typing import Any

import pytest
import zenoh

from services import access, keys, topics
from services.access import ROLES
from services.bus import Bus
from services.client import Client, connect
from services.keys import Authority, KeysConfig
from services.service import ServiceConfig
from services.sources import InputConfig
from services.status import RigWatch
from services.topics import QUESTIONS, TOPICS, Question, Topic
from suturetrack.stage import open_scene
from suturetrack.types import InputError
from tests.conftest import wait_until
from tests.test_tiny import play

Wire = Topic[object] | Question[object, object]
WIRING = (*TOPICS, *QUESTIONS)
STREAMS = [topic for topic in TOPICS if topic is not topics.HEALTH]


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Keys for a router on this machine."""
    folder = tmp_path_factory.mktemp("domain") / "keys"
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port = probe.getsockname()[1]
    keys.init(KeysConfig("init", folder, router="127.0.0.1", port=port))
    return folder


@pytest.fixture(scope="module")
def sessions(folder: Path) -> Iterator[dict[str, zenoh.Session]]:
    """A session for each role, through the router."""
    zenoh.init_log_from_env_or("off")
    with zenoh.open(config(folder, "router")):
        opened = {role: zenoh.open(config(folder, f"rig-{role}")) for role in ROLES}
        yield opened
        for session in opened.values():
            session.close()  # type: ignore[no-untyped-call]


def config(folder: Path, name: str) -> zenoh.Config:
    return zenoh.Config.from_file(str(folder / f"{name}.json5"))


def key_of(wire: Wire, filling: str = "0") -> str:
    return f"suturetrack/rig/{topics.pattern_of(wire).replace('*', filling)}"


def test_only_the_publisher_publishes_and_only_readers_hear(
    sessions: dict[str, zenoh.Session],
) -> None:
    heard: defaultdict[tuple[str, str], set[str]] = defaultdict(set)

    def listen(reader: str, topic: Topic[object]) -> object:
        def arrived(sample: zenoh.Sample) -> None:
            heard[reader, topic.key].add(sample.payload.to_string())

        return sessions[reader].declare_subscriber(key_of(topic, "*"), arrived)

    kept = [listen(role, topic) for role in ROLES for topic in STREAMS]
    publishers = {t.key: {r.name for r in ROLES.values() if t in r.publishes} for t in STREAMS}
    assert all(len(roles) == 1 for roles in publishers.values())
    allowed = {
        (role.name, topic.key): publishers[topic.key] - {role.name}
        for role in ROLES.values()
        for topic in STREAMS
        if topic in (*role.reads, *role.keeps)
    }

    def say_everything() -> bool:
        for name, session in sessions.items():
            for topic in STREAMS:
                session.put(key_of(topic), name)
        return all(heard[cell] >= senders for cell, senders in allowed.items())

    wait_until(say_everything)
    # What a first round would leak has arrived when later rounds have.
    for _ in range(3):
        heard.clear()
        wait_until(say_everything)
    for role in ROLES:
        for topic in STREAMS:
            others = heard[role, topic.key] - {role}
            assert others == allowed.get((role, topic.key), set()), (role, topic.key)
    assert len(kept) == len(ROLES) * len(STREAMS)


def test_nobody_reports_the_health_of_another(sessions: dict[str, zenoh.Session]) -> None:
    heard: set[tuple[str, str]] = set()

    def arrived(sample: zenoh.Sample) -> None:
        heard.add((str(sample.key_expr).rsplit("/", 1)[1], sample.payload.to_string()))

    with sessions["viewer"].declare_subscriber(key_of(topics.HEALTH, "*"), arrived):
        processes = [process for role in ROLES.values() for process in role.processes]
        allowed = {(process, role.name) for role in ROLES.values() for process in role.processes}

        def say_everything() -> bool:
            for name, session in sessions.items():
                for process in processes if name != "viewer" else ():
                    session.put(key_of(topics.HEALTH, process), name)
            return heard >= allowed

        for _ in range(3):
            wait_until(say_everything)
            assert heard == allowed
            heard.clear()


def test_only_the_server_answers_and_only_those_who_may_ask_are_answered(
    sessions: dict[str, zenoh.Session],
) -> None:
    def serve(server: str, wire: Wire) -> object:
        def asked(query: zenoh.Query) -> None:
            with query:
                query.reply(key_of(wire), server)

        return sessions[server].declare_queryable(key_of(wire, "*"), asked)

    kept = [serve(role, wire) for role in ROLES for wire in WIRING]
    allowed = {
        (role.name, wire.key): {getattr(wire, "server", "") or getattr(wire, "keeper", "")}
        for role in ROLES.values()
        for wire in (*role.asks, *role.recalls)
    }

    def answers(asker: str, wire: Wire) -> set[str]:
        replies = sessions[asker].get(
            key_of(wire, "*" if isinstance(wire, Topic) else "0"),
            target=zenoh.QueryTarget.ALL,
            consolidation=zenoh.ConsolidationMode.NONE,
            timeout=2.0,
        )
        return {r.ok.payload.to_string() for r in replies if r.ok is not None} - {asker}

    for role in ROLES:
        for wire in WIRING:
            expected = allowed.get((role, wire.key), set()) - {role}
            wait_until(lambda e=expected, r=role, w=wire: answers(r, w) == e)  # type: ignore[misc]
    assert len(kept) == len(ROLES) * len(WIRING)


def test_nobody_is_seen_alive_under_the_name_of_another(
    sessions: dict[str, zenoh.Session],
) -> None:
    forged = sessions["operator"].liveliness().declare_token("suturetrack/rig/alive/tracker")
    true = sessions["source"].liveliness().declare_token("suturetrack/rig/alive/source")

    def alive() -> set[str]:
        replies = sessions["viewer"].liveliness().get("suturetrack/rig/alive/*", timeout=1.0)
        return {str(r.ok.key_expr).rsplit("/", 1)[1] for r in replies if r.ok is not None}

    wait_until(lambda: bool(alive()))
    assert alive() == {"source"}
    del forged, true


def test_strangers_are_kept_out(
    sessions: dict[str, zenoh.Session], folder: Path, tmp_path: Path
) -> None:
    assert sessions
    keys.init(KeysConfig("init", tmp_path / "other", router="127.0.0.1", port=port_of(folder)))
    assert not connects(tmp_path / "other" / "rig-operator.json5")
    plain = json.loads((folder / "rig-operator.json5").read_text())
    del plain["transport"], plain["access_control"]
    plain["connect"]["endpoints"] = [f"tcp/127.0.0.1:{port_of(folder)}"]
    assert not connects(written(tmp_path / "plain.json5", plain))
    assert connects(folder / "rig-operator.json5")


def test_an_unknown_name_of_the_same_authority_hears_nothing(tmp_path: Path) -> None:
    """The router's rules apply also where the client has none of its own."""
    domain = tmp_path / "keys"
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port = probe.getsockname()[1]
    keys.init(KeysConfig("init", domain, router="127.0.0.1", port=port, rigs=("rig", "other")))
    router = json.loads((domain / "router.json5").read_text())
    known = [s for s in router["access_control"]["subjects"] if s["id"] != "other-viewer"]
    policies = [
        p for p in router["access_control"]["policies"] if "other-viewer" not in p["subjects"]
    ]
    router["access_control"] |= {"subjects": known, "policies": policies}
    free = json.loads((domain / "other-viewer.json5").read_text())
    del free["access_control"]
    frame, state = key_of(topics.FRAME), key_of(topics.STATE, "*")
    heard: list[str] = []
    seen: list[str] = []
    with (
        zenoh.open(zenoh.Config.from_file(str(written(tmp_path / "router.json5", router)))),
        zenoh.open(zenoh.Config.from_file(str(written(tmp_path / "free.json5", free)))) as stranger,
        zenoh.open(config(domain, "rig-source")) as source,
        zenoh.open(config(domain, "rig-viewer")) as viewer,
        stranger.declare_subscriber(frame, lambda _: heard.append("the stranger")),
        viewer.declare_subscriber(frame, lambda s: seen.append(str(s.key_expr))),
        viewer.declare_subscriber(state, lambda s: seen.append(str(s.key_expr))),
    ):

        def say() -> bool:
            source.put(frame, "frame")
            stranger.put(state.replace("*", "0"), "forged")
            return len(seen) > 5

        wait_until(say)
    assert heard == []
    assert set(seen) == {frame}


def test_a_rig_runs_behind_the_router(tmp_path: Path) -> None:
    """Processes of every role over mutual TLS: a seed is accepted, a state and a grasp come back, and each
    process is seen at work."""
    domain = tmp_path / "keys"
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        keys.init(KeysConfig("init", domain, router="127.0.0.1", port=probe.getsockname()[1]))

    def start(verb: str, *options: str) -> subprocess.Popen[bytes]:
        name = "router" if verb == "router" else f"rig-{verb}"
        words = [sys.executable, "-m", "services.cli", verb, "--zenoh", f"{domain / name}.json5"]
        return subprocess.Popen([*words, *options], stderr=subprocess.DEVNULL)

    running = [
        start("tracker"),
        start("segmenter"),
        start("router"),
        start("source", "--source", "stage:figure8-107", "--fps", "5"),
    ]
    try:
        with connect(zenoh=domain / "rig-operator.json5") as client:
            # The kernels may have to be compiled first.
            wait_until(lambda: bool(seeded(client)), 180)
            wait_until(lambda: (seen := client.latest()) is not None and seen.live, 20)
            assert client.grasp(fraction=0.5).position[2] > 0.1
        with connect(zenoh=domain / "rig-viewer.json5") as viewer:
            wait_until(lambda: viewer.latest() is not None, 20)
            with pytest.raises(InputError):
                viewer.seed(pixel=(320, 240), timeout=1.0)
        with closing(RigWatch("rig", domain / "rig-viewer.json5")) as watch:
            wait_until(lambda: (watch.listen(), not watch.unheard)[1], 20)
    finally:
        for process in running:
            process.terminate()
        try:
            assert [process.wait(30) for process in running] == [0, 0, 0, 0]
        finally:
            for process in running:
                process.kill()
                process.wait()


def seeded(client: Client) -> bool:
    pixel = open_scene("figure8-107").seed_pixel(0)
    try:
        return client.seed(pixel=pixel, timeout=5.0).accepted
    except InputError:
        return False


def test_each_rule_is_needed_by_the_wiring() -> None:
    """Every topic has a publisher that may publish it and somebody who may read it."""
    for topic in STREAMS:
        assert any(topic in role.publishes for role in ROLES.values()), topic.key
        assert any(topic in role.reads for role in ROLES.values()), topic.key
        assert not topic.keeper or any(topic in role.keeps for role in ROLES.values())
    for question in QUESTIONS:
        assert [r.name for r in ROLES.values() if question in r.answers] == [question.server]
    assert {r.name for r in ROLES.values() if topics.SEED in r.asks} == {"operator", "bridge"}


def test_processes_recall_and_ask_no_more_and_no_less_than_they_may(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """When they are started again, which is when most is asked."""
    recalled, asked = defaultdict[str, set[object]](set), defaultdict[str, set[object]](set)
    last, ask = Bus.last, Bus.ask

    def spied_last(bus: Bus, topic: Any, *args: Any) -> Any:
        recalled[bus.process].add(topic)
        return last(bus, topic, *args)

    def spied_ask(bus: Bus, question: Any, *args: Any, **options: Any) -> Any:
        asked[bus.process].add(question)
        return ask(bus, question, *args, **options)

    monkeypatch.setattr(Bus, "last", spied_last)
    monkeypatch.setattr(Bus, "ask", spied_ask)
    seed = (open_scene("figure8-107").seed_pixel(0),)
    _, rig = play(
        seed, ServiceConfig(lockstep=True, resume=1), InputConfig("stage:figure8-107", frames=2)
    )
    assert not rig.errors
    for process in topics.PROCESSES:
        assert recalled[process] == set(ROLES[process].recalls)
        assert asked[process] == set(ROLES[process].asks)


def test_keys_are_for_this_user_alone_and_never_overwritten(folder: Path) -> None:
    assert (folder.stat().st_mode & 0o077) == 0
    assert all((file.stat().st_mode & 0o077) == 0 for file in folder.iterdir())
    with pytest.raises(InputError, match="it holds keys already"):
        keys.init(KeysConfig("init", folder))


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"rigs": ()}, "name one or more --rigs"),
        ({"rigs": ("a/b",)}, "rig"),
        ({"port": 0}, "port 0: use 1 to 65535"),
        ({"days": 0}, "days 0: use 1 to 3650"),
    ],
)
def test_impossible_keys_are_refused(
    tmp_path: Path, settings: dict[str, object], message: str
) -> None:
    with pytest.raises(InputError, match=message):
        keys.init(KeysConfig("init", tmp_path / "keys", **settings))  # type: ignore[arg-type]
    assert not (tmp_path / "keys").exists()


def test_certificates_name_the_role_and_the_host() -> None:
    authority = Authority(30)
    _, certificate = authority.issue("rig-source", "192.0.2.7")
    assert certificate.subject.rfc4514_string() == "CN=rig-source"
    assert (certificate.not_valid_after_utc - certificate.not_valid_before_utc).days == 31
    certificate.verify_directly_issued_by(authority.certificate)
    assert access.common_name("rig", "source") == "rig-source"


def port_of(folder: Path) -> int:
    endpoint = json.loads((folder / "router.json5").read_text())["listen"]["endpoints"][0]
    return int(endpoint.rsplit(":", 1)[1])


def written(path: Path, settings: object) -> Path:
    path.write_text(json.dumps(settings))
    return path


def connects(path: Path) -> bool:
    """Whether a client gets a link to the router."""
    settings = zenoh.Config.from_file(str(path))
    settings.insert_json5("connect/timeout_ms", "1500")
    settings.insert_json5("connect/exit_on_failure", "true")
    try:
        with zenoh.open(settings) as session:
            return bool(session.info.routers_zid())
    except zenoh.ZError:
        return False
