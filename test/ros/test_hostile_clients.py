"""Commands that subscribe, and examples, go on when somebody else publishes nonsense on their topics."""

from __future__ import annotations

import importlib.util
import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from conftest import ROOT
from ros_support import Client, rclpy, write_scene
from waiting import wait_until

from humansim_ros.data import messages
from humansim_ros.data.messages.camera_truth import JOINT_POINT
from humansim_ros.data.messages.cameras import projection_message
from humansim_ros.data.messages.humans import joints_message, vertices_message
from humansim_ros.data.messages.images import image_message
from humansim_ros.data.messages.legends import joints_legend
from humansim_ros.data.messages.points import point_cloud
from humansim_ros.ros.tools.bench import _Subscriber
from humansim_ros.ros.tools.demo import _contact_sheet, _Recorder
from humansim_ros.scene import Scene

SIZES = {"left": (160, 120), "right": (200, 150)}


class Sender:
    """Publishes on topics that a client subscribes to, and waits until it has got everything."""

    def __init__(self, client: Any) -> None:
        self._client = client
        self._node = rclpy.create_node("sender")
        self._publishers: dict[str, Any] = {}

    def send(self, kind: Any, topic: str, *contents: Any) -> None:
        if topic not in self._publishers:
            publisher = self._publishers[topic] = self._node.create_publisher(kind, topic, 100)
            assert wait_until(publisher.get_subscription_count, step=lambda: self._client.spin(0.05))
        for content in contents:
            self._publishers[topic].publish(content)
            self._client.spin(0.05)

    def close(self) -> None:
        self._node.destroy_node()


@pytest.fixture
def recorder(tmp_path: Path) -> Iterator[_Recorder]:
    with _Recorder(Scene.load(write_scene(tmp_path))) as recorder:
        yield recorder


def image(camera: str, encoding: str, stamp: int) -> Any:
    width, height = SIZES[camera]
    pixel, kind = {"rgb8": ((3,), np.uint8), "32FC1": ((), np.float32), "mono8": ((), np.uint8)}[encoding]
    return image_message(np.ones((height, width, *pixel), kind), encoding, stamp, "frame")


def joints(scene: Scene, stamp: int, u: float = 20.0) -> Any:
    count = len(scene.actors["first"].human.skeleton.joint_names)
    points = np.zeros(2 * count, dtype=JOINT_POINT)
    points["u"], points["v"], points["visible"] = u, 30.0, 2
    points["human"] = np.repeat([actor.instance for actor in scene.actors.values()], count)
    return point_cloud(points, messages.header(stamp, "frame"))


def test_the_demo_draws_a_frame_among_hostile_messages(recorder: _Recorder) -> None:
    from sensor_msgs.msg import Image, PointCloud2

    sender, scene = Sender(recorder), recorder.scene
    kinds = {"image_raw": "rgb8", "depth/image": "32FC1", "part/image": "mono8"}
    for topic, encoding in kinds.items():
        wrong = {"encoding": "x"}, {"width": 0}, {"width": 2**32 - 1, "height": 2**32 - 1}, {"data": b""}
        hostile: list[Any] = [b"", b"\0\1\0\0" + b"\xff" * 60]
        for changes in wrong:
            hostile.append(image("left", encoding, 5))
            for name, value in changes.items():
                setattr(hostile[-1], name, value)
        sender.send(Image, f"/left/{topic}", *hostile)
        assert not recorder.messages[f"/left/{topic}"]
        ahead = [image("left", encoding, (2_000_000_000 + number) * 10**9) for number in range(30)]
        sender.send(Image, f"/left/{topic}", *ahead)
        assert recorder.messages[f"/left/{topic}"]
    alien = joints(scene, 5)
    alien.width, alien.data = 1, alien.data[: alien.point_step]
    sender.send(PointCloud2, "/left/joints", b"", alien, vertices_message(np.ones((3, 3)), 5))
    assert not recorder.messages["/left/joints"]

    def send_frame() -> None:  # again, because best-effort subscribers may lose messages
        for camera in SIZES:
            for topic, encoding in kinds.items():
                sender.send(Image, f"/{camera}/{topic}", image(camera, encoding, 5))
            sender.send(PointCloud2, f"/{camera}/joints", joints(scene, 5, u=1e30))

    assert wait_until(lambda: len(recorder.sheet) == 8, step=send_frame)
    sheet = _contact_sheet(scene, recorder)
    assert sheet.dtype == np.uint8 and sheet.any()
    sender.close()


def test_the_benchmark_counts_frames_among_hostile_messages() -> None:
    from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
    from sensor_msgs.msg import Image

    with _Subscriber(["/left/image_raw"], ["/left/image_raw"]) as subscriber:
        sender = Sender(subscriber)
        bad_stamp = image("left", "rgb8", 5)
        bad_stamp.header.stamp.nanosec = 2**32 - 1
        sender.send(Image, "/left/image_raw", b"", b"\0\1", bad_stamp)
        assert subscriber.complete == 0 and subscriber.silent
        good = image("left", "rgb8", 5)
        assert wait_until(
            lambda: subscriber.complete == 1, step=lambda: sender.send(Image, "/left/image_raw", good)
        )
        assert not subscriber.silent
        for value in ("x", "", "nan", "inf", "-1", "1e400", "7.5"):
            status = DiagnosticStatus(name="/left", values=[KeyValue(key="render_median_ms", value=value)])
            sender.send(DiagnosticArray, "/diagnostics", DiagnosticArray(status=[status]))
        assert wait_until(lambda: subscriber.milliseconds("left"), step=lambda: subscriber.spin(0.05))
        assert subscriber._diagnostics["/left"] == [7.5]
        sender.close()


def test_the_tracker_measures_a_frame_among_hostile_messages(ros: None, tmp_path: Path) -> None:
    from rclpy.qos import QoSDurabilityPolicy, QoSProfile
    from sensor_msgs.msg import MultiDOFJointState, PointCloud2
    from std_msgs.msg import Float64MultiArray, String

    spec = importlib.util.spec_from_file_location("tracker", ROOT / "examples" / "tracker.py")
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    scene, client = Scene.load(write_scene(tmp_path)), Client("hostile_client")
    tracker = module.Tracker("first", 1)
    client.executor.add_node(tracker)
    latched = QoSProfile(depth=10, durability=QoSDurabilityPolicy.TRANSIENT_LOCAL)
    state = scene.actors["first"].at(0.0)
    labels = joints_legend({"first": (scene.actors["first"].instance, state.joint_names)})
    projection, legend, pixels = {}, {}, {}
    for camera in SIZES:
        projection[camera] = client.node.create_publisher(Float64MultiArray, f"{camera}/projection", latched)
        legend[camera] = client.node.create_publisher(String, f"{camera}/joints/legend", latched)
        pixels[camera] = client.node.create_publisher(PointCloud2, f"{camera}/joints", 10)
    truth = client.node.create_publisher(MultiDOFJointState, "humans/first/joints", 10)
    everyone = [*projection.values(), *legend.values(), *pixels.values(), truth]
    assert client.spin_until(lambda: all(publisher.get_subscription_count() for publisher in everyone))
    for text in ("", "[" * 100_000, "[]", json.dumps({"human": 5}), json.dumps({"human": {"x": "first"}})):
        legend["left"].publish(String(data=text))
    for numbers in ([], [1.0] * 11, [float("nan")] * 12):
        projection["left"].publish(Float64MultiArray(data=numbers))
    pixels["left"].publish(PointCloud2())
    pixels["left"].publish(vertices_message(state.vertices, 4))
    truth.publish(MultiDOFJointState())

    def send_frame() -> None:
        for camera in SIZES:
            view = scene.cameras[camera]
            u, v = view.project(state.positions)[0].T
            points = np.zeros(len(u), dtype=JOINT_POINT)
            points["u"], points["v"], points["visible"] = u, v, 2
            points["human"] = scene.actors["first"].instance
            legend[camera].publish(labels)
            projection[camera].publish(projection_message(view))
            pixels[camera].publish(point_cloud(points, messages.header(5, "frame")))
        truth.publish(joints_message(state, 5))
        client.spin_until(lambda: tracker.frames <= 0, 0.2)

    assert wait_until(lambda: tracker.frames <= 0, step=send_frame)
    assert max(tracker.errors) < 0.001
    tracker.destroy_node()
    client.close()
