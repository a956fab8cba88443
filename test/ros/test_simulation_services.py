"""Services of simulation_interfaces: a client that knows only the standard drives the player."""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from conftest import ROOT
from ros_support import write_scene
from simulation_driver import (  # noqa: F401  # fixtures
    ALREADY,
    FAILED,
    OK,
    PAUSED,
    PLAYING,
    STOPPED,
    UNSUPPORTED,
    Driver,
    Tool,
    driver_fixture,
    paused_fixture,
    running_fixture,
    scene_fixture,
    yaw,
)
from waiting import PATIENCE

from humansim_ros.data import messages
from humansim_ros.ros.graph.qos import LATCHED
from humansim_ros.ros.processes.stop_signals import QUIT
from humansim_ros.scene import Scene

pytestmark = pytest.mark.usefixtures("interfaces")


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
    assert not {name for name in names if "SPAWN" in name or "BOUNDS" in name}
    has_worlds = {"WORLD_INFO_GETTING", "AVAILABLE_WORLDS", "WORLD_TAGS"} & named.keys()
    assert {name for name in names if "WORLD" in name} == has_worlds


def test_scene_is_the_world(driver: Driver) -> None:
    worlds = pytest.importorskip("simulation_interfaces.srv")
    if not hasattr(worlds, "GetCurrentWorld"):
        pytest.skip("version 1 of simulation_interfaces has no worlds")
    from simulation_interfaces.msg import TagsFilter

    answer = driver.call("GetCurrentWorld")
    assert answer.result.result == OK
    assert (answer.world.name, answer.world.world_resource.uri) == ("scene", "humansim:scene")
    assert driver.call("GetAvailableWorlds").worlds == [answer.world]
    assert driver.call("GetAvailableWorlds", filter=TagsFilter(tags=["humans"])).worlds == [answer.world]
    assert driver.call("GetAvailableWorlds", filter=TagsFilter(tags=["outdoor"])).worlds == []
    code, text = driver.code("GetAvailableWorlds", additional_sources=["file:///etc"])
    assert code == FAILED and "no sources" in text
    code, text = driver.code("GetAvailableWorlds", filter=TagsFilter(tags=["humans"] * 2000))
    assert code == FAILED and "1000 tags" in text


@pytest.mark.nightly
def test_the_services_of_version_2() -> None:
    tests = [__file__, str(Path(__file__).parent / "test_simulation_entities.py")]
    command = [sys.executable, "-m", "pytest", "-q", "-p", "no:cacheprovider", "-m", "not nightly", *tests]
    environment = {**os.environ, "SIMULATION_INTERFACES": "simulation_interfaces-2.1"}
    done = subprocess.run(command, cwd=ROOT, env=environment, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout[-3000:]
    assert "has no worlds" not in done.stdout


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
