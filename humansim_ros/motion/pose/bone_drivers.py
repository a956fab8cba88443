"""Bone rotations from the links and rotations of the joints that drive the bones."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cached_property
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from humansim_ros.geometry import (
    WORLD_FROM_BODY,
    angle_between,
    from_y_axis,
    quaternion_to_matrix,
    rotate,
    unit_vectors,
)
from humansim_ros.motion.body.kinematics import JointPoses
from humansim_ros.motion.body.skeleton import Skeleton
from humansim_ros.motion.matching.file_frame import BodyLines
from humansim_ros.motion.matching.joint_tables import JointMatch
from humansim_ros.types import Array, Indices

#: Rotations of pelvis, chest and feet that are computed from joint positions. Arrays of rotations have them,
#: in this order, after the rotations of all joints.
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
_NONE = np.zeros(0, dtype=np.intp)
_TOES = {"l_ankle": "l_metatarsal", "r_ankle": "r_metatarsal"}
#: Arms without known joints hang down. They lean outwards by this share.
_OUTWARDS = 0.18
#: A shorter link (metres) has no clear direction, so its bone keeps the rotation that it inherits.
SHORTEST_LINK = 1e-4


class DrivenBones(NamedTuple):
    """Some bones of a level of the skeleton's tree, and their drivers. ``places``: indices in the level.
    ``bones``: indices in the skeleton. ``starts``, ``ends``: joints at both ends of the driving links. If the
    rotation of a joint drives a bone, ``starts`` and ``ends`` both have this joint."""

    places: Indices
    bones: Indices
    starts: Indices
    ends: Indices

    def among(self, chosen: ArrayLike) -> DrivenBones:
        """Keep only the bones that ``chosen`` (b,) selects: a mask or indices."""
        return DrivenBones(*(part[np.asarray(chosen, dtype=bool)] for part in self))


@dataclass(frozen=True)
class BoneDrivers:
    """The drivers of the bones of a skeleton.

    ``extra``: include drivers of bones that the general skeleton lacks. ``rest_links``: bone -> direction
    (3,) of its link at rest, in the axes of the bone at rest. Such a bone is not parallel to its link, but
    keeps its angle to the link. ``loose``: bones that do not use the rotations of their joints. Among them,
    pelvis, chest and feet use :data:`LINE_ROTATIONS` instead.
    """

    skeleton: Skeleton
    match: JointMatch
    extra: bool = True
    rest_links: Mapping[str, tuple[float, float, float]] = field(default_factory=dict)
    loose: tuple[str, ...] = ()

    @cached_property
    def _joints(self) -> dict[str, tuple[int, int]]:
        """Bone -> (joint, joint), the joint with the rotation that drives the bone, twice. A negative number
        stands for one of :data:`LINE_ROTATIONS`."""
        drivers = {**(self.match.extra if self.extra else {}), **self.match.difference}
        for bone in self.loose:
            if drivers.pop(bone, None) is not None and (line := _LINE_OF_BONE.get(bone)) is not None:
                drivers[bone] = LINE_ROTATIONS.index(line) - len(LINE_ROTATIONS)
        return {bone: (joint, joint) for bone, joint in drivers.items() if bone not in self.match.parallel}

    def _split(self, bones: Indices) -> tuple[DrivenBones, DrivenBones]:
        """Bones driven by links, and bones driven by joint rotations."""
        names = [(place, bone, self.skeleton.names[bone]) for place, bone in enumerate(bones)]
        links, joints = (
            np.array(
                [(place, bone, *drivers[name]) for place, bone, name in names if name in drivers], np.intp
            )
            for drivers in (self.match.parallel, self._joints)
        )
        return DrivenBones(*links.reshape(-1, 4).T), DrivenBones(*joints.reshape(-1, 4).T)

    @cached_property
    def driven(self) -> tuple[DrivenBones, DrivenBones]:
        """The bones driven by links, and the bones driven by joint rotations."""
        return self._split(np.arange(len(self.skeleton)))

    @cached_property
    def levels(self) -> tuple[tuple[Indices, DrivenBones, DrivenBones], ...]:
        """For each level of the tree: all bones, bones driven by links, bones driven by joint rotations."""
        return tuple((bones, *self._split(bones)) for bones in self.skeleton.levels)

    def inherited(self, rotations: Array, bones: Indices) -> Array:
        """Rotations (N, b, 3, 3) that bones of one level have if they only follow their parents."""
        local = self._at_rest[bones]
        parents = self.skeleton.parents[bones]
        above = np.where((parents < 0)[:, None, None], WORLD_FROM_BODY, rotations[:, parents])
        return np.asarray(above @ local)

    @cached_property
    def _at_rest(self) -> Array:
        """Rotations (B, 3, 3) at rest relative to the parents. Upper arms without a joint hang down."""
        local = self.skeleton.rest_in_parent[:, :3, :3].copy()
        for bone, side in (("l_shoulder", 1), ("r_shoulder", -1)):
            if bone in self.match.held:
                number = self.skeleton.bone(bone)
                rest = self.skeleton.rest[[number], :3, :3]
                hanging = swing_onto(rest[None], np.array([[[side * _OUTWARDS, -1.0, 0.0]]]))[0]
                local[number] = local[number] @ (np.swapaxes(rest, -1, -2) @ hanging)[0]
        return local

    def swing(self, positions: Array, joint_rotations: Array) -> Array:
        """Rotate bones (N, B, 3, 3) onto their links by the shortest rotation [thesis §7.2], level by level.
        ``positions``: (N, J, 3). ``joint_rotations``: (N, J, 3, 3), or (N, J + 4, 3, 3) with ``loose``
        bones."""
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
        """Compute rotations (N, B, 3, 3) of all bones from the full rotations of their joints, with twist.
        Bones with a link are then rotated onto the link. Bones without a joint follow their parents.

        Args:
            positions, joint_rotations: The same as in :meth:`swing`.
            rest: Rotations (B, 3, 3) of the bones when all joint rotations are zero.
        """
        rotations = np.empty((len(positions), len(self.skeleton), 3, 3))
        links, joints, _ = self._transferred
        for driven in (links, joints):
            rotations[:, driven.bones] = joint_rotations[:, driven.starts] @ rest[driven.bones]
        if len(links.bones):
            rotations[:, links.bones] = swing_onto(
                rotations[:, links.bones], link_vectors(positions, links.starts, links.ends)
            )
        if self._from_links is not None:
            bones = self._leaving_rest
            rotations[:, bones] = rotations[:, bones] @ self._from_links[bones]
        self._inherit(rotations, positions)
        return rotations

    def turned(self, rotations: Array, positions: Array, turns: Array, chain: Indices) -> Array:
        """Turn bones of a chain, and update all bones that inherit their rotations from the chain.

        Args:
            rotations, positions: Bones (N, B, 3, 3) and joints (N, J, 3), as in :meth:`transfer`.
            turns, chain: Rotations (N, 3, 3) in ``map``, and numbers of the bones to turn.
        """
        rotations = rotations.copy()
        rotations[:, chain] = turns[:, None] @ rotations[:, chain]
        self._inherit(rotations, positions, chain)
        return rotations

    def _inherit(self, rotations: Array, positions: Array, fixed: Indices = _NONE) -> None:
        """Update rotations (N, B, 3, 3) of bones that inherit theirs, except those of the ``fixed`` bones."""
        *_, inheriting = self._transferred
        for bones, links in inheriting:
            before = rotations[:, fixed]
            rotations[:, bones] = self.inherited(rotations, bones)
            if len(links.bones):
                along = self._along_links(rotations[:, links.bones], links.bones)
                rotations[:, links.bones] = self._onto_links(along, positions, links)
            rotations[:, fixed] = before

    @cached_property
    def _transferred(self) -> tuple[DrivenBones, DrivenBones, list[tuple[Indices, DrivenBones]]]:
        """Return three groups of bones: bones with a link that take the rotation of a joint; bones without a
        link that take the rotation of a joint; and, for each level, bones that inherit their rotation, with
        their links."""
        links, joints = self.driven
        is_loose = np.array([self.skeleton.names[bone] in self.loose for bone in links.bones], dtype=bool)
        links, loose = links.among(~is_loose), links.among(is_loose)
        others = np.setdiff1d(np.arange(len(self.skeleton)), [*links.bones, *joints.bones])
        levels = (np.intersect1d(level, others) for level in self.skeleton.levels)
        inheriting = [(level, loose.among(np.isin(loose.bones, level))) for level in levels if len(level)]
        return links, joints, inheriting

    @cached_property
    def _leaving_rest(self) -> Indices:
        """Bones that take the rotation of their joint and keep an angle to their link (``rest_links``)."""
        links, *_ = self._transferred
        return np.intersect1d(links.bones, [self.skeleton.bone(bone) for bone in self.rest_links])

    def _along_links(self, rotations: Array, bones: Indices) -> Array:
        """Remove the angle at rest between bones and their links from rotations (N, b, 3, 3). Bones that are
        parallel to their links do not change."""
        if self._from_links is None:
            return rotations
        return np.asarray(rotations @ np.swapaxes(self._from_links[bones], -1, -2))

    def _onto_links(self, rotations: Array, positions: Array, driven: DrivenBones) -> Array:
        """Rotate bones (N, b, 3, 3) onto their links by the shortest way; keep any angle between both."""
        swung = swing_onto(rotations, link_vectors(positions, driven.starts, driven.ends))
        return swung if self._from_links is None else swung @ self._from_links[driven.bones]

    @cached_property
    def _from_links(self) -> Array | None:
        """Rotations (B, 3, 3) that give a bone its angle to the link at rest: turn the bone along its link
        first, then multiply its rotation by them on the right. Identity for bones that are parallel to their
        links. None without ``rest_links``."""
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
    """Turn the +y axes of bones (N, b, 3, 3) onto links (N, b, 3) by the shortest rotation. A link without
    length changes nothing."""
    length = np.linalg.norm(links, axis=-1, keepdims=True)
    in_bone = rotate(np.swapaxes(rotations, -1, -2), links) / np.maximum(length, 1e-12)
    goal = np.where(length < SHORTEST_LINK, [0.0, 1.0, 0.0], in_bone)
    return np.asarray(rotations @ quaternion_to_matrix(from_y_axis(goal)))


#: If the rotations of all joints change over time by less than this angle (radians), they count as constant.
_CONSTANT_ANGLE = 1e-6
#: A line and a joint rotate together if they differ by less than these angles (degrees) in the median pose.
_HIPS, _SHOULDERS, _FLEXIBLE = 12.0, 15.0, 25.0
#: Hips that are nevertheless rigid may differ by more than this angle in this share of the poses.
_RIGID_SHARE = 0.1


def has_rotations(poses: JointPoses) -> bool:
    """Whether a source measures joint rotations. False if all rotations are zero or constant."""
    rotations = poses.rotations
    if not (np.linalg.norm(rotations, axis=-1) > 0.5).all():
        return False
    cosine = np.abs((rotations * rotations[:1, :1]).sum(-1))
    return bool((cosine < np.cos(_CONSTANT_ANGLE / 2) - 1e-12).any())


def loose_bones(poses: JointPoses, match: JointMatch, standing: bool) -> tuple[str, ...]:
    """Find bones with a driving joint that does not rotate as the lines between the joints do.

    The rotation of such a joint does not describe the body. Examples are hips that a neural network predicts
    independently, and a root that does not move. Usually, the line between the hip joints turns rigidly with
    the hips. The line between the shoulders turns with chest and spine, within some degrees. The links of
    limbs turn with their joints.

    ``standing``: whether rotations are measured from a rest pose that stands upright and faces +x.
    """
    roles = match.roles
    back = np.swapaxes(quaternion_to_matrix(poses.rotations), -1, -2)
    lines = BodyLines.of(poses.positions, roles)
    left = np.array([0.0, 1.0, 0.0]) if standing else None

    def deviates(joint: int, line: Array, most: float, rest: Array | None = None, share: float = 0.5) -> bool:
        """Whether a ``share`` of lines (N, 3) in ``map``, seen in the axes of a joint, differs by more than
        ``most`` degrees from ``rest`` (3,). If ``rest`` is None, from their mean direction."""
        known = np.linalg.norm(line, axis=-1) > SHORTEST_LINK
        inside = rotate(back[known, joint], unit_vectors(line[known]))
        if not len(inside):
            return False
        angles = angle_between(inside, inside.mean(0) if rest is None else rest)
        return bool(np.quantile(angles, 1 - share) > np.radians(most))

    def link_deviates(start: int, end: int) -> bool:
        return deviates(start, poses.positions[:, end] - poses.positions[:, start], _FLEXIBLE)

    joints = set()
    for role, line, most, share in (
        ("Hips", lines.hips, _HIPS, _RIGID_SHARE),
        ("Spine", lines.left, _FLEXIBLE, 0.5),
        ("Chest", lines.shoulders, _SHOULDERS, 0.5),
    ):
        if role != "Hips" and lines.shoulders is lines.hips:
            continue  # if the shoulders are unknown, no line shows how the trunk turns
        if role in roles and deviates(roles[role], line, most, left, share):
            joints.add(roles[role])
    for side in ("Left", "Right"):
        ankle, toe = roles.get(f"{side}Ankle"), roles.get(f"{side}Toe")
        if ankle is not None and toe is not None and link_deviates(ankle, toe):
            joints.add(ankle)
    loose = [bone for bone, joint in match.difference.items() if joint in joints]
    return (
        *loose,
        # toes also count if their foot has a joint that does not rotate as the foot does
        *(toes for bone, toes in _TOES.items() if bone in loose and toes in match.extra),
        *(bone for bone, link in match.parallel.items() if link_deviates(*link)),
    )


def line_rotations(poses: JointPoses, match: JointMatch) -> Array:
    """Compute rotations from rest (N, 4, 3, 3) for :data:`LINE_ROTATIONS` from joint positions. The pelvis
    follows hips and trunk, the chest follows shoulders and trunk, and a foot follows its shin."""
    lines = BodyLines.of(poses.positions, match.roles)
    pelvis, chest = (lines.axes(left) @ WORLD_FROM_BODY.T for left in (lines.hips, lines.shoulders))
    feet = []
    for side in ("Left", "Right"):
        knee, ankle = (match.roles.get(f"{side}{part}") for part in ("Knee", "Ankle"))
        if knee is None or ankle is None:
            feet.append(pelvis)
            continue
        # the shortest rotation of the shin from straight down
        shin = poses.positions[:, ankle] - poses.positions[:, knee]
        in_pelvis = unit_vectors(rotate(np.swapaxes(pelvis, -1, -2), -shin))
        up = quaternion_to_matrix(from_y_axis(in_pelvis[:, [1, 2, 0]]))
        feet.append(pelvis @ WORLD_FROM_BODY @ up @ WORLD_FROM_BODY.T)
    return np.stack([pelvis, chest, *feet], axis=1)
