"""examples/mujoco_robot.py: our cameras are where MuJoCo has its robot, and each run is the same."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from conftest import ROOT
from geometry_msgs.msg import TransformStamped
from nav_msgs.msg import Odometry
from ros_support import Client, write_scene
from sensor_msgs.msg import Image

from humansim_ros import Scene
from humansim_ros.data.engine import run
from humansim_ros.data.formats.exporting import Export
from humansim_ros.data.formats.formats import chosen_formats
from humansim_ros.data.formats.plan import ExportPlan
from humansim_ros.data.formats.source import SimulatedSource
from humansim_ros.geometry import quaternion_to_matrix, transform
from humansim_ros.ros.nodes.in_process import InProcessNodes
from humansim_ros.scene.core.simulation import SceneStates

pytest.importorskip("mujoco", reason="MuJoCo is not installed")
sys.path.append(str(ROOT / "examples"))

from mujoco_robot import MujocoRobot, World

SCENE = """
rate: 10
room: null
humans:
  anna: {body: adult_woman, motion: {file: walk, position: [0.3, -1.4], loop: continue}}
  ben: {body: child, motion: {file: wave, position: [-0.8, 0.1], yaw_deg: 180}}
robot: {odometry: /odom, position: [-2.0, 0.0], yaw_deg: 10}
time: {mode: lockstep, wait_for: [{topic: /odom}]}
cameras:
  front: {mount: robot, position: [0.1, 0, 0.9], look_at: [2, 0, 0.9], fov_deg: 80, size: [80, 60]}
"""
FRAMES = 12


@pytest.fixture(scope="module")
def world(tmp_path_factory: pytest.TempPathFactory) -> tuple[Scene, Path]:
    """The scene, and its model for MuJoCo."""
    folder = tmp_path_factory.mktemp("world")
    scene = Scene.load(write_scene(folder, SCENE))
    source = SimulatedSource(scene, tuple(chosen_formats(["mujoco"])))
    run(Export(source, ExportPlan.of(source, range(1))), folder / "out")
    return scene, folder / "out" / "mujoco" / "scene.xml"


class Run:
    """What was sent in a run, and where MuJoCo had the robot and the people at each stamp."""

    def __init__(self, scene: Scene, model: Path) -> None:
        self.robots: dict[int, np.ndarray] = {}
        self.people: dict[int, np.ndarray] = {}
        client = Client()
        client.subscribe(Image, ["/front/image_raw"])
        client.subscribe(Odometry, ["/odom"])
        client.subscribe(TransformStamped, ["/front/extrinsics"])
        robot = MujocoRobot(scene, str(model))
        self._watch(robot)
        nodes = InProcessNodes(scene, "", {"mode": "lockstep", "frames": FRAMES})
        for node in (*nodes.nodes, robot):
            client.executor.add_node(node)
        last = 1 + scene.frame_time(FRAMES - 1)
        try:
            received = client.received
            topics = "/front/image_raw", "/odom", "/front/extrinsics"
            assert client.spin_until(
                lambda: nodes.has_ended and all(last in received[topic] for topic in topics)
            )
        finally:
            for node in (*nodes.nodes, robot):
                client.executor.remove_node(node)
            nodes.close()
            robot.destroy_node()
            client.close()
        self.received: Mapping[str, dict[int, Any]] = client.received

    def _watch(self, robot: MujocoRobot) -> None:
        inner = robot.world.odometry

        def odometry(stamp: int) -> Odometry:
            self.robots[stamp] = np.array(robot.world.data.joint("mujoco_free").qpos)
            self.people[stamp] = np.array(robot.world.data.mocap_pos)
            return inner(stamp)

        robot.world.odometry = odometry  # type: ignore[method-assign]


@pytest.mark.nightly
def test_cameras_are_where_mujoco_has_the_robot(ros: None, world: tuple[Scene, Path]) -> None:
    scene, model = world
    first, second = Run(scene, model), Run(scene, model)
    mount, _ = scene.scene_cameras["front"].mount or (None, None)
    assert mount is not None
    stamps = [1 + scene.frame_time(index) for index in range(FRAMES)]
    assert sorted(first.received["/front/image_raw"]) == stamps
    for stamp in stamps[1:]:
        qpos = first.robots[stamp]
        base = transform(quaternion_to_matrix(qpos[[4, 5, 6, 3]]), qpos[:3])
        place = transform(quaternion_to_matrix(mount.rotation), mount.position)
        link = first.received["/front/extrinsics"][stamp].transform
        p, q = link.translation, link.rotation
        found = transform(quaternion_to_matrix(np.array([q.x, q.y, q.z, q.w])), np.array([p.x, p.y, p.z]))
        np.testing.assert_allclose(found, base @ place, atol=1e-12)
    # it drives, and the physics is no path on a plane
    track = np.array([first.robots[stamp] for stamp in stamps[1:]])
    assert np.linalg.norm(np.diff(track[:, :2], axis=0), axis=1).sum() > 0.1
    assert np.ptp(track[:, 2]) > 1e-5 and np.abs(track[:, 2]).max() < 0.02
    assert (np.abs(track[:, 4:6]) < 0.05).all()  # it stands on its wheels
    # while the robot drives to a frame, people stand where they are in the frame before
    states = SceneStates(scene)
    for index, stamp in enumerate(stamps[1:]):
        expected = np.concatenate(
            [
                state.positions[: len(scene.actors[name].human.skeleton)]
                for name, state in states.at(index).humans.items()
            ]
        )
        np.testing.assert_allclose(first.people[stamp][: len(expected)], expected, atol=1e-9)
    for topic in ("/front/image_raw", "/odom", "/front/extrinsics"):
        one, two = first.received[topic], second.received[topic]
        assert all(one[stamp] == two[stamp] for stamp in stamps[1:]), topic
    np.testing.assert_array_equal(
        [first.robots[stamp] for stamp in stamps[1:]], [second.robots[stamp] for stamp in stamps[1:]]
    )


def test_people_stop_the_rangefinder(world: tuple[Scene, Path]) -> None:
    scene, model = world
    robot = World(scene, str(model))
    ahead = float(robot.data.sensor("mujoco_ahead").data[0])
    yaw = np.radians(10)
    start = np.array([-2, 0, 0.95]) + 0.21 * np.array([np.cos(yaw), np.sin(yaw), 0])
    vertices = SceneStates(scene).at(0).humans["ben"].vertices - start
    along = vertices @ [np.cos(yaw), np.sin(yaw), 0]
    beside = np.abs(vertices @ [-np.sin(yaw), np.cos(yaw), 0])
    hit = (beside < 0.03) & (np.abs(vertices[:, 2]) < 0.03)
    assert hit.any() and ahead == pytest.approx(along[hit].min(), abs=0.03)


@pytest.mark.nightly
def test_a_scene_whose_robot_takes_no_odometry_is_told(tmp_path: Path) -> None:
    scene = write_scene(tmp_path, SCENE.replace("odometry: /odom, ", ""))
    done = subprocess.run(
        [sys.executable, str(ROOT / "examples" / "mujoco_robot.py"), str(scene), "none.xml"],
        capture_output=True,
        text=True,
        check=False,
        cwd=ROOT,
    )
    assert done.returncode == 1 and "odometry: /odom" in done.stderr and "Traceback" not in done.stderr
