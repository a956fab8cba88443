"""A running graph in the page shows what its topics say, whoever publishes them."""

from __future__ import annotations

import itertools
import re
import time
from collections.abc import Callable, Iterator
from contextlib import closing
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from keyframe_text import keyframes
from ros_support import Client, write_scene
from waiting import wait_until

from humansim_ros import Scene, Simulation
from humansim_ros.errors import RosError
from humansim_ros.motion.body.skeleton import body_joints
from humansim_ros.scene import Frame
from humansim_ros.testing import SceneGraph
from humansim_ros.view.sources.picking import PIXEL_CHANNELS, pixel_info
from humansim_ros.view.sources.ros_source import RosViewSource
from humansim_ros.view.sources.source import JOINTS, FrameRequest

SCENE = """
rate: 20
room: null
humans:
  anna: {body: child, motion: walk}
  bert: {body: adult_man, motion: {file: walk, position: [0.8, 0.3]}}
objects:
  crate: {mesh: box, size: [0.4, 0.3, 0.4], position: [0.2, -0.8, 0.2], label: true, keyframes: moves.xml}
cameras:
  fixed: {size: [96, 72], position: [3, 0.4, 1.4], look_at: [0, 0, 1]}
  bent: {size: [80, 64], distortion: [-0.2, 0.05, 0, 0, 0], position: [0, 3, 1.2], look_at: [0, 0, 0.8]}
"""
MOVES = keyframes(10, 10, crate=((0, 0, 0), (0.4, 0, 0)))
ERROR = 0.03


@pytest.fixture(scope="module")
def shown(ros: None, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Any]:
    """A source of the nodes of a scene, a fake tracker, and a simulation of the same scene."""
    folder = tmp_path_factory.mktemp("graph")
    (folder / "moves.xml").write_text(MOVES)
    scene = Scene.load(write_scene(folder, SCENE))
    with SceneGraph(scene) as graph, Simulation(scene, channels=PIXEL_CHANNELS) as simulation:
        tracker = Tracker(graph.node)
        graph.play(1)
        with closing(RosViewSource(estimate="/tracker/poses", patience=0.5)) as source:
            yield SimpleNamespace(
                source=source, graph=graph, scene=scene, simulation=simulation, tracker=tracker
            )


class Tracker:
    """Publishes the true joints of everybody 30 mm too high."""

    def __init__(self, node: Any) -> None:
        from sensor_msgs.msg import MultiDOFJointState

        self._publisher = node.create_publisher(MultiDOFJointState, "/tracker/poses", 5)
        for person in ("anna", "bert"):
            node.create_subscription(
                MultiDOFJointState, f"/humans/{person}/joints", lambda m, p=person: self._on(p, m), 5
            )
        self._waiting: dict[int, Any] = {}

    def _on(self, person: str, message: Any) -> None:
        stamp = message.header.stamp.sec * 10**9 + message.header.stamp.nanosec
        names = [f"{person}/{name}" for name in message.joint_names]
        for each in message.transforms:
            each.translation.z += ERROR
        other = self._waiting.pop(stamp, None)
        message.joint_names = names + (list(other.joint_names) if other else [])
        message.transforms = [*message.transforms, *(other.transforms if other else [])]
        if other:
            message.twist = []
            self._publisher.publish(message)
        else:
            self._waiting[stamp] = message


def shown_frame(shown: Any, channels: tuple[str, ...], whole: Callable[[Any], object]) -> tuple[Any, Frame]:
    """Play frames until one is whole; returns it and the frame of the simulation."""
    cameras, found = ["fixed", "bent"], []

    def step() -> None:
        shown.graph.play(1)
        found.append(shown.source.frame(0, FrameRequest(cameras, channels)))

    assert wait_until(lambda: found and whole(found[-1]), step=step), found[-1]
    frame = found[-1]
    return frame, shown.simulation.frame(round((frame.stamp - 1) / 50e6))


def test_a_frame_of_the_graph_is_that_of_the_simulation(shown: Any) -> None:
    source = shown.source
    assert source.frames is None
    assert source.title == f"ROS domain {shown.graph.domain}"
    channels = ("rgb", "depth", JOINTS)
    frame, truth = shown_frame(
        shown, channels, lambda frame: [len(each) for each in frame.images.values()] == [3, 3]
    )
    assert frame.stamp == truth.stamp and frame.scene_time == truth.scene_time
    assert source.people.keys() == {"anna", "bert"}
    assert {"rgb", JOINTS, "depth", "instance", "part"} <= set(source.channels)
    for name, joints in frame.joints.items():
        np.testing.assert_allclose(joints, truth.humans[name].joints, atol=1e-12)
        human = source.people[name]
        assert human.mesh.texture is not None
        posed = human.pose(joints[: len(human.skeleton)])
        np.testing.assert_allclose(posed, truth.humans[name].vertices, atol=1e-6)
    for name, camera in frame.cameras.items():
        np.testing.assert_allclose(camera.P, truth.cameras[name].P, atol=1e-9)
        np.testing.assert_array_equal(frame.images[name]["rgb"], truth.views[name].rgb)
        assert not np.array_equal(frame.images[name][JOINTS], truth.views[name].rgb)
    np.testing.assert_allclose(frame.objects["crate"], truth.objects["crate"].matrix, atol=1e-12)
    later, _ = shown_frame(shown, (), lambda later: later.stamp > frame.stamp)
    assert later.index > frame.index and not any(later.images.values())
    assert source.period == 50_000_000


def test_age_rate_and_lost_images_are_told(shown: Any) -> None:
    source = shown.source
    shown_frame(shown, ("rgb",), lambda frame: [len(each) for each in frame.images.values()] == [1, 1])

    def step() -> None:
        shown.graph.play(1)
        source.frame(0, FrameRequest(["fixed", "bent"], ["rgb"]))

    pattern = r"(\d\.\d\d) s old; bent \d+\.\d Hz; fixed \d+\.\d Hz"
    assert wait_until(lambda: re.fullmatch(pattern, source.timing), step=step), source.timing
    store = source._receiver.store
    topic = source.topics.cameras["bent"].images["rgb"]
    assert wait_until(lambda: len(store.stamps([topic])) > 3, step=step)
    # one that arrived is taken away: it is as one that never came
    store._remove(topic, store.stamps([topic])[-2])
    age, rates = source.timing.split(" s old; ", 1)
    assert re.fullmatch(r"bent \d+\.\d Hz, 1 of \d+ lost; fixed \d+\.\d Hz", rates), source.timing
    time.sleep(0.3)
    assert float(source.timing.split(" s")[0]) >= float(age) + 0.29


def test_the_timeline_of_the_graph_grows_with_its_truth(shown: Any) -> None:
    source, found = shown.source, []
    cameras = ["fixed", "bent"]

    def step() -> None:
        shown.graph.play(1)
        source.frame(0, FrameRequest(cameras, ["rgb", JOINTS]))
        found[:] = [source.live_tracks()]

    def is_known() -> bool:
        """Visibility comes from the topics of the cameras, for all people."""
        table = found[0].table() if found and found[0] else {}
        known = [each for seen in table.get("visible", {}).values() for each in seen.values()]
        return len(known) == 4 and all(each[-1] is not None for each in known) and not table["projected"]

    assert wait_until(is_known, step=step)
    table, frames = found[0].table(), found[0].outline.frames
    assert {
        name: each["spans"][-1][1] for name, each in zip(("anna", "bert"), table["people"], strict=True)
    } == {
        "anna": frames - 1,
        "bert": frames - 1,
    }
    newest, number = source._live.newest, table["sampled"][-1]
    index = round((newest - 1) / 50e6) - (frames - 1 - number)
    truth = shown.simulation.frame(index)
    for person in ("anna", "bert"):
        for camera in cameras:
            names = source.people[person].skeleton.joint_names
            states = truth.truth[camera].joints[person].visible[body_joints(names)]
            assert table["visible"][person][camera][-1] == round(100 * float((states == 2).mean()))
        curve = found[0].curve(person, "l_wrist")
        joints = source.people[person].skeleton.joint_names
        point = truth.humans[person].joints[joints.index("l_wrist"), :3, 3]
        assert [curve["lines"][axis][-1] for axis in "xyz"] == pytest.approx(point.tolist(), abs=1e-3)
        assert table["errors"]["values"][person][-1] == pytest.approx(1000 * ERROR, abs=0.1)
    before, store = source._live.newest, source._receiver.store
    topic = source.topics.cameras["bent"].images["rgb"]

    def new() -> list[int]:
        return [stamp for stamp in store.stamps([topic]) if stamp > before]

    def play() -> None:
        shown.graph.play(1)
        source.frame(0, FrameRequest(cameras, ["rgb"]))

    assert wait_until(lambda: len(new()) > 2, step=play)
    # one that arrived is taken away: it is as one that never came
    lost = new()[1]
    store._remove(topic, lost)
    table = source.live_tracks().table()
    assert table["frames"] - 1 - round((source._live.newest - lost) / 50e6) in table["drops"]["bent"]


def test_an_estimate_is_beside_the_truth_of_its_frame(shown: Any) -> None:
    frame, truth = shown_frame(shown, (), lambda frame: len(frame.estimate) == 2)
    assert frame.estimate_errors == pytest.approx({"anna": 1000 * ERROR, "bert": 1000 * ERROR}, abs=1e-6)
    expected = truth.humans["anna"].positions + np.array([0, 0, ERROR])
    np.testing.assert_allclose(frame.estimate["anna"], expected, atol=1e-12)
    # on a slow machine, the frame of the simulation took so long that no estimate has arrived meanwhile
    told = [text for text in shown.source.messages if not text.startswith("No estimate arrives")]
    assert not any("estimate" in text for text in told)


def test_pixels_have_the_numbers_of_the_simulation(shown: Any) -> None:
    """Topics that nobody wanted before are received from then on."""
    source, found = shown.source, []

    def step() -> None:
        truth = shown.simulation.frame(round((shown.graph.play(1)[0] - 1) / 50e6))
        labels = truth.views["fixed"].instance
        rows, columns = np.nonzero((labels > 0) & (labels < 3))  # people
        middle = len(rows) // 2
        pixel = int(columns[middle]), int(rows[middle])
        source.frame(0)
        expected = pixel_info(shown.scene, truth, "fixed", *pixel)
        found.append((source.describe("fixed", *pixel), expected))

    assert wait_until(lambda: found and found[-1][0].values == found[-1][1].values, step=step), found[-1]
    assert {"world", "normal", "instance", "part", "face"} <= found[-1][0].values.keys()
    np.testing.assert_allclose(found[-1][0].world, found[-1][1].world, atol=1e-6)
    described = source.frame(0, FrameRequest(wait=True))
    shown.graph.play(2)
    assert wait_until(lambda: source._receiver.store.stamps(["/humans/anna/joints"])[-1] > described.stamp)
    assert source.frame(0, FrameRequest(wait=True)).stamp == described.stamp  # while the page is paused
    assert wait_until(lambda: source.frame(0).stamp > described.stamp)
    with pytest.raises(RosError, match="there is no camera"):
        source.describe("nowhere", 0, 0)


def test_images_that_nobody_looks_at_are_not_received(shown: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    """Cameras render them only while they are shown."""
    monkeypatch.setattr("humansim_ros.view.sources.ros_source._UNWANTED", 0.2)
    source, node = shown.source, shown.graph.node
    assert wait_until(
        lambda: (
            source.frame(0, FrameRequest(["fixed"], ["rgb"])) and node.count_subscribers("/fixed/image_raw")
        )
    )
    assert wait_until(lambda: not node.count_subscribers("/bent/image_raw"))
    assert wait_until(lambda: not node.count_subscribers("/fixed/image_raw"))
    assert node.count_subscribers("/humans/anna/joints")


# --- graphs that lack something


@pytest.fixture
def client(ros: None) -> Iterator[Client]:
    with closing(Client()) as client:
        yield client


def test_an_empty_graph_says_so_and_takes_what_comes(client: Client) -> None:
    """A camera of another program, which is best effort, then people of a live source."""
    from rclpy.qos import QoSProfile, QoSReliabilityPolicy
    from sensor_msgs.msg import CameraInfo, Image, MultiDOFJointState

    from humansim_ros.data.messages import header
    from humansim_ros.data.messages.humans import joints_message
    from humansim_ros.data.messages.images import image_message

    with closing(RosViewSource(estimate="/t/*/poses", namespace="lab", patience=0.1)) as source:
        frame = source.frame(0, FrameRequest([], ["rgb"]))
        assert not frame.joints and not frame.cameras
        assert "Nothing in ROS domain" in source.messages[0]
        assert "Nothing publishes the estimate, /t/*/poses." in source.messages
        qos = QoSProfile(depth=5, reliability=QoSReliabilityPolicy.BEST_EFFORT)
        infos = client.node.create_publisher(CameraInfo, "/lab/eye/camera_info", qos)
        images = client.node.create_publisher(Image, "/lab/eye/image_mono", qos)
        hidden = client.node.create_publisher(CameraInfo, "/other/camera_info", qos)
        info = CameraInfo(width=8, height=6)
        pixels = np.arange(48, dtype=np.uint8).reshape(6, 8)
        stamps = iter(range(10**9, 10**12, 10**7))
        found: list[Any] = []

        def publish() -> None:
            stamp = next(stamps)
            info.header = header(stamp, "eye")
            infos.publish(info)
            hidden.publish(info)
            images.publish(image_message(pixels, "mono8", stamp, "eye"))
            client.executor.spin_once(timeout_sec=0.02)
            found.append(source.frame(0, FrameRequest(list(source.cameras), ["rgb"])))

        assert wait_until(lambda: found and any(found[-1].images.values()), step=publish)
        assert list(source.cameras) == ["lab/eye"]
        np.testing.assert_array_equal(found[-1].images["lab/eye"]["rgb"], np.repeat(pixels[..., None], 3, 2))
        assert any("has no calibration" in text for text in source.messages)
        assert any("has no pose" in text for text in source.messages)
        assert "The graph has no people: no topic is humans/<name>/joints." in source.messages
        state = Scene.load().actors["walker"].at(0.0)
        people = client.node.create_publisher(MultiDOFJointState, "/lab/humans/x/joints", 5)

        def publish_people() -> None:
            people.publish(joints_message(state, next(stamps)))
            publish()

        assert wait_until(lambda: found[-1].joints, step=publish_people)
        assert source.people.keys() == {"lab/x"}
        np.testing.assert_allclose(
            np.sort(found[-1].joints["lab/x"][:, 2, 3]), np.sort(state.positions[:, 2]), atol=1e-9
        )


def test_the_skin_of_an_unknown_body_is_found_while_it_moves(client: Client) -> None:
    """Vertices are received until then."""
    from sensor_msgs.msg import MultiDOFJointState, PointCloud2
    from shape_msgs.msg import Mesh as MeshMessage

    from humansim_ros.data.messages.humans import joints_message, mesh_message, vertices_message
    from humansim_ros.ros.graph.qos import LATCHED

    actor = Scene.load().actors["walker"]
    mesh = replace(actor.human.mesh, vertices=actor.human.mesh.vertices + np.array([0, 0, 0.01]))
    name = "/skin/humans/x"
    client.node.create_publisher(MeshMessage, f"{name}/mesh", LATCHED).publish(mesh_message(mesh))
    joints = client.node.create_publisher(MultiDOFJointState, f"{name}/joints", 5)
    vertices = client.node.create_publisher(PointCloud2, f"{name}/vertices", 5)
    frames = itertools.count()
    with closing(RosViewSource(namespace="skin", patience=0.1)) as source:

        def publish() -> None:
            number = next(frames)
            state, stamp = actor.at(0.1 * number), 10**9 + 10**8 * number
            joints.publish(joints_message(state, stamp))
            vertices.publish(vertices_message(state.vertices, stamp))
            client.executor.spin_once(timeout_sec=0.01)
            source.frame(0)

        def has_skin() -> bool:
            return "skin/x" in source.people and len(source.people["skin/x"].mesh.vertices) == len(
                mesh.vertices
            )

        assert wait_until(has_skin, step=publish)
        human = source.people["skin/x"]
        frame = source.frame(0)
        truth = actor.at((frame.stamp - 10**9) * 1e-9)
        posed = human.pose(frame.joints["skin/x"][: len(human.skeleton)])
        assert np.linalg.norm(posed - truth.vertices, axis=1).mean() < 0.002
        assert "built in" in " ".join(source.messages)


def test_hostile_messages_do_not_end_the_source(client: Client) -> None:
    """Wrong contents are told once; the next good message is shown."""
    from sensor_msgs.msg import CameraInfo, CompressedImage, MultiDOFJointState, PointCloud2
    from shape_msgs.msg import Mesh as MeshMessage
    from std_msgs.msg import String
    from visualization_msgs.msg import Marker, MarkerArray

    from humansim_ros.data.messages import header
    from humansim_ros.data.messages.humans import joints_message

    kinds = {
        "/bad/humans/x/joints": MultiDOFJointState,
        "/bad/humans/x/mesh": MeshMessage,
        "/bad/objects/thing/marker": Marker,
        "/bad/cam/camera_info": CameraInfo,
        "/bad/cam/image_raw/compressed": CompressedImage,
        "/bad/cam/joints": PointCloud2,
        "/bad/cam/joints/legend": String,
        "/bad/poses": MarkerArray,
    }
    publishers = {name: client.node.create_publisher(kind, name, 5) for name, kind in kinds.items()}
    state = Scene.load().actors["walker"].at(0.0)
    stamps = iter(range(10**9, 10**13, 10**8))
    found: list[Any] = []
    with closing(RosViewSource(estimate="/bad/poses", namespace="bad", patience=0.1)) as source:

        def attack() -> None:
            stamp = next(stamps)
            head = header(stamp, "map")
            nan = float("nan")
            wrong = MultiDOFJointState(header=head, joint_names=["a", "b"])
            info = CameraInfo(header=head, width=2**31, height=2**31, k=[nan] * 9)
            picture = CompressedImage(header=head, format="rgb8; jpeg", data=b"\xff\xd8\xff" * 99)
            marker = Marker(header=head, mesh_resource="file:///etc/passwd", type=Marker.MESH_RESOURCE)
            estimate = MarkerArray(markers=[Marker(header=head, type=Marker.SPHERE_LIST)])
            early = header(0, "map")
            early.stamp.sec = -5
            contents: dict[str, Any] = {
                "/bad/humans/x/joints": wrong,
                "/bad/humans/x/mesh": MeshMessage(),
                "/bad/objects/thing/marker": marker,
                "/bad/cam/camera_info": info,
                "/bad/cam/image_raw/compressed": picture,
                "/bad/cam/joints": PointCloud2(header=head, width=2**31, point_step=7),
                "/bad/cam/joints/legend": String(data='{"human": [[]], "joint": 3}'),
                "/bad/poses": estimate,
            }
            for name, message in contents.items():
                publishers[name].publish(message)
            publishers["/bad/humans/x/joints"].publish(MultiDOFJointState(header=early))
            found.append(source.frame(0, FrameRequest(["bad/cam"], ["rgb", JOINTS])))
            client.executor.spin_once(timeout_sec=0.02)

        wrong = {"humans/x/joints", "cam/camera_info", "objects/thing/marker", "poses"}

        def told() -> set[str]:
            return {name for name in wrong for text in source.messages if text.startswith(f"/bad/{name}: ")}

        assert wait_until(lambda: told() == wrong, step=attack), source.messages
        assert not source.people and not found[-1].joints and not source.objects

        def publish() -> None:
            publishers["/bad/humans/x/joints"].publish(joints_message(state, next(stamps)))
            found.append(source.frame(0, FrameRequest(["bad/cam"], ["rgb", JOINTS])))
            client.executor.spin_once(timeout_sec=0.02)

        assert wait_until(lambda: found[-1].joints, step=publish)
        assert any(text.startswith("/bad/humans/x/mesh: ") for text in source.messages)
        assert all(len(text) < 500 for text in source.messages) and len(source.messages) < 30


@pytest.mark.parametrize(("estimate", "namespace"), [("/", ""), ("/a b", ""), (None, "a b")])
def test_names_that_are_no_topics_are_refused(ros: None, estimate: str | None, namespace: str) -> None:
    with pytest.raises(RosError, match="is no "):
        RosViewSource(estimate=estimate, namespace=namespace, patience=0)
