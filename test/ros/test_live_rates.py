"""Live cameras with rates of their own: in lockstep they send the pictures of Simulation, and no others; in
real time, those of the frames that the player has sent.
"""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from rclpy.parameter import Parameter
from ros_support import Client, rclpy
from sensor_msgs.msg import CameraInfo, TimeReference
from waiting import PATIENCE

from humansim_ros.data import messages
from humansim_ros.ros.nodes.camera_rig import CameraRigNode
from humansim_ros.ros.nodes.motion_player import MotionPlayerNode
from humansim_ros.ros.processes.runtime import make_executor
from humansim_ros.scene import Scene, Simulation
from humansim_ros.testing import SceneGraph

PERIOD = 50_000_000
#: Frames in which the cameras take pictures, of a scene at 20 Hz.
PICTURES = {"full": range(9), "third": range(1, 9, 3), "left": range(2, 9, 4), "right": range(2, 9, 4)}
CAMERAS: dict[str, Any] = {
    "full": {},
    "third": {"rate": 6.667, "offset": 0.05},
    "left": {"rate": 5, "offset": 0.1},
}


def scene_dict(cameras: dict[str, Any]) -> dict[str, Any]:
    place = {"size": [32, 24], "position": [4, 0, 1.5], "look_at": [0, 0, 1]}
    cameras = {name: place | own for name, own in cameras.items()}
    if "left" in cameras:
        cameras["left"] |= {"stereo": 0.1, "sensor": {"noise": {"read_noise": 4}}}
    humans = {"anna": {"body": "child", "motion": "walk"}}
    return {"rate": 20, "room": None, "humans": humans, "cameras": cameras}


@pytest.fixture
def graph(humansim_domain: int) -> Iterator[SceneGraph]:
    with SceneGraph(Scene.from_dict(scene_dict(CAMERAS))) as graph:
        yield graph


def stamps_of(received: Any) -> list[int]:
    return [messages.to_nanoseconds(each.header.stamp) for each in received]


def test_nodes_send_the_pictures_of_simulation_in_their_frames(graph: SceneGraph) -> None:
    images = {name: graph.subscribe(f"{name}/image_raw") for name in PICTURES}
    infos = {name: graph.subscribe(f"{name}/camera_info") for name in PICTURES}
    truth, flow = graph.subscribe("third/joints"), graph.subscribe("third/flow/image", every_frame=False)
    joints = graph.subscribe("humans/anna/joints")
    played = graph.play(9)
    assert played == stamps_of(joints) == [1 + PERIOD * index for index in range(9)]
    for name, pictures in PICTURES.items():
        expected = [1 + PERIOD * index for index in pictures]
        assert stamps_of(images[name]) == stamps_of(infos[name]) == expected
    assert stamps_of(truth) == stamps_of(images["third"])
    with Simulation(graph.scene, ("rgb", "depth", "instance", "part", "flow")) as simulation:
        for index in range(9):
            frame = simulation.frame(index)
            for name, view in frame.views.items():
                assert bytes(images[name].at(frame.stamp).data) == view.rgb.tobytes()
            if index == 1:
                assert stamps_of(flow)[:2] == [frame.stamp, frame.stamp + 3 * PERIOD]
                assert np.array_equal(messages.read_image(flow[0]), frame.views["third"].flow, equal_nan=True)


def test_frames_without_a_picture_wait_for_no_answer(humansim_domain: int) -> None:
    from geometry_msgs.msg import PoseArray
    from sensor_msgs.msg import Image

    scene = Scene.from_dict(scene_dict({"third": CAMERAS["third"]}))
    with SceneGraph(scene, limit=10) as graph:
        tracker = rclpy.create_node("tracker")
        poses = tracker.create_publisher(PoseArray, "poses", 10)
        answer = lambda image: poses.publish(PoseArray(header=image.header))  # noqa: E731
        tracker.create_subscription(Image, "third/image_raw", answer, 10)
        graph.add_node(tracker)
        answers = graph.subscribe("poses")
        graph.play(6)
        assert stamps_of(answers) == [1 + PERIOD, 1 + 4 * PERIOD]
        graph.remove_node(tracker)
        tracker.destroy_node()


def test_in_real_time_each_camera_takes_the_first_frame_of_each_of_its_periods(
    ros: None, tmp_path: Path
) -> None:
    """This is the frame of its grid, unless a busy player has skipped it."""
    (tmp_path / "scene.yaml").write_text(yaml.safe_dump(scene_dict(CAMERAS) | {"humans": {}}))
    overrides = [Parameter("scene", value=str(tmp_path / "scene.yaml"))]
    player = MotionPlayerNode(parameter_overrides=overrides)
    rig = CameraRigNode(parameter_overrides=[*overrides, Parameter("start_scene", value=False)])
    client = Client(executor=make_executor())
    client.subscribe(TimeReference, ["/scene_time"])
    client.subscribe(CameraInfo, [f"/{name}/camera_info" for name in PICTURES])
    for node in (player, *rig.nodes):
        client.executor.add_node(node)
    client.spin_until_matched(player, *rig.nodes)
    client.received.clear()
    infos = {name: client.received[f"/{name}/camera_info"] for name in PICTURES}
    assert client.spin_until(lambda: min(map(len, infos.values())) >= 6)
    player.playing.timer.cancel()
    assert client.spin_until(lambda: player.playback_clock.last in client.received["/scene_time"])
    sent = {messages.read_frame_number(each): stamp for stamp, each in client.received["/scene_time"].items()}
    first_index, first_stamp = next(iter(sent.items()))
    assert all(stamp - first_stamp == PERIOD * (index - first_index) for index, stamp in sent.items())
    for name, pictures in PICTURES.items():
        begin = min(stamp for stamp in infos[name] if stamp >= first_stamp)
        stamps = {index: stamp for index, stamp in sent.items() if stamp >= begin}
        periods = {(index - pictures.start) // pictures.step: index for index in reversed(stamps)}
        expected = {stamps[index] for index in periods.values()}
        assert client.spin_until(lambda name=name, expected=expected: max(infos[name]) >= max(expected))
        assert {stamp for stamp in infos[name] if stamp >= begin} == expected
    for node in (player, rig):
        node.close()
        node.destroy_node()
    client.close()


@pytest.mark.slow
@pytest.mark.nightly
def test_a_run_in_lockstep_records_exactly_the_pictures(ros: None, tmp_path: Path) -> None:
    rosbags_highlevel = pytest.importorskip("rosbags.highlevel")
    (tmp_path / "scene.yaml").write_text(yaml.safe_dump(scene_dict(CAMERAS)))
    command = [sys.executable, "-m", "humansim_ros.cli", "run", str(tmp_path / "scene.yaml"), "--lockstep"]
    command += ["--frames", "9", "--record", str(tmp_path / "bag")]
    done = subprocess.run(command, capture_output=True, text=True, timeout=3 * PATIENCE, check=False)
    assert done.returncode == 0, done.stdout + done.stderr
    assert "third: 32x24, 6.66667 Hz from 0.05 s on" in done.stdout
    found: dict[str, list[tuple[int, bytes]]] = {}
    with rosbags_highlevel.AnyReader([tmp_path / "bag"]) as reader:
        for connection, _, data in reader.messages():
            message = reader.deserialize(data, connection.msgtype)
            if connection.topic.endswith(("image_raw", "anna/joints", "scene_time")):
                pixels = message.data.tobytes() if hasattr(message, "data") else b""
                stamp = message.header.stamp.sec * 10**9 + message.header.stamp.nanosec
                found.setdefault(connection.topic, []).append((stamp, pixels))
    whole = [1 + PERIOD * index for index in range(9)]
    for topic in ("/scene_time", "/humans/anna/joints"):
        assert [stamp for stamp, _ in found[topic]] == whole
    with Simulation(Scene.load(tmp_path / "scene.yaml"), ("rgb",)) as simulation:
        for name, pictures in PICTURES.items():
            frames = [simulation.frame(index) for index in pictures]
            expected = [(frame.stamp, frame.views[name].rgb.tobytes()) for frame in frames]
            assert found[f"/{name}/image_raw"] == expected
