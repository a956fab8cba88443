"""Services of ``simulation_interfaces``, a standard package: tools for other simulators control the player.

They are served if the package is installed (docs/simulation_interfaces.md), in the namespace of the node's
name, as in Gazebo.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from importlib import import_module
from types import SimpleNamespace
from typing import Any

import numpy as np
from geometry_msgs.msg import Accel, PoseStamped, Twist, Vector3
from rclpy.action import ActionServer, CancelResponse, GoalResponse
from rclpy.task import Future

from humansim_ros.data.messages import (
    WORLD_FRAME,
    header,
    pose_message,
    read_pose,
    rigid_pose,
    twist_message,
)
from humansim_ros.errors import HumansimError, RosError, printable
from humansim_ros.geometry import ObjectPose, Velocity
from humansim_ros.ros.graph.qos import DATA, NEWEST
from humansim_ros.ros.playing.clock import Tick
from humansim_ros.ros.playing.entities import (
    MAX_FILTERS,
    Entity,
    Refusal,
    has_tags,
    name_filter,
    placement,
    scene_entities,
)
from humansim_ros.ros.playing.playing import MAX_WAITING, FramePlayer
from humansim_ros.ros.processes.stop_signals import QUIT
from humansim_ros.scene.config import LIVE
from humansim_ros.scene.core import CameraPose
from humansim_ros.types import Array

_PACKAGE = "simulation_interfaces"
_SERVICES = {
    "get_simulator_features": "GetSimulatorFeatures",
    "get_simulation_state": "GetSimulationState",
    "set_simulation_state": "SetSimulationState",
    "step_simulation": "StepSimulation",
    "reset_simulation": "ResetSimulation",
    "get_entities": "GetEntities",
    "get_entities_states": "GetEntitiesStates",
    "get_entity_info": "GetEntityInfo",
    "get_entity_state": "GetEntityState",
    "set_entity_state": "SetEntityState",
    # of versions 2 and later
    "get_current_world": "GetCurrentWorld",
    "get_available_worlds": "GetAvailableWorlds",
}
_FEATURES = (
    "ENTITY_TAGS",
    "ENTITY_CATEGORIES",
    "ENTITY_STATE_GETTING",
    "ENTITY_STATE_SETTING",
    "ENTITY_INFO_GETTING",
    "SIMULATION_RESET",
    "SIMULATION_RESET_TIME",
    "SIMULATION_RESET_STATE",
    "SIMULATION_STATE_GETTING",
    "SIMULATION_STATE_SETTING",
    "SIMULATION_STATE_PAUSE",
    "STEP_SIMULATION_SINGLE",
    "STEP_SIMULATION_MULTIPLE",
    "STEP_SIMULATION_ACTION",
    # of versions 2 and later
    "WORLD_INFO_GETTING",
    "AVAILABLE_WORLDS",
    "WORLD_TAGS",
)
_INFO = "humansim_ros: a step is a frame, an entity has the name that its topics begin with"
#: Tags of the scene as a world, and scheme of the URI of this world.
_WORLD_TAGS, _WORLD_SCHEME = ("humans",), "humansim"
#: Largest deviation of a human's rotation from a rotation about z.
_ROTATION_TOLERANCE = 1e-3
#: In a request, a human may be this far above or below the floor, metres.
_FLOOR_TOLERANCE = 1e-3
_REST = Velocity(np.zeros(3), np.zeros(3))
#: The process ends this time after the answer to a request to quit, seconds.
_QUIT_AFTER = 0.2


def serve_simulation(player: FramePlayer) -> SimulationServices | None:
    """Serve the standard services of a player. Returns None, and serves nothing, if the package
    simulation_interfaces is not installed."""
    try:
        types = SimpleNamespace(
            msg=import_module(f"{_PACKAGE}.msg"),
            srv=import_module(f"{_PACKAGE}.srv"),
            action=import_module(f"{_PACKAGE}.action"),
        )
    except ImportError:
        player.get_logger().debug(f"{_PACKAGE} is not installed: its services are not offered")
        return None
    return SimulationServices(player, types)


class SimulationServices:
    """The standard services of a player, and its action. ``types``: modules ``msg``, ``srv`` and ``action``
    of simulation_interfaces."""

    def __init__(self, player: FramePlayer, types: Any) -> None:
        self._player = player
        self._types = types
        self._entities = scene_entities(player.scene)
        self._world_name = player.scene.path.stem if player.scene.path else "scene"
        self._is_stopped = False
        self._run: StepRun | None = None
        #: Goal of the action that began last; and whether another goal is accepted that has not begun yet.
        self._goal: Any = None
        self._is_goal_accepted = False
        static = [camera for camera in player.scene.scene_cameras.values() if not camera.moves]
        #: By name of a static camera: pose from topic ``<camera>/pose``; and publishers of these topics.
        self._camera_poses: dict[str, CameraPose] = {}
        #: Messages that this node has sent on these topics, and has not yet received itself.
        self._echoes: dict[str, list[PoseStamped]] = {camera.name: [] for camera in static}
        self._pose_publishers = {
            camera.name: player.create_publisher(PoseStamped, f"{camera.name}/pose", DATA)
            for camera in static
        }
        for camera in static:
            player.create_subscription(
                PoseStamped, f"{camera.name}/pose", self._camera_pose_callback(camera.name), NEWEST
            )
        for service, name in _SERVICES.items():
            if hasattr(types.srv, name):  # the installed version has it
                self._serve(getattr(types.srv, name), service, getattr(self, f"_{service}"))
        self._serve_steps(types.action.SimulateSteps)

    def close(self) -> None:
        """Destroy the action server."""
        self._action.destroy()

    # --- answers

    def _serve(self, kind: Any, name: str, answer: Callable[[Any, Any], Any]) -> None:
        """Create a service.

        ``answer`` fills the response, or raises Refusal or HumansimError. If it returns a future, the request
        is answered when the future is done.
        """

        def on_request(request: Any, response: Any) -> Any:
            answered = Future()

            def finish(done: Future) -> None:
                with self._result_of(response):
                    done.result()
                answered.set_result(response)

            done = None
            with self._result_of(response):
                done = answer(request, response)
            if done is None:
                return response
            done.add_done_callback(finish)
            return answered

        self._player.create_service(kind, f"~/{name}", on_request)

    @contextmanager
    def _result_of(self, response: Any) -> Iterator[None]:
        """Context manager that sets the result of a response: success, or what its block raises."""
        try:
            yield
        except Refusal as refusal:
            self._set_result(response, refusal)
        except HumansimError as error:
            self._set_result(response, Refusal(str(error)))
        else:
            self._set_result(response)

    def _set_result(self, response: Any, refusal: Refusal | None = None) -> None:
        """Set the result of a response, if it has one: success, or a refusal."""
        if not hasattr(response, "result"):
            return
        result = self._types.msg.Result
        name = "RESULT_OK" if refusal is None else refusal.code
        # codes above 100 are constants of the service; SetEntityState has its own only in newer versions
        code = getattr(result, name, getattr(type(response), name, result.RESULT_OPERATION_FAILED))
        response.result.result = code
        response.result.error_message = "" if refusal is None else printable(str(refusal), 500)

    # --- simulator

    def _get_simulator_features(self, _: Any, response: Any) -> None:
        features = self._types.msg.SimulatorFeatures
        response.features.features = [
            getattr(features, name) for name in _FEATURES if hasattr(features, name)
        ]
        response.features.custom_info = _INFO

    def _world(self) -> Any:
        """The scene, described as a world. Its URI has the name of the scene, but no path of this host."""
        world = self._types.msg.WorldResource(name=self._world_name, tags=list(_WORLD_TAGS))
        # version 2.0 names this field level_resource
        resource = world.world_resource if hasattr(world, "world_resource") else world.level_resource
        resource.uri = f"{_WORLD_SCHEME}:{world.name}"
        return world

    def _get_current_world(self, _: Any, response: Any) -> None:
        response.world = self._world()

    def _get_available_worlds(self, request: Any, response: Any) -> None:
        if request.additional_sources:
            raise Refusal("only the scene of the player is a world: no sources are searched")
        if has_tags(request.filter, _WORLD_TAGS):
            response.worlds = [self._world()]

    def _state(self) -> int:
        states = self._types.msg.SimulationState
        if not self._player.playing.is_paused:
            return int(states.STATE_PLAYING)
        return int(states.STATE_STOPPED if self._is_stopped else states.STATE_PAUSED)

    def _get_simulation_state(self, _: Any, response: Any) -> None:
        response.state.state = self._state()

    def _set_simulation_state(self, request: Any, _: Any) -> None:
        states, wanted = self._types.msg.SimulationState, request.state.state
        known = states.STATE_STOPPED, states.STATE_PLAYING, states.STATE_PAUSED, states.STATE_QUITTING
        if wanted not in known:
            raise Refusal(f"state {wanted} cannot be set: only {known}", "RESULT_FEATURE_UNSUPPORTED")
        is_stepping = self._end_run("the state of the simulation was set meanwhile")
        if wanted == self._state() and not is_stepping:
            raise Refusal("the simulation is in this state", "ALREADY_IN_TARGET_STATE")
        self._player.playing.pause(wanted != states.STATE_PLAYING)
        if wanted in (states.STATE_STOPPED, states.STATE_QUITTING):
            self._reset_places()
            self._player.restart()
        self._is_stopped = wanted == states.STATE_STOPPED
        if wanted == states.STATE_QUITTING:
            self._player.get_logger().info("ending, as a request to quit says")
            self._player.create_timer(_QUIT_AFTER, self._quit)

    def _quit(self) -> None:
        self._player.exit_code = QUIT

    def _reset_simulation(self, request: Any, _: Any) -> None:
        scopes = type(request)
        scope = request.scope or scopes.SCOPE_ALL
        known = scopes.SCOPE_TIME | scopes.SCOPE_STATE
        if scope != scopes.SCOPE_ALL and scope & ~known:
            raise Refusal(
                f"scope {scope}: nothing is spawned; time ({scopes.SCOPE_TIME}) and "
                f"state ({scopes.SCOPE_STATE}) can be reset",
                "RESULT_FEATURE_UNSUPPORTED",
            )
        self._end_run("the simulation was reset meanwhile")
        if scope & scopes.SCOPE_STATE:
            self._reset_places()
        if scope & scopes.SCOPE_TIME:
            self._player.restart()

    def _reset_places(self) -> None:
        """Put everything that a request has moved back to its place in the scene."""
        scene, settings = self._player.scene, self._player.playback.settings
        of_scene = {name: human.motion for name, human in scene.config.humans.items()}
        places = {
            name: {"position": of_scene[name].position, "yaw_deg": of_scene[name].yaw_deg}
            for name, now in settings.items()
            if (now.position, now.yaw_deg) != (of_scene[name].position, of_scene[name].yaw_deg)
        }
        self._player.change_motions(places)
        self._player.playback.reset_objects()
        for name in list(self._camera_poses):
            self._send_camera_pose(name, CameraPose.of(scene.cameras[name]))
            del self._camera_poses[name]

    # --- steps

    def _step_simulation(self, request: Any, _: Any) -> Future:
        return self._begin_run(request.steps, lambda finished: None).ended

    def _begin_run(self, steps: int, report: Callable[[int], object]) -> StepRun:
        """Begin to simulate steps. ``report``: called after each step with the number of finished steps."""
        if self._run is not None:
            raise Refusal(f"{self._run.left} steps are being simulated already")
        if not self._player.playing.is_paused:
            raise Refusal("the simulation must be paused for a step")
        if steps < 1:
            raise Refusal("steps must be 1 or more")
        self._is_stopped = False
        self._run = run = StepRun(self._player, steps, report)
        run.ended.add_done_callback(lambda _: self._forget(run))
        run.step()
        return run

    def _forget(self, run: StepRun) -> None:
        if self._run is run:
            self._run = None

    def _end_run(self, reason: str) -> bool:
        """End the simulated steps after the present step. Returns whether steps were being simulated."""
        run, self._run = self._run, None
        if run is not None:
            run.end(Refusal(f"{reason}, after {run.finished} steps"))
        return run is not None

    def _serve_steps(self, kind: Any) -> None:
        def on_goal(_: Any) -> GoalResponse:
            if self._run is not None or self._is_goal_accepted:
                return GoalResponse.REJECT
            self._is_goal_accepted = True
            return GoalResponse.ACCEPT

        def on_cancel(goal: Any) -> CancelResponse:
            if goal is self._goal:
                self._end_run("cancelled")
            return CancelResponse.ACCEPT

        async def execute(goal: Any) -> Any:
            result, steps = kind.Result(), goal.request.steps
            self._goal, self._is_goal_accepted = goal, False

            def report(finished: int) -> None:
                goal.publish_feedback(
                    kind.Feedback(completed_steps=finished, remaining_steps=steps - finished)
                )

            with self._player.guard("action simulate_steps", "the goal is aborted"):
                try:
                    if goal.is_cancel_requested:
                        raise Refusal("cancelled before the first step")
                    await self._begin_run(steps, report).ended
                    goal.succeed()
                    self._set_result(result)
                except Refusal as refusal:
                    self._set_result(result, refusal)
                    (goal.canceled if goal.is_cancel_requested else goal.abort)()
            return result

        self._action = ActionServer(
            self._player,
            kind,
            "~/simulate_steps",
            execute,
            goal_callback=on_goal,
            cancel_callback=on_cancel,
        )

    # --- entities

    def _get_entities(self, request: Any, response: Any) -> None:
        response.entities = [entity.name for entity in self._found(request.filters)]

    def _get_entities_states(self, request: Any, response: Any) -> None:
        found = [entity for entity in self._found(request.filters) if not self._is_live(entity)]
        response.entities = [entity.name for entity in found]
        response.states = [self._entity_state(entity) for entity in found]

    def _get_entity_info(self, request: Any, response: Any) -> None:
        entity = self._entity(request.entity)
        response.info.category.category = self._category(entity)
        response.info.description = entity.description
        response.info.tags = list(entity.tags)

    def _get_entity_state(self, request: Any, response: Any) -> None:
        response.state = self._entity_state(self._entity(request.entity))

    def _set_entity_state(self, request: Any, _: Any) -> None:
        entity = self._entity(request.entity)
        # newer versions of the package say which parts of the state are meant
        if getattr(request, "set_twist", True) and request.state.twist != Twist():
            raise Refusal("the scene gives velocities: the twist must be zero")
        if not getattr(request, "set_pose", True):
            raise Refusal("only a pose can be set: set_pose is false")
        position, rotation = _read_pose(request.state)
        if not entity.moves and entity.kind == "object":
            raise Refusal(f"{entity.name} is static: only objects with keyframes can be moved")
        if entity.kind == "human":
            self._place_human(entity, position, rotation)
        elif entity.kind == "object":
            self._player.playback.place_object(entity.key, position, rotation)
        else:
            self._place_camera(entity, position, rotation)

    def _place_human(self, entity: Entity, position: Array, rotation: Array) -> None:
        if self._is_live(entity):
            raise Refusal(f"{entity.name} is moved by another node")
        if self._player.playback.actors[entity.key].keyframes is not None:
            raise Refusal(f"{entity.name} is moved by keyframes of the scene")
        x, y, z, w = rotation
        if math.hypot(x, y) > _ROTATION_TOLERANCE or abs(position[2]) > _FLOOR_TOLERANCE:
            raise Refusal(
                "a human stands on the floor: z must be 0, and the rotation about z", "INVALID_POSE"
            )
        place = placement(self._player.playback, entity.key, position[:2], 2 * math.atan2(z, w))
        self._player.change_motions({entity.key: place})

    def _place_camera(self, entity: Entity, position: Array, rotation: Array) -> None:
        if entity.moves:
            raise Refusal(f"{entity.name} is moved by a trajectory of the scene")
        self._send_camera_pose(entity.key, CameraPose.at(position, rotation))

    def _send_camera_pose(self, name: str, pose: CameraPose) -> None:
        """Move a static camera from the next frame on."""
        publisher, own = self._pose_publishers[name], self._player.get_name()
        listeners = self._player.get_subscriptions_info_by_topic(publisher.topic_name)
        if all(each.node_name == own for each in listeners):  # the player hears it, too
            raise Refusal(f"no node renders the camera {name}")
        before = self._camera_poses.get(name)
        last = self._player.playback_clock.last or 0
        # poses are interpolated: the one before holds until the last frame
        messages = [pose_message(before, last)] if before is not None and last else []
        for message in (*messages, pose_message(pose, last + 1)):
            self._echoes[name].append(message)
            publisher.publish(message)
        self._camera_poses[name] = replace(pose, velocity=_REST)

    def _camera_pose_callback(self, name: str) -> Callable[[PoseStamped], None]:
        def on_pose(message: PoseStamped) -> None:
            echoes = self._echoes[name]
            if message in echoes:
                del echoes[: echoes.index(message) + 1]
            else:
                self._camera_poses[name] = read_pose(message)

        return on_pose

    def _entity(self, name: str) -> Entity:
        if name not in self._entities:
            raise Refusal(f"there is no entity '{printable(name, 80)}': see get_entities", "RESULT_NOT_FOUND")
        return self._entities[name]

    def _is_live(self, entity: Entity) -> bool:
        """Whether another node moves a human, so that the player does not know the pose of the human."""
        if entity.kind != "human":
            return False
        live = self._player.playback.settings[entity.key].file == LIVE
        return live or not self._player.get_parameter(f"{entity.key}.play").value

    def _category(self, entity: Entity) -> int:
        categories = self._types.msg.EntityCategory
        if entity.kind == "human":
            return int(categories.CATEGORY_HUMAN)
        if entity.kind == "camera":
            return int(categories.CATEGORY_OBJECT)
        return int(categories.CATEGORY_DYNAMIC_OBJECT if entity.moves else categories.CATEGORY_STATIC_OBJECT)

    def _found(self, filters: Any) -> Iterator[Entity]:
        """Entities (humans, objects, cameras) that pass all filters of a request."""
        if filters.bounds.type:
            raise Refusal("entities cannot be filtered by bounds", "RESULT_FEATURE_UNSUPPORTED")
        if len(filters.categories) > MAX_FILTERS:
            raise Refusal(f"more than {MAX_FILTERS} categories")
        categories = {each.category for each in filters.categories}
        name_matches = name_filter(filters.filter)
        for entity in self._entities.values():
            if not has_tags(filters.tags, entity.tags):
                continue
            if categories and self._category(entity) not in categories:
                continue
            if name_matches(entity.name):
                yield entity

    def _pose(self, entity: Entity) -> ObjectPose | CameraPose:
        """Pose of an entity at the last frame. The velocity is per second of the wall clock."""
        playback, clock = self._player.playback, self._player.playback_clock
        if entity.kind == "human":
            pose: ObjectPose | CameraPose = playback.human_pose(entity.key)
        elif entity.kind == "object":
            pose = playback.world.object_pose(entity.key, playback.elapsed * 1e-9)
        else:
            camera = self._player.scene.scene_cameras[entity.key]
            moved = self._camera_poses.get(entity.key)
            at_rest = replace(camera.pose(0.0), velocity=_REST)
            pose = camera.pose(playback.elapsed * 1e-9) if camera.moves else moved or at_rest
        if not entity.moves and entity.kind == "object":
            return replace(pose, velocity=_REST)
        pace = 0.0 if clock.paused else clock.speed
        return replace(pose, velocity=None if pose.velocity is None else pose.velocity.scaled(pace))

    def _entity_state(self, entity: Entity) -> Any:
        if self._is_live(entity):
            raise Refusal(f"{entity.name} is moved by another node")
        pose, stamp = self._pose(entity), self._player.playback_clock.last or 0
        state = self._types.msg.EntityState(header=header(stamp, WORLD_FRAME))
        p, q = state.pose.position, state.pose.orientation
        p.x, p.y, p.z = pose.position.tolist()
        q.x, q.y, q.z, q.w = pose.rotation.tolist()
        state.twist = twist_message(pose.velocity, stamp).twist
        unknown = Vector3(x=math.nan, y=math.nan, z=math.nan)
        state.acceleration = Accel(linear=unknown, angular=unknown)
        return state


class StepRun:
    """Plays some steps of a paused player, one after the other.

    Args:
        player: The player.
        steps: Number of steps.
        report: Called after each step with the number of finished steps.

    Attributes:
        ended: Future that is done when all steps are finished. It raises Refusal if the run was ended
            earlier.
        finished: Number of finished steps.
    """

    def __init__(self, player: FramePlayer, steps: int, report: Callable[[int], object]) -> None:
        self._player = player
        self._steps = steps
        self._report = report
        self.ended = Future()
        self.finished = 0

    @property
    def left(self) -> int:
        """Number of steps that are not finished."""
        return self._steps - self.finished

    def step(self) -> None:
        """Play the next step."""
        playing = self._player.playing
        if not playing.is_paused:
            self.end(Refusal(f"continued meanwhile, after {self.finished} steps"))
        elif playing.waiting >= MAX_WAITING:
            self.end(Refusal(f"{MAX_WAITING} other steps wait for the cameras"))
        elif self._player.stamped_steps.topic:
            try:
                self._player.stamped_steps.play(self._on_stamped)
            except RosError as error:
                self.end(Refusal(f"{error}, after {self.finished} steps"))
        else:
            playing.step(lambda: self._player.run_soon(self._finish_step))

    def _on_stamped(self, _: Tick | None, failure: str) -> None:
        if failure:
            self.end(Refusal(f"{failure}, after {self.finished} steps"))
        else:
            self._player.run_soon(self._finish_step)

    def end(self, refusal: Refusal) -> None:
        """End the run early."""
        if not self.ended.done():
            self.ended.set_exception(refusal)
            self._player.stamped_steps.cancel(str(refusal), self._on_stamped)

    def _finish_step(self) -> None:
        if self.ended.done():
            return
        self.finished += 1
        self._report(self.finished)
        if self.left:
            self.step()
        else:
            self.ended.set_result(None)


def _read_pose(state: Any) -> tuple[Array, Array]:
    """Position (3,) and normalised quaternion (4,) of a requested state. Raises Refusal if it is no pose in
    ``map``."""
    frame = state.header.frame_id
    if frame not in ("", WORLD_FRAME):
        raise Refusal(f"poses must be in {WORLD_FRAME}, this is in '{printable(frame, 80)}'", "INVALID_POSE")
    try:
        return rigid_pose(state.pose, "the pose")
    except RosError as error:
        raise Refusal(str(error), "INVALID_POSE") from None
