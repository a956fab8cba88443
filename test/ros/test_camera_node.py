"""Camera nodes behave as drivers of real cameras: lenses, sensors, calibrations, moving cameras."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from keyframe_text import keyframes
from numpy.typing import NDArray
from render_scenes import renderer_or_skip
from ros_support import Client, deliver, rclpy
from scipy.spatial.transform import Rotation
from waiting import PATIENCE

from humansim_ros.cameras import Camera
from humansim_ros.cameras.formats.calibration import read_calibration
from humansim_ros.data import messages
from humansim_ros.data.messages import CameraTopics
from humansim_ros.data.messages.cameras import object_message
from humansim_ros.data.messages.headers import scene_time_message
from humansim_ros.data.messages.humans import joints_message, vertices_message
from humansim_ros.errors import HumansimError
from humansim_ros.motion import hanim_skeleton
from humansim_ros.ros.graph.qos import LATCHED
from humansim_ros.ros.nodes import camera as camera_pose
from humansim_ros.ros.nodes.camera import CameraNode
from humansim_ros.ros.nodes.motion_player import MotionPlayerNode
from humansim_ros.ros.nodes.skinner import SkinnerNode
from humansim_ros.ros.processes.node import SceneNode
from humansim_ros.ros.processes.node_processes import scene_processes
from humansim_ros.scene import Frame, Scene, Simulation
from humansim_ros.scene.core.state import SceneState

PLACE = "size: [128, 96], position: [3, 0.4, 1.4], look_at: [0, 0, 1]"
BENT = "K: [[120, 1, 66], [0, 118, 46], [0, 0, 1]], distortion: [-0.3, 0.09, 0.001, -0.002]"
BLUR = "exposure_time: 0.03, rolling_shutter: 0.0001, samples: 4"
NOISE = "noise: {full_well: 3000}, vignetting: {cos4: true}"
#: The first camera has lens, binning and sensor effects together.
STUDIO = f"""\
rate: 20
room: null
humans:
  anna: {{motion: {{file: walk, position: [0.0, -0.6], loop: continue}}}}
objects:
  box: {{size: [0.2, 0.4, 0.5], position: [0.5, 0, 0.3], keyframes: moves.xml}}
cameras:
  real: {{{PLACE}, {BENT}, binning: [2, 1], sensor: {{{BLUR}, {NOISE}}}}}
  moving: {{size: [96, 80], trajectory: way.txt, sensor: {{encoding: mono8, {BLUR}}}}}
  bgr: {{{PLACE}, sensor: {{encoding: bgr8, jpeg: 90}}}}
  bayer: {{{PLACE}, {BENT}, sensor: {{encoding: bayer_rggb8}}}}
"""
MOVES = keyframes(20, 10, box=((0, -1, 0), (0, 1, 0)))
ENCODINGS = {"real": "rgb8", "moving": "mono8", "bgr": "bgr8", "bayer": "bayer_rggb8"}
TRUTH = {
    "depth": (np.float32, "depth/image"),
    "instance": (np.uint16, "instance/image"),
    "part": (np.uint8, "part/image"),
}
START = 5_000_000_000
SHOWN = (3, 4, 5, 6)


def write_files(folder: Path, scene: str) -> Path:
    """Write a scene, a keyframe file, and a trajectory along a wall with a rotation."""
    (folder / "moves.xml").write_text(MOVES)
    start = Camera.look_at((3, -0.5, 1.3), (0, 0, 1))
    turns = [Rotation.from_rotvec([0, 0, a]) * Rotation.from_matrix(start.R.T) for a in (0.0, 0.2)]
    rows = [
        (t, *position, *rotation.as_quat())
        for t, position, rotation in zip((0, 2), ((3, -0.5, 1.3), (3, 0.5, 1.4)), turns, strict=True)
    ]
    (folder / "way.txt").write_text("\n".join(" ".join(repr(float(n)) for n in row) for row in rows))
    path = folder / "scene.yaml"
    path.write_text(scene)
    return path


class NodeSet:
    """Nodes of a scene and a client in one executor; the client can publish, too."""

    def __init__(self, namespace: str, scene: Path) -> None:
        self.namespace, self.scene = namespace, scene
        self.client = Client(f"{namespace}_client")
        self.received = self.client.received
        self.nodes: list[Any] = []
        self.senders: dict[str, Any] = {}

    def add(self, kind: Callable[..., Any], **parameters: Any) -> Any:
        from rclpy.parameter import Parameter

        values = [
            Parameter(name, value=value) for name, value in {"scene": str(self.scene), **parameters}.items()
        ]
        node = kind(parameter_overrides=values, namespace=self.namespace)
        self.nodes.append(node)
        self.client.executor.add_node(node)
        return node

    def subscribe(self, kind: Any, *topics: str, qos: Any = None) -> None:
        self.client.subscribe(kind, [f"/{self.namespace}/{topic}" for topic in topics], qos)

    def messages_of(self, topic: str) -> dict[int, Any]:
        return self.received[f"/{self.namespace}/{topic}"]

    def next(self, *topics: str, count: int = 1) -> list[int]:
        """Wait for ``count`` stamps from now on at which all these topics have arrived, and return them."""
        now = self.nodes[0].now()

        def common() -> list[int]:
            return sorted(s for s in set.intersection(*(set(self.messages_of(t)) for t in topics)) if s > now)

        assert self.client.spin_until(lambda: len(common()) >= count), f"{topics} did not arrive"
        return common()

    def send(self, topic: str, message: Any) -> None:
        full = f"/{self.namespace}/{topic}"
        if full not in self.senders:
            self.senders[full] = self.client.node.create_publisher(type(message), full, 5)
            self.client.spin_until_matched(*self.nodes)
        self.senders[full].publish(message)

    def call(self, service: str, kind: Any, **fields: Any) -> Any:
        caller = self.client.node.create_client(kind, f"/{self.namespace}/{service}")
        assert self.client.spin_until(caller.service_is_ready)
        future = caller.call_async(kind.Request(**fields))
        assert self.client.spin_until(future.done)
        self.client.node.destroy_client(caller)
        return future.result()

    def close(self) -> None:
        for node in self.nodes:
            node.close()
            node.destroy_node()
        self.client.close()


@pytest.fixture
def make(ros: None, tmp_path: Path) -> Iterator[Callable[[str, str], NodeSet]]:
    made: list[NodeSet] = []

    def make_nodes(namespace: str, scene: str) -> NodeSet:
        made.append(NodeSet(namespace, write_files(tmp_path, scene)))
        return made[-1]

    yield make_nodes
    for one in made:
        one.close()


def pixels(message: Any) -> NDArray[np.uint8]:
    """Pixels (H, W) or (H, W, 3) of an image with 8 bits per sample."""
    image = np.frombuffer(message.data, np.uint8).reshape(message.height, message.step)
    return image if message.step == message.width else image.reshape(message.height, message.width, 3)


# --- published images are those of Simulation


@pytest.fixture(scope="module")
def studio(ros: None, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Any]:
    """Four camera nodes that receive some frames of Simulation."""
    from sensor_msgs.msg import CameraInfo, Image, PointCloud2

    path = write_files(tmp_path_factory.mktemp("studio"), STUDIO)
    simulation = Simulation(Scene.load(path), start=START)
    one = NodeSet("studio", path)
    for name in ENCODINGS:
        one.add(CameraNode, camera=name)
    images = [
        f"{name}/{topic}" for name in ENCODINGS for topic in ("image_raw", *(t for _, t in TRUTH.values()))
    ]
    images += [f"{name}/image_rect" for name in ("real", "bayer")]
    one.subscribe(Image, *images)
    one.subscribe(CameraInfo, *(f"{name}/camera_info" for name in ENCODINGS))
    one.subscribe(PointCloud2, *(f"{name}/joints" for name in ENCODINGS))
    topics = [*images, *(f"{name}/{kind}" for name in ENCODINGS for kind in ("camera_info", "joints"))]
    everything = [f"/studio/{topic}" for topic in topics]
    one.client.spin_until_matched(*one.nodes)
    frames = {}
    for index in SHOWN:
        frame = frames[START + simulation.scene.frame_time(index)] = simulation.frame(index)
        send_frame(one, simulation.scene, frame)
        done = one.client.spin_until(lambda s=frame.stamp: all(s in one.received[t] for t in everything))
        assert done, [t for t in everything if frame.stamp not in one.received[t]]
    yield SimpleNamespace(set=one, scene=simulation.scene, frames=frames)
    one.close()
    simulation.close()


def send_frame(one: NodeSet, scene: Scene, frame: Frame) -> None:
    """Publish a frame as player and skinner do."""
    state, stamp = frame.humans["anna"], frame.stamp
    one.send("scene_time", scene_time_message(scene.frame_time(frame.index), stamp))
    one.send("humans/anna/joints", joints_message(state, stamp))
    box = frame.objects["box"]
    one.send("objects/box/marker", object_message(scene.moving_objects["box"], box, stamp))
    one.send("objects/box/twist", messages.twist_message(box.velocity, stamp))
    pose = scene.scene_cameras["moving"].pose(scene.frame_time(frame.index) * 1e-9)
    one.send("moving/pose", messages.pose_message(pose, stamp))
    one.send("moving/twist", messages.twist_message(pose.velocity, stamp))
    one.send("humans/anna/vertices", vertices_message(state.vertices, stamp))


@pytest.mark.parametrize("name", ENCODINGS)
def test_live_images_equal_those_of_simulation_to_the_byte(studio: Any, name: str) -> None:
    """With lens, binning, blur, shutter, noise, mosaic and compression."""
    for stamp, frame in studio.frames.items():
        view = frame.views[name]
        live = pixels(studio.set.messages_of(f"{name}/image_raw")[stamp])
        assert view.rgb is not None and live.shape == view.rgb.shape
        np.testing.assert_array_equal(live, view.rgb)
        for channel, (kind, topic) in TRUTH.items():
            message = studio.set.messages_of(f"{name}/{topic}")[stamp]
            expected = getattr(view, channel)
            np.testing.assert_array_equal(np.frombuffer(message.data, kind).reshape(expected.shape), expected)
        joints = messages.read_joint_view(studio.set.messages_of(f"{name}/joints")[stamp])
        np.testing.assert_allclose(joints["u"], frame.joints[name]["anna"].pixels[:, 0], atol=1e-4)


def test_images_have_the_encoding_of_their_sensor(studio: Any) -> None:
    for name, encoding in ENCODINGS.items():
        width, height = studio.scene.cameras[name].size
        for stamp in studio.frames:
            message = studio.set.messages_of(f"{name}/image_raw")[stamp]
            assert (message.encoding, message.width, message.height) == (encoding, width, height)
            assert message.step == width * (3 if encoding in ("rgb8", "bgr8") else 1)
            assert len(message.data) == message.step * height
            assert message.header.frame_id == f"{name}_optical_frame"


def test_camera_info_has_the_rendered_lens(studio: Any) -> None:
    stamp = max(studio.frames)
    info = studio.set.messages_of("real/camera_info")[stamp]
    assert (info.width, info.height, info.binning_x, info.binning_y) == (128, 96, 2, 1)
    assert info.distortion_model == "plumb_bob"
    assert list(info.d) == [-0.3, 0.09, 0.001, -0.002, 0.0]
    assert list(info.k) == [120, 1, 66, 0, 118, 46, 0, 0, 1]
    image = studio.set.messages_of("real/image_raw")[stamp]
    assert (image.width, image.height) == (64, 96)
    assert not any(studio.set.messages_of("bgr/camera_info")[stamp].d)


def test_image_rect_is_published_for_distorting_lenses_and_fits_p(studio: Any) -> None:
    count = studio.set.client.node.count_publishers
    assert [count(f"/studio/{name}/image_rect") for name in ENCODINGS] == [1, 0, 0, 1]
    for name in ("real", "bayer"):
        stamp, frame = list(studio.frames.items())[-1]
        rect = studio.set.messages_of(f"{name}/image_rect")[stamp]
        image = pixels(rect)
        assert rect.encoding == "rgb8" and image.shape[2] == 3
        raw = frame.views[name].rgb
        np.testing.assert_array_equal(image, studio.scene.scene_cameras[name].rectify(raw))
        # joints projected with P are on their body
        info = studio.set.messages_of(f"{name}/camera_info")[stamp]
        joints = messages.read_joint_view(studio.set.messages_of(f"{name}/joints")[stamp])
        # fingers are thinner than a pixel
        seen = joints[(joints["visible"] == 2) & (joints["joint"] < len(hanim_skeleton()))]
        points = np.stack([seen["x"], seen["y"], seen["z"], np.ones(len(seen))]).astype(float)
        u, v, w = np.reshape(info.p, (3, 4)) @ points
        columns, rows = u / w / max(info.binning_x, 1), v / w / max(info.binning_y, 1)
        inside = (columns > 0) & (columns < rect.width - 1) & (rows > 0) & (rows < rect.height - 1)
        assert inside.sum() > 5
        columns, rows = columns[inside].round().astype(int), rows[inside].round().astype(int)
        background = image[rect.height // 2, 2].astype(int)
        different = np.abs(image[rows, columns].astype(int) - background).max(axis=1) > 20
        assert different.mean() > 0.8


# --- set_camera_info, camera_info_url

DRIVER = f"""\
room: null
objects: {{post: {{size: [0.2, 0.2, 2], position: [0, 0.3, 1]}}}}
cameras: {{left: {{{PLACE}, {BENT}}}}}
"""
CALIBRATION = """\
image_width: 128
image_height: 96
camera_name: other
camera_matrix: {rows: 3, cols: 3, data: [90, 0, 60, 0, 91, 50, 0, 0, 1]}
distortion_model: equidistant
distortion_coefficients: {rows: 1, cols: 4, data: [0.02, -0.01, 0.001, 0]}
"""


def test_set_camera_info_replaces_and_saves_camera_info_and_changes_no_lens(
    make: Callable[[str, str], NodeSet], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    from sensor_msgs.msg import CameraInfo, Image
    from sensor_msgs.srv import SetCameraInfo

    monkeypatch.setenv("ROS_HOME", str(tmp_path / "ros home"))
    one = make("driver", DRIVER)
    one.add(CameraNode)
    one.subscribe(CameraInfo, "left/camera_info")
    one.subscribe(Image, "left/image_raw")
    stamp = one.next("left/camera_info", "left/image_raw")[-1]
    before, picture = one.messages_of("left/camera_info")[stamp], one.messages_of("left/image_raw")[stamp]

    def request(**changed: Any) -> Any:
        info = CameraInfo(width=128, height=96, distortion_model="equidistant", d=[0.02, -0.01, 0.001, 0.0])
        info.k, info.p = [90.0, 0, 60, 0, 91, 50, 0, 0, 1], [88.0, 0, 61, 0, 0, 88, 49, 0, 0, 0, 1, 0]
        for field, value in changed.items():
            setattr(info, field, value)
        answer = one.call("left/set_camera_info", SetCameraInfo, camera_info=info)
        stamp = one.next("left/camera_info", "left/image_raw", count=2)[-1]
        published, image = (
            one.messages_of("left/camera_info")[stamp],
            one.messages_of("left/image_raw")[stamp],
        )
        assert bytes(image.data) == bytes(picture.data)
        assert answer.status_message
        return answer, published

    nan = float("nan")
    for wrong, reason in (
        ({"width": 64}, "64x96"),
        ({"d": [0.1, nan, 0.0, 0.0]}, "finite"),
        ({"d": [0.1] * 9}, "coefficients"),
        ({"k": [0.0] * 9}, "K"),
        ({"k": [nan, 0, 60, 0, 91, 50, 0, 0, 1]}, "finite"),
        ({"r": [2.0, 0, 0, 0, 1, 0, 0, 0, 1]}, "rotation"),
        ({"p": [-88.0, 0, 61, 0, 0, 88, 49, 0, 0, 0, 1, 0]}, "focal length"),
        ({"distortion_model": "thick"}, "unknown distortion model 'thick'"),
    ):
        answer, info = request(**wrong)
        assert not answer.success
        assert reason in answer.status_message
        assert (list(info.k), list(info.d)) == (list(before.k), list(before.d))
    assert not (tmp_path / "ros home").exists()

    answer, info = request()
    assert answer.success
    assert info.distortion_model == "equidistant"
    assert list(info.d) == [0.02, -0.01, 0.001, 0.0]
    assert list(info.k) == [90, 0, 60, 0, 91, 50, 0, 0, 1]
    assert list(info.p) == [88, 0, 61, 0, 0, 88, 49, 0, 0, 0, 1, 0]
    assert info.header.frame_id == "left_optical_frame"
    saved = read_calibration(tmp_path / "ros home" / "camera_info" / "left.yaml")
    assert list(saved) == ["left"]
    assert saved["left"].model == "equidistant"
    np.testing.assert_array_equal(saved["left"].K, np.reshape(info.k, (3, 3)))
    np.testing.assert_array_equal(saved["left"].rectified_projection, np.reshape(info.p, (3, 4)))

    # a calibration that cannot be saved is published all the same
    monkeypatch.setenv("ROS_HOME", str(tmp_path / "scene.yaml"))
    answer, info = request(k=[95.0, 0, 60, 0, 91, 50, 0, 0, 1])
    assert not answer.success
    assert "not saved" in answer.status_message
    assert info.k[0] == 95


def test_camera_info_url_sets_the_lens_and_published_info_url_sets_camera_info(
    make: Callable[[str, str], NodeSet], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    from sensor_msgs.msg import CameraInfo, Image

    monkeypatch.setenv("ROS_HOME", str(tmp_path))
    (tmp_path / "camera_info").mkdir()
    (tmp_path / "camera_info" / "left.yaml").write_text(CALIBRATION)
    one = make("urls", DRIVER)
    other = make("urls_said", DRIVER)
    one.add(CameraNode, camera_info_url=f"file://{tmp_path}/camera_info/left.yaml")
    other.add(CameraNode, published_info_url="file://${ROS_HOME}/camera_info/${NAME}.yaml")
    pictures, infos = [], []
    for each in (one, other):
        each.subscribe(Image, "left/image_raw")
        each.subscribe(CameraInfo, "left/camera_info")
        stamp = each.next("left/image_raw", "left/camera_info")[-1]
        pictures.append(pixels(each.messages_of("left/image_raw")[stamp]))
        infos.append(each.messages_of("left/camera_info")[stamp])
    for info in infos:
        assert (info.distortion_model, info.k[0]) == ("equidistant", 90)

    def simulated(words: str) -> NDArray[np.uint8]:
        path = tmp_path / "expected.yaml"
        path.write_text(DRIVER.replace(BENT, words))
        simulation = Simulation(Scene.load(path), ["rgb"])
        picture = simulation.frame(0).views["left"].rgb
        simulation.close()
        return picture

    lens = "distortion_model: equidistant, distortion: [0.02, -0.01, 0.001]"
    np.testing.assert_array_equal(pictures[0], simulated(f"K: [[90, 0, 60], [0, 91, 50], [0, 0, 1]], {lens}"))
    np.testing.assert_array_equal(pictures[1], simulated(BENT))


@pytest.mark.parametrize(
    ("parameter", "content", "message"),
    [
        ("camera_info_url", None, "no such calibration file"),
        (
            "camera_info_url",
            CALIBRATION.replace("0.02", ".nan"),
            "distortion_coefficients.data: a number is not",
        ),
        ("camera_info_url", "just: words", "is not a known calibration format"),
        (
            "camera_info_url",
            CALIBRATION.replace("128", "64"),
            "roi: x, y, width, height of 0, 0, 100, 90 is not",
        ),
        ("published_info_url", None, "no such calibration file"),
        ("published_info_url", CALIBRATION.replace("128", "64"), "64x96 pixels, the camera has 128x96"),
    ],
)
def test_an_invalid_calibration_is_an_error_that_names_the_file(
    ros: None, tmp_path: Path, parameter: str, content: str | None, message: str
) -> None:
    from rclpy.parameter import Parameter

    part = ", roi: {width: 100, height: 90}" if parameter == "camera_info_url" else ""
    scene = write_files(tmp_path, DRIVER.replace(BENT, BENT + part))
    if content is not None:
        (tmp_path / "wrong.yaml").write_text(content)
    values = {"scene": str(scene), parameter: f"file://{tmp_path}/wrong.yaml"}
    with pytest.raises(HumansimError, match=message) as caught:
        CameraNode(parameter_overrides=[Parameter(name, value=value) for name, value in values.items()])
    assert "wrong.yaml" in str(caught.value)


def test_a_camera_info_url_without_a_file_ends_the_process_with_code_2(tmp_path: Path) -> None:
    scene = write_files(tmp_path, DRIVER)
    result = subprocess.run(
        [sys.executable, "-m", "humansim_ros.ros.nodes", "camera", "--ros-args", "-p", f"scene:={scene}",
         "-p", "camera_info_url:=file:///gone/left.yaml"],
        capture_output=True, text=True, timeout=PATIENCE, check=False,
    )  # fmt: skip
    assert result.returncode == 2
    assert "error: /gone/left.yaml: no such calibration file" in result.stderr
    assert "Traceback" not in result.stderr


def test_a_scene_for_a_renderer_that_is_not_installed_ends_the_process_with_code_2(
    ros: None, tmp_path: Path
) -> None:
    scene = write_files(tmp_path, f"renderer: pyrender\nroom: null\ncameras: {{left: {{{PLACE}}}}}")
    (tmp_path / "pyrender.py").write_text("raise ImportError('no pyrender here')")
    result = subprocess.run(
        [sys.executable, "-m", "humansim_ros.ros.nodes", "camera", "--ros-args", "-p", f"scene:={scene}"],
        env={**os.environ, "PYTHONPATH": os.pathsep.join([str(tmp_path), os.environ.get("PYTHONPATH", "")])},
        capture_output=True, text=True, timeout=PATIENCE, check=False,
    )  # fmt: skip
    assert result.returncode == 2
    assert "error: pyrender cannot be imported (no pyrender here). Install it: pip install" in result.stderr
    assert "Traceback" not in result.stderr


# --- cameras that move


def pose_of(message: Any) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Rotation (3, 3) and position (3,) of a TransformStamped."""
    p, q = message.transform.translation, message.transform.rotation
    return Rotation.from_quat([q.x, q.y, q.z, q.w]).as_matrix(), np.array([p.x, p.y, p.z])


def points_of(depth: Any, info: Any, extrinsics: Any) -> NDArray[np.float64]:
    """Points (N, 3) in the world from a depth image of an ideal camera, from received messages only."""
    image = np.frombuffer(depth.data, np.float32).reshape(depth.height, depth.width)
    rows, columns = np.nonzero(np.isfinite(image))
    rays = np.linalg.solve(np.reshape(info.k, (3, 3)), np.stack([columns, rows, np.ones(len(rows))]))
    rotation, position = pose_of(extrinsics)
    return (rays * image[rows, columns]).T @ rotation.T + position


WALL = "objects: {wall: {size: [0.1, 40, 40], position: [-2.05, 0, 0]}}\n"
MOVING = f"""\
rate: 20
room: null
{WALL}humans:
  anna: {{motion: {{file: walk, position: [0.0, -0.6], loop: repeat}}}}
cameras:
  one: {{size: [64, 48], trajectory: way.txt, sensor: {{{BLUR}}}}}
  two: {{size: [80, 60], fov_deg: 70, trajectory: {{file: way.txt, offset: 1, end: ping_pong}}}}
"""


def test_trajectories_move_all_cameras_at_the_same_stamp_until_the_player_pauses(
    make: Callable[[str, str], NodeSet], tf: dict[str, list[Any]]
) -> None:
    from geometry_msgs.msg import TransformStamped
    from sensor_msgs.msg import CameraInfo, Image, PointCloud2
    from std_msgs.msg import Float64MultiArray
    from std_srvs.srv import SetBool

    move = make("movers", MOVING)
    player = move.add(MotionPlayerNode)
    for kind, values in ((SkinnerNode, {}), (CameraNode, {"camera": "one"}), (CameraNode, {"camera": "two"})):
        move.add(kind, **values)
    cameras = ("one", "two")
    topics = {
        Image: ("depth/image", "image_raw"), CameraInfo: ("camera_info",), PointCloud2: ("joints",),
        TransformStamped: ("extrinsics",),
    }  # fmt: skip
    for kind, names in topics.items():
        move.subscribe(
            kind, *(f"{c}/{name}" for c in cameras for name in names), qos=rclpy.qos.QoSProfile(depth=100)
        )
    move.subscribe(Float64MultiArray, *(f"{c}/projection" for c in cameras), qos=LATCHED)
    together = [f"{c}/{name}" for c in cameras for names in topics.values() for name in names]
    move.next(*together)
    stamps = move.next(*together, count=6)

    scene = Scene.load(move.scene)
    begun = player.playback_clock._base[0]
    transforms = {
        (t.child_frame_id, messages.to_nanoseconds(t.header.stamp)): t for ts in tf["/tf"] for t in ts
    }
    positions = []
    for stamp in stamps:
        joints = []
        for name in cameras:
            message = move.messages_of(f"{name}/extrinsics")[stamp]
            assert message.header.frame_id == "map"
            assert transforms[f"{name}_optical_frame", stamp] == message
            rotation, position = pose_of(message)
            pose = scene.scene_cameras[name].pose((stamp - begun) * 1e-9)
            np.testing.assert_allclose(rotation.T, pose.R, atol=1e-9)
            np.testing.assert_allclose(position, -pose.R.T @ pose.t, atol=1e-9)
            depth, info = (
                move.messages_of(f"{name}/depth/image")[stamp],
                move.messages_of(f"{name}/camera_info")[stamp],
            )
            shown = points_of(depth, info, message)
            on_the_wall = np.abs(shown[:, 0] + 2) < 2e-3
            assert on_the_wall.mean() > 0.5
            assert shown[~on_the_wall, 0].min(initial=0) > -1  # the person
            cloud = messages.read_joint_view(move.messages_of(f"{name}/joints")[stamp])
            joints.append(np.stack([cloud["x"], cloud["y"], cloud["z"]], -1) @ rotation.T + position)
        # both see the same person at the same position
        np.testing.assert_allclose(joints[0], joints[1], atol=1e-5)
        positions.append(position)
    assert np.abs(np.diff(positions, axis=0)).max() > 0.01
    assert tf["/tf_static"] == []

    assert move.call("motion_player/pause", SetBool, data=True).success
    move.next(*together, count=2)  # on their way
    still = move.next(*together, count=3)
    for name in cameras:
        seen = [move.messages_of(f"{name}/extrinsics")[stamp] for stamp in still]
        assert all(message.transform == seen[0].transform for message in seen)
        pictures = [bytes(move.messages_of(f"{name}/image_raw")[stamp].data) for stamp in still]
        assert len(set(pictures)) == 1
        rotation, position = pose_of(seen[0])
        k = np.reshape(move.messages_of(f"{name}/camera_info")[still[0]].k, (3, 3))
        p = np.reshape(move.messages_of(f"{name}/projection")[0].data, (3, 4))
        np.testing.assert_allclose(p, k @ np.column_stack([rotation.T, -rotation.T @ position]), atol=1e-9)


def test_a_pose_moves_a_camera_and_an_invalid_pose_is_logged(
    make: Callable[[str, str], NodeSet],
    tf: dict[str, list[Any]],
    capfd: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    from geometry_msgs.msg import PoseStamped, TransformStamped
    from sensor_msgs.msg import CameraInfo, Image
    from std_msgs.msg import Float64MultiArray

    monkeypatch.setattr(camera_pose, "_MAX_AHEAD", 2_000_000_000_000)
    one = make("posed", f"rate: 20\nroom: null\n{WALL}cameras: {{left: {{{PLACE}}}}}")
    node = one.add(CameraNode)
    one.subscribe(TransformStamped, "left/extrinsics", qos=LATCHED)
    one.subscribe(Float64MultiArray, "left/projection", qos=LATCHED)
    one.subscribe(CameraInfo, "left/camera_info")
    one.subscribe(Image, "left/depth/image")
    one.next("left/depth/image", "left/camera_info")
    # the static pose is published once
    assert one.client.spin_until(lambda: len(one.messages_of("left/projection")) == 1)
    assert one.client.spin_until(lambda: len(one.messages_of("left/extrinsics")) == 1)
    ((static,),) = tf["/tf_static"]
    assert static == next(iter(one.messages_of("left/extrinsics").values()))
    np.testing.assert_allclose(pose_of(static)[1], (3, 0.4, 1.4), atol=1e-12)
    assert tf["/tf"] == []

    def pose(position: tuple[float, float, float], yaw: float, stamp: int = 0) -> PoseStamped:
        there = Camera.look_at(position, np.array(position) - (np.cos(yaw), np.sin(yaw), 0.1))
        message = messages.pose_message(camera_pose.CameraPose.of(there), stamp)
        assert message.header.frame_id == "map"
        return message

    def is_at(stamp: int, position: Any, error: float = 1e-6) -> bool:
        found = pose_of(one.messages_of("left/extrinsics")[stamp])[1]
        return bool(np.allclose(found, position, rtol=0, atol=error))

    one.send("left/pose", pose((1.5, -0.3, 1.2), 0.2))
    topics = ("left/extrinsics", "left/depth/image", "left/camera_info")
    assert one.client.spin_until(
        lambda: any(is_at(s, (1.5, -0.3, 1.2)) for s in one.messages_of("left/extrinsics"))
    )
    for stamp in one.next(*topics, count=3):
        assert is_at(stamp, (1.5, -0.3, 1.2))
        extrinsics, depth, info = (one.messages_of(topic)[stamp] for topic in topics)
        np.testing.assert_allclose(points_of(depth, info, extrinsics)[:, 0], -2, atol=1e-3)
        rotation, position = pose_of(extrinsics)
        p = np.reshape(one.messages_of("left/projection")[0].data, (3, 4))
        k = np.reshape(info.k, (3, 3))
        np.testing.assert_allclose(p, k @ np.column_stack([rotation.T, -rotation.T @ position]), atol=1e-9)
        assert [extrinsics] in tf["/tf"]
    assert tf["/tf_static"][-1] == []  # late joiners do not get the old pose

    # between two poses
    now = node.now()
    one.send("left/pose", pose((1.5, 0, 1.2), 0, now - 100_000_000_000))
    one.send("left/pose", pose((3.5, 0, 2.2), 0, now + 900_000_000_000))
    # a busy node has frames from before the second pose
    assert one.client.spin_until(
        lambda: any(is_at(s, (1.7, 0, 1.3), 1e-2) for s in one.messages_of("left/extrinsics"))
    )
    for stamp in one.next(*topics, count=2):
        share = (stamp - now + 1e11) / 1e12
        assert is_at(stamp, (1.5 + 2 * share, 0, 1.2 + share))
        np.testing.assert_allclose(
            points_of(one.messages_of(topics[1])[stamp], info, one.messages_of(topics[0])[stamp])[:, 0],
            -2,
            atol=1e-3,
        )

    # an invalid pose does not move it
    one.send("left/pose", pose((2, 0, 1), 0, now + 1_000_000_000_000))
    stranger, nan, bent = (pose((9, 9, 9), 0) for _ in range(3))
    stranger.header.frame_id, nan.pose.position.y, bent.pose.orientation.w = "odom", float("nan"), 2.0
    capfd.readouterr()
    for wrong in (stranger, nan, bent):
        one.send("left/pose", wrong)
        for stamp in one.next(*topics, count=2):
            assert pose_of(one.messages_of("left/extrinsics")[stamp])[1].max() < 4
    log = capfd.readouterr().err
    assert "pose not used: a camera's pose must be in map, this is in 'odom'" in log


def test_a_pose_of_another_clock_moves_a_camera_and_does_not_fix_it(
    ros: None, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    """One pose years ahead, a sender whose clock is ahead, and a sender whose clock is right."""
    scene = Scene.load(write_files(tmp_path, f"room: null\n{WALL}cameras: {{left: {{{PLACE}}}}}"))
    node = SceneNode("posed", scene)
    camera = scene.scene_cameras["left"]
    publisher = camera_pose.CameraPosePublisher(node, camera, CameraTopics(scene, camera))
    now = node.now()

    def send(x: float, stamp: int) -> None:
        there = camera_pose.CameraPose.of(Camera.look_at((x, 0, 1), (0, 0, 1)))
        deliver(node, "left/pose", messages.pose_message(there, stamp))

    def x_at(stamp: int) -> float:
        state = SceneState(
            stamp=stamp,
            scene_time=0,
            scene=scene,
            actors={},
        )
        pose = publisher.shot(state).pose_at(0.0)
        return float((-pose.R.T @ pose.t)[0])

    period = 50_000_000
    send(2.0, now)
    assert x_at(now) == pytest.approx(2.0)
    send(2.5, now + 10**17)
    assert x_at(now + period) == pytest.approx(2.5)
    for number in range(2, 30):
        send(2.5 + 0.01 * number, now + number * period + 10**10)
        assert x_at(now + number * period) == pytest.approx(2.5 + 0.01 * number)
    for number in range(30, 33):
        send(0.1 * number, now + number * period)
        assert x_at(now + number * period) == pytest.approx(0.1 * number)
    # poses of a recording, which is older than the frames
    send(1.5, 7 * period)
    assert x_at(now + 33 * period) == pytest.approx(1.5)
    node.destroy_node()
    assert "/left/pose: stamps are 100000000.0 s ahead of the frames" in capfd.readouterr().err


def test_a_camera_with_rare_poses_counts_as_moving_between_them(
    make: Callable[[str, str], NodeSet], monkeypatch: pytest.MonkeyPatch
) -> None:
    """The static scene is cached only for a camera that rests for a while."""
    from sensor_msgs.msg import Image

    monkeypatch.setattr(camera_pose, "_MOVING_FOR", 1000_000_000_000)
    one = make("restless", f"rate: 20\nroom: null\n{WALL}cameras: {{left: {{{PLACE}}}}}")
    node = one.add(CameraNode)
    moving_flags: list[bool] = []
    render = node._renderer.render

    def watch(request: Any) -> Any:
        moving_flags.append(request.moving_camera)
        return render(request)

    monkeypatch.setattr(node._renderer, "render", watch)
    one.subscribe(Image, "left/image_raw")
    one.next("left/image_raw", count=2)
    assert not any(moving_flags)
    for x in (1.0, 1.1, 1.2):
        there = Camera.look_at((x, 0, 1), (0, 0, 1))
        one.send("left/pose", messages.pose_message(camera_pose.CameraPose.of(there), node.now()))
        one.next("left/image_raw", count=4)
    assert moving_flags[-8:] == [True] * 8
    monkeypatch.setattr(camera_pose, "_MOVING_FOR", 50_000_000)
    assert one.client.spin_until(lambda: moving_flags[-2:] == [False] * 2)


def test_motion_blur_follows_the_velocity_of_the_camera_not_its_last_pose(
    make: Callable[[str, str], NodeSet],
) -> None:
    """A camera that has shown the start of the scene, and a player that seeks backwards: both jump."""
    from sensor_msgs.msg import Image

    moving = f"{{size: [64, 48], trajectory: way.txt, sensor: {{{BLUR}}}}}"
    one = make("late_camera", DRIVER.partition("cameras")[0] + f"cameras: {{one: {moving}}}")
    node = one.add(CameraNode)
    one.subscribe(Image, "one/image_raw")
    assert one.client.spin_until(lambda: len(one.messages_of("one/image_raw")) > 0)
    camera, start = Scene.load(one.scene).scene_cameras["one"], node.now() + 200_000_000
    pictures = []
    for number, seconds in enumerate((0.6, 0.2, 0.6)):
        stamp, pose = start + number * 50_000_000, camera.pose(seconds)
        one.send("one/pose", messages.pose_message(pose, stamp))
        one.send("one/twist", messages.twist_message(pose.velocity, stamp))
        assert one.client.spin_until(lambda s=stamp: s in one.messages_of("one/image_raw"))
        pictures.append(pixels(one.messages_of("one/image_raw")[stamp]))
    np.testing.assert_array_equal(pictures[0], pictures[2])
    assert not np.array_equal(pictures[0], pictures[1])


def test_with_pyrender_there_are_only_the_topics_that_it_supports(
    make: Callable[[str, str], NodeSet],
) -> None:
    """A subscriber to an unsupported topic, such as a recorder of all topics, does not disturb others."""
    from sensor_msgs.msg import Image, PointCloud2

    renderer_or_skip(name="pyrender").close()
    scene = f"renderer: pyrender\nroom: null\nhumans: {{anna: {{}}}}\ncameras: {{left: {{{PLACE}}}}}"
    one = make("other", scene)
    one.add(CameraNode)
    images = ("left/image_raw", "left/depth/image", "left/amodal/anna/image")
    one.subscribe(Image, *images, "left/face/image", "left/alpha/anna/image", "left/flow/image")
    one.subscribe(PointCloud2, "left/boxes", "left/joints", "left/visible_vertices")
    one.next(*images, "left/boxes", "left/joints", "left/visible_vertices")
    for topic in ("face/image", "alpha/anna/image", "flow/image", "shadow/image"):
        assert one.client.node.count_publishers(f"/other/left/{topic}") == 0


def test_depth_alone_is_rendered_once_a_frame_whatever_the_sensor(
    make: Callable[[str, str], NodeSet], monkeypatch: pytest.MonkeyPatch
) -> None:
    from sensor_msgs.msg import Image

    one = make(
        "once",
        f"room: null\n{WALL}cameras: {{left: {{{PLACE}, sensor: {{exposure_time: 0.03, samples: 64}}}}}}",
    )
    node = one.add(CameraNode)
    requested: list[set[str]] = []
    render = node._renderer.render

    def watch(request: Any) -> Any:
        requested.append(set(request.channels))
        return render(request)

    monkeypatch.setattr(node._renderer, "render", watch)
    one.subscribe(Image, "left/depth/image")
    one.next("left/depth/image", count=3)
    # some rendered images may still be on their way
    assert one.client.spin_until(lambda: len(requested) == len(one.messages_of("left/depth/image")))
    assert requested.count({"depth"}) == len(requested)
    one.subscribe(Image, "left/image_raw")
    one.next("left/image_raw", "left/depth/image")
    assert {"rgb"} in requested


# --- rigs

RIG = {
    name: {
        "k": [[0.0], [0.0], [0.0]], "p": [[0.0], [0.0]], "R": [[-1, 0, 0], [0, 0, -1], [0, -1, 0]],
        "T": [[x], [2500.0], [1500.0]], "fx": 60.0, "fy": 60.0, "cx": 32.0, "cy": 24.0,
    }
    for name, x in (("0", 0.0), ("1", 500.0))
}  # fmt: skip


@pytest.mark.nightly
def test_the_cameras_of_a_rig_run_as_nodes(ros: None, tmp_path: Path) -> None:
    from sensor_msgs.msg import CameraInfo

    (tmp_path / "rig.json").write_text(json.dumps(RIG))
    scene = tmp_path / "scene.yaml"
    scene.write_text(
        f"room: null\n{WALL}rig: {{file: rig.json, size: [64, 48]}}\ncameras: {{last: {{{PLACE}}}}}\n"
    )
    cameras = [n.parameters["camera"] for n in scene_processes(scene, 9) if n.executable == "camera"]
    assert cameras == ["camera_0", "camera_1", "last"]
    client = Client("rig_client")
    client.subscribe(CameraInfo, [f"/{name}/camera_info" for name in cameras])
    with (tmp_path / "output").open("w") as output:
        command = [sys.executable, "-m", "humansim_ros.cli", "run", str(scene)]
        process = subprocess.Popen(command, stdout=output, stderr=subprocess.STDOUT)
        try:
            done = client.spin_until(lambda: len(client.received) == len(cameras))
            assert done, (tmp_path / "output").read_text()
        finally:
            process.send_signal(signal.SIGINT)
            process.wait(PATIENCE)
    info = next(iter(client.received["/camera_1/camera_info"].values()))
    assert (info.width, info.height, info.k[0]) == (64, 48, 60.0)
    client.close()


def test_a_missing_rig_file_is_an_error_before_any_process_starts(tmp_path: Path) -> None:
    (tmp_path / "scene.yaml").write_text("rig: rig.json\n")
    with pytest.raises(HumansimError, match="no such file"):
        scene_processes(tmp_path / "scene.yaml")
