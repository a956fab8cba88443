"""Topics and frames of a camera are those that the image packages of ROS and tf2 expect."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray
from ros_support import Client, rclpy, write_scene

from humansim_ros.data import messages
from humansim_ros.errors import RosError
from humansim_ros.render.interface.channels import CHANNEL_TABLE
from humansim_ros.ros.graph.qos import LATCHED
from humansim_ros.ros.nodes.camera import CameraNode
from humansim_ros.ros.nodes.camera_rig import CameraRigNode
from humansim_ros.ros.nodes.motion_player import MotionPlayerNode
from humansim_ros.ros.nodes.skinner import SkinnerNode

#: A floor and two boxes, seen through a lens, with stereo rectification, binning and a region of interest.
BOXES = """
rate: 20
room: null
light: {shadows: none}
objects:
  floor: {size: [12, 12, 0.2], position: [0, 0, -0.1], color: [90, 120, 60]}
  low: {size: [0.5, 1.2, 0.6], position: [-0.4, 0.3, 0.3], color: [200, 40, 40]}
  high: {size: [0.3, 0.3, 1.6], position: [0.6, -0.7, 0.8], color: [40, 40, 200]}
cameras:
  lens:
    size: [640, 480]
    K: [[410, 0, 330], [0, 405, 236], [0, 0, 1]]
    distortion: [-0.33, 0.1, 0.001, -0.002]
    rectification: [[0.999550, 0, 0.029996], [0, 1, 0], [-0.029996, 0, 0.999550]]
    rectified: [[300, 0, 320, -30], [0, 300, 240, 0], [0, 0, 1, 0]]
    position: [3, 0.4, 1.5]
    look_at: [0, 0, 0.5]
    sensor: {noise: {full_well: 2000}}
    %s
"""
#: Solid boxes of the scene: lower and upper corner.
SOLIDS = np.array(
    [
        [[-6, -6, -0.2], [6, 6, 0]],
        [[-0.65, -0.3, 0], [-0.15, 0.9, 0.6]],
        [[0.45, -0.85, 0], [0.75, -0.55, 1.6]],
    ]
)
IMAGES = ("image_raw", "image_rect", "depth/image", "depth/image_rect", "part/image", "flow_back/image")
INFOS = ("camera_info", "depth/camera_info", "part/camera_info", "flow_back/camera_info")


def started(kind: Any, namespace: str, scene: Path, **parameters: Any) -> Any:
    values = {"scene": str(scene), **parameters}
    given = [rclpy.Parameter(name, value=value) for name, value in values.items()]
    return kind(parameter_overrides=given, namespace=namespace)


def stop(*nodes: Any) -> None:
    for node in nodes:
        node.close()
        node.destroy_node()


@pytest.fixture(scope="module", params=["whole", "part"])
def seen(request: Any, ros: None, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Any]:
    """Messages of one stamp of a camera with a lens: of its whole sensor, and of a part with binning."""
    from sensor_msgs.msg import CameraInfo, Image

    part = "binning: [2, 2]\n    roi: {x: 64, y: 32, width: 480, height: 400}"
    folder = tmp_path_factory.mktemp("boxes")
    node = started(
        CameraNode, request.param, write_scene(folder, BOXES % (part if request.param == "part" else ""))
    )
    client = Client(f"{request.param}_client")
    client.executor.add_node(node)
    for kind, topics in ((Image, IMAGES), (CameraInfo, INFOS)):
        client.subscribe(kind, [f"/{request.param}/lens/{topic}" for topic in topics])
    client.spin_until_matched(node)
    assert client.spin_until(
        lambda: len(client.received) == len(IMAGES) + len(INFOS) and client.common_stamps()
    )
    stamp = client.common_stamps()[0]
    prefix = f"/{request.param}/lens/"
    of_stamp = {topic.removeprefix(prefix): each[stamp] for topic, each in client.received.items()}
    yield SimpleNamespace(messages=of_stamp, camera=node.scene.scene_cameras["lens"], client=client)
    stop(node)
    client.close()


def test_the_calibration_is_beside_each_image(seen: Any) -> None:
    """As image_transport's CameraSubscriber looks for it: camera_info in the namespace of the image."""
    for topic in IMAGES:
        info = seen.messages["/".join([*topic.split("/")[:-1], "camera_info"])]
        assert info.header == seen.messages[topic].header
        assert info == seen.messages["camera_info"]
    publishers = dict(seen.client.node.get_topic_names_and_types())
    for channel in CHANNEL_TABLE.values():
        if not channel.per_body:
            namespace = f"lens/{channel.topic}".rpartition("/")[0]
            assert any(name.endswith(f"/{namespace}/camera_info") for name in publishers), channel.topic


def test_rectified_depth_and_p_give_the_true_surface(seen: Any) -> None:
    """As depth_image_proc computes points. No pixel is between two surfaces."""
    info, image = seen.messages["depth/camera_info"], seen.messages["depth/image_rect"]
    assert (image.encoding, image.width, image.height) == ("32FC1", *seen.camera.camera.size)
    depth = np.frombuffer(bytes(image.data), np.float32).reshape(image.height, image.width).astype(float)
    columns, rows = np.meshgrid(np.arange(image.width), np.arange(image.height))
    u = columns * max(1, info.binning_x) + info.roi.x_offset
    v = rows * max(1, info.binning_y) + info.roi.y_offset
    p, r = np.reshape(info.p, (3, 4)), np.reshape(info.r, (3, 3))
    rays = np.stack([(u - p[0, 2]) / p[0, 0], (v - p[1, 2]) / p[1, 1], np.ones_like(u, float)], axis=-1)
    hit = np.isfinite(depth)
    assert hit.mean() > 0.4
    rectified = rays[hit] * depth[hit, None]
    camera = seen.camera.camera
    points = (rectified @ r - camera.t) @ camera.R
    assert distance_to_surfaces(points).max() < 1e-3
    for solid in range(len(SOLIDS)):  # all of them are seen
        assert (distance_to_surfaces(points, solid) < 1e-3).sum() > 300


def test_rectified_depth_ends_where_image_raw_ends(seen: Any) -> None:
    image, rect = seen.messages["depth/image_rect"], seen.messages["image_rect"]
    depth = np.frombuffer(bytes(image.data), np.float32).reshape(image.height, image.width)
    colour = np.frombuffer(bytes(rect.data), np.uint8).reshape(image.height, image.width, 3)
    beyond = np.isnan(depth)
    assert beyond.any() and not colour[cv2.erode(beyond.astype(np.uint8), np.ones((3, 3))) > 0].any()
    assert np.isinf(depth[~beyond]).any()  # the background


def distance_to_surfaces(points: NDArray[np.float64], solid: int | None = None) -> NDArray[np.float64]:
    """Metres from points (N, 3) to the nearest surface of all solids, or of one."""
    solids = SOLIDS if solid is None else SOLIDS[solid : solid + 1]
    outside = np.maximum(solids[:, None, 0] - points, points - solids[:, None, 1])
    distance = np.where(
        (outside > 0).any(axis=-1),
        np.linalg.norm(outside.clip(min=0), axis=-1),
        -outside.max(axis=-1),
    )
    return np.abs(distance).min(axis=0)


def test_image_rect_is_the_image_that_image_proc_makes_of_image_raw(seen: Any) -> None:
    """image_proc remaps bilinearly, with maps of 1/32 pixel that image_geometry computes for the binned
    sensor and cuts to the region. Few coordinates are rounded to another 1/32 than ours.
    """
    info, raw, rect = (seen.messages[topic] for topic in ("camera_info", "image_raw", "image_rect"))
    binning = np.array([max(1, info.binning_x), max(1, info.binning_y)])
    scale = np.diag([*(1 / binning), 1])
    k, p = scale @ np.reshape(info.k, (3, 3)), scale @ np.reshape(info.p, (3, 4))
    size = (info.width // binning[0], info.height // binning[1])
    whole = cv2.initUndistortRectifyMap(
        k, np.array(info.d), np.reshape(info.r, (3, 3)), p, size, cv2.CV_16SC2
    )
    x, y = np.array([info.roi.x_offset, info.roi.y_offset]) // binning
    cut = np.s_[y : y + raw.height, x : x + raw.width]
    shape = (raw.height, raw.width, 3)
    image = np.frombuffer(bytes(raw.data), np.uint8).reshape(shape)
    made = cv2.remap(image, whole[0][cut] - np.array([x, y], np.int16), whole[1][cut], cv2.INTER_LINEAR)
    published = np.frombuffer(bytes(rect.data), np.uint8).reshape(shape)
    assert image.std() > 20
    assert (published != made).any(axis=2).mean() < 0.003


PEOPLE = """
rate: 20
room: null
humans: {anna: {motion: walk}}
cameras:
  front: {size: [64, 48], position: [3, 0, 1], look_at: [0, 0, 1], distortion: [-0.2, 0.05]}
  side: {size: [64, 48], position: [0, 3, 1], look_at: [0, 0, 1]}
"""
CAMERAS = ("front", "side")
OF_CAMERA = {
    "Image": ("image_raw", "depth/image", "part/image"),
    "CompressedImage": ("image_raw/compressed", "depth/image/compressedDepth"),
    "CameraInfo": ("camera_info", "depth/camera_info"),
    "PointCloud2": ("joints", "boxes", "visible_vertices"),
}


def test_two_simulations_in_namespaces_share_tf(ros: None, tf: dict[str, list[Any]], tmp_path: Path) -> None:
    """Each is complete; all their frames differ, and are in the frame map."""
    from geometry_msgs.msg import PoseStamped, TransformStamped
    from sensor_msgs import msg

    scene = write_scene(tmp_path, PEOPLE)
    client = Client("tf_client")
    nodes = []
    for name in ("one", "two"):
        nodes += [started(kind, name, scene) for kind in (MotionPlayerNode, SkinnerNode)]
        nodes.append(started(CameraRigNode, name, scene, frame_prefix=f"{name}/", start_scene=False))
    everyone = [each for node in nodes for each in node.nodes]
    for each in everyone:
        client.executor.add_node(each)
    frames = {name: {f"{name}/{camera}_optical_frame" for camera in CAMERAS} for name in ("one", "two")}
    static = {t.child_frame_id: t.header.frame_id for transforms in tf["/tf_static"] for t in transforms}
    assert static == dict.fromkeys(frames["one"] | frames["two"], "map")

    expected = {}
    for name in frames:
        of_front = [("Image", "front/image_rect"), ("Image", "front/depth/image_rect")]
        of_each = [
            (k, f"{c}/{topic}") for c in CAMERAS for k, topics in OF_CAMERA.items() for topic in topics
        ]
        for kind, topic in of_front + of_each:
            full = f"/{name}/{topic}"
            client.subscribe(getattr(msg, kind), [full])
            expected[full] = f"{name}/{topic.partition('/')[0]}_optical_frame"
        client.subscribe(msg.MultiDOFJointState, [f"/{name}/humans/anna/joints"])
        latched = [f"/{name}/{camera}/extrinsics" for camera in CAMERAS]
        client.subscribe(TransformStamped, latched, LATCHED)
        expected |= dict.fromkeys([f"/{name}/humans/anna/joints", *latched], "map")
    client.spin_until_matched(*everyone)
    assert client.spin_until(lambda: expected.keys() <= client.received.keys())
    arrived = {topic: next(iter(client.received[topic].values())) for topic in expected}
    assert {topic: message.header.frame_id for topic, message in arrived.items()} == expected
    for name in frames:
        poses = [arrived[f"/{name}/{camera}/extrinsics"] for camera in CAMERAS]
        assert {pose.child_frame_id for pose in poses} == frames[name]

    mover = client.node.create_publisher(PoseStamped, "/two/side/pose", 5)
    pose = messages.pose_message(nodes[2].scene.scene_cameras["side"].pose(0.0), 0)
    client.spin_until_matched(*nodes[-1].nodes)
    mover.publish(pose)
    assert client.spin_until(lambda: tf["/tf"])
    assert {t.child_frame_id for transforms in tf["/tf"] for t in transforms} == {"two/side_optical_frame"}
    stop(*nodes)
    client.close()


def test_the_optical_frame_has_the_name_of_its_parameter(
    ros: None, tf: dict[str, list[Any]], tmp_path: Path
) -> None:
    scene = write_scene(tmp_path, PEOPLE)
    stop(started(CameraNode, "named", scene, frame_id="cam_link"))
    stop(started(CameraNode, "named", scene, frame_id="cam_link", frame_prefix="lab_"))
    assert [t.child_frame_id for ts in tf["/tf_static"] for t in ts] == ["cam_link", "lab_cam_link"]
    for parameter in ("frame_id", "frame_prefix"):
        with pytest.raises(RosError, match=f"parameter {parameter}: frames do not begin with /"):
            started(CameraNode, "named", scene, **{parameter: "/lab"})
