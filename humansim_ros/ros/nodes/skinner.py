"""Node ``skinner``: computes joints and skin of one human from the messages of its motion.

Subscribes to ``humans/<id>/motion`` of any sender: the motion player, or live motion capture. For live motion
capture, joint names, scale and rest pose are detected from the messages (docs/playing.md). Subscribes also to
the legend of the motion player, ``humans/<id>/motion/legend``, and to ``humans/<id>/frame``, the stamps of
frames for a live human. Publishes ``humans/<id>/joints``, ``vertices``, ``markers``, ``face`` if the face
moves and, for subscribers, ``keypoints/<set>`` with the same stamp, and latched ``humans/<id>/mesh``.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
from sensor_msgs.msg import MultiDOFJointState
from std_msgs.msg import Header, String

from humansim_ros.data.messages import HumanTopics, read_joints, read_legend, to_nanoseconds
from humansim_ros.errors import HumansimError, RosError, SceneError, printable, unknown, within_bounds
from humansim_ros.motion.matching import built_in_tables, load_table
from humansim_ros.ros.graph.qos import LATCHED, NEWEST
from humansim_ros.ros.nodes.motion_player import MAX_LEAD
from humansim_ros.ros.processes.node import SceneNode
from humansim_ros.scene.config import LIVE
from humansim_ros.scene.core import LiveRetargeter
from humansim_ros.scene.truth import HumanState

#: Shortest time between two log lines about changes of the source of motion, seconds.
_CHANGES_EVERY = 10.0
#: A live source is silent after this time without a message, seconds: at the start, and later.
_SILENT_AT_START, _SILENT_AFTER = 3.0, 2.0


class SourceLog:
    """Logs what a user of live motion capture must know. Each fact is logged once.

    Args:
        log: Function that writes a line.
        human: Name of the human.
        topic: Topic of the motion of this human.
    """

    def __init__(self, log: Callable[[str], None], human: str, topic: str) -> None:
        self._log, self._human, self._topic = log, human, topic
        self._number, self._next_change = 0, 0.0
        self._since: float | None = None
        self._heard = self._silent = False

    def add_source(self, number: int, text: str, now: float) -> None:
        """Log a change of the source, at most every ten seconds.

        Args:
            number: Number of the source; 0 for the source of the scene.
            text: Description of the source.
            now: Monotonic seconds.
        """
        if number == self._number or now < self._next_change:
            return
        self._number, self._next_change = number, now + _CHANGES_EVERY
        self._log(f"joint source: {text or 'the motion of the scene'}")

    def add_frame(self, has_message: bool, now: float) -> bool:
        """Record a frame of a live human. Logs when the source becomes silent and when it is back.

        ``has_message``: whether a message has arrived since the last frame. ``now``: monotonic seconds.

        Returns:
            Whether the source is silent.
        """
        if self._since is None or has_message:
            if self._silent and has_message:
                self._log(f"motion arrives on {self._topic}: {self._human} follows it")
            self._since, self._heard, self._silent = now, self._heard or has_message, False
            return False
        if self._silent or now - self._since < (_SILENT_AFTER if self._heard else _SILENT_AT_START):
            return self._silent
        self._silent = True
        if self._heard:
            self._log(f"no motion arrives on {self._topic}: {self._human} keeps its last pose")
        else:
            self._log(
                f"nobody publishes {self._topic} yet: {self._human} stands at rest. An example of a sender: "
                f"python examples/live_mocap.py walk {self._human}"
            )
        return True

    def forget_frames(self) -> None:
        """Forget the frames of a live human, since the motion player moves this human again."""
        self._since, self._heard, self._silent = None, False, False


#: After this time without a frame of the motion player, seconds, a live source sets the stamps itself.
_PLAYER_GONE_AFTER = 3.0


class SkinnerNode(SceneNode):
    """Computes joints and vertices of a body from the joints of a motion. If several skinners share a
    process, node ``skinner_rig`` passes the name ``human``. Otherwise a parameter has the name."""

    def __init__(self, human: str = "", **options: Any) -> None:
        super().__init__("skinner", **options)
        name = human or self.text_parameter("human", "", "Human of the scene; empty: the first")
        marker_rate = self.number_parameter(
            "marker_rate", 10.0, 0.1, 1000.0, "Maximum number of marker messages per second (they are large)"
        )
        name = name or next(iter(self.scene.actors), "")
        if name not in self.scene.actors:
            text = unknown("human", name, self.scene.actors, "the scene")
            raise SceneError(text, path=self.scene.path, key="humans")
        self._actor = self.scene.actors[name]
        table = self.text_parameter(
            "joint_names", "", "Joint table of a live source (built-in name or YAML file); empty: detected"
        )
        live = self.scene.config.humans[name].motion.file == LIVE
        self._live_retargeter = LiveRetargeter(self._actor, self._find_table(table), live)
        # for a live human: its newest message, its last body, and when the player last asked for a frame
        self._message: MultiDOFJointState | None = None
        self._body: HumanState | None = None
        self._asked: float | None = None
        self._topics = topics = HumanTopics(self._actor)
        self._joints, self._vertices, self._markers = map(
            self.topic_publisher, (topics.joints, topics.vertices, topics.markers)
        )
        self._features = [(topic, self.topic_publisher(topic)) for topic in topics.features.values()]
        self._keypoints = [(topic, self.topic_publisher(topic)) for topic in topics.keypoints.values()]
        _ = topics.marker_builder  # made now: later it would delay a frame
        self._marker_period = int(1e9 / marker_rate)
        self._last_marker = -self._marker_period  # a first stamp of 0 has markers
        self.publish_latched(topics.mesh.build(None, 0), topics.mesh.name)
        # first, so that a legend arrives before its motion
        self.create_subscription(topics.legend.type, topics.legend.name, self._on_legend, LATCHED)
        motion = topics.motion
        self._motion = self.create_subscription(motion.type, motion.name, self._on_motion, NEWEST)
        self.neighbours.expect_one_sender(self._motion.topic_name)
        self._log = SourceLog(self.get_logger().info, name, self._motion.topic_name)
        self.create_subscription(topics.frame.type, topics.frame.name, self._on_frame, NEWEST)
        self.get_logger().info(f"skinning {name} ({len(self._actor.human.mesh.vertices)} vertices)")

    def _find_table(self, name: str) -> str | None:
        """Built-in joint table, or path of a table, relative to the scene file if it exists there."""
        if not name:
            return None
        path = self.scene.source.joint_table(name)
        if not any(table.name == path for table in built_in_tables()):
            load_table(path)
        return path

    def _on_motion(self, message: MultiDOFJointState) -> None:
        if self._asked is not None and time.monotonic() - self._asked < _PLAYER_GONE_AFTER:
            self._message = message  # shown in the next frame
            return
        if state := self._retarget(message):
            self._publish(state, to_nanoseconds(message.header.stamp))

    def _on_frame(self, frame: Header) -> None:
        """Publish the live human for a frame of the motion player, with its stamp: in the newest pose
        received, and with zero velocity once the source is silent."""
        self._asked = time.monotonic()
        message, self._message = self._message, None
        if message is not None and (state := self._retarget(message)):
            self._body = state
            self.report_lateness(to_nanoseconds(message.header.stamp), "age")
        silent = self._log.add_frame(message is not None, self._asked)
        body = self._body or self._actor.at(0.0)
        moves = body.linear is not None and bool(body.linear.any())
        self._publish(_at_standstill(body) if silent and moves else body, to_nanoseconds(frame.stamp))

    def _retarget(self, message: MultiDOFJointState) -> HumanState | None:
        """Compute the body for a message of a motion; None if the message cannot be used."""
        try:
            stamp = to_nanoseconds(message.header.stamp)
            state = self._live_retargeter.retarget(read_joints(message), stamp)
            if not within_bounds(state.vertices):
                raise RosError(
                    "the pose has numbers that are not finite, or puts the body more than 1000 km away"
                )
        except HumansimError as error:
            self.report_skipped(str(error))
            return None
        number, text = self._live_retargeter.source_number, self._live_retargeter.detected_source
        self._log.add_source(number, text, time.monotonic())
        return state

    def _publish(self, state: HumanState, stamp: int) -> None:
        self._body = state
        joints, vertices = (
            topic.build(state, stamp) for topic in (self._topics.joints, self._topics.vertices)
        )
        self._wait_for(stamp)
        self._joints.publish(joints)
        for topic, publisher in self._features:
            publisher.publish(topic.build(state, stamp))
        if self._vertices.get_subscription_count():
            self._vertices.publish(vertices)
        for topic, publisher in self._keypoints:
            if publisher.get_subscription_count():
                publisher.publish(topic.build(state, stamp))
        since_marker = stamp - self._last_marker  # negative after a stamp of another clock
        if self._markers.get_subscription_count() and not 0 <= since_marker < self._marker_period:
            self._last_marker = stamp
            self._markers.publish(self._topics.markers.build(state, stamp))
        self.count("frames")
        self.report_lateness(stamp)

    def _wait_for(self, stamp: int) -> None:
        """Wait until the time of a stamp: the motion player sends motions ahead of time, but bodies are
        published on time. Do not wait for a stamp farther ahead, since it is of another clock."""
        if self.has_simulated_time():  # it may run at any rate, and /clock may arrive after the motion
            return
        wait = (stamp - self.now()) * 1e-9
        if 0 < wait <= MAX_LEAD:
            time.sleep(wait)

    def _on_legend(self, message: String) -> None:
        try:
            legend = read_legend(message)
            if not legend.get("live"):
                self._live_retargeter.add_legend(legend)
                self._message = self._asked = None  # the player moves the human
                self._log.forget_frames()
        except HumansimError as error:
            self.get_logger().error(f"legend not used: {printable(str(error))}", throttle_duration_sec=1.0)


def _at_standstill(state: HumanState) -> HumanState:
    """Copy of a state with all velocities set to zero."""
    nothing = np.zeros((len(state.joints), 3))
    features = {name: each.stopped() for name, each in state.features.items()}
    return replace(state, linear=nothing, angular=nothing, features=features)
