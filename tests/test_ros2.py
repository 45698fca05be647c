"""The ROS 2 bridge and the ROS 2 source over real Zenoh; what is sent is read by rosbags alone."""

from __future__ import annotations

import itertools
import socket
import struct
import threading
import time
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import zenoh
from rosbags.typesys import Stores, get_typestore
from scipy.spatial.transform import Rotation

from services import ros2, topics
from services.bus import Bus
from services.memory_transport import Hub
from services.messages import SeedReply
from services.ros2 import Ros2Config
from services.ros2_graph import TYPES, RosConfig, RosNode, new
from services.service import Service, ServiceConfig
from services.sources import InputConfig, open_input
from services.sources import ros2 as ros2_source
from services.sources.ros_image import CAMERA_INFO, IMAGE
from services.zenoh_session import configured
from suturetrack import nurbs
from suturetrack.types import Energies, InputError, Nurbs, Stamp, Status, ThreadState
from tests.conftest import wait_until
from tests.test_bags import LEFT, RIGHT, Ros
from tests.test_cameras import stall_of
from tests.test_sources import HEIGHT, WIDTH, picture, told

STORE = get_typestore(Stores.LATEST)
CURVE, MARKER = "/suturetrack/my_rig/thread_0/curve", "/suturetrack/my_rig/thread_0/marker"
GRASP, SEED = "/suturetrack/my_rig/thread_0/grasp", "/suturetrack/my_rig/thread_0/seed"
KINDS = {
    CURVE: "geometry_msgs/msg/PoseArray",
    MARKER: "visualization_msgs/msg/Marker",
    GRASP: "geometry_msgs/msg/PoseStamped",
    "/diagnostics": "diagnostic_msgs/msg/DiagnosticArray",
}


def session(mode: str, **endpoints: str) -> zenoh.Session:
    places = {f"{side}/endpoints": [endpoint] for side, endpoint in endpoints.items()}
    return zenoh.open(configured({"mode": mode, "scouting/multicast/enabled": False, **places}))


@pytest.fixture(scope="module")
def router() -> Iterator[str]:
    """What `rmw_zenohd` is to a ROS 2 graph."""
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        endpoint = f"tcp/127.0.0.1:{free.getsockname()[1]}"
    with session("router", listen=endpoint):
        yield endpoint


class Listener:
    """A plain Zenoh session that hears a domain."""

    def __init__(self, endpoint: str, domain: int):
        self.samples: dict[str, list[zenoh.Sample]] = {}
        self.session = session("client", connect=endpoint)
        self._subscriber = self.session.declare_subscriber(f"{domain}/**", self._take)
        self._domain = domain

    def _take(self, sample: zenoh.Sample) -> None:
        self.samples.setdefault(str(sample.key_expr), []).append(sample)

    def of(self, topic: str) -> list[zenoh.Sample]:
        found = [s for k, s in self.samples.items() if k.startswith(f"{self._domain}{topic}/")]
        assert len(found) <= 1
        return list(found[0]) if found else []

    def message(self, topic: str, kind: str) -> Any:
        """The last message of a topic, once there is one."""
        wait_until(lambda: self.of(topic))
        return STORE.deserialize_cdr(self.of(topic)[-1].payload.to_bytes(), kind)

    def tokens(self) -> list[str]:
        replies = self.session.liveliness().get(f"@ros2_lv/{self._domain}/**", timeout=2.0)
        return sorted(str(reply.ok.key_expr) for reply in replies if reply.ok is not None)


class Bridge:
    """The bridge process in a thread, with the tracker's end of its bus."""

    def __init__(self, router: str, domain: int, **options: Any):
        hub = Hub()
        shared = ServiceConfig(rig="my-rig")
        config = Ros2Config(shared, RosConfig(router, domain), **options)
        self.tracker = Bus(hub.connect(), "my-rig", "tracker")
        self.seeds = self.tracker.requests(topics.SEED)
        self.service = Service("ros2", shared, Bus(hub.connect(), "my-rig", "ros2"))
        self.failure: BaseException | None = None
        self._config = config
        self._thread = threading.Thread(target=self._run, daemon=True)
        self._thread.start()
        wait_until(lambda: self.failure or "ros2" in self.tracker.alive())

    def _run(self) -> None:
        try:
            with self.service:
                ros2.run(self.service, self._config)
        except BaseException as error:
            self.failure = error

    def close(self) -> None:
        self.service.bus.stop.set()
        self._thread.join(20)
        assert not self._thread.is_alive()
        assert self.failure is None


_domains = itertools.count(10)


@pytest.fixture
def bridge(router: str) -> Iterator[tuple[Bridge, Listener]]:
    domain = next(_domains)
    listener = Listener(router, domain)
    running = Bridge(router, domain)
    yield running, listener
    running.close()
    listener.session.close()


@pytest.fixture
def state(curve: Nurbs) -> ThreadState:
    """A thread in metres whose last third is not seen."""
    metres = replace(curve, control_points=curve.control_points / 1000)
    seen = np.arange(12) < 8
    stamp = Stamp(7, 1_700_000_000_123_456_789, time.time_ns(), 10_000_000_000)
    length = nurbs.length(metres)
    return ThreadState(
        stamp, "0", Status.TRACKING, metres, length, Energies(), np.full(12, 1e-4), seen
    )


# Published elsewhere: the first by rmw_zenoh's design document, the others by programs that speak to
# ROS 2 over rmw_zenoh or were generated from an installed ROS.
HASHES = {
    "std_msgs/msg/String": "df668c740482bbd48fb39d76a70dfd4bd59db1288021743503259e948f6b1a18",
    "geometry_msgs/msg/PoseArray": "af0cc36d190e104d546d168d6b39df04fa4b4ccecf59cb4c9ed328d3d5004aa0",
    "geometry_msgs/msg/PointStamped": "4c0296af86e01e562e9e0405d138a01537247580076c58ea38d7923ac1045897",
    "visualization_msgs/msg/Marker": "45b13ccf791f225962bf74e746f9644518855d783a6f42ba0cc14fde2b4f3ce0",
    "diagnostic_msgs/msg/DiagnosticArray": (
        "5a8a36efb05fb25070fa0fb3810290c0e6cd4862b54a8fb975a1ee8dc55a333e"
    ),
    "sensor_msgs/msg/Image": "d31d41a9a4c4bc8eae9be757b0beed306564f7526c88ea6a4588fb9582527d47",
}


@pytest.mark.parametrize("kind", HASHES)
def test_type_hashes_are_those_that_ros_has(kind: str) -> None:
    assert TYPES.hash_rihs01(kind) == f"RIHS01_{HASHES[kind]}"


def test_tokens_and_keys_are_those_of_rmw_zenoh(router: str) -> None:
    """Against the examples of its design document."""
    listener = Listener(router, 2)
    node = RosNode("talker", RosConfig(router, 2))
    chatter = node.publisher("/chatter", "std_msgs/msg/String")
    node.subscribe("/robot1/chatter", "std_msgs/msg/String", lambda _: None, lambda _: None)
    kind = f"std_msgs::msg::dds_::String_/RIHS01_{HASHES['std_msgs/msg/String']}"
    wait_until(lambda: len(listener.tokens()) == 3)
    tokens = listener.tokens()
    zid = tokens[0].split("/")[2]
    assert len(zid) in (31, 32)
    assert int(zid, 16) > 0
    assert tokens == sorted(
        [
            f"@ros2_lv/2/{zid}/0/0/NN/%/%/talker",
            f"@ros2_lv/2/{zid}/0/1/MP/%/%/talker/%chatter/{kind}/::,10:,:,:,,",
            f"@ros2_lv/2/{zid}/0/2/MS/%/%/talker/%robot1%chatter/{kind}/::,10:,:,:,,",
        ]
    )
    chatter.publish(new("std_msgs/msg/String", data="hello"))
    chatter.publish(new("std_msgs/msg/String", data="again"))
    wait_until(lambda: len(listener.of("/chatter")) == 2)
    samples = listener.of("/chatter")
    assert str(samples[0].key_expr) == f"2/chatter/{kind}"
    assert samples[0].payload.to_bytes() == b"\x00\x01\x00\x00\x06\x00\x00\x00hello\x00"
    numbers = []
    for sample in samples:
        assert sample.attachment is not None
        attachment = sample.attachment.to_bytes()
        assert len(attachment) == 33
        sequence, sent_ns, length, gid = struct.unpack("<qqB16s", attachment)
        numbers.append(sequence)
        assert abs(time.time_ns() - sent_ns) < 60e9
        assert length == 16
        assert any(gid)
    assert numbers == [1, 2]
    node.close()
    wait_until(lambda: not listener.tokens())
    listener.session.close()


def test_the_bridge_is_seen_in_the_graph(bridge: tuple[Bridge, Listener]) -> None:
    tokens = bridge[1].tokens()
    named = {token.split("/")[5]: 0 for token in tokens}
    assert set(named) == {"NN", "MP", "MS"}
    announced = {
        (parts[5], parts[9].replace("%", "/"))
        for parts in (token.split("/") for token in tokens)
        if len(parts) > 9
    }
    assert announced == {("MP", topic) for topic in KINDS} | {("MS", SEED)}


def test_a_state_becomes_messages_that_rosbags_reads(
    bridge: tuple[Bridge, Listener], state: ThreadState
) -> None:
    running, listener = bridge
    running.tracker.publish(topics.STATE, state)
    curve = listener.message(CURVE, KINDS[CURVE])
    stamp = curve.header.stamp
    assert (stamp.sec, stamp.nanosec) == (1_700_000_000, 123_456_789)
    assert curve.header.frame_id == "suturetrack"
    points = np.array([[p.position.x, p.position.y, p.position.z] for p in curve.poses])
    assert points.shape == (50, 3)
    assert state.curve is not None
    ends = nurbs.evaluate(state.curve, np.array([0.0, 1.0]))
    np.testing.assert_allclose(points[[0, -1]], ends, atol=1e-9)
    steps = np.linalg.norm(np.diff(points, axis=0), axis=1)
    assert steps.sum() == pytest.approx(state.length, rel=1e-2)
    assert np.ptp(steps) < 0.05 * steps.mean()
    q = np.array(
        [[p.orientation.x, p.orientation.y, p.orientation.z, p.orientation.w] for p in curve.poses]
    )
    frames = Rotation.from_quat(q).as_matrix()
    chords = np.diff(points, axis=0) / steps[:, None]
    assert np.einsum("ij,ij->i", frames[:-1, :, 2] + frames[1:, :, 2], chords).min() > 1.9
    assert (frames[:, 2, 0] > 0).all()

    marker = listener.message(MARKER, KINDS[MARKER])
    assert (marker.type, marker.action) == (4, 0)
    assert marker.scale.x == pytest.approx(0.001)
    assert marker.pose.orientation.w == 1
    drawn = np.array([[p.x, p.y, p.z] for p in marker.points])
    np.testing.assert_array_equal(drawn, points)
    green = [c.g > c.r for c in marker.colors]
    assert green[0]
    assert not green[-1]
    assert 0.6 < np.mean(green) < 0.75

    grasp = listener.message(GRASP, KINDS[GRASP])
    middle = np.array([grasp.pose.position.x, grasp.pose.position.y, grasp.pose.position.z])
    travelled = np.r_[0, np.cumsum(steps)]
    halfway = [np.interp(travelled[-1] / 2, travelled, points[:, i]) for i in range(3)]
    np.testing.assert_allclose(middle, halfway, atol=3e-4)

    (entry,) = listener.message("/diagnostics", KINDS["/diagnostics"]).status
    assert entry.level == 0
    assert entry.message == "tracking"
    values = {v.key: v.value for v in entry.values}
    assert float(values["length_mm"]) == pytest.approx(1000 * state.length, abs=0.01)


def test_a_lost_thread_is_shown_nowhere_and_silence_is_told(
    bridge: tuple[Bridge, Listener], state: ThreadState
) -> None:
    running, listener = bridge
    running.tracker.publish(topics.STATE, replace(state, status=Status.LOST))
    assert listener.message(CURVE, KINDS[CURVE]).poses == []
    assert listener.message(MARKER, KINDS[MARKER]).action == 2
    wait_until(lambda: listener.of("/diagnostics"))
    (entry,) = listener.message("/diagnostics", KINDS["/diagnostics"]).status
    assert (entry.level, entry.message) in ((2, "lost"), (3, "no states come"))
    assert not listener.of(GRASP)
    wait_until(lambda: listener.message("/diagnostics", KINDS["/diagnostics"]).status[0].level == 3)


@pytest.mark.parametrize("stale", [{"released_ns": 0}, {"period_ns": 0}])
def test_a_stale_state_gives_no_grasp(
    bridge: tuple[Bridge, Listener], state: ThreadState, stale: dict[str, int]
) -> None:
    running, listener = bridge
    running.tracker.publish(topics.STATE, replace(state, stamp=replace(state.stamp, **stale)))
    assert listener.message(CURVE, KINDS[CURVE]).poses
    running.tracker.publish(topics.STATE, replace(state, status=Status.LOST))
    wait_until(lambda: len(listener.of(CURVE)) == 2)
    assert not listener.of(GRASP)


def point(frame_id: str, *xyz: float) -> Any:
    place = dict(zip("xyz", xyz, strict=True))
    header = new("std_msgs/msg/Header", frame_id=frame_id)
    return new(
        "geometry_msgs/msg/PointStamped",
        header=header,
        point=new("geometry_msgs/msg/Point", **place),
    )


def said(listener: Listener) -> str:
    (entry,) = listener.message("/diagnostics", KINDS["/diagnostics"]).status
    return next(v.value for v in entry.values if v.key == "seed")


def test_seeds_of_ros_reach_the_tracker(bridge: tuple[Bridge, Listener], router: str) -> None:
    running, listener = bridge
    domain = int(next(iter(listener.tokens())).split("/")[1])
    node = RosNode("operator", RosConfig(router, domain))
    seeds = node.publisher(SEED, "geometry_msgs/msg/PointStamped")
    asked = []

    def answer() -> None:
        seeds.publish(point("suturetrack", 0.01, -0.02, 0.2))
        request = running.seeds.get(0.5)
        if request is not None:
            asked.append(request.question)
            request.answer(SeedReply(request.question.thread, True, "found 120.0 mm"))

    wait_until(lambda: (answer(), asked)[1])
    assert asked[0].thread == "0"
    assert asked[0].point == pytest.approx((0.01, -0.02, 0.2))
    wait_until(lambda: "found 120.0 mm" in said(listener))
    wait_until(lambda: (running.seeds.get(0.2)) is None)
    seeds.publish(point("base_link", 0, 0, 0.2))
    wait_until(
        lambda: "it is in frame 'base_link'; transform it to 'suturetrack'" in said(listener)
    )
    seeds.publish(point("", 0, float("nan"), 0.2))
    wait_until(lambda: "its coordinates are not finite" in said(listener))
    key = next(t for t in listener.tokens() if "/MS/" in t).split("/")
    listener.session.put(f"{domain}{SEED}/{key[10]}/{key[11]}", b"junk")
    wait_until(lambda: "Invalid or unsupported CDR" in said(listener))
    node.close()


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"threads": ()}, "name one at least"),
        ({"threads": ("a/b",)}, "use 1 to 64 of"),
        ({"samples": 1}, "samples 1: use 2 to"),
        ({"grasp_at": 1.5}, "use a part of the length"),
        ({"width_mm": 0.0}, "width-mm 0"),
        (
            {"ros": RosConfig("tcp/127.0.0.1:1")},
            "no ROS 2 graph at tcp/127.0.0.1:1; start its router",
        ),
        ({"ros": RosConfig("tcp/127.0.0.1:1", domain=-1)}, "use ROS_DOMAIN_ID"),
    ],
)
def test_a_bridge_that_cannot_be_is_refused(options: dict[str, Any], words: str) -> None:
    service = Service("ros2", ServiceConfig(), Bus(Hub().connect(), "rig", "ros2"))
    with pytest.raises(InputError, match=words) as caught, service:
        ros2.run(service, Ros2Config(**options))
    assert "\n" not in str(caught.value)


class Cameras:
    """A ROS node that publishes pairs of pictures stamped at 50 Hz until it is closed."""

    def __init__(
        self, config: RosConfig, *, late_ns: int = 0, encoding: str = "bgr8", info: bool = True
    ):
        self.node = RosNode("cameras", config)
        self.paused, self._stop = threading.Event(), threading.Event()
        ros = Ros(2)
        images = [self.node.publisher(topic, IMAGE) for topic in (LEFT, RIGHT)]
        infos = [
            self.node.publisher(topic.replace("image_raw", "camera_info"), CAMERA_INFO)
            for topic in (LEFT, RIGHT)
        ]

        def publish() -> None:
            for now in itertools.count(time.time_ns(), 20_000_000):
                if self._stop.wait(0.02):
                    return
                for side in (0, 1):
                    if self.paused.is_set():
                        continue
                    message = ros.image(now + side * late_ns, picture(2, side), encoding)
                    images[side].publish(message)
                    if info:
                        infos[side].publish(ros.info(bool(side)))

        self._thread = threading.Thread(target=publish, daemon=True)
        self._thread.start()

    def close(self) -> None:
        self._stop.set()
        self._thread.join(20)
        self.node.close()


@pytest.fixture
def quick(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(ros2_source, "_FIRST_S", 2.0)
    monkeypatch.setattr(ros2_source, "_INFO_S", 0.5)
    monkeypatch.setattr(ros2_source, "STALL_S", 0.2)


def test_image_topics_are_a_source_that_recovers_from_silence(router: str, quick: None) -> None:
    config = RosConfig(router, next(_domains))
    cameras = Cameras(config)
    footage, rig = open_input(InputConfig(f"ros2:{LEFT},{RIGHT}", ros=config))
    assert footage.live
    assert footage.size == (WIDTH, HEIGHT)
    assert footage.fps == pytest.approx(50)
    assert rig.baseline == pytest.approx(0.04)
    stamps = []
    for i in range(4):
        exposure = footage.read(i)
        assert exposure is not None
        assert (told(exposure.left), told(exposure.right)) == ((2, 0), (2, 1))
        stamps.append(exposure.capture_ns)
    assert np.diff(stamps).min() > 0
    cameras.paused.set()
    assert "no pair of images (they used to come) for " in stall_of(footage)
    cameras.paused.clear()
    assert footage.read(4) is not None
    footage.close()
    cameras.close()


@pytest.mark.parametrize(
    ("options", "words"),
    [
        (
            {"late_ns": 10**10},
            r"stamps are \d+\.\d ms apart, more than --slop-ms 10",
        ),
        ({"encoding": "mono16"}, "images are 'mono16'; convert them"),
        ({"info": False}, "nothing came on .*left/camera_info and .*; give --calibration FILE"),
    ],
)
def test_topics_that_are_no_source_are_refused(
    router: str, quick: None, options: dict[str, Any], words: str
) -> None:
    config = RosConfig(router, next(_domains))
    cameras = Cameras(config, **options)
    with pytest.raises(InputError, match=words):
        open_input(InputConfig(f"ros2:{LEFT},{RIGHT}", ros=config))
    cameras.close()


def test_no_topics_no_publisher_and_no_router_are_told(
    router: str, quick: None, tmp_path: Path
) -> None:
    config = RosConfig(router, next(_domains))
    with pytest.raises(InputError, match="give two image topics, ros2:/left/image,/right/image"):
        open_input(InputConfig("ros2:", ros=config))
    with pytest.raises(InputError, match="topic 'left': ROS topics are like"):
        open_input(InputConfig("ros2:left,right", ros=config))
    with pytest.raises(
        InputError, match="at most one of the two sides sends images; is somebody publishing"
    ):
        open_input(InputConfig(f"ros2:{LEFT},{RIGHT}", ros=config))
    with pytest.raises(InputError, match="no ROS 2 graph at tcp/"):
        open_input(InputConfig(f"ros2:{LEFT},{RIGHT}", ros=RosConfig("tcp/127.0.0.1:1")))
