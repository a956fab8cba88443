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


class Carrier(Protocol):
    """A thing that carries cameras and scanners, such as the robot."""

    @property
    def base_frame(self) -> str:
        """Name of the frame in which it carries them."""

    def body_at(self, seconds: float, base: ObjectPose | None = None) -> ObjectPose:
        """Pose and velocity of its body at a scene time. ``base``: where ``base_link`` is, if it is known."""


def robot_of_mount(mount: str | None, robot: Carrier | None) -> Carrier | None:
    """The robot that carries a thing with a key ``mount``; None without the key.

    ``robot``: the robot of the scene. Raises SceneError of this key if it has none.
    """
    if mount is None:
        return None
    if robot is None:
        raise SceneError("the scene has no robot: give it a section 'robot'", key="mount")
    return robot
