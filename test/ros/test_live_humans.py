"""Live humans: another node moves them, and the motion player gives the stamps of their frames."""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from conftest import ROOT
from rclpy.parameter import Parameter
from ros_support import Client, write_scene
from sensor_msgs.msg import MultiDOFJointState, PointCloud2
from waiting import end_process

from humansim_ros import Scene
from humansim_ros.data import messages
from humansim_ros.data.messages.humans import motion_message
from humansim_ros.ros.nodes.motion_player import MotionPlayerNode
from humansim_ros.ros.nodes.skinner import SkinnerNode, SourceLog
from humansim_ros.ros.tools.first_images import FirstImages
from humansim_ros.scene.core.live import LiveRetargeter

SECOND = 1_000_000_000
#: One human is played, the other is live.
MIXED = """
rate: 20
room: null
humans:
  played: {motion: {file: walk, loop: continue}}
  live: {body: adult_woman, motion: {file: live, position: [1.0, 0.5], yaw_deg: 90}}
cameras:
  front: {size: [160, 120], position: [4, 0, 1.5], look_at: [0, 0, 1]}
"""


def test_a_live_human_of_a_scene_stands_at_rest_at_its_position(tmp_path: Path) -> None:
    actor = Scene.load(write_scene(tmp_path, MIXED)).actors["live"]
    first, later = actor.at(0.0), actor.at(12.3)
    np.testing.assert_allclose(first.joints, later.joints, atol=1e-9)
    assert first.linear is not None and not np.any(np.abs(first.linear) > 1e-6)
    positions = dict(zip(first.joint_names, first.positions, strict=True))
    feet = [place for name, place in positions.items() if "ankle" in name.lower() or "foot" in name.lower()]
    assert np.allclose(np.mean(feet, axis=0)[:2], [1.0, 0.5], atol=0.15)
    assert first.vertices[:, 2].min() == pytest.approx(0.0, abs=0.02)
    wrists = [place for name, place in positions.items() if "wrist" in name.lower()]
    assert all(wrist[2] < 1.0 for wrist in wrists)  # hanging arms, not a T pose
    # it faces +y: its left hand is on the side of -x
    left, right = (positions[name] for name in ("l_shoulder", "r_shoulder"))
    assert left[0] < right[0] - 0.2


@dataclass
class Stage:
    """A player, the skinners of its humans, a client, and a sender of live motion."""

    folder: Path
    namespace: str
    text: str = MIXED
    nodes: list[Any] = field(default_factory=list)

    def __post_init__(self) -> None:
        scene = Parameter("scene", value=str(write_scene(self.folder, self.text)))
        self.player = MotionPlayerNode(parameter_overrides=[scene], namespace=self.namespace)
        self.nodes = [self.player]
        self.client = Client(f"client_of_{self.namespace}")
        self.scene = self.player.scene
        for human in self.scene.actors:
            overrides = [scene, Parameter("human", value=human)]
            name = ["--ros-args", "-r", f"__node:=skinner_{human}"]
            self.nodes.append(
                SkinnerNode(parameter_overrides=overrides, namespace=self.namespace, cli_args=name)
            )
        for node in self.nodes:
            self.client.executor.add_node(node)
        self.joints = {
            human: self.client.received[f"/{self.namespace}/humans/{human}/joints"]
            for human in self.scene.actors
        }
        for human in self.scene.actors:
            topic = f"/{self.namespace}/humans/{human}"
            self.client.subscribe(MultiDOFJointState, [f"{topic}/joints"], 500)
            self.client.subscribe(PointCloud2, [f"{topic}/vertices"], 500)
        self.sender: Any = None

    def send(self, poses: Any, human: str = "live", stamp: int = 0) -> None:
        """Publish live motion. It has a stamp of its own, of another clock."""
        if self.sender is None:
            topic = f"/{self.namespace}/humans/{human}/motion"
            self.sender = self.client.node.create_publisher(MultiDOFJointState, topic, 5)
            assert self.client.spin_until(lambda: self.sender.get_subscription_count() == 1)
        self.sender.publish(motion_message(poses, stamp or 77 * SECOND))

    def newest(self, human: str) -> Any:
        """Newest joints of a human."""
        return messages.read_joints(self.joints[human][max(self.joints[human])])

    def close(self) -> None:
        for node in self.nodes:
            node.destroy_node()
        self.client.close()


@pytest.fixture
def stage(ros: None, tmp_path: Path, request: pytest.FixtureRequest) -> Iterator[Stage]:
    made = Stage(tmp_path, "stage_" + str(abs(hash(request.node.name)) % 10**8))
    yield made
    made.close()


def distance(stage: Stage, human: str, expected: Any) -> float:
    """Largest distance of the newest joints of a human from those of a state, metres."""
    if not stage.joints[human]:
        return np.inf
    return float(np.abs(stage.newest(human).positions[0] - expected.positions).max())


@pytest.mark.slow
def test_a_live_human_has_the_stamps_of_the_player_at_rest_and_in_motion(stage: Stage) -> None:
    played, live = stage.joints["played"], stage.joints["live"]
    actor = stage.scene.actors["live"]
    rest = actor.at(0.0)
    assert stage.client.spin_until(lambda: len(set(played) & set(live)) >= 10)
    assert distance(stage, "live", rest) < 1e-6
    # a pose far from the rest pose, of a person of the same size
    walk = stage.scene.actors["played"]
    pose = replace(walk.joint_poses(0.4), linear=None, angular=None)
    expected = LiveRetargeter(actor, live=True).retarget(pose)
    moved = max(live)

    def follows() -> bool:
        stage.send(pose)
        return distance(stage, "live", expected) < 1e-4

    assert stage.client.spin_until(follows)
    assert distance(stage, "live", rest) > 0.1
    # the stamp of the live source is of another clock: those of the player are used
    assert 77 * SECOND not in live
    count = len(live)
    # a source that is silent again: the body keeps its pose, and frames go on
    assert stage.client.spin_until(lambda: len(live) >= count + 5)
    assert distance(stage, "live", expected) < 1e-4
    common = sorted(set(played) & set(live))
    assert common[-1] > moved
    assert set(live) - set(played) <= {max(live), *sorted(live)[:3]}


@pytest.mark.slow
def test_a_live_human_is_played_when_it_gets_a_motion_and_is_live_again(stage: Stage) -> None:
    def publishers() -> int:
        return int(stage.client.node.count_publishers(f"/{stage.namespace}/humans/live/motion"))

    rest = stage.scene.actors["live"].at(0.0)
    assert stage.client.spin_until(lambda: distance(stage, "live", rest) < 1e-6)
    assert publishers() == 0
    result = stage.player.set_parameters([Parameter("live.motion", value="walk")])
    assert result[0].successful, result[0].reason
    assert stage.client.spin_until(lambda: distance(stage, "live", rest) > 0.3)
    assert publishers() == 1
    result = stage.player.set_parameters([Parameter("live.motion", value="live")])
    assert result[0].successful, result[0].reason
    assert stage.client.spin_until(lambda: publishers() == 0)
    frames = len(stage.joints["live"])
    assert stage.client.spin_until(lambda: len(stage.joints["live"]) >= frames + 10)
    last = sorted(stage.joints["live"])[-5:]
    poses = [messages.read_joints(stage.joints["live"][stamp]).positions for stamp in last]
    assert all(np.array_equal(pose, poses[0]) for pose in poses)  # it keeps its last pose


def test_faulty_live_messages_keep_the_last_pose_and_frames_go_on(stage: Stage) -> None:
    live = stage.joints["live"]
    pose = stage.scene.actors["played"].joint_poses(0.4)
    expected = LiveRetargeter(stage.scene.actors["live"], live=True).retarget(pose)

    def follows() -> bool:
        stage.send(pose)
        return distance(stage, "live", expected) < 1e-4

    assert stage.client.spin_until(follows)
    broken = replace(pose, positions=pose.positions + np.nan)
    before = len(live)

    def goes_on() -> bool:
        stage.send(broken)
        return len(live) >= before + 5

    assert stage.client.spin_until(goes_on)
    assert distance(stage, "live", expected) < 1e-4


def test_a_change_of_the_source_is_logged_at_most_every_ten_seconds() -> None:
    lines: list[str] = []
    log = SourceLog(lines.append, "anna", "/humans/anna/motion")
    for step in range(1250):  # 25 s; two senders from 5 s to 15 s
        seconds = 0.02 * step
        number = 1 if seconds < 5 else 1 + step % 2 if seconds < 15 else 3
        log.add_source(number, f"source {number}", seconds)
    assert lines == ["joint source: source 1", "joint source: source 2", "joint source: source 3"]
    log.add_source(3, "source 3", 100.0)
    assert len(lines) == 3


def test_a_source_that_changes_its_joint_names_has_another_number(tmp_path: Path) -> None:
    actor = Scene.load(write_scene(tmp_path, MIXED)).actors["live"]
    retargeter = LiveRetargeter(actor, live=True)
    poses = actor.joint_poses(0.0)
    numbers = []
    for names in (poses.names, tuple(f"suit:{name}" for name in poses.names), poses.names):
        for _ in range(40):  # more than are needed for the calibration
            retargeter.retarget(replace(poses, names=names))
            numbers.append(retargeter.source_number)
    assert numbers == [1] * 40 + [2] * 40 + [1] * 40


def test_silence_of_a_live_source_is_said_once_with_topic_and_command() -> None:
    lines: list[str] = []
    log = SourceLog(lines.append, "anna", "/humans/anna/motion")
    for step in range(100):
        log.add_frame(False, 0.1 * step)
    assert len(lines) == 1
    assert "/humans/anna/motion" in lines[0] and "at rest" in lines[0]
    assert "python examples/live_mocap.py walk anna" in lines[0]
    for step in range(100, 300):
        log.add_frame(step < 200, 0.1 * step)
    assert len(lines) == 3
    assert "follows" in lines[1] and "keeps its last pose" in lines[2]


def test_the_report_of_the_first_images_names_domain_topics_and_a_next_command(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    first = FirstImages([f"camera_{n}" for n in range(1, 7)], ["anna"], 0.0)
    monkeypatch.setenv("ROS_DOMAIN_ID", "42")
    monkeypatch.setenv("PATH", str(tmp_path))
    text = first.report(2.14)
    assert text.startswith("all 6 cameras deliver, after 2.1 s\n")
    assert "ROS domain 42" in text and "/camera_1/image_raw" in text and "and 2 more" in text
    assert "/humans/anna/joints" in text
    assert text.endswith("in another terminal: humansim view --ros")
    (tmp_path / "ros2").write_text("#!/bin/sh\n")
    (tmp_path / "ros2").chmod(0o755)
    assert "ros2 topic hz /camera_1/image_raw" in first.report(2.14)
    inside = FirstImages(["camera_1"], ["anna"], 0.0, "lab").report(2.14)
    assert "images on /lab/camera_1/image_raw; truth on /lab/humans/anna/joints" in inside
    assert "ros2 topic hz /lab/camera_1/image_raw" in inside
    assert "1 of 6 cameras" in first.progress(first.cameras[1:], 4.0)


@pytest.mark.slow
@pytest.mark.nightly
def test_run_live_says_what_it_waits_for_and_follows_the_example(ros: None, tmp_path: Path) -> None:
    """The two lines of the README, in the folder of the repository."""
    output = tmp_path / "output"
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}
    scene = write_scene(tmp_path, MIXED.replace("file: live, ", ""))
    with output.open("w") as file:
        run = subprocess.Popen(
            [sys.executable, "-m", "humansim_ros.cli", "run", str(scene), "--live", "live"],
            stdout=file,
            stderr=subprocess.STDOUT,
            env=environment,
            cwd=ROOT,
        )
    sender = None
    client = Client("watcher_of_run")
    client.subscribe(MultiDOFJointState, ["/humans/live/joints"])
    try:
        assert client.spin_until(lambda: "stands at rest" in output.read_text()), output.read_text()
        sender = subprocess.Popen(
            [sys.executable, "examples/live_mocap.py", "walk", "live"], env=environment, cwd=ROOT
        )
        assert client.spin_until(lambda: "follows" in output.read_text()), output.read_text()
        assert client.spin_until(lambda: "front delivers, after" in output.read_text())
        seen = client.received["/humans/live/joints"]
        places = set()

        def moves() -> bool:
            if seen:
                places.add(tuple(messages.read_joints(seen[max(seen)]).positions[0, 0].round(3)))
            return len(places) > 20

        assert client.spin_until(moves)
    finally:
        for process in (sender, run):
            if process is not None:
                end_process(process)
        client.close()
    text = output.read_text()
    assert "live: live" not in text and "Traceback" not in text
    assert "live: adult_woman, live: moved by joints on /humans/live/motion" in text
    # a loaded machine drops frames
    warnings = [line for line in text.splitlines() if "[WARN]" in line and "dropped" not in line]
    assert text.count("stands at rest") == 1 and not warnings
