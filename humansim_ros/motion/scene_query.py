"""What a motion may ask of the others in its scene: by name, at any times, up to a stage of their poses."""

from __future__ import annotations

from collections.abc import Set
from enum import IntEnum
from typing import Protocol

from humansim_ros.body.skeleton import Skeleton
from humansim_ros.geometry import ObjectPose
from humansim_ros.types import Array


class PoseStage(IntEnum):
    """Steps in which the pose of a human is made, in their order (docs/data_model.md)."""

    MOTION, FLOOR, ARMS, SPACE, FINGERS, HEAD, EYES, FACE, CLOTH = range(9)


#: Stages of joints without the rotations of fingers, head and eyes.
BODY = frozenset({PoseStage.MOTION, PoseStage.FLOOR, PoseStage.ARMS, PoseStage.SPACE})
#: The same with the arms as the motion has them.
WITHOUT_REACH = BODY - {PoseStage.ARMS}


class SceneQuery(Protocol):
    """Humans, objects and cameras of a scene by name, as they are now.

    No answer depends on itself: a head turns to eyes before their head turns, and hands that meet do so
    between two arms without reach.
    """

    @property
    def version(self) -> int:
        """Number of changes so far: answers from before the last change are out of date."""

    def is_human(self, name: str) -> bool:
        """Whether a human has this name."""

    def joints(self, human: str, times: Array, stages: Set[PoseStage]) -> Array:
        """Frames (N, J, 4, 4) of the joints of a human at scene times (N,). The array is shared."""

    def eyes(self, human: str, times: Array, turned: bool) -> Array:
        """Points (N, 3) between the eyes of a human at scene times (N,).

        ``turned``: with the turn of the head to what the human looks at.
        """

    def skeleton(self, human: str) -> Skeleton:
        """Skeleton of a human."""

    def size(self, human: str, seconds: float) -> float:
        """Factor by which keyframes scale a human at a scene time."""

    def object_pose(self, name: str, seconds: float) -> ObjectPose:
        """Pose of an object, static or moving, at a scene time."""

    def camera_position(self, name: str, times: Array) -> Array:
        """Centres (N, 3) of a camera at scene times (N,)."""
