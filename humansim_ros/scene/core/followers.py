"""What moves an object along with a human: its palms, or its path on the floor."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from humansim_ros.geometry import (
    AROUND,
    VELOCITY_STEP,
    ObjectPose,
    Velocity,
    matrix_to_quaternion,
    quaternion_to_matrix,
    unit_vectors,
)
from humansim_ros.scene.core.actor import Actor
from humansim_ros.scene.core.objects import SceneObject
from humansim_ros.scene.core.world import World
from humansim_ros.types import Array

#: Most poses that are kept.
_KNOWN = 10_000
#: Seconds around a time over which a path is smoothed, which three strides fill.
_SMOOTHED = np.linspace(-1.5, 1.5, 31)
_UP = np.array([0.0, 0.0, 1.0])


def _smoothing() -> Array:
    """Weights (31,): they keep a path of constant acceleration, and little of strides of a second."""
    bell = 1 + np.cos(np.pi * _SMOOTHED / _SMOOTHED[-1])
    moments = [(bell * _SMOOTHED**power).sum() for power in (0, 2, 4)]
    a, b = np.linalg.solve([moments[:2], moments[1:]], [1.0, 0.0])
    return np.asarray(bell * (a + b * _SMOOTHED**2))


@dataclass(frozen=True, eq=False)
class Follower(ABC):
    """Moves an object along with a human.

    Attributes:
        world: Knows the human by name.
        human: Name of the human.
        own: Pose of the object in the frame that follows the human.
    """

    world: World
    human: str
    own: ObjectPose

    def __call__(self, seconds: float) -> ObjectPose:
        """Pose and velocity at a scene time in seconds."""
        key = self.world.version, seconds
        if key not in self._known:
            if len(self._known) >= _KNOWN:
                self._known.clear()
            self._known[key] = self._at(seconds)
        return self._known[key]

    @cached_property
    def _known(self) -> dict[tuple[int, float], ObjectPose]:
        """Poses by version of the motions and scene time: humans that reach for the object ask again."""
        return {}

    @property
    def actor(self) -> Actor:
        """The human as it is now."""
        return self.world.human(self.human)

    def _at(self, seconds: float) -> ObjectPose:
        times = seconds + AROUND
        positions, rotations = self.frames(times)
        turn = quaternion_to_matrix(self.own.rotation)
        places = positions + rotations @ self.own.position
        quaternions = matrix_to_quaternion(rotations @ turn)
        velocity = Velocity.between(places, quaternions, 2 * VELOCITY_STEP)
        return ObjectPose(places[1], quaternions[1], self.own.size, velocity)

    @abstractmethod
    def frames(self, times: Array) -> tuple[Array, Array]:
        """Origins (N, 3) and axes (N, 3, 3) of the frame in ``map`` at scene times (N,)."""

    def in_world(self, world: World) -> Follower:
        """The same for the human of another world."""
        return replace(self, world=world)


class OnPath(Follower):
    """Follows the path of a human on the floor: x ahead, y left, z up, without the sway of steps."""

    def frames(self, times: Array) -> tuple[Array, Array]:
        """Points of the floor below the hips, and axes."""
        return path_frames(self.actor, times)


@dataclass(frozen=True, eq=False)
class InHand(Follower):
    """Follows the left palm, or the right one, of a human, which may reach for something.

    The axes are those of :class:`OnPath`: a thing in the hand keeps upright.

    Attributes:
        side: ``left`` or ``right``.
    """

    side: str = "right"

    def frames(self, times: Array) -> tuple[Array, Array]:
        """Palms, and axes."""
        return self.actor.palms_at(self.side, times), path_frames(self.actor, times)[1]


def path_frames(
    actor: Actor, times: Array, clamped: Callable[[Array], Array] = np.asarray
) -> tuple[Array, Array]:
    """Points (N, 3) of the floor below the hips of a human at scene times (N,), and axes (N, 3, 3).

    Both are smoothed over three strides: x ahead, y left, z up. ``clamped``: changes the times (M,) at which
    the path is sampled.
    """
    weights = _smoothing()
    around = clamped(np.add.outer(times, _SMOOTHED).ravel())
    middle, left = (
        np.einsum("w,nwd->nd", weights, each.reshape(len(times), len(weights), 3)) * (1.0, 1.0, 0.0)
        for each in actor.hips_at(around)
    )
    y, z = unit_vectors(left), np.broadcast_to(_UP, left.shape)
    return middle, np.stack([np.cross(y, z), y, z], axis=-1)


def followed(item: SceneObject, world: World) -> SceneObject:
    """An object that follows the human of another world, if it follows one. It keeps its size and place."""
    mover = item.pose_at
    return replace(item, pose_at=mover.in_world(world)) if isinstance(mover, Follower) else item
