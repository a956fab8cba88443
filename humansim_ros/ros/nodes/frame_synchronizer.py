"""Synchronise messages: all messages with the same stamp make up one scene state."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any

from rclpy.event_handler import QoSSubscriptionMatchedInfo, SubscriptionEventCallbacks
from sensor_msgs.msg import TimeReference
from std_msgs.msg import Header

from humansim_ros.data import messages
from humansim_ros.data.messages import GivenUpFrame, PacedFrames, SceneInput, received_state, scene_inputs
from humansim_ros.errors import HumansimError
from humansim_ros.ros.graph.qos import ALIVE, CAMERA_ALIVE, DONE, FRAME_DONE, NEWEST, SCENE_TIME
from humansim_ros.ros.processes.node import SceneNode
from humansim_ros.scene.config import frame_at
from humansim_ros.scene.core import CameraPose, SceneState

#: If no vertices arrive within this time after the start, seconds, the start of the scene is shown.
_START_SCENE_AFTER = 1.5
#: If noise depends on scene time, the first frames wait for a scene time, but not longer than this, seconds.
_SCENE_TIME_WITHIN = 1.0
#: Within this time after the start, seconds, other nodes may still be starting.
_STARTING = 15.0
#: Stamps of another clock are reported after the first number of seconds with such stamps. After a pause of
#: the second number of seconds, the count begins anew.
_CLOCK_DOUBT, _CLOCK_GAP = 10.0, 5.0


class FrameSynchronizer:
    """Subscribes to all humans, all moving objects and some cameras, and passes on complete frames.

    It subscribes to vertices, joints and features of every human, to marker and twist of every moving object,
    to pose and twist of some cameras, and to ``scene_time`` if it has a publisher. Without such a publisher,
    for example when a bag with vertices is played, the stamp is used as scene time.

    Each finished frame is reported on ``frame_done``. With these reports, the motion player sends a frame
    only if all cameras have time for it, so that every frame is passed on. If nobody listens to the reports,
    and frames arrive faster than ``on_frame`` returns, only the newest frame is passed on.

    Until the first skinner publishes, the start of the scene is passed on, so that a camera shows something
    even without other nodes. Parameter ``start_scene`` switches this off.

    Args:
        node: Node that subscribes.
        on_frame: Called with each complete frame.
        cameras: Nodes of the cameras that show the frames; the reports name them.
        moving_cameras: Names of cameras with a trajectory.
        previews: Whether the start of the scene may be passed on (with parameter ``start_scene``).
    """

    def __init__(
        self,
        node: SceneNode,
        on_frame: Callable[[SceneState], None],
        cameras: Sequence[SceneNode],
        moving_cameras: Sequence[str] = (),
        previews: bool = True,
    ) -> None:
        self._node = node
        self._reporter = ", ".join(camera.get_fully_qualified_name() for camera in cameras)
        self._scene = node.scene
        self._on_frame = on_frame
        self._moving_cameras = list(moving_cameras)
        # first, so that it is read before the other messages of its frame
        events = SubscriptionEventCallbacks(matched=self._on_scene_time_matched)
        self._subscribe(SCENE_TIME, SceneInput(TimeReference, self._read_scene_time), event_callbacks=events)
        inputs = scene_inputs(self._scene, self._moving_cameras)
        for topic, each in inputs.items():
            self._subscribe(topic, each)
        #: Topics of humans, objects and cameras.
        self._topics = list(inputs)
        self._frames = PacedFrames(self._topics, self._scene.period * 1e9)
        noisy = any(
            camera.sensor.config.noise or camera.depth_sensor for camera in self._scene.scene_cameras.values()
        )
        #: Whether a publisher of the scene time is known.
        self._has_scene_time = False
        self._require_scene_time(noisy)
        #: Monotonic seconds of the first message.
        self._first_message: float | None = None
        self._has_frames = False
        #: Monotonic seconds of the first and newest frame in a series with stamps of another clock.
        self._first_foreign, self._last_foreign = 0.0, float("-inf")
        self._done = node.create_publisher(Header, FRAME_DONE, DONE)
        self._alive = node.create_publisher(Header, CAMERA_ALIVE, ALIVE)
        description = "Show the scene at its start while no vertices arrive"
        self._shows_start = previews and bool(
            node.described_parameter("start_scene", True, description, read_only=True)
        )
        self._started = time.monotonic()
        self._start_scene_logged = False
        self._start_timer = node.create_timer(self._scene.period, self._await_first_frame)

    def _subscribe(self, topic: str, source: SceneInput, **options: Any) -> None:
        """Subscribe to a topic, and store each message with the other messages of its stamp. ``options``:
        other options of ``create_subscription``."""

        def on_message(message: Any) -> None:
            try:
                content = source.read(message)
            except HumansimError as error:
                self._node.report_skipped(f"{topic}: {error}")
                return
            if source.raw:
                stamp = messages.serialised_stamp(message)
            else:
                stamp = messages.to_nanoseconds(message.header.stamp)
            self._store(topic, stamp, content)

        self._node.create_subscription(
            source.type, topic, on_message, NEWEST, raw=source.raw, max_bytes=source.max_bytes, **options
        )

    def _on_scene_time_matched(self, publishers: QoSSubscriptionMatchedInfo) -> None:
        self._has_scene_time = publishers.current_count > 0
        self._require_scene_time(self._has_scene_time)

    def _read_scene_time(self, message: TimeReference) -> tuple[int, int]:
        """Scene time in nanoseconds, and number of the frame."""
        scene_time, index = messages.read_scene_time(message), messages.read_frame_number(message)
        self._has_scene_time = True
        self._require_scene_time(True)
        return scene_time, self._frame_at(scene_time) if index is None else index

    def _frame_at(self, scene_time: int) -> int:
        return frame_at(scene_time, self._scene.config.rate)

    def _require_scene_time(self, required: bool) -> None:
        """Set whether frames wait for their scene time. If nothing moves, frames wait for nothing else."""
        self._frames.require(SCENE_TIME, required or not self._topics)
        if not required and self._frames.has_whole:
            self._schedule_next_frame()

    def _store(self, topic: str, stamp: int, content: Any) -> None:
        """Store the content of a message with the contents of other messages that have the same stamp."""
        steady = time.monotonic()
        if self._first_message is None:
            self._first_message = steady
        if self._frames.add(topic, stamp, content, steady):
            self._schedule_next_frame()
        elif frame := self._frames.give_up(self._node.now(), steady):
            self._report_given_up(frame)

    def _report_given_up(self, frame: GivenUpFrame) -> None:
        if frame.offsets:
            self._node.count("foreign_stamps")
            seconds = max(frame.offsets.values(), key=abs)
            now = time.monotonic()
            if now - self._last_foreign > _CLOCK_GAP:
                self._first_foreign = now
            self._last_foreign = now
            # a node that was started or has died leaves stamps behind that only look like another clock
            if now - self._first_foreign > _CLOCK_DOUBT:
                self._node.report_other_clock(frame.offsets, seconds, "others")
            return
        if not self._has_frames and time.monotonic() - self._started < _STARTING:
            return  # the skinners may be starting
        self._node.count("drops")
        sources = dict.fromkeys(
            topic.rpartition("/")[0].removeprefix("humans/") or topic for topic in frame.missing
        )
        is_human = any(topic.startswith("humans/") for topic in frame.missing)
        node = "its skinner" if is_human else "the motion player"
        self._node.get_logger().warn(
            f"frames wait for {', '.join(sources)}: is {node} running?", throttle_duration_sec=5.0
        )

    def _schedule_next_frame(self) -> None:
        """Process a frame after all messages that have arrived, so that a late node notices its delay."""
        # executors that do not take events in turn run tasks before arrived messages: thus two tasks
        self._node.run_soon(lambda: self._node.run_soon(self._process_next_frame))

    def _process_next_frame(self) -> None:
        """Pass on the oldest complete frame. If the player does not wait for reports, late frames are
        skipped; if all frames are late, the newest is passed on.
        """
        paced = self._done.get_subscription_count() > 0
        frame = self._frames.take(not paced, self._node.now(), time.monotonic())
        if frame is None:
            return
        self._has_frames = True
        self._node.count("drops", frame.skipped)
        self._node.report_lateness(frame.stamp, "arrival")
        contents = frame.contents
        scene_time, index = contents.get(SCENE_TIME) or (frame.stamp, self._frame_at(frame.stamp))
        self._pass_on(
            received_state(
                self._scene, contents, frame.stamp, scene_time, index, moving_cameras=self._moving_cameras
            )
        )
        report = messages.header(frame.stamp, self._reporter)
        self._done.publish(report)
        self._alive.publish(report)
        if self._frames.has_whole:
            self._schedule_next_frame()

    def _await_first_frame(self) -> None:
        """Show the scene at its start until frames arrive, and do not wait for ever for a scene time."""
        if self._has_frames:
            self._start_timer.cancel()
            return
        steady = time.monotonic()
        if self._first_message is not None and steady - self._first_message > _SCENE_TIME_WITHIN:
            self._require_scene_time(self._has_scene_time)
        if self._shows_start and (steady - self._started > _START_SCENE_AFTER or not self._topics):
            self._show_start_scene()

    def _show_start_scene(self) -> None:
        if not self._start_scene_logged and self._topics:
            self._start_scene_logged = True
            self._node.get_logger().info("no vertices are published: showing the scene at its start")
        states = {name: actor.at(0.0) for name, actor in self._scene.actors.items()}
        objects = {
            name: replace(moving.at(0.0), velocity=None)
            for name, moving in self._scene.moving_objects.items()
        }
        now = self._node.now()
        self._pass_on(
            SceneState(
                stamp=now,
                scene_time=0,
                index=self._frame_at(now),
                scene=self._scene,
                actors=self._scene.actors,
                humans={name: replace(state, linear=None, angular=None) for name, state in states.items()},
                objects=objects,
                cameras={name: CameraPose.of(self._scene.cameras[name]) for name in self._moving_cameras},
                is_preview=True,
            )
        )

    def _pass_on(self, state: SceneState) -> None:
        with self._node.skip_frame_on_error():
            self._on_frame(state)
