"""The node of the example tracker, examples/tracker/node.py: in lockstep, and calibrations that it reads."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from conftest import ROOT
from geometry_msgs.msg import Quaternion, TransformStamped
from rclpy.parameter import Parameter
from ros_support import Client, write_scene
from sensor_msgs.msg import CameraInfo, Image, MultiDOFJointState

from humansim_ros import Scene
from humansim_ros.cameras import Trajectory
from humansim_ros.motion.body.skeleton import DETAIL_BONES
from humansim_ros.ros.nodes.camera_rig import CameraRigNode
from humansim_ros.ros.nodes.motion_player import MotionPlayerNode
from humansim_ros.ros.nodes.skinner import SkinnerNode

sys.path.insert(0, str(ROOT / "examples" / "tracker"))

from mediapipe_detector import MediaPipeDetector
from node import TrackerNode, camera_of, image_size
from truth_detector import TruthDetector

SCENE = """
rate: 20
room: null
humans: {anna: {motion: {file: walk, loop: continue}}}
cameras:
  left: {size: [160, 120], position: [3, 1, 1.5], look_at: [0, 0, 1]}
  right: {size: [160, 120], position: [-1, 3, 1.5], look_at: [0, 0, 1], distortion: [-0.2, 0.05]}
  behind: {size: [160, 120], position: [-2.5, -1.5, 1.8], look_at: [0, 0, 1]}
  orbiting: {size: [160, 120], fov_deg: 60, trajectory: orbit.txt}
"""
FRAMES = 8
PERFECT = {"pixel_noise": 0.0, "dropped_joints": 0.0, "false_joints": 0.0, "dropped_people": 0.0,
           "false_people": 0.0}  # fmt: skip


def test_the_tracker_takes_part_in_lockstep_unchanged(ros: None, tmp_path: Path) -> None:
    """Static, distorted and moving cameras; every frame has a message, and its stamp."""
    Trajectory.orbit((0, 0, 1), 3.5, 1.6, 8.0, start=-1.0).write(tmp_path / "orbit.txt")
    scene = Scene.load(write_scene(tmp_path, SCENE))

    def given(**values: Any) -> dict[str, Any]:
        overrides = [Parameter(name, value=value) for name, value in values.items()]
        return {"parameter_overrides": overrides, "namespace": "tracked"}

    client, topic = Client("client_of_tracked"), "/tracked/tracker/poses"
    client.subscribe(MultiDOFJointState, [topic, "/tracked/humans/anna/joints"])
    tracker = TrackerNode(TruthDetector, **given(cameras=["left", "right", "behind", "orbiting"], **PERFECT))
    player = MotionPlayerNode(
        **given(scene=str(scene.path), mode="lockstep", frames=FRAMES, wait_for=[f"topic:{topic}"])
    )
    nodes = [player, SkinnerNode(scene=scene, **given()), CameraRigNode(scene, **given())]
    for node in (*nodes, *nodes[2].members, tracker):
        client.executor.add_node(node)
    try:
        last = 1 + (FRAMES - 1) * 50_000_000
        assert client.spin_until(lambda: player.exit_code is not None and last in client.received[topic])
    finally:
        for node in (tracker, *reversed(nodes)):
            client.executor.remove_node(node)
            if node is not tracker:
                node.close()
            node.destroy_node()
        client.close()
    assert player.exit_code == 0
    truth = client.received["/tracked/humans/anna/joints"]
    # cameras show the scene in real time before the player starts: that is another run
    poses = {stamp: each for stamp, each in client.received[topic].items() if stamp < 10**12}
    assert list(poses) == [1 + frame * 50_000_000 for frame in range(FRAMES)]
    assert [len(message.joint_names) for message in poses.values()][:2] == [0, 0]  # nobody is confirmed yet
    errors = []
    for stamp in list(poses)[2:]:
        joints = dict(zip(truth[stamp].joint_names, truth[stamp].transforms, strict=True))
        assert len(poses[stamp].joint_names) > 0.8 * len(joints)
        assert poses[stamp].header.frame_id == "map"
        for name, transform in zip(poses[stamp].joint_names, poses[stamp].transforms, strict=True):
            identity, joint = name.split("/")
            assert identity == "1"
            if joint.removesuffix("_end") in DETAIL_BONES:
                continue  # a finger may be seen by one camera only: it is predicted
            a, b = transform.translation, joints[joint].translation
            errors.append(np.linalg.norm([a.x - b.x, a.y - b.y, a.z - b.z]))
    assert 1e3 * np.mean(errors) < 0.5


def test_region_and_binning_of_a_sensor_are_taken_into_account() -> None:
    info = CameraInfo(
        width=640, height=480, k=[500.0, 0, 320, 0, 500, 240, 0, 0, 1], binning_x=2, binning_y=2
    )
    info.roi.x_offset, info.roi.y_offset, info.roi.width, info.roi.height = 100, 40, 400, 200
    upright = TransformStamped()
    upright.transform.rotation = Quaternion(w=1.0)
    camera = camera_of(info, upright.transform)
    assert camera.matrix.tolist() == [[250, 0, 110], [0, 250, 100], [0, 0, 1]]
    assert image_size(info) == (200, 100)


@pytest.mark.parametrize(
    "wrong",
    [{"k": [0.0] * 9}, {"k": [float("nan")] * 9}, {"distortion_model": "thin_prism"}, {"d": [float("inf")]}],
)
def test_calibrations_that_cannot_be_used_are_refused(wrong: dict[str, Any]) -> None:
    good = {"width": 640, "height": 480, "k": [500.0, 0, 320, 0, 500, 240, 0, 0, 1]}
    message = TransformStamped()
    for quaternion in (Quaternion(w=0.0), Quaternion(w=float("nan"))):
        message.transform.rotation = quaternion
        with pytest.raises(ValueError):
            camera_of(CameraInfo(**good), message.transform)
    message.transform.rotation = Quaternion(w=1.0)
    camera_of(CameraInfo(**good), message.transform)
    with pytest.raises(ValueError, match=r"lens model|not finite"):
        camera_of(CameraInfo(**{**good, **wrong}), message.transform)


class SeenPeople:
    """Stands in for MediaPipe: one person, and the image that was given."""

    def __init__(self) -> None:
        self.image = np.zeros(0)

    def find(self, camera: str, image: Any) -> list[list[list[float]]]:
        self.image = image
        return [[[float(joint), 2.0 * joint, 0.49 if joint % 2 else 0.5] for joint in range(33)]]


@pytest.mark.parametrize("encoding", ["rgb8", "bgr8"])
def test_mediapipe_gets_rgb_images_and_gives_joints_that_it_sees(encoding: str) -> None:
    pixels = np.random.default_rng(0).integers(0, 256, (4, 5, 3), dtype=np.uint8)
    rows = np.pad(pixels.reshape(4, 15), ((0, 0), (0, 3)))  # with bytes that fill the rows
    message = Image(height=4, width=5, step=18, encoding=encoding, data=rows.tobytes())
    people = SeenPeople()
    found = MediaPipeDetector(people).detect("left", message, (5, 4))
    np.testing.assert_array_equal(people.image, pixels if encoding == "rgb8" else pixels[..., ::-1])
    assert found.shape == (1, 33, 2)
    np.testing.assert_array_equal(found[0, ::2], [[joint, 2 * joint] for joint in range(0, 33, 2)])
    assert np.isnan(found[0, 1::2]).all()


@pytest.mark.parametrize(
    ("change", "problem"),
    [({"encoding": "mono8"}, "rgb8 or bgr8"), ({"step": 12}, "bytes"), ({"height": 9}, "bytes")],
)
def test_images_that_mediapipe_cannot_take_are_refused(change: dict[str, Any], problem: str) -> None:
    message = Image(**{"height": 4, "width": 5, "step": 15, "encoding": "rgb8", "data": bytes(60), **change})
    with pytest.raises(ValueError, match=problem):
        MediaPipeDetector(SeenPeople()).detect("left", message, (5, 4))
