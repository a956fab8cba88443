"""The synchronizer of a camera: messages of a scene become its states, and clocks that disagree are named."""

from __future__ import annotations

import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from ros_support import SMALL_SCENE, Client, deliver, write_scene

from humansim_ros.data.messages.headers import scene_time_message
from humansim_ros.data.messages.humans import joints_message, vertices_message
from humansim_ros.ros.nodes import frame_synchronizer
from humansim_ros.ros.nodes.frame_synchronizer import FrameSynchronizer
from humansim_ros.ros.processes.node import SceneNode
from humansim_ros.scene.core.state import SceneState

HUMANS = ("first", "second")
PERIOD = 50_000_000


class Stage:
    """A node with a synchronizer, and the states that it passes on."""

    def __init__(self, scene: Path) -> None:
        from rclpy.parameter import Parameter

        given = {"scene": str(scene), "start_scene": False}
        overrides = [Parameter(name, value=value) for name, value in given.items()]
        self.node = SceneNode("synchronized", parameter_overrides=overrides, namespace="sync")
        self.states: list[SceneState] = []
        self.synchronizer = FrameSynchronizer(self.node, self.states.append, [self.node])
        self.client = Client("sync_client")
        self.client.executor.add_node(self.node)
        self.bodies = {name: actor.at(0.5) for name, actor in self.node.scene.actors.items()}

    def send_vertices(self, human: str, stamp: int, vertices: Any = None) -> None:
        points = self.bodies[human].vertices if vertices is None else vertices
        deliver(self.node, f"humans/{human}/vertices", vertices_message(points, stamp))

    def send(self, human: str, stamp: int) -> None:
        deliver(self.node, f"humans/{human}/joints", joints_message(self.bodies[human], stamp))
        self.send_vertices(human, stamp)

    def send_frame(self, stamp: int) -> None:
        for human in HUMANS:
            self.send(human, stamp)

    def scene_time_of(self, stamp: int) -> int:
        (state,) = (state for state in self.states if state.stamp == stamp)
        return state.scene_time

    def passed_on(self, stamp: int) -> bool:
        return self.client.spin_until(lambda: any(state.stamp == stamp for state in self.states))

    def close(self) -> None:
        self.node.destroy_node()
        self.client.close()


@pytest.fixture
def stage(ros: None, tmp_path: Path) -> Iterator[Stage]:
    made = Stage(write_scene(tmp_path))
    yield made
    made.close()


@pytest.fixture
def noisy_stage(ros: None, tmp_path: Path) -> Iterator[Stage]:
    made = Stage(write_scene(tmp_path, SMALL_SCENE.replace("{size:", "{sensor: {noise: {}}, size:")))
    yield made
    made.close()


def test_frames_go_on_beside_stamps_that_are_ahead_for_ever(
    stage: Stage, capfd: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """They froze after eight of them. The user is told the topic, the seconds and the remedy, but not at
    once: a node that starts or dies leaves such stamps, too.
    """
    start = stage.node.now()
    for number in range(-10, 0):
        stage.send("first", start + number * PERIOD)
        stage.send_vertices("first", start + number * PERIOD + 12_300_000_000)
        stage.send("second", start + number * PERIOD)
        assert stage.passed_on(start + number * PERIOD)
    assert "clocks" not in capfd.readouterr().err
    monkeypatch.setattr(frame_synchronizer, "_CLOCK_DOUBT", 0.0)
    for number in range(30):
        stamp = start + number * PERIOD
        stage.send("first", stamp)
        stage.send_vertices("first", stamp + 12_300_000_000)
        stage.send("second", stamp)
        assert stage.passed_on(stamp)
    (state,) = (state for state in stage.states if state.stamp == stamp)
    np.testing.assert_array_equal(state.vertices["first"], stage.bodies["first"].vertices)
    log = capfd.readouterr().err
    # the frames are sent faster than their period, and the log is throttled
    assert re.search(r"/sync/humans/first/vertices: stamps are 1[1-3]\.\d s ahead of the others", log)
    assert "are the clocks of the hosts synchronised (chrony, NTP)" in log


def test_a_silent_human_is_named(stage: Stage, capfd: pytest.CaptureFixture[str]) -> None:
    start = stage.node.now()
    for human in HUMANS:
        stage.send(human, start)
    assert stage.passed_on(start)
    for number in range(1, 12):
        stage.send("first", start + number * PERIOD)
    log = capfd.readouterr().err
    assert "frames wait for second: is its skinner running?" in log
    assert "clocks" not in log


def test_only_cameras_and_scanners_show_the_scene_at_its_start(
    ros: None, tmp_path: Path, capfd: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Not node ``bridge``, which has no use for it."""
    from rclpy.parameter import Parameter

    monkeypatch.setattr(frame_synchronizer, "_START_SCENE_AFTER", -1.0)
    scene = Parameter("scene", value=str(write_scene(tmp_path)))
    for previews in (False, True):
        node, states = SceneNode("alone", parameter_overrides=[scene]), list[SceneState]()
        try:
            FrameSynchronizer(node, states.append, [node], previews=previews)._await_first_frame()
            assert [state.is_preview for state in states] == [True] * previews
            assert node.has_parameter("start_scene") is previews
        finally:
            node.destroy_node()
        assert ("showing the scene at its start" in capfd.readouterr().err) is previews


def test_vertices_that_are_not_those_of_the_body_are_not_held(
    stage: Stage, capfd: pytest.CaptureFixture[str]
) -> None:
    """Eight large clouds of a stranger would fill the memory of a camera."""
    start = stage.node.now()
    body = stage.bodies["first"].vertices
    stage.send_vertices("first", start, np.zeros((len(body) + 1, 3), np.float32))
    assert "vertices, but the body has" in capfd.readouterr().err
    stage.send_vertices("first", start, np.zeros((100 * len(body), 3), np.float32))
    assert "are read" in capfd.readouterr().err, "it is not even deserialised"
    stage.send_vertices("first", start, np.full_like(stage.bodies["first"].vertices, np.nan))
    stage.send_vertices("first", start, 1e7 + stage.bodies["first"].vertices)
    deliver(stage.node, "humans/first/joints", joints_message(stage.bodies["first"], start))
    stage.send("second", start)
    stage.send("first", start + PERIOD)
    stage.send("second", start + PERIOD)
    assert stage.passed_on(start + PERIOD)
    assert [state.stamp for state in stage.states] == [start + PERIOD]


def test_frames_get_their_scene_time_while_a_player_is_there(stage: Stage) -> None:
    """It comes, and goes, between frames: neither stops the frames of a recording without scene time."""
    from sensor_msgs.msg import TimeReference

    start = stage.node.now()
    stage.send_frame(start)
    assert stage.passed_on(start)
    assert stage.scene_time_of(start) == start, "without a scene time it is the stamp"
    player = stage.client.node.create_publisher(TimeReference, "/sync/scene_time", 5)
    assert stage.client.spin_until(lambda: stage.synchronizer._has_scene_time)
    stage.send_frame(start + PERIOD)
    stage.client.executor.spin_once(0)
    assert start + PERIOD not in [state.stamp for state in stage.states], "it waits for its scene time"
    for scene_time, stamp in ((7, start + PERIOD), (0, start + 2 * PERIOD)):
        player.publish(scene_time_message(scene_time, stamp))
    assert stage.passed_on(start + PERIOD)
    stage.send_frame(start + 2 * PERIOD)
    assert stage.passed_on(start + 2 * PERIOD)
    assert [stage.scene_time_of(start + number * PERIOD) for number in (1, 2)] == [7, 0]
    stage.send_frame(start + 3 * PERIOD)  # the player dies before its scene time arrives
    stage.client.node.destroy_publisher(player)
    assert stage.passed_on(start + 3 * PERIOD)
    stage.send_frame(start + 4 * PERIOD)
    assert stage.passed_on(start + 4 * PERIOD)


def test_first_frame_with_noise_waits_for_a_player_that_is_still_being_discovered(noisy_stage: Stage) -> None:
    """Else its noise would depend on the stamp, and be another one on each run."""
    stage = noisy_stage
    start = stage.node.now()
    stage.send_frame(start)
    stage.client.executor.spin_once(0)
    assert stage.states == []
    deliver(stage.node, "scene_time", scene_time_message(5, start))
    assert stage.passed_on(start)
    assert stage.scene_time_of(start) == 5


def test_recorded_vertices_without_scene_time_are_shown_with_noise(noisy_stage: Stage) -> None:
    start = noisy_stage.node.now()
    noisy_stage.send_frame(start)
    assert noisy_stage.passed_on(start)
    assert noisy_stage.scene_time_of(start) == start
