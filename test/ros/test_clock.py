"""The clock of the nodes: a system clock that is set while they run, and simulated time."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from ros_support import Client, write_scene
from waiting import PATIENCE

from humansim_ros.cameras import Camera
from humansim_ros.data import messages
from humansim_ros.ros.graph.clock import ClockSteps
from humansim_ros.ros.nodes.camera import CameraNode
from humansim_ros.ros.nodes.camera_rig import CameraRigNode
from humansim_ros.ros.nodes.motion_player import MotionPlayerNode
from humansim_ros.ros.nodes.skinner import SkinnerNode
from humansim_ros.ros.playing.clock import PlaybackClock
from humansim_ros.ros.processes import node as scene_node
from humansim_ros.ros.processes.node import SceneNode
from humansim_ros.ros.processes.runtime import make_executor
from humansim_ros.scene.core.camera import CameraPose

SECOND = 1_000_000_000
#: Steps of the system clock in seconds: by a person, by NTP.
STEPS = (-20.0, 20.0, -3600.0, 3600.0, -0.5, 0.5)
#: A scene of one human and one small camera, at 20 frames per second.
SCENE = """
rate: 20
room: null
humans: {first: {motion: {file: walk, loop: continue}}}
cameras: {left: {size: [32, 24], position: [3.0, 2.6, 2.0], look_at: [0, 0, 0.8]}}
"""


# Without ROS


class Clocks:
    """A monotonic clock, and a clock that can be set."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.steady, self.now, self.simulated, self.delay = 7 * SECOND, 1000 * SECOND, False, 0
        self.steps = ClockSteps(self._read, lambda: self.simulated)
        monkeypatch.setattr(time, "monotonic_ns", lambda: self.steady)

    def _read(self) -> int:
        self.wait(self.delay)
        return self.now

    def wait(self, nanoseconds: int) -> None:
        self.steady += nanoseconds
        self.now += nanoseconds

    def step(self) -> int:
        now, step = self.steps.read()
        assert now == self.now
        return step


@pytest.mark.parametrize("seconds", STEPS)
def test_a_step_of_the_system_clock_is_seen_once_with_its_size(
    monkeypatch: pytest.MonkeyPatch, seconds: float
) -> None:
    clocks = Clocks(monkeypatch)
    assert clocks.step() == 0
    clocks.wait(33_000_000)
    clocks.now += round(seconds * SECOND)
    assert clocks.step() == round(seconds * SECOND)
    clocks.wait(5 * SECOND)
    clocks.now += 1_000_000  # drift
    assert clocks.step() == 0


def test_waiting_for_the_processor_is_no_step(monkeypatch: pytest.MonkeyPatch) -> None:
    clocks = Clocks(monkeypatch)
    for clocks.delay in (0, 300_000_000, 0, 50_000_000, 50_000_000):
        assert clocks.step() == 0
        clocks.wait(33_000_000)


def test_simulated_time_may_run_at_any_rate_and_only_its_jumps_back_and_its_start_are_steps(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    clocks = Clocks(monkeypatch)
    assert clocks.step() == 0
    clocks.simulated, clocks.now = True, 0
    assert clocks.step() == -1000 * SECOND
    clocks.now = 500 * SECOND
    assert clocks.step() == 500 * SECOND
    for ahead in (0, 1, SECOND, 100 * SECOND):
        clocks.now += ahead
        assert clocks.step() == 0
    clocks.now -= 1000
    assert clocks.step() == -1000


@pytest.mark.parametrize("seconds", STEPS)
@pytest.mark.parametrize("speed", [1.0, 0.5])
def test_stamps_jump_with_the_clock_and_scene_time_goes_on(seconds: float, speed: float) -> None:
    clock, step, now = PlaybackClock(rate=10, speed=speed), round(seconds * SECOND), 5000 * SECOND
    ticks = []
    for frame in range(8):
        if frame == 4:
            clock.shift(step)
            now += step
        ticks.append(clock.due(now))
        now += SECOND // 10
    assert [tick.elapsed for tick in ticks if tick] == [round(k * speed * SECOND / 10) for k in range(8)]
    assert [tick.dropped for tick in ticks if tick] == [0] * 8
    stamps = [tick.stamp for tick in ticks if tick]
    np.testing.assert_array_equal(
        np.diff(stamps), [SECOND // 10] * 3 + [SECOND // 10 + step] + [SECOND // 10] * 3
    )


# With ROS


def parameters(scene: Path, **values: Any) -> list[Any]:
    from rclpy.parameter import Parameter

    return [Parameter(name, value=value) for name, value in {"scene": str(scene), **values}.items()]


@pytest.fixture
def scene(ros: None, tmp_path: Path) -> Path:
    return write_scene(tmp_path, SCENE)


@pytest.fixture
def start(scene: Path) -> Iterator[Callable[..., tuple[Client, Any]]]:
    """Starts nodes in a namespace, with a client in their executor."""
    started: list[tuple[Client, list[Any]]] = []

    def make(namespace: str, *kinds: type, **values: Any) -> tuple[Client, list[Any]]:
        given = parameters(scene, **values)
        nodes = [kind(parameter_overrides=given, namespace=namespace) for kind in kinds]
        client = Client(f"client_of_{namespace}", make_executor())
        for each in nodes:
            client.executor.add_node(each)
        started.append((client, nodes))
        return client, nodes

    yield make
    for client, nodes in started:
        for each in nodes:
            each.close()
            each.destroy_node()
        client.close()


@pytest.mark.parametrize("simulated", [False, True])
def test_every_timer_is_on_the_steady_clock_or_on_simulated_time(
    start: Callable[..., tuple[Client, Any]], simulated: bool
) -> None:
    """The checks for simulated time that does not start and for neighbours are on the steady clock, and so is
    the wait of a step for its topic.
    """
    from rclpy.clock_type import ClockType

    _, nodes = start(
        "timers", MotionPlayerNode, SkinnerNode, CameraNode, CameraRigNode, use_sim_time=simulated
    )
    for each in (*nodes, *nodes[-1].members):
        kinds = [timer.clock.clock_type for timer in each.timers]
        assert len(kinds) >= 2
        followers = [kind for kind in kinds if kind != ClockType.STEADY_TIME]
        steady = 3 if isinstance(each, MotionPlayerNode) else 2
        assert len(followers) == (len(kinds) - steady if simulated else 0), each.get_name()


@pytest.mark.daily("-20.0")
@pytest.mark.slow
@pytest.mark.parametrize("seconds", [-20.0, 3600.0, -0.5])
def test_all_outputs_go_on_when_the_system_clock_is_set(
    start: Callable[..., tuple[Client, Any]],
    monkeypatch: pytest.MonkeyPatch,
    capfd: pytest.CaptureFixture[str],
    seconds: float,
) -> None:
    """Of the player, of the skinner with its rare markers, of the camera. Scene time does not jump."""
    from sensor_msgs.msg import Image, MultiDOFJointState
    from visualization_msgs.msg import MarkerArray

    step = 0
    monkeypatch.setattr(SceneNode, "now", lambda self: time.time_ns() + step)
    client, (player, _, camera) = start(
        "stepped", MotionPlayerNode, SkinnerNode, CameraNode, start_scene=False
    )
    joints, images = "/stepped/humans/first/joints", "/stepped/left/image_raw"
    marker_stamps: list[int] = []

    def on_markers(message: MarkerArray) -> None:
        marker_stamps.append(messages.to_nanoseconds(message.markers[0].header.stamp))

    client.node.create_subscription(MarkerArray, "/stepped/humans/first/markers", on_markers, 5)
    client.subscribe(MultiDOFJointState, [joints])
    client.subscribe(Image, [images])
    client.spin_until_matched(player, camera)
    drops: list[int] = []
    ticks: list[Any] = []
    send = player.send_frame
    monkeypatch.setattr(player, "send_frame", lambda tick, poses: (ticks.append(tick), send(tick, poses)))
    assert client.spin_until(lambda: len(client.received[images]) >= 5 and marker_stamps)

    step = round(seconds * SECOND)  # nobody spins at present
    before = len(ticks)
    monkeypatch.setattr(
        player, "count", lambda counter, number=1: drops.append(number * (counter == "drops"))
    )

    def arrived() -> bool:
        """Three whole frames, and markers."""
        new = {tick.stamp for tick in ticks[before:]}
        frames = new & client.received[joints].keys() & client.received[images].keys()
        return len(frames) >= 3 and not new.isdisjoint(marker_stamps)

    begin = time.monotonic()
    assert client.spin_until(arrived, min(abs(step) / SECOND, PATIENCE) / 2 + 5)
    waited = (time.monotonic() - begin) * SECOND
    last, first = ticks[before - 1 : before + 1]
    assert abs(first.stamp - last.stamp - step) < waited + SECOND
    assert first.elapsed - last.elapsed == pytest.approx(first.stamp - last.stamp - step, abs=20_000_000)
    assert sum(drops) * SECOND / 20 < waited + SECOND  # the load of the machine may cost some
    direction = "ahead" if seconds > 0 else "back"
    assert f"the system clock was set {abs(seconds):.2f} s {direction}:" in capfd.readouterr().err


def test_a_legend_is_valid_after_the_clock_is_set_back(
    start: Callable[..., tuple[Client, Any]], monkeypatch: pytest.MonkeyPatch
) -> None:
    """A legend with a later stamp than its motion would not be used."""
    from rclpy.parameter import Parameter

    step = 0
    monkeypatch.setattr(SceneNode, "now", lambda self: time.time_ns() + step)
    client, (player, skinner) = start("legends", MotionPlayerNode, SkinnerNode)
    frames: list[int] = []
    publish = skinner._publish
    monkeypatch.setattr(
        skinner, "_publish", lambda state, stamp: (frames.append(stamp), publish(state, stamp))
    )
    assert client.spin_until(lambda: frames)
    assert player.set_parameters([Parameter("mirror", value=True)])[0].successful
    assert player._sources["first"].since > 0
    count = len(frames)
    assert client.spin_until(lambda: len(frames) > count + 2)
    step = -3600 * SECOND
    assert client.spin_until(lambda: frames[-1] < time.time_ns() + step // 2)
    retargeter = skinner._live_retargeter._source.retargeter
    assert retargeter.lift == player.playback.actors["first"].retargeter.lift
    assert next(skinner._live_retargeter._candidates(frames[-1])).since <= frames[-1]


def test_a_camera_that_was_moved_keeps_its_pose_when_the_clock_is_set_back(
    start: Callable[..., tuple[Client, Any]], monkeypatch: pytest.MonkeyPatch
) -> None:
    from geometry_msgs.msg import PoseStamped, TransformStamped

    step = 0
    monkeypatch.setattr(SceneNode, "now", lambda self: time.time_ns() + step)
    client, (_, _, camera) = start("moved", MotionPlayerNode, SkinnerNode, CameraNode, start_scene=False)
    client.subscribe(TransformStamped, ["/moved/left/extrinsics"])
    sender = client.node.create_publisher(PoseStamped, "/moved/left/pose", 5)
    client.spin_until_matched(camera)
    there = Camera.look_at((1.5, -0.5, 1.0), (0, 0, 1))
    sender.publish(messages.pose_message(CameraPose.of(there), camera.now()))
    poses = client.received["/moved/left/extrinsics"]

    def is_there(stamp: int) -> bool:
        place = poses[stamp].transform.translation
        return bool(np.allclose([place.x, place.y, place.z], (1.5, -0.5, 1.0), atol=1e-9))

    assert client.spin_until(lambda: any(map(is_there, poses)))
    step = -20 * SECOND
    limit = time.time_ns() - 10 * SECOND
    assert client.spin_until(lambda: sum(stamp < limit for stamp in poses) >= 3)
    assert all(is_there(stamp) for stamp in poses if stamp < limit)


# Simulated time


def test_a_node_whose_simulated_time_does_not_start_says_so_until_it_does(
    start: Callable[..., tuple[Client, Any]],
    monkeypatch: pytest.MonkeyPatch,
    capfd: pytest.CaptureFixture[str],
) -> None:
    from rosgraph_msgs.msg import Clock

    monkeypatch.setattr(scene_node, "_CLOCK_CHECK_EVERY", 0.1)
    warnings: list[str] = []

    def in_log(text: str) -> bool:
        warnings.extend(line for line in capfd.readouterr().err.splitlines() if "use_sim_time" in line)
        return any(text in line for line in warnings)

    client, nodes = start("waiting", MotionPlayerNode, SkinnerNode, CameraRigNode, use_sim_time=True)
    for each in nodes:
        line = f"[waiting.{each.get_name()}]: use_sim_time is true, but nothing publishes /clock: "
        assert client.spin_until(lambda line=line: in_log(line)), warnings
    warnings.clear()
    assert client.spin_until(lambda: in_log("[waiting.motion_player]: ")), "it is not said again"
    publisher = client.node.create_publisher(Clock, "/clock", 5)
    assert client.spin_until(lambda: in_log("but no time has arrived on /clock: "))
    message = Clock()
    message.clock.sec = 3
    assert client.spin_until(lambda: publisher.publish(message) or all(each.now() for each in nodes))
    assert client.spin_until(lambda: not in_log("") or warnings.clear())
    client.node.destroy_publisher(publisher)


def test_without_simulated_time_nothing_is_said_of_it(
    start: Callable[..., tuple[Client, Any]],
    monkeypatch: pytest.MonkeyPatch,
    capfd: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.setattr(scene_node, "_CLOCK_CHECK_EVERY", 0.01)
    checks: list[None] = []
    check = SceneNode._check_clock
    monkeypatch.setattr(SceneNode, "_check_clock", lambda self: (checks.append(None), check(self)))
    client, _ = start("plain", MotionPlayerNode)
    assert client.spin_until(lambda: len(checks) >= 3)
    assert "/clock" not in capfd.readouterr().err


class SimulatedClock:
    """Publishes ``/clock`` when it is told."""

    def __init__(self, client: Client) -> None:
        from rosgraph_msgs.msg import Clock

        self._message = Clock()
        self._publisher = client.node.create_publisher(Clock, "/clock", 5)

    def show(self, seconds: float) -> None:
        self._message.clock = messages.header(round(seconds * SECOND), "").stamp
        self._publisher.publish(self._message)


def test_timers_follow_simulated_time_through_pauses_rates_and_jumps_back(
    start: Callable[..., tuple[Client, Any]],
) -> None:
    """A bag that is played at three times its speed, paused, and played again from its start."""
    from sensor_msgs.msg import MultiDOFJointState

    client, (player, skinner) = start("bag", MotionPlayerNode, SkinnerNode, use_sim_time=True)
    topic = "/bag/humans/first/joints"
    client.subscribe(MultiDOFJointState, [topic])
    client.spin_until_matched(player, skinner)
    clock, received = SimulatedClock(client), client.received[topic]
    assert client.spin_until(lambda: clock.show(100.0) or (skinner.now() and player.now()))
    for tick in range(101):  # five seconds of 20 frames each
        clock.show(100 + tick * 0.05)
        assert client.spin_until(lambda tick=tick: len(received) > tick), f"tick {tick}: {len(received)}"
    np.testing.assert_array_equal(np.diff(sorted(received)), SECOND // 20)

    sent = player.playback_clock.last
    pauses: list[None] = []
    timer = client.node.create_timer(0.05, lambda: (pauses.append(None), clock.show(105.0)))
    assert client.spin_until(lambda: len(pauses) >= 10)  # time stands
    client.node.destroy_timer(timer)
    assert player.playback_clock.last <= sent + SECOND // 20

    elapsed = player.playback_clock.elapsed
    received.clear()
    now = 50 * SECOND

    def goes_on() -> bool:
        """Whether two frames have come; the clock advances when all nodes have the last time."""
        nonlocal now
        if player.now() == now == skinner.now():
            now += SECOND // 20
        clock.show(now / SECOND)
        return len(received) >= 2

    assert client.spin_until(goes_on)
    assert all(50 * SECOND < stamp < 60 * SECOND for stamp in received)
    assert 0 < player.playback_clock.elapsed - elapsed <= now - 50 * SECOND
