"""Node ``motion_player``: plays the motions of a scene's humans, all from one clock.

Publishes ``humans/<id>/motion``, latched ``humans/<id>/motion/legend``, ``objects/<name>/marker`` and
``twist`` of every object that moves, and ``<camera>/pose`` and ``twist`` of every camera with a trajectory.
Frame k has the stamp start + round(k * period) and leaves ``lead`` before it on the wall clock, so that what
follows from it can be there at its stamp; a player that is late skips to the newest frame and reports the
drop.

Parameters can be set while it plays, services ``~/pause``, ``~/step`` and ``~/restart`` steer it
(docs/playing.md). What cannot be played is refused with the reason, and the old motion goes on.
"""

from __future__ import annotations

import sys
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor, wait
from dataclasses import replace
from typing import Any, TypeVar

from geometry_msgs.msg import PoseStamped, TwistStamped
from rcl_interfaces.msg import SetParametersResult
from rclpy.parameter import Parameter
from sensor_msgs.msg import MultiDOFJointState
from std_msgs.msg import String
from std_srvs.srv import SetBool, Trigger
from visualization_msgs.msg import Marker

from humansim_ros.errors import HumansimError
from humansim_ros.ros.messages import (
    motion_legend,
    motion_message,
    object_message,
    pose_message,
    twist_message,
)
from humansim_ros.ros.motion_parameters import LONGEST, MotionParameters
from humansim_ros.ros.node import SceneNode
from humansim_ros.ros.qos import DATA, LATCHED
from humansim_ros.ros.runtime import run_node
from humansim_ros.scene.live import JointSource
from humansim_ros.scene.playback import Change, Playback, PlaybackClock, Tick

T = TypeVar("T")
#: Most seconds that frames may leave before their stamps.
LONGEST_LEAD = 0.1


class MotionPlayerNode(SceneNode):
    """Publishes where the joints of every motion are, frame by frame."""

    def __init__(self, **options: Any) -> None:
        super().__init__("motion_player", **options)
        declare = self.described_parameter
        rate = declare(
            "rate", self.scene.config.rate, "Frames per second", (min(0.01, self.scene.config.rate), 1000.0)
        )
        speed = declare("speed", 1.0, "Seconds of the scene per second", (0.0, 10.0))
        seek = declare("seek", 0.0, "Setting it goes to this second of the scene", (0.0, LONGEST))
        what = "Seconds before their stamps at which motions leave, so that bodies are there at their stamps"
        self._asked_lead = 1e9 * self.number_parameter("lead", 0.01, 0.0, LONGEST_LEAD, what)
        self._playback = Playback(self.scene)
        self._scene_clock = PlaybackClock(rate, speed, seek)
        self._playback.elapsed = self._scene_clock.elapsed
        self._changes: list[tuple[Change, JointSource]] = []
        self._parameters_of_motions = MotionParameters(self, self._playback)
        for name in self.scene.actors:
            what = (
                "whether the motion is sent; false leaves the human to another source, such as live capture"
            )
            declare(f"{name}.play", True, what)
        self._motions = {
            name: self.create_publisher(MultiDOFJointState, f"humans/{name}/motion", DATA)
            for name in self.scene.actors
        }
        self._markers = {
            name: self.create_publisher(Marker, f"objects/{name}/marker", DATA)
            for name in self.scene.moving_objects
        }
        # of objects and cameras: how they move
        topics = [*(f"objects/{name}" for name in self._markers), *self.scene.moving_cameras]
        self._twists = {
            topic: self.create_publisher(TwistStamped, f"{topic}/twist", DATA) for topic in topics
        }
        self._poses = {
            name: self.create_publisher(PoseStamped, f"{name}/pose", DATA)
            for name in self.scene.moving_cameras
        }
        self._legends = {
            name: self.create_publisher(String, f"humans/{name}/motion/legend", LATCHED)
            for name in self.scene.actors
        }
        for name, actor in self._playback.actors.items():
            self._legends[name].publish(motion_legend(JointSource.of_actor(actor)))
        self.add_pre_set_parameters_callback(self._parameters_of_motions.complete)
        self.add_on_set_parameters_callback(self._prepare)
        self.add_post_set_parameters_callback(self._apply)
        self.create_service(SetBool, "~/pause", self._on_pause)
        self.create_service(Trigger, "~/step", self._on_step)
        self.create_service(Trigger, "~/restart", self._on_restart)
        self._ticking = self.create_timer(self._scene_clock.period * 1e-9, self._tick)
        self.get_logger().info(f"playing {len(self._motions)} motions at {rate:g} Hz from {self.scene.path}")

    # --- frames

    @property
    def _lead(self) -> int:
        """Nanoseconds; at most a period, so that motions do not queue up before skinners."""
        return round(min(self._asked_lead, self._scene_clock.period))

    def _ahead(self) -> int:
        """The time that frames are sent for, nanoseconds."""
        return self.now() + self._lead

    def _tick(self) -> None:
        now = self._ahead()
        tick = self._scene_clock.due(now)
        if tick is None:
            return
        if tick.stamp == now:
            # frames are counted from here: a timer that came late to it would be early for all others, and
            # each would wait for the timer's next round
            self._ticking.reset()
        self._publish(tick)

    def _publish(self, tick: Tick) -> None:
        """One frame: everything that moves, at one stamp."""
        moment = self._playback.show(tick.elapsed, tick.pace)
        for name, poses in moment.poses.items():
            if self.get_parameter(f"{name}.play").value:
                self._motions[name].publish(motion_message(poses, tick.stamp))
        for name, place in moment.objects.items():
            thing = self.scene.moving_objects[name]
            self._twists[f"objects/{name}"].publish(twist_message(place.velocity, tick.stamp))
            self._markers[name].publish(object_message(thing, place, tick.stamp))
        for name, pose in moment.cameras.items():
            self._twists[name].publish(twist_message(pose.velocity, tick.stamp))
            self._poses[name].publish(pose_message(pose, tick.stamp))
        self.count("drops", tick.dropped)
        self.count("frames")
        self.report_lateness(tick.stamp - self._lead)

    def _publish_at_once(self, tick: Tick) -> None:
        """A frame out of turn; the timer goes on from here, as the clock does."""
        self._ticking.timer_period_ns = round(self._scene_clock.period)
        self._ticking.reset()
        self._publish(tick)

    # --- parameters

    def _prepare(self, parameters: Sequence[Parameter]) -> SetParametersResult:
        """Everything is prepared before anything is changed: what is refused leaves all as it was."""
        self._changes = []
        wanted = self._parameters_of_motions.wanted(parameters)
        try:
            self._changes = self._meanwhile(lambda: [self._ready(*one) for one in wanted.items()])
        except HumansimError as error:
            self.get_logger().error(f"the motion stays as it is: {error}")
            return SetParametersResult(successful=False, reason=str(error))
        return SetParametersResult(successful=True)

    def _ready(self, human: str, settings: Mapping[str, Any]) -> tuple[Change, JointSource]:
        """A change, and what its legend says."""
        change = self._playback.prepare(human, settings)
        return change, JointSource.of_actor(change.actor)

    def _meanwhile(self, work: Callable[[], T]) -> T:
        """Do something slow while frames go on."""
        with ThreadPoolExecutor(1) as pool:
            doing = pool.submit(work)
            while not wait([doing], timeout=min(0.01, self._scene_clock.period * 0.5e-9)).done:
                self._tick()
        return doing.result()

    def _apply(self, parameters: Sequence[Parameter]) -> None:
        """Parameters that have been accepted take effect."""
        since = 0 if self._scene_clock.last is None else self._scene_clock.last + 1
        for change, source in self._changes:
            self._legends[change.name].publish(motion_legend(replace(source, since=since)))
            self._playback.make(change)
        self._changes = []
        values = {parameter.name: parameter.value for parameter in parameters}
        if "speed" in values:
            self._scene_clock.set_speed(values["speed"])
        if "rate" in values:
            tick = self._scene_clock.set_rate(values["rate"], self._ahead())
            if "seek" not in values:
                self._publish_at_once(tick)
        if "seek" in values:
            self._go_to(values["seek"])

    def _go_to(self, seconds: float) -> None:
        """Show a second of the scene as if all had done from its start what they do now."""
        self._playback.rewind()
        self._publish_at_once(self._scene_clock.seek(seconds, self._ahead()))

    # --- services

    def _on_pause(self, request: Any, response: Any) -> Any:
        self._scene_clock.pause(bool(request.data))
        response.success = True
        response.message = f"{'paused' if request.data else 'playing'} {self._place()}"
        return response

    def _on_step(self, _: Any, response: Any) -> Any:
        response.success = self._scene_clock.paused
        if self._scene_clock.paused:
            self._publish_at_once(self._scene_clock.step(self._ahead()))
            response.message = self._place()
        else:
            response.message = "only a paused player steps: call ~/pause first"
        return response

    def _on_restart(self, _: Any, response: Any) -> Any:
        self._go_to(0.0)
        response.success, response.message = True, self._place()
        return response

    def _place(self) -> str:
        """What the last frame shows, and its stamp."""
        seconds, nanoseconds = divmod(self._scene_clock.last or 0, 1_000_000_000)
        return f"at {self._scene_clock.elapsed * 1e-9:.6f} s of the scene, stamp {seconds}.{nanoseconds:09d}"


def main() -> int:
    return run_node(MotionPlayerNode)


if __name__ == "__main__":
    sys.exit(main())
