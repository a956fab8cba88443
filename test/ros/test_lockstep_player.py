"""A motion player in lockstep with members of all kinds, in one process."""

from __future__ import annotations

import json
import time
from collections import defaultdict
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
from geometry_msgs.msg import PoseStamped
from rclpy.parameter import Parameter
from ros_support import Client, write_scene
from rosgraph_msgs.msg import Clock
from sensor_msgs.msg import Image, MultiDOFJointState, TimeReference
from std_msgs.msg import Header, String
from std_srvs.srv import SetBool, Trigger
from waiting import wait_until

from humansim_ros.data import messages
from humansim_ros.errors import RosError
from humansim_ros.ros.graph.qos import ALIVE, CAMERA_ALIVE
from humansim_ros.ros.nodes.motion_player import MotionPlayerNode
from humansim_ros.ros.processes.lockstep_settings import CLOCK_SEARCH
from humansim_ros.ros.processes.runtime import make_executor

SECOND = 1_000_000_000
CAMERAS = "/led/left, /led/right"


class Stage:
    """A player in namespace ``led``, and a client that stands in for cameras and trackers."""

    def __init__(self, scene: Path, executor: Any = None) -> None:
        self._scene = scene
        self.client = Client("stand_in", executor)
        self.reports = self.client.node.create_publisher(Header, "/led/frame_done", 10)
        self.stamps: list[int] = []
        self.order: list[tuple[str, int]] = []
        self.scene_times: dict[int, int] = {}
        for kind, topic in (
            (Clock, "/clock"),
            (TimeReference, "/led/scene_time"),
            (MultiDOFJointState, "/led/humans/first/motion"),
        ):
            self.client.node.create_subscription(kind, topic, self._listener(topic), 100)
        self.players: list[MotionPlayerNode] = []

    def _listener(self, topic: str) -> Callable[[Any], None]:
        def on_message(message: Any) -> None:
            stamp = messages.to_nanoseconds(message.clock if topic == "/clock" else message.header.stamp)
            self.order.append((topic, stamp))
            if isinstance(message, TimeReference):
                self.stamps.append(stamp)
                self.scene_times[stamp] = messages.to_nanoseconds(message.time_ref)

        return on_message

    def player(self, name: str = "motion_player", **parameters: Any) -> MotionPlayerNode:
        """Start a player, which looks for no other one unless ``parameters`` say so."""
        given = {"scene": str(self._scene), "mode": "lockstep", "clock_search": 0.0, **parameters}
        player = MotionPlayerNode(
            parameter_overrides=[Parameter(key, value=value) for key, value in given.items()],
            namespace="led",
            cli_args=["--ros-args", "-r", f"__node:={name}"],
        )
        self.players.append(player)
        self.client.executor.add_node(player)
        return player

    def kill(self, player: MotionPlayerNode) -> None:
        """End a player without its knowledge."""
        self.players.remove(player)
        self.client.executor.remove_node(player)
        player.destroy_node()

    def sees(self, condition: Callable[[], object]) -> bool:
        return self.client.spin_until(condition)

    def report(self, stamp: int, name: str = CAMERAS) -> None:
        self.reports.publish(messages.header(stamp, name))

    def finish(self, stamp: int, name: str = CAMERAS) -> None:
        """Wait for a frame, and report it."""
        assert self.sees(lambda: stamp in self.stamps), (stamp, self.stamps)
        self.report(stamp, name)

    def begin(self, player: MotionPlayerNode, kind: Any, name: str, **fields: Any) -> Any:
        """Send a request; returns the future of the answer."""
        client = self.client.node.create_client(kind, f"/led/{player.get_name()}/{name}")
        assert self.sees(client.service_is_ready)
        return client.call_async(kind.Request(**fields))

    def call(self, player: MotionPlayerNode, kind: Any, name: str, **fields: Any) -> Any:
        future = self.begin(player, kind, name, **fields)
        assert self.sees(future.done)
        return future.result()

    def close(self) -> None:
        for player in list(self.players):
            self.kill(player)
        self.client.close()


@pytest.fixture
def stage(ros: None, tmp_path: Path) -> Iterator[Stage]:
    stage = Stage(write_scene(tmp_path))
    yield stage
    stage.close()


def stamp_of(frame: int) -> int:
    return 1 + frame * SECOND // 20


def test_the_clock_comes_first_and_the_next_frame_when_all_have_finished(stage: Stage) -> None:
    stage.player(frames=3)
    for frame in range(3):
        stage.finish(stamp_of(frame), "/led/left")
        assert not stage.client.spin_until(lambda frame=frame: stamp_of(frame + 1) in stage.stamps, 0.3)
        stage.report(stamp_of(frame), "/led/right")
    (player,) = stage.players
    assert stage.sees(lambda: player.exit_code is not None)
    assert player.exit_code == 0
    assert sorted(set(stage.stamps)) == [stamp_of(frame) for frame in range(3)]
    firsts = list(dict.fromkeys(stage.order))
    clock = [stamp for topic, stamp in stage.order if topic == "/clock"]
    assert clock == sorted(clock)
    assert {topic for topic, _ in firsts} == {"/clock", "/led/scene_time", "/led/humans/first/motion"}


def test_a_topic_of_any_type_with_a_header_is_a_member_and_old_stamps_are_none(stage: Stage) -> None:
    stage.player(wait_for=["topic:/tracker/poses"])
    poses = stage.client.node.create_publisher(PoseStamped, "/tracker/poses", 10)
    stage.finish(stamp_of(0))
    assert stage.sees(lambda: poses.get_subscription_count())

    def publish(stamp: int) -> None:
        poses.publish(PoseStamped(header=messages.header(stamp, "map")))

    publish(stamp_of(0))
    stage.finish(stamp_of(1))
    publish(stamp_of(0))
    publish(stamp_of(0))
    assert not stage.client.spin_until(lambda: stamp_of(2) in stage.stamps, 0.5)
    publish(10**18)  # newer than the frame: it finishes this frame, and no other
    stage.finish(stamp_of(2))
    assert not stage.client.spin_until(lambda: stamp_of(3) in stage.stamps, 0.5)


@pytest.mark.parametrize("kind", [String, TimeReference])
def test_a_topic_without_a_header_is_refused(stage: Stage, kind: Any) -> None:
    publisher = stage.client.node.create_publisher(kind, "/tracker/poses", 10)
    player = stage.player(wait_for=["topic:/tracker/poses"])
    stage.finish(stamp_of(0))
    if kind is TimeReference:  # its first field is a header
        assert stage.sees(lambda: publisher.get_subscription_count())
        publisher.publish(TimeReference(header=messages.header(stamp_of(0), "")))
        assert stage.sees(lambda: stamp_of(1) in stage.stamps)
    else:
        assert stage.sees(lambda: player.exit_code is not None)
        assert player.exit_code == 2


@pytest.mark.parametrize(
    "name", ["nothing_msgs/msg/Pose", "os/msg/path", "antigravity/msg/X", "a/b", "../x/msg/Y", "x" * 9999]
)
def test_a_type_of_the_graph_that_is_not_installed_is_refused(name: str) -> None:
    from humansim_ros.ros.graph.graph import Endpoint, _usable

    with pytest.raises(RosError, match="/x: "):
        _usable("/x", [Endpoint("/tracker", name, True)])


def test_who_reports_is_waited_for_until_its_publisher_is_gone(stage: Stage) -> None:
    stage.player()
    tracker = Client("tracker")
    stage.client.executor.add_node(tracker.node)
    done = tracker.node.create_publisher(Header, "/led/frame_done", 10)
    assert stage.sees(lambda: stage.stamps and done.get_subscription_count())
    done.publish(messages.header(stamp_of(0), "tracker"))
    stage.finish(stamp_of(0))
    stage.finish(stamp_of(1))
    assert not stage.client.spin_until(lambda: stamp_of(2) in stage.stamps, 1.0)
    stage.client.executor.remove_node(tracker.node)
    tracker.close()
    assert stage.sees(lambda: stamp_of(2) in stage.stamps)


def test_reports_with_many_names_and_hostile_ones_do_no_harm(stage: Stage) -> None:
    stage.player()
    assert stage.sees(lambda: stage.stamps)
    for name in (
        ", ".join(map(str, range(100_000))),
        ", ".join(map(str, range(9000))),
        ",,, ",
        "\x00é\n" * 9,
    ):
        stage.report(stamp_of(0), name)
        stage.report(0, name)
    assert stage.sees(lambda: len(stage.players[0].playing.state.members) == 2 + 100)


def test_a_player_that_was_killed_goes_on_with_the_newest_finished_frame(stage: Stage) -> None:
    alive = stage.client.node.create_publisher(Header, f"/led/{CAMERA_ALIVE}", ALIVE)
    first = stage.player()
    for frame in range(4):
        stage.finish(stamp_of(frame))
        alive.publish(messages.header(stamp_of(frame), CAMERAS))
    assert stage.sees(lambda: stamp_of(4) in stage.stamps)
    stage.kill(first)
    stage.stamps.clear()
    stage.player(clock_search=CLOCK_SEARCH)  # in this time it hears of the camera, too
    assert stage.sees(lambda: stage.stamps)
    assert stage.stamps[0] == stamp_of(3)
    stage.finish(stamp_of(3))
    stage.finish(stamp_of(4))


def test_a_reporter_of_other_qos_does_not_end_the_executor(ros: None, tmp_path: Path) -> None:
    """The EventsExecutor fails at an event of a subscription that has been destroyed meanwhile."""
    stage = Stage(write_scene(tmp_path), make_executor())
    camera = stage.client.node.create_publisher(Header, f"/led/{CAMERA_ALIVE}", ALIVE)
    player = stage.player()
    stage.client.spin_until_matched(player)
    stage.finish(stamp_of(0))
    assert stage.sees(lambda: stamp_of(1) in stage.stamps)
    camera.publish(messages.header(stamp_of(0), CAMERAS))
    other = Client("of_other_qos")  # its executor is not spun: the event waits behind the report
    volatile = other.node.create_publisher(Header, f"/led/{CAMERA_ALIVE}", 10)
    assert wait_until(lambda: player.count_publishers(volatile.topic_name) == 2)
    stage.finish(stamp_of(1))
    stage.finish(stamp_of(2))
    other.close()
    stage.close()


def test_the_later_of_two_players_names_the_other_and_ends(
    stage: Stage, capfd: pytest.CaptureFixture[str]
) -> None:
    first = stage.player("early_player")
    assert stage.sees(lambda: stage.stamps)
    second = stage.player("late_player", clock_search=2.0)
    assert stage.sees(lambda: second.exit_code is not None)
    assert (first.exit_code, second.exit_code) == (None, 2)
    assert "another node publishes /clock: /led/early_player" in capfd.readouterr().err


def test_steps_and_restarts_of_a_pause_are_frames_as_any_others(stage: Stage) -> None:
    player = stage.player()
    stage.finish(stamp_of(0))
    assert stage.sees(lambda: stamp_of(1) in stage.stamps)
    stage.call(player, SetBool, "pause", data=True)
    stage.finish(stamp_of(1))
    assert not stage.client.spin_until(lambda: stamp_of(2) in stage.stamps, 0.5)
    for frame in (2, 3, 4):
        answer = json.loads(stage.call(player, Trigger, "step").message)
        assert answer["stamp"] == {"sec": 0, "nanosec": stamp_of(frame)}
        assert answer["scene_time"] == pytest.approx(frame / 20)
    for frame in (2, 3, 4):
        stage.finish(stamp_of(frame))
    answer = json.loads(stage.call(player, Trigger, "restart").message)
    assert (answer["stamp"]["nanosec"], answer["scene_time"]) == (stamp_of(5), 0.0)
    stage.finish(stamp_of(5))
    assert not stage.client.spin_until(lambda: stamp_of(6) in stage.stamps, 0.5)
    stage.call(player, SetBool, "pause", data=False)
    stage.finish(stamp_of(6))
    assert stage.scene_times[stamp_of(5)] == 0
    assert stage.scene_times[stamp_of(6)] == SECOND // 20


@pytest.fixture(params=["lockstep", "realtime"])
def stepped(stage: Stage, request: pytest.FixtureRequest) -> tuple[Stage, MotionPlayerNode, Any]:
    """A paused player whose steps wait for ``/tracker/poses``, and the publisher of this topic."""
    poses = stage.client.node.create_publisher(PoseStamped, "/tracker/poses", 10)
    player = stage.player(mode=request.param, step_topic="/tracker/poses")
    assert stage.sees(lambda: stage.stamps)
    assert stage.call(player, SetBool, "pause", data=True).success
    stage.report(stage.stamps[-1])
    return stage, player, poses


def set_parameters(player: MotionPlayerNode, **values: Any) -> list[Any]:
    return player.set_parameters([Parameter(name, value=value) for name, value in values.items()])


def test_a_step_returns_after_the_message_with_its_stamp_and_no_other(stepped: Any) -> None:
    stage, player, poses = stepped
    for _ in range(2):
        elapsed = player.playback_clock.elapsed + 50_000_000
        answer = stage.begin(player, Trigger, "step")
        assert stage.sees(lambda e=elapsed: e in stage.scene_times.values())
        # the first frame of this scene time: a paused player in real time repeats it with later stamps
        stamp = next(stamp for stamp, shown in stage.scene_times.items() if shown == elapsed)
        stage.report(stamp)
        for other in (stamp - 1, stamp + 1, 0):
            poses.publish(PoseStamped(header=messages.header(other, "map")))
        assert not stage.client.spin_until(answer.done, 0.3)
        refused = stage.call(player, Trigger, "step")
        assert not refused.success and "another step waits for /tracker/poses" in refused.message
        poses.publish(PoseStamped(header=messages.header(stamp, "map")))
        assert stage.sees(answer.done)
        assert answer.result().success
        told = json.loads(answer.result().message)["stamp"]
        assert told["sec"] * SECOND + told["nanosec"] == stamp


def test_a_step_without_its_message_fails_with_the_newest_stamp_of_the_topic(stepped: Any) -> None:
    stage, player, poses = stepped
    set_parameters(player, step_timeout=0.5)
    answer = stage.begin(player, Trigger, "step")
    seen = len(stage.stamps)
    assert stage.sees(lambda: len(stage.stamps) > seen)
    stage.report(player.playback_clock.last)
    poses.publish(PoseStamped(header=messages.header(1, "map")))
    assert stage.sees(answer.done)
    assert not answer.result().success
    assert "on /tracker/poses within 0.5 s (step_timeout); newest stamp there: 0.000000001" in (
        answer.result().message
    )
    stage.report(player.playback_clock.last)
    set_parameters(player, step_topic="/nobody")
    before = player.playback_clock.elapsed
    answer = stage.call(player, Trigger, "step")
    assert not answer.success
    assert answer.message.startswith("no frame was played: nobody publishes /nobody")
    assert player.playback_clock.elapsed == before
    set_parameters(player, step_topic="")
    assert stage.call(player, Trigger, "step").success


def test_a_topic_of_steps_without_a_header_fails_the_step_and_ends_nothing(stage: Stage) -> None:
    stage.client.node.create_publisher(String, "/tracker/words", 10)
    player = stage.player(step_topic="/tracker/words")
    stage.finish(stamp_of(0))
    stage.call(player, SetBool, "pause", data=True)
    answer = stage.call(player, Trigger, "step")
    assert not answer.success
    assert answer.message == "step_topic /tracker/words: std_msgs/msg/String does not begin with a header"
    assert player.exit_code is None


@pytest.mark.parametrize(
    "name",
    ["/", "a//b", "/1a", "a b", "~/x", "/x\n", "/\u202ex", "../x", "{x}", "/x/", "/*", "é", "x" * 9999],
)
def test_a_hostile_name_of_a_topic_of_steps_is_refused_and_changes_nothing(stage: Stage, name: str) -> None:
    player = stage.player()
    (result,) = set_parameters(player, step_topic=name)
    assert not result.successful
    assert result.reason.startswith("step_topic: ") and len(result.reason) < 200
    assert "\u202e" not in result.reason and "\n" not in result.reason
    assert player.stamped_steps.topic == ""
    with pytest.raises(RosError, match="step_topic"):
        stage.player("second", step_topic=name)


def test_a_done_callback_comes_when_all_members_have_finished_the_last_step(stage: Stage) -> None:
    player = stage.player()
    assert stage.sees(lambda: stage.stamps)
    player.playing.pause(True)
    done: list[int] = []
    player.playing.step()
    player.playing.step(lambda: done.append(stage.stamps[-1]))
    for frame in range(3):
        assert not done
        stage.finish(stamp_of(frame))
    assert stage.sees(lambda: done)


def test_a_node_that_joins_during_a_pause_gets_the_frame_again(stage: Stage) -> None:
    player = stage.player()
    assert stage.sees(lambda: stage.stamps)
    player.playing.pause(True)
    stage.report(stamp_of(0))
    assert stage.sees(lambda: player.playing.state.is_finished)
    late: list[int] = []
    node = Client("late").node
    stage.client.executor.add_node(node)
    node.create_subscription(
        TimeReference, "/led/scene_time", lambda m: late.append(messages.to_nanoseconds(m.header.stamp)), 10
    )
    assert stage.sees(lambda: late)
    assert set(late) == {stamp_of(0)}
    stage.client.executor.remove_node(node)
    node.destroy_node()


@pytest.mark.parametrize(
    ("parameters", "problem"),
    [
        ({"mode": "warp"}, "parameter mode: no value 'warp'; there are realtime, lockstep"),
        ({"wait_for": ["a b"]}, "'a b' is neither"),
        ({"wait_for": [f"m{number}" for number in range(101)]}, "101 members"),
        ({"frames": -1}, "frames"),
        ({"timeout": 0.0}, "timeout"),
        ({"on_timeout": "explode"}, "no value 'explode'; there are stop, continue"),
    ],
)
def test_a_wrong_parameter_of_lockstep_is_refused(
    ros: None, tmp_path: Path, parameters: dict[str, Any], problem: str
) -> None:
    given = {"scene": str(write_scene(tmp_path)), "mode": "lockstep", **parameters}
    with pytest.raises(RosError, match=problem):
        MotionPlayerNode(parameter_overrides=[Parameter(key, value=value) for key, value in given.items()])


def test_a_player_in_lockstep_is_never_late_and_drops_nothing(stage: Stage) -> None:
    """Its stamps are far from the wall clock."""
    from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus

    player = stage.player()
    statuses: list[DiagnosticStatus] = []
    stage.client.node.create_subscription(
        DiagnosticArray,
        "/diagnostics",
        lambda m: statuses.extend(s for s in m.status if s.name == "/led/motion_player"),
        10,
    )
    frame = 0
    while len(statuses) < 2:
        stage.finish(stamp_of(frame))
        frame += 1
    assert all(status.level == DiagnosticStatus.OK for status in statuses)
    assert not [value.key for status in statuses for value in status.values if "lateness" in value.key]
    assert player.exit_code is None


@pytest.mark.slow
def test_a_frame_that_is_sent_again_has_the_same_images_and_flow(ros: None, tmp_path: Path) -> None:
    """A player, skinners and cameras in lockstep. Backward flow compares with the frame before."""
    from humansim_ros.render.interface.channels import CHANNEL_TABLE
    from humansim_ros.ros.nodes.camera_rig import CameraRigNode
    from humansim_ros.ros.nodes.skinner import SkinnerNode

    scene = Parameter("scene", value=str(write_scene(tmp_path)))
    player = MotionPlayerNode(
        parameter_overrides=[scene, Parameter("mode", value="lockstep")], namespace="again"
    )
    player.playing.pause(True)
    skinners = [
        SkinnerNode(
            parameter_overrides=[scene, Parameter("human", value=name)],
            namespace="again",
            cli_args=["--ros-args", "-r", f"__node:=skinner_{name}"],
        )
        for name in ("first", "second")
    ]
    rig = CameraRigNode(parameter_overrides=[scene, Parameter("start_scene", value=False)], namespace="again")
    client = Client("compares")
    for node in (player, *skinners, *rig.nodes):
        client.executor.add_node(node)
    images: dict[tuple[str, int], list[bytes]] = defaultdict(list)
    topics = [f"/again/left/{CHANNEL_TABLE[name].topic}" for name in ("rgb", "depth", "flow_back")]

    def listen(topic: str) -> None:
        def on_image(message: Any) -> None:
            images[topic, messages.to_nanoseconds(message.header.stamp)].append(bytes(message.data))

        client.node.create_subscription(Image, topic, on_image, 50)

    for topic in topics:
        listen(topic)
    client.spin_until_matched(player, *skinners, *rig.nodes)
    for frame in range(3):
        done: list[int] = []
        player.playing.step(lambda done=done: done.append(1))
        assert client.spin_until(lambda done=done: done), frame
    last = stamp_of(2)
    assert client.spin_until(lambda: all(images[topic, last] for topic in topics))
    before = {topic: len(images[topic, last]) for topic in topics}
    player.playing._send()  # as for a node that has joined
    assert client.spin_until(lambda: all(len(images[topic, last]) > before[topic] for topic in topics))
    for topic in topics:
        assert len(set(images[topic, last])) == 1, topic
    assert any(images[topics[2], last][0])
    for node in (player, *skinners, rig):
        node.close()
        node.destroy_node()
    client.close()


def test_a_player_goes_on_with_the_frame_in_flight_also_before_it_has_found_a_camera(
    stage: Stage, tmp_path: Path
) -> None:
    summary = str(tmp_path / "summary.json")
    first = stage.player(summary=summary)
    for frame in range(3):
        stage.finish(stamp_of(frame))
    assert stage.sees(lambda: stamp_of(3) in stage.stamps)
    stage.kill(first)  # which writes no summary
    stage.stamps.clear()
    second = stage.player(summary=summary, frames=5)
    assert stage.sees(lambda: stage.stamps)
    assert stage.stamps[0] == stamp_of(3)
    stage.finish(stamp_of(3))
    stage.finish(stamp_of(4))
    assert stage.sees(lambda: second.exit_code is not None)
    told = json.loads((tmp_path / "summary.json").read_text())
    assert (told["frames"], told["sent"], told["is_complete"]) == (5, 2, True)
    assert [path.name for path in tmp_path.glob("summary*")] == ["summary.json"]


def test_frames_are_not_faster_than_the_pace(stage: Stage) -> None:
    stage.player(pace=4.0)
    assert stage.sees(lambda: stage.stamps)
    begin = time.monotonic()
    for frame in range(5):
        stage.finish(stamp_of(frame))
    assert time.monotonic() - begin > 0.6  # four quarters of a second, of which the first may be over
