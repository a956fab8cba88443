"""Services of simulation_interfaces: a client that knows only the standard drives the player."""

from __future__ import annotations

import math
import os
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from conftest import ROOT
from ros_support import Client, write_scene
from scipy.spatial.transform import Rotation
from waiting import PATIENCE

from humansim_ros import messages
from humansim_ros.ros.nodes.motion_player import MotionPlayerNode
from humansim_ros.ros.processes.node_processes import QUIT
from humansim_ros.ros.qos import DATA, DONE, LATCHED
from humansim_ros.ros.runtime import make_executor
from humansim_ros.scene import Scene

pytestmark = pytest.mark.usefixtures("interfaces")

SCENE = """\
rate: 20
room: null
humans:
  walker: {motion: {file: walk, position: [0.0, -1], yaw_deg: 30, loop: continue}}
  carried: {motion: {file: walk}, keyframes: moves.xml}
  other: {motion: {file: live}}
objects:
  box: {size: [0.1, 0.4, 1.8], position: [0, 0, 0.9], keyframes: moves.xml}
  post: {mesh: cylinder, position: [-1, 1, 0.5]}
cameras:
  left: {size: [160, 120], position: [5, 0, 1.5], look_at: [0, 0, 1]}
  dolly: {size: [160, 120], fov_deg: 60, trajectory: {file: dolly.txt}}
"""
MOVES = """\
<animation startframe="0" endframe="1000" rate="10">
  <object name="carried">
    <frame number="0"><position x="0" y="0" z="0"/></frame>
    <frame number="1000"><position x="19" y="0" z="0"/></frame>
  </object>
  <object name="box">
    <frame number="0"><position x="2" y="-1" z="0"/></frame>
    <frame number="1000"><position x="2" y="99" z="0"/><rotation x="0" y="0" z="100"/></frame>
  </object>
</animation>
"""
DOLLY = "".join(f"{t} {t} 0 1.5 0.5 0.5 0.5 0.5\n" for t in range(100))


class Tool:
    """A client of the standard services, and the stamps and scene times of all frames."""

    def __init__(self) -> None:
        from sensor_msgs.msg import TimeReference

        self.client = Client("driver", make_executor())
        self.node = self.client.node
        self.frames: list[tuple[int, int]] = []
        self.node.create_subscription(TimeReference, "scene_time", self._on_frame, 500)
        self._clients: dict[str, Any] = {}

    def _on_frame(self, message: Any) -> None:
        self.frames.append((messages.to_nanoseconds(message.header.stamp), messages.read_scene_time(message)))

    def spin_until(self, done: Callable[[], object]) -> None:
        assert self.client.spin_until(done)

    def begin(self, service: str, **fields: Any) -> Any:
        """Send a request; returns the future of the answer."""
        import simulation_interfaces.srv as services

        kind = getattr(services, service)
        name = "".join(f"_{c.lower()}" if c.isupper() else c for c in service).lstrip("_")
        if service not in self._clients:
            self._clients[service] = self.node.create_client(kind, f"/motion_player/{name}")
            self.spin_until(self._clients[service].service_is_ready)
        return self._clients[service].call_async(kind.Request(**fields))

    def call(self, service: str, **fields: Any) -> Any:
        future = self.begin(service, **fields)
        self.spin_until(future.done)
        return future.result()

    def code(self, service: str, **fields: Any) -> tuple[int, str]:
        """Code and message of the result of a request."""
        result = self.call(service, **fields).result
        return result.result, result.error_message

    def set_state(self, name: str) -> tuple[int, str]:
        from simulation_interfaces.msg import SimulationState

        return self.code(
            "SetSimulationState", state=SimulationState(state=getattr(SimulationState, f"STATE_{name}"))
        )

    def state(self) -> int:
        return int(self.call("GetSimulationState").state.state)

    def pose(self, entity: str) -> tuple[np.ndarray, np.ndarray, Any]:
        """Position, quaternion and twist of an entity."""
        answer = self.call("GetEntityState", entity=entity)
        assert answer.result.result == OK, answer.result
        p, q = answer.state.pose.position, answer.state.pose.orientation
        return np.array([p.x, p.y, p.z]), np.array([q.x, q.y, q.z, q.w]), answer.state.twist

    def place(
        self, entity: str, position: Any, rotation: Any = (0, 0, 0, 1), **changes: Any
    ) -> tuple[int, str]:
        return self.code("SetEntityState", entity=entity, state=entity_state(position, rotation, **changes))

    def entities(self, **filters: Any) -> list[str]:
        from simulation_interfaces.msg import EntityFilters

        answer = self.call("GetEntities", filters=EntityFilters(**filters))
        assert answer.result.result == OK, answer.result
        return list(answer.entities)

    def close(self) -> None:
        """Leave the graph: nodes of an executor that is not shut down stay in it, and so would ``/clock``."""
        self.client.executor.remove_node(self.node)
        self.client.executor.shutdown()
        self.client.close()


class Driver(Tool):
    """A player and a client, which stands in for the cameras and reports their frames."""

    def __init__(self, scene: Path, mode: str) -> None:
        from rclpy.parameter import Parameter
        from std_msgs.msg import Header

        super().__init__()
        given = [Parameter("scene", value=str(scene)), Parameter("mode", value=mode)]
        self.mode = mode
        self.player = MotionPlayerNode(parameter_overrides=given)
        self.client.executor.add_node(self.player)
        self.answers = True
        self._report = self.node.create_publisher(Header, "frame_done", DONE)

    def _on_frame(self, message: Any) -> None:
        super()._on_frame(message)
        if self.answers:
            self.report()

    def report(self) -> None:
        """Say that the cameras have finished the newest frame."""
        self._report.publish(messages.header(self.frames[-1][0], "left, dolly"))

    def close(self) -> None:
        self.player.close()
        self.client.executor.remove_node(self.player)
        self.player.destroy_node()
        super().close()


#: Codes of the standard.
UNSUPPORTED, OK, NOT_FOUND, INCORRECT_STATE, FAILED, ALREADY = 0, 1, 2, 3, 4, 101
STOPPED, PLAYING, PAUSED = 0, 1, 2


def entity_state(position: Any, rotation: Any = (0, 0, 0, 1), frame: str = "map", speed: float = 0.0) -> Any:
    from simulation_interfaces.msg import EntityState

    state = EntityState()
    state.header.frame_id = frame
    p, q = state.pose.position, state.pose.orientation
    p.x, p.y, p.z = map(float, position)
    q.x, q.y, q.z, q.w = map(float, rotation)
    state.twist.linear.x = speed
    return state


def yaw(degrees: float) -> Any:
    return Rotation.from_euler("z", degrees, degrees=True).as_quat()


@pytest.fixture(scope="module")
def scene(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("services")
    (folder / "moves.xml").write_text(MOVES)
    (folder / "dolly.txt").write_text(DOLLY)
    return write_scene(folder, SCENE)


@pytest.fixture(scope="module", params=["realtime", "lockstep"])
def running(ros: None, interfaces: Path, scene: Path, request: pytest.FixtureRequest) -> Iterator[Driver]:
    """A player for the tests of a mode; tests with a player of their own come before all that use it."""
    driver = Driver(scene, request.param)
    driver.spin_until(lambda: driver.frames)
    yield driver
    driver.close()


@pytest.fixture
def driver(running: Driver) -> Driver:
    """The player at its start, with all entities at their places, playing."""
    running.answers = True
    running.report()
    assert running.code("ResetSimulation") == (OK, "")
    assert running.set_state("PLAYING")[0] in (OK, ALREADY)
    running.frames.clear()
    running.client.received.clear()
    running.spin_until(lambda: running.frames)
    return running


@pytest.fixture
def paused(driver: Driver) -> Driver:
    assert driver.set_state("PAUSED") == (OK, "")
    return driver


@pytest.mark.parametrize("mode", ["realtime", "lockstep"])
def test_quitting_ends_the_player_with_its_own_code(ros: None, scene: Path, mode: str) -> None:
    driver = Driver(scene, mode)
    driver.spin_until(lambda: driver.frames)
    assert driver.set_state("QUITTING") == (OK, "")
    driver.spin_until(lambda: driver.player.exit_code is not None)
    assert driver.player.exit_code == QUIT
    driver.close()


def test_without_the_package_a_player_has_its_own_services_only(
    ros: None, scene: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for name in ("simulation_interfaces", "simulation_interfaces.msg"):
        monkeypatch.setitem(sys.modules, name, None)
    driver = Driver(scene, "realtime")
    names = {service.srv_name for service in driver.player.services}
    assert any(name.endswith("/pause") for name in names)
    assert not any("entit" in name or "simulat" in name for name in names)
    driver.spin_until(lambda: len(driver.frames) > 3)
    driver.close()


@pytest.mark.slow
@pytest.mark.parametrize("mode", [pytest.param("realtime", marks=pytest.mark.nightly), "lockstep"])
def test_a_running_suite_is_driven_by_the_standard_alone(
    ros: None, interfaces: Path, tmp_path: Path, mode: str
) -> None:
    from geometry_msgs.msg import TransformStamped

    scene = write_scene(tmp_path)
    environment = {**os.environ, "PYTHONPATH": f"{ROOT}{os.pathsep}{interfaces}"}
    tool = Tool()
    run = subprocess.Popen(
        [sys.executable, "-m", "humansim_ros.cli", "run", str(scene), f"--{mode}"], env=environment
    )
    try:
        tool.client.subscribe(TransformStamped, ["/left/extrinsics"], LATCHED)
        shown = tool.client.received["/left/extrinsics"]
        tool.spin_until(lambda: len(tool.frames) > 3 and shown)
        assert tool.set_state("PAUSED") == (OK, "") and tool.state() == PAUSED
        assert tool.code("StepSimulation", steps=1) == (OK, "")
        begin = tool.call("GetEntityState", entity="humans/first").state.header.stamp
        assert tool.code("StepSimulation", steps=5) == (OK, "")
        end = tool.call("GetEntityState", entity="humans/first").state.header.stamp
        passed = messages.to_nanoseconds(end) - messages.to_nanoseconds(begin)
        assert mode == "realtime" or passed == 5 * 50_000_000
        # a player may discover a camera later than this tool does
        tool.spin_until(lambda: tool.place("left", (3, 3, 2), yaw(0)) == (OK, ""))
        assert tool.code("StepSimulation", steps=1) == (OK, "")
        tool.spin_until(lambda: shown[max(shown)].transform.translation.y == pytest.approx(3))
        assert tool.set_state("QUITTING") == (OK, "")
        assert run.wait(PATIENCE) == 0
    finally:
        run.terminate()
        run.wait()
        tool.close()


def test_features_are_those_that_the_services_have(driver: Driver) -> None:
    from simulation_interfaces.msg import SimulatorFeatures

    features = set(driver.call("GetSimulatorFeatures").features.features)
    named = {name: getattr(SimulatorFeatures, name) for name in dir(SimulatorFeatures) if name.isupper()}
    names = {name for name, number in named.items() if isinstance(number, int) and number in features}
    assert len(names) == len(features)
    assert {"ENTITY_STATE_SETTING", "STEP_SIMULATION_ACTION", "SIMULATION_RESET_STATE"} <= names
    assert not {name for name in names if "SPAWN" in name or "BOUNDS" in name or "WORLD" in name}


def test_the_simulation_plays_pauses_and_stops(driver: Driver) -> None:
    assert driver.state() == PLAYING
    code, text = driver.set_state("PLAYING")
    assert code == ALREADY and text
    driver.spin_until(lambda: driver.frames[-1][1] > 0)
    assert driver.set_state("PAUSED") == (OK, "") and driver.state() == PAUSED
    assert driver.player.playback_clock.elapsed > 0
    assert driver.set_state("STOPPED") == (OK, "") and driver.state() == STOPPED
    driver.spin_until(lambda: driver.frames[-1][1] == 0)
    assert driver.set_state("PAUSED") == (OK, "") and driver.state() == PAUSED
    assert driver.set_state("PLAYING") == (OK, "") and driver.state() == PLAYING
    driver.spin_until(lambda: driver.frames[-1][1] > 0)
    stamps = [stamp for stamp, _ in driver.frames]
    assert stamps == sorted(stamps)


@pytest.mark.parametrize("state", [4, 5, 9, 255])
def test_other_states_cannot_be_set(driver: Driver, state: int) -> None:
    from simulation_interfaces.msg import SimulationState

    code, text = driver.code("SetSimulationState", state=SimulationState(state=state))
    assert code == UNSUPPORTED and str(state) in text
    assert driver.state() == PLAYING


def test_steps_are_frames_of_the_paused_simulation(paused: Driver) -> None:
    before = paused.player.playback_clock.elapsed
    assert paused.code("StepSimulation", steps=7) == (OK, "")
    assert paused.player.playback_clock.elapsed - before == 7 * 50_000_000
    assert paused.state() == PAUSED
    assert paused.code("StepSimulation") == (OK, "")
    assert paused.player.playback_clock.elapsed - before == 8 * 50_000_000
    paused.spin_until(lambda: paused.frames[-1][1] - before == 8 * 50_000_000)


def test_steps_need_a_pause_and_a_number(driver: Driver) -> None:
    code, text = driver.code("StepSimulation", steps=3)
    assert code == FAILED and "paused" in text
    driver.set_state("PAUSED")
    code, text = driver.code("StepSimulation", steps=0)
    assert code == FAILED and "1 or more" in text


@pytest.mark.parametrize("running", ["lockstep"], indirect=True)
def test_a_step_in_lockstep_ends_when_the_cameras_have_finished_it(driver: Driver) -> None:
    driver.set_state("PAUSED")
    driver.code("StepSimulation", steps=1)
    driver.answers = False
    count = len({stamp for stamp, _ in driver.frames})
    future = driver.begin("StepSimulation", steps=2)
    for number in (1, 2):
        driver.spin_until(lambda number=number: len({stamp for stamp, _ in driver.frames}) == count + number)
        assert driver.state() == PAUSED and not future.done()
        code, text = driver.code("StepSimulation", steps=1)
        assert code == FAILED and f"{3 - number} steps are being simulated" in text
        driver.report()
    driver.spin_until(future.done)
    assert future.result().result.result == OK


def test_steps_wait_for_the_message_of_each_frame_on_a_topic(paused: Driver) -> None:
    from rclpy.parameter import Parameter
    from std_msgs.msg import Header

    player = paused.player
    poses = paused.node.create_publisher(Header, "/tracker/poses", 10)
    player.set_parameters([Parameter("step_topic", value="/tracker/poses")])
    before = player.playback_clock.elapsed
    future = paused.begin("StepSimulation", steps=2)
    for number in (1, 2):
        elapsed = before + number * 50_000_000
        paused.spin_until(lambda e=elapsed: any(shown == e for _, shown in paused.frames))
        assert not paused.client.spin_until(future.done, 0.2)
        # the first frame of this scene time: a paused player repeats it with later stamps
        stamp = next(stamp for stamp, shown in paused.frames if shown == elapsed)
        poses.publish(messages.header(stamp, ""))
    paused.spin_until(future.done)
    assert future.result().result.result == OK
    player.set_parameters([Parameter("step_timeout", value=0.2)])
    code, text = paused.code("StepSimulation", steps=2)
    assert code == FAILED and "on /tracker/poses within 0.2 s" in text and text.endswith("after 0 steps")
    player.set_parameters([Parameter("step_timeout", value=600.0)])
    future = paused.begin("StepSimulation", steps=2)
    paused.spin_until(lambda: player.playback_clock.elapsed == before + 4 * 50_000_000)
    assert paused.set_state("PAUSED") == (OK, "")
    paused.spin_until(future.done)
    assert "meanwhile" in future.result().result.error_message
    player.set_parameters([Parameter("step_topic", value=""), Parameter("step_timeout", value=10.0)])
    paused.node.destroy_publisher(poses)


@pytest.mark.parametrize("interruption", ["PLAYING", "PAUSED", "STOPPED", "reset"])
def test_steps_without_end_are_ended_by_a_new_state(paused: Driver, interruption: str) -> None:
    future = paused.begin("StepSimulation", steps=2**64 - 1)
    seen = len(paused.frames)
    paused.spin_until(lambda: len(paused.frames) > seen + 3)
    done = paused.code("ResetSimulation") if interruption == "reset" else paused.set_state(interruption)
    assert done == (OK, "")
    paused.spin_until(future.done)
    result = future.result().result
    assert result.result == FAILED and "meanwhile, after" in result.error_message
    assert paused.state() == {"PLAYING": PLAYING, "STOPPED": STOPPED}.get(interruption, PAUSED)
    assert paused.code("StepSimulation")[0] == (FAILED if interruption == "PLAYING" else OK)


class Goals:
    """A client of the action."""

    def __init__(self, driver: Driver) -> None:
        from rclpy.action import ActionClient
        from simulation_interfaces.action import SimulateSteps

        self.driver, self.kind = driver, SimulateSteps
        self.feedback: list[tuple[int, int]] = []
        self.client = ActionClient(driver.node, SimulateSteps, "/motion_player/simulate_steps")
        driver.spin_until(self.client.server_is_ready)

    def send(self, steps: int) -> Any:
        """Send a goal; returns its handle."""

        def on_feedback(message: Any) -> None:
            self.feedback.append((message.feedback.completed_steps, message.feedback.remaining_steps))

        future = self.client.send_goal_async(self.kind.Goal(steps=steps), on_feedback)
        self.driver.spin_until(future.done)
        return future.result()

    def result(self, handle: Any) -> tuple[int, int, str]:
        """Status of a goal, and code and message of its result."""
        future = handle.get_result_async()
        self.driver.spin_until(future.done)
        result = future.result().result.result
        return future.result().status, result.result, result.error_message


@pytest.fixture
def goals(driver: Driver) -> Iterator[Goals]:
    goals = Goals(driver)
    yield goals
    goals.client.destroy()


def test_the_action_reports_each_finished_step(driver: Driver, goals: Goals) -> None:
    from action_msgs.msg import GoalStatus

    driver.set_state("PAUSED")
    before = driver.player.playback_clock.elapsed
    handle = goals.send(5)
    assert handle.accepted
    assert goals.result(handle) == (GoalStatus.STATUS_SUCCEEDED, OK, "")
    driver.spin_until(lambda: len(goals.feedback) == 5)
    assert goals.feedback == [(1, 4), (2, 3), (3, 2), (4, 1), (5, 0)]
    assert driver.player.playback_clock.elapsed - before == 5 * 50_000_000


def test_the_action_is_cancelled_and_takes_one_goal_at_a_time(driver: Driver, goals: Goals) -> None:
    from action_msgs.msg import GoalStatus

    driver.set_state("PAUSED")
    handle = goals.send(2**64 - 1)
    driver.spin_until(lambda: len(goals.feedback) > 2)
    assert handle.accepted and not goals.send(1).accepted
    assert driver.code("StepSimulation")[0] == FAILED
    driver.spin_until(handle.cancel_goal_async().done)
    status, code, text = goals.result(handle)
    assert (status, code) == (GoalStatus.STATUS_CANCELED, FAILED) and "cancelled" in text
    assert driver.code("StepSimulation") == (OK, "")
    assert goals.result(goals.send(1))[0] == GoalStatus.STATUS_SUCCEEDED


def test_a_goal_without_pause_or_steps_is_aborted(driver: Driver, goals: Goals) -> None:
    from action_msgs.msg import GoalStatus

    status, code, text = goals.result(goals.send(2))
    assert (status, code) == (GoalStatus.STATUS_ABORTED, FAILED) and "paused" in text
    driver.set_state("PAUSED")
    assert goals.result(goals.send(0))[:2] == (GoalStatus.STATUS_ABORTED, FAILED)
    assert goals.result(goals.send(1))[0] == GoalStatus.STATUS_SUCCEEDED


EVERYTHING = [
    "humans/walker",
    "humans/carried",
    "humans/other",
    "objects/box",
    "objects/post",
    "left",
    "dolly",
]


def test_entities_are_found_by_name_category_and_tag(driver: Driver) -> None:
    from simulation_interfaces.msg import EntityCategory, TagsFilter

    assert driver.entities() == EVERYTHING
    assert driver.entities(filter="^humans/[[:alpha:]]+er$") == ["humans/walker", "humans/other"]
    assert driver.entities(filter="o[sx]") == ["objects/box", "objects/post"]
    human, static = EntityCategory(category=2), EntityCategory(category=5)
    assert driver.entities(categories=[human, static], filter="o") == ["humans/other", "objects/post"]
    tags = ["camera", "static"]
    assert driver.entities(tags=TagsFilter(tags=tags)) == ["objects/post", "left", "dolly"]
    assert driver.entities(tags=TagsFilter(tags=tags, filter_mode=1)) == ["left"]
    assert driver.entities(tags=TagsFilter(tags=["no such tag"])) == []


def test_entities_have_their_standard_categories(driver: Driver) -> None:
    categories = {"humans/walker": 2, "objects/box": 4, "objects/post": 5, "left": 0}
    for entity, category in categories.items():
        info = driver.call("GetEntityInfo", entity=entity).info
        assert info.category.category == category and info.description
    assert list(info.tags) == ["camera", "static"]


@pytest.mark.parametrize("pattern", ["(", "a" * 10**6, "[[:foo:]]", "x{9999}", "(" * 200])
def test_a_pattern_that_is_none_is_refused(driver: Driver, pattern: str) -> None:
    from simulation_interfaces.msg import EntityFilters

    for service in ("GetEntities", "GetEntitiesStates"):
        code, text = driver.code(service, filters=EntityFilters(filter=pattern))
        assert code == FAILED and "pattern" in text and len(text) < 500


def test_filters_that_are_not_supported_say_so(driver: Driver) -> None:
    from simulation_interfaces.msg import Bounds, EntityCategory, EntityFilters

    assert driver.code("GetEntities", filters=EntityFilters(bounds=Bounds(type=3)))[0] == UNSUPPORTED
    many = [EntityCategory(category=2)] * 2000
    assert driver.code("GetEntities", filters=EntityFilters(categories=many))[0] == FAILED


def test_states_are_those_of_the_frame(paused: Driver, scene: Path) -> None:
    driver = paused
    driver.code("StepSimulation", steps=5)
    truth = Scene.load(scene)
    seconds = driver.player.playback_clock.elapsed * 1e-9
    poses = truth.actors["walker"].joint_poses(seconds)
    hips = poses.names.index("Hips")
    position, rotation, twist = driver.pose("humans/walker")
    np.testing.assert_allclose(position[:2], poses.positions[0, hips, :2], atol=1e-9)
    assert position[2] == 0 and not rotation[:2].any()
    facing = Rotation.from_quat(poses.rotations[0, hips]).as_matrix()[:, 0]
    np.testing.assert_allclose(
        Rotation.from_quat(rotation).as_matrix()[:2, 0], facing[:2] / np.linalg.norm(facing[:2]), atol=1e-9
    )
    moving = driver.mode == "lockstep"  # velocities are those of the messages: 0 during a pause in real time
    speed = np.array([twist.linear.x, twist.linear.y])
    np.testing.assert_allclose(speed, moving * poses.linear[0, hips, :2], atol=1e-9)
    early, late = (truth.actors["walker"].joint_poses(seconds + step) for step in (-1e-4, 1e-4))
    yaws = []
    for each in (early, late):
        x, y, _ = Rotation.from_quat(each.rotations[0, hips]).as_matrix()[:, 0]
        yaws.append(math.atan2(y, x))
    assert twist.angular.z == pytest.approx(moving * (yaws[1] - yaws[0]) / 2e-4, abs=0.05)
    box = truth.objects["box"].at(seconds)
    position, rotation, twist = driver.pose("objects/box")
    np.testing.assert_allclose([*position, *rotation], [*box.position, *box.rotation], atol=1e-9)
    assert twist.linear.y == pytest.approx(moving * box.velocity.linear[1])
    for name in ("left", "dolly"):
        camera = truth.scene_cameras[name].pose(seconds)
        position, rotation, _ = driver.pose(name)
        np.testing.assert_allclose(Rotation.from_quat(rotation).as_matrix(), camera.R.T, atol=1e-9)
        np.testing.assert_allclose(position, -camera.R.T @ camera.t, atol=1e-9)
    answer = driver.call("GetEntitiesStates")
    assert list(answer.entities) == [name for name in EVERYTHING if name != "humans/other"]
    assert len(answer.states) == len(answer.entities)
    code, text = driver.code("GetEntityState", entity="humans/other")
    assert code == FAILED and "another node" in text


@pytest.mark.parametrize(("position", "degrees"), [((1.5, -2.5, 0), 0), ((-3, 0.25, 0), 170)])
def test_a_human_is_put_somewhere_else_and_walks_on(paused: Driver, position: Any, degrees: float) -> None:
    driver = paused
    driver.code("StepSimulation", steps=3)
    before, facing, _ = driver.pose("humans/walker")
    assert driver.place("humans/walker", position, yaw(degrees)) == (OK, "")
    now, rotation, _ = driver.pose("humans/walker")
    np.testing.assert_allclose(now, position, atol=1e-9)
    np.testing.assert_allclose(abs(rotation @ yaw(degrees)), 1, atol=1e-9)
    turn = Rotation.from_quat(rotation) * Rotation.from_quat(facing).inv()
    elapsed = driver.player.playback_clock.elapsed
    driver.code("StepSimulation", steps=10)
    old = Scene.load(driver.player.scene.path).actors["walker"].joint_poses(elapsed * 1e-9 + 0.5)
    hips = old.positions[0, old.names.index("Hips")] * (1, 1, 0)
    expected = now + turn.apply(hips - before)
    np.testing.assert_allclose(driver.pose("humans/walker")[0], expected, atol=1e-6)


def test_an_object_is_put_somewhere_else_and_its_keyframes_go_on(paused: Driver) -> None:
    driver = paused
    driver.client.subscribe(marker_type(), ["/objects/box/marker"])
    assert driver.place("objects/box", (1, 2, 3), yaw(90)) == (OK, "")
    position, rotation, _ = driver.pose("objects/box")
    np.testing.assert_allclose([*position, *rotation], [1, 2, 3, *yaw(90)], atol=1e-9)
    driver.client.spin_until_matched(driver.player)
    driver.code("StepSimulation", steps=4)
    driver.spin_until(
        lambda: driver.player.playback_clock.last in driver.client.received["/objects/box/marker"]
    )
    shown = messages.read_object(
        driver.client.received["/objects/box/marker"][driver.player.playback_clock.last]
    )
    position, rotation, _ = driver.pose("objects/box")
    np.testing.assert_allclose([*shown.position, *shown.rotation], [*position, *rotation], atol=1e-9)
    assert np.linalg.norm(position - [1, 2, 3]) == pytest.approx(0.2, rel=0.05)  # 1 m/s
    assert driver.code("ResetSimulation", scope=2) == (OK, "")  # the state, not the time
    seconds = driver.player.playback.elapsed * 1e-9
    position, _, _ = driver.pose("objects/box")
    np.testing.assert_allclose(position, driver.player.scene.objects["box"].at(seconds).position, atol=1e-9)
    assert seconds > 0


def marker_type() -> Any:
    from visualization_msgs.msg import Marker

    return Marker


def test_a_static_camera_is_moved_from_the_next_frame_on(paused: Driver) -> None:
    from geometry_msgs.msg import PoseStamped

    driver = paused
    driver.client.subscribe(PoseStamped, ["/left/pose"], DATA)
    driver.client.spin_until_matched(driver.player)
    driver.spin_until(lambda: driver.player.playback_clock.last)
    rotation = Rotation.from_euler("xyz", (10, 20, 30), degrees=True).as_quat()
    for position in ((1, 2, 3), (4, 5, 6)):
        last = driver.player.playback_clock.last
        assert driver.place("left", position, rotation) == (OK, "")
        now, turned, twist = driver.pose("left")
        np.testing.assert_allclose([*now, *turned], [*position, *rotation], atol=1e-9)
        assert twist.linear.x == 0
        poses = driver.client.received["/left/pose"]
        driver.spin_until(lambda poses=poses, last=last: max(poses, default=0) > last)
        pose = messages.read_pose(poses[max(poses)])
        np.testing.assert_allclose(-pose.R.T @ pose.t, position, atol=1e-9)
    held = sorted(poses)[-2]  # no way between the places is shown
    np.testing.assert_allclose(poses[held].pose.position.x, 1, atol=1e-9)
    assert max(poses) - held == 1
    driver.spin_until(lambda: not driver.player._simulation._echoes["left"])
    assert driver.pose("left")[0] == pytest.approx([4, 5, 6])
    assert driver.code("ResetSimulation") == (OK, "")
    assert driver.pose("left")[0] == pytest.approx([5, 0, 1.5])


BAD_POSES = {
    "nan": ((math.nan, 0, 0), (0, 0, 0, 1), "finite"),
    "infinite": ((0, math.inf, 0), (0, 0, 0, 1), "finite"),
    "far": ((0, 1e9, 0), (0, 0, 0, 1), "1000 km"),
    "quaternion of zeros": ((0, 0, 0), (0, 0, 0, 0), "length 1"),
    "long quaternion": ((0, 0, 0), (0, 0, 0, 2), "length 1"),
    "nan quaternion": ((0, 0, 0), (0, 0, 0, math.nan), "finite"),
}


@pytest.mark.parametrize("entity", ["humans/walker", "objects/box", "left"])
def test_poses_that_are_none_are_refused(paused: Driver, entity: str) -> None:
    before = paused.pose(entity)[0]
    for position, rotation, reason in BAD_POSES.values():
        code, text = paused.place(entity, position, rotation)
        assert code == FAILED and reason in text
    for changes, reason in (({"frame": "odom"}, "must be in map"), ({"speed": 1.0}, "twist must be zero")):
        code, text = paused.place(entity, (0, 0, 0), **changes)
        assert code == FAILED and reason in text
    np.testing.assert_array_equal(paused.pose(entity)[0], before)


@pytest.mark.parametrize(
    ("entity", "position", "rotation", "reason"),
    [
        ("humans/walker", (0, 0, 0.5), (0, 0, 0, 1), "stands on the floor"),
        ("humans/walker", (0, 0, 0), (1, 0, 0, 0), "stands on the floor"),
        ("humans/carried", (0, 0, 0), (0, 0, 0, 1), "keyframes"),
        ("humans/other", (0, 0, 0), (0, 0, 0, 1), "another node"),
        ("objects/post", (0, 0, 0), (0, 0, 0, 1), "static"),
        ("dolly", (0, 0, 0), (0, 0, 0, 1), "trajectory"),
    ],
)
def test_entities_that_cannot_be_moved_say_why(
    driver: Driver, entity: str, position: Any, rotation: Any, reason: str
) -> None:
    code, text = driver.place(entity, position, rotation)
    assert code == FAILED and reason in text


@pytest.mark.parametrize("name", ["", "walker", "x" * 10**6, "humans/walker\n"])
def test_unknown_entities_are_not_found(driver: Driver, name: str) -> None:
    for service, fields in (
        ("GetEntityState", {}),
        ("GetEntityInfo", {}),
        ("SetEntityState", {"state": entity_state((0, 0, 0))}),
    ):
        code, text = driver.code(service, entity=name, **fields)
        assert code == NOT_FOUND and len(text) < 200


def test_time_and_state_are_reset(paused: Driver) -> None:
    paused.code("StepSimulation", steps=5)
    start = Scene.load(paused.player.scene.path).actors["walker"].joint_poses(0.0)
    origin = start.positions[0, start.names.index("Hips"), :2]
    paused.place("humans/walker", (7, 7, 0))
    assert paused.code("ResetSimulation", scope=1) == (OK, "")  # the time, not the state
    paused.spin_until(lambda: paused.frames[-1][1] == 0)
    assert np.linalg.norm(paused.pose("humans/walker")[0][:2] - origin) > 3
    assert paused.code("ResetSimulation", scope=0) == (OK, "")
    np.testing.assert_allclose(paused.pose("humans/walker")[0][:2], origin, atol=1e-9)
    code, text = paused.code("ResetSimulation", scope=4)
    assert code == UNSUPPORTED and "spawned" in text
