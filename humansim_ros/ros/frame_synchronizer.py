"""Puts a scene together again: what skinners and player sent of its humans and objects with one stamp is one
instant.
"""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import cache, partial
from typing import Any

import numpy as np
from geometry_msgs.msg import PoseStamped, TwistStamped
from numpy.typing import NDArray
from rclpy.serialization import deserialize_message
from sensor_msgs.msg import MultiDOFJointState, PointCloud2
from visualization_msgs.msg import Marker

from humansim_ros.errors import HumansimError
from humansim_ros.ros import messages
from humansim_ros.ros.frame_skipper import FrameSkipper
from humansim_ros.ros.node import SceneNode
from humansim_ros.ros.qos import NEWEST
from humansim_ros.scene.camera import CameraPose
from humansim_ros.scene.objects import ObjectPose
from humansim_ros.scene.state import JointMotion, SceneState

#: Frames that may wait for a human's message before they are given up.
_MAX_WAITING = 8
#: Frames that the time between frames is known by.
_GAPS = 5
#: Periods that a frame may be behind the newest before it is skipped.
_PATIENCE = 1.5
#: Seconds without any vertices after which the still scene is shown.
_STILL_AFTER = 1.5
#: Metres from the origin within which everything is.
_FARTHEST = 1e6
#: Nanoseconds back that mean the clock was set anew (a bag played again) and not a message that is late.
_NEW_TIME = 1_000_000_000


#: What comes of one stamp, in this order: vertices by human, serialised joints by human, poses by object and
#: by camera, how these move by topic.
_Parts = tuple[dict[str, Any], dict[str, Any], dict[str, Any], dict[str, Any], dict[str, Any]]


class FrameSynchronizer:
    """Subscribes to every human's vertices and joints, every moving object's marker, the pose of some
    ``cameras``, and how both move, and hands over whole instants, the newest where it is late.

    Until a skinner speaks, it hands over the scene as it is at its start, so that a camera alone shows
    something.
    """

    def __init__(
        self, node: SceneNode, show: Callable[[SceneState], None], cameras: Sequence[str] = ()
    ) -> None:
        self._node = node
        self._scene = node.scene
        self._show = show
        self._period = self._scene.period * 1e9
        self._pace = FrameSkipper(self._period)
        actors, objects = list(self._scene.actors), list(self._scene.moving_objects)
        twists = [*(f"objects/{name}" for name in objects), *cameras]
        self._expected = (actors, actors, objects, list(cameras), twists)
        # by stamp, the frames that are not whole yet
        self._waiting: dict[int, _Parts] = {}
        self._last = self._newest = 0
        # nanoseconds between the newest frames: the player's rate may not be the scene's
        self._gaps: deque[float] = deque([self._period] * _GAPS, maxlen=_GAPS)
        for human in actors:
            topic = f"humans/{human}"
            vertices = partial(self._read, messages.read_vertices, 0, human)
            node.create_subscription(PointCloud2, f"{topic}/vertices", vertices, NEWEST)
            # as bytes: they are read only if somebody wants to know where a camera sees the joints
            node.create_subscription(
                MultiDOFJointState, f"{topic}/joints", partial(self._take_joints, human), NEWEST, raw=True
            )
        for name in objects:
            place = partial(self._read, messages.read_object, 2, name)
            node.create_subscription(Marker, f"objects/{name}/marker", place, NEWEST)
        for name in cameras:
            pose = partial(self._read, messages.read_pose, 3, name)
            node.create_subscription(PoseStamped, f"{name}/pose", pose, NEWEST)
        for name in twists:
            twist = partial(self._read, messages.read_twist, 4, name)
            node.create_subscription(TwistStamped, f"{name}/twist", twist, NEWEST)
        self._started = node.now()
        self._told = False
        self._still = node.create_timer(self._scene.period, self._show_still)

    def _read(self, read: Callable[[Any], Any], kind: int, name: str, message: Any) -> None:
        """Take what a message says, if it can be read."""
        try:
            part = read(message)
        except HumansimError as error:
            self._node.skipped(f"{name}: {error}")
        else:
            self._take(messages.to_nanoseconds(message.header.stamp), kind, name, part)

    def _take_joints(self, human: str, data: bytes) -> None:
        self._take(messages.serialised_stamp(data), 1, human, data)

    def _take(self, stamp: int, kind: int, name: str, part: Any) -> None:
        """Put a human's vertices (kind 0) or joints (1), an object (2), a camera (3) or how one of these
        moves (4) with the others of their stamp.
        """
        if stamp < self._last - _NEW_TIME:
            self._waiting, self._last, self._newest = {}, 0, 0
        if stamp > self._newest:
            if self._newest:
                self._gaps.append(stamp - self._newest)
                self._period = sorted(self._gaps)[1]  # frames out of turn and lost ones are few
            self._newest = stamp
        if stamp <= self._last or not self._pace.keeps(stamp):
            return
        self._waiting.setdefault(stamp, ({}, {}, {}, {}, {}))[kind][name] = part
        if self._is_whole(stamp):
            self._hand_over_soon()
        elif len(self._waiting) > _MAX_WAITING:
            self._give_up()

    def _is_whole(self, stamp: int) -> bool:
        return all(
            len(parts) == len(names)
            for parts, names in zip(self._waiting[stamp], self._expected, strict=True)
        )

    def _give_up(self) -> None:
        frame = self._waiting.pop(min(self._waiting))
        missing = {
            name: None
            for parts, names in zip(frame, self._expected, strict=True)
            for name in names
            if name not in parts
        }
        self._node.count("drops")
        source = "its skinner" if {*missing} & {*self._scene.actors} else "the motion player"
        self._node.get_logger().warn(
            f"frames wait for {', '.join(missing)}: is {source} running?", throttle_duration_sec=5.0
        )

    def _hand_over_soon(self) -> None:
        """Not at once: what else has arrived is taken first, so that who is late sees it."""
        executor = self._node.executor
        # executors that do not take events in turn have tasks before what has arrived: thus two
        executor.create_task(lambda: executor.create_task(self._hand_over) and None)

    def _hand_over(self) -> None:
        """Show the oldest whole frame that is not late, or the newest whole one if all are."""
        whole = sorted(stamp for stamp in self._waiting if self._is_whole(stamp))
        if not whole:
            return
        newest = max(self._waiting)
        stamp = next((s for s in whole if newest - s <= _PATIENCE * self._period), whole[-1])
        self._pace.lost(sum(older < stamp for older in self._waiting))
        vertices, serialised, objects, cameras, twists = self._waiting[stamp]
        objects = {name: replace(pose, velocity=twists[f"objects/{name}"]) for name, pose in objects.items()}
        cameras = {name: replace(pose, velocity=twists[name]) for name, pose in cameras.items()}
        self._waiting = {later: parts for later, parts in self._waiting.items() if later > stamp}
        if self._last:
            # those that the pace leaves out are drops too
            self._node.count("drops", max(0, round((stamp - self._last) / self._period) - 1))
        self._last = stamp
        self._node.report_lateness(stamp, "arrival")
        start = time.monotonic()
        joints_of = cache(lambda human: _joints(serialised[human]))
        self._try_to_show(stamp, vertices, objects, cameras, joints_of)
        self._pace.worked(start, time.monotonic())
        if any(self._is_whole(later) for later in self._waiting):
            self._hand_over_soon()

    def _show_still(self) -> None:
        now = self._node.now()
        awaited = any(self._expected)
        if self._last and awaited:
            self._still.cancel()
        elif now - self._started > _STILL_AFTER * 1e9 or not awaited:
            if not self._told and awaited:
                self._told = True
                self._node.get_logger().info("nothing is published: showing the scene as at its start")
            states = {name: actor.at(0.0) for name, actor in self._scene.actors.items()}
            vertices = {name: state.vertices for name, state in states.items()}
            places = {name: thing.at(0.0) for name, thing in self._scene.moving_objects.items()}
            objects = {name: replace(place, velocity=None) for name, place in places.items()}
            cameras = {name: CameraPose.of(self._scene.cameras[name]) for name in self._expected[3]}

            def joints_of(human: str) -> JointMotion:
                return JointMotion(states[human].joints, None, None)

            self._try_to_show(now, vertices, objects, cameras, joints_of)

    def _try_to_show(
        self,
        stamp: int,
        vertices: dict[str, NDArray[np.float32]],
        objects: dict[str, ObjectPose],
        cameras: dict[str, CameraPose],
        joints_of: Callable[[str], JointMotion],
    ) -> None:
        actors = self._scene.actors
        for name, points in vertices.items():
            if wrong := _wrong(points, len(actors[name].human.mesh.vertices)):
                self._node.skipped(f"{name}: {wrong}")
                return
        try:
            self._show(SceneState(stamp, self._scene, actors, vertices, joints_of, objects, cameras))
        except HumansimError as error:
            self._node.skipped(str(error))


def _wrong(vertices: NDArray[np.float32], number: int) -> str:
    """What is wrong with the vertices (V, 3) of a body of so many."""
    if len(vertices) != number:
        return f"{len(vertices)} vertices are not those of a body of {number}"
    if not (np.abs(vertices) < _FARTHEST).all():  # False for NaN, too
        return "a vertex is not finite, or farther away than anybody is"
    return ""


def _joints(data: bytes) -> JointMotion:
    """The joints of a serialised ``joints`` message."""
    return messages.joint_motion(messages.read_joints(deserialize_message(data, MultiDOFJointState)))
