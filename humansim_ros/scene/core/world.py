"""The humans, objects and cameras of a scene as they are now, for those who ask for others by name."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Set
from typing import Any

import numpy as np

from humansim_ros.errors import SceneError
from humansim_ros.geometry import ObjectPose
from humansim_ros.motion.body import Skeleton
from humansim_ros.motion.pose import WITHOUT_REACH, PoseStage
from humansim_ros.scene.core.actor import Actor
from humansim_ros.scene.core.camera import SceneCamera
from humansim_ros.types import Array

#: Most answers that are remembered.
_REMEMBERED = 64


class World:
    """Answers a :class:`~humansim_ros.motion.pose.reaches.SceneQuery`.

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
        """Frames (N, J, 4, 4) of the joints of a human at scene times (N,)."""
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
        """Points (N, 3) between the eyes of a human at scene times (N,)."""
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
