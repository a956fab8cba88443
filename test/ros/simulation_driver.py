"""A player, and a client that knows only the standard services of simulation_interfaces."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from keyframe_text import keyframes
from ros_support import Client, write_scene
from scipy.spatial.transform import Rotation

from humansim_ros.data import messages
from humansim_ros.ros.graph.qos import DONE
from humansim_ros.ros.nodes.motion_player import MotionPlayerNode
from humansim_ros.ros.processes.runtime import make_executor

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
MOVES = keyframes(
    1000,
    10,
    carried=((0, 0, 0), (19, 0, 0)),
    box=((2, -1, 0), {"position": (2, 99, 0), "rotation": (0, 0, 100)}),
)
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
        state = entity_state(position, rotation, **changes)
        return self.code("SetEntityState", entity=entity, state=state, **set_flags())

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


def set_flags(pose: bool = True, twist: bool = True) -> dict[str, bool]:
    """Flags of SetEntityState that choose parts of the state; versions before 2.1 have none."""
    from simulation_interfaces.srv import SetEntityState

    fields = SetEntityState.Request.get_fields_and_field_types()
    flags = {"set_pose": pose, "set_twist": twist}
    return {name: value for name, value in flags.items() if name in fields}


def yaw(degrees: float) -> Any:
    return Rotation.from_euler("z", degrees, degrees=True).as_quat()


@pytest.fixture(scope="module", name="scene")
def scene_fixture(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("services")
    (folder / "moves.xml").write_text(MOVES)
    (folder / "dolly.txt").write_text(DOLLY)
    return write_scene(folder, SCENE)


@pytest.fixture(scope="module", name="running", params=["realtime", "lockstep"])
def running_fixture(
    ros: None, interfaces: Path, scene: Path, request: pytest.FixtureRequest
) -> Iterator[Driver]:
    """A player for the tests of a mode; tests with a player of their own come before all that use it."""
    driver = Driver(scene, request.param)
    driver.spin_until(lambda: driver.frames)
    yield driver
    driver.close()


@pytest.fixture(name="driver")
def driver_fixture(running: Driver) -> Driver:
    """The player at its start, with all entities at their places, playing."""
    running.answers = True
    running.report()
    assert running.code("ResetSimulation") == (OK, "")
    assert running.set_state("PLAYING")[0] in (OK, ALREADY)
    running.frames.clear()
    running.client.received.clear()
    running.spin_until(lambda: running.frames)
    return running


@pytest.fixture(name="paused")
def paused_fixture(driver: Driver) -> Driver:
    assert driver.set_state("PAUSED") == (OK, "")
    return driver
