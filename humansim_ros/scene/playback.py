"""A scene that is played: when its frames leave, which time of it they show, and motions that can be changed.

Without ROS: the motion player and ``Simulation`` show the same frames because both ask :class:`Playback`.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from pydantic import ValidationError

from humansim_ros.errors import MotionError, in_section
from humansim_ros.motion.joint_poses import JointPoses, Velocity
from humansim_ros.motion.world_motion import WorldMotion
from humansim_ros.scene.actor import Actor
from humansim_ros.scene.camera import CameraPose
from humansim_ros.scene.config import MotionConfig
from humansim_ros.scene.objects import ObjectPose
from humansim_ros.scene.scene import Scene

#: What is said of a motion's file, and does not hold for another.
_OF_THE_FILE = ("joint_names", "unit", "up", "facing", "positions", "start", "end")
#: Changes after which a motion begins at its start; after others it goes on from where it is.
_BEGINNING = {"file", "start", "end", "offset"}
#: Changes after which the place in the round counts, not how many rounds there were.
_OF_THE_ROUND = {"loop", "blend"}
#: Nanoseconds before its time, but at most a tenth of a period, from which on a frame is due.
_EARLY = 5_000_000
#: Nanoseconds back that mean that the wall clock was set anew.
_SET_BACK = 1_000_000_000


@dataclass(frozen=True)
class Tick:
    """A frame: its ``stamp`` and the time of the scene it shows, ``elapsed`` (nanoseconds).

    ``pace``: seconds of the scene per second, 0 while paused. ``dropped``: frames left out before it.
    """

    stamp: int
    elapsed: int
    pace: float
    dropped: int = 0


class PlaybackClock:
    """When frames leave, in nanoseconds of a wall clock, and which time of the scene each shows.

    Frame k leaves at start + round(k * period); a new start is made by :meth:`cut`. Stamps always rise, but
    where the wall clock itself is set back. The scene's time follows the stamps at ``speed``, stands while
    paused, and never jumps but by :meth:`seek`.
    """

    def __init__(self, rate: float, speed: float = 1.0, seconds: float = 0.0) -> None:
        self.period = 1e9 / rate
        self.speed = speed
        self.paused = False
        self.elapsed = round(seconds * 1e9)
        self.last: int | None = None
        self._start = self._next = 0
        # from which stamp (None: the next frame's) and time of the scene on it runs, or is stepped
        self._base: tuple[int | None, int] = (None, self.elapsed)
        self._steps = 0

    def due(self, now: int) -> Tick | None:
        """The newest frame that is due, or None: timers may come a moment early."""
        if now <= 0:
            return None  # simulated time has not begun: zero is never a stamp
        if self.last is None or now < self.last - _SET_BACK:
            return self.cut(now)
        frame = int((now - self._start + min(0.1 * self.period, _EARLY)) / self.period)
        if frame < self._next:
            return None
        dropped, self._next = frame - self._next, frame + 1
        return self._tick(self._start + round(frame * self.period), dropped)

    def cut(self, now: int) -> Tick:
        """A frame at once, from which the next ones are counted."""
        stamp = now
        if self.last is not None and now >= self.last - _SET_BACK:
            stamp = max(now, self.last + 1)
        elif self.last is not None:
            self._base, self._steps = (None, self.elapsed), 0
        self._start, self._next = stamp, 1
        return self._tick(stamp)

    def set_rate(self, rate: float, now: int) -> Tick:
        """So many frames a second from now on."""
        self._rebase()
        self.period = 1e9 / rate
        return self.cut(now)

    def set_speed(self, speed: float) -> None:
        """So many seconds of the scene a second after the last frame."""
        self._rebase()
        self.speed = speed

    def pause(self, paused: bool) -> None:
        """Stay at what the last frame shows, or go on from there."""
        self._rebase()
        self.paused = paused

    def step(self, now: int) -> Tick:
        """While paused: show at once what the next frame would."""
        self._steps += 1
        self.elapsed = self._base[1] + round(self._steps * self.period * (self.speed or 1.0))
        return self.cut(now)

    def seek(self, seconds: float, now: int) -> Tick:
        """Show a time of the scene at once, and go on from there."""
        self.elapsed = round(seconds * 1e9)
        self._base, self._steps = (None, self.elapsed), 0
        return self.cut(now)

    def _rebase(self) -> None:
        self._base, self._steps = (self.last, self.elapsed), 0

    def _tick(self, stamp: int, dropped: int = 0) -> Tick:
        since, elapsed = self._base
        if since is None:
            self._base = (stamp, elapsed)
        elif not self.paused:
            self.elapsed = elapsed + round((stamp - since) * self.speed)
        self.last = stamp
        return Tick(stamp, self.elapsed, 0.0 if self.paused else self.speed, dropped)


@dataclass(frozen=True)
class ScenePoses:
    """What moves at one time of the scene: the joints of each human's motion (N = 1), and the places of
    objects and of cameras with a trajectory.
    """

    poses: dict[str, JointPoses]
    objects: dict[str, ObjectPose]
    cameras: dict[str, CameraPose]


@dataclass(frozen=True)
class Change:
    """Another motion for one human, read and understood, that :meth:`Playback.make` starts.

    ``begins``: at its start; else it goes on from where the old one is. ``in_round``: but in its first round.
    """

    name: str
    settings: MotionConfig
    actor: Actor
    begins: bool
    in_round: bool


class Playback:
    """The humans and objects of a scene at any time of it, with motions that can be changed meanwhile.

    ``settings``: what each human does now, as a scene file would say it. ``actors``: the humans doing it.
    ``elapsed``: time of the scene that was shown last (nanoseconds); changes hold from there on.
    """

    def __init__(self, scene: Scene) -> None:
        self.scene = scene
        self.actors: dict[str, Actor] = dict(scene.actors)
        self.settings: dict[str, MotionConfig] = {
            name: scene.config.humans[name].motion for name in scene.actors
        }
        self.elapsed = 0

    def show(self, elapsed: int, pace: float = 1.0) -> ScenePoses:
        """What moves at ``elapsed`` nanoseconds of the scene; velocities are per second of the wall, on which
        ``pace`` seconds of the scene pass.
        """
        self.elapsed = elapsed
        seconds = elapsed * 1e-9
        poses = {name: _paced(actor.joint_poses(seconds), pace) for name, actor in self.actors.items()}
        objects = {name: thing.at(seconds) for name, thing in self.scene.moving_objects.items()}
        objects = {name: replace(place, velocity=_velocity(place, pace)) for name, place in objects.items()}
        cameras = {name: camera.pose(seconds) for name, camera in self.scene.moving_cameras.items()}
        cameras = {name: replace(pose, velocity=_velocity(pose, pace)) for name, pose in cameras.items()}
        return ScenePoses(poses, objects, cameras)

    def change(self, name: str, **settings: Any) -> None:
        """Let a human do something else after what was shown last: keys of a scene file's ``motion``.

        Raises HumansimError, and changes nothing, where that cannot be played.
        """
        self.make(self.prepare(name, settings))

    def prepare(self, name: str, settings: Mapping[str, Any]) -> Change:
        """The slow part of a change: files are read, and nothing is changed yet. Raises HumansimError.

        ``file`` reads it, even the same again; otherwise it may have vanished since. What was said of the old
        file (joint table, unit, start, end …) does not hold for another; for the scene's own, what the scene
        says of it does.
        """
        with in_section(f"humans.{name}.motion"):
            return self._prepare(name, settings)

    def _prepare(self, name: str, settings: Mapping[str, Any]) -> Change:
        old, before = self.settings[name], self.actors[name]
        new = _with(old, settings, self.scene.config.humans[name].motion)
        different = {key for key in MotionConfig.model_fields if getattr(new, key) != getattr(old, key)}
        different |= {"file"} & set(settings)
        if different <= {"speed"}:
            actor = replace(before, motion=replace(before.motion, speed=new.speed))
        else:
            read_again = different & {"file", "positions"}
            actor = before.with_motion(new, self.scene.source, None if read_again else before.motion.motion)
        actor.motion.sample(0.0)  # what is worked out for all frames at once is worked out now
        return Change(name, new, actor, bool(different & _BEGINNING), bool(different & _OF_THE_ROUND))

    def make(self, change: Change) -> None:
        """Start what was prepared."""
        old, actor = self.actors[change.name], change.actor
        seconds = self.elapsed * 1e-9
        at = 0.0
        if not change.begins:
            at = float(old.motion.file_times(seconds + old.offset, old.ahead)[0])
            at = _in_round(old.motion, at) if change.in_round else at
        ahead = at - actor.motion.speed * (seconds + actor.offset)
        self.actors[change.name] = replace(actor, ahead=ahead)
        self.settings[change.name] = change.settings

    def rewind(self) -> None:
        """From now on every time shows what it would if all had done from the start what they do now."""
        for name, actor in self.actors.items():
            self.actors[name] = replace(actor, ahead=0.0)


def _with(old: MotionConfig, changes: Mapping[str, Any], of_scene: MotionConfig) -> MotionConfig:
    """Settings with some changed. Raises MotionError naming a key that is wrong."""
    values = old.model_dump()
    file = changes.get("file", old.file)
    if file != old.file:
        known = of_scene if file == of_scene.file else MotionConfig()
        values.update({key: getattr(known, key) for key in _OF_THE_FILE})
    try:
        return MotionConfig.model_validate({**values, **changes})
    except ValidationError as reason:
        first = reason.errors()[0]
        message = first["msg"].removeprefix("Value error, ")
        raise MotionError(message, key=".".join(map(str, first["loc"]))) from None


def _in_round(motion: WorldMotion, played: float) -> float:
    """Seconds since the start of the round that a motion is in."""
    length = motion.cycle_length
    if motion.loop == "none" or length <= 0:
        return float(np.clip(played, 0.0, length))
    return float(played % length)


def _velocity(pose: ObjectPose | CameraPose, pace: float) -> Velocity | None:
    return None if pose.velocity is None else pose.velocity.scaled(pace)


def _paced(poses: JointPoses, pace: float) -> JointPoses:
    if pace == 1 or poses.linear is None or poses.angular is None:
        return poses
    return replace(poses, linear=poses.linear * pace, angular=poses.angular * pace)
