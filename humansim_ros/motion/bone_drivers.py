"""Bone rotations from the links and rotations of the joints that drive the bones."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from humansim_ros.body.skeleton import Skeleton
from humansim_ros.motion.joint_match import JointMatch
from humansim_ros.rotations import WORLD_FROM_BODY, from_y_axis, quaternion_to_matrix, rotate
from humansim_ros.types import Array, Indices

#: A shorter link (metres) has no direction: its bone keeps the rotation that it inherits.
SHORTEST_LINK = 1e-4


@dataclass(frozen=True)
class DrivenBones:
    """Some bones of a level of a skeleton, and their drivers.

    ``places``: their places in the level. ``bones``: their indices. ``starts``, ``ends``: joints at both ends
    of the driving links; the same joint twice where the rotation of a joint drives a bone.
    """

    places: Indices
    bones: Indices
    starts: Indices
    ends: Indices

    @classmethod
    def among(cls, bones: Indices, skeleton: Skeleton, drivers: Mapping[str, tuple[int, int]]) -> DrivenBones:
        """The bones that have drivers."""
        rows = [
            (place, bone, *drivers[skeleton.names[bone]])
            for place, bone in enumerate(bones)
            if skeleton.names[bone] in drivers
        ]
        return cls(*np.array(rows, dtype=np.intp).reshape(-1, 4).T)


@dataclass(frozen=True)
class BoneDrivers:
    """The drivers of the bones of a skeleton; ``extra``: also of bones that the general skeleton lacks."""

    skeleton: Skeleton
    match: JointMatch
    extra: bool = True

    @cached_property
    def _joints(self) -> dict[str, tuple[int, int]]:
        """Bone -> joint (twice) whose rotation drives it."""
        drivers = {**(self.match.extra if self.extra else {}), **self.match.difference}.items()
        return {bone: (joint, joint) for bone, joint in drivers if bone not in self.match.parallel}

    def _split(self, bones: Indices) -> tuple[DrivenBones, DrivenBones]:
        """Bones driven by links, and bones driven by joint rotations."""
        return (
            DrivenBones.among(bones, self.skeleton, self.match.parallel),
            DrivenBones.among(bones, self.skeleton, self._joints),
        )

    @cached_property
    def driven(self) -> tuple[DrivenBones, DrivenBones]:
        """Of all bones, those driven by links, and those driven by joint rotations."""
        return self._split(np.arange(len(self.skeleton)))

    @cached_property
    def levels(self) -> tuple[tuple[Indices, DrivenBones, DrivenBones], ...]:
        """For each level of the skeleton: its bones, those driven by links, those driven by rotations."""
        return tuple((bones, *self._split(bones)) for bones in self.skeleton.levels)

    def inherited(self, rotations: Array, bones: Indices) -> Array:
        """Rotations (N, b, 3, 3) that bones of one level inherit from their parents' rotations."""
        local = self.skeleton.rest_in_parent[bones, :3, :3]
        parents = self.skeleton.parents[bones]
        above = np.where((parents < 0)[:, None, None], WORLD_FROM_BODY, rotations[:, parents])
        return np.asarray(above @ local)

    def swing(self, positions: Array, joint_rotations: Array) -> Array:
        """Bone rotations (N, B, 3, 3) by the shortest rotation onto the links [thesis §7.2], level by level.

        ``positions``: (N, J, 3). ``joint_rotations``: (N, J, 3, 3).
        """
        skeleton = self.skeleton
        rotations = np.empty((len(positions), len(skeleton), 3, 3))
        for bones, links, joints in self.levels:
            inherited = self.inherited(rotations, bones)
            rotations[:, bones] = inherited
            if len(links.bones):
                rotations[:, links.bones] = swing_onto(
                    inherited[:, links.places], link_vectors(positions, links.starts, links.ends)
                )
            if len(joints.bones):
                rest = WORLD_FROM_BODY @ skeleton.rest[joints.bones, :3, :3]
                rotations[:, joints.bones] = joint_rotations[:, joints.starts] @ rest
        return rotations

    def transfer(self, positions: Array, joint_rotations: Array, rest: Array) -> Array:
        """Bone rotations (N, B, 3, 3) by the whole rotations of the joints from a shared rest pose (B, 3, 3).

        Bones with a link are then rotated onto it. ``positions``, ``joint_rotations``: as in :meth:`swing`.
        """
        rotations = np.empty((len(positions), len(self.skeleton), 3, 3))
        links, joints = self.driven
        for driven in (links, joints):
            rotations[:, driven.bones] = joint_rotations[:, driven.starts] @ rest[driven.bones]
        if len(links.bones):
            rotations[:, links.bones] = swing_onto(
                rotations[:, links.bones], link_vectors(positions, links.starts, links.ends)
            )
        driven_bones = {*links.bones.tolist(), *joints.bones.tolist()}
        for bone in range(len(self.skeleton)):  # parents come first
            if bone not in driven_bones:
                rotations[:, [bone]] = self.inherited(rotations, np.array([bone]))
        return rotations


def link_vectors(positions: Array, starts: Indices, ends: Indices) -> Array:
    """Vectors (N, P, 3) from start joints to end joints."""
    return positions[:, ends] - positions[:, starts]


def swing_onto(rotations: Array, links: Array) -> Array:
    """Bone rotations (N, b, 3, 3), and then the shortest rotation of the +y axes onto links (N, b, 3).

    A link without length changes nothing.
    """
    length = np.linalg.norm(links, axis=-1, keepdims=True)
    in_bone = rotate(np.swapaxes(rotations, -1, -2), links) / np.maximum(length, 1e-12)
    goal = np.where(length < SHORTEST_LINK, [0.0, 1.0, 0.0], in_bone)
    return np.asarray(rotations @ quaternion_to_matrix(from_y_axis(goal)))
