"""The same scene shows the same on every run, whenever it is played and by whatever."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from ros_support import whole_flow, write_scene

from humansim_ros.camera.trajectory import Trajectory
from humansim_ros.ros import messages
from humansim_ros.rotations import unit_quaternions
from humansim_ros.scene import Scene, Simulation
from humansim_ros.scene.live import JointSource, LiveRetargeter

NOISY = """
rate: 20
humans: {anna: {motion: {file: walk, position: [0.0, -1.0]}}}
cameras: {left: {size: [80, 60], position: [3.0, 2.6, 2.0], look_at: [0, 0, 0.8], sensor: {noise: {}}}}
"""


def test_noise_is_that_of_the_scene_time_at_any_stamp(ros: None, tmp_path: Path) -> None:
    from sensor_msgs.msg import Image

    scene = write_scene(tmp_path, NOISY)
    stamps, runs = [], []
    for namespace in ("now", "later"):
        topic = f"/{namespace}/left/image_raw"
        with whole_flow(scene, namespace, {Image: [topic]}, frames=3) as client:
            images = [np.array(image.data) for _, image in sorted(client.received[topic].items())]
            stamps.append(sorted(client.received[topic]))
            runs.append(images)
    assert not set(stamps[0]) & set(stamps[1])
    np.testing.assert_array_equal(runs[0], runs[1])
    with Simulation(Scene.load(scene), ("rgb",)) as simulation:
        for image, frame in zip(runs[0], simulation.frames(3), strict=True):
            np.testing.assert_array_equal(image, frame.views["left"].rgb.ravel())


# --- numbers that were sent are those that were not, to the last bit

KEYFRAMES = """
<animation startframe="0" endframe="20" rate="10"><object name="anna">
<frame number="0"><position x="1" y="2" z="0"/><rotation x="0" y="0" z="30"/></frame>
<frame number="20"><position x="2" y="1" z="0"/><size x="1.2" y="1.2" z="1.2"/></frame></object></animation>
"""


@pytest.mark.parametrize(
    "human",
    [
        "{motion: {file: walk, loop: continue, yaw_deg: 33, speed: 1.3}}",
        "{motion: {file: sit_stand, mirror: true, retarget: thesis}}",
        "{motion: {file: run, clamp: true, pin_feet: true}, skinning: dual_quaternion}",
        "{motion: {file: walk}, keyframes: {file: moves.xml}}",
    ],
)
def test_body_of_sent_joints_has_the_bits_of_simulation(ros: None, tmp_path: Path, human: str) -> None:
    """Through the motion, its legend, and the joints of the body; with and without the legend."""
    (tmp_path / "moves.xml").write_text(KEYFRAMES)
    camera = "{position: [3, 0, 1], look_at: [0, 0, 1]}"
    scene = Scene.load(write_scene(tmp_path, f"humans: {{anna: {human}}}\ncameras: {{left: {camera}}}"))
    actor = scene.actors["anna"]
    told = LiveRetargeter(actor, live=True)
    told.add_legend(messages.read_motion_legend(messages.motion_legend(JointSource.of_actor(actor))))
    with Simulation(scene, ()) as simulation:
        for frame in simulation.frames(40):
            state = frame.humans["anna"]
            poses = actor.joint_poses(scene.frame_time(frame.index) * 1e-9)
            sent = messages.read_joints(messages.motion_message(poses, frame.stamp))
            for retargeter in (told, LiveRetargeter(actor)):
                received = retargeter.retarget(sent, frame.stamp)
                for part in ("joints", "rotations", "linear", "angular", "vertices"):
                    np.testing.assert_array_equal(getattr(received, part), getattr(state, part), part)
            motion = messages.joint_motion(messages.read_joints(messages.joints_message(state, frame.stamp)))
            for part in ("joints", "linear", "angular"):
                np.testing.assert_array_equal(getattr(motion, part), getattr(state, part), part)
            body = messages.read_vertices(messages.vertices_message(state.vertices, frame.stamp))
            np.testing.assert_array_equal(body, state.vertices)


def test_sent_camera_poses_have_the_bits_of_simulation(ros: None, tmp_path: Path) -> None:
    Trajectory.orbit((0.2, 0.1, 1.0), 2.5, 1.7, 3.1).write(tmp_path / "way.txt")
    text = "cameras: {left: {trajectory: {file: way.txt, speed: 0.7, end: loop}}}"
    camera = Scene.load(write_scene(tmp_path, text)).scene_cameras["left"]
    for seconds in np.linspace(0, 6, 100).tolist():
        pose = camera.pose(seconds)
        received = messages.read_pose(messages.pose_message(pose, 1))
        assert pose.velocity is not None
        velocity = messages.read_twist(messages.twist_message(pose.velocity, 1))
        assert velocity is not None
        for one, other in (
            (received.R, pose.R),
            (received.t, pose.t),
            (velocity.linear, pose.velocity.linear),
            (velocity.angular, pose.velocity.angular),
        ):
            np.testing.assert_array_equal(one, other)


def test_only_quaternions_that_are_not_of_length_1_are_changed() -> None:
    rng = np.random.default_rng(3)
    units = rng.normal(size=(1000, 4))
    units /= np.linalg.norm(units, axis=1, keepdims=True)
    np.testing.assert_array_equal(unit_quaternions(units), units)
    np.testing.assert_allclose(unit_quaternions(1.001 * units), units, atol=1e-15)
    assert unit_quaternions(np.array([0.0, 0.0, 0.0, 2.0])).tolist() == [0, 0, 0, 1]
