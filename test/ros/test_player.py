"""Control of the motion player while it plays: parameters, services, and rejected values."""

from __future__ import annotations

import json
import os
import re
import shutil
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from conftest import ROOT
from ros_support import Client, write_scene
from scipy.spatial.transform import Rotation
from waiting import PATIENCE, wait_until

from humansim_ros.data import messages
from humansim_ros.errors import HumansimError, HumansimWarning, RosError
from humansim_ros.motion import read_bvh
from humansim_ros.motion.body.kinematics import JointPoses
from humansim_ros.ros.graph.qos import LATCHED
from humansim_ros.ros.nodes.motion_player import MotionPlayerNode
from humansim_ros.ros.nodes.skinner import SkinnerNode
from humansim_ros.ros.playing.clock import PlaybackClock, Tick
from humansim_ros.ros.processes.runtime import make_executor
from humansim_ros.scene import Scene
from humansim_ros.scene.config.config import MotionConfig
from humansim_ros.scene.core.playback import Playback

HUMANS = ("first", "second")
SECOND = 1_000_000_000
WALK = ROOT / "assets" / "motions" / "walk.bvh"


# The clock, without ROS


def due(clock: PlaybackClock, seconds: float) -> Tick:
    tick = clock.due(round(seconds * SECOND))
    assert tick is not None
    return tick


def test_frames_are_due_at_start_plus_round_k_periods() -> None:
    clock = PlaybackClock(rate=30)
    start = due(clock, 5.0).stamp
    for frame in range(1, 100):
        tick = due(clock, 5.0 + frame / 30)
        assert (tick.stamp, tick.dropped) == (start + round(frame * SECOND / 30), 0)
        assert tick.elapsed == tick.stamp - start
    assert clock.due(tick.stamp + 1_000_000) is None
    assert due(clock, 5.0 + 110 / 30).dropped == 10


def test_scene_time_stops_while_paused_and_continues_without_a_jump() -> None:
    clock = PlaybackClock(rate=10)
    due(clock, 1.0), due(clock, 1.1)
    clock.pause(True)
    still = [due(clock, 1.2), due(clock, 1.3)]
    assert {(tick.elapsed, tick.pace) for tick in still} == {(SECOND // 10, 0.0)}
    clock.pause(False)
    clock.set_speed(0.5)
    assert due(clock, 1.4).elapsed == 0.15 * SECOND
    assert (due(clock, 1.5).elapsed, clock.speed) == (0.2 * SECOND, 0.5)
    clock.set_speed(0.0)
    assert (due(clock, 1.6).elapsed, due(clock, 1.7).elapsed) == (0.2 * SECOND, 0.2 * SECOND)


def test_steps_show_frames_at_once_and_their_stamps_do_not_run_ahead() -> None:
    clock = PlaybackClock(rate=30)
    due(clock, 1.0)
    clock.pause(True)
    stamps = []
    for step in range(1, 61):
        now = SECOND + 1000 * step
        tick = clock.step(now)
        assert tick.elapsed == round(step * SECOND / 30)
        stamps.append(tick.stamp)
        assert tick.stamp == now
    assert due(clock, 1.04).elapsed == tick.elapsed
    assert np.all(np.diff(stamps) > 0)


def test_seeking_shows_that_time_at_once_and_continues_from_there() -> None:
    clock = PlaybackClock(rate=20, seconds=3.0)
    assert due(clock, 9.0).elapsed == 3 * SECOND
    clock.seek(7.25)
    tick = clock.cut(round(9.01 * SECOND))
    assert (tick.stamp, tick.elapsed) == (9.01 * SECOND, 7.25 * SECOND)
    assert due(clock, 9.06).elapsed == 7.3 * SECOND


@pytest.mark.parametrize(("before", "after"), [(30.0, 0.1), (0.1, 1000.0), (20.0, 20.0)])
def test_stamps_rise_and_time_runs_on_when_the_rate_changes(before: float, after: float) -> None:
    clock = PlaybackClock(before)
    first = due(clock, 1.0)
    early = first.stamp - 5  # a frame may be sent a little early
    clock.set_rate(after)
    tick = clock.cut(early)
    assert tick.stamp == first.stamp + 1
    assert tick.elapsed == first.elapsed + 1
    assert due(clock, 1.0 + 1 / after).stamp == tick.stamp + round(SECOND / after)


def test_no_frame_is_due_before_simulated_time_has_started() -> None:
    assert PlaybackClock(rate=10).due(0) is None


def test_a_slow_clock_sends_frames_when_they_are_due() -> None:
    clock = PlaybackClock(rate=0.1)
    due(clock, 100.0)
    assert clock.due(109 * SECOND) is None
    assert due(clock, 109.999).stamp == 110 * SECOND
    assert clock.due(round(110.1 * SECOND)) is None


# Playback, without ROS


@pytest.fixture(scope="module")
def scene(tmp_path_factory: pytest.TempPathFactory) -> Scene:
    return Scene.load(write_scene(tmp_path_factory.mktemp("played")))


def hips(poses: JointPoses) -> np.ndarray:
    return poses.positions[0, 0]


def test_without_changes_the_scene_is_played_as_its_file_says(scene: Scene) -> None:
    playback = Playback(scene)
    for frame in (300, 0, 7):
        elapsed = scene.frame_time(frame)
        for name, poses in playback.show(elapsed).motions.items():
            expected = scene.actors[name].joint_poses(elapsed * 1e-9)
            np.testing.assert_array_equal(poses.positions, expected.positions)
            np.testing.assert_array_equal(poses.linear, expected.linear)


def test_velocities_are_per_second_of_the_wall(scene: Scene) -> None:
    playback = Playback(scene)
    plain, fast, still = (playback.show(SECOND // 2, pace).motions["first"] for pace in (1.0, 2.5, 0.0))
    assert plain.linear is not None and plain.angular is not None
    np.testing.assert_array_equal(fast.linear, 2.5 * plain.linear)
    np.testing.assert_array_equal(fast.angular, 2.5 * plain.angular)
    np.testing.assert_array_equal(still.linear, 0 * plain.linear)
    np.testing.assert_array_equal(still.positions, plain.positions)


@pytest.mark.parametrize("speeds", [(3.0, 0.25), (0.0, 2.0)])
def test_at_another_speed_a_motion_continues_from_its_position(
    scene: Scene, speeds: tuple[float, ...]
) -> None:
    """Also after speed 0; the other human is not affected."""
    playback, elapsed = Playback(scene), 7 * SECOND // 10
    played = 0.7
    for speed in speeds:
        before = playback.show(elapsed).motions
        playback.change("first", speed=speed)
        after = playback.show(elapsed).motions
        np.testing.assert_allclose(after["first"].positions, before["first"].positions, atol=1e-9)
        np.testing.assert_array_equal(after["second"].positions, before["second"].positions)
        elapsed += SECOND
        played += speed
        expected = scene.actors["first"].joint_poses(played).positions
        np.testing.assert_allclose(playback.show(elapsed).motions["first"].positions, expected, atol=1e-9)


def test_another_motion_begins_at_its_start_and_after_rewind_equals_that_of_the_scene_file(
    scene: Scene,
) -> None:
    """For "second", whose offset of half a second is relative to the start of the scene."""
    playback = Playback(scene)
    config = MotionConfig(
        file="walk", loop="none", position=(-0.5, 0.8), yaw_deg=-20, anchor="center", offset=0.5
    )
    expected = scene.actors["second"].with_motion(config, scene.source)
    playback.show(3 * SECOND // 2)
    playback.change("second", file="walk", loop="none")
    assert playback.settings["second"] == config
    for later in (0.0, 0.4):
        now = playback.show(round((1.5 + later) * SECOND)).poses["second"]
        np.testing.assert_allclose(now.positions, expected.motion.sample(later).positions, atol=1e-9)
    playback.rewind()
    again = playback.show(3 * SECOND // 10).motions["second"]
    np.testing.assert_array_equal(again.positions, expected.joint_poses(0.3).positions)


def test_another_loop_keeps_the_position_in_the_repetition(scene: Scene) -> None:
    """A walk repeats every two seconds; in its third repetition it changes to walking on the spot."""
    playback = Playback(scene)
    playback.show(round(4.9 * SECOND))
    playback.change("first", loop="repeat")
    shown = playback.show(round(4.9 * SECOND)).motions["first"].positions
    np.testing.assert_allclose(shown, scene.actors["first"].joint_poses(0.9).positions, atol=1e-9)


def test_settings_of_a_file_are_not_used_for_another_file_but_return_with_it(tmp_path: Path) -> None:
    text = "humans: {giant: {motion: {file: walk, unit: 0.02, start: 0.5, speed: 2.0}}}\n"
    text += "cameras: {c: {position: [3, 0, 1], look_at: [0, 0, 1]}}\n"
    playback = Playback(Scene.load(write_scene(tmp_path, text)))

    def height() -> float:
        return float(np.ptp(playback.show(0).motions["giant"].positions[0, :, 2]))

    assert 3.0 < height() < 3.6
    playback.change("giant", file="walk_straight")
    assert playback.settings["giant"] == MotionConfig(file="walk_straight", speed=2.0)
    assert 1.5 < height() < 1.8
    playback.change("giant", file="walk")
    assert playback.settings["giant"] == playback.scene.config.humans["giant"].motion
    assert 3.0 < height() < 3.6


def test_hand_keys_with_times_are_for_the_file_of_the_scene(tmp_path: Path) -> None:
    text = "humans: {anna: {motion: {file: talk, hands: [{pose: fist, time: 3}]}}}\n"
    text += "cameras: {c: {position: [3, 0, 1], look_at: [0, 0, 1]}}\n"
    playback = Playback(Scene.load(write_scene(tmp_path, text)))
    of_scene = playback.settings["anna"].hands
    assert of_scene is not None
    playback.change("anna", file="walk")  # of 2 s
    assert playback.settings["anna"].hands is None
    playback.change("anna", file="talk")
    assert playback.settings["anna"].hands == of_scene
    playback.elapsed = 1_300_000_000
    before = playback.human_pose("anna").position
    playback.change("anna", hands=["fist"])
    np.testing.assert_allclose(playback.human_pose("anna").position, before, atol=1e-9)  # it goes on
    playback.change("anna", file="walk")
    assert [key.pose for key in playback.settings["anna"].hands or ()] == ["fist"]


# With ROS


class PlayerClient:
    """A player with a client that receives its motions, sets its parameters and calls its services."""

    def __init__(self, folder: Path, namespace: str, skinner: bool = False) -> None:
        from rclpy.parameter import Parameter
        from rclpy.parameter_client import AsyncParameterClient
        from sensor_msgs.msg import MultiDOFJointState, TimeReference
        from std_msgs.msg import String

        scene = [Parameter("scene", value=str(write_scene(folder)))]
        #: Folder besides that of the scene whose files may be named.
        self.motions = folder.parent / f"{namespace}_motions"
        self.motions.mkdir(exist_ok=True)
        folders = Parameter("motion_folders", value=[str(self.motions)])
        self.player = MotionPlayerNode(parameter_overrides=[*scene, folders], namespace=namespace)
        self.nodes = [self.player]
        if skinner:
            self.nodes.append(SkinnerNode(parameter_overrides=scene, namespace=namespace))
        self.client = Client(f"{namespace}_client", make_executor())  # as in node processes
        for node in self.nodes:
            self.client.executor.add_node(node)
        self.namespace = namespace
        self.parameters = AsyncParameterClient(self.client.node, f"/{namespace}/motion_player")
        topics = [f"/{namespace}/humans/{human}/{kind}" for human in HUMANS for kind in ("motion", "joints")]
        self.client.subscribe(MultiDOFJointState, topics)
        self.client.subscribe(TimeReference, [f"/{namespace}/scene_time"])
        self.client.subscribe(String, [f"/{namespace}/humans/first/motion/legend"], LATCHED)
        self.frames(2)

    def messages_of(self, human: str = "first", kind: str = "motion") -> dict[int, Any]:
        return self.client.received[f"/{self.namespace}/humans/{human}/{kind}"]

    def frames(self, count: int, human: str = "first", kind: str = "motion") -> list[tuple[int, JointPoses]]:
        """The first ``count`` frames that the player sends from now on."""
        sent = self.player.playback_clock.last or 0

        def later() -> list[tuple[int, Any]]:
            return sorted(item for item in self.messages_of(human, kind).items() if item[0] > sent)

        assert self.client.spin_until(lambda: len(later()) >= count), "no frames arrive"
        return [(stamp, messages.read_joints(message)) for stamp, message in later()[:count]]

    def of_stamp(self, stamp: int, human: str = "first", kind: str = "motion") -> JointPoses:
        assert self.client.spin_until(lambda: stamp in self.messages_of(human, kind))
        return messages.read_joints(self.messages_of(human, kind)[stamp])

    def scene_time_of(self, stamp: int) -> int:
        times = self.client.received[f"/{self.namespace}/scene_time"]
        assert self.client.spin_until(lambda: stamp in times)
        return messages.read_scene_time(times[stamp])

    def wait(self, future: Any) -> Any:
        assert self.client.spin_until(future.done)
        return future.result()

    def set(self, together: bool = True, **values: Any) -> str:
        """Set parameters through the service, as ``ros2 param set`` does; the reason of a refusal, or ""."""
        from rclpy.parameter import Parameter

        named = [Parameter(name.replace("__", "."), value=value) for name, value in values.items()]
        assert self.client.spin_until(self.parameters.services_are_ready)
        result = self.wait(self.parameters.set_parameters_atomically(named)).result
        assert result.successful == (not result.reason)
        return str(result.reason)

    def get(self, *names: str) -> list[Any]:
        from rclpy.parameter import parameter_value_to_python

        return [parameter_value_to_python(v) for v in self.wait(self.parameters.get_parameters(names)).values]

    def call(self, service: str, kind: Any, **fields: Any) -> Any:
        caller = self.client.node.create_client(kind, f"/{self.namespace}/motion_player/{service}")
        assert self.client.spin_until(caller.service_is_ready)
        answer = self.wait(caller.call_async(kind.Request(**fields)))
        self.client.node.destroy_client(caller)
        return answer

    def close(self) -> None:
        for node in self.nodes:
            node.destroy_node()
        self.client.close()


@pytest.fixture(scope="module")
def steered(ros: None, tmp_path_factory: pytest.TempPathFactory) -> Iterator[PlayerClient]:
    client = PlayerClient(tmp_path_factory.mktemp("player"), "steer", skinner=True)
    yield client
    client.close()


@pytest.fixture
def player(steered: PlayerClient) -> Iterator[PlayerClient]:
    """The player, reset after the test to the values of the scene."""
    from std_srvs.srv import SetBool

    yield steered
    steered.call("pause", SetBool, data=False)
    assert steered.set(motion="walk", mirror=False, first__loop="continue", first__speed=1.0) == ""
    assert steered.set(second__motion="walk_straight", second__loop="repeat") == ""
    assert steered.set(rate=20.0, speed=1.0, seek=0.0) == ""


def stamp_of(answer: Any) -> int:
    """Stamp in the answer of a service."""
    stamp = json.loads(answer.message)["stamp"]
    return int(stamp["sec"]) * SECOND + int(stamp["nanosec"])


def moves(frames: list[tuple[int, JointPoses]]) -> bool:
    return bool(np.abs(frames[0][1].positions - frames[-1][1].positions).max() > 1e-3)


def test_a_paused_player_shows_the_same_pose_with_new_stamps_and_steps_by_frames(
    player: PlayerClient,
) -> None:
    from std_srvs.srv import SetBool, Trigger

    paused = player.call("pause", SetBool, data=True)
    assert paused.success
    still = player.frames(4)
    assert not moves(still)
    assert np.all(np.diff([stamp for stamp, _ in still]) > 0)
    assert still[-1][1].linear is not None
    assert np.abs(still[-1][1].linear).max() == 0
    start = player.player.playback_clock.elapsed
    for step in (1, 2, 3):
        answer = player.call("step", Trigger)
        assert answer.success
        assert json.loads(answer.message)["scene_time"] == pytest.approx(start * 1e-9 + 0.05 * step, abs=1e-9)
        shown = player.of_stamp(stamp_of(answer), "second")
        expected = player.player.scene.actors["second"].joint_poses((start + 50_000_000 * step) * 1e-9)
        np.testing.assert_allclose(shown.positions, expected.positions, atol=1e-9)
        assert player.scene_time_of(stamp_of(answer)) == start + 50_000_000 * step
    player.call("pause", SetBool, data=False)
    assert moves(player.frames(4))
    answer = player.call("step", Trigger)
    assert not answer.success
    assert "pause" in answer.message


@pytest.mark.parametrize("paused", [True, False])
def test_restart_and_seek_show_that_scene_time_at_once(player: PlayerClient, paused: bool) -> None:
    from std_srvs.srv import SetBool, Trigger

    player.call("pause", SetBool, data=paused)
    actors = player.player.scene.actors

    def is_shown(seconds: float, stamp: int) -> bool:
        shown = {human: player.of_stamp(stamp, human).positions for human in HUMANS}
        expected = {human: actors[human].joint_poses(seconds).positions for human in HUMANS}
        return all(np.allclose(shown[human], expected[human], rtol=0, atol=1e-9) for human in HUMANS)

    before = max(player.messages_of())
    assert player.set(seek=1.25) == ""
    player.frames(1)
    assert sum(is_shown(1.25, stamp) for stamp in sorted(player.messages_of()) if stamp > before) >= 1
    assert is_shown(0.0, stamp_of(player.call("restart", Trigger)))


def test_the_rate_changes_and_frames_are_a_period_apart_to_the_nanosecond(player: PlayerClient) -> None:
    player.frames(2)
    assert player.set(rate=40) == ""  # an integer, as users type it
    stamps = [stamp for stamp, _ in player.frames(6)]
    steps = np.diff(stamps) / 25_000_000
    assert np.array_equal(steps, np.round(steps))
    assert np.all(np.diff(sorted(player.messages_of())) > 0)


def test_speeds_of_the_clock_and_of_one_human(player: PlayerClient) -> None:
    assert player.set(speed=0.0) == ""
    assert not moves(player.frames(3))
    assert player.set(speed=4.0) == ""
    ((_, poses),) = player.frames(1)
    assert poses.linear is not None
    assert np.linalg.norm(poses.linear[0, 0]) > 2.5  # hips of a person who walks four times as fast
    assert player.set(first__speed=0.0) == ""
    assert not moves(player.frames(3))
    assert moves(player.frames(4, "second"))


def test_values_for_all_are_set_for_each_and_parameters_return_present_values(player: PlayerClient) -> None:
    assert player.set(second__start=0.25, second__end=1.0) == ""
    assert player.set(motion="walk") == ""
    # another file is played from start to end
    names = ("motion", "first.motion", "second.motion", "second.start", "second.end")
    assert player.get(*names) == ["walk", "walk", "walk", 0.0, 0.0]
    assert player.set(loop="none", mirror=True) == ""
    assert (
        player.get("first.loop", "second.loop", "first.mirror", "second.mirror") == ["none"] * 2 + [True] * 2
    )
    assert player.set(first__loop="repeat") == ""
    assert player.set(second__loop="repeat") == ""
    assert player.get("loop") == ["repeat"]


def test_one_human_can_be_left_to_another_source(player: PlayerClient) -> None:
    assert player.set(second__play=False) == ""
    last = player.player.playback_clock.last
    player.frames(4)
    assert max(player.messages_of("second")) <= last
    assert player.set(second__play=True) == ""
    player.frames(2, "second")


def test_start_end_loop_and_mirror_change_the_motion(player: PlayerClient) -> None:
    assert player.set(start=0.5, end=1.0, loop="none", speed=5.0) == ""
    end = read_bvh(WALK).world_positions(60)  # second 1, where it ends

    def is_at_the_end() -> bool:
        poses = player.frames(1)[0][1].positions[0]
        heights = poses[:, 2] - poses[0, 2]
        return bool(np.abs(heights - (end[:, 1] - end[0, 1]) * 0.01).max() < 1e-6)

    assert player.client.spin_until(is_at_the_end)
    before = player.frames(1)[0][1]
    assert player.set(first__mirror=True) == ""
    after = player.frames(1)[0][1]
    twins = [before.names.index(n.replace("Left", "?").replace("Right", "Left").replace("?", "Right"))
             for n in before.names]  # fmt: skip
    position = np.array(player.player.scene.config.humans["first"].motion.position)
    mirrored = before.positions[0, twins]
    mirrored[:, 1] = 2 * position[1] - mirrored[:, 1]
    np.testing.assert_allclose(after.positions[0], mirrored, atol=1e-9)


def test_a_changed_motion_gives_the_same_truth_as_in_the_scene_file(player: PlayerClient) -> None:
    """Through the skinner, which uses the legend: joints agree to the last digits of the JSON."""
    from std_srvs.srv import SetBool

    assert player.set(first__motion="walk_straight", first__mirror=True) == ""
    player.call("pause", SetBool, data=True)
    assert player.set(seek=1.5) == ""
    _, body = player.frames(1, kind="joints")[0]
    config = MotionConfig(file="walk_straight", mirror=True, position=(0.0, -1.59), loop="continue")
    actor = player.player.scene.actors["first"].with_motion(config, player.player.scene.source)
    np.testing.assert_allclose(body.positions[0], actor.at(1.5).positions, atol=1e-9)
    legends = player.client.received[f"/{player.namespace}/humans/first/motion/legend"]
    assert player.client.spin_until(lambda: json.loads(legends[0].data)["lift"] == actor.retargeter.lift)
    assert actor.retargeter.lift != player.player.scene.actors["first"].retargeter.lift


def test_hands_change_while_the_motion_goes_on(player: PlayerClient) -> None:
    rest = player.player.scene.actors["first"].human.skeleton

    def turned(bone: str) -> float:
        """Degrees by which a finger joint differs from rest in the next body."""
        _, joints = player.frames(1, kind="joints")[0]
        above = joints.rotations[0, joints.names.index(f"{bone[:-1]}{int(bone[-1]) - 1}")]
        own = Rotation.from_quat(joints.rotations[0, joints.names.index(bone)])
        at_rest = Rotation.from_matrix(rest.rest_in_parent[rest.bone(bone), :3, :3])
        return float(np.degrees((at_rest.inv() * Rotation.from_quat(above).inv() * own).magnitude()))

    assert player.set(first__hands="left: fist") == ""
    assert 40 < turned("l_index2") < 60  # a finger at rest is bent by 39 degrees, of a fist by 90
    assert turned("r_index2") == pytest.approx(0.0, abs=0.01)
    for value, reason in (
        ("left: fisst", r"fisst.*did you mean 'fist'|fist"),
        ("top: fist", "left.*right"),
        ("x" * 1000, "1000 characters; at most 100"),
        ("", "relaxed"),
        ("left: right: fist", "left"),
    ):
        assert re.search(reason, player.set(first__hands=value)), value
    assert player.get("first.hands") == ["left: fist"]
    assert player.set(first__hands="scene") == ""
    assert turned("l_index2") == pytest.approx(0.0, abs=0.01)


def test_values_that_cannot_be_played_are_rejected_and_the_old_motion_continues(
    player: PlayerClient,
) -> None:
    """Also with a deleted file: a motion that plays is in memory."""
    tmp_path = player.motions
    (tmp_path / "broken.bvh").write_text("HIERARCHY\nROOT a\n{\n")
    (tmp_path / "chain.bvh").write_text(
        "HIERARCHY\nROOT a\n{\nOFFSET 0 0 0\nCHANNELS 1 Zrotation\n}\nMOTION\nFrames: 1\nFrame Time: 1\n0\n"
    )
    shutil.copy(WALK, tmp_path / "gone.bvh")
    assert player.set(first__motion=str(tmp_path / "gone.bvh")) == ""
    (tmp_path / "gone.bvh").unlink()
    assert player.set(first__mirror=True, first__end=1.5) == ""
    settings, actors = dict(player.player.playback.settings), dict(player.player.playback.actors)
    names = ("first.motion", "first.mirror", "first.start", "second.loop", "rate", "seek")
    values_before = player.get(*names)
    for values, reason in (
        ({"motion": "nothing"}, "no built-in motion and no file 'nothing'; there are"),
        ({"first.motion": str(tmp_path / "gone.bvh")}, "gone.bvh"),
        ({"first.motion": str(tmp_path / "broken.bvh")}, "broken.bvh"),
        ({"motion": str(tmp_path / "chain.bvh")}, "chain.bvh"),
        ({"first.mirror": True, "second.motion": "nothing"}, "nothing"),
        ({"loop": "often"}, "none, repeat or continue"),
        ({"start": 1.0, "end": 0.5}, "must come after start"),
        ({"start": 90.0}, "start is 90 s, outside"),
        ({"first.start": 90.0, "rate": 5.0, "seek": 4.0}, "start is 90 s, outside"),
        ({"speed": -1.0}, "range"),
        ({"speed": float("nan")}, "range"),
        ({"rate": 0.0}, "range"),
        ({"seek": -1.0}, "range"),
        ({"motion": 3}, "type"),
        ({"end": [0.5, 1.0]}, "type"),
        ({"nobody.motion": "walk"}, "undeclared"),
    ):
        assert reason in player.set(**{name.replace(".", "__"): value for name, value in values.items()}), (
            values
        )
        assert player.player.playback.settings == settings, values
        assert all(player.player.playback.actors[name] is actors[name] for name in actors), values
    assert player.get(*names) == values_before
    assert moves(player.frames(4))


def test_frames_are_sent_while_a_motion_is_read(
    player: PlayerClient, monkeypatch: pytest.MonkeyPatch
) -> None:
    prepare, publish, during = Playback.prepare, player.player.send_frame, list[int]()
    five_are_sent = threading.Event()

    def slow(self: Playback, *change: Any) -> Any:
        monkeypatch.setattr(player.player, "send_frame", count)
        assert five_are_sent.wait(PATIENCE), "no frames are sent while the motion is read"
        monkeypatch.setattr(player.player, "send_frame", publish)
        return prepare(self, *change)

    def count(tick: Tick, scene_poses: Any) -> None:
        publish(tick, scene_poses)
        during.append(tick.stamp)
        if len(during) >= 5:
            five_are_sent.set()

    monkeypatch.setattr(Playback, "prepare", slow)
    assert player.set(first__motion="walk_straight") == ""
    assert player.client.spin_until(lambda: set(during) <= set(player.messages_of()))
    assert moves([(stamp, messages.read_joints(player.messages_of()[stamp])) for stamp in during])


def test_a_parameter_reads_no_other_file_of_the_machine_and_quotes_none(
    player: PlayerClient, tmp_path: Path
) -> None:
    """Neither in the answer nor in the log, which is on the network too; a pipe does not stop the player."""
    from rcl_interfaces.msg import Log

    player.client.subscribe(Log, ["/rosout"])
    (tmp_path / "elsewhere.bvh").write_text("secret\n")
    (player.motions / "notes.bvh").write_text("secret\n")
    os.mkfifo(player.motions / "pipe.bvh")
    elsewhere, missing = (
        player.set(motion=str(tmp_path / name)) for name in ("elsewhere.bvh", "missing.bvh")
    )
    assert elsewhere == missing.replace("missing", "elsewhere")
    assert "motion_folders" in elsewhere
    with pytest.warns(HumansimWarning, match="notes.bvh.*HIERARCHY"):  # on this machine
        notes = player.set(motion=str(player.motions / "notes.bvh"))
    assert "not a motion that can be read" in notes
    assert "not a regular file" in player.set(motion=str(player.motions / "pipe.bvh"))
    assert player.set(motion="wave") == ""
    said = player.client.received["/rosout"]
    assert player.client.spin_until(lambda: any("not a regular file" in log.msg for log in said.values()))
    assert not any("secret" in text for text in (elsewhere, notes, *(log.msg for log in said.values())))


def test_only_the_motion_parameters_of_a_running_player_name_files(player: PlayerClient) -> None:
    """All others with a text or texts are read-only, or one of a few words."""
    from rclpy.parameter import Parameter

    texts = (Parameter.Type.STRING, Parameter.Type.STRING_ARRAY, Parameter.Type.NOT_SET)
    for node in player.nodes:
        for name, parameter in node._parameters.items():
            read_only = node.describe_parameter(name).read_only
            if parameter.type_ in texts and not read_only:
                last = name.rpartition(".")[2]
                assert last in ("motion", "loop", "start", "end", "mirror", "hands", "step_topic")
    assert "read-only" in player.set(motion_folders=["/"])


def test_parameters_at_the_start_have_priority_over_the_scene(ros: None, tmp_path: Path) -> None:
    from rclpy.parameter import Parameter

    def made(**given: Any) -> MotionPlayerNode:
        given = {"scene": str(write_scene(tmp_path)), **given}
        return MotionPlayerNode(
            parameter_overrides=[Parameter(n.replace("__", "."), value=v) for n, v in given.items()],
            namespace="given",
        )

    node = made(motion="walk_straight", second__motion="walk", second__start=0.5, seek=3.0)
    files = {name: motion.file for name, motion in node.playback.settings.items()}
    assert files == {"first": "walk_straight", "second": "walk"}
    expected = node.playback.actors["second"].motion.sample(
        3.5
    )  # with an offset of half a second, from its start
    shown = node.playback.show(node.playback_clock.cut(5).elapsed).motions["second"]
    np.testing.assert_array_equal(shown.positions, expected.positions)
    node.destroy_node()
    for invalid in ({"rate": 0.0}, {"speed": "fast"}, {"motion": "nothing"}, {"first__loop": "often"}):
        with pytest.raises(HumansimError, match=r"rate|speed|nothing|loop"):
            made(**invalid)
    assert issubclass(RosError, HumansimError)


def test_a_motion_is_sent_before_its_stamp_and_its_body_is_not(ros: None, tmp_path: Path) -> None:
    from sensor_msgs.msg import MultiDOFJointState, PointCloud2

    stage = PlayerClient(tmp_path, "early", skinner=True)
    ahead: dict[str, list[int]] = {"motion": [], "joints": [], "vertices": []}

    def keeper(kind: str) -> Any:
        def keep(message: Any, info: dict[str, int]) -> None:
            ahead[kind].append(messages.to_nanoseconds(message.header.stamp) - info["source_timestamp"])

        return keep

    listener = Client("clock_watcher")  # rclpy's other executor fails if a callback takes message info
    for kind in ahead:
        what = PointCloud2 if kind == "vertices" else MultiDOFJointState
        listener.node.create_subscription(what, f"/early/humans/first/{kind}", keeper(kind), 50)

    lead = stage.player.get_parameter("lead").value * SECOND

    def heard_enough() -> bool:
        """Of 20 frames one at least was sent on time, even on a loaded machine."""
        listener.executor.spin_once(timeout_sec=0.0)
        return all(len(times) >= 20 for times in ahead.values()) and max(ahead["motion"]) > 0.2 * lead

    assert stage.client.spin_until(heard_enough), ahead
    assert max(ahead["motion"]) < 1.5 * lead
    assert max(ahead["joints"]) <= 0 and max(ahead["vertices"]) <= 0
    stage.close()
    listener.close()


def test_frames_are_sent_at_their_stamps_even_if_the_first_was_late(
    ros: None, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    from rclpy.executors import SingleThreadedExecutor
    from rclpy.parameter import Parameter

    overrides = [Parameter("scene", value=str(write_scene(tmp_path))), Parameter("rate", value=5.0)]
    player = MotionPlayerNode(parameter_overrides=overrides, namespace="sluggish")
    lead = round(player.get_parameter("lead").value * SECOND)
    late: list[int] = []
    monkeypatch.setattr(player, "send_frame", lambda tick, _: late.append(player.now() + lead - tick.stamp))
    executor = SingleThreadedExecutor()
    executor.add_node(player)
    time.sleep(0.25)  # the timer was due after 0.2 s
    # a frame may be late on a loaded machine, but if they waited for the next call of the timer, all would be
    on_time = wait_until(
        lambda: len([each for each in late[1:] if each < 0.04 * SECOND]) >= 3,
        step=lambda: executor.spin_once(timeout_sec=1.0),
    )
    player.destroy_node()
    assert on_time, late
