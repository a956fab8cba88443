"""``humansim play``: subscribers get the messages of a bag with their bytes, in their order, in time."""

from __future__ import annotations

import subprocess
import sys
import threading
import warnings
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

import pytest
from conftest import ROOT
from ros_support import rclpy
from waiting import PATIENCE, wait_until

from humansim_ros.data.bags.metadata import Storage
from humansim_ros.data.bags.topics import BagMessage, BagTopic, Qos
from humansim_ros.data.bags.writer import BagWriter
from humansim_ros.errors import HumansimError, HumansimWarning

START = 1_000_000_000
MILLISECOND = 1_000_000
HEADER, STRING = "std_msgs/msg/Header", "std_msgs/msg/String"
TOPICS = (
    BagTopic("/played/data", HEADER, (Qos(depth=5),)),
    BagTopic("/played/legend", STRING, (Qos(transient_local=True, depth=1),)),
)


def data_of(number: int) -> bytes:
    from rclpy.serialization import serialize_message
    from std_msgs.msg import Header

    message = Header(frame_id=f"message {number}")
    message.stamp.sec = number
    return bytes(serialize_message(message))


def legend(text: str) -> bytes:
    from rclpy.serialization import serialize_message
    from std_msgs.msg import String

    return bytes(serialize_message(String(data=text)))


def write_bag(
    folder: Path,
    messages: Sequence[BagMessage],
    topics: Sequence[BagTopic] = TOPICS,
    storage: Storage = "mcap",
) -> Path:
    with BagWriter(folder, topics, storage=storage) as writer:
        for message in messages:
            writer.write([message])
            writer.flush()  # a chunk for each message, so that a part of the file has some of them
    return folder


def headers(count: int, step: int = MILLISECOND) -> list[BagMessage]:
    return [BagMessage(0, START + number * step, data_of(number)) for number in range(count)]


class Listener:
    """Receives topics in an executor of its own thread."""

    def __init__(self, *topics: str, latched: bool = False) -> None:
        from rclpy.executors import SingleThreadedExecutor
        from rclpy.qos import QoSDurabilityPolicy, QoSProfile
        from rosgraph_msgs.msg import Clock
        from std_msgs.msg import Header, String

        self.node = rclpy.create_node("listener")
        self.received: list[tuple[str, bytes]] = []
        self.clock: list[int] = []
        profile = QoSProfile(depth=20_000)
        if latched:
            profile.durability = QoSDurabilityPolicy.TRANSIENT_LOCAL
        kinds = {"/played/legend": String}
        for topic in topics:
            self.node.create_subscription(
                kinds.get(topic, Header), topic, self._callback(topic), profile, raw=True
            )
        self.node.create_subscription(
            Clock, "/clock", lambda m: self.clock.append(m.clock.sec * 10**9 + m.clock.nanosec), 1000
        )
        self.executor = SingleThreadedExecutor()
        self.executor.add_node(self.node)
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._spin, daemon=True)
        self._thread.start()

    def _callback(self, topic: str) -> Callable[[bytes], None]:
        return lambda data: self.received.append((topic, bytes(data)))

    def _spin(self) -> None:
        while not self._stop.is_set():
            self.executor.spin_once(timeout_sec=0.02)

    def close(self) -> None:
        self._stop.set()
        self._thread.join(PATIENCE)
        self.node.destroy_node()


@pytest.fixture
def listen(ros: None) -> Iterator[Callable[..., Listener]]:
    started: list[Listener] = []

    def start(*topics: str, latched: bool = False) -> Listener:
        started.append(Listener(*topics, latched=latched))
        return started[-1]

    yield start
    for each in started:
        each.close()


def play(folder: Path, key: Callable[[], str] = lambda: "", **options: Any) -> int:
    """Play a bag; returns the number of messages."""
    from humansim_ros.ros.processes import PlayOptions
    from humansim_ros.ros.tools.bag_player import BagPlayer

    player = BagPlayer(folder, PlayOptions(**options))
    try:
        player.play(key)
    finally:
        player.close()
    return player.played


@pytest.mark.parametrize("storage", ["mcap", "sqlite3"])
def test_a_subscriber_gets_the_same_bytes_in_the_same_order(
    listen: Callable[..., Listener], tmp_path: Path, storage: Storage
) -> None:
    messages = headers(500)
    listener = listen("/played/data")
    assert play(write_bag(tmp_path / "bag", messages, storage=storage)) == 500
    assert wait_until(lambda: len(listener.received) == 500)
    assert listener.received == [("/played/data", bytes(message.data)) for message in messages]


@pytest.mark.slow
def test_messages_that_follow_each_other_at_once_all_arrive(
    listen: Callable[..., Listener], tmp_path: Path
) -> None:
    messages = headers(1500)
    listener = listen("/played/data")
    play(write_bag(tmp_path / "bag", messages), rate=1000.0)
    assert wait_until(lambda: len(listener.received) == 1500)
    assert [data for _, data in listener.received] == [message.data for message in messages]


def test_latched_topics_come_first_and_late_subscribers_get_them(
    listen: Callable[..., Listener], tmp_path: Path
) -> None:
    messages = headers(50, 40 * MILLISECOND)
    first = BagMessage(1, messages[30].stamp, legend("first"))
    last = BagMessage(1, messages[-1].stamp, legend("second"))
    bag = write_bag(tmp_path / "bag", [*messages[:30], first, *messages[30:], last])
    listener = listen("/played/data", "/played/legend")
    late: list[Listener] = []

    def key() -> str:
        if len(listener.received) > 10 and not late:
            late.append(listen("/played/legend", latched=True))
        return ""

    assert play(bag, key) == 52
    assert wait_until(lambda: len(listener.received) == 52)
    assert ("/played/legend", legend("first")) in listener.received[:2]
    assert listener.received[-1] == ("/played/legend", legend("second"))
    assert late[0].received[0] == ("/played/legend", legend("first"))


def test_the_clock_follows_the_bag_and_never_goes_back(
    listen: Callable[..., Listener], tmp_path: Path
) -> None:
    messages = headers(100, 5 * MILLISECOND)
    listener = listen("/played/data")
    play(write_bag(tmp_path / "bag", messages), clock=100.0)
    assert wait_until(lambda: listener.clock and listener.clock[-1] == messages[-1].stamp)
    assert listener.clock == sorted(set(listener.clock))
    assert listener.clock[0] >= START


def test_a_pause_stops_time_until_the_next_key(listen: Callable[..., Listener], tmp_path: Path) -> None:
    listener = listen("/played/data")
    paused_at: list[int] = []
    calls = 0

    def key() -> str:
        nonlocal calls
        calls += 1
        if not paused_at and len(listener.received) >= 5:
            paused_at.append(len(listener.received))
            calls = 0
            return " "
        if paused_at and calls == 30:
            paused_at.append(len(listener.received))
            return " "
        return ""

    play(write_bag(tmp_path / "bag", headers(30, 30 * MILLISECOND)), key)
    assert wait_until(lambda: len(listener.received) == 30)
    assert paused_at[1] <= paused_at[0] + 1


def test_pace_maps_monotonic_time_to_recorded_time() -> None:
    from humansim_ros.ros.tools.bag_player import Pace

    pace = Pace(1000, 2.0, 10.0)
    assert pace.recorded(11.0) == 1000 + 2 * 10**9
    assert pace.seconds_until(1000 + 4 * 10**9, 11.0) == 1.0
    pace.toggle_pause(11.0)
    assert pace.recorded(50.0) == 1000 + 2 * 10**9
    assert pace.seconds_until(0, 50.0) == float("inf")
    pace.toggle_pause(60.0)
    assert pace.seconds_until(1000 + 4 * 10**9, 60.0) == 1.0


def test_a_start_offset_and_topics_choose_messages(listen: Callable[..., Listener], tmp_path: Path) -> None:
    listener = listen("/played/data", "/played/legend")
    bag = write_bag(tmp_path / "bag", [BagMessage(1, START, legend("first")), *headers(100)])
    assert play(bag, start_offset=0.09, topics=["/played/da*"]) == 10
    assert wait_until(lambda: len(listener.received) == 10)
    assert listener.received[0] == ("/played/data", data_of(90))
    assert play(bag, start_offset=0.09, topics=["/played/legend"]) == 1  # as a late subscriber would get it


def test_a_loop_begins_again(listen: Callable[..., Listener], tmp_path: Path) -> None:
    listener = listen("/played/data")

    class Enough(Exception):
        pass

    def key() -> str:
        if len(listener.received) >= 25:
            raise Enough
        return ""

    with pytest.raises(Enough):
        play(write_bag(tmp_path / "bag", headers(10)), key, loop=True)
    assert [data for _, data in listener.received[:25]] == [data_of(number % 10) for number in range(25)]


@pytest.mark.parametrize("history", ["unfinished", "cut"])
def test_what_is_whole_of_an_interrupted_bag_is_played(
    listen: Callable[..., Listener], tmp_path: Path, history: str
) -> None:
    listener = listen("/played/data")
    bag = write_bag(tmp_path / "bag", headers(50))
    file = bag / "bag_0.mcap"
    whole = file.read_bytes()
    file.write_bytes(whole[: -8 if history == "unfinished" else len(whole) // 2])
    with pytest.warns(HumansimWarning, match="not finished, or was cut"):
        played = play(bag)
    assert played == 50 if history == "unfinished" else 5 < played < 50
    assert wait_until(lambda: len(listener.received) == played)
    assert [data for _, data in listener.received] == [data_of(number) for number in range(played)]


@pytest.mark.parametrize("storage", ["mcap", "sqlite3"])
def test_a_bag_of_rosbags_is_played(listen: Callable[..., Listener], tmp_path: Path, storage: str) -> None:
    from rosbags.rosbag2 import StoragePlugin, Writer
    from rosbags.typesys import Stores, get_typestore

    plugin = StoragePlugin.MCAP if storage == "mcap" else StoragePlugin.SQLITE3
    store = get_typestore(Stores.ROS2_JAZZY)
    with Writer(tmp_path / "bag", version=9, storage_plugin=plugin) as writer:
        connection = writer.add_connection("/played/data", HEADER, typestore=store)
        for number in range(20):
            writer.write(connection, START + number * MILLISECOND, data_of(number))
    listener = listen("/played/data")
    assert play(tmp_path / "bag") == 20
    assert wait_until(lambda: len(listener.received) == 20)


def test_types_that_are_not_installed_are_skipped(listen: Callable[..., Listener], tmp_path: Path) -> None:
    foreign = BagTopic("/played/foreign", "foreign_msgs/msg/Thing")
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        bag = write_bag(
            tmp_path / "bag",
            [*headers(5), BagMessage(2, START + 10 * MILLISECOND, b"\0\1\0\0rest")],
            (*TOPICS, foreign),
        )
    with pytest.warns(
        HumansimWarning, match="/played/foreign is not played: the message package foreign_msgs"
    ):
        assert play(bag) == 5


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"topics": ["/played/dat"]}, "has no topic /played/dat; did you mean '/played/data'"),
        ({"topics": ["/other/*"]}, "has no topic /other"),
        ({"start_offset": 5.0}, "the bag lasts 0.009 s"),
    ],
)
def test_options_that_leave_nothing_are_errors(
    ros: None, tmp_path: Path, options: dict[str, Any], words: str
) -> None:
    with pytest.raises(HumansimError, match=words):
        play(write_bag(tmp_path / "bag", headers(10)), **options)


def test_a_bag_without_messages_is_an_error(ros: None, tmp_path: Path) -> None:
    with pytest.raises(HumansimError, match="the bag has no messages"):
        play(write_bag(tmp_path / "bag", []))


@pytest.mark.parametrize("content", ["nothing", "folder"])
def test_a_path_without_a_bag_is_an_error(ros: None, tmp_path: Path, content: str) -> None:
    path = tmp_path / "bag"
    if content == "folder":
        path.mkdir()
    with pytest.raises(HumansimError, match=f"^{path}: "):
        play(path)


def test_a_path_without_a_bag_is_one_line_and_exit_code_2(tmp_path: Path) -> None:
    path = tmp_path / "bag"
    path.write_text("no bag")
    command = [sys.executable, "-m", "humansim_ros", "play", str(path)]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, timeout=PATIENCE, check=False)
    assert done.returncode == 2
    assert done.stderr.startswith(f"error: {path}: ") and done.stderr.count("\n") == 1


def test_a_second_clock_is_an_error(ros: None, tmp_path: Path) -> None:
    from rosgraph_msgs.msg import Clock

    bag = write_bag(tmp_path / "bag", headers(10))
    node = rclpy.create_node("other_player")
    publisher = node.create_publisher(Clock, "/clock", 10)
    stop = threading.Event()

    def publish() -> None:
        while not stop.wait(0.05):
            publisher.publish(Clock())

    thread = threading.Thread(target=publish)
    thread.start()
    try:
        with pytest.raises(HumansimError, match="another node publishes /clock: /other_player"):
            play(bag, clock=10.0)
        assert play(bag) == 10
    finally:
        stop.set()
        thread.join(PATIENCE)
        node.destroy_node()


@pytest.mark.parametrize(
    ("given", "joined"),
    [
        ("play bag --clock", "play bag --clock 100"),
        ("play --clock bag", "play --clock 100 bag"),
        ("play --clock 50 bag", "play --clock 50 bag"),
        ("play --clock --loop bag", "play --clock 100 --loop bag"),
    ],
)
def test_the_rate_of_the_clock_may_be_left_out(given: str, joined: str) -> None:
    from humansim_ros.cli.options import join_numbers

    assert join_numbers(given.split()) == joined.split()


def test_a_camera_renders_a_played_bag_as_it_renders_the_live_topics(ros: None, tmp_path: Path) -> None:
    from rclpy.parameter import Parameter
    from rclpy.serialization import serialize_message
    from ros_support import Client, write_scene
    from sensor_msgs.msg import Image

    from humansim_ros import Scene, Simulation
    from humansim_ros.data.messages.headers import scene_time_message
    from humansim_ros.data.messages.humans import joints_message, vertices_message
    from humansim_ros.ros.nodes.camera import CameraNode
    from humansim_ros.ros.processes import PlayOptions
    from humansim_ros.ros.tools.bag_player import BagPlayer

    scene = Scene.load(write_scene(tmp_path))
    with Simulation(scene, channels=("rgb",)) as simulation:
        frame = simulation.frame(3)
        expected = frame.views["left"].rgb
    topics = [BagTopic("/scene_time", "sensor_msgs/msg/TimeReference")]
    topics += [BagTopic(f"/humans/{name}/vertices", "sensor_msgs/msg/PointCloud2") for name in scene.actors]
    topics += [
        BagTopic(f"/humans/{name}/joints", "sensor_msgs/msg/MultiDOFJointState") for name in scene.actors
    ]
    content = [scene_time_message(frame.scene_time, frame.stamp)]
    content += [vertices_message(body.vertices, frame.stamp) for body in frame.humans.values()]
    content += [joints_message(body, frame.stamp) for body in frame.humans.values()]
    messages = [
        BagMessage(number, frame.stamp, bytes(serialize_message(message)))
        for number, message in enumerate(content)
    ]
    bag = write_bag(tmp_path / "bag", messages, topics)
    overrides = [Parameter("camera", value="left"), Parameter("start_scene", value=False)]
    camera = CameraNode(scene=scene, parameter_overrides=overrides)
    client = Client("viewer")
    client.subscribe(Image, ["/left/image_raw"])
    client.executor.add_node(camera)
    player = BagPlayer(bag, PlayOptions())
    try:
        publishers = list(player._all())
        assert client.spin_until(lambda: all(each.get_subscription_count() for each in publishers))
        assert client.spin_until(lambda: camera.count_subscribers("/left/image_raw"))
        thread = threading.Thread(target=player.play)
        thread.start()
        assert client.spin_until(lambda: client.received["/left/image_raw"])
        thread.join(PATIENCE)
    finally:
        player.close()
        camera.close()
        camera.destroy_node()
        client.close()
    (image,) = client.received["/left/image_raw"].values()
    assert bytes(image.data) == expected.tobytes()
