"""Synchronization of messages: everything with one stamp becomes one scene state."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, fields, replace
from functools import cache, partial
from typing import Any

import numpy as np
from geometry_msgs.msg import PoseStamped, TwistStamped
from rclpy.serialization import deserialize_message
from sensor_msgs.msg import MultiDOFJointState, PointCloud2
from std_msgs.msg import Header
from visualization_msgs.msg import Marker

from humansim_ros.errors import HumansimError, RosError
from humansim_ros.motion.joint_poses import Velocity
from humansim_ros.ros import messages
from humansim_ros.ros.node import SceneNode
from humansim_ros.ros.qos import DATA, NEWEST
from humansim_ros.scene.camera import CameraPose
from humansim_ros.scene.objects import ObjectPose
from humansim_ros.scene.state import JointMotion, SceneState
from humansim_ros.types import Float32Array

#: Incomplete frames that are held before the oldest is dropped.
_MAX_INCOMPLETE = 8
#: Intervals between frames from which the period is estimated.
_INTERVALS = 5
#: Periods behind the newest frame after which a frame is late.
_MAX_PERIODS_LATE = 1.5
#: Seconds without any vertices after which the scene at its start is shown.
_START_SCENE_AFTER = 1.5
#: Nanoseconds after the start in which the other nodes may still be starting.
_STARTING = 15_000_000_000
#: Nanoseconds back that mean a clock that was set back (a bag played again), not a late message.
_CLOCK_SET_BACK = 1_000_000_000


@dataclass
class _ReceivedFrame:
    """Message contents that have arrived for one stamp, by name."""

    #: By human.
    vertices: dict[str, Float32Array] = field(default_factory=dict)
    #: Serialised messages by human.
    joints: dict[str, bytes] = field(default_factory=dict)
    objects: dict[str, ObjectPose] = field(default_factory=dict)
    cameras: dict[str, CameraPose] = field(default_factory=dict)
    #: By topic without ``/twist``.
    twists: dict[str, Velocity | None] = field(default_factory=dict)


_FIELDS = tuple(part.name for part in fields(_ReceivedFrame))


class FrameSynchronizer:
    """Subscribes to all humans, moving objects and some cameras, and passes complete frames on.

    Subscriptions: vertices and joints of every human, marker and twist of every moving object, pose and twist
    of some cameras. Each finished frame is reported on ``frame_done``: the motion player sends a frame only
    if all cameras have time for it, and every frame is passed on. If nobody listens to the reports, and
    frames arrive faster than ``on_frame`` returns, the newest one is passed on.

    Until the first skinner publishes, the scene at its start is passed on, so that a camera alone shows
    something; not if parameter ``start_scene`` is false.

    Args:
        node: Node that subscribes.
        on_frame: Called with each complete frame.
        cameras: Nodes of the cameras that show the frames; the reports name them.
        moving_cameras: Names of cameras with a trajectory.
    """

    def __init__(
        self,
        node: SceneNode,
        on_frame: Callable[[SceneState], None],
        cameras: Sequence[SceneNode],
        moving_cameras: Sequence[str] = (),
    ) -> None:
        self._node = node
        self._reporter = ", ".join(camera.get_fully_qualified_name() for camera in cameras)
        self._scene = node.scene
        self._on_frame = on_frame
        self._period = self._scene.period * 1e9
        humans, objects = list(self._scene.actors), list(self._scene.moving_objects)
        moving = [*(f"objects/{name}" for name in objects), *moving_cameras]
        #: Names of a complete frame, by field of _ReceivedFrame.
        self._expected: dict[str, Sequence[str]] = {
            "vertices": humans,
            "joints": humans,
            "objects": objects,
            "cameras": list(moving_cameras),
            "twists": moving,
        }
        self._frames: dict[int, _ReceivedFrame] = {}
        self._last = self._newest = 0
        # nanoseconds between the newest frames: the player's rate may differ from the scene's
        self._intervals: deque[float] = deque([self._period] * _INTERVALS, maxlen=_INTERVALS)
        for human in humans:
            topic = f"humans/{human}"
            self._subscribe(PointCloud2, f"{topic}/vertices", "vertices", human, messages.read_vertices)
            # serialised: joints are read only if a topic needs them
            node.create_subscription(
                MultiDOFJointState, f"{topic}/joints", partial(self._on_joints, human), NEWEST, raw=True
            )
        for name in objects:
            self._subscribe(Marker, f"objects/{name}/marker", "objects", name, messages.read_object)
        for name in moving_cameras:
            self._subscribe(PoseStamped, f"{name}/pose", "cameras", name, messages.read_pose)
        for name in moving:
            self._subscribe(TwistStamped, f"{name}/twist", "twists", name, messages.read_twist)
        self._done = node.create_publisher(Header, "frame_done", DATA)
        if not any(self._expected.values()):  # nothing moves: the player gives the stamps alone
            node.create_subscription(Header, "frame", self._on_static_frame, NEWEST)
        description = "Show the scene at its start while no vertices arrive"
        self._shows_start = bool(node.described_parameter("start_scene", True, description, read_only=True))
        self._started = node.now()
        self._start_scene_logged = False
        self._start_scene_timer = node.create_timer(self._scene.period, self._show_start_scene)

    def _subscribe(
        self, message_type: Any, topic: str, part: str, name: str, read: Callable[[Any], Any]
    ) -> None:
        def on_message(message: Any) -> None:
            try:
                content = read(message)
            except HumansimError as error:
                self._node.report_skipped(f"{name}: {error}")
            else:
                self._store(messages.to_nanoseconds(message.header.stamp), part, name, content)

        self._node.create_subscription(message_type, topic, on_message, NEWEST)

    def _on_joints(self, human: str, data: bytes) -> None:
        self._store(messages.serialised_stamp(data), "joints", human, data)

    def _store(self, stamp: int, part: str, name: str, content: Any) -> None:
        """Store the content of a message with the others of its stamp."""
        if stamp < self._last - _CLOCK_SET_BACK:
            self._frames, self._last, self._newest = {}, 0, 0
        if stamp > self._newest:
            if self._newest:
                self._intervals.append(stamp - self._newest)
                self._period = sorted(self._intervals)[1]  # robust to few reordered or lost frames
            self._newest = stamp
        if stamp <= self._last:
            return
        getattr(self._frames.setdefault(stamp, _ReceivedFrame()), part)[name] = content
        if self._is_complete(stamp):
            self._schedule_next_frame()
        elif len(self._frames) > _MAX_INCOMPLETE:
            self._drop_oldest()

    def _is_complete(self, stamp: int) -> bool:
        frame = self._frames[stamp]
        return all(len(getattr(frame, part)) == len(self._expected[part]) for part in _FIELDS)

    def _drop_oldest(self) -> None:
        frame = self._frames.pop(min(self._frames))
        missing = {
            name: None
            for part in _FIELDS
            for name in self._expected[part]
            if name not in getattr(frame, part)
        }
        if not self._last and self._node.now() - self._started < _STARTING:
            return  # the skinners may be starting
        self._node.count("drops")
        source = "its skinner" if {*missing} & {*self._scene.actors} else "the motion player"
        self._node.get_logger().warn(
            f"frames wait for {', '.join(missing)}: is {source} running?", throttle_duration_sec=5.0
        )

    def _schedule_next_frame(self) -> None:
        """Process a frame after all messages that have already arrived, so that a late node notices it."""
        executor = self._node.executor
        # executors that do not take events in turn run tasks before arrived messages: thus two tasks
        executor.create_task(lambda: executor.create_task(self._process_next_frame) and None)

    def _process_next_frame(self) -> None:
        """Pass on the oldest complete frame; without pacing, the oldest that is not late, or the newest one
        if all are.
        """
        complete = sorted(stamp for stamp in self._frames if self._is_complete(stamp))
        if not complete:
            return
        stamp = complete[0]
        if not self._done.get_subscription_count():
            newest, limit = max(self._frames), _MAX_PERIODS_LATE * self._period
            stamp = next((s for s in complete if newest - s <= limit), complete[-1])
        self._node.count("drops", sum(older < stamp for older in self._frames))
        frame = self._frames[stamp]
        twists = frame.twists
        objects = {
            name: replace(pose, velocity=twists[f"objects/{name}"]) for name, pose in frame.objects.items()
        }
        cameras = {name: replace(pose, velocity=twists[name]) for name, pose in frame.cameras.items()}
        self._frames = {later: content for later, content in self._frames.items() if later > stamp}
        self._last = stamp
        self._node.report_lateness(stamp, "arrival")
        joints_of = cache(lambda human: _read_joints(frame.joints[human]))
        self._pass_on(stamp, frame.vertices, joints_of, objects, cameras)
        self._report_done(stamp)
        if any(self._is_complete(later) for later in self._frames):
            self._schedule_next_frame()

    def _report_done(self, stamp: int) -> None:
        self._done.publish(messages.header(stamp, self._reporter))

    def _on_static_frame(self, frame: Header) -> None:
        """Show a scene in which nothing moves, at the stamps of the motion player."""
        self._start_scene_timer.cancel()
        self._last = messages.to_nanoseconds(frame.stamp)
        self._pass_on(self._last, {}, _no_joints, {}, {})
        self._report_done(self._last)

    def _show_start_scene(self) -> None:
        now = self._node.now()
        has_sources = any(self._expected.values())
        if self._last and has_sources:
            self._start_scene_timer.cancel()
        elif self._shows_start and (now - self._started > _START_SCENE_AFTER * 1e9 or not has_sources):
            if not self._start_scene_logged and has_sources:
                self._start_scene_logged = True
                self._node.get_logger().info("no vertices are published: showing the scene at its start")
            states = {name: actor.at(0.0) for name, actor in self._scene.actors.items()}
            objects = {
                name: replace(moving.at(0.0), velocity=None)
                for name, moving in self._scene.moving_objects.items()
            }
            self._pass_on(
                now,
                {name: state.vertices for name, state in states.items()},
                lambda human: JointMotion(states[human].joints, None, None),
                objects,
                {name: CameraPose.of(self._scene.cameras[name]) for name in self._expected["cameras"]},
            )

    def _pass_on(
        self,
        stamp: int,
        vertices: dict[str, Float32Array],
        joints_of: Callable[[str], JointMotion],
        objects: dict[str, ObjectPose],
        cameras: dict[str, CameraPose],
    ) -> None:
        actors = self._scene.actors
        try:
            for name, points in vertices.items():
                _check_vertices(name, points, len(actors[name].human.mesh.vertices))
            self._on_frame(
                SceneState(
                    stamp=stamp,
                    scene=self._scene,
                    actors=actors,
                    vertices=vertices,
                    joints_of=joints_of,
                    objects=objects,
                    cameras=cameras,
                )
            )
        except HumansimError as error:
            self._node.report_skipped(str(error))


def _no_joints(human: str) -> JointMotion:
    raise KeyError(human)


def _check_vertices(name: str, vertices: Float32Array, count: int) -> None:
    """Raise RosError unless these are ``count`` finite vertices."""
    if len(vertices) != count:
        raise RosError(f"{name}: {len(vertices)} vertices, but the body has {count}")
    if not (np.abs(vertices) < messages.MAX_COORDINATE).all():  # False for NaN, too
        raise RosError(f"{name}: a vertex is not finite, or more than 1000 km away")


def _read_joints(data: bytes) -> JointMotion:
    """Joints of a serialised ``joints`` message."""
    return messages.joint_motion(messages.read_joints(deserialize_message(data, MultiDOFJointState)))
