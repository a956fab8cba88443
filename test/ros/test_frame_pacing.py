"""On a machine that is too slow, all cameras show the same frames."""

from __future__ import annotations

import json
import subprocess
import sys
import threading
import time
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from rclpy.parameter import Parameter
from ros_support import Client, Lockstep, write_scene
from std_msgs.msg import Header
from waiting import wait_until

from humansim_ros.data.messages import header
from humansim_ros.ros.graph.qos import DATA
from humansim_ros.ros.nodes.camera import CameraNode
from humansim_ros.ros.nodes.motion_player import MotionPlayerNode
from humansim_ros.ros.nodes.skinner import SkinnerNode
from humansim_ros.ros.playing.realtime import FramePacing, pace_reason
from humansim_ros.ros.processes.runtime import make_executor

SECOND = 1_000_000_000
PERIOD = SECOND / 30
START = 1_700_000_000 * SECOND


@dataclass
class SimulatedCamera:
    """A camera that needs ``cost(frame)`` seconds for each frame, in order. Its queue holds the newest three
    messages, as that of a node does.
    """

    cost: Callable[[int], float]
    queue: deque[int] = field(default_factory=lambda: deque(maxlen=3))
    sent: list[int] = field(default_factory=list)
    done: list[int] = field(default_factory=list)
    rendering: int | None = None
    busy_until: float = 0.0

    def run_until(self, now: float, report: Callable[[int, float], None]) -> None:
        """Finish the frame in progress if it is time, report it, and begin the oldest one."""
        if self.rendering is not None and self.busy_until <= now:
            self.done.append(self.rendering)
            report(self.rendering, now)
            self.rendering = None
        if self.rendering is None and self.queue:
            self.rendering = self.queue.popleft()
            self.busy_until = now + self.cost(self.rendering)

    def done_since(self, frame: int) -> list[int]:
        """Frames after the start, when the sender does not know of the camera yet."""
        return [done for done in self.done if done >= frame]


def play(
    seconds: float, are_known: bool = False, **costs: Callable[[int], float]
) -> dict[str, SimulatedCamera]:
    """Play for some seconds at 30 Hz for cameras with these costs; events are exact to 1 ms.

    ``are_known``: whether the middleware has told the sender that each camera is a process that runs.
    """
    pacing = FramePacing()
    pacing.set_processes(len(costs) if are_known else 0, 0.0)
    cameras = {name: SimulatedCamera(cost) for name, cost in costs.items()}
    number = 0
    for millisecond in range(round(1000 * seconds)):
        now = millisecond * 1e-3
        for name, camera in cameras.items():
            camera.run_until(
                now,
                lambda frame, at, name=name: pacing.add_finished(name, START + round(frame * PERIOD), at),
            )
        if now * SECOND < number * PERIOD:
            continue
        stamp = START + round(number * PERIOD)
        if not pacing.late_cameras(stamp, PERIOD, now):
            pacing.add_sent(stamp, now)
            for camera in cameras.values():
                camera.sent.append(number)
                camera.queue.append(number)
        number += 1
    return cameras


@pytest.mark.parametrize(
    ("causes", "load", "sentence"),
    [
        ({"/left": 3, "/front": 9}, 1.2, "the motion player waits for /front, /left; "),
        ({"/a": 1, "/b": 1, "/c": 1, "/d": 1}, 2.0, "the motion player waits for /a, /b, /c and 1 more; "),
        ({"": 4}, 9.6, "the motion player is late, 10 processes share 2 processors; "),
        ({"": 1, "/a": 2}, 0.1, "the motion player waits for /a, the motion player is late; "),
    ],
)
def test_the_log_says_who_sets_the_pace(causes: dict[str, int], load: float, sentence: str) -> None:
    text = pace_reason(causes, load, 2)
    assert text == sentence + "lower rate or image sizes, or play in lockstep, which drops nothing"


def test_cameras_that_keep_up_get_every_frame() -> None:
    cameras = play(10, left=lambda _: 0.025, right=lambda _: 0.032)
    assert all(len(camera.done) >= 298 for camera in cameras.values())


def test_a_short_delay_loses_no_frame() -> None:
    cameras = play(10, left=lambda frame: 0.07 if frame % 50 == 20 else 0.015)
    assert cameras["left"].done == list(range(300))


def test_late_cameras_of_different_speeds_show_the_same_frames_as_fast_as_the_slowest_can() -> None:
    cameras = play(
        20,
        fast=lambda _: 0.01,
        slow=lambda frame: 0.045 if frame % 3 else 0.09,
        slower=lambda frame: 0.07 if frame % 2 else 0.05,
    )
    fast, slow, slower = (camera.done_since(15) for camera in cameras.values())
    common = min(len(fast), len(slow), len(slower))
    assert fast[:common] == slow[:common] == slower[:common]
    assert max(len(fast), len(slow), len(slower)) - common <= 3  # still in the queues
    assert common > 0.9 * 19.5 / 0.062


def test_a_very_slow_camera_gets_evenly_spaced_frames() -> None:
    done = play(30, only=lambda _: 0.2)["only"].done_since(30)
    gaps = {later - earlier for earlier, later in pairwise(done)}
    assert len(done) >= 140
    assert gaps <= {5, 6, 7}


def test_while_all_cameras_prepare_their_first_frame_few_frames_are_sent() -> None:
    """Others would only keep the skinners busy, and push each other out of the queues of the cameras."""
    cameras = play(
        20,
        are_known=True,
        left=lambda frame: 0.02 if frame else 8.0,
        right=lambda frame: 0.02 if frame else 12.0,
    )
    before_the_first_report = [frame for frame in cameras["left"].sent if frame < 8 * 30]
    gaps = [later - earlier for earlier, later in pairwise(before_the_first_report)]
    assert gaps == sorted(gaps)
    assert gaps[0] == 1
    assert len(gaps) <= 10
    assert all(set(range(13 * 30, 598)) <= set(camera.done) for camera in cameras.values())


def test_cameras_that_need_seconds_for_each_frame_show_the_same_frames() -> None:
    cameras = play(200, are_known=True, left=lambda _: 6.0, right=lambda _: 7.0)
    left, right = (set(camera.done) for camera in cameras.values())
    assert len(left & right) >= 0.8 * len(left | right)
    assert len(left & right) >= 0.9 * (200 / 7.0)


def test_cameras_that_all_need_longer_than_they_are_waited_for_get_a_frame_every_two_seconds() -> None:
    sent = play(60, are_known=True, only=lambda _: 1e9)["only"].sent
    assert {later - earlier for earlier, later in pairwise(sent[9:])} <= {60, 61}


def test_a_camera_that_never_reports_again_delays_the_others_for_seconds_only() -> None:
    cameras = play(20, dead=lambda frame: 0.01 if frame < 100 else 1e9, alive=lambda _: 0.01)
    assert len(cameras["alive"].done) > 600 - 4 * 30
    assert set(range(250, 598)) <= set(cameras["alive"].done)


def test_without_reports_and_after_a_pause_nothing_is_late() -> None:
    pacing = FramePacing()
    for number in range(100):
        assert pacing.late_cameras(number + 1, 1.0, float(number)) == []
        pacing.add_sent(number + 1, float(number))
    pacing.add_finished("camera", 100, 100.0)
    assert pacing.late_cameras(101, 1.0, 1000.0) == []
    pacing.add_sent(101, 1000.0)
    pacing.add_sent(102, 1000.0)
    assert pacing.late_cameras(110, 1.0, 1001.0) == ["camera"]


def test_frames_before_a_clock_that_is_set_back_are_forgotten() -> None:
    pacing = FramePacing()
    pacing.add_sent(50, 0.0)
    pacing.add_finished("camera", 50, 0.0)
    for stamp in (100, 101, 102):
        pacing.add_sent(stamp, 0.0)
    assert pacing.late_cameras(110, 1.0, 0.1) == ["camera"]
    pacing.add_sent(7, 0.2)
    assert pacing.late_cameras(8, 1.0, 0.3) == []


def test_slow_camera_is_waited_for_longer() -> None:
    pacing = FramePacing()
    for stamp in (1, 2, 3):
        pacing.add_sent(stamp, 0.0)
    pacing.add_finished("slow", 1, 2.4)  # after its first frame took longer than others are waited for
    assert pacing.late_cameras(4, 0.1, 2.5) == ["slow"]
    assert pacing.late_cameras(4, 0.1, 2.4 + 4 * 2.3) == ["slow"]
    assert pacing.late_cameras(4, 0.1, 2.4 + 10.1) == []


def test_reports_of_frames_that_were_not_sent_and_repeated_ones_delay_nothing_for_ever() -> None:
    """As from the cameras of another player, or from a stranger who repeats one report for ever."""
    pacing = FramePacing()
    pacing.add_sent(1, 0.0)
    pacing.add_finished("repeats", 1, 0.0)
    late = []
    for number in range(2, 400):
        now = 0.05 * number
        for stamp in (0, 10**18, -5):
            pacing.add_finished("stranger", stamp, now)
        pacing.add_finished("repeats", 1, now)
        late.append(pacing.late_cameras(number, 1.0, now))
        if not late[-1]:
            pacing.add_sent(number, now)
    assert ["repeats"] in late
    assert late[100:] == [[]] * (len(late) - 100)


def test_names_of_reports_are_bounded() -> None:
    pacing = FramePacing()
    pacing.add_sent(1, 0.0)
    for number in range(10_000):
        pacing.add_finished(f"camera_{number}", 1, 0.0)
    assert len(pacing._finished) == 100


def test_during_a_pause_a_frame_is_sent_only_if_it_fits_into_the_queues_of_all_cameras() -> None:
    pacing = FramePacing()
    assert pacing.may_send_paused(0, 0.0)
    pacing.add_sent(10, 0.0)
    pacing.add_finished("fast", 10, 0.0)
    pacing.add_finished("slow", 10, 0.0)
    pacing.add_sent(11, 0.1)
    assert not pacing.may_send_paused(0, 0.2)
    assert pacing.may_send_paused(1, 0.2)
    pacing.add_finished("fast", 11, 0.2)
    assert not pacing.may_send_paused(0, 0.3)
    pacing.add_sent(12, 0.3)
    assert not pacing.may_send_paused(1, 0.4)
    pacing.add_finished("slow", 11, 0.4)
    assert pacing.may_send_paused(1, 0.5)
    pacing.add_finished("fast", 12, 0.5)
    pacing.add_finished("slow", 12, 0.5)
    assert pacing.may_send_paused(0, 0.6)
    assert not pacing.may_repeat(0.7)
    assert pacing.may_repeat(0.8)


def test_a_dead_camera_delays_frames_of_a_pause_until_it_is_forgotten() -> None:
    pacing = FramePacing()
    pacing.add_sent(10, 0.0)
    pacing.add_finished("dead", 10, 0.0)
    sent = []
    for tenth in range(1, 200):
        if pacing.may_send_paused(0, 0.1 * tenth):
            pacing.add_sent(10 + tenth, 0.1 * tenth)
            sent.append(tenth)
    assert 4 <= sum(tenth < 100 for tenth in sent) <= 6
    assert set(range(110, 200)) <= set(sent)


@pytest.mark.slow
def test_camera_nodes_of_different_speeds_show_the_same_frames(
    ros: None, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Each camera has a thread, as in a process of its own. Both need more than a period of 50 ms."""
    shown: dict[str, list[int]] = {"left": [], "right": []}
    seconds = {"left": 0.07, "right": 0.11}

    def slowly(node: Any, state: Any) -> None:
        time.sleep(seconds[node.get_name()])
        shown[node.get_name()].append(state.stamp)

    monkeypatch.setattr(CameraNode, "publish_frame", slowly)
    scene = write_scene(tmp_path)
    player = node(MotionPlayerNode, scene, "motion_player")
    skinners = [node(SkinnerNode, scene, f"skinner_{human}", human=human) for human in ("first", "second")]
    cameras = [node(CameraNode, scene, name, camera=name, start_scene=False) for name in ("left", "right")]
    with spinning([player, *skinners], [cameras[0]], [cameras[1]]):
        wait_until(lambda: all(len(stamps) >= 40 for stamps in shown.values()))
    left, right = shown.values()
    assert min(len(left), len(right)) >= 40
    first = max(left[4], right[4])  # both have reported to the player
    last = min(left[-1], right[-1])
    assert [s for s in left if first < s <= last] == [s for s in right if first < s <= last]
    for each in (player, *skinners, *cameras):
        each.close()
        each.destroy_node()


#: A camera process that reports the first frame, and no other; or none, with an argument.
CAMERA_PROCESS = """
import sys
import rclpy
from sensor_msgs.msg import TimeReference
from std_msgs.msg import Header
from humansim_ros.ros.graph.qos import ALIVE, CAMERA_ALIVE, DATA, SCENE_TIME

def report(frame):
    node.destroy_subscription(frames)
    for publisher in alive, done:
        publisher.publish(Header(stamp=frame.header.stamp, frame_id="/front"))

rclpy.init()
node = rclpy.create_node("front", namespace="/paced")
alive = node.create_publisher(Header, CAMERA_ALIVE, ALIVE)
done = node.create_publisher(Header, "frame_done", DATA)
while not (alive.get_subscription_count() and done.get_subscription_count()):
    rclpy.spin_once(node, timeout_sec=0.05)
if not sys.argv[1:]:
    frames = node.create_subscription(TimeReference, SCENE_TIME, report, DATA)
rclpy.spin(node)
"""


@pytest.mark.parametrize(
    ("arguments", "cause"), [([], "/front"), (["silent"], "cameras, none of which has reported yet")]
)
def test_a_camera_that_has_died_delays_the_others_no_longer(
    ros: None, tmp_path: Path, arguments: list[str], cause: str
) -> None:
    """The middleware tells the player that it runs, and, long before the player gives it up, that it has
    died.
    """
    player = node(MotionPlayerNode, write_scene(tmp_path), "motion_player")
    lockstep, client = Lockstep(player), Client("other")
    client.executor.add_node(player)
    now = time.monotonic()

    def late() -> list[str]:
        return player.playing._pacing.late_cameras(lockstep.play(), PERIOD, now)

    with subprocess.Popen([sys.executable, "-c", CAMERA_PROCESS, *arguments]) as camera:
        try:
            assert client.spin_until(lambda: late() == [cause])
        finally:
            camera.kill()
    assert client.spin_until(lambda: not late())
    player.destroy_node()
    client.close()


def test_the_player_hears_a_reporter_with_ordinary_quality_of_service(ros: None, tmp_path: Path) -> None:
    player = node(MotionPlayerNode, write_scene(tmp_path), "motion_player")
    lockstep, client = Lockstep(player), Client("tracker")
    client.executor.add_node(player)
    reports = client.node.create_publisher(Header, "/paced/frame_done", DATA)
    client.spin_until_matched(player)
    first = lockstep.play()
    reports.publish(header(first, "tracker"))
    for _ in range(3):
        lockstep.play()
    assert client.spin_until(
        lambda: (
            player.playing._pacing.late_cameras(first + 3 * SECOND, PERIOD, time.monotonic()) == ["tracker"]
        )
    )
    player.destroy_node()
    client.close()


@pytest.mark.daily("True")
@pytest.mark.slow
@pytest.mark.parametrize("waits", [True, False])
def test_every_step_of_a_paused_player_is_shown_by_all_cameras(
    ros: None, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, waits: bool
) -> None:
    """Of a client that waits for the image of each step, and of one that does not wait at all; with a camera
    that is much slower than the rate at which the paused pose is sent again.
    """
    from std_srvs.srv import SetBool, Trigger

    shown: dict[str, list[int]] = {"left": [], "right": []}
    seconds = {"left": 0.001, "right": 0.15}

    def slowly(each: Any, state: Any) -> None:
        time.sleep(seconds[each._camera.name])
        shown[each._camera.name].append(state.stamp)

    monkeypatch.setattr(CameraNode, "publish_frame", slowly)
    scene = write_scene(tmp_path)
    player = node(MotionPlayerNode, scene, "motion_player")
    skinners = [node(SkinnerNode, scene, f"skinner_{human}", human=human) for human in ("first", "second")]
    cameras = [
        node(CameraNode, scene, f"camera_{name}", camera=name, start_scene=False)
        for name in ("left", "right")
    ]
    with spinning([player, *skinners], [cameras[0]], [cameras[1]]):
        assert wait_until(lambda: min(map(len, shown.values())) >= 3)
        player._on_pause(SetBool.Request(data=True), SetBool.Response())
        steps = []
        answers: list[Any] = []

        def step() -> None:
            answers.append(player._on_step(Trigger.Request(), Trigger.Response()))

        for number in range(15):  # more than the queues of a camera hold
            player.run_soon(step)
            assert wait_until(lambda n=number: len(answers) > n, step=lambda: time.sleep(0.001))
            assert answers[-1].success
            stamp = json.loads(answers[-1].message)["stamp"]
            steps.append(stamp["sec"] * SECOND + stamp["nanosec"])
            if waits:
                assert wait_until(lambda: all(steps[-1] in stamps for stamps in shown.values())), len(steps)
        assert wait_until(lambda: all(set(steps) <= set(stamps) for stamps in shown.values())), [
            [steps.index(step) for step in steps if step not in stamps] for stamps in shown.values()
        ]
    assert np.all(np.diff(steps) > 0)
    for each in (player, *skinners, *cameras):
        each.close()
        each.destroy_node()


def node(kind: type, scene: Path, name: str, **parameters: str | bool) -> Any:
    """Node with its name in the namespace of this file."""
    overrides = [Parameter(key, value=value) for key, value in {"scene": str(scene), **parameters}.items()]
    arguments = ["--ros-args", "-r", f"__node:={name}"]
    return kind(parameter_overrides=overrides, namespace="paced", cli_args=arguments)


@contextmanager
def spinning(*groups: Sequence[Any]) -> Iterator[None]:
    """Spin each group of nodes in a thread of its own."""
    stop = threading.Event()

    def spin(nodes: Sequence[Any]) -> None:
        executor = make_executor()
        for each in nodes:
            executor.add_node(each)
        while not stop.is_set():
            executor.spin_once(0.05)
        executor.shutdown()

    threads = [threading.Thread(target=spin, args=(nodes,)) for nodes in groups]
    for thread in threads:
        thread.start()
    try:
        yield
    finally:
        stop.set()
        for thread in threads:
            thread.join(20)
