"""Questions that a motion may ask about other humans, objects and cameras of its scene, by name and at any
times."""

from __future__ import annotations

from collections.abc import Set
from enum import IntEnum
from typing import Protocol

from humansim_ros.geometry import ObjectPose
from humansim_ros.motion.body.skeleton import Skeleton
from humansim_ros.types import Array


class PoseStage(IntEnum):
    """Steps that make the pose of a human, in this order (docs/data_model.md)."""

    MOTION, FLOOR, ARMS, SPACE, FINGERS, HEAD, EYES, FACE, CLOTH = range(9)


#: Stages for joints without the rotations of fingers, head and eyes.
BODY = frozenset({PoseStage.MOTION, PoseStage.FLOOR, PoseStage.ARMS, PoseStage.SPACE})
#: The same stages, but with the arms of the motion: no reaches.
WITHOUT_REACH = BODY - {PoseStage.ARMS}


class SceneQuery(Protocol):
    """Tells where humans, objects and cameras of a scene are, by name, with the present content of the scene.
    No answer depends on itself. If two people look at each other, each turns to the place of the other's eyes
    before the other head turns. If two hands meet, they meet between the arms as they are without a reach."""

    @property
    def version(self) -> int:
        """Number of changes of the scene so far. Answers from before the last change are out of date."""

    def is_human(self, name: str) -> bool:
        """Whether a human has this name."""

    def joints(self, human: str, times: Array, stages: Set[PoseStage]) -> Array:
        """Frames (N, J, 4, 4) of the joints of a human at scene times (N,). The array is shared."""

    def eyes(self, human: str, times: Array, turned: bool) -> Array:
        """Points (N, 3) between the eyes of a human at scene times (N,). ``turned``: whether the head is
        turned to the target that the human looks at."""

    def skeleton(self, human: str) -> Skeleton:
        """Skeleton of a human."""

    def size(self, human: str, seconds: float) -> float:
        """Factor by which keyframes scale a human at a scene time."""

    def object_pose(self, name: str, seconds: float) -> ObjectPose:
        """Pose of an object, static or moving, at a scene time."""

    def camera_position(self, name: str, times: Array) -> Array:
        """Centres (N, 3) of a camera at scene times (N,)."""
