"""A player that is steered while it plays: parameters, services, and what is refused."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from conftest import ROOT
from ros_support import Client, write_scene

from humansim_ros.motion import read_bvh
from humansim_ros.motion.world import JointPoses
from humansim_ros.ros import messages
from humansim_ros.ros.nodes.motion_player import MotionPlayer
from humansim_ros.ros.qos import LATCHED
from humansim_ros.scene import Scene
from humansim_ros.scene.config import MotionConfig
from humansim_ros.scene.playback import Clock, Playback

HUMANS = ("first", "second")


# Without ROS


def test_a_clock_stands_jumps_and_changes_its_speed_without_a_jump() -> None:
    clock = Clock()
    second = 1_000_000_000
    assert clock.at(5 * second) == 0.0
    assert clock.at(7 * second) == pytest.approx(2.0)
    clock.set_speed(0.5, 7 * second)
    assert clock.at(9 * second) == pytest.approx(3.0)
    clock.pause(True, 9 * second)
    assert (clock.at(20 * second), clock.pace) == (pytest.approx(3.0), 0.0)
    clock.pause(False, 20 * second)
    assert clock.at(22 * second) == pytest.approx(4.0)
    clock.seek(100.0, 22 * second)
    assert clock.at(24 * second) == pytest.approx(101.0)


@pytest.fixture
def playback(tmp_path: Path) -> Playback:
    return Playback(Scene.load(write_scene(tmp_path)))


def changed(playback: Playback, name: str, stamp: int, **changes: Any) -> None:
    playback.change(name, playback.changed(name, changes, stamp))


def test_an_unsteered_playback_is_the_scenes_own(playback: Playback) -> None:
    playback.clock.at(1)
    for frame in (0, 7, 300):
        elapsed = playback.scene.frame_time(frame)
        poses = playback.poses(1 + elapsed)
        for name, actor in playback.scene.actors.items():
            expected = actor.joint_poses(elapsed * 1e-9)
            np.testing.assert_array_equal(poses[name].positions, expected.positions)
            np.testing.assert_array_equal(poses[name].linear, expected.linear)


def test_velocities_are_those_that_are_seen(playback: Playback) -> None:
    playback.clock.at(0)
    plain = playback.poses(500_000_000)["first"]
    playback.clock.set_speed(2.0, 500_000_000)
    fast = playback.poses(500_000_000)["first"]
    playback.clock.pause(True, 500_000_000)
    still = playback.poses(500_000_000)["first"]
    assert plain.linear is not None
    np.testing.assert_allclose(fast.linear, 2 * plain.linear)
    np.testing.assert_array_equal(still.linear, 0 * plain.linear)
    np.testing.assert_array_equal(still.positions, plain.positions)


@pytest.mark.parametrize("change", [{"speed": 3.0}, {"speed": 0.25}])
def test_another_speed_of_one_goes_on_from_where_it_is(playback: Playback, change: dict[str, float]) -> None:
    playback.clock.at(0)
    before = playback.poses(700_000_000)
    changed(playback, "first", 700_000_000, **change)
    after = playback.poses(700_000_000)
    np.testing.assert_allclose(after["first"].positions, before["first"].positions, atol=1e-9)
    np.testing.assert_array_equal(after["second"].positions, before["second"].positions)
    assert after["first"].linear is not None
    np.testing.assert_allclose(after["first"].linear, change["speed"] * before["first"].linear, atol=0.05)


def test_another_motion_starts_at_its_start_and_restarts_as_in_the_scene(playback: Playback) -> None:
    playback.clock.at(0)
    changed(playback, "first", 1_500_000_000, file="walk_straight", loop="none")
    expected = Playback(playback.scene)
    config = MotionConfig(file="walk_straight", loop="none", position=(0.0, -1.59))
    expected.change(
        "first", (config, playback.scene.actors["first"].with_motion(config, playback.scene.path))
    )
    expected.clock.at(0)
    now = playback.poses(1_500_000_000)["first"].positions
    np.testing.assert_allclose(now, expected.poses(0)["first"].positions, atol=1e-9)
    playback.seek(0.0, 2_000_000_000)
    again = playback.poses(2_300_000_000)
    np.testing.assert_allclose(
        again["first"].positions, expected.poses(300_000_000)["first"].positions, atol=1e-9
    )
    np.testing.assert_allclose(
        again["second"].positions, expected.poses(300_000_000)["second"].positions, atol=1e-9
    )


# With ROS


class Steered:
    """A player with a client that hears its motions, sets its parameters and calls its services."""

    def __init__(self, folder: Path, namespace: str) -> None:
        from rclpy.parameter import Parameter
        from sensor_msgs.msg import MultiDOFJointState
        from std_msgs.msg import String

        scene = write_scene(folder)
        self.player = MotionPlayer(
            parameter_overrides=[Parameter("scene", value=str(scene))], namespace=namespace
        )
        self.client = Client(f"{namespace}_client")
        self.client.executor.add_node(self.player)
        self.namespace = namespace
        topics = [f"/{namespace}/humans/{human}/motion" for human in HUMANS]
        self.client.subscribe(MultiDOFJointState, topics, 500)
        self.client.subscribe(String, [f"{topic}/legend" for topic in topics], LATCHED)
        self.frames(2)

    def heard(self, human: str = "first") -> dict[int, Any]:
        return self.client.received[f"/{self.namespace}/humans/{human}/motion"]

    def frames(self, count: int, human: str = "first") -> list[tuple[int, JointPoses]]:
        """The next so many frames."""
        before = len(self.heard(human))
        assert self.client.spin_until(lambda: len(self.heard(human)) >= before + count), "no frames come"
        items = sorted(self.heard(human).items())[-count:]
        return [(stamp, messages.read_joints(message)) for stamp, message in items]

    def set(self, **values: Any) -> list[Any]:
        from rclpy.parameter import Parameter

        names = {name.replace("__", "."): value for name, value in values.items()}
        return list(self.player.set_parameters([Parameter(n, value=v) for n, v in names.items()]))

    def call(self, service: str, kind: Any, **fields: Any) -> Any:
        caller = self.client.node.create_client(kind, f"/{self.namespace}/motion_player/{service}")
        assert self.client.spin_until(caller.service_is_ready)
        future = caller.call_async(kind.Request(**fields))
        assert self.client.spin_until(future.done)
        self.client.node.destroy_client(caller)
        return future.result()

    def close(self) -> None:
        self.player.destroy_node()
        self.client.close()


@pytest.fixture(scope="module")
def steered(ros: None, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Steered]:
    one = Steered(tmp_path_factory.mktemp("player"), "steer")
    yield one
    one.close()


@pytest.fixture
def player(steered: Steered) -> Iterator[Steered]:
    """The player as the scene has it, and left so."""
    from std_srvs.srv import SetBool

    yield steered
    steered.call("pause", SetBool, data=False)
    results = steered.set(rate=0.0, speed=1.0, motion="walk", loop="continue", mirror=False)
    results += steered.set(second__motion="walk_straight", second__loop="repeat", seek=0.0)
    assert all(result.successful for result in results)


def shape(poses: JointPoses) -> np.ndarray:
    """What of a pose does not depend on the place: joints about the hips, and heights."""
    return poses.positions[0] - poses.positions[0, :1] * [1, 1, 0]


def moves(frames: list[tuple[int, JointPoses]]) -> bool:
    return bool(np.abs(frames[0][1].positions - frames[-1][1].positions).max() > 1e-3)


def test_a_paused_player_shows_the_same_pose_with_new_stamps(player: Steered) -> None:
    from std_srvs.srv import SetBool, Trigger

    assert player.call("pause", SetBool, data=True).success
    player.frames(2)
    still = player.frames(4)
    assert not moves(still)
    assert np.all(np.diff([stamp for stamp, _ in still]) > 0)
    assert np.abs(still[-1][1].linear).max() == 0
    assert player.call("step", Trigger).success
    stepped = player.frames(3)[-1][1]
    actor = player.player._playback.actors["first"]
    t = player.player._playback.clock.at(0)
    np.testing.assert_allclose(stepped.positions, actor.joint_poses(t).positions, atol=1e-9)
    expected = np.linalg.norm(stepped.positions - still[-1][1].positions, axis=-1).max()
    assert 0.005 < expected < 0.4  # a twentieth of a second of walking
    player.call("pause", SetBool, data=False)
    assert moves(player.frames(4))
    answer = player.call("step", Trigger)
    assert not answer.success
    assert "pause" in answer.message


def test_restart_and_seek_show_that_second_of_the_scene(player: Steered) -> None:
    from std_srvs.srv import SetBool, Trigger

    player.call("pause", SetBool, data=True)
    scene = player.player.scene
    for seconds, jump in (
        (1.25, lambda: player.set(seek=1.25)),
        (0.0, lambda: player.call("restart", Trigger)),
    ):
        jump()
        for human in HUMANS:
            shown = player.frames(3, human)[-1][1]
            expected = scene.actors[human].joint_poses(seconds)
            np.testing.assert_allclose(shown.positions, expected.positions, atol=1e-9)


def test_frames_stay_a_period_apart_whatever_the_rate(player: Steered) -> None:
    before = [stamp for stamp, _ in player.frames(3)]
    assert player.set(rate=40.0)[0].successful
    after = [stamp for stamp, _ in player.frames(6)]
    assert before[-1] < after[0]
    steps = np.diff(after) / 25_000_000
    assert np.array_equal(steps, np.round(steps))


def test_speed_is_that_of_the_clock(player: Steered) -> None:
    player.set(speed=0.0)
    player.frames(2)
    assert not moves(player.frames(3))
    player.set(speed=4.0)
    (first, _), *_, (last, b) = player.frames(5)
    clock = player.player._playback.clock
    assert clock.at(last) - clock.at(first) == pytest.approx(4e-9 * (last - first))
    assert np.linalg.norm(b.linear[0, 0]) > 2.5  # the hips of somebody who walks four times as fast


def test_a_motion_is_changed_for_all_or_for_one(player: Steered) -> None:
    assert player.set(first__motion="walk_straight")[0].successful
    player.frames(1)
    configs = player.player._playback.configs
    assert (configs["first"].file, configs["second"].file) == ("walk_straight", "walk_straight")
    assert player.set(motion="walk")[0].successful
    assert {config.file for config in player.player._playback.configs.values()} == {"walk"}
    assert player.player.get_parameter("second.motion").value == "walk"
    assert moves(player.frames(4, "second"))


def test_part_loop_and_mirror_are_changed(player: Steered) -> None:
    assert all(r.successful for r in player.set(start=0.5, end=1.0, loop="none"))
    player.client.spin_until(lambda: False, 0.8)
    last = player.frames(1)[0][1]
    motion = read_bvh(ROOT / "assets" / "motions" / "walk.bvh")
    local = motion.world_positions(60)
    heights = last.positions[0, :, 2] - last.positions[0, 0, 2]
    np.testing.assert_allclose(heights, (local[:, 1] - local[0, 1]) * 0.01, atol=1e-6)
    # another file is played from its start to its end
    player.set(motion="walk_straight")
    assert player.player.get_parameter("start").value == 0.0
    before = player.player._playback.actors["first"].motion.mirror
    assert player.set(mirror=True)[0].successful
    assert (before, player.player._playback.actors["first"].motion.mirror) == (False, True)


def wrong_values(folder: Path) -> list[tuple[str, dict[str, Any], str]]:
    (folder / "broken.bvh").write_text("HIERARCHY\nROOT a\n{\n")
    (folder / "chain.bvh").write_text(
        "HIERARCHY\nROOT a\n{\nOFFSET 0 0 0\nCHANNELS 1 Zrotation\n}\nMOTION\nFrames: 1\nFrame Time: 1\n0\n"
    )
    return [
        ("no such motion", {"motion": "nothing"}, "nothing"),
        ("a file that has vanished", {"motion": str(folder / "gone.bvh")}, "gone.bvh"),
        ("a broken file", {"first.motion": str(folder / "broken.bvh")}, "truncated"),
        ("no person", {"motion": str(folder / "chain.bvh")}, "chain.bvh"),
        ("an unknown way to loop", {"loop": "often"}, "none"),
        ("an end before the start", {"start": 1.0, "end": 0.5}, "end"),
        ("a start behind the end", {"start": 90.0}, "start"),
        ("a speed below zero", {"speed": -1.0}, "range"),
        ("a rate beyond all measure", {"rate": 1e6}, "range"),
        ("a number for a name", {"motion": 3}, "type"),
    ]


def test_what_cannot_be_played_is_refused_and_the_old_goes_on(player: Steered, tmp_path: Path) -> None:
    before = dict(player.player._playback.configs)
    actors = dict(player.player._playback.actors)
    for what, values, message in wrong_values(tmp_path):
        results = player.set(**{name.replace(".", "__"): value for name, value in values.items()})
        refused = [result for result in results if not result.successful]
        assert refused, what
        assert any(message in result.reason for result in refused), (what, [r.reason for r in refused])
        if what not in ("an end before the start",):
            assert player.player._playback.configs == before, what
            assert player.player._playback.actors == actors, what
        else:
            player.set(start=0.0)
            before, actors = dict(player.player._playback.configs), dict(player.player._playback.actors)
        assert moves(player.frames(4)), what


def test_a_legend_says_how_the_motion_is_retargeted(player: Steered) -> None:
    topic = f"/{player.namespace}/humans/first/motion/legend"
    get: Callable[[], Any] = lambda: next(iter(player.client.received[topic].values()))  # noqa: E731
    assert player.client.spin_until(lambda: topic in player.client.received)
    data = json.loads(get().data)
    assert data["joint_names"] == list(player.player.scene.actors["first"].motion.names)
    assert data["mode"] == "full"


def test_parameters_at_the_start_win_over_the_scene(ros: None, tmp_path: Path) -> None:
    from rclpy.parameter import Parameter

    given = {
        "scene": str(write_scene(tmp_path)),
        "motion": "walk_straight",
        "second.motion": "walk",
        "seek": 3.0,
    }
    node = MotionPlayer(
        parameter_overrides=[Parameter(name, value=value) for name, value in given.items()], namespace="given"
    )
    files = {name: config.file for name, config in node._playback.configs.items()}
    assert files == {"first": "walk_straight", "second": "walk"}
    assert node._playback.clock.at(5) == 3.0
    node.destroy_node()
