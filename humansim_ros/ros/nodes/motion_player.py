"""Node ``motion_player``: plays the motions of a scene's humans, all from one clock.

Publishes ``humans/<id>/motion``, latched ``humans/<id>/motion/legend``, and ``objects/<name>/marker`` of
every object that moves. Frame k leaves at start + round(k * period) on the wall clock and carries that stamp;
a player that is late skips to the newest frame and reports the drop.

Parameters can be set while it plays, services ``~/pause``, ``~/step`` and ``~/restart`` steer it
(docs/playing.md). What cannot be played is refused with the reason, and the old motion goes on.
"""

from __future__ import annotations

import sys
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor, wait
from dataclasses import dataclass, replace
from typing import Any, TypeVar

from rcl_interfaces.msg import SetParametersResult
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
from humansim_ros.scene.playback import Change, Clock, Playback, Tick

T = TypeVar("T")


@dataclass(frozen=True)
class _Setting:
    """A parameter of a human's motion: ``key`` of the scene file, type, what it is, limits."""

    key: str
    kind: Parameter.Type
    description: str
    limits: tuple[float, float] | None = None
    constraints: str = ""

    def of(self, motion: MotionConfig) -> Any:
        value = getattr(motion, self.key)
        return 0.0 if value is None else value

    def given(self, value: Any) -> Any:
        return None if self.key == "end" and value == 0 else value


_LONGEST = 1e6
_SETTINGS = {
    "motion": _Setting(
        "file",
        Parameter.Type.STRING,
        "which motion; setting it reads the file, also the same file again",
        constraints="a motion that comes with the package, or a BVH file, from the folder of the scene file",
    ),
    "loop": _Setting(
        "loop", Parameter.Type.STRING, "what follows the last frame", None, "none, repeat or continue"
    ),
    "start": _Setting(
        "start", Parameter.Type.DOUBLE, "where in the file it starts, seconds of the file", (0.0, _LONGEST)
    ),
    "end": _Setting(
        "end",
        Parameter.Type.DOUBLE,
        "where in the file it ends, seconds of the file; 0: at its end",
        (0.0, _LONGEST),
        "behind start",
    ),
    "mirror": _Setting("mirror", Parameter.Type.BOOL, "left and right change sides"),
    "speed": _Setting(
        "speed", Parameter.Type.DOUBLE, "seconds of the file per second of the scene", (0.0, 100.0)
    ),
}
#: Settings that can be given for all humans at once; ``speed`` alone is that of the clock.
_OF_ALL = [name for name in _SETTINGS if name != "speed"]


class MotionPlayer(SceneNode):
    """Publishes where the joints of every motion are, frame by frame."""

    def __init__(self, **options: Any) -> None:
        super().__init__("motion_player", **options)
        declare = self.described_parameter
        rate = declare("rate", self.scene.config.rate, "Frames per second", (0.01, 1000.0))
        speed = declare("speed", 1.0, "Seconds of the scene per second", (0.0, 10.0))
        seek = declare("seek", 0.0, "Setting it goes to this second of the scene", (0.0, _LONGEST))
        self._playback = Playback(self.scene)
        self._scene_clock = Clock(rate, speed, seek)
        self._changes: list[tuple[Change, Source]] = []
        self._declare_settings()
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
        for name, actor in self._playback.actors.items():
            self._legends[name].publish(motion_legend(Source.of_actor(actor)))
        self.add_pre_set_parameters_callback(self._complete)
        self.add_on_set_parameters_callback(self._prepare)
        self.add_post_set_parameters_callback(self._apply)
        self.create_service(SetBool, "~/pause", self._on_pause)
        self.create_service(Trigger, "~/step", self._on_step)
        self.create_service(Trigger, "~/restart", self._on_restart)
        self._ticking = self.create_timer(self._scene_clock.period * 1e-9, self._tick)
        self.get_logger().info(f"playing {len(self._motions)} motions at {rate:g} Hz from {self.scene.path}")

    # --- frames

    def _tick(self) -> None:
        tick = self._scene_clock.due(self.now())
        if tick is not None:
            self._publish(tick)

    def _publish(self, tick: Tick) -> None:
        """One frame: everything that moves, at one stamp."""
        moment = self._playback.show(tick.elapsed, tick.pace)
        for name, poses in moment.poses.items():
            self._motions[name].publish(motion_message(poses, tick.stamp))
        for name, place in moment.objects.items():
            thing = self.scene.moving_objects[name]
            self._markers[name].publish(object_message(thing, place, tick.stamp))
        self.count("drops", tick.dropped)
        self.count("frames")
        self.report_lateness(tick.stamp)

    def _publish_at_once(self, tick: Tick) -> None:
        """A frame out of turn; the timer goes on from here, as the clock does."""
        self._publish(tick)
        self._ticking.timer_period_ns = round(self._scene_clock.period)
        self._ticking.reset()

    # --- parameters

    def _declare_settings(self) -> None:
        """Parameters for all humans, and for each: what is given at the start wins over the scene file."""
        settings = self._playback.settings
        for_all = {}
        for name in _OF_ALL if settings else ():
            setting = _SETTINGS[name]
            description = f"All humans: {setting.description} (unset while they differ)"
            for_all[name] = self.described_parameter(
                name, setting.kind, description, setting.limits, setting.constraints
            )
        for human, motion in settings.items():
            changes = {}
            for name, setting in _SETTINGS.items():
                default = setting.of(motion) if for_all.get(name) is None else for_all[name]
                value = self.described_parameter(
                    f"{human}.{name}", default, setting.description, setting.limits, setting.constraints
                )
                if value != setting.of(motion):
                    changes[setting.key] = setting.given(value)
            if changes:
                self._playback.change(human, **changes)
        self._playback.rewind()
        common = self._common({})
        self.set_parameters([Parameter(name, value=value) for name, value in common.items()])

    def _common(self, values: Mapping[str, Any]) -> dict[str, Any]:
        """What all humans have in common, by parameter; ``values`` of parameters count before what they
        have.
        """
        common = {}
        for name in _OF_ALL:
            held = [
                values.get(f"{human}.{name}", _SETTINGS[name].of(motion))
                for human, motion in self._playback.settings.items()
            ]
            if held and all(value == held[0] for value in held):
                common[name] = held[0]
        return common

    def _complete(self, parameters: Sequence[Parameter]) -> list[Parameter]:
        """What else changes with parameters: each human's with that of all, and the part with the file."""
        out: dict[str, Parameter] = {}
        for parameter in parameters:
            out[parameter.name] = self._as_declared(parameter)
        for name in [name for name in out if name in _OF_ALL]:
            for human in self._playback.actors:
                same = Parameter(f"{human}.{name}", out[name].type_, out[name].value)
                out.setdefault(same.name, same)
        for human, motion in self._playback.settings.items():
            file = out.get(f"{human}.motion")
            if file is not None and file.value != motion.file:
                known = self.scene.config.humans[human].motion
                known = known if file.value == known.file else MotionConfig()
                for part in ("start", "end"):
                    value = Parameter(f"{human}.{part}", value=_SETTINGS[part].of(known))
                    out.setdefault(value.name, value)
        for name, value in self._common({name: parameter.value for name, parameter in out.items()}).items():
            if f"{name}" not in out and any(key.endswith(f".{name}") for key in out):
                out[name] = Parameter(name, _SETTINGS[name].kind, value)
        return list(out.values())

    def _as_declared(self, parameter: Parameter) -> Parameter:
        """``2`` for ``2.0``, as people type it."""
        kind = _SETTINGS[name].kind if (name := parameter.name.rpartition(".")[2]) in _SETTINGS else None
        if parameter.name in ("rate", "seek"):
            kind = Parameter.Type.DOUBLE
        if parameter.type_ == Parameter.Type.INTEGER and kind == Parameter.Type.DOUBLE:
            return Parameter(parameter.name, kind, float(parameter.value))
        return parameter

    def _prepare(self, parameters: Sequence[Parameter]) -> SetParametersResult:
        """Everything is prepared before anything is changed: what is refused leaves all as it was."""
        self._changes = []
        wanted: dict[str, dict[str, Any]] = {}
        for parameter in parameters:
            human, _, name = parameter.name.rpartition(".")
            if human not in self._playback.actors or name not in _SETTINGS:
                continue
            setting = _SETTINGS[name]
            value = setting.given(parameter.value)
            if name == "motion" or value != getattr(self._playback.settings[human], setting.key):
                wanted.setdefault(human, {})[setting.key] = value
        try:
            self._changes = self._meanwhile(lambda: [self._ready(*one) for one in wanted.items()])
        except HumansimError as error:
            self.get_logger().error(f"the motion stays as it is: {error}")
            return SetParametersResult(successful=False, reason=str(error))
        return SetParametersResult(successful=True)

    def _ready(self, human: str, settings: Mapping[str, Any]) -> tuple[Change, Source]:
        """A change, and what its legend says."""
        change = self._playback.prepare(human, settings)
        return change, Source.of_actor(change.actor)

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
            tick = self._scene_clock.set_rate(values["rate"], self.now())
            if "seek" not in values:
                self._publish_at_once(tick)
        if "seek" in values:
            self._go_to(values["seek"])

    def _go_to(self, seconds: float) -> None:
        """Show a second of the scene as if all had done from its start what they do now."""
        self._playback.rewind()
        self._publish_at_once(self._scene_clock.seek(seconds, self.now()))

    # --- services

    def _on_pause(self, request: Any, response: Any) -> Any:
        self._scene_clock.pause(bool(request.data))
        response.success = True
        response.message = f"{'paused' if request.data else 'playing'} {self._place()}"
        return response

    def _on_step(self, _: Any, response: Any) -> Any:
        response.success = self._scene_clock.paused
        if self._scene_clock.paused:
            self._publish_at_once(self._scene_clock.step(self.now()))
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
    return run_node(MotionPlayer)


if __name__ == "__main__":
    sys.exit(main())
