"""The humans, objects and cameras of a scene as they are now, and what follows a human."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping, Set
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np

from humansim_ros.errors import SceneError
from humansim_ros.geometry import (
    AROUND,
    VELOCITY_STEP,
    ObjectPose,
    Velocity,
    matrix_to_quaternion,
    quaternion_to_matrix,
    unit_vectors,
)
from humansim_ros.motion.body import Skeleton
from humansim_ros.motion.pose import WITHOUT_REACH, PoseStage
from humansim_ros.scene.core.actor import Actor
from humansim_ros.scene.core.camera import SceneCamera
from humansim_ros.scene.core.objects import SceneObject
from humansim_ros.types import Array

#: Most answers that are remembered.
_REMEMBERED = 64


class World:
    """Tells layers where humans, objects and cameras of a scene are, by name, with its present content.

    No answer depends on itself. If two people look at each other, each looks at the place of the other's eyes
    before the other head turns. If two hands meet, they meet between the arms as posed without a reach.

    It is pickled without its content, so that a human does not bring the others along. A pickled scene fills
    its world again.

    Attributes:
        people: Humans by name.
        cameras: Cameras by name.
        version: Number of changes so far.
    """

    def __init__(self) -> None:
        self.people: dict[str, Actor] = {}
        self.cameras: Mapping[str, SceneCamera] = {}
        self.version = 0
        self._object_at: Callable[[str, float], ObjectPose] | None = None
        self._answers: dict[tuple[Any, ...], Array] = {}

    def __reduce__(self) -> tuple[Any, ...]:
        return World, ()

    def fill(
        self,
        people: dict[str, Actor],
        cameras: Mapping[str, SceneCamera],
        object_at: Callable[[str, float], ObjectPose],
    ) -> None:
        """Set what it answers from. ``object_at``: returns the pose of an object at a scene time."""
        self.people, self.cameras, self._object_at = people, cameras, object_at

    def is_human(self, name: str) -> bool:
        """Whether a human has this name."""
        return name in self.people

    def joints(self, human: str, times: Array, stages: Set[PoseStage]) -> Array:
        """Frames (N, J, 4, 4) of the joints of a human at scene times (N,). The array is shared."""
        key = self.version, human, stages, times.tobytes()
        found = self._answers.pop(key, None)
        if found is None:
            found = self.human(human).joints_at(times, stages)
            found.setflags(write=False)
        self._answers[key] = found  # the last one of the dictionary is the one that was used last
        while len(self._answers) > _REMEMBERED:
            del self._answers[next(iter(self._answers))]
        return found

    def eyes(self, human: str, times: Array, turned: bool) -> Array:
        """Points (N, 3) between the eyes of a human at scene times (N,). ``turned``: whether the head is
        turned to the target that the human looks at."""
        stages = WITHOUT_REACH | {PoseStage.HEAD} if turned else WITHOUT_REACH
        return self.human(human).rays(self.joints(human, times, stages))[0]

    def skeleton(self, human: str) -> Skeleton:
        """Skeleton of a human."""
        return self.human(human).human.skeleton

    def size(self, human: str, seconds: float) -> float:
        """Factor by which keyframes scale a human at a scene time."""
        keyframes = self.human(human).keyframes
        return 1.0 if keyframes is None else float(keyframes.at(np.array([seconds])).size[0, 0])

    def object_pose(self, name: str, seconds: float) -> ObjectPose:
        """Pose of an object at a scene time."""
        if self._object_at is None:
            raise _alone(name)
        return self._object_at(name, seconds)

    def camera_position(self, name: str, times: Array) -> Array:
        """Centres (N, 3) of a camera at scene times (N,)."""
        if name not in self.cameras:
            raise _alone(name)
        camera = self.cameras[name]
        if not camera.moves:
            return np.broadcast_to(camera.whole.center, (len(times), 3))
        return np.stack([camera.pose(float(time)).position for time in times])

    def human(self, name: str) -> Actor:
        """The human with a name, as it is now."""
        if name not in self.people:
            raise _alone(name)
        return self.people[name]


def _alone(name: str) -> SceneError:
    return SceneError(f"a human without its scene does not know where {name} is: pickle the whole scene")


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


@dataclass(frozen=True, eq=False)
class InHand(Follower):
    """Follows the left palm, or the right one, of a human, which may reach for something.

    The axes are those of :func:`path_frames`: a thing in the hand keeps upright.

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
