"""Node ``motion_player``: plays the motions of all humans of a scene from one clock.

Publishes ``humans/<id>/motion``, latched ``humans/<id>/motion/legend``, ``marker`` and ``twist`` of every
moving object (``objects/<name>``), and ``pose`` and ``twist`` of every camera with a trajectory. Of a live
human, which another node moves, it publishes only the stamps of its frames, ``humans/<id>/frame``. Before
everything else of a frame it publishes the scene time of its stamp, ``scene_time``.

Frame k has the stamp start + round(k * period). It is sent ``lead`` before its stamp on the wall clock, so
that bodies are ready at the stamp. A late player skips to the newest frame and counts the drops. Cameras
report each finished frame on ``frame_done``; the player skips frames that a camera has no time for, so that
all cameras show the same frames.

Parameters can be set while it plays; services ``~/pause``, ``~/step`` and ``~/restart`` control it
(docs/playing.md). Values that cannot be played are rejected with the reason, and the old motion goes on.
"""

from __future__ import annotations

import json
import time
from collections import deque
from collections.abc import Collection, Mapping, Sequence
from dataclasses import replace
from typing import Any

from geometry_msgs.msg import PoseStamped, TwistStamped
from rcl_interfaces.msg import SetParametersResult
from rclpy.event_handler import QoSLivelinessChangedInfo, SubscriptionEventCallbacks
from rclpy.parameter import Parameter
from rclpy.qos import QoSProfile
from sensor_msgs.msg import MultiDOFJointState, TimeReference
from std_msgs.msg import Header, String
from std_srvs.srv import SetBool, Trigger
from visualization_msgs.msg import Marker

from humansim_ros.errors import HumansimError, printable
from humansim_ros.ros.background import BackgroundWork
from humansim_ros.ros.clock_steps import ClockSteps
from humansim_ros.ros.frame_pacing import FramePacing
from humansim_ros.ros.messages import (
    WORLD_FRAME,
    header,
    live_legend,
    motion_legend,
    motion_message,
    object_message,
    pose_message,
    scene_time_message,
    to_nanoseconds,
    twist_message,
)
from humansim_ros.ros.motion_parameters import MAX_SECONDS, MotionParameters
from humansim_ros.ros.node import SceneNode
from humansim_ros.ros.qos import ALIVE, CAMERA_ALIVE, DATA, LATCHED, SCENE_TIME
from humansim_ros.ros.requested_motions import MOTION_FOLDERS, RequestedMotions
from humansim_ros.ros.runtime import run_node
from humansim_ros.scene import Scene
from humansim_ros.scene.config import LIVE
from humansim_ros.scene.live import JointSource
from humansim_ros.scene.playback import Change, Playback, PlaybackClock, ScenePoses, Tick

#: Largest accepted lead in seconds.
MAX_LEAD = 0.1
#: Seconds until a request is given up whose motions are not ready.
MAX_READING = 20.0
#: Most frames of a pause that wait until the cameras have time for them.
MAX_WAITING = 100
#: Queue for reports: one for each camera process and frame; a lost one is replaced by the next.
_REPORTS = QoSProfile(depth=50)


class MotionPlayerNode(SceneNode):
    """Publishes the joints of all motions, moving objects and moving cameras, frame by frame."""

    def __init__(self, **options: Any) -> None:
        super().__init__("motion_player", **options)
        declare = self.described_parameter
        rate = declare(
            "rate", self.scene.config.rate, "Frames per second", (min(0.01, self.scene.config.rate), 1000.0)
        )
        speed = declare("speed", 1.0, "Scene time per second", (0.0, 10.0))
        seek = declare("seek", 0.0, "Setting it jumps to this scene time in seconds", (0.0, MAX_SECONDS))
        description = "Seconds by which motions are sent before their stamps, so that bodies are ready then"
        self._requested_lead = 1e9 * self.number_parameter("lead", 0.01, 0.0, MAX_LEAD, description)
        self._playback = Playback(self.scene)
        self._playback_clock = PlaybackClock(rate, speed, seek)
        self._clock_steps = ClockSteps(lambda: self.now(), self.has_simulated_time)
        self._playback.elapsed = self._playback_clock.elapsed
        self._changes: list[tuple[Change, JointSource]] = []
        self._motion_parameters = MotionParameters(self, self._playback)
        self._requested_motions = self._allowed_motions()
        self._background = BackgroundWork(MAX_READING)
        for name in self.scene.actors:
            description = "publish the motion; false: another node does, such as live motion capture"
            declare(f"{name}.play", True, description)
        self._scene_time = self.create_publisher(TimeReference, SCENE_TIME, DATA)
        #: Publishers of motions by human, and of the stamps of its frames for a live human.
        self._motions: dict[str, Any] = {}
        self._live: dict[str, Any] = {}
        self._markers = {
            name: self.create_publisher(Marker, f"objects/{name}/marker", DATA)
            for name in self.scene.moving_objects
        }
        moving = [*(f"objects/{name}" for name in self._markers), *self.scene.moving_cameras]
        self._twists = {
            topic: self.create_publisher(TwistStamped, f"{topic}/twist", DATA) for topic in moving
        }
        self._poses = {
            name: self.create_publisher(PoseStamped, f"{name}/pose", DATA)
            for name in self.scene.moving_cameras
        }
        self._legends = {
            name: self.create_publisher(String, f"humans/{name}/motion/legend", LATCHED)
            for name in self.scene.actors
        }
        self._sources = {name: JointSource.of_actor(actor) for name, actor in self._playback.actors.items()}
        self._update_sources()
        self.add_pre_set_parameters_callback(self._motion_parameters.complete)
        self.add_on_set_parameters_callback(self._prepare)
        self.add_post_set_parameters_callback(self._apply)
        self.create_service(SetBool, "~/pause", self._on_pause)
        self.create_service(Trigger, "~/step", self._on_step)
        self.create_service(Trigger, "~/restart", self._on_restart)
        self._pacing = FramePacing()
        #: Frames of a pause (steps, seeks) that wait until the cameras have time for them.
        self._waiting: deque[tuple[Tick, ScenePoses]] = deque()
        self.create_subscription(Header, "frame_done", self._on_frame_done, _REPORTS)
        events = SubscriptionEventCallbacks(liveliness=self._on_liveliness)
        self.create_subscription(Header, CAMERA_ALIVE, lambda _: None, ALIVE, event_callbacks=events)
        self._frame_timer = self.create_timer(self._playback_clock.period * 1e-9, self._tick)
        self.get_logger().info(f"playing {len(self._motions)} motions at {rate:g} Hz from {self.scene.path}")

    # --- frames

    @property
    def _lead(self) -> int:
        """Nanoseconds; at most a period, so that motions do not queue up at the skinners."""
        return round(min(self._requested_lead, self._playback_clock.period))

    def _stamp_now(self) -> int:
        """Stamp of a frame that is sent now."""
        now, step = self._clock_steps.read()
        if step:
            self._follow_clock(step)
        return now + self._lead

    def _follow_clock(self, step: int) -> None:
        """Go on after the clock was set by ``step`` nanoseconds."""
        started = self._playback_clock.last is not None
        self._playback_clock.shift(step)
        if not started:
            return
        clock = "simulated time" if self.has_simulated_time() else "the system clock"
        step_text = f"{abs(step) * 1e-9:.2f} s {'ahead' if step > 0 else 'back'}"
        text = f"{clock} was set {step_text}: stamps jump with it, scene time goes on"
        self.get_logger().warn(text, throttle_duration_sec=5.0)
        if step < 0:  # no legend may be of a later stamp than its motion
            self._sources = {name: replace(source, since=0) for name, source in self._sources.items()}
            for name in self._motions:
                self._legends[name].publish(motion_legend(self._sources[name]))

    def _tick(self) -> None:
        self._send_waiting()
        now = self._stamp_now()
        tick = self._playback_clock.due(now)
        if tick is None:
            return
        if tick.stamp == now:
            # frames are counted from here: the timer was late, so it would be early for all later frames,
            # and each would wait for the next call of the timer
            self._frame_timer.reset()
        if self._playback_clock.paused or self._waiting:
            # the same pose again; a step is not lost among such frames
            if not self._waiting and self._pacing.may_repeat(time.monotonic()):
                self._publish(tick)
            return
        late = self._pacing.late_cameras(tick.stamp, self._playback_clock.period, time.monotonic())
        if late:
            self.count("drops", 1 + tick.dropped)
            self.drop_reason = f"waiting for {', '.join(late)}"
            return
        self._publish(tick)

    def _on_frame_done(self, report: Header) -> None:
        self._pacing.add_finished(report.frame_id, to_nanoseconds(report.stamp), time.monotonic())
        self._send_waiting()

    def _send_waiting(self) -> None:
        """Publish the next waiting frames for which the cameras have time."""
        while self._waiting and self._pacing.may_send_paused(1, time.monotonic()):
            self._send(*self._waiting.popleft())

    def _on_liveliness(self, change: QoSLivelinessChangedInfo) -> None:
        if change.alive_count_change < 0:  # a camera process has ended or died
            self._pacing.forget_cameras()

    def _publish(self, tick: Tick) -> None:
        """Publish one frame."""
        self._send(tick, self._playback.show(tick.elapsed, tick.pace))

    def _send(self, tick: Tick, scene_poses: ScenePoses) -> None:
        self._pacing.add_sent(tick.stamp, time.monotonic())
        self._scene_time.publish(scene_time_message(tick.elapsed, tick.stamp))
        for name, publisher in self._motions.items():
            publisher.publish(motion_message(scene_poses.poses[name], tick.stamp))
        for publisher in self._live.values():
            publisher.publish(header(tick.stamp, WORLD_FRAME))
        for name, object_pose in scene_poses.objects.items():
            moving = self.scene.moving_objects[name]
            self._twists[f"objects/{name}"].publish(twist_message(object_pose.velocity, tick.stamp))
            self._markers[name].publish(object_message(moving, object_pose, tick.stamp))
        for name, pose in scene_poses.cameras.items():
            self._twists[name].publish(twist_message(pose.velocity, tick.stamp))
            self._poses[name].publish(pose_message(pose, tick.stamp))
        self.count("drops", tick.dropped)
        self.count("frames")
        self.report_lateness(tick.stamp - self._lead)

    def _publish_at_once(self, tick: Tick) -> None:
        """Publish a frame between two calls of the timer; timer and clock go on from here.

        During a pause it waits until the cameras have time for it, so that none loses it.
        """
        self._frame_timer.timer_period_ns = round(self._playback_clock.period)
        self._frame_timer.reset()
        scene_poses = self._playback.show(tick.elapsed, tick.pace)
        if not (self._playback_clock.paused or self._waiting):
            self._send(tick, scene_poses)
        elif len(self._waiting) < MAX_WAITING:  # else shown by the next frames of the pause
            self._waiting.append((tick, scene_poses))
            self._send_waiting()

    # --- parameters

    def _prepare(self, parameters: Sequence[Parameter]) -> SetParametersResult:
        """Prepare all changes before any is made, so that rejected parameters change nothing."""
        self._changes = []
        changes = self._motion_parameters.changes(parameters)
        try:
            self._changes = self._background.run(
                lambda: [self._prepare_change(*change) for change in changes.items()],
                self._tick,
                min(0.01, self._playback_clock.period * 0.5e-9),
            )
        except HumansimError as error:
            reason = printable(str(error), 1000)
            self.get_logger().error(f"parameters rejected, the old motion goes on: {reason}")
            return SetParametersResult(successful=False, reason=reason)
        return SetParametersResult(successful=True)

    def _prepare_change(self, human: str, settings: Mapping[str, Any]) -> tuple[Change, JointSource]:
        """Prepare a change, and the content of its legend."""
        change = self._playback.prepare(human, settings, self._requested_motions)
        return change, JointSource.of_actor(change.actor)

    def _allowed_motions(self) -> RequestedMotions:
        """Motions that parameters may be set to over the network; those of the start are among them."""
        folders = self.described_parameter(
            MOTION_FOLDERS,
            Parameter.Type.STRING_ARRAY,
            "Folders whose files the motion parameters may name, besides the folder of the scene",
            read_only=True,
        )
        named = {human.motion.file for human in self.scene.config.humans.values()}
        named |= {settings.file for settings in self._playback.settings.values()}
        return RequestedMotions.of(self.scene.source, folders or (), named)

    def _apply(self, parameters: Sequence[Parameter]) -> None:
        """Make accepted parameters effective."""
        since = 0 if self._playback_clock.last is None else self._playback_clock.last + 1
        for change, source in self._changes:
            self._sources[change.name] = replace(source, since=since)
            self._playback.apply(change)
        self._update_sources({change.name for change, _ in self._changes})
        self._changes = []
        values = {parameter.name: parameter.value for parameter in parameters}
        if "speed" in values:
            self._playback_clock.set_speed(values["speed"])
        if "rate" in values:
            tick = self._playback_clock.set_rate(values["rate"], self._stamp_now())
            if "seek" not in values:
                self._publish_at_once(tick)
        if "seek" in values:
            self._go_to(values["seek"])

    def _update_sources(self, changed: Collection[str] = ()) -> None:
        """Publish the motion of every human that is not live, and the legend of each change.

        ``changed``: humans with another motion.
        """
        for name in self._legends:
            live = self._playback.settings[name].file == LIVE or not self.get_parameter(f"{name}.play").value
            old, new = (self._motions, self._live) if live else (self._live, self._motions)
            if name in new and name not in changed:
                continue
            self._legends[name].publish(live_legend() if live else motion_legend(self._sources[name]))
            if name in old:
                self.destroy_publisher(old.pop(name))
            if name not in new:
                kind, topic = (Header, "frame") if live else (MultiDOFJointState, "motion")
                new[name] = self.create_publisher(kind, f"humans/{name}/{topic}", DATA)

    def _go_to(self, seconds: float) -> None:
        """Jump to a scene time, as if all humans had played their present motions from the start."""
        self._playback.rewind()
        self._publish_at_once(self._playback_clock.seek(seconds, self._stamp_now()))

    # --- services

    def _on_pause(self, request: Any, response: Any) -> Any:
        self._playback_clock.pause(bool(request.data))
        return self._accept(response)

    def _on_step(self, _: Any, response: Any) -> Any:
        if not self._playback_clock.paused:
            response.message = "the player must be paused for a step: call ~/pause first"
            return response
        if len(self._waiting) >= MAX_WAITING:
            response.message = f"{MAX_WAITING} steps wait for the cameras: wait for their images first"
            return response
        self._publish_at_once(self._playback_clock.step(self._stamp_now()))
        return self._accept(response)

    def _on_restart(self, _: Any, response: Any) -> Any:
        self._go_to(0.0)
        return self._accept(response)

    def _accept(self, response: Any) -> Any:
        """Answer with stamp and scene time of the last frame, as JSON."""
        seconds, nanoseconds = divmod(self._playback_clock.last or 0, 1_000_000_000)
        position = {
            "stamp": {"sec": seconds, "nanosec": nanoseconds},
            "scene_time": round(self._playback_clock.elapsed * 1e-9, 9),
        }
        response.success, response.message = True, json.dumps(position)
        return response


def main(scene: Scene | None = None) -> int:
    """Run the node; returns its exit code. ``scene``: the scene of its parameter, if it is loaded already."""
    return run_node(lambda: MotionPlayerNode(scene=scene))
