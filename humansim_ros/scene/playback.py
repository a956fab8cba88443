"""A scene that is played: a clock that can stand, jump and go faster, and motions that can be changed."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

from pydantic import ValidationError

from humansim_ros.errors import MotionError
from humansim_ros.motion.world import JointPoses
from humansim_ros.scene.config import MotionConfig
from humansim_ros.scene.scene import Actor, Scene

#: What of a motion is about its file, and is found anew for another.
_OF_THE_FILE = ("joint_names", "unit", "up", "facing", "positions", "start", "end")
#: Changes that leave the motion where it is; after others it starts again.
_KEEPING_PLACE = {"speed", "mirror"}


class Clock:
    """Seconds of the scene by stamps in nanoseconds: they go on at ``speed``, stand while paused, jump."""

    def __init__(self, speed: float = 1.0, seconds: float = 0.0) -> None:
        self.speed = speed
        self.paused = False
        self._stamp: int | None = None
        self._seconds = seconds

    def at(self, stamp: int) -> float:
        """Seconds at a stamp; the first stamp asked for is the start."""
        if self._stamp is None:
            self._stamp = stamp
        return self._seconds + (0.0 if self.paused else (stamp - self._stamp) * 1e-9 * self.speed)

    @property
    def pace(self) -> float:
        """Seconds of the scene per second: 0 while it stands."""
        return 0.0 if self.paused else self.speed

    def pause(self, paused: bool, stamp: int) -> None:
        """Stand at what the stamp shows, or go on from there."""
        self.seek(self.at(stamp), stamp)
        self.paused = paused

    def set_speed(self, speed: float, stamp: int) -> None:
        """Go on at another speed, without a jump."""
        self.seek(self.at(stamp), stamp)
        self.speed = speed

    def seek(self, seconds: float, stamp: int) -> None:
        """Jump, so that the stamp shows these seconds."""
        self._seconds, self._stamp = seconds, stamp


class Playback:
    """The humans of a scene on one clock. Raises HumansimError, and goes on as before, where a change cannot
    be made.
    """

    def __init__(self, scene: Scene) -> None:
        self.scene = scene
        self.clock = Clock()
        self.actors: dict[str, Actor] = dict(scene.actors)
        self.configs: dict[str, MotionConfig] = {
            name: scene.config.humans[name].motion for name in scene.actors
        }

    def poses(self, stamp: int) -> dict[str, JointPoses]:
        """The motion of every human at a stamp, with velocities per second of the wall."""
        seconds, pace = self.clock.at(stamp), self.clock.pace
        return {name: _paced(actor.joint_poses(seconds), pace) for name, actor in self.actors.items()}

    def seek(self, seconds: float, stamp: int) -> None:
        """Jump to a time of the scene, as if it had been played from its start with these motions."""
        self.clock.seek(seconds, stamp)
        for name, actor in self.actors.items():
            self.actors[name] = replace(actor, offset=self.configs[name].offset)

    def changed(self, name: str, changes: Mapping[str, Any], stamp: int) -> tuple[MotionConfig, Actor]:
        """What a human would do with another motion, or another part of it; nothing is changed yet.

        ``changes``: keys of the scene file's ``motion``. Another file is played from its start; so is
        another part, and another way to loop.
        """
        old = self.configs[name]
        values = old.model_dump()
        if changes.get("file", old.file) != old.file:
            fresh = MotionConfig()
            values.update({key: getattr(fresh, key) for key in _OF_THE_FILE})
        try:
            config = MotionConfig.model_validate({**values, **changes})
        except ValidationError as reason:
            first = reason.errors()[0]
            message = first["msg"].removeprefix("Value error, ")
            raise MotionError(message, key=".".join(map(str, first["loc"]))) from None
        before = self.actors[name]
        actor = before.with_motion(config, self.scene.path)
        seconds = self.clock.at(stamp)
        if config == old and "file" not in changes:
            return config, before
        different = {key for key in changes if key == "file" or getattr(config, key) != getattr(old, key)}
        if different <= _KEEPING_PLACE:
            # the same second of the file, at whatever speed
            ahead = (seconds + before.offset) * before.motion.speed
            offset = ahead / actor.motion.speed - seconds if actor.motion.speed else before.offset
        else:
            offset = config.offset - seconds
        return config, replace(actor, offset=offset)

    def change(self, name: str, changed: tuple[MotionConfig, Actor]) -> None:
        """Make a change that :meth:`changed` has prepared."""
        self.configs[name], self.actors[name] = changed


def _paced(poses: JointPoses, pace: float) -> JointPoses:
    if pace == 1 or poses.linear is None or poses.angular is None:
        return poses
    return replace(poses, linear=poses.linear * pace, angular=poses.angular * pace)
