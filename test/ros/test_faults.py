"""Faults of cameras over nodes and in recordings: stamps, order, losses, and what is said about them."""

from __future__ import annotations

import json
from collections import Counter
from pathlib import Path
from typing import Any

import pytest
from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import TransformStamped
from rclpy.serialization import deserialize_message
from render_scenes import renderer_or_skip
from ros_support import Client, Lockstep
from sensor_msgs.msg import CameraInfo, Image, PointCloud2
from std_msgs.msg import Float64MultiArray, String

from humansim_ros.data import messages
from humansim_ros.data.bags.reader import BagReader
from humansim_ros.data.engine import run
from humansim_ros.data.messages.topics import scene_topics
from humansim_ros.data.recording import SceneRecording
from humansim_ros.ros.graph.qos import LATCHED
from humansim_ros.ros.nodes.camera import CameraNode
from humansim_ros.ros.nodes.motion_player import MotionPlayerNode
from humansim_ros.ros.nodes.publishers import CameraDriver
from humansim_ros.ros.nodes.recorder import has_message_per_frame
from humansim_ros.ros.nodes.skinner import SkinnerNode
from humansim_ros.scene import Scene, Simulation
from humansim_ros.scene.core.faults import FrameFaults

FAULTS = """\
      drop: {probability: 0.2}
      freeze: {at: [[0.15, 0.3]]}
      late: {probability: 0.4, delay: [0.05, 0.1]}
      out_of_order: {probability: 0.2}
      duplicate: 0.3
      clock: {offset: 0.013, jitter: 0.001}
      seed: 4
"""
SCENE = f"""\
rate: 20
room: null
humans: {{anna: {{body: child, motion: walk}}}}
cameras:
  left:
    size: [64, 48]
    position: [3, 0.4, 1.4]
    look_at: [0, 0, 1]
    sensor: {{noise: {{}}}}
    faults:
{FAULTS}"""
COUNT = 12
PERIOD = 50_000_000


@pytest.fixture
def scene(tmp_path: Path) -> Path:
    renderer_or_skip().close()
    path = tmp_path / "scene.yaml"
    path.write_text(SCENE)
    return path


def expected(scene: Path) -> list[tuple[int, int, bytes]]:
    """Time of sending, stamp and pixels of each image of a simulation, in the order of sending."""
    sent = []
    with Simulation(Scene.load(scene), ("rgb",)) as simulation:
        for frame in simulation.frames(COUNT):
            faults = frame.faults["left"]
            pixels = frame.views["left"].rgb.tobytes()
            sent += [(frame.stamp + after, faults.stamp(frame.stamp), pixels) for after in faults.sent]
    return sorted(sent, key=lambda each: each[0])


@pytest.mark.nightly
def test_a_recording_has_the_faults_of_the_simulation_and_says_what_they_are(
    scene: Path, tmp_path: Path
) -> None:
    loaded = Scene.load(scene)
    plan = SceneRecording.of(loaded, COUNT, ["/left/image_raw", "/left/depth/image", "/left/faults/legend"])
    bag = tmp_path / "bag"
    run(plan, bag)
    found: dict[str, list[tuple[int, Any]]] = {}
    kinds = {"/left/image_raw": Image, "/left/depth/image": Image, "/left/faults": DiagnosticArray}
    with BagReader(bag) as reader:
        for topic, time, data, _ in reader.messages():
            name = reader.topics[topic].name
            message = deserialize_message(bytes(data), kinds.get(name, String))
            found.setdefault(name, []).append((time, message))
    images = [
        (time, messages.to_nanoseconds(image.header.stamp), bytes(image.data))
        for time, image in found["/left/image_raw"]
    ]
    assert images == expected(scene)
    true = [1 + PERIOD * index for index in range(COUNT)]
    for topic in ("/left/depth/image", "/left/faults"):  # the truth has no faults
        stamps = [(time, messages.to_nanoseconds(message.header.stamp)) for time, message in found[topic]]
        assert stamps == [(stamp, stamp) for stamp in true]
    schedule = loaded.scene_cameras["left"].faults
    assert schedule is not None
    told = [messages.read_faults(message) for _, message in found["/left/faults"]]
    assert told == [schedule.at(index).kinds for index in range(COUNT)]
    assert any("drop" in each for each in told) and any("duplicate" in each for each in told)
    ((_, legend),) = found["/left/faults/legend"]
    assert json.loads(legend.data)["clock"] == {"offset": 0.013, "drift_ppm": 0.0, "jitter": 0.001}


def test_nodes_send_the_images_of_the_simulation_in_its_order(ros: None, scene: Path) -> None:
    from rclpy.parameter import Parameter

    given = [Parameter("scene", value=str(scene))]
    kinds = (MotionPlayerNode, SkinnerNode, CameraNode)
    nodes = [kind(parameter_overrides=given, namespace="faulty") for kind in kinds]
    camera = nodes[2]
    camera.has_simulated_time = lambda: True  # time stands between frames, as in lockstep
    lockstep, client = Lockstep(nodes[0]), Client("client_of_faulty")
    for node in nodes:
        client.executor.add_node(node)
    received: dict[str, list[Any]] = {"image_raw": [], "camera_info": [], "faults/legend": []}
    for kind, topic, qos in (
        (Image, "image_raw", 100),
        (CameraInfo, "camera_info", 100),
        (String, "faults/legend", LATCHED),
    ):
        client.node.create_subscription(kind, f"/faulty/left/{topic}", received[topic].append, qos)
    client.subscribe(DiagnosticArray, ["/faulty/left/faults"])
    client.subscribe(Image, ["/faulty/left/depth/image"])
    client.spin_until_matched(*nodes)
    told, depth = (client.received[f"/faulty/left/{name}"] for name in ("faults", "depth/image"))
    stamps = []
    for _ in range(COUNT):
        stamps.append(lockstep.play())
        assert client.spin_until(lambda: stamps[-1] in told and stamps[-1] in depth)
    last = PERIOD * (COUNT - 1) + 2
    first = stamps[0] - 1  # stamps of the nodes are those of the wall clock
    due = [(stamp, pixels) for time, stamp, pixels in expected(scene) if time <= last]
    assert client.spin_until(lambda: len(received["image_raw"]) >= len(due))
    images = [
        (messages.to_nanoseconds(image.header.stamp) - first, bytes(image.data))
        for image in received["image_raw"]
    ]
    assert [stamp for stamp, _ in images] == [stamp for stamp, _ in due]
    assert [pixels for _, pixels in images] == [pixels for _, pixels in due]
    assert client.spin_until(lambda: len(received["camera_info"]) >= len(due))
    infos = [messages.to_nanoseconds(info.header.stamp) - first for info in received["camera_info"]]
    assert infos == [stamp for stamp, _ in due]
    assert sorted(depth) == stamps  # the truth loses nothing
    schedule = camera.scene.scene_cameras["left"].faults
    assert [messages.read_faults(told[stamp]) for stamp in stamps] == [
        schedule.at(index).kinds for index in range(COUNT)
    ]
    assert json.loads(received["faults/legend"][0].data)["seed"] == 4
    for node in nodes:
        node.close()
        node.destroy_node()
    client.close()


LIES = """\
rate: 20
room: null
humans: {anna: {body: child, motion: run}}
cameras:
  left:
    size: [64, 48]
    position: [3, 0.4, 1.4]
    look_at: [0, 0, 1]
    sensor: {rolling_shutter: 0.0002, samples: 2}
    distortion: [-0.2, 0.05]
    faults:
      seed: 3
      trigger_delay: {delay: 0.02, jitter: 0.005}
      calibration: {rotation: 1.5, translation: 0.04, focal: 0.05, drift: {rotation: 90, translation: 3}}
      flicker: {frequency: 93, depth: 0.4}
      exposure_steps: {probability: 0.5}
      dirt: {spots: 4, size: [0.1, 0.3]}
"""
#: What a tracker reads, and where the truth is.
LYING = {
    "extrinsics": TransformStamped,
    "projection": Float64MultiArray,
    "camera_info": CameraInfo,
    "image_raw": Image,
    "image_rect": Image,
    "depth/image": Image,
    "depth/camera_info": CameraInfo,
    "truth/extrinsics": TransformStamped,
    "joints": PointCloud2,
}
LATCHED_TOPICS = ("extrinsics", "projection", "truth/extrinsics")


def numbers(message: Any) -> Any:
    """What a message says, without its stamp."""
    if isinstance(message, CameraInfo):
        return [*message.k, *message.p, *message.d]
    if isinstance(message, TransformStamped):
        shift, turn = message.transform.translation, message.transform.rotation
        return [shift.x, shift.y, shift.z, turn.x, turn.y, turn.z, turn.w]
    return list(message.data) if isinstance(message, Float64MultiArray) else bytes(message.data)


@pytest.fixture
def lying(tmp_path: Path) -> Path:
    renderer_or_skip().close()
    path = tmp_path / "lies.yaml"
    path.write_text(LIES)
    return path


def told(scene: Path, count: int) -> dict[str, list[Any]]:
    """Numbers of the messages of each topic in a simulation."""
    loaded = Scene.load(scene)
    table = {topic.name: topic for topic in scene_topics(loaded)}
    found: dict[str, list[Any]] = {name: [] for name in LYING}
    with Simulation(loaded, ("rgb", "depth", "instance", "part")) as simulation:
        for frame in simulation.frames(count):
            for name in LYING:
                topic = table[f"left/{name}"]
                if topic.per_frame or frame.index == 0:
                    found[name].append(numbers(topic.message(frame)))
    return found


def test_a_recording_of_a_wrong_calibration_has_the_lies_and_the_truth(lying: Path, tmp_path: Path) -> None:
    loaded = Scene.load(lying)
    plan = SceneRecording.of(loaded, 3, [f"/left/{name}" for name in LYING if name != "truth/extrinsics"])
    run(plan, tmp_path / "bag")
    found: dict[str, list[Any]] = {name: [] for name in LYING}
    kinds: set[str] = set()
    with BagReader(tmp_path / "bag") as reader:
        for topic, _, data, _ in reader.messages():
            name = reader.topics[topic].name.removeprefix("/left/")
            if name in LYING:
                found[name].append(numbers(deserialize_message(bytes(data), LYING[name])))
            elif name == "faults":
                kinds |= messages.read_faults(deserialize_message(bytes(data), DiagnosticArray)).keys()
    assert found == told(lying, 3)
    assert kinds == {"trigger_delay", "calibration", "flicker", "exposure_steps", "dirt"}
    frames = [len(found[name]) for name in ("extrinsics", "truth/extrinsics")]
    assert frames == [1, 3]  # the camera drifts away from what is published
    assert found["extrinsics"][0] != found["truth/extrinsics"][0]
    assert found["camera_info"][0] != found["depth/camera_info"][0]


def test_nodes_lie_as_a_simulation_does_and_count_their_faults(ros: None, lying: Path) -> None:
    from rclpy.parameter import Parameter

    given = [Parameter("scene", value=str(lying))]
    nodes = [
        kind(parameter_overrides=given, namespace="lying")
        for kind in (MotionPlayerNode, SkinnerNode, CameraNode)
    ]
    lockstep, client = Lockstep(nodes[0]), Client("client_of_lying")
    for node in nodes:
        client.executor.add_node(node)
    received: dict[str, list[Any]] = {name: [] for name in LYING}
    for name, kind in LYING.items():
        listen = received[name].append
        qos = LATCHED if name in LATCHED_TOPICS else 100
        client.node.create_subscription(kind, f"/lying/left/{name}", listen, qos)
    counted: Counter[str] = Counter()

    def on_diagnostics(message: Any) -> None:
        for status in message.status:
            counted.update({each.key: int(each.value) for each in status.values if "fault_" in each.key})

    client.node.create_subscription(DiagnosticArray, "/diagnostics", on_diagnostics, 100)
    client.spin_until_matched(*nodes)
    for index in range(4):
        lockstep.play()
        assert client.spin_until(lambda index=index: len(received["depth/image"]) == index + 1)
    expected = told(lying, 4)
    per_frame = [name for name in LYING if name not in LATCHED_TOPICS]
    assert client.spin_until(lambda: all(len(received[name]) == 4 for name in per_frame))
    assert client.spin_until(lambda: len(received["truth/extrinsics"]) >= 4)
    sent = {name: [numbers(each) for each in received[name]] for name in LYING}
    sent["truth/extrinsics"] = sent["truth/extrinsics"][-4:]  # before them that of the start
    sent["extrinsics"], sent["projection"] = sent["extrinsics"][:1], sent["projection"][:1]
    assert sent == expected
    assert client.spin_until(lambda: len(counted) == 5 and min(counted.values()) == 4)
    assert counted.keys() == {
        "fault_trigger_delay", "fault_calibration", "fault_flicker", "fault_exposure_steps", "fault_dirt"
    }  # fmt: skip
    for node in nodes:
        node.close()
        node.destroy_node()
    client.close()


def test_the_player_in_lockstep_goes_on_after_frames_that_a_camera_loses(ros: None, scene: Path) -> None:
    from rclpy.parameter import Parameter

    scene.write_text(SCENE.replace(FAULTS, "      drop: 1\n"))
    count = 4
    lockstep = {"mode": "lockstep", "clock_search": 0.0, "frames": count}

    def made(kind: Any, name: str, **settings: Any) -> Any:
        given = {"scene": str(scene), **settings}
        return kind(
            parameter_overrides=[Parameter(key, value=value) for key, value in given.items()],
            namespace="losing",
            cli_args=["--ros-args", "-r", f"__node:={name}"],
        )

    player, skinner = made(MotionPlayerNode, "motion_player", **lockstep), made(SkinnerNode, "skinner")
    nodes = [player, skinner, made(CameraNode, "left")]
    client = Client("client_of_losing")
    for node in nodes:
        client.executor.add_node(node)
    client.subscribe(Image, ["/losing/left/image_raw", "/losing/left/depth/image"])
    client.subscribe(DiagnosticArray, ["/losing/left/faults"])
    assert client.spin_until(lambda: player.exit_code is not None)
    assert player.exit_code == 0
    assert client.spin_until(lambda: 1 + PERIOD * (count - 1) in client.received["/losing/left/faults"])
    assert not client.received["/losing/left/image_raw"]
    for node in nodes:
        node.close()
        node.destroy_node()
    client.close()


def test_a_recorder_in_lockstep_does_not_wait_for_images_that_may_be_lost(scene: Path) -> None:
    table = {topic.name: topic for topic in scene_topics(Scene.load(scene))}
    assert not has_message_per_frame(table["left/image_raw"])
    assert not has_message_per_frame(table["left/camera_info"])
    assert has_message_per_frame(table["left/depth/image"])
    assert has_message_per_frame(table["left/faults"])


class _Node:
    """Clock and timers of a node."""

    def __init__(self) -> None:
        self.time, self.timers = 0, []

    def now(self) -> int:
        return self.time

    def has_simulated_time(self) -> bool:
        return False

    def create_timer(self, seconds: float, callback: Any) -> Any:
        self.timers.append((self.time + round(seconds * 1e9), callback))
        return self.timers[-1]

    def destroy_timer(self, timer: Any) -> None:
        self.timers.remove(timer)

    def advance(self, time: int) -> None:
        while self.timers and min(self.timers)[0] <= time:
            self.time, callback = min(self.timers, key=lambda timer: timer[0])
            callback()
        self.time = time


class _Topic:
    faulty = True

    @staticmethod
    def build(content: str, stamp: int) -> tuple[str, int]:
        return content, stamp


class _Publisher:
    def __init__(self) -> None:
        self.sent: list[tuple[str, int]] = []
        self.awaited = 0

    def wait_for_all_acked(self, timeout: Any) -> None:
        self.awaited += 1

    def publish(self, message: tuple[str, int]) -> None:
        self.sent.append(message)


def send(driver: Any, publisher: Any, name: str, stamp: int, **faults: Any) -> None:
    with driver.frame(stamp, FrameFaults(**faults)):
        driver.send(_Topic(), publisher, name, stamp)


def test_in_real_time_a_late_image_is_sent_between_frames() -> None:
    node, publisher = _Node(), _Publisher()
    driver: Any = CameraDriver(node)  # type: ignore[arg-type]
    send(driver, publisher, "a", 100, sent=(20_000_000,), stamp_error=7)
    assert publisher.sent == []
    node.advance(19_000_000)
    assert publisher.sent == []
    node.advance(21_100_000)
    assert publisher.sent == [("a", 107)]
    assert not node.timers


def test_a_frame_that_comes_again_is_sent_again_and_its_held_messages_are_not_doubled() -> None:
    node, publisher = _Node(), _Publisher()
    node.has_simulated_time = lambda: True  # type: ignore[method-assign]
    driver: Any = CameraDriver(node)  # type: ignore[arg-type]
    for _ in range(2):
        send(driver, publisher, "a", 100, sent=(50,))
    send(driver, publisher, "b", 200)
    assert [name for name, _ in publisher.sent] == ["a", "b"]
    send(driver, publisher, "c", 300, sent=(1000,))
    send(driver, publisher, "d", 50)  # the clock was set back
    send(driver, publisher, "e", 2000)
    assert [name for name, _ in publisher.sent] == ["a", "b", "d", "e"]


def test_images_that_are_held_at_the_end_of_a_run_are_sent() -> None:
    node, publisher = _Node(), _Publisher()
    node.has_simulated_time = lambda: True  # type: ignore[method-assign]
    driver: Any = CameraDriver(node)  # type: ignore[arg-type]
    send(driver, publisher, "a", 100, sent=(10**9,))
    send(driver, publisher, "b", 200, sent=(50, 51), kinds={"duplicate": {}})
    driver.send_held()
    assert [name for name, _ in publisher.sent] == ["b", "b", "a"]
    assert publisher.awaited == 1
    driver.send_held()
    assert len(publisher.sent) == 3
