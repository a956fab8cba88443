"""The recorder node: all messages that are published are in the bag, with their bytes, type and QoS."""

from __future__ import annotations

import errno
import os
import resource
import signal
import subprocess
import sys
import threading
import time
from array import array
from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any

import pytest
from conftest import ROOT
from mcap.reader import NonSeekingReader
from rclpy.exceptions import InvalidHandle
from ros_support import rclpy, write_scene
from rosbags.rosbag2 import Reader
from waiting import PATIENCE, wait_until

from humansim_ros.data.bags.reader import BagReader
from humansim_ros.errors import HumansimWarning

NODE = [sys.executable, "-m", "humansim_ros.ros.nodes"]


class Recording:
    """A recorder in this process, and a node that publishes."""

    def __init__(self, folder: Path, **parameters: Any) -> None:
        from rclpy.parameter import Parameter

        from humansim_ros.ros.nodes.recorder import RecorderNode
        from humansim_ros.ros.processes.runtime import make_executor

        self.folder = folder
        parameters = {"output": str(folder), "topics": ["/sent/*"], **parameters}
        self.sender = rclpy.create_node("sender")
        self.node = RecorderNode(
            parameter_overrides=[
                Parameter(name, value=value) for name, value in parameters.items() if value is not None
            ]
        )
        self.executor = make_executor()
        self.executor.add_node(self.node)

    def publisher(self, kind: Any, topic: str, qos: Any = 1000) -> Any:
        """A publisher that the recorder has found."""
        publisher = self.sender.create_publisher(kind, topic, qos)
        assert self.spin_until(publisher.get_subscription_count), topic
        return publisher

    def spin_until(self, done: Callable[[], object], limit: float = PATIENCE) -> bool:
        return wait_until(done, limit, self._spin_once)

    def _spin_once(self) -> None:
        # rclpy fails at an event of a subscription that has been replaced; runtime.spin goes on, too
        with suppress(InvalidHandle):
            self.executor.spin_once(0.02)

    @property
    def received(self) -> int:
        """Number of messages that were put into the bag or its queue, without those that were counted and
        forgotten for the diagnostics.
        """
        return int(self.node.received)

    def finish(self) -> None:
        self.node.complete()

    def close(self) -> None:
        self.node.close()
        self.node.destroy_node()
        self.sender.destroy_node()


@pytest.fixture
def recording(ros: None, tmp_path: Path) -> Iterator[Callable[..., Recording]]:
    """Starts recorders, and ends them."""
    started: list[Recording] = []

    def start(folder: Path = tmp_path / "bag", **parameters: Any) -> Recording:
        started.append(Recording(folder, **parameters))
        return started[-1]

    yield start
    for each in started:
        each.close()


def content(folder: Path, topic: str = "") -> list[tuple[str, bytes]]:
    """Topics and messages of a bag in the order of their log times, by rosbags."""
    with Reader(folder) as reader:
        return [(c.topic, bytes(data)) for c, _, data in reader.messages() if topic in ("", c.topic)]


def by_mcap(folder: Path) -> list[tuple[str, bytes]]:
    found = []
    for path in sorted(folder.glob("*.mcap"), key=lambda path: int(path.stem.rpartition("_")[2])):
        with path.open("rb") as file:
            messages = NonSeekingReader(file, validate_crcs=True).iter_messages()
            found += [(channel.topic, message.data) for _, channel, message in messages]
    return found


def header(number: int, text: str = "") -> Any:
    from std_msgs.msg import Header

    message = Header(frame_id=text or str(number))
    message.stamp.sec, message.stamp.nanosec = divmod(number, 10**9)
    return message


def serialised(messages: Sequence[Any]) -> list[bytes]:
    from rclpy.serialization import serialize_message

    return [serialize_message(message) for message in messages]


# Nothing is lost


@pytest.mark.slow
@pytest.mark.parametrize("storage", ["mcap", "sqlite3"])
def test_ten_thousand_messages_in_are_ten_thousand_out(
    recording: Callable[..., Recording], storage: str
) -> None:
    from std_msgs.msg import Header

    recorder = recording(storage=storage)
    publisher = recorder.publisher(Header, "/sent/a")
    sent = [header(number) for number in range(10_000)]
    for number, message in enumerate(sent, 1):
        publisher.publish(message)
        if number % 100 == 0:  # as many as the queues of reliable topics hold
            assert recorder.spin_until(lambda number=number: recorder.received == number)
    recorder.finish()
    expected = [("/sent/a", data) for data in serialised(sent)]
    assert content(recorder.folder) == expected
    if storage == "mcap":
        assert by_mcap(recorder.folder) == expected


@pytest.mark.slow
@pytest.mark.parametrize("compression", ["none", "zstd"])
@pytest.mark.parametrize("count", [200, pytest.param(1000, marks=pytest.mark.nightly)])
def test_all_of_many_images_are_in_the_bag(
    recording: Callable[..., Recording], compression: str, count: int
) -> None:
    from sensor_msgs.msg import Image

    recorder = recording(compression=compression, max_queue=1 << 31)
    publisher = recorder.publisher(Image, "/sent/image_raw", 5)
    for number in range(count):
        image = Image(height=480, width=640, encoding="rgb8", step=1920)
        image.header = header(number)
        image.data = array("B", number.to_bytes(4, "little") * (640 * 480 * 3 // 4))
        publisher.publish(image)
        assert recorder.spin_until(lambda number=number: recorder.received == number + 1)
    recorder.finish()
    numbers = []
    for _, data in content(recorder.folder):
        pixels = data[-640 * 480 * 3 :]
        assert pixels == pixels[:4] * (640 * 480 * 3 // 4)
        numbers.append(int.from_bytes(pixels[:4], "little"))
    assert numbers == list(range(count))


def test_a_message_of_a_hundred_megabytes_is_recorded(recording: Callable[..., Recording]) -> None:
    from std_msgs.msg import UInt8MultiArray

    recorder = recording(max_queue=1 << 20)  # it is longer than the queue
    publisher = recorder.publisher(UInt8MultiArray, "/sent/large")
    message = UInt8MultiArray(data=array("B", bytes(range(250)) * 400_000))
    publisher.publish(message)
    assert recorder.spin_until(lambda: recorder.received == 1)
    recorder.finish()
    assert [data for _, data in content(recorder.folder)] == serialised([message])


# Topics and quality of service


def qos(reliable: bool, latched: bool) -> Any:
    from rclpy.qos import QoSDurabilityPolicy, QoSProfile, QoSReliabilityPolicy

    return QoSProfile(
        depth=10,
        reliability=QoSReliabilityPolicy.RELIABLE if reliable else QoSReliabilityPolicy.BEST_EFFORT,
        durability=QoSDurabilityPolicy.TRANSIENT_LOCAL if latched else QoSDurabilityPolicy.VOLATILE,
    )


@pytest.mark.parametrize("reliable", [True, False])
@pytest.mark.parametrize("latched", [True, False])
def test_quality_of_service_follows_the_publisher(
    recording: Callable[..., Recording], reliable: bool, latched: bool
) -> None:
    from std_msgs.msg import Header

    recorder = recording()
    publisher = recorder.sender.create_publisher(Header, "/sent/a", qos(reliable, latched))
    publisher.publish(header(1, "before the recorder"))
    assert recorder.spin_until(publisher.get_subscription_count)
    publisher.publish(header(2, "after it"))
    assert recorder.spin_until(lambda: recorder.received == 1 + (latched and reliable))
    recorder.finish()
    with Reader(recorder.folder) as reader:
        (connection,) = reader.connections
        (profile,) = connection.ext.offered_qos_profiles
        assert (profile.reliability.value == 1, profile.durability.value == 1) == (reliable, latched)
        assert connection.digest.startswith("RIHS01_")
        assert "string frame_id" in connection.msgdef.data


def test_a_publisher_that_offers_less_is_recorded_too(recording: Callable[..., Recording]) -> None:
    from std_msgs.msg import Header

    recorder = recording()
    recorder.publisher(Header, "/sent/a", qos(reliable=True, latched=True))
    later = recorder.publisher(Header, "/sent/a", qos(reliable=False, latched=False))
    later.publish(header(1))
    assert recorder.spin_until(lambda: recorder.received == 1)


def test_topics_that_appear_later_are_recorded(recording: Callable[..., Recording]) -> None:
    from std_msgs.msg import Header, String

    recorder = recording()
    first = recorder.publisher(Header, "/sent/first")
    first.publish(header(1))
    assert recorder.spin_until(lambda: recorder.received == 1)
    second = recorder.publisher(String, "/sent/second")
    second.publish(String(data="late"))
    assert recorder.spin_until(lambda: recorder.received == 2)
    recorder.finish()
    assert [topic for topic, _ in content(recorder.folder)] == ["/sent/first", "/sent/second"]


def test_all_topics_are_recorded_but_hidden_ones_and_those_of_every_node(
    recording: Callable[..., Recording],
) -> None:
    from std_msgs.msg import Header

    recorder = recording(topics=None)
    recorder.sender.create_publisher(Header, "/sent/_hidden", 10)
    publisher = recorder.publisher(Header, "/sent/a")
    publisher.publish(header(1))
    assert recorder.spin_until(lambda: recorder.received)
    recorder.finish()
    with Reader(recorder.folder) as reader:
        topics = {connection.topic for connection in reader.connections}
    assert "/sent/a" in topics
    assert not topics & {"/sent/_hidden", "/rosout", "/parameter_events"}


def test_names_are_relative_to_the_namespace_and_patterns_mean_no_hidden_topics() -> None:
    from humansim_ros.ros.graph.graph import TopicChoice

    choice = TopicChoice.of(["left/image_raw", "/right/*", "/_camera_alive"], "/lab")
    for topic in ("/lab/left/image_raw", "/right/a/b", "/_camera_alive"):
        assert choice.has(topic)
    for topic in ("/left/image_raw", "/right/_a", "/rosout", "/other"):
        assert not choice.has(topic)
    assert choice.unmatched(["/right/a", "/left/image_raw"]) == ["/lab/left/image_raw", "/_camera_alive"]


@pytest.mark.parametrize("name", ["", "/", "two words", "a\nb"])
def test_a_name_that_is_no_topic_is_an_error(name: str) -> None:
    from humansim_ros.errors import RosError
    from humansim_ros.ros.graph.graph import TopicChoice

    with pytest.raises(RosError, match="is no topic"):
        TopicChoice.of([name])


# Frames of lockstep


def test_copies_that_a_faulty_camera_sends_are_kept_and_those_of_a_frame_that_comes_again_are_not() -> None:
    from humansim_ros.data.messages.recorded_frames import RecordedFrames
    from humansim_ros.ros.nodes.recorder import ImageCopies
    from humansim_ros.scene.config.camera_config import FaultsConfig
    from humansim_ros.scene.core.faults import FaultSchedule

    config = FaultsConfig.model_validate({"duplicate": 0.5, "clock": 0.25})
    schedule, rate = FaultSchedule(config, "left", 10.0), 10
    copies = ImageCopies({"/left/image_raw": schedule})
    frames = RecordedFrames([], [], copies)
    expected = [len(schedule.at(index).sent) for index in range(20)]
    assert set(expected) == {1, 2}
    for index, count in enumerate(expected):
        stamp = 1 + index * 10**9 // rate
        copies.note(stamp, stamp - 1)
        sent = [frames.add("/left/image_raw", schedule.at(index).stamp(stamp), b"image") for _ in range(4)]
        assert sum(sent) == count
        assert sum(frames.add("/left/other", stamp, b"image") for _ in range(2)) == 1


# A slow or full disk


class SlowBag:
    """Bag whose messages are written when the test says so."""

    def __init__(self, error: Exception | None = None) -> None:
        self.topics: tuple[Any, ...] = ()
        self.go = threading.Event()
        self.error = error
        self.written: list[Any] = []
        self.flushed = 0
        self.closed = False

    def write(self, messages: Sequence[Any]) -> None:
        assert self.go.wait(PATIENCE)
        if self.error:
            raise self.error
        self.written += messages

    def flush(self) -> None:
        self.flushed = len(self.written)

    def close(self) -> None:
        self.closed = True


def message(size: int, stamp: int = 1) -> Any:
    from humansim_ros.data.bags.topics import BagMessage

    return BagMessage(0, stamp, bytes(size))


def test_a_full_queue_drops_in_real_time_and_waits_in_lockstep() -> None:
    from humansim_ros.data.bags.bag_thread import BagThread

    bag: Any = SlowBag()
    thread = BagThread(lambda: bag, 1000)
    assert thread.add(message(900))
    assert not thread.add(message(200))
    assert thread.add(message(100))
    waiting = threading.Thread(target=thread.add, args=(message(500), True))
    waiting.start()
    bag.go.set()
    waiting.join(PATIENCE)
    assert not waiting.is_alive()
    thread.close()
    assert (thread.written, thread.written_bytes, bag.closed) == (3, 1500, True)


def test_a_message_that_is_longer_than_the_queue_is_taken() -> None:
    from humansim_ros.data.bags.bag_thread import BagThread

    bag: Any = SlowBag()
    bag.go.set()
    thread = BagThread(lambda: bag, 10)
    assert thread.add(message(1000))
    thread.close()
    assert thread.written == 1


def test_a_frame_is_reported_when_it_is_in_the_file() -> None:
    from humansim_ros.data.bags.bag_thread import BagThread

    bag: Any = SlowBag()
    reports: list[tuple[int, int]] = []
    thread = BagThread(lambda: bag, 1 << 30, on_written=lambda s: reports.append((s, bag.flushed)))
    for stamp in (1, 2):
        for _ in range(3):
            thread.add(message(100, stamp))
        thread.end_frame(stamp)
    assert reports == []
    bag.go.set()
    thread.close()
    assert reports == [(1, 3), (2, 6)]
    assert [each.stamp for each in bag.written] == [1, 1, 1, 2, 2, 2]


def test_few_messages_are_in_the_file_after_half_a_second() -> None:
    from humansim_ros.data.bags.bag_thread import BagThread

    bag: Any = SlowBag()
    bag.go.set()
    thread = BagThread(lambda: bag, 1000)
    thread.add(message(10))
    assert wait_until(lambda: bag.flushed == 1)
    thread.close()


@pytest.mark.parametrize("error", [OSError(errno.ENOSPC, "No space left on device"), MemoryError()])
def test_an_error_of_the_bag_ends_the_thread_and_frees_who_waits(error: Exception) -> None:
    from humansim_ros.data.bags.bag_thread import BagThread

    bag: Any = SlowBag(error)
    thread = BagThread(lambda: bag, 100)
    assert thread.add(message(100))
    waiting = threading.Thread(target=thread.add, args=(message(100), True))
    waiting.start()
    bag.go.set()
    waiting.join(PATIENCE)
    assert not waiting.is_alive()
    assert not thread.add(message(1))
    thread.close()
    assert "the bag cannot be written" in str(thread.error)
    assert bag.closed


# Wrong input


@pytest.mark.parametrize(
    ("parameters", "words"),
    [
        ({"output": ""}, "name the folder of the bag"),
        ({"output": "/proc/bag"}, "cannot be written"),
        ({"storage": "mcpa"}, "did you mean 'mcap'"),
        ({"compression": "gzip"}, "no value 'gzip'; there are none, zstd, lz4"),
        ({"storage": "sqlite3", "compression": "zstd"}, "sqlite3"),
        ({"max_bag_size": -1}, "max_bag_size"),
        ({"topics": ["a b"]}, "'a b' is no topic"),
    ],
)
def test_wrong_parameters_are_errors(
    recording: Callable[..., Recording], parameters: dict[str, Any], words: str
) -> None:
    from humansim_ros.errors import HumansimError

    with pytest.raises(HumansimError, match=words):
        recording(**parameters)


@pytest.mark.parametrize("name", ["file", "folder"])
def test_a_path_that_exists_is_an_error(
    recording: Callable[..., Recording], tmp_path: Path, name: str
) -> None:
    from humansim_ros.errors import HumansimError

    (tmp_path / "file").write_text("mine")
    (tmp_path / "folder").mkdir()
    with pytest.raises(HumansimError, match="exists; choose another name"):
        recording(tmp_path / name)
    assert (tmp_path / "file").read_text() == "mine"


@pytest.mark.parametrize(
    ("name", "words"),
    [
        ("os/msg/System", "message package os is not installed"),
        ("this/msg/Zen", "message package this is not installed"),
        ("sensor_msgs/msg/Imagee", "no message Imagee"),
        ("sensor_msgs/srv/SetCameraInfo", "no name of a message type"),
        ("../../etc/passwd", "no name of a message type"),
        ("a" * 10_000 + "/msg/A", "no name of a message type"),
        ("sensor_msgs/msg/__doc__", "no name of a message type"),
    ],
)
def test_names_of_types_run_no_code(ros: None, name: str, words: str) -> None:
    from humansim_ros.data.messages.types import message_type
    from humansim_ros.errors import RosError

    with pytest.raises(RosError, match=words):
        message_type(name)
    assert "this" not in sys.modules


def logged(recorder: Recording, monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """Warnings of a recorder from now on."""
    lines: list[str] = []
    monkeypatch.setattr(
        type(recorder.node.get_logger()), "warn", lambda self, text, **_: lines.append(text) or True
    )
    return lines


def pretend(recorder: Recording, monkeypatch: pytest.MonkeyPatch, graph: list[tuple[str, list[str]]]) -> None:
    """Let a recorder see another graph, whose topics all have a publisher."""
    monkeypatch.setattr(recorder.node, "get_topic_names_and_types", lambda: graph)
    monkeypatch.setattr(recorder.node, "publisher_count", lambda _: 1)


@pytest.mark.parametrize(
    ("topic", "types", "words"),
    [
        ("/sent/a", ["foreign_msgs/msg/Thing"], "message package foreign_msgs is not installed"),
        ("/sent/a", ["os/msg/System"], "message package os is not installed"),
        ("/sent/a", ["std_msgs/msg/String", "std_msgs/msg/Header"], "disagree about its type"),
        ("/sent/\u00fc", ["std_msgs/msg/String"], "not an absolute topic name"),
        ("/sent/a\nb", ["std_msgs/msg/String"], "not an absolute topic name"),
        ("/sent/" + "a" * 5000, ["foreign_msgs/msg/A"], "characters"),
    ],
)
def test_a_topic_that_cannot_be_recorded_is_named_once(
    recording: Callable[..., Recording],
    monkeypatch: pytest.MonkeyPatch,
    topic: str,
    types: list[str],
    words: str,
) -> None:
    from std_msgs.msg import Header

    recorder = recording()
    lines = logged(recorder, monkeypatch)
    with monkeypatch.context() as patch:
        pretend(recorder, patch, [(topic, types)])
        patch.setattr(recorder.node, "get_publishers_info_by_topic", lambda _: [])
        for _ in range(3):
            recorder.node._discover()
    assert len(lines) == 1
    assert words in lines[0]
    assert lines[0].isprintable() and len(lines[0]) < 500
    publisher = recorder.publisher(Header, "/sent/good")
    publisher.publish(header(1))
    assert recorder.spin_until(lambda: recorder.received == 1)


def test_ten_thousand_topics_that_appear_do_not_stop_the_recorder(
    recording: Callable[..., Recording], monkeypatch: pytest.MonkeyPatch
) -> None:
    from std_msgs.msg import Header

    from humansim_ros.ros.nodes import recorder as module

    monkeypatch.setattr(module, "_MAX_TOPICS", 60)
    recorder = recording()
    publisher = recorder.publisher(Header, "/sent/good")
    lines = logged(recorder, monkeypatch)
    graph = [(f"/sent/t{number}", ["std_msgs/msg/Header"]) for number in range(10_000)]
    real = recorder.node.get_topic_names_and_types
    monkeypatch.setattr(recorder.node, "get_topic_names_and_types", lambda: [*real(), *graph])
    monkeypatch.setattr(recorder.node, "get_publishers_info_by_topic", lambda _: [])
    monkeypatch.setattr(recorder.node, "publisher_count", lambda _: 1)
    for number in range(100):
        publisher.publish(header(number))
        recorder.node._discover()
    assert recorder.spin_until(lambda: recorder.received == 100)
    assert len(recorder.node._recorded) == 60
    assert any("60 others already" in line for line in lines)
    assert all(len(line) < 1000 for line in lines)
    recorder.finish()
    assert len(content(recorder.folder, "/sent/good")) == 100


def test_names_that_match_nothing_are_reported_with_a_similar_name(
    recording: Callable[..., Recording], monkeypatch: pytest.MonkeyPatch
) -> None:
    from std_msgs.msg import Header

    from humansim_ros.ros.nodes import recorder as module

    monkeypatch.setattr(module, "_REPORT_AFTER", 0.0)
    recorder = recording(topics=["/sent/image_raww", "/sent/image_raw"])
    lines = logged(recorder, monkeypatch)
    recorder.publisher(Header, "/sent/image_raw")
    text = (
        "nothing publishes /sent/image_raww: it is recorded when it appears; did you mean '/sent/image_raw'?"
    )
    assert recorder.spin_until(lambda: text in lines)


def test_log_times_go_on_when_the_clock_is_set_back(
    recording: Callable[..., Recording], monkeypatch: pytest.MonkeyPatch
) -> None:
    from std_msgs.msg import Header

    recorder = recording()
    publisher = recorder.publisher(Header, "/sent/a")
    for number in range(10):
        if number == 5:
            monkeypatch.setattr(recorder.node, "now", lambda: time.time_ns() - 3600 * 10**9)
        publisher.publish(header(number))
        assert recorder.spin_until(lambda number=number: recorder.received == number + 1)
    recorder.finish()
    with Reader(recorder.folder) as reader:
        times = [stamp for _, stamp, _ in reader.messages()]
        assert times == sorted(times)
        assert times[-1] - times[0] < 600 * 10**9
    assert [data for _, data in content(recorder.folder)] == serialised([header(n) for n in range(10)])


def test_messages_that_have_arrived_before_the_end_are_in_the_bag(
    recording: Callable[..., Recording],
) -> None:
    from std_msgs.msg import Header

    recorder = recording()
    publishers = [recorder.publisher(Header, f"/sent/{name}") for name in "ab"]
    for number in range(10):
        publishers[number % 2].publish(header(number))
    assert all(publisher.wait_for_all_acked() for publisher in publishers)
    recorder.finish()  # the executor has not spun
    found = sorted(data for _, data in content(recorder.folder))
    assert found == serialised([header(n) for n in range(10)])


def test_a_bag_is_split_by_size(recording: Callable[..., Recording]) -> None:
    from std_msgs.msg import UInt8MultiArray

    recorder = recording(max_bag_size=100_000)
    publisher = recorder.publisher(UInt8MultiArray, "/sent/a")
    for number in range(10):
        publisher.publish(UInt8MultiArray(data=array("B", bytes(5_000_000))))
        assert recorder.spin_until(lambda number=number: recorder.received == number + 1)
    recorder.finish()
    assert len(list(recorder.folder.glob("*.mcap"))) > 2
    assert len(content(recorder.folder)) == 10


# Processes


class RecorderProcess:
    """A recorder process, and a publisher of large messages that it has found."""

    def __init__(self, folder: Path, topic: str, *parameters: str, limit: int = 0) -> None:
        from rclpy.qos import QoSDurabilityPolicy, QoSProfile
        from std_msgs.msg import UInt8MultiArray

        self.folder = folder
        self.sender = rclpy.create_node("sender")
        given = [f"output:={folder}", 'topics:=["/sent/*"]', *parameters]
        self.output = folder.with_name("output.txt")
        with self.output.open("ab") as file:
            self.process = subprocess.Popen(
                [*NODE, "recorder", "--ros-args", *(word for each in given for word in ("-p", each))],
                cwd=ROOT,
                # with a limit, Python would cut the bytecode of its modules
                env={**os.environ, "PYTHONDONTWRITEBYTECODE": "1"},
                stdout=file,
                stderr=subprocess.STDOUT,
                preexec_fn=(lambda: resource.setrlimit(resource.RLIMIT_FSIZE, (limit, limit)))
                if limit
                else None,
            )
        # latched: a recorder that finds it late gets the first messages, too
        latched = QoSProfile(depth=1000, durability=QoSDurabilityPolicy.TRANSIENT_LOCAL)
        self._publisher = self.sender.create_publisher(UInt8MultiArray, topic, latched)
        self.sent: list[bytes] = []
        assert wait_until(lambda: self._publisher.get_subscription_count() or self.process.poll() is not None)

    def send(self, number: int, size: int = 1000) -> None:
        from std_msgs.msg import UInt8MultiArray

        for _ in range(number):
            message = UInt8MultiArray(data=array("B", [len(self.sent) % 251]) * size)
            self._publisher.publish(message)
            self.sent += serialised([message])

    def written(self) -> int:
        """Bytes in the files of the bag."""
        return sum(path.stat().st_size for path in self.folder.glob("*.mcap"))

    def close(self) -> None:
        self.process.kill()
        self.process.wait(PATIENCE)
        self.sender.destroy_node()


@pytest.fixture
def recorder_process(ros: None, tmp_path: Path) -> Iterator[Callable[..., RecorderProcess]]:
    started: list[RecorderProcess] = []

    def start(*parameters: str, limit: int = 0) -> RecorderProcess:
        topic = f"/sent/topic_{len(started)}"  # which a recorder that was killed does not seem to receive
        started.append(RecorderProcess(tmp_path / "bag", topic, *parameters, limit=limit))
        return started[-1]

    yield start
    for each in started:
        each.close()


@pytest.mark.parametrize("number", [signal.SIGINT, pytest.param(signal.SIGTERM, marks=pytest.mark.nightly)])
def test_a_stop_signal_finishes_the_bag(
    recorder_process: Callable[..., RecorderProcess], number: signal.Signals
) -> None:
    recorder = recorder_process()
    recorder.send(10)
    assert recorder._publisher.wait_for_all_acked()
    recorder.process.send_signal(number)
    assert recorder.process.wait(PATIENCE) == 0, recorder.output.read_text()
    assert [data for _, data in content(recorder.folder)] == recorder.sent
    assert by_mcap(recorder.folder) == content(recorder.folder)


@pytest.mark.slow
def test_a_killed_recorder_leaves_a_readable_bag_and_continues_it(
    recorder_process: Callable[..., RecorderProcess],
) -> None:
    first = recorder_process()
    first.send(10, 100_000)
    assert wait_until(lambda: first.written() > 1_000_000)
    first.process.kill()
    first.process.wait(PATIENCE)
    with pytest.warns(HumansimWarning, match="was not finished"), BagReader(first.folder) as reader:
        assert [bytes(message.data) for message in reader.messages()] == first.sent
    first.sender.destroy_publisher(first._publisher)  # its messages are latched
    second = recorder_process("resume:=true")
    second.send(10, 100_000)
    assert wait_until(lambda: second.written() > 2_000_000)
    second.process.terminate()
    assert second.process.wait(PATIENCE) == 0, second.output.read_text()
    assert [data for _, data in content(second.folder)] == first.sent + second.sent


@pytest.mark.slow
@pytest.mark.nightly
def test_a_full_disk_is_said_once_and_the_bag_has_whole_messages(
    recorder_process: Callable[..., RecorderProcess],
) -> None:
    recorder = recorder_process(limit=1 << 27)  # more than the shared memory of the middleware

    def send() -> None:
        recorder.send(1, 4_000_000)
        time.sleep(0.02)

    assert wait_until(lambda: recorder.process.poll() is not None, step=send)
    output = recorder.output.read_text()
    assert recorder.process.returncode == 1, output
    assert output.count("error: ") == 1
    assert f"{recorder.folder}: cannot be written: File too large; its messages are readable" in output
    assert "Traceback" not in output
    with pytest.warns(HumansimWarning, match="was not finished"), BagReader(recorder.folder) as reader:
        found = [bytes(each.data) for each in reader.messages()]
    assert len(found) > 20
    assert found == recorder.sent[: len(found)]


def test_the_output_is_one_line_if_the_path_exists(tmp_path: Path) -> None:
    (tmp_path / "bag").mkdir()
    command = [*NODE, "recorder", "--ros-args", "-p", f"output:={tmp_path / 'bag'}"]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, timeout=PATIENCE, check=False)
    assert done.returncode == 2
    assert done.stderr == f"error: {tmp_path / 'bag'}: this path exists; choose another name for the bag\n"


# Whole runs in lockstep


SCENE = """
rate: 20
room: null
humans: {anna: {motion: {file: walk}}}
cameras:
  left: {size: [64, 48], position: [3, 0, 1.5], look_at: [0, 0, 1]}
  right: {size: [64, 48], position: [0, 3, 1.5], look_at: [0, 0, 1]}
"""
FRAMES = 60


def node_pid(name: str, mark: str) -> int | None:
    """Process id of a node whose environment has a variable."""
    for entry in Path("/proc").iterdir():
        try:
            if (entry / "comm").read_text().strip() == name and mark in (entry / "environ").read_text():
                return int(entry.name)
        except (OSError, ValueError, UnicodeDecodeError):
            continue
    return None


def written(bag: Path) -> int:
    """Bytes of the files of a bag."""
    return sum(path.stat().st_size for path in bag.glob("*.mcap"))


@pytest.mark.slow
@pytest.mark.nightly
@pytest.mark.parametrize("victim", ["recorder", "right"])
def test_a_run_in_lockstep_records_every_frame_although_a_node_is_killed_and_slow_to_start(
    ros: None, tmp_path: Path, victim: str
) -> None:
    """The new process is stopped for three time-outs, as if the machine were too busy to start it."""
    scene, bag, output = write_scene(tmp_path, SCENE), tmp_path / "bag", tmp_path / "output.txt"
    mark, timeout = f"HUMANSIM_TEST_MARK={tmp_path}", 2.0
    command = [sys.executable, "-m", "humansim_ros", "run", str(scene), "--lockstep", "--frames", str(FRAMES)]
    with output.open("wb") as file:
        run = subprocess.Popen(
            [*command, "--record", str(bag), "--jobs", "2", "--timeout", str(timeout), "--pace", "10"],
            cwd=ROOT,
            stdout=file,
            stderr=subprocess.STDOUT,
            env={**os.environ, **dict([mark.split("=")])},
        )
    try:
        for size in (200_000, 900_000):
            assert wait_until(lambda size=size: run.poll() is not None or written(bag) > size)
            assert run.poll() is None, output.read_text()
            killed = node_pid(victim, mark)
            assert killed is not None
            os.kill(killed, signal.SIGKILL)
            assert wait_until(lambda killed=killed: node_pid(victim, mark) not in (killed, None))
            started = node_pid(victim, mark)
            assert started is not None
            os.kill(started, signal.SIGSTOP)
            time.sleep(3 * timeout)
            os.kill(started, signal.SIGCONT)
        assert run.wait(PATIENCE) == 0, output.read_text()
    finally:
        run.terminate()
        run.wait(PATIENCE)
    assert output.read_text().count("started again") == 2
    found: dict[str, list[int]] = {}
    with Reader(bag) as reader:
        for connection, stamp, _ in reader.messages():
            found.setdefault(connection.topic, []).append(stamp)
    stamps = [1 + k * 50_000_000 for k in range(FRAMES)]
    kinds = ("image_raw", "depth/image", "part/image", "camera_info", "joints")
    topics = [f"/{camera}/{kind}" for camera in ("left", "right") for kind in kinds]
    for topic in (*topics, "/humans/anna/joints", "/humans/anna/vertices", "/scene_time", "/clock"):
        assert found[topic] == stamps, topic
    assert f"finished: left {FRAMES}, right {FRAMES}, recorder {FRAMES}" in output.read_text()


def test_a_recorder_is_one_of_the_processes_and_lockstep_waits_for_it(tmp_path: Path) -> None:
    from humansim_ros.errors import RosError
    from humansim_ros.ros.processes.lockstep_settings import TimeOptions
    from humansim_ros.ros.processes.node_processes import scene_processes
    from humansim_ros.ros.processes.run_options import RecordOptions

    scene, bag = write_scene(tmp_path, SCENE), tmp_path / "bag"
    time_options = TimeOptions(lockstep=True, wait_for=["topic:/tracker/poses", "me"])
    options = RecordOptions(bag, ["/left/*"])
    player, *_, recorder = scene_processes(scene, namespace="lab", time=time_options, record=options)
    assert player.parameters["recorder"] == recorder.node_name == "recorder"
    assert recorder.parameters["awaited"] == ["/tracker/poses"]
    assert recorder.parameters["topics"] == ["/left/*"]
    assert recorder.parameters["lockstep"] is True and recorder.namespace == "lab"
    in_real_time = scene_processes(scene, record=options)
    assert "recorder" not in in_real_time[0].parameters
    assert in_real_time[-1].parameters["lockstep"] is False
    bag.mkdir()
    with pytest.raises(RosError, match="exists; choose another name"):
        scene_processes(scene, record=options)


def test_launch_arguments_are_options_of_the_recorder() -> None:
    from humansim_ros.errors import RosError
    from humansim_ros.ros.processes.run_options import RecordOptions, launch_arguments, launch_options

    nothing = dict.fromkeys(launch_arguments(RecordOptions), "")
    assert launch_options(RecordOptions, nothing) is None
    given = {**nothing, "record": "/data/walk", "record_topics": "/left/*, /tracker/poses"}
    made = launch_options(RecordOptions, given)
    assert made == RecordOptions(Path("/data/walk"), ["/left/*", "/tracker/poses"], "none")
    with pytest.raises(RosError, match="record_topics goes with record only"):
        launch_options(RecordOptions, {**nothing, "record_topics": "/left/*"})
