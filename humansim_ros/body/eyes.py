"""Eyeballs of a skeleton: directions of gaze, and the actions of the lids that go with them.

Angles are yaw to the person's left and pitch upwards, from the direction at rest, in the axes of the head.
An action such as ``eyeLookUpLeft`` has the weight 1 where the eye is at its limit. These actions say where
the eyes look, and move the skin around them: lids follow the eyes up and down [Leigh 2015].
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from humansim_ros.body.face_actions import ACTIONS
from humansim_ros.body.skeleton import Skeleton
from humansim_ros.rotations import unit_vectors
from humansim_ros.types import Array, Indices

#: The eyes, left first.
EYE_BONES = ("l_eyeball_joint", "r_eyeball_joint")
_HEAD = "vt3"
#: (2, 2, 2) numbers of the actions of the left and of the right eye: yaw to the left and to the right, pitch
#: up and down.
LOOKS: Indices = np.array(
    [
        [[ACTIONS.index(f"eyeLook{way}{side}") for way in ways] for ways in (yaw, ("Up", "Down"))]
        for side, yaw in (("Left", ("Out", "In")), ("Right", ("In", "Out")))
    ]
)
#: Limits of the eyes [Shechtman 2005]: ``eyeball_joint`` of config/joint_limits/normal.yaml.
_LIMITS = {"Up": 28.0, "Down": 47.0, "In": 45.0, "Out": 44.0}
#: (2, 2, 2) limits of the actions of :data:`LOOKS`, radians.
LIMITS: Array = np.radians(
    [
        [[_LIMITS[way] for way in ways] for ways in (yaw, ("Up", "Down"))]
        for yaw in (("Out", "In"), ("In", "Out"))
    ]
)


def looked_angles(weights: Array) -> Array:
    """Angles (N, 2, 2) radians of weights (N, 52): yaw and pitch of both eyes."""
    towards, away = np.moveaxis(weights[:, LOOKS] * LIMITS, -1, 0)
    return np.asarray(towards - away)


def with_looks(weights: Array, angles: Array) -> Array:
    """Weights (N, 52) whose actions of the eyes are those of angles (N, 2, 2), at most 1."""
    out = np.array(weights)
    out[:, LOOKS] = np.clip(np.stack([angles, -angles], axis=-1) / LIMITS, 0.0, 1.0)
    return out


def within_limits(angles: Array) -> Array:
    """Angles (N, 2, 2) radians that eyes reach."""
    return np.clip(angles, -LIMITS[..., 1], LIMITS[..., 0])


@dataclass(frozen=True)
class Eyes:
    """The eyeballs of a skeleton.

    Attributes:
        head: Number of the bone of the head.
        bones: (2,) numbers of the bones, left first.
        ends: (2,) numbers of the joints at the pupils.
        head_rest: Rotation (3, 3) of the head at rest.
        rest: Rotations (2, 3, 3) of the eyes at rest.
    """

    head: int
    bones: Indices
    ends: Indices
    head_rest: Array
    rest: Array

    @classmethod
    def of(cls, skeleton: Skeleton) -> Eyes | None:
        """Eyes of a skeleton; None without bones for them."""
        if not {_HEAD, *EYE_BONES} <= set(skeleton.names):
            return None
        head, bones = skeleton.bone(_HEAD), np.array([skeleton.bone(name) for name in EYE_BONES])
        names = skeleton.joint_names
        ends = np.array([names.index(f"{name}_end") for name in EYE_BONES])
        rest = skeleton.rest[:, :3, :3]
        return cls(head, bones, ends, rest[head], rest[bones])

    def rays(self, joints: Array) -> tuple[Array, Array]:
        """Middle of the eyes (N, 3), and the direction (N, 3) of eyes at rest, of joints (N, J, 4, 4)."""
        ahead = self.rest[:, :, 1].mean(0)
        head = joints[:, self.head, :3, :3] @ self.head_rest.T
        return _positions(joints)[:, self.bones].mean(1), unit_vectors(head @ ahead)

    def angles_to(self, joints: Array, points: Array) -> Array:
        """Angles (N, 2, 2) of eyes that look at points (N, 3), of joints (N, J, 4, 4)."""
        head = joints[:, self.head, :3, :3] @ self.head_rest.T
        lines = points[:, None] - _positions(joints)[:, self.bones]
        return _angles((head.swapaxes(-1, -2)[:, None] @ lines[..., None])[..., 0]) - self._rest_angles

    def turn(self, joints: Array, angles: Array) -> None:
        """Set the eyes and pupils of joints (N, J, 4, 4) to angles (N, 2, 2) from rest."""
        head = joints[:, self.head, :3, :3] @ self.head_rest.T
        rest = self._rest_angles
        turned = head[:, None] @ _turns(rest + angles) @ _turns(rest).swapaxes(-1, -2) @ self.rest
        places = _positions(joints)
        centers = places[:, self.bones]
        reach = np.linalg.norm(places[:, self.ends] - centers, axis=-1, keepdims=True)
        joints[:, self.bones, :3, :3] = joints[:, self.ends, :3, :3] = turned
        places[:, self.ends] = centers + reach * turned[..., 1]

    @property
    def _rest_angles(self) -> Array:
        return _angles(self.rest[:, :, 1])


def _positions(joints: Array) -> Array:
    """View (N, J, 3) of the positions of joints (N, J, 4, 4)."""
    return joints[..., :3, 3]


def _angles(lines: Array) -> Array:
    """Yaw and pitch (..., 2) of lines (..., 3) in body space."""
    x, y, z = np.moveaxis(lines, -1, 0)
    return np.stack([np.arctan2(x, z), np.arctan2(y, np.hypot(x, z))], axis=-1)


def _turns(angles: Array) -> Array:
    """Rotations (..., 3, 3) that take the z axis of body space to yaw and pitch (..., 2)."""
    (a, b), (c, d) = np.moveaxis(np.sin(angles), -1, 0), np.moveaxis(np.cos(angles), -1, 0)
    out = np.zeros((*angles.shape[:-1], 3, 3))
    out[..., 0, 0], out[..., 0, 1], out[..., 0, 2] = c, -a * b, a * d
    out[..., 1, 1], out[..., 1, 2] = d, b
    out[..., 2, 0], out[..., 2, 1], out[..., 2, 2] = -a, -c * b, c * d
    return out
