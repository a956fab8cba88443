"""What moves cameras and scanners: a trajectory, or something that carries them."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np

from humansim_ros.cameras.camera import Trajectory
from humansim_ros.errors import SceneError, in_section
from humansim_ros.geometry import VELOCITY_STEP, ObjectPose, Velocity
from humansim_ros.scene.config.camera_config import TrajectoryConfig
from humansim_ros.scene.core.source import SceneSource
from humansim_ros.scene.features.robot.keys import RobotConfig


@dataclass(frozen=True, eq=False)
class Route:
    """A trajectory that something follows.

    Attributes:
        path: The trajectory.
        offset: Time that it is ahead of the scene, seconds.
        speed: Seconds of the trajectory per second.
    """

    path: Trajectory
    offset: float = 0.0
    speed: float = 1.0

    @classmethod
    def read(cls, config: TrajectoryConfig, source: SceneSource) -> Route:
        """Read the file of a section. Raises HumansimError, which names the key, relative to the section."""
        with in_section("file"):
            path = Trajectory.read(source.find_url(config.file), config.end)
        return cls(path, config.offset, config.speed)

    @property
    def duration(self) -> float:
        """Seconds until its end; 0 if it stands."""
        return self.path.duration / self.speed if self.speed else 0.0

    def at(self, seconds: float) -> ObjectPose:
        """Pose and velocity at a scene time in seconds."""
        time = self.speed * (seconds + self.offset)
        early, late = self.path.difference_times(time, VELOCITY_STEP * max(self.speed, 1e-6))
        positions, rotations = zip(self.path.in_map(early), self.path.in_map(late), strict=True)
        velocity = Velocity.between(np.array(positions), np.array(rotations), late - early)
        return ObjectPose(*self.path.in_map(time), velocity=velocity.scaled(self.speed))


class Drive(Protocol):
    """What moves a carrier that follows commands. The same commands give the same way."""

    def at(self, seconds: float) -> ObjectPose:
        """Pose and velocity of ``base_link`` at a scene time in seconds."""

    def command(self, seconds: float, speed: float, turn: float) -> None:
        """Drive from a scene time on: metres per second, and radians per second to the left."""

    def place(self, seconds: float, x: float, y: float, yaw: float) -> None:
        """Stand somewhere else from a scene time on.

        Args:
            seconds: The scene time.
            x: Metres in ``map``.
            y: Metres in ``map``.
            yaw: Heading in radians from +x to the left.
        """

    def reset(self) -> None:
        """Forget all commands: it stands at its start."""


class Carrier(Protocol):
    """A thing that carries cameras and scanners: the robot."""

    @property
    def config(self) -> RobotConfig:
        """Its settings."""

    @property
    def route(self) -> Route | None:
        """Its way, if the way is the same in each run."""

    @property
    def base_frame(self) -> str:
        """Name of the frame ``base_link`` in messages."""

    @property
    def takes_commands(self) -> bool:
        """Whether it follows ``cmd_vel``."""

    @property
    def start(self) -> ObjectPose:
        """Pose of ``base_link`` at the start of the scene."""

    def base_at(self, seconds: float) -> ObjectPose:
        """Pose and velocity of ``base_link`` at a scene time."""

    def body_at(self, seconds: float, base: ObjectPose | None = None) -> ObjectPose:
        """Pose and velocity of its body at a scene time. ``base``: where ``base_link`` is, if it is known."""

    def base_of(self, body: ObjectPose, seconds: float) -> ObjectPose:
        """Pose of ``base_link`` at a scene time from the pose of its body, without velocity."""

    def drive(self) -> Drive | None:
        """What moves it by commands; None if it takes none."""


def robot_of_mount(mount: str | None, robot: Carrier | None) -> Carrier | None:
    """The robot that carries a thing with a key ``mount``; None without the key.

    ``robot``: the robot of the scene. Raises SceneError of this key if it has none.
    """
    if mount is None:
        return None
    if robot is None:
        raise SceneError("the scene has no robot: give it a section 'robot'", key="mount")
    return robot
