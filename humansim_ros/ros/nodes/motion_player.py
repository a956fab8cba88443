"""Node ``motion_player``: plays the motions of all humans of a scene from one clock.

Publishes ``humans/<id>/motion``, latched ``humans/<id>/motion/legend``, ``marker`` and ``twist`` of every
moving object (``objects/<name>``), and ``pose`` and ``twist`` of every camera with a trajectory. For a live
human, which another node moves, it publishes only the stamps of frames, ``humans/<id>/frame``. Before
everything else of a frame it publishes the scene time of its stamp, ``scene_time``.

Frame k has the stamp start + round(k * period). It is sent ``lead`` before its stamp on the wall clock, so
that bodies are ready at the stamp. A late player skips to the newest frame and counts the drops. Cameras
report each finished frame on ``frame_done``; the player skips frames that a camera has no time for, so that
all cameras show the same frames.

Parameters can be set while it plays; services ``~/pause``, ``~/step`` and ``~/restart`` control it
(docs/playing.md), and services of the package simulation_interfaces, where it is installed. Parameter values
that cannot be played are rejected with the reason, and the old motion goes on.
"""

from __future__ import annotations

import json
from collections.abc import Collection, Mapping, Sequence
from dataclasses import replace
from typing import Any

from rcl_interfaces.msg import SetParametersResult
from rclpy.parameter import Parameter
from rclpy.task import Future
from std_srvs.srv import SetBool, Trigger

from humansim_ros.data.messages import SCENE_TIME_TOPIC, HumanTopics, ObjectTopics, moving_camera_topics
from humansim_ros.errors import HumansimError, RosError, printable
from humansim_ros.ros.playing.clock import PlaybackClock, Tick
from humansim_ros.ros.playing.lockstep import LockstepPlaying, LockstepSettings
from humansim_ros.ros.playing.motions import (
    MAX_SECONDS,
    MOTION_FOLDERS,
    BackgroundWork,
    MotionParameters,
    RequestedMotions,
)
from humansim_ros.ros.playing.playing import MAX_WAITING, FramePlayer, StampedSteps
from humansim_ros.ros.playing.realtime import RealtimePlaying
from humansim_ros.ros.playing.robot import RobotPort
from humansim_ros.ros.playing.simulation_services import serve_simulation
from humansim_ros.scene.config import LIVE
from humansim_ros.scene.core import Change, JointSource, Playback, SceneState

#: Largest lead (time from sending a frame to its stamp), seconds.
MAX_LEAD = 0.1
#: A request is given up if its motions are not read within this time, seconds.
MAX_READING = 20.0


class MotionPlayerNode(FramePlayer):
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
        lead = 1e9 * self.number_parameter("lead", 0.01, 0.0, MAX_LEAD, description)
        settings = LockstepSettings.of_parameters(self)
        self.playback = Playback(self.scene)
        self.playback_clock = PlaybackClock(rate, speed, seek)
        self.playback.elapsed = self.playback_clock.elapsed
        self._changes: list[tuple[Change, JointSource]] = []
        self._motion_parameters = MotionParameters(self, self.playback)
        self._requested_motions = self._allowed_motions()
        self._background = BackgroundWork(MAX_READING)
        for name in self.scene.actors:
            description = "publish the motion; false: another node does, such as live motion capture"
            declare(f"{name}.play", True, description)
        self._scene_time = self.topic_publisher(SCENE_TIME_TOPIC)
        #: Publishers by human: of the motion; and, for live humans, of the stamps of frames.
        self._motions: dict[str, Any] = {}
        self._live: dict[str, Any] = {}
        #: Topics of moving objects and moving cameras with their publishers, by name.
        self._objects = {
            name: [(topic, self.topic_publisher(topic)) for topic in ObjectTopics(item)]
            for name, item in self.scene.moving_objects.items()
        }
        self._cameras = {
            name: [(topic, self.topic_publisher(topic)) for topic in moving_camera_topics(name)]
            for name in self.scene.moving_cameras
        }
        robot = self.scene.robot
        self._robot = None if robot is None else RobotPort(self, self.playback, robot)
        self._human_topics = {name: HumanTopics(actor) for name, actor in self.scene.actors.items()}
        self._legends = {
            name: self.topic_publisher(topics.legend) for name, topics in self._human_topics.items()
        }
        self._sources = {name: JointSource.of_actor(actor) for name, actor in self.playback.actors.items()}
        self._update_sources()
        self.add_pre_set_parameters_callback(self._motion_parameters.complete)
        self.add_on_set_parameters_callback(self._prepare)
        self.add_post_set_parameters_callback(self._apply)
        self.create_service(SetBool, "~/pause", self._on_pause)
        self.create_service(Trigger, "~/step", self._on_step)
        self.create_service(Trigger, "~/restart", self._on_restart)
        self.playing = LockstepPlaying(self, settings) if settings else RealtimePlaying(self, lead)
        self.stamped_steps = StampedSteps(self)
        self._simulation = serve_simulation(self)
        place = self.scene.path or "a scene in memory"
        count = len(self._motions)
        motions = "1 motion" if count == 1 else f"{count} motions"
        self.get_logger().info(f"playing {motions} at {rate:g} Hz from {place}")

    # --- frames

    def send_frame(self, tick: Tick, shown: SceneState) -> None:
        """Publish one frame."""
        if self._robot is not None:
            shown = self._robot.placed(tick, shown)
            self._robot.publish(shown, tick.stamp)
        self._scene_time.publish(SCENE_TIME_TOPIC.build((tick.elapsed, tick.index), tick.stamp))
        for name, publisher in self._motions.items():
            motion = self._human_topics[name].motion
            publisher.publish(motion.build(shown.motions[name], tick.stamp))
        for name, publisher in self._live.items():
            publisher.publish(self._human_topics[name].frame.build(None, tick.stamp))
        for name, object_pose in shown.objects.items():
            for object_topic, publisher in self._objects[name]:
                publisher.publish(object_topic.build(object_pose, tick.stamp))
        for name, pose in shown.cameras.items():
            for camera_topic, publisher in self._cameras[name]:
                publisher.publish(camera_topic.build(pose, tick.stamp))
        self.count("frames")

    def restart_legends(self) -> None:
        """Publish the legends again, valid for all stamps, since stamps have jumped back."""
        # no legend may be of a later stamp than its motion
        self._sources = {name: replace(source, since=0) for name, source in self._sources.items()}
        for name in self._motions:
            self._publish_legend(name, self._sources[name])

    def close(self) -> None:
        """Stop to send frames, and free resources."""
        if self._simulation is not None:
            self._simulation.close()
        self.stamped_steps.cancel("the player ends")
        self.playing.close()

    # --- parameters

    def _prepare(self, parameters: Sequence[Parameter]) -> SetParametersResult:
        """Prepare all changes before any is applied, so that rejected parameters change nothing."""
        self._changes = []
        try:
            self._changes = self._prepared(self._motion_parameters.changes(parameters))
        except HumansimError as error:
            reason = printable(str(error), 1000)
            self.get_logger().error(f"parameters rejected, the old motion goes on: {reason}")
            return SetParametersResult(successful=False, reason=reason)
        return SetParametersResult(successful=True)

    def _prepared(self, changes: Mapping[str, Mapping[str, Any]]) -> list[tuple[Change, JointSource]]:
        """Prepare changes by human, while frames go on. Raises HumansimError if a motion cannot be played."""
        return self._background.run(
            lambda: [self._prepare_change(*change) for change in changes.items()],
            self.playing.work,
            min(0.01, self.playback_clock.period * 0.5e-9),
        )

    def change_motions(self, changes: Mapping[str, Mapping[str, Any]]) -> None:
        """Change the motions of several humans at once. ``changes``: keys of a section ``motion`` by human.
        If one cannot be played, changes nothing and raises HumansimError."""
        self._changes = self._prepared(changes)
        self._apply_changes()

    def _prepare_change(self, human: str, settings: Mapping[str, Any]) -> tuple[Change, JointSource]:
        """Prepare the change of one motion. Returns the change, and the content of the new legend."""
        change = self.playback.prepare(human, settings, self._requested_motions)
        return change, JointSource.of_actor(change.actor)

    def _allowed_motions(self) -> RequestedMotions:
        """Motions that parameters may name over the network, including all motions set at the start."""
        folders = self.described_parameter(
            MOTION_FOLDERS,
            Parameter.Type.STRING_ARRAY,
            "Folders whose files the motion parameters may name, besides the folder of the scene",
            read_only=True,
        )
        named = {human.motion.file for human in self.scene.config.humans.values()}
        named |= {settings.file for settings in self.playback.settings.values()}
        return RequestedMotions.of(self.scene.source, folders or (), named)

    def _apply(self, parameters: Sequence[Parameter]) -> None:
        """Make accepted parameters effective."""
        self._apply_changes()
        values = {parameter.name: parameter.value for parameter in parameters}
        if "speed" in values:
            self.playback_clock.set_speed(values["speed"])
        if "rate" in values:
            self.playback_clock.set_rate(values["rate"])
        if "seek" in values:
            self._go_to(values["seek"])
        elif "rate" in values:
            self.playing.follow_rate()

    def _apply_changes(self) -> None:
        """Start the prepared motions with the next frame."""
        since = 0 if self.playback_clock.last is None else self.playback_clock.last + 1
        for change, source in self._changes:
            self._sources[change.name] = replace(source, since=since)
            self.playback.apply(change)
        self._update_sources({change.name for change, _ in self._changes})
        self._changes = []

    def _update_sources(self, changed: Collection[str] = ()) -> None:
        """Adapt publishers and legends: every human that is not live has a publisher of its motion.
        ``changed``: humans with another motion, which get a new legend."""
        for name in self._legends:
            live = self.playback.settings[name].file == LIVE or not self.get_parameter(f"{name}.play").value
            old, new = (self._motions, self._live) if live else (self._live, self._motions)
            if name in new and name not in changed:
                continue
            self._publish_legend(name, None if live else self._sources[name])
            if name in old:
                self.destroy_publisher(old.pop(name))
            if name not in new:
                topics = self._human_topics[name]
                new[name] = self.topic_publisher(topics.frame if live else topics.motion)

    def _publish_legend(self, human: str, source: JointSource | None) -> None:
        """Publish the legend of a human's motion. ``source``: None if another node moves the human."""
        self._legends[human].publish(self._human_topics[human].legend.build(source, 0))

    def restart(self) -> Tick:
        """Jump to scene time 0. Returns the frame that shows this time."""
        return self._go_to(0.0)

    def _go_to(self, seconds: float) -> Tick:
        """Jump to a scene time, as if all humans had played their present motions from the start."""
        self.playback.rewind()
        return self.playing.seek(seconds)

    # --- services

    def _on_pause(self, request: Any, response: Any) -> Any:
        self.playing.pause(bool(request.data))
        return _accept(response, self.playback_clock.last or 0, self.playback_clock.elapsed)

    def _on_step(self, _: Any, response: Any) -> Any:
        if not self.playing.is_paused:
            response.message = "the player must be paused for a step: call ~/pause first"
            return response
        if self.playing.waiting >= MAX_WAITING:
            response.message = f"{MAX_WAITING} steps wait for the cameras: wait for their images first"
            return response
        if self.stamped_steps.topic:
            return self._stamped_step(response)
        tick = self.playing.step()
        return _accept(response, tick.stamp, tick.elapsed)

    def _stamped_step(self, response: Any) -> Any:
        """Play a step. Returns a refusal, or a future: the response when a message with its stamp arrives."""
        answered: Any = Future()

        def on_end(tick: Tick | None, failure: str) -> None:
            if failure or tick is None:
                response.message = failure
            else:
                _accept(response, tick.stamp, tick.elapsed)
            answered.set_result(response)

        try:
            self.stamped_steps.play(on_end)
        except RosError as error:
            response.message = str(error)
            return response
        return answered

    def _on_restart(self, _: Any, response: Any) -> Any:
        tick = self.restart()
        return _accept(response, tick.stamp, tick.elapsed)


def _accept(response: Any, stamp: int, elapsed: int) -> Any:
    """Fill a response with the stamp and the scene time of a frame (nanoseconds), as JSON."""
    seconds, nanoseconds = divmod(stamp, 1_000_000_000)
    position = {
        "stamp": {"sec": seconds, "nanosec": nanoseconds},
        "scene_time": round(elapsed * 1e-9, 9),
    }
    response.success, response.message = True, json.dumps(position)
    return response
