"""Node ``motion_player``: plays the motions of a scene's humans, all from one clock.

Publishes ``humans/<id>/motion``, latched ``humans/<id>/motion/legend``, and ``objects/<name>/marker`` of
every object that moves. Frame k leaves at start + round(k * period) on the wall clock and carries that stamp;
a player that is late skips to the newest frame and reports the drop.

Parameters can be set while it plays, services ``~/pause``, ``~/step`` and ``~/restart`` steer it
(docs/playing.md). What cannot be played is refused with the reason, and the old motion goes on.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

from rcl_interfaces.msg import FloatingPointRange, ParameterDescriptor, SetParametersResult
from rclpy.parameter import Parameter
from sensor_msgs.msg import MultiDOFJointState
from std_msgs.msg import String
from std_srvs.srv import SetBool, Trigger
from visualization_msgs.msg import Marker

from humansim_ros.errors import HumansimError
from humansim_ros.ros.messages import motion_legend, motion_message, object_message
from humansim_ros.ros.node import SceneNode
from humansim_ros.ros.qos import DATA, LATCHED
from humansim_ros.ros.runtime import run_node
from humansim_ros.scene.config import MotionConfig
from humansim_ros.scene.live import Source
from humansim_ros.scene.playback import Clock, Playback

_LOOPS = "none, repeat or continue"
#: Parameter of a human's motion: its key in the scene file, and what it is.
_OF_MOTIONS = {
    "motion": ("file", "a motion that comes with the package, or a BVH file"),
    "loop": ("loop", f"what follows the last frame: {_LOOPS}"),
    "start": ("start", "where in the file it starts, seconds of the file"),
    "end": ("end", "where in the file it ends, seconds of the file; 0: at its end"),
    "mirror": ("mirror", "left and right change sides"),
}
_LONGEST = 1e6


class MotionPlayer(SceneNode):
    """Publishes where the joints of every motion are, frame by frame."""

    def __init__(self, **options: Any) -> None:
        super().__init__("motion_player", **options)
        self._playback = Playback(self.scene)
        self._last = 0
        self._ticking: Any = None
        rate = self._steered("rate", 0.0, 0.0, 1000.0, "Frames per second; 0 for the scene's own rate")
        speed = self._steered("speed", 1.0, 0.0, 10.0, "Seconds of the scene per second")
        seek = self._steered("seek", 0.0, 0.0, _LONGEST, "Set to jump to this second of the scene")
        self._declare_motions()
        self._playback.clock = Clock(speed, seek)
        self._motions = {
            name: self.create_publisher(MultiDOFJointState, f"humans/{name}/motion", DATA)
            for name in self.scene.actors
        }
        self._markers = {
            name: self.create_publisher(Marker, f"objects/{name}/marker", DATA)
            for name in self.scene.moving_objects
        }
        self._legends = {
            name: self.create_publisher(String, f"humans/{name}/motion/legend", LATCHED)
            for name in self.scene.actors
        }
        self._set_rate(rate)
        for name in self.scene.actors:
            self._publish_legend(name)
        self.add_pre_set_parameters_callback(self._for_every_human)
        self.add_on_set_parameters_callback(self._on_parameters)
        self.create_service(SetBool, "~/pause", self._on_pause)
        self.create_service(Trigger, "~/step", self._on_step)
        self.create_service(Trigger, "~/restart", self._on_restart)
        self.get_logger().info(
            f"playing {len(self._motions)} motions at {1e9 / self._period:g} Hz from {self.scene.path}"
        )

    # --- frames

    def _set_rate(self, rate: float) -> None:
        """Count frames anew from now, so many a second."""
        self._period = 1e9 / (rate or self.scene.config.rate)
        self._start: int | None = None
        self._next = 0
        if self._ticking is not None:
            self.destroy_timer(self._ticking)
        self._ticking = self.create_timer(self._period * 1e-9, self._tick)

    def _tick(self) -> None:
        now = self.now()
        if self._start is None:
            self._start = max(now, round(self._last + self._period) if self._last else 0)
        # the timer may come a moment early: a frame is due from a tenth of a period before its time
        due = int((now - self._start) / self._period + 0.1)
        if due < self._next or now < self._start - 0.1 * self._period:
            return
        self.count("drops", due - self._next)
        self._send(due)

    def _send(self, frame: int) -> None:
        """Frame ``frame`` since the rate was set."""
        if self._start is None:
            self._start = self.now()
        self._next = frame + 1
        self._publish(self._start + round(frame * self._period))

    @property
    def _shown(self) -> int:
        """Stamp of what is shown: the last frame's."""
        return self._last or self.now()

    def _publish(self, stamp: int) -> None:
        """One frame: everything that moves, at one stamp."""
        self._last = stamp
        for name, poses in self._playback.poses(stamp).items():
            self._motions[name].publish(motion_message(poses, stamp))
        seconds = self._playback.clock.at(stamp)
        for name, thing in self.scene.moving_objects.items():
            self._markers[name].publish(object_message(thing, thing.at(seconds), stamp))
        self.count("frames")
        self.report_lateness(stamp)

    def _publish_legend(self, name: str) -> None:
        self._legends[name].publish(motion_legend(Source.of_actor(self._playback.actors[name])))

    # --- parameters

    def _steered(self, name: str, default: float, low: float, high: float, description: str) -> float:
        """Declare a number that can be set while the node runs."""
        descriptor = ParameterDescriptor(description=description)
        descriptor.floating_point_range = [FloatingPointRange(from_value=low, to_value=high, step=0.0)]
        return float(self.declare_parameter(name, default, descriptor).value)

    def _declare_motions(self) -> None:
        """Parameters of each human's motion, and of all: these are the first human's until they are set."""
        configs = self._playback.configs
        for field_owner in ("", *configs) if configs else ():
            names = [field_owner] if field_owner else list(configs)
            whose = field_owner or "all humans (until it is set, the first one's)"
            prefix = f"{field_owner}." if field_owner else ""
            changes: dict[str, Any] = {}
            for key, (field, description) in _OF_MOTIONS.items():
                value = _parameter_value(configs[names[0]], field)
                described = f"Of {whose}: {description}"
                if isinstance(value, float):
                    given: Any = self._steered(prefix + key, value, 0.0, _LONGEST, described)
                else:
                    descriptor = ParameterDescriptor(description=described)
                    given = self.declare_parameter(prefix + key, value, descriptor).value
                if given != value:
                    changes[field] = _config_value(field, given)
            if field_owner:
                speed = configs[field_owner].speed
                described = f"Of {whose}: seconds of the file per second of the scene"
                given = self._steered(f"{prefix}speed", speed, 0.0, 100.0, described)
                if given != speed:
                    changes["speed"] = given
            for name in names if changes else ():
                config, actor = self._playback.changed(name, changes, 0)
                self._playback.change(name, (config, replace(actor, offset=config.offset)))

    def _for_every_human(self, parameters: Sequence[Parameter]) -> list[Parameter]:
        """What is set of all humans is set of each; with another file, the part that plays is all of it."""
        given = {parameter.name for parameter in parameters}
        out = list(parameters)
        for parameter in parameters:
            if parameter.name in _OF_MOTIONS:
                out += [
                    Parameter(f"{name}.{parameter.name}", parameter.type_, parameter.value)
                    for name in self._playback.actors
                    if f"{name}.{parameter.name}" not in given
                ]
        named = {parameter.name for parameter in out}
        for parameter in list(out):
            owner, _, key = parameter.name.rpartition(".")
            if key == "motion" and self.has_parameter(parameter.name):
                prefix = f"{owner}." if owner else ""
                out += [
                    Parameter(prefix + part, Parameter.Type.DOUBLE, 0.0)
                    for part in ("start", "end")
                    if prefix + part not in named
                ]
        return out

    def _on_parameters(self, parameters: Sequence[Parameter]) -> SetParametersResult:
        """Everything is prepared before anything is changed: what is refused leaves all as it was."""
        stamp = self._shown
        changes: dict[str, dict[str, Any]] = {}
        for parameter in parameters:
            owner, _, key = parameter.name.rpartition(".")
            if owner in self._playback.actors and (key in _OF_MOTIONS or key == "speed"):
                field = _OF_MOTIONS[key][0] if key in _OF_MOTIONS else key
                changes.setdefault(owner, {})[field] = _config_value(field, parameter.value)
        try:
            ready = {
                name: self._playback.changed(name, fields, stamp)
                for name, fields in changes.items()
                if self._differs(name, fields)
            }
        except HumansimError as error:
            self.get_logger().error(f"the motion stays as it is: {error}")
            return SetParametersResult(successful=False, reason=str(error))
        for name, changed in ready.items():
            self._playback.change(name, changed)
            self._publish_legend(name)
        for parameter in parameters:
            if parameter.name == "rate":
                self._set_rate(float(parameter.value))
            elif parameter.name == "speed":
                self._playback.clock.set_speed(float(parameter.value), stamp)
            elif parameter.name == "seek":
                self._jump(float(parameter.value))
        return SetParametersResult(successful=True)

    def _differs(self, name: str, fields: dict[str, Any]) -> bool:
        """Whether any of these is not as it is. The same file is read again: it may have changed."""
        config = self._playback.configs[name]
        return "file" in fields or any(getattr(config, field) != value for field, value in fields.items())

    # --- services

    def _jump(self, seconds: float) -> None:
        """Go to a second of the scene; what stands shows it at once."""
        stamp = self._shown
        self._playback.seek(seconds, stamp)
        if self._playback.clock.paused:
            self._show_now()

    def _show_now(self) -> None:
        """A frame between the regular ones would break their rhythm: the next regular one is sent early."""
        self._send(self._next)

    def _on_pause(self, request: Any, response: Any) -> Any:
        self._playback.clock.pause(bool(request.data), self._shown)
        response.success = True
        response.message = "paused" if request.data else "playing"
        return response

    def _on_step(self, _: Any, response: Any) -> Any:
        clock = self._playback.clock
        response.success = clock.paused
        if clock.paused:
            step = self._period * 1e-9 * (clock.speed or 1.0)
            clock.seek(clock.at(self._shown) + step, self._shown)
            self._show_now()
            response.message = f"at {clock.at(self._shown):.3f} s of the scene"
        else:
            response.message = "only a paused player steps: call ~/pause first"
        return response

    def _on_restart(self, _: Any, response: Any) -> Any:
        self._jump(0.0)
        response.success, response.message = True, "from the start"
        return response


def _parameter_value(config: MotionConfig, field: str) -> Any:
    value = getattr(config, field)
    return 0.0 if value is None else value


def _config_value(field: str, value: Any) -> Any:
    return None if field == "end" and value == 0 else value


def main() -> int:
    return run_node(MotionPlayer)


if __name__ == "__main__":
    sys.exit(main())
