"""Lines of a person between joints: hips, shoulders, trunk, thighs."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from humansim_ros.body.skeleton import Skeleton
from humansim_ros.rotations import angle_between, unit_vectors
from humansim_ros.types import Array

#: Angles (degrees) up to which trunk, legs, hips and shoulders count as those of a standing person.
_TRUNK_TO_LEGS, _LEG_TO_LEG, _HIPS_TO_SHOULDERS, _HIPS_TO_LEVEL = 35.0, 90.0, 35.0, 35.0

#: Bones whose heads are the joints between which the lines go.
_BONE_OF_ROLE = {
    f"{side}{part}": f"{side[0].lower()}_{part.lower()}"
    for side in ("Left", "Right")
    for part in ("Hip", "Knee", "Shoulder", "Elbow")
}
#: Weight of the angle between an arm and the trunk in the measure of upright standing.
_ARM_WEIGHT = 0.05


@dataclass(frozen=True)
class BodyLines:
    """Lines of a person in N poses, as vectors (N, 3) in the frame and unit of the joints.

    Attributes:
        hips: From the right hip to the left hip.
        shoulders: From the right shoulder to the left shoulder; the hips' line where shoulders are unknown.
        trunk: From the middle of the hips to the middle of the shoulders, or to the neck or the head.
        thighs: (2, N, 3), from the left and the right hip to the knee.
        arms: (A, N, 3), from the shoulders to the elbows that are known.
    """

    hips: Array
    shoulders: Array
    trunk: Array
    thighs: Array
    arms: Array

    @classmethod
    def of(cls, positions: Array, roles: Mapping[str, int]) -> BodyLines:
        """Lines between joints (N, J, 3) with these roles."""

        def at(role: str) -> Array:
            return positions[:, roles[role]]

        middle = (at("LeftHip") + at("RightHip")) / 2
        hips = at("LeftHip") - at("RightHip")
        if {"LeftShoulder", "RightShoulder"} <= roles.keys():
            shoulders = at("LeftShoulder") - at("RightShoulder")
            top = (at("LeftShoulder") + at("RightShoulder")) / 2
        else:
            shoulders, top = hips, at(next(role for role in ("Neck", "Head", "Hips") if role in roles))
        thighs, arms = (
            [
                at(side + end) - at(side + start)
                for side in ("Left", "Right")
                if {side + start, side + end} <= roles.keys()
            ]
            for start, end in (("Hip", "Knee"), ("Shoulder", "Elbow"))
        )
        return cls(hips, shoulders, top - middle, np.array(thighs), np.array(arms).reshape(-1, *hips.shape))

    @classmethod
    def of_body(cls, posed: Array, skeleton: Skeleton) -> BodyLines:
        """Lines of posed bones (N, B, 4, 4)."""
        roles = {role: skeleton.bone(bone) for role, bone in _BONE_OF_ROLE.items()}
        return cls.of(posed[..., :3, 3], roles)

    @property
    def left(self) -> Array:
        """Direction of hips and shoulders together (N, 3), as they are long."""
        return self.hips + self.shoulders if self.shoulders is not self.hips else self.hips

    def axes(self, left: Array) -> Array:
        """Body axes (N, 3, 3) as columns: left (N, 3), up nearly along the trunk, forward."""
        x = unit_vectors(left)
        z = unit_vectors(np.cross(x, self.trunk))
        return np.stack([x, np.cross(z, x), z], axis=-1)

    def bend(self, up: Array) -> Array:
        """Sum of angles (N,) in radians by which a pose differs from standing upright.

        They are those between trunk and up, thighs and down, hips and shoulders, trunk and thighs. Raised
        arms count a little, so that they decide between poses that are equal otherwise.
        """
        legs = sum(angle_between(-thigh, up) + angle_between(-thigh, self.trunk) for thigh in self.thighs)
        across = angle_between(self.hips, self.shoulders)
        arms = sum(angle_between(-arm, self.trunk) for arm in self.arms)
        return np.asarray(angle_between(self.trunk, up) + legs / 2 + across + _ARM_WEIGHT * arms)

    def stands(self) -> Array:
        """Whether each pose (N,) is that of a standing person, in any orientation in space."""
        legs = unit_vectors(unit_vectors(self.thighs).sum(0))
        angles = np.degrees(
            [
                angle_between(-legs, self.trunk),
                angle_between(*self.thighs),
                angle_between(self.hips, self.shoulders),
                np.abs(angle_between(self.hips, self.trunk) - np.pi / 2),
            ]
        )
        limits = np.array([_TRUNK_TO_LEGS, _LEG_TO_LEG, _HIPS_TO_SHOULDERS, _HIPS_TO_LEVEL])
        return np.asarray((angles <= limits[:, None]).all(0))
