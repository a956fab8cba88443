"""Puts the humans of a scene together again: what their skinners sent with one stamp is one instant."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray
from rclpy.serialization import deserialize_message
from sensor_msgs.msg import MultiDOFJointState, PointCloud2

from humansim_ros.errors import HumansimError
from humansim_ros.render import Body
from humansim_ros.ros import messages
from humansim_ros.ros.node import SceneNode
from humansim_ros.ros.pace import Pace
from humansim_ros.ros.qos import NEWEST
from humansim_ros.rotations import Array

#: Frames that may wait for a human's message before they are given up.
_MOST_WAITING = 8
#: Periods that a frame may be behind the newest before it is skipped.
_PATIENCE = 1.5
#: Seconds without any vertices after which the still scene is shown.
_STILL_AFTER = 1.5
#: Nanoseconds back that mean the clock was set anew (a bag played again) and not a message that is late.
_NEW_TIME = 1_000_000_000


@dataclass(frozen=True)
class Instant:
    """All humans of a scene at one stamp (nanoseconds). ``joints_of``: a human's joint positions (J, 3),
    ``map``.
    """

    stamp: int
    bodies: Sequence[Body]
    joints_of: Callable[[str], Array]


class FrameJoiner:
    """Subscribes to every human's vertices and joints and hands over whole instants, the newest where it is
    late.

    Until a skinner speaks, it hands over the scene as it is at its start, so that a camera alone shows
    something.
    """

    def __init__(self, node: SceneNode, show: Callable[[Instant], None]) -> None:
        self._node = node
        self._scene = node.scene
        self._show = show
        self._period = self._scene.period * 1e9
        self._pace = Pace(self._period)
        # stamp -> (vertices by human, serialised joints by human), for frames that are not whole yet
        self._waiting: dict[int, tuple[dict[str, NDArray[np.float32]], dict[str, bytes]]] = {}
        self._last = 0
        self._whole = node.create_guard_condition(self._hand_over)
        for human in self._scene.actors:
            topic = f"humans/{human}"
            node.create_subscription(
                PointCloud2, f"{topic}/vertices", partial(self._take_vertices, human), NEWEST
            )
            # as bytes: they are read only if somebody wants to know where a camera sees the joints
            node.create_subscription(
                MultiDOFJointState, f"{topic}/joints", partial(self._take_joints, human), NEWEST, raw=True
            )
        self._started = node.now()
        self._told = False
        self._still = node.create_timer(self._scene.period, self._show_still)

    def _take_vertices(self, human: str, message: PointCloud2) -> None:
        try:
            vertices = messages.read_vertices(message)
        except HumansimError as error:
            self._skipped(f"{human}: {error}")
        else:
            self._take(messages.to_nanoseconds(message.header.stamp), 0, human, vertices)

    def _take_joints(self, human: str, data: bytes) -> None:
        self._take(messages.serialised_stamp(data), 1, human, data)

    def _take(self, stamp: int, kind: int, human: str, part: Any) -> None:
        """Put one human's vertices (kind 0) or joints (kind 1) with the others of their stamp."""
        if stamp < self._last - _NEW_TIME:
            self._waiting, self._last = {}, 0
        if stamp <= self._last or not self._pace.keeps(stamp):
            return
        self._waiting.setdefault(stamp, ({}, {}))[kind][human] = part
        if self._is_whole(stamp):
            # not at once: what else has arrived is taken first, so that who is late sees it
            self._whole.trigger()
        elif len(self._waiting) > _MOST_WAITING:
            self._give_up()

    def _is_whole(self, stamp: int) -> bool:
        return all(len(parts) == len(self._scene.actors) for parts in self._waiting[stamp])

    def _give_up(self) -> None:
        vertices, joints = self._waiting.pop(min(self._waiting))
        missing = [human for human in self._scene.actors if human not in vertices or human not in joints]
        self._node.count("drops")
        self._node.get_logger().warn(
            f"frames wait for {', '.join(missing)}: is its skinner running?", throttle_duration_sec=5.0
        )

    def _hand_over(self) -> None:
        """Show the oldest whole frame that is not late, or the newest whole one if all are."""
        whole = sorted(stamp for stamp in self._waiting if self._is_whole(stamp))
        if not whole:
            return
        newest = max(self._waiting)
        stamp = next((s for s in whole if newest - s <= _PATIENCE * self._period), whole[-1])
        self._pace.lost(sum(older < stamp for older in self._waiting))
        vertices, serialised = self._waiting[stamp]
        self._waiting = {later: parts for later, parts in self._waiting.items() if later > stamp}
        if self._last:
            # those that the pace leaves out are drops too
            self._node.count("drops", max(0, round((stamp - self._last) / self._period) - 1))
        self._last = stamp
        start = time.monotonic()
        self._try_to_show(stamp, vertices, lambda human: _positions(serialised[human]))
        self._pace.worked(start, time.monotonic())
        if any(self._is_whole(later) for later in self._waiting):
            self._whole.trigger()

    def _show_still(self) -> None:
        now = self._node.now()
        if self._last and self._scene.actors:
            self._still.cancel()
        elif now - self._started > _STILL_AFTER * 1e9 or not self._scene.actors:
            if not self._told and self._scene.actors:
                self._told = True
                self._node.get_logger().info("no skinner is publishing: showing the scene as at its start")
            states = {name: actor.at(0.0) for name, actor in self._scene.actors.items()}
            vertices = {name: state.vertices for name, state in states.items()}
            self._try_to_show(now, vertices, lambda human: states[human].positions)

    def _try_to_show(
        self, stamp: int, vertices: dict[str, NDArray[np.float32]], joints_of: Callable[[str], Array]
    ) -> None:
        bodies = [actor.body(vertices[name]) for name, actor in self._scene.actors.items()]
        try:
            self._show(Instant(stamp, bodies, joints_of))
        except HumansimError as error:
            self._skipped(str(error))

    def _skipped(self, reason: str) -> None:
        self._node.count("drops")
        self._node.get_logger().error(f"frame skipped: {reason}", throttle_duration_sec=1.0)


def _positions(data: bytes) -> Array:
    """(J, 3) joint positions of a serialised ``joints`` message."""
    return messages.read_joints(deserialize_message(data, MultiDOFJointState)).positions[0]
