"""Several cameras in one process render the images of Simulation with one renderer, independently."""

from __future__ import annotations

import signal
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from ros_support import SMALL_SCENE, Client, rclpy, write_scene
from waiting import PATIENCE

from humansim_ros.data.messages.humans import joints_message, vertices_message
from humansim_ros.errors import RenderError, SceneError
from humansim_ros.render import GLRenderer
from humansim_ros.render.device.mesh_buffers import PosedMesh
from humansim_ros.ros.nodes.camera_rig import CameraRigNode
from humansim_ros.ros.processes.node_processes import scene_processes
from humansim_ros.ros.processes.runtime import make_executor
from humansim_ros.ros.processes.supervisor import Supervisor
from humansim_ros.scene import Scene, Simulation

START = 7_000_000_000
CAMERAS = ("left", "right")
#: Topic, element type and pixel shape of every channel that has one image.
CHANNELS: dict[str, tuple[str, Any, tuple[int, ...]]] = {
    "rgb": ("image_raw", np.uint8, (3,)),
    "depth": ("depth/image", np.float32, ()),
    "instance": ("instance/image", np.uint16, ()),
    "part": ("part/image", np.uint8, ()),
    "face": ("face/image", np.int32, ()),
    "normal": ("normal/image", np.float32, (3,)),
    "uv": ("uv/image", np.float32, (2,)),
    "flow_back": ("flow_back/image", np.float32, (2,)),
    "flow_back_hidden": ("flow_back/hidden", np.uint8, ()),
}
HUMANS = ("first", "second")


class Stage:
    """A rig, and a client that publishes as skinners do and subscribes to its cameras."""

    def __init__(self, namespace: str, scene: Path, **parameters: Any) -> None:
        from sensor_msgs.msg import MultiDOFJointState, PointCloud2

        values = {"scene": str(scene), **parameters}
        overrides = [rclpy.parameter.Parameter(name, value=value) for name, value in values.items()]
        self.namespace = namespace
        self.rig = CameraRigNode(parameter_overrides=overrides, namespace=namespace)
        self.client = Client(f"{namespace}_client", make_executor())  # as in node processes
        for node in self.rig.nodes:
            self.client.executor.add_node(node)
        self.senders = {
            (human, kind): self.client.node.create_publisher(
                message, f"/{namespace}/humans/{human}/{kind}", 5
            )
            for human in self.rig.scene.actors
            for kind, message in (("vertices", PointCloud2), ("joints", MultiDOFJointState))
        }
        self.client.spin_until_matched(*self.rig.nodes)

    def subscribe(self, kind: Any, *topics: str) -> None:
        full = [f"/{self.namespace}/{topic}" for topic in topics]
        self.client.subscribe(kind, full)
        self.client.spin_until_matched(*self.rig.nodes)

    def messages_of(self, topic: str) -> dict[int, Any]:
        return self.client.received[f"/{self.namespace}/{topic}"]

    def send(self, frame: Any) -> None:
        for human, state in frame.humans.items():
            self.senders[human, "joints"].publish(joints_message(state, frame.stamp))
            self.senders[human, "vertices"].publish(vertices_message(state.vertices, frame.stamp))

    def close(self) -> None:
        self.rig.close()
        self.rig.destroy_node()
        self.client.close()


@pytest.fixture
def make_stage(ros: None, scene_path: Path) -> Iterator[Callable[[str], Stage]]:
    """Stage in a namespace; closed after a test that fails, too: its nodes must not stay in the graph."""
    stages: list[Stage] = []

    def make(namespace: str) -> Stage:
        stages.append(Stage(namespace, scene_path))
        return stages[-1]

    yield make
    for stage in stages:
        stage.close()


@pytest.fixture(scope="module")
def scene_path(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_scene(tmp_path_factory.mktemp("rig"))


@pytest.fixture(scope="module")
def played(ros: None, scene_path: Path) -> Iterator[Any]:
    """Some frames of Simulation, sent to a rig, and the images that it publishes."""
    from sensor_msgs.msg import Image, PointCloud2

    channels = (*CHANNELS, "alpha", "amodal")
    simulation = Simulation(Scene.load(scene_path), channels, start=START)
    stage = Stage("rig", scene_path)
    topics = [f"{camera}/{topic}" for camera in CAMERAS for topic, _, _ in CHANNELS.values()]
    topics += [
        f"{camera}/{kind}/{human}/image"
        for camera in CAMERAS
        for kind in ("alpha", "amodal")
        for human in HUMANS
    ]
    stage.subscribe(Image, *topics)
    stage.subscribe(PointCloud2, *(f"{camera}/joints" for camera in CAMERAS))
    frames = {}
    for index in range(3, 7):
        frame = frames[START + simulation.scene.frame_time(index)] = simulation.frame(index)
        stage.send(frame)
        # the first frame has no previous frame
        awaited = [t for t in topics if index > 3 or "flow_back" not in t]
        done = stage.client.spin_until(
            lambda s=frame.stamp, a=awaited: all(s in stage.messages_of(t) for t in a)
        )
        assert done, [t for t in awaited if frame.stamp not in stage.messages_of(t)]
    yield SimpleNamespace(stage=stage, frames=frames, scene=simulation.scene)
    stage.close()
    simulation.close()


@pytest.mark.parametrize("camera", CAMERAS)
def test_images_of_a_rig_equal_those_of_simulation_to_the_byte(played: Any, camera: str) -> None:
    for stamp, frame in list(played.frames.items())[1:]:
        view = frame.views[camera]
        for channel, (topic, kind, end) in CHANNELS.items():
            message = played.stage.messages_of(f"{camera}/{topic}")[stamp]
            image = np.frombuffer(message.data, kind).reshape(message.height, message.width, *end)
            assert np.array_equal(image, getattr(view, channel), equal_nan=kind == np.float32), channel
            assert message.header.frame_id == f"{camera}_optical_frame"
        for channel in ("alpha", "amodal"):
            for human in HUMANS:
                data = played.stage.messages_of(f"{camera}/{channel}/{human}/image")[stamp].data
                expected = getattr(view, channel)[played.scene.actors[human].instance]
                full = 255 if channel == "amodal" else 1
                assert bytes(data) == (expected * np.uint8(full)).astype(np.uint8).tobytes(), channel


def test_a_posed_mesh_is_computed_once_for_all_cameras(
    make_stage: Callable[[str], Stage], monkeypatch: pytest.MonkeyPatch
) -> None:
    from sensor_msgs.msg import Image

    stage = make_stage("once")
    simulation = Simulation(stage.rig.scene, ("depth",), start=START)
    topics = [f"{camera}/{topic}" for camera in CAMERAS for topic in ("image_raw", "depth/image")]
    stage.subscribe(Image, *topics)
    frames = [simulation.frame(index) for index in (0, 1)]
    computed = 0
    make = PosedMesh.__init__

    def count(self: Any, *rest: Any) -> None:
        nonlocal computed
        computed += 1
        make(self, *rest)

    for frame in frames:
        if frame is frames[1]:  # the first frame needs more work
            monkeypatch.setattr(PosedMesh, "__init__", count)
        stage.send(frame)
        assert stage.client.spin_until(lambda s=frame.stamp: all(s in stage.messages_of(t) for t in topics))
    assert computed == len(HUMANS)
    simulation.close()


def test_a_rig_subscribes_once_to_each_human_and_has_a_node_for_each_camera(played: Any) -> None:
    node = played.stage.client.node
    for human in HUMANS:
        for kind in ("vertices", "joints"):
            (subscriber,) = node.get_subscriptions_info_by_topic(f"/rig/humans/{human}/{kind}")
            assert subscriber.node_name == "_camera_rig"
    names = {name for name, namespace in node.get_node_names_and_namespaces() if namespace == "/rig"}
    assert {"_camera_rig", *CAMERAS} <= names
    for camera in CAMERAS:
        (publisher,) = node.get_publishers_info_by_topic(f"/rig/{camera}/image_raw")
        assert publisher.node_name == camera


def test_a_frame_with_a_vertex_that_is_not_finite_is_skipped_and_logged_and_the_next_is_rendered(
    played: Any, capfd: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    stage = played.stage
    skipped: list[str] = []
    report = stage.rig.report_skipped
    monkeypatch.setattr(stage.rig, "report_skipped", lambda reason: (skipped.append(reason), report(reason)))
    last = max(played.frames)
    frame = played.frames[last]
    capfd.readouterr()
    for step, poison in ((1, np.nan), (2, np.inf), (3, 0.0)):
        stamp = last + step * 50_000_000
        for human, state in frame.humans.items():
            vertices = state.vertices.copy()
            vertices[7, 1] += poison
            stage.senders[human, "joints"].publish(joints_message(state, stamp))
            stage.senders[human, "vertices"].publish(vertices_message(vertices, stamp))
        assert stage.client.spin_until(lambda s=step: len(skipped) == min(s, 2))
    assert stage.client.spin_until(lambda: all(stamp in stage.messages_of(f"{c}/image_raw") for c in CAMERAS))
    for camera in CAMERAS:
        assert not {last + 50_000_000, last + 100_000_000} & set(stage.messages_of(f"{camera}/image_raw"))
    log = capfd.readouterr().err
    assert "frame skipped" in log and "not finite" in log


def test_a_frame_with_joints_that_cannot_be_read_is_skipped_and_the_next_is_rendered(played: Any) -> None:
    """Joints are read only when a topic needs them; their stamp is read before."""
    from rclpy.serialization import serialize_message

    stage, last = played.stage, max(played.frames)
    frame, drops = played.frames[last], played.stage.rig.members[0]._counts
    broken = ("cut", "of another body", "whole")
    stamps = [last + 500_000_000 + number * 50_000_000 for number in range(len(broken))]
    for stamp, kind in zip(stamps, broken, strict=True):
        for human, state in frame.humans.items():
            message = joints_message(state, stamp)
            if kind == "of another body":
                message.joint_names[0] = "other"
            data = serialize_message(message)
            stage.senders[human, "joints"].publish(data[:200] if kind == "cut" else data)
            stage.senders[human, "vertices"].publish(vertices_message(state.vertices, stamp))
    assert stage.client.spin_until(lambda: stamps[-1] in stage.messages_of("left/joints"))
    assert not {*stamps[:-1]} & set(stage.messages_of("left/joints"))
    assert "drops" in drops


@pytest.mark.parametrize(
    ("error", "line"),
    [
        (RenderError("the left one is broken"), "frame skipped: the left one is broken"),
        (ZeroDivisionError("unexpected"), "frame: ZeroDivisionError: unexpected; it is skipped"),
    ],
)
def test_a_camera_that_fails_does_not_stop_the_others(
    error: Exception,
    line: str,
    make_stage: Callable[[str], Stage],
    monkeypatch: pytest.MonkeyPatch,
    capfd: pytest.CaptureFixture[str],
) -> None:
    from sensor_msgs.msg import Image

    stage = make_stage("half")
    simulation = Simulation(stage.rig.scene, ("depth",), start=START)
    frame = simulation.frame(0)
    render = GLRenderer.render

    def fail(self: Any, request: Any) -> Any:
        if request.camera.size == (160, 120):
            raise error
        return render(self, request)

    monkeypatch.setattr(GLRenderer, "render", fail)
    stage.subscribe(Image, "left/depth/image", "right/depth/image")
    stage.send(frame)
    assert stage.client.spin_until(lambda: frame.stamp in stage.messages_of("right/depth/image"))
    assert not stage.messages_of("left/depth/image")
    assert f"[half.left]: {line}" in capfd.readouterr().err
    simulation.close()


def test_a_rig_has_the_cameras_of_its_parameter(ros: None, scene_path: Path) -> None:
    def made(*cameras: str) -> list[str]:
        values = {"scene": str(scene_path), **({"cameras": list(cameras)} if cameras else {})}
        overrides = [rclpy.parameter.Parameter(name, value=value) for name, value in values.items()]
        rig = CameraRigNode(parameter_overrides=overrides, namespace="chosen")
        names = [node.get_name() for node in rig.members]
        rig.close()
        rig.destroy_node()
        return names

    assert made() == ["left", "right"]
    assert made("right") == ["right"]
    assert made("right", "left", "right") == ["right", "left"]
    with pytest.raises(SceneError, match="the scene has no camera 'middle'; there are left, right"):
        made("left", "middle")


def nodes_seen_by(client: Client, namespace: str = "/") -> set[str]:
    """Nodes in a namespace; not the clients of tests, of which ROS knows for a while after their end."""
    found = client.node.get_node_names_and_namespaces()
    return {name for name, its in found if its == namespace and "client" not in name}


@pytest.mark.slow
@pytest.mark.nightly
def test_users_see_the_same_nodes_and_diagnostics_for_any_number_of_processes(
    ros: None, scene_path: Path
) -> None:
    """The tools of ROS hide nodes with a name that begins with _."""
    from diagnostic_msgs.msg import DiagnosticArray
    from std_msgs.msg import Header

    visible = {"motion_player", "skinner_first", "skinner_second", *CAMERAS}
    reporters = {1: {"/left, /right"}, 2: {"/left", "/right"}}
    for number in (1, 2):
        client = Client("onlooker_client")
        diagnostics: set[str] = set()
        done: set[str] = set()
        client.node.create_subscription(
            DiagnosticArray, "/diagnostics", lambda m, names=diagnostics: names.add(m.status[0].name), 50
        )
        client.node.create_subscription(
            Header, "/frame_done", lambda m, names=done: names.add(m.frame_id), 50
        )

        def nodes(client: Client = client) -> set[str]:
            return {name for name in nodes_seen_by(client) if not name.startswith("_")}

        with Supervisor(scene_processes(scene_path, number)):
            assert client.spin_until(lambda n=nodes: n() == visible), nodes()
            everyone = {f"/{name}" for name in visible}
            assert client.spin_until(lambda d=diagnostics, e=everyone: d == e), diagnostics
            assert client.spin_until(lambda d=done, n=number: d == reporters[n]), done
        client.close()


def test_a_process_with_a_name_and_a_list_of_cameras(ros: None, tmp_path: Path) -> None:
    """As humansim run and launch start it; one camera is named off, a boolean in YAML."""
    scene = write_scene(tmp_path, SMALL_SCENE.replace("  left:", "  'off':"))
    (process,) = [p for p in scene_processes(scene, 1) if p.executable == "camera_rig"]
    command = [sys.executable, "-m", "humansim_ros.ros.nodes", process.executable, *process.ros_arguments]
    command += ["-r", "__ns:=/named"]  # nodes of earlier tests may be known for a while
    running = subprocess.Popen(
        command,
        stderr=subprocess.PIPE,
        text=True,
    )
    client = Client("onlooker_client")

    try:
        expected = {"_camera_rig_1", "off", "right"}
        assert client.spin_until(lambda: nodes_seen_by(client, "/named") == expected)
    finally:
        running.send_signal(signal.SIGINT)
        log = running.communicate(timeout=PATIENCE)[1]
        client.close()
    assert running.returncode == 0 and "Traceback" not in log, log
