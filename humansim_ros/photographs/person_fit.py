"""The result of fitting: proportions and poses of a person in photographs."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from humansim_ros.humans.human import Human
from humansim_ros.photographs.body_shape import shaped_human
from humansim_ros.photographs.proportions import Proportions, with_proportions
from humansim_ros.types import Array, Float32Array


@dataclass(frozen=True, eq=False)
class PersonFit:
    """A person fitted to F frames of V photographs.

    Attributes:
        human: Built-in human, or file, that has these proportions.
        proportions: Proportions of the person.
        bones: Names of the B bones.
        root: (F, 4, 4) rigid transforms from body space to ``map``.
        rotations: (F, B, 4) quaternions xyzw of the bones, as :meth:`~humansim_ros.body.Skeleton.pose` takes
            them. That of the first bone is the identity: ``root`` has its rotation.
        period: Nanoseconds between frames.
        keypoints: Name of the set of the points.
        views: Names of the V views.
        residuals: (F, V, K) pixels between the given and the fitted points; NaN where there is none.
        outliers: (F, V, K) the given point is wrong and was left out.
        swapped: (F, V) left and right of the points were exchanged.
    """

    human: str
    proportions: Proportions
    bones: tuple[str, ...]
    root: Array
    rotations: Array
    period: int
    keypoints: str
    views: tuple[str, ...]
    residuals: Array
    outliers: NDArray[np.bool_]
    swapped: NDArray[np.bool_]

    def __repr__(self) -> str:
        return f"PersonFit({self.human!r}, {len(self.root)} frames, {len(self.views)} views)"

    @cached_property
    def body(self) -> Human:
        """The human in the proportions of the person. Raises MeshError if it cannot be loaded."""
        return with_proportions(shaped_human(self.human, self.proportions.shape), self.proportions)

    def posed(self, frame: int = 0) -> Array:
        """Frames of the bones (B, 4, 4) in ``map``."""
        return self.body.skeleton.pose(self.rotations[frame], self.root[frame])

    def joints(self, frame: int = 0) -> Array:
        """Positions (J, 3) of the joints in ``map``, in the order of the joints of the skeleton."""
        return np.array(self.body.skeleton.joint_transforms(self.posed(frame))[:, :3, 3])

    def vertices(self, frame: int = 0) -> Float32Array:
        """Positions (V, 3) of the vertices in ``map``."""
        return self.body.pose(self.posed(frame))
