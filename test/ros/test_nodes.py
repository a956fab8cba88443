"""The nodes in one process: all messages of a frame have the same stamp and belong to it."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from ros_support import Client, Lockstep, deliver, write_scene
from scipy.spatial.transform import Rotation

from humansim_ros.data import messages
from humansim_ros.data.messages.humans import joints_message, motion_message, vertices_message
from humansim_ros.errors import SceneError
from humansim_ros.motion.body.skinning import dominant_bones
from humansim_ros.ros.graph.qos import LATCHED
from humansim_ros.ros.nodes.camera import CameraNode
from humansim_ros.ros.nodes.motion_player import MotionPlayerNode
from humansim_ros.ros.nodes.skinner import SkinnerNode
from humansim_ros.scene import Scene

HUMANS, CAMERAS = ("first", "second"), ("left", "right")
IMAGES = {"image_raw": "rgb8", "depth/image": "32FC1", "instance/image": "mono16", "part/image": "mono8"}


def parameters(**values: Any) -> dict[str, Any]:
    from rclpy.parameter import Parameter

    return {"parameter_overrides": [Parameter(name, value=value) for name, value in values.items()]}


@pytest.fixture(scope="module")
def flow(ros: None, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Any]:
    """Player, two skinners, two cameras and a client in one executor; some seconds of messages."""
    from sensor_msgs.msg import CameraInfo, Image, MultiDOFJointState, PointCloud2

    scene = str(write_scene(tmp_path_factory.mktemp("scene")))
    nodes = [
        MotionPlayerNode(**parameters(scene=scene)),
        *(SkinnerNode(**parameters(scene=scene, human=human)) for human in HUMANS),
        *(CameraNode(**parameters(scene=scene, camera=camera)) for camera in CAMERAS),
    ]
    client = Client()
    for node in nodes:
        client.executor.add_node(node)
    topics = [f"/humans/{human}/{kind}" for human in HUMANS for kind in ("motion", "joints")]
    client.subscribe(MultiDOFJointState, topics)
    client.subscribe(PointCloud2, [f"/humans/{human}/vertices" for human in HUMANS])
    client.subscribe(PointCloud2, [f"/{camera}/joints" for camera in CAMERAS])
    client.subscribe(Image, [f"/{camera}/{kind}" for camera in CAMERAS for kind in IMAGES])
    client.subscribe(CameraInfo, [f"/{camera}/camera_info" for camera in CAMERAS])
    expected = len(topics) + 2 + 2 + 8 + 2
    done = client.spin_until(lambda: len(client.received) == expected and len(client.common_stamps()) >= 12)
    assert done, f"received {sorted(client.received)}, {len(client.common_stamps())} common stamps"
    yield SimpleNamespace(client=client, nodes=nodes, scene=scene)
    for node in nodes:
        node.close()
        node.destroy_node()
    client.close()


def frames(flow: Any) -> Iterator[tuple[int, dict[str, Any]]]:
    for stamp in flow.client.common_stamps():
        yield (
            stamp,
            {topic: by_stamp[stamp] for topic, by_stamp in flow.client.received.items() if stamp in by_stamp},
        )


def camera_of(messages_: dict[str, Any], camera: str, flow: Any) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """K, R, t from received messages only."""
    info = messages_[f"/{camera}/camera_info"]
    transform = flow.extrinsics[camera].transform
    q, p = transform.rotation, transform.translation
    rotation = Rotation.from_quat([q.x, q.y, q.z, q.w]).as_matrix().T
    return np.array(info.k).reshape(3, 3), rotation, -rotation @ [p.x, p.y, p.z]


@pytest.fixture(scope="module")
def late(flow: Any) -> dict[str, Any]:
    """Messages that a late joiner gets."""
    from geometry_msgs.msg import TransformStamped
    from shape_msgs.msg import Mesh
    from std_msgs.msg import Float64MultiArray, String

    late_client = Client("late")
    late_client.subscribe(Mesh, [f"/humans/{human}/mesh" for human in HUMANS], LATCHED)
    late_client.subscribe(TransformStamped, [f"/{camera}/extrinsics" for camera in CAMERAS], LATCHED)
    late_client.subscribe(Float64MultiArray, [f"/{camera}/projection" for camera in CAMERAS], LATCHED)
    legends = [f"/{camera}/{kind}/legend" for camera in CAMERAS for kind in ("instance", "part", "joints")]
    late_client.subscribe(String, legends, LATCHED)
    expected = 2 + 2 + 2 + 6

    def done() -> bool:
        flow.client.executor.spin_once(timeout_sec=0.0)
        return len(late_client.received) == expected

    assert late_client.spin_until(done), f"a late joiner received only {sorted(late_client.received)}"
    received = {topic: next(iter(by_stamp.values())) for topic, by_stamp in late_client.received.items()}
    late_client.close()
    flow.extrinsics = {camera: received[f"/{camera}/extrinsics"] for camera in CAMERAS}
    return received


def test_every_message_of_a_frame_has_the_same_stamp(flow: Any) -> None:
    received = flow.client.received
    played = set(received["/humans/first/motion"])
    for topic, by_stamp in received.items():
        if "markers" not in topic:
            # a topic has only stamps of the player (except a camera that starts before the first frame has
            # arrived, and shows the scene at its start until then)
            arrived = list(by_stamp)  # in the order of arrival
            begun = next(number for number, stamp in enumerate(arrived) if stamp in played)
            assert set(arrived[begun:]) <= played, topic
    assert len(flow.client.common_stamps()) >= 12


def test_frames_are_a_period_apart_to_the_nanosecond(flow: Any) -> None:
    stamps = np.array(sorted(flow.client.received["/humans/first/motion"]))
    steps = (stamps - stamps[0]) / 50_000_000
    assert np.array_equal(steps, np.round(steps))


def test_images_have_their_encodings_sizes_and_frames(flow: Any) -> None:
    for _, frame in frames(flow):
        for camera, size in (("left", (160, 120)), ("right", (200, 150))):
            for kind, encoding in IMAGES.items():
                message = frame[f"/{camera}/{kind}"]
                assert (message.width, message.height, message.encoding) == (*size, encoding)
                assert len(message.data) == message.step * message.height
                assert message.header.frame_id == f"{camera}_optical_frame"
            assert frame[f"/{camera}/camera_info"].header.frame_id == f"{camera}_optical_frame"
        for human in HUMANS:
            assert frame[f"/humans/{human}/joints"].header.frame_id == "map"


def test_joints_projected_with_the_received_camera_are_the_received_2d_joints(flow: Any, late: Any) -> None:
    for _, frame in frames(flow):
        for camera in CAMERAS:
            k, r, t = camera_of(frame, camera, flow)
            cloud = messages.read_joint_view(frame[f"/{camera}/joints"])
            for number, human in enumerate(HUMANS, 1):
                state = messages.read_joints(frame[f"/humans/{human}/joints"])
                optical = state.positions[0] @ r.T + t
                pixels = optical @ k.T
                pixels = pixels[:, :2] / pixels[:, 2:]
                own = cloud[cloud["human"] == number]
                front = optical[:, 2] > 0
                assert np.abs(np.stack([own["u"], own["v"]], -1) - pixels)[front].max() < 1e-3
                assert np.abs(np.stack([own["x"], own["y"], own["z"]], -1) - optical).max() < 1e-5
                assert own["joint"].tolist() == list(range(len(state.names)))


def test_vertices_projected_with_the_received_camera_land_on_their_body(flow: Any, late: Any) -> None:
    checked = missed = 0
    actor = next(iter(Scene.load(flow.scene).actors.values()))
    bones = np.array(actor.human.skeleton.names)[dominant_bones(actor.human.weights)]
    body = ~np.char.endswith(bones, "wrist")  # fingers are thinner than these pixels
    for _, frame in frames(flow):
        for camera in CAMERAS:
            k, r, t = camera_of(frame, camera, flow)
            message = frame[f"/{camera}/instance/image"]
            labels = np.frombuffer(message.data, np.uint16).reshape(message.height, message.width)
            depth_message = frame[f"/{camera}/depth/image"]
            depth = np.frombuffer(depth_message.data, np.float32).reshape(labels.shape)
            for number, human in enumerate(HUMANS, 1):
                optical = messages.read_vertices(frame[f"/humans/{human}/vertices"])[body] @ r.T + t
                pixels = optical @ k.T
                column, row = np.rint(pixels[:, :2] / pixels[:, 2:]).astype(int).T
                inside = (
                    (column >= 1) & (row >= 1) & (column < message.width - 1) & (row < message.height - 1)
                )
                inside &= optical[:, 2] > 0
                column, row, z = column[inside], row[inside], optical[inside, 2]
                # every vertex projects to a pixel of its body, or next to one, unless it is occluded
                hidden = depth[row, column] < z - 0.002
                near = np.zeros(len(row), bool)
                for dy in (-1, 0, 1):
                    for dx in (-1, 0, 1):
                        near |= labels[row + dy, column + dx] == number
                missed += int((~(near | hidden)).sum())
                checked += len(row)
    # except a few at the edges of occluders, where one pixel shows both
    assert checked > 10_000
    assert missed < 0.005 * checked


def test_visible_joints_are_on_their_own_body(flow: Any) -> None:
    seen = 0
    for _, frame in frames(flow):
        for camera in CAMERAS:
            message = frame[f"/{camera}/instance/image"]
            labels = np.frombuffer(message.data, np.uint16).reshape(message.height, message.width)
            cloud = messages.read_joint_view(frame[f"/{camera}/joints"])
            visible = cloud[(cloud["visible"] == 2) & (cloud["behind"] > 0)]
            column, row = np.rint(visible["u"]).astype(int), np.rint(visible["v"]).astype(int)
            assert np.array_equal(labels[row, column], visible["human"])
            outside = cloud[cloud["visible"] == 0]
            inside = (outside["u"] > 0) & (outside["u"] < message.width - 1) & (outside["v"] > 0)
            assert not (inside & (outside["v"] < message.height - 1) & (outside["z"] > 0)).any()
            seen += len(visible)
    assert seen > 100


def test_published_velocities_are_those_of_the_joint_positions(ros: None, tmp_path: Path) -> None:
    """Compared with the adjacent frames: exact up to the acceleration within a period."""
    from sensor_msgs.msg import MultiDOFJointState

    scene = str(write_scene(tmp_path))
    nodes = [
        MotionPlayerNode(**parameters(scene=scene), namespace="speeds"),
        SkinnerNode(**parameters(scene=scene, human="second"), namespace="speeds"),
    ]
    client, topic = Client("speedometer"), "/speeds/humans/second/joints"
    for node in nodes:
        client.executor.add_node(node)
    client.subscribe(MultiDOFJointState, [topic])
    client.spin_until_matched(*nodes)
    lockstep, stamps, received = Lockstep(nodes[0]), [], client.received[topic]
    for _ in range(9):
        stamps.append(lockstep.play())
        assert client.spin_until(lambda: stamps[-1] in received)
    for node in nodes:
        node.destroy_node()
    client.close()
    errors, speeds = [], []
    for before, now, after in zip(stamps, stamps[1:], stamps[2:], strict=False):
        position = {s: messages.read_joints(received[s]) for s in (before, now, after)}
        measured = (position[after].positions - position[before].positions) / 0.1
        if np.abs(measured).max() > 8:  # the motion jumped back to its start
            continue
        assert position[now].linear is not None
        errors.append(np.linalg.norm(position[now].linear - measured, axis=-1))
        speeds.append(np.linalg.norm(measured, axis=-1))
    assert errors
    assert np.median(errors) < 0.05 * np.median(speeds)


def test_a_late_joiner_gets_latched_messages(late: dict[str, Any], flow: Any) -> None:
    mesh = late["/humans/first/mesh"]
    frame = dict(frames(flow).__next__()[1])
    assert len(mesh.vertices) == frame["/humans/first/vertices"].width
    assert max(int(t.vertex_indices.max()) for t in mesh.triangles) < len(mesh.vertices)
    for camera in CAMERAS:
        k, r, t = camera_of(frame, camera, flow)
        p = np.array(late[f"/{camera}/projection"].data).reshape(3, 4)
        assert np.allclose(p, k @ np.column_stack([r, t]), atol=1e-9)
        assert json.loads(late[f"/{camera}/instance/legend"].data) == {
            "0": "background",
            "1": "first",
            "2": "second",
        }
        assert json.loads(late[f"/{camera}/part/legend"].data)["1"] == "HumanoidRoot"
        legend = json.loads(late[f"/{camera}/joints/legend"].data)
        assert legend["joint"]["first"] == frame["/humans/first/joints"].joint_names


def test_markers_are_published_to_subscribers(flow: Any) -> None:
    from visualization_msgs.msg import MarkerArray

    # a separate client: markers have no stamp, and frames would have no stamp in common with them
    watcher = Client("watcher")
    watcher.subscribe(MarkerArray, ["/humans/first/markers"])

    def has_markers() -> bool:
        flow.client.executor.spin_once(timeout_sec=0.0)
        return bool(watcher.received)

    assert watcher.spin_until(has_markers)
    array = next(iter(watcher.received["/humans/first/markers"].values()))
    watcher.close()
    assert {marker.header.frame_id for marker in array.markers} == {"map"}


def test_diagnostics_have_the_times_of_arrival_and_sending(flow: Any) -> None:
    from diagnostic_msgs.msg import DiagnosticArray

    reported: dict[str, dict[str, float]] = {}

    def on_message(message: DiagnosticArray) -> None:
        for status in message.status:
            reported[status.name] = {item.key: float(item.value) for item in status.values}

    subscription = flow.client.node.create_subscription(DiagnosticArray, "/diagnostics", on_message, 20)
    names = {node.get_fully_qualified_name() for node in flow.nodes}
    assert flow.client.spin_until(
        lambda: names <= set(reported) and all(reported[name].get("frames") for name in names)
    )
    flow.client.node.destroy_subscription(subscription)
    for name in names:
        assert reported[name]["lateness_median_ms"] <= reported[name]["lateness_ms"]
    for name in (node.get_fully_qualified_name() for node in flow.nodes if isinstance(node, CameraNode)):
        assert 0 <= reported[name]["arrival_median_ms"] <= reported[name]["lateness_median_ms"]


def test_publishers_have_the_qos_of_rep_2003(flow: Any, late: Any) -> None:
    from rclpy.qos import QoSDurabilityPolicy, QoSReliabilityPolicy

    def qos(topic: str) -> Any:
        (info,) = flow.client.node.get_publishers_info_by_topic(topic)
        return info.qos_profile

    for topic in ("/left/image_raw", "/left/camera_info", "/left/joints", "/humans/first/vertices"):
        assert qos(topic).reliability == QoSReliabilityPolicy.RELIABLE
        assert qos(topic).durability == QoSDurabilityPolicy.VOLATILE
    for topic in ("/left/extrinsics", "/left/projection", "/left/part/legend", "/humans/first/mesh"):
        assert qos(topic).durability == QoSDurabilityPolicy.TRANSIENT_LOCAL


def test_every_parameter_has_a_description_and_limits(flow: Any) -> None:
    for node in flow.nodes:
        own = [name for name in node._parameters if name not in ("use_sim_time",) and "qos" not in name]
        own = [name for name in own if not name.startswith("start_type_description")]
        assert "scene" in own
        for descriptor in node.describe_parameters(own):
            assert descriptor.description, f"{node.get_name()}.{descriptor.name}"
            if descriptor.type == 3:  # double
                assert descriptor.floating_point_range, f"{node.get_name()}.{descriptor.name}"


def test_nothing_is_rendered_without_subscribers(
    ros: None, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    from sensor_msgs.msg import CameraInfo, Image

    requested: list[set[str]] = []
    node = CameraNode(**parameters(scene=str(write_scene(tmp_path)), camera="left"), namespace="lazy")
    render = node._renderer.render

    def watch(request: Any) -> Any:
        requested.append(set(request.channels))
        return render(request)

    monkeypatch.setattr(node._renderer, "render", watch)
    client = Client("lazy")
    client.executor.add_node(node)
    client.subscribe(CameraInfo, ["/lazy/left/camera_info"])
    assert client.spin_until(lambda: len(client.received["/lazy/left/camera_info"]) > 5)
    assert requested == []
    client.subscribe(Image, ["/lazy/left/depth/image"])
    assert client.spin_until(lambda: len(client.received["/lazy/left/depth/image"]) > 2)
    assert {frozenset(channels) for channels in requested} == {frozenset({"depth"})}
    node.close()
    node.destroy_node()
    client.close()


def test_a_camera_alone_renders_the_scene_at_its_start(ros: None, tmp_path: Path) -> None:
    from sensor_msgs.msg import Image

    node = CameraNode(**parameters(scene=str(write_scene(tmp_path))), namespace="alone")
    client = Client("alone")
    client.executor.add_node(node)
    client.subscribe(Image, ["/alone/left/instance/image"])
    assert client.spin_until(lambda: len(client.received["/alone/left/instance/image"]) > 0)
    message = next(iter(client.received["/alone/left/instance/image"].values()))
    assert set(np.unique(np.frombuffer(message.data, np.uint16))) == {0, 1, 2}
    node.close()
    node.destroy_node()
    client.close()


def test_a_skinner_skips_motions_that_it_cannot_use(
    ros: None, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    from sensor_msgs.msg import MultiDOFJointState

    node = SkinnerNode(**parameters(scene=str(write_scene(tmp_path)), human="first"), namespace="outlive")
    client = Client("sender")
    client.executor.add_node(node)
    client.subscribe(MultiDOFJointState, ["/outlive/humans/first/joints"])
    publisher = client.node.create_publisher(MultiDOFJointState, "/outlive/humans/first/motion", 5)
    client.spin_until_matched(node)
    poses = node._actor.joint_poses(0.0)
    broken = motion_message(poses, 1_000)
    broken.transforms[0].translation.x = float("nan")
    stranger = motion_message(poses, 2_000)
    stranger.joint_names[0] = "somebody_else"
    skipped: list[str] = []
    monkeypatch.setattr(node, "report_skipped", skipped.append)
    for number, message in enumerate((broken, stranger), 1):
        publisher.publish(message)
        assert client.spin_until(lambda n=number: len(skipped) == n)
    publisher.publish(motion_message(poses, 3_000))
    assert client.spin_until(lambda: 3_000 in client.received["/outlive/humans/first/joints"])
    assert set(client.received["/outlive/humans/first/joints"]) == {3_000}
    node.destroy_node()
    client.close()


@pytest.mark.parametrize(("node", "key"), [(SkinnerNode, "human"), (CameraNode, "camera")])
def test_a_name_that_the_scene_lacks_is_refused_with_the_names_it_has(
    ros: None, tmp_path: Path, node: type, key: str
) -> None:
    with pytest.raises(SceneError, match=r"nobody.*(first|left)"):
        node(**parameters(scene=str(write_scene(tmp_path)), **{key: "nobody"}))


def test_a_stamp_far_ahead_does_not_end_the_markers(
    ros: None, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    node = SkinnerNode(**parameters(scene=str(write_scene(tmp_path))))
    sent: list[int] = []
    recorder = SimpleNamespace(
        get_subscription_count=lambda: 1,
        publish=lambda message: sent.append(messages.to_nanoseconds(message.markers[0].header.stamp)),
    )
    monkeypatch.setattr(node, "_markers", recorder)
    poses = node._actor.joint_poses(0.5)
    start = node.now() - 10**9
    stamps = [start, start + 10**17, *(start + number * 50_000_000 for number in range(1, 8))]
    for stamp in stamps:
        deliver(node, "humans/first/motion", motion_message(poses, stamp))
    node.destroy_node()
    # ten a second
    assert sent == [*stamps[:3], *stamps[4::2]]


def test_a_camera_follows_a_clock_that_is_set_back(ros: None, tmp_path: Path) -> None:
    """As when a bag is played a second time: its frames are rendered, and do not count as late."""
    from sensor_msgs.msg import Image, MultiDOFJointState, PointCloud2

    node = CameraNode(**parameters(scene=str(write_scene(tmp_path))), namespace="jump")
    client = Client("jumper")
    client.executor.add_node(node)
    client.subscribe(Image, ["/jump/left/part/image"])
    senders = {
        name: (
            client.node.create_publisher(MultiDOFJointState, f"/jump/humans/{name}/joints", 5),
            client.node.create_publisher(PointCloud2, f"/jump/humans/{name}/vertices", 5),
        )
        for name in HUMANS
    }
    client.spin_until_matched(node)
    images = client.received["/jump/left/part/image"]
    for stamp in (20_000_000_000, 1_000_000_000, 1_050_000_000):
        for name, (joints, vertices) in senders.items():
            state = node.scene.actors[name].at(stamp * 1e-9)
            joints.publish(joints_message(state, stamp))
            vertices.publish(vertices_message(state.vertices, stamp))
        shown = client.spin_until(lambda s=stamp: s in images)
        assert shown, f"{stamp} was not shown, only {sorted(images)}"
    node.close()
    node.destroy_node()
    client.close()


def test_frames_of_a_slower_player_do_not_count_as_lost(
    ros: None, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Its rate changes while it plays, from 20 frames per second of the scene to 5."""
    from sensor_msgs.msg import Image, MultiDOFJointState, PointCloud2

    node = CameraNode(**parameters(scene=str(write_scene(tmp_path))), namespace="slow")
    dropped: list[int] = []
    monkeypatch.setattr(
        node, "count", lambda counter, number=1: dropped.append(number * (counter == "drops"))
    )
    client = Client("slow_sender")
    client.executor.add_node(node)
    client.subscribe(Image, ["/slow/left/part/image"])
    senders = {
        (name, kind): client.node.create_publisher(kind, f"/slow/humans/{name}/{topic}", 5)
        for name in HUMANS
        for kind, topic in ((MultiDOFJointState, "joints"), (PointCloud2, "vertices"))
    }
    client.spin_until_matched(node)
    states = {name: actor.at(0.0) for name, actor in node.scene.actors.items()}
    after = []
    for frame in range(16):
        stamp = 9_000_000_000 + (50_000_000 * frame if frame < 6 else 250_000_000 + 200_000_000 * (frame - 5))
        for (name, kind), sender in senders.items():
            make = joints_message if kind is MultiDOFJointState else vertices_message
            state = states[name] if kind is MultiDOFJointState else states[name].vertices
            sender.publish(make(state, stamp))
        assert client.spin_until(lambda s=stamp: s in client.received["/slow/left/part/image"])
        after.append(sum(dropped))
    assert after[5] == 0
    assert after[-1] == after[-6]
    node.close()
    node.destroy_node()
    client.close()
