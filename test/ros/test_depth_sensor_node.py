"""The camera node publishes what the depth sensors of Simulation measure, at the same stamp."""

from __future__ import annotations

from collections.abc import Iterator
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from ros_support import write_scene

from humansim_ros.data import messages
from humansim_ros.scene import Scene, Simulation
from humansim_ros.testing import SceneGraph

SCENE = """
rate: 20
room: null
humans:
  anna: {body: child, motion: walk}
objects:
  wall: {size: [0.1, 4, 3], position: [-1, 0, 1]}
cameras:
  left:
    size: [120, 90]
    position: [2.6, 0.4, 1.2]
    look_at: [0, 0, 0.8]
    stereo: 0.1
    depth_sensor: {preset: azure_kinect_nfov, size: [100, 80]}
"""
NAMES = ("depth_sensor/image_raw", "depth_sensor/points", "aligned_depth_to_color/image_raw", "points")
INFOS = ("depth_sensor/camera_info", "aligned_depth_to_color/camera_info")


@pytest.fixture(scope="module")
def run(ros: None, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Any]:
    scene = Scene.load(write_scene(tmp_path_factory.mktemp("depth"), SCENE))
    topics = ["/rgbd/scene_time", *(f"/rgbd/left/{name}" for name in (*NAMES, *INFOS))]
    topics += ["/rgbd/right/depth/image", "/rgbd/right/camera_info"]
    with SceneGraph(scene, namespace="rgbd") as graph, Simulation(scene, ("rgb", "depth")) as simulation:
        received = {topic.removeprefix("/rgbd/"): graph.subscribe(topic) for topic in topics}
        yield SimpleNamespace(received=received, stamps=graph.play(3), simulation=simulation)


def test_all_messages_of_the_sensor_have_the_stamps_of_frames(run: Any) -> None:
    for name, received in run.received.items():
        assert received.stamps == run.stamps, name


def test_measurements_are_those_of_simulation(run: Any) -> None:
    for stamp in run.stamps:
        time = messages.read_scene_time(run.received["scene_time"].at(stamp))
        frame = run.simulation.frame(round(time * 20 / 1e9))
        capture = frame.depth_sensors["left"]
        raw, points, aligned, colored = (run.received[f"left/{name}"].at(stamp) for name in NAMES)
        # vertices may differ in their last bit, and with them a pixel on an edge
        assert np.mean(messages.read_image(raw) == capture.measured) > 0.995
        assert np.mean(messages.read_image(aligned) == capture.aligned) > 0.995
        assert (capture.measured > 0).mean() > 0.3
        for cloud, truth in ((points, capture.points), (colored, capture.color_points)):
            rows = messages.read_points(cloud, ("x", "y", "z"))
            found = np.stack([rows["x"], rows["y"], rows["z"]], axis=1).reshape(truth.shape)
            assert np.isclose(found, truth, atol=1e-6, equal_nan=True).mean() > 0.99


def test_a_live_pair_has_the_frames_and_matrices_of_a_stereo_camera(run: Any) -> None:
    stamp = run.stamps[-1]
    info, image = (run.received[f"right/{name}"].at(stamp) for name in ("camera_info", "depth/image"))
    assert info.header.frame_id == image.header.frame_id == "left_optical_frame"
    assert info.p[3] == pytest.approx(-0.1 * info.p[0])
