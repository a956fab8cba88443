"""Bone rotations from the links and rotations of the joints that drive the bones."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike

from humansim_ros.body.skeleton import Skeleton
from humansim_ros.motion.joint_match import JointMatch
from humansim_ros.rotations import WORLD_FROM_BODY, from_y_axis, quaternion_to_matrix, rotate
from humansim_ros.types import Array, Indices

#: Place of the rotations of pelvis, chest and feet that follow from positions, after those of all joints.
LINE_ROTATIONS = ("pelvis", "chest", "l_ankle", "r_ankle")
_LINE_OF_BONE = {
    "HumanoidRoot": "pelvis",
    "HumanoidRoot_to_l_hip": "pelvis",
    "HumanoidRoot_to_r_hip": "pelvis",
    "sacroiliac": "pelvis",
    "vl5": "chest",
    "vt3": "chest",
    "vl5_to_l_sternoclavicular": "chest",
    "vl5_to_r_sternoclavicular": "chest",
    "l_ankle": "l_ankle",
    "r_ankle": "r_ankle",
}
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

    def split(self, chosen: ArrayLike) -> tuple[DrivenBones, DrivenBones]:
        """The bones that are not chosen (b,), and those that are."""
        pick = np.asarray(chosen, dtype=bool)
        every = (self.places, self.bones, self.starts, self.ends)
        return DrivenBones(*(part[~pick] for part in every)), DrivenBones(*(part[pick] for part in every))


@dataclass(frozen=True)
class BoneDrivers:
    """The drivers of the bones of a skeleton.

    ``extra``: also of bones that the general skeleton lacks. ``rest_links``: bone -> direction (3,) of its
    link at rest, in the axes of the bone at rest. Such a bone is not parallel to its link; it leaves its rest
    pose as the link leaves its own. ``loose``: bones for which the rotations of their joints are not used.
    Instead, pelvis, chest and feet use the last four of the joint rotations, as in ``LINE_ROTATIONS``.
    """

    skeleton: Skeleton
    match: JointMatch
    extra: bool = True
    rest_links: Mapping[str, tuple[float, float, float]] = field(default_factory=dict)
    loose: tuple[str, ...] = ()

    @cached_property
    def _joints(self) -> dict[str, tuple[int, int]]:
        """Bone -> joint (twice) whose rotation drives it; negative numbers for rotations from positions."""
        drivers = {**(self.match.extra if self.extra else {}), **self.match.difference}
        for bone in self.loose:
            if drivers.pop(bone, None) is not None and (line := _LINE_OF_BONE.get(bone)) is not None:
                drivers[bone] = LINE_ROTATIONS.index(line) - len(LINE_ROTATIONS)
        return {bone: (joint, joint) for bone, joint in drivers.items() if bone not in self.match.parallel}

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

        ``positions``: (N, J, 3). ``joint_rotations``: (N, J, 3, 3), or (N, J + 4, 3, 3) with ``loose`` bones.
        """
        skeleton = self.skeleton
        rotations = np.empty((len(positions), len(skeleton), 3, 3))
        for bones, links, joints in self.levels:
            inherited = self.inherited(rotations, bones)
            rotations[:, bones] = inherited
            if len(links.bones):
                rotations[:, links.bones] = self._onto_links(
                    self._along_links(inherited[:, links.places], links.bones), positions, links
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
        links, joints, inheriting = self._transferred
        for driven in (links, joints):
            rotations[:, driven.bones] = joint_rotations[:, driven.starts] @ rest[driven.bones]
        if len(links.bones):
            rotations[:, links.bones] = swing_onto(
                rotations[:, links.bones], link_vectors(positions, links.starts, links.ends)
            )
        if self._from_links is not None:
            bones = self._leaving_rest
            rotations[:, bones] = rotations[:, bones] @ self._from_links[bones]
        for bone, link in inheriting:
            inherited = self.inherited(rotations, bone)
            if len(link.bones):
                inherited = self._onto_links(self._along_links(inherited, bone), positions, link)
            rotations[:, bone] = inherited
        return rotations

    @cached_property
    def _transferred(self) -> tuple[DrivenBones, DrivenBones, list[tuple[Indices, DrivenBones]]]:
        """Bones with the rotation of their joint and a link; those without a link; and the others.

        The others inherit their rotation, parents first. Each is a bone (1,) and its link, if it has one.
        """
        links, joints = self.driven
        links, loose = links.split([self.skeleton.names[bone] in self.loose for bone in links.bones])
        others = np.setdiff1d(np.arange(len(self.skeleton)), [*links.bones, *joints.bones])
        return (
            links,
            joints,
            [(others[[n]], loose.split(loose.bones == bone)[1]) for n, bone in enumerate(others)],
        )

    @cached_property
    def _leaving_rest(self) -> Indices:
        """Bones with the rotation of their joint and a link to which they are not parallel."""
        links, *_ = self._transferred
        return np.intersect1d(links.bones, [self.skeleton.bone(bone) for bone in self.rest_links])

    def _along_links(self, rotations: Array, bones: Indices) -> Array:
        """Rotations (N, b, 3, 3) that make bones parallel to their links at rest, where they differ."""
        return (
            rotations
            if self._from_links is None
            else rotations @ np.swapaxes(self._from_links[bones], -1, -2)
        )

    def _onto_links(self, rotations: Array, positions: Array, driven: DrivenBones) -> Array:
        """Bone rotations (N, b, 3, 3) along the links at rest, rotated onto the links by the shortest way."""
        swung = swing_onto(rotations, link_vectors(positions, driven.starts, driven.ends))
        return swung if self._from_links is None else swung @ self._from_links[driven.bones]

    @cached_property
    def _from_links(self) -> Array | None:
        """Rotations (B, 3, 3) that put a bone at rest where it is parallel to its link at rest."""
        if not self.rest_links:
            return None
        out = np.tile(np.eye(3), (len(self.skeleton), 1, 1))
        for bone, direction in self.rest_links.items():
            out[self.skeleton.bone(bone)] = quaternion_to_matrix(from_y_axis(np.array(direction))).T
        return out


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
