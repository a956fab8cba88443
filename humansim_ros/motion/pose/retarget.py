"""Retargeting: convert joint poses of a motion to bone rotations of a skeleton."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import dataclass, field, fields, replace
from functools import cached_property
from typing import Any, Literal

import numpy as np
from pydantic import BaseModel

from humansim_ros.errors import MotionError, within_bounds
from humansim_ros.geometry import (
    WORLD_FROM_BODY,
    angle_between,
    are_rotations,
    matrix_to_quaternion,
    quaternion_to_matrix,
    rotate,
    rotation_vector_to_matrix,
    transform,
    unit_vectors,
)
from humansim_ros.motion.body.kinematics import JointPoses
from humansim_ros.motion.body.skeleton import Skeleton, sole_heights
from humansim_ros.motion.matching.file_frame import BodyLines
from humansim_ros.motion.matching.joint_tables import JointMatch
from humansim_ros.motion.pose.bone_drivers import (
    LINE_ROTATIONS,
    SHORTEST_LINK,
    BoneDrivers,
    has_rotations,
    line_rotations,
    link_vectors,
    loose_bones,
    swing_onto,
)
from humansim_ros.motion.pose.hand_poses import FINGER_BONES, FreeFingers
from humansim_ros.motion.pose.limits import JointLimits, load_limits
from humansim_ros.motion.pose.world_motion import WorldMotion, floor_height
from humansim_ros.types import Array, Indices

#: Default for ``hands``: no finger has a pose from keys.
NO_HANDS: Mapping[str, Array] = {}
#: Feet are flat on the floor in this percentage of the poses: those with the lowest ankles.
_FLAT_PERCENTILE = 20
#: The axis of a hinge is known if the axes of bends agree: the mean of the unit axes must be at least this
#: long.
_HINGE_AGREEMENT = 0.8
#: Bones that leave their rest pose as their links do, instead of being parallel to the links. In most files,
#: these links rise from the spine to the shoulders at rest.
COLLARS = ("l_sternoclavicular", "r_sternoclavicular")
#: The directions of the body's trunk and of the trunk of the joints may differ by this angle (degrees).
_TRUNK_TOLERANCE = 13.0
_TRUNK = ("sacroiliac", "vl5", "vl5_to_l_sternoclavicular", "vl5_to_r_sternoclavicular")
#: Hinges of elbows and knees: upper and lower bone, and the axis of a bend. Elbows bend forwards and knees
#: backwards from a T pose.
_HINGES = (
    ("l_shoulder", "l_elbow", (0.0, 0.0, -1.0)),
    ("r_shoulder", "r_elbow", (0.0, 0.0, 1.0)),
    ("l_hip", "l_knee", (0.0, 1.0, 0.0)),
    ("r_hip", "r_knee", (0.0, 1.0, 0.0)),
)


def link_directions_at_rest(poses: JointPoses, match: JointMatch) -> dict[str, Array]:
    """Mean directions (3,) of the links of ``match.parallel`` at joint rotation zero, by bone; zero for a
    link without length. A link rotates with its start joint, so every pose measures the direction."""
    starts, ends = np.array(list(match.parallel.values())).T
    links = link_vectors(poses.positions, starts, ends)
    length = np.linalg.norm(links, axis=-1, keepdims=True)
    links = np.where(length < SHORTEST_LINK, 0.0, links / np.maximum(length, 1e-12))
    back = np.swapaxes(quaternion_to_matrix(poses.rotations[:, starts]), -1, -2)
    mean = rotate(back, links).mean(0)
    size = np.linalg.norm(mean, axis=-1, keepdims=True)
    return dict(zip(match.parallel, np.where(size < 0.05, 0.0, mean / np.maximum(size, 1e-12)), strict=True))


def is_standing_at_rest(poses: JointPoses, match: JointMatch) -> bool:
    """Whether joint rotations are measured from a rest pose that stands upright and faces +x."""
    links = link_directions_at_rest(poses, match)
    legs = [links[bone] for bone in ("l_hip", "r_hip", "l_knee", "r_knee") if bone in links]
    across = poses.positions[:, match.roles["LeftHip"]] - poses.positions[:, match.roles["RightHip"]]
    hips = quaternion_to_matrix(poses.rotations[:, match.roles["Hips"]])
    left = rotate(np.swapaxes(hips, -1, -2), across).mean(0)
    arms = [links[bone] for bone in ("l_shoulder", "l_sternoclavicular") if bone in links]
    sideways = left[1] > 0.8 * np.linalg.norm(left) and all(arm[1] > -0.5 for arm in arms)
    return bool(sideways and all(leg[2] < -0.7 for leg in legs))


def shared_rest(drivers: BoneDrivers, poses: JointPoses) -> Array:
    """Bone axes (B, 3, 3) in the rest pose of a motion. Bones with a link are parallel to their link."""
    skeleton, match = drivers.skeleton, drivers.match
    extra = [skeleton.bone(bone) for bone in match.extra]
    directions = link_directions_at_rest(poses, match)
    ends = {skeleton.bone(bone) for bone in match.extra if bone in FINGER_BONES}
    rotations = np.empty((1, len(skeleton), 3, 3))
    for bones, links, joints in drivers.levels:
        inherited = drivers.inherited(rotations, bones)
        rotations[:, bones] = inherited
        for place, bone in zip(links.places, links.bones, strict=True):
            direction = directions[skeleton.names[bone]]
            rotations[:, [bone]] = swing_onto(inherited[:, [place]], direction[None, None])
            if not direction.any():
                ends.add(int(bone))
        # extra bones keep the rotation that they inherit, so that fingers follow hands
        general = joints.bones[~np.isin(joints.bones, extra)]
        rotations[:, general] = WORLD_FROM_BODY @ skeleton.rest[general, :3, :3]
        # the direction of the last segment of a finger is unknown, so it continues the segment before it
        for bone in ends.intersection(bones.tolist()):
            along = rotations[:, [skeleton.parents[bone]], :, 1]
            rotations[:, [bone]] = swing_onto(rotations[:, [bone]], along)
    return rotations[0]


def rest_from_first_pose(drivers: BoneDrivers, poses: JointPoses) -> Array:
    """Bone axes (B, 3, 3) relative to the axes of their joints, if those are arbitrary. In the first pose,
    the bones are where the shortest rotations put them: this defines the axes."""
    skeleton = drivers.skeleton
    by_lines = replace(drivers, extra=False, loose=skeleton.names, rest_links={})
    first = JointPoses(poses.names, poses.positions[:1], poses.rotations[:1])
    posed = by_lines.swing(first.positions, line_rotations(first, drivers.match))[0]
    rotations = quaternion_to_matrix(poses.rotations[0])
    rest = WORLD_FROM_BODY @ skeleton.rest[:, :3, :3]
    for driven in drivers.driven:
        of_joints = driven.among(driven.starts >= 0)
        rest[of_joints.bones] = np.swapaxes(rotations[of_joints.starts], -1, -2) @ posed[of_joints.bones]
    return np.asarray(rest)


def collar_links(
    skeleton: Skeleton, poses: JointPoses, match: JointMatch, loose: Collection[str]
) -> dict[str, tuple[float, float, float]]:
    """Directions of the links of the collars at joint rotation zero, in the axes of the bones at rest.

    Args:
        skeleton, poses, match: Skeleton that is posed, joint poses, and joints that drive the bones.
        loose: Bones that do not use joint rotations. Their links get a mean direction relative to the chest.
    """
    chest = line_rotations(poses, match)[:, LINE_ROTATIONS.index("chest")]
    at_zero = link_directions_at_rest(poses, match)
    out = {}
    for bone in (each for each in COLLARS if each in at_zero):
        direction = at_zero[bone]
        if bone in loose:
            start, end = match.parallel[bone]
            link = unit_vectors(poses.positions[:, end] - poses.positions[:, start])
            direction = unit_vectors(rotate(np.swapaxes(chest, -1, -2), link).mean(0))
        if direction.any():
            at_rest = WORLD_FROM_BODY @ skeleton.rest[skeleton.bone(bone), :3, :3]
            x, y, z = (at_rest.T @ direction).tolist()
            out[bone] = (x, y, z)
    return out


def align_hinges(drivers: BoneDrivers, rest: Array, poses: JointPoses) -> Array:
    """Twist limbs in ``rest``, so that elbows and knees bend about the hinge axes of the skeleton."""
    skeleton, match = drivers.skeleton, drivers.match
    rest = np.array(rest)
    rotations = quaternion_to_matrix(poses.rotations)
    for upper, lower, axis in _HINGES:
        if upper not in match.parallel or lower not in match.parallel:
            continue
        joints = [match.parallel[bone] for bone in (upper, lower)]
        u, v = (poses.positions[:, end] - poses.positions[:, start] for start, end in joints)
        bend = np.asarray(np.cross(u, v), dtype=float)
        total = np.linalg.norm(bend, axis=-1).sum()
        least = max(_HINGE_AGREEMENT * total, 0.1 * len(u) * np.abs(u).mean() ** 2)
        for bone, (driver, _) in zip((upper, lower), joints, strict=True):
            index = skeleton.bone(bone)
            measured = rotate(np.swapaxes(rotations[:, driver], -1, -2), bend).sum(0)
            if np.linalg.norm(measured) < least:
                continue
            at_rest = WORLD_FROM_BODY @ skeleton.rest[index, :3, :3]
            expected = at_rest.T @ np.array(axis)  # axis in bone space
            actual = rest[index].T @ (measured / np.linalg.norm(measured))
            angle = np.arctan2(*actual[[0, 2]]) - np.arctan2(*expected[[0, 2]])
            c, s = np.cos(angle), np.sin(angle)
            rest[index] = rest[index] @ np.array([[c, 0, s], [0, 1, 0], [-s, 0, c]])
    return rest


def align_trunk(drivers: BoneDrivers, rest: Array, poses: JointPoses, posed: Array) -> Array:
    """Correct ``rest``, so that the trunk differs from the trunk of the joints by a tolerance at most.

    Skeletons differ a little: their shoulders are in front of the hips or behind the hips. The body keeps
    such a small difference. A larger difference is the posture of the person, so it is corrected.

    Args:
        drivers, rest: Drivers of the bones, and bone axes (B, 3, 3) at joint rotation zero.
        poses, posed: Joint poses at N times, and bone frames (N, B, 4, 4) of these poses with ``rest``.
    """
    skeleton, match = drivers.skeleton, drivers.match
    joint = match.difference.get("vl5")
    if joint is None or "vl5" in drivers.loose:
        return rest
    back = np.swapaxes(quaternion_to_matrix(poses.rotations[:, joint]), -1, -2)
    lines = (BodyLines.of_body(posed, skeleton), BodyLines.of(poses.positions, match.roles))
    ours, theirs = (rotate(back, unit_vectors(each.trunk)).mean(0) for each in lines)
    excess = float(angle_between(ours, theirs)) - np.radians(_TRUNK_TOLERANCE)
    if excess <= 0:
        return rest
    lean = rotation_vector_to_matrix(excess * unit_vectors(np.cross(ours, theirs)))
    trunk = [skeleton.bone(bone) for bone in _TRUNK if bone in match.difference]
    rest = np.array(rest)
    rest[trunk] = lean @ rest[trunk]
    return rest


def trunk_turns(trunks: Array, spines: Array, goals: Array) -> Array:
    """Rotations (N, 3, 3) of the spine, so that the trunk differs from a goal by the tolerance at most.

    This is needed for deep bends: if there are few links between hips and shoulders, the joints bend at other
    heights than the bones. ``trunks``: (N, 3) from the middle of the hips to the middle of the shoulders.
    ``spines``: (N, 3) the part of the trunk that rotates. ``goals``: (N, 3) trunks of the joints.
    """
    ours, theirs = unit_vectors(trunks), unit_vectors(goals)
    excess = np.maximum(angle_between(ours, theirs) - np.radians(_TRUNK_TOLERANCE), 0.0)
    if not excess.any():
        return np.broadcast_to(np.eye(3), (len(trunks), 3, 3))
    lean = rotation_vector_to_matrix(excess[:, None] * unit_vectors(np.cross(ours, theirs)))
    along = rotate(lean, ours)
    # the other part of the trunk keeps its direction: rest + turn @ spine is parallel to ``along``
    rest = trunks - spines
    offset = (rest * along).sum(-1)
    length = (spines**2).sum(-1) - (rest**2).sum(-1) + offset**2
    turned = (offset + np.sqrt(np.maximum(length, 0.0)))[:, None] * along - rest
    start, end = unit_vectors(spines), unit_vectors(turned)
    angle = np.where((excess > 0) & (length > 0), angle_between(start, end), 0.0)
    return rotation_vector_to_matrix(angle[:, None] * unit_vectors(np.cross(start, end)))


def align_feet(drivers: BoneDrivers, rest: Array, poses: JointPoses) -> Array:
    """Correct ``rest``, so that feet with low ankles are flat and along the links from ankle to toe."""
    skeleton, match = drivers.skeleton, drivers.match
    rest = np.array(rest)
    rotations = quaternion_to_matrix(poses.rotations)
    for side, bone in (("Left", "l_ankle"), ("Right", "r_ankle")):
        ankle, toe = (match.roles.get(f"{side}{part}") for part in ("Ankle", "Toe"))
        if ankle is None or toe is None or match.difference.get(bone) != ankle:
            continue
        index = skeleton.bone(bone)
        height = poses.positions[:, ankle, 2]
        low = height <= np.percentile(height, _FLAT_PERCENTILE)
        forward = (poses.positions[:, toe] - poses.positions[:, ankle])[low]
        forward[:, 2] = 0.0
        foot = WORLD_FROM_BODY @ skeleton.rest[index, :3, 1]
        flat = np.linalg.norm(foot[:2]) * unit_vectors(forward) + np.array([0.0, 0.0, foot[2]])
        in_joint = rotate(np.swapaxes(rotations[low, ankle], -1, -2), flat).mean(0)
        before = rest[index]
        rest[index] = swing_onto(before[None, None], in_joint[None, None])[0, 0]
        toes = f"{bone[:2]}metatarsal"
        if toes in match.extra:  # these toes keep their direction in the foot
            rest[skeleton.bone(toes)] = rest[index] @ before.T @ rest[skeleton.bone(toes)]
    return rest


RetargetMode = Literal["full", "thesis"]
#: Measure for the scale of the movement of the root: ankle-to-head height [thesis §7.2], or length of the
#: legs.
RootScale = Literal["height", "legs"]

#: If a person stands, the lowest joint is at most this high above the floor, metres.
_LOWEST_JOINT = 0.15
#: Most poses that are used to fit a retargeter.
_MAX_FITTED = 400


class _Constants(BaseModel):
    """Constants of a retargeter, with the names and in the order of their JSON."""

    table: str
    by: Literal["names", "shape", "given"]
    confidence: float
    parallel: dict[str, tuple[int, int]]
    difference: dict[str, int]
    roles: dict[str, int]
    missing: tuple[str, ...]
    own: dict[str, int] = {}
    mode: RetargetMode
    scale: float
    origin: tuple[float, float]
    lift: float
    rest: list[list[list[float]]] | None
    positions_only: bool = False
    clamp: bool = False
    loose: tuple[str, ...] = ()
    rest_links: dict[str, tuple[float, float, float]] = {}


@dataclass(frozen=True)
class Retargeter:
    """Computes poses of a skeleton from joint poses in ``map``. It holds only constants.

    The middle of the hips follows the hips of the motion. This movement is scaled by ``scale`` about
    ``origin`` and raised by ``lift``.

    Attributes:
        skeleton: Skeleton to be posed.
        match: Joints that drive the bones of the skeleton.
        scale: Scale of the root's movement.
        origin: Fixed point (x, y) of the scale on the floor, metres.
        lift: Metres by which the body is raised.
        mode: ``full``: a bone takes the whole rotation of its joint, twist included, from a rest pose that
            both skeletons share. It is then rotated to be parallel to its link. ``thesis``: a bone with a
            link is rotated onto the link by the shortest way from the rotation that it inherits (swing only).
            Other bones take the rotation of their joint [thesis §7.2].
        rest: (B, 3, 3) axes of the bones at joint rotation zero, for ``full``.
        positions_only: Whether to ignore the rotations of the joints.
        clamp: Whether to keep joints within their limits (docs/limits.md).
        loose: Bones with joints that do not rotate as the lines between joints do, for ``full``. The
            rotations of these joints are not used.
        rest_links: Bone -> direction of its link at rest, in the axes of the bone at rest. Such a bone (a
            collar) leaves its rest pose as its link does, instead of being parallel to the link.
    """

    skeleton: Skeleton
    match: JointMatch
    scale: float = 1.0
    origin: tuple[float, float] = (0.0, 0.0)
    lift: float = 0.0
    mode: RetargetMode = "thesis"
    rest: Array | None = None
    positions_only: bool = False
    clamp: bool = False
    loose: tuple[str, ...] = ()
    rest_links: Mapping[str, tuple[float, float, float]] = field(default_factory=dict)

    @classmethod
    def fit(
        cls,
        motion: WorldMotion,
        skeleton: Skeleton,
        mode: RetargetMode = "full",
        root_scale: RootScale | float | None = None,
        clamp: bool = False,
    ) -> Retargeter:
        """Fit to a motion. This finds a shared rest pose, the scale, and a lift that puts the lowest sole on
        the floor.

        Args:
            motion: Motion in ``map``.
            skeleton: Skeleton to be posed.
            mode: Whole rotations (``full``), or swing only (``thesis``).
            root_scale: Measure of the scale, or the scale itself. If None, ``legs``, since feet then slide
                least. In mode ``thesis``, ``height``.
            clamp: Whether to keep joints within their limits.
        """
        if root_scale is None:
            root_scale = "legs" if mode == "full" else "height"
        motion = replace(motion, correction=None)
        times = motion.frame_times
        times = times[:: len(times) // _MAX_FITTED + 1]
        poses = replace(motion, loop="none", speed=1.0).sample(np.minimum(times, motion.cycle_length))
        x, y = motion.placement.position
        scale = _root_scale(poses, motion, skeleton, root_scale)
        match = motion.match.with_extra_bones(skeleton.names, motion.names)
        fitted = cls(skeleton, match, scale, (float(x), float(y)), mode=mode, clamp=clamp)
        if mode == "full":
            loose = loose_bones(poses, match, standing=True)
            drivers = BoneDrivers(skeleton, match, loose=loose)
            rest = shared_rest(drivers, poses)
            if not motion.frame.offsets_stand:
                # if the rest pose is a frame of the motion, hinges and feet measure the unknown twist
                rest = align_feet(drivers, align_hinges(drivers, rest, poses), poses)
            links = collar_links(skeleton, poses, match, loose)
            fitted = replace(fitted, rest=rest, loose=loose, rest_links=links)
            rest = align_trunk(fitted._drivers, rest, poses, fitted.pose(poses))
            fitted = replace(fitted, rest=rest)
        return replace(fitted, lift=-floor_height(sole_heights(skeleton, fitted.pose(poses)).min(-1)))

    @classmethod
    def fit_live(cls, poses: JointPoses, match: JointMatch, skeleton: Skeleton) -> Retargeter:
        """Fit to some poses (N >= 1) of a live source, with the floor at z = 0.

        Rotations are relative to a standing rest pose that faces +x, as from the motion player. Otherwise
        they may be relative to any constant rest pose: then the first pose defines the bone axes. If all
        rotations are the same, bones follow only their links, and the trunk follows hips and shoulders. The
        scale is the ratio of the lengths of the legs, about the origin of ``map``.

        Raises:
            MotionError: The legs have no length.
        """
        match = match.with_extra_bones(skeleton.names, poses.names)
        scale = _leg_scale(poses, match, skeleton)
        if has_rotations(poses):
            standing = is_standing_at_rest(poses, match)
            loose = loose_bones(poses, match, standing)
            drivers = BoneDrivers(skeleton, match, loose=loose)
            rest = (shared_rest if standing else rest_from_first_pose)(drivers, poses)
            fitted = cls(skeleton, match, scale, mode="full", rest=rest, loose=loose)
        else:
            standing, loose = False, ()
            fitted = cls(skeleton, match, scale, positions_only=True)
        links = collar_links(skeleton, poses, match, loose if standing else COLLARS)
        fitted = replace(fitted, rest_links=links)
        lowest = sole_heights(skeleton, fitted.pose(poses)).min(-1)
        # a person who jumps in the first pose is in the air, not on the floor
        above = np.maximum(poses.positions[..., 2].min(-1) - _LOWEST_JOINT, 0.0)
        return replace(fitted, lift=-floor_height(lowest - scale * above))

    def placed_about(self, x: float, y: float) -> Retargeter:
        """Return a copy that scales the movement of the root about another point of the floor."""
        return replace(self, origin=(float(x), float(y)))

    def to_dict(self) -> dict[str, Any]:
        """Return all constants except the skeleton, as JSON types for :meth:`from_dict`."""
        rest = None if self.rest is None else self.rest.tolist()
        values = {**vars(self.match), "own": self.match.extra, **vars(self), "rest": rest}
        return _Constants.model_validate(values).model_dump(mode="json")

    @classmethod
    def from_dict(cls, data: Mapping[str, Any], skeleton: Skeleton) -> Retargeter:
        """Make the retargeter again from the result of :meth:`to_dict`.

        Raises:
            MotionError: The constants are incomplete or belong to another skeleton.
        """
        try:
            read = _Constants.model_validate(data)
            rest = None if read.rest is None else np.array(read.rest)
        except ValueError as reason:  # comes from pydantic, or from rows of different lengths
            why = " ".join(str(reason).splitlines()[1:3]) or reason
            raise MotionError(f"these are not the constants of a retargeter: {why}") from None
        fits = rest is None or (rest.shape == (len(skeleton), 3, 3) and are_rotations(rest))
        numbers = [read.scale, *read.origin, read.lift, read.confidence]
        numbers += [number for link in read.rest_links.values() for number in link]
        known = {*read.loose, *read.rest_links} <= {*skeleton.names}
        if not (within_bounds(numbers) and read.scale > 0 and fits and known):
            raise MotionError("these are not the constants of a retargeter for this skeleton")
        values = {**dict(read), "extra": read.own, "rest": rest, "skeleton": skeleton}
        match, own = (
            {each.name: values[each.name] for each in fields(kind) if each.name in values}
            for kind in (JointMatch, cls)
        )
        return cls(**{**own, "match": JointMatch(**match)})

    def apply(self, poses: JointPoses, hands: Mapping[str, Array] = NO_HANDS) -> tuple[Array, Array]:
        """Bone rotations (N, B, 4) xyzw in bone space, and transforms (N, 4, 4) from body space to ``map``.
        ``skeleton.pose(*apply(poses))`` equals :meth:`pose`. ``hands``: finger bone -> rotation (N, 4) xyzw
        in bone space, which the bone takes whatever the motion or the arm does."""
        rotations, _, translation = self._solve(poses, hands)
        local = self.skeleton.rest_in_parent[:, :3, :3]
        parents = self.skeleton.parents
        inherited = np.where((parents < 0)[:, None, None], WORLD_FROM_BODY, rotations[:, parents]) @ local
        in_bone = matrix_to_quaternion(np.swapaxes(inherited, -1, -2) @ rotations)
        if self.clamp:
            in_bone = self._limits.clamp(in_bone)
        return in_bone, transform(WORLD_FROM_BODY, translation)

    def pose(self, poses: JointPoses, hands: Mapping[str, Array] = NO_HANDS) -> Array:
        """Posed bone frames (N, B, 4, 4) in ``map``. ``hands`` is the same as in :meth:`apply`."""
        if self.clamp:
            return self.skeleton.pose(*self.apply(poses, hands))
        rotations, heads, translation = self._solve(poses, hands)
        return transform(rotations, heads + translation[:, None])

    def _solve(self, poses: JointPoses, hands: Mapping[str, Array]) -> tuple[Array, Array, Array]:
        """Pose the bones. Returns rotations (N, B, 3, 3) and heads (N, B, 3) in ``map`` axes, before the body
        is moved to its place; and the translation (N, 3) that moves the body to its place."""
        joint_rotations = quaternion_to_matrix(poses.rotations)
        if self._drivers.loose:
            joint_rotations = np.append(joint_rotations, line_rotations(poses, self.match), axis=1)
        if self.rest is None:
            rotations = self._drivers.swing(poses.positions, joint_rotations)
            heads = self._heads(rotations)
        else:
            rotations = self._drivers.transfer(poses.positions, joint_rotations, self.rest)
            rotations, heads = self._with_trunk(rotations, self._heads(rotations), poses)
        if self._free_fingers is not None:
            self._free_fingers.move(rotations, heads, hands)
        hips = [self.skeleton.bone("l_hip"), self.skeleton.bone("r_hip")]
        return rotations, heads, self.hips(poses) - heads[:, hips].mean(1)

    def _heads(self, rotations: Array) -> Array:
        """Heads (N, B, 3) of bones with rotations (N, B, 3, 3), in a body that is not placed."""
        heads = np.empty((len(rotations), len(self.skeleton), 3))
        local = self.skeleton.rest_in_parent[:, :3, 3]
        roots, *levels = self.skeleton.levels
        heads[:, roots] = local[roots] @ WORLD_FROM_BODY.T
        for bones in levels:
            parents = self.skeleton.parents[bones]
            heads[:, bones] = heads[:, parents] + rotate(rotations[:, parents], local[bones])
        return heads

    def _with_trunk(self, rotations: Array, heads: Array, poses: JointPoses) -> tuple[Array, Array]:
        """Correct rotations (N, B, 3, 3) and heads (N, B, 3): the spine follows the trunk of the joints."""
        if not {"LeftShoulder", "RightShoulder"} <= self.match.roles.keys():
            return rotations, heads
        ours = BodyLines.of_body(transform(rotations, heads), self.skeleton)
        theirs = BodyLines.of(poses.positions, self.match.roles)
        spines = heads[:, self._collars].mean(1) - heads[:, self._spine[0]]
        turns = trunk_turns(ours.trunk, spines, theirs.trunk)
        if (turns == np.eye(3)).all():
            return rotations, heads
        rotations = self._drivers.turned(rotations, poses.positions, turns, self._spine)
        return rotations, self._heads(rotations)

    @cached_property
    def _free_fingers(self) -> FreeFingers | None:
        return FreeFingers.of(self.skeleton, self.match)

    @cached_property
    def _spine(self) -> Indices:
        """Bones from the sacroiliac joint to the chest."""
        skeleton, chain = self.skeleton, [self.skeleton.bone("vl5")]
        while chain[0] != skeleton.bone("sacroiliac") and skeleton.parents[chain[0]] >= 0:
            chain.insert(0, int(skeleton.parents[chain[0]]))
        return np.array(chain, dtype=np.intp)

    @cached_property
    def _collars(self) -> list[int]:
        """Bones from the chest to the collars."""
        return [self.skeleton.bone(f"vl5_to_{side}_sternoclavicular") for side in "lr"]

    def hips(self, poses: JointPoses) -> Array:
        """Middle of the hips (N, 3) of the posed skeleton."""
        roles = self.match.roles
        source = (poses.positions[:, roles["LeftHip"]] + poses.positions[:, roles["RightHip"]]) / 2
        origin = np.array([*self.origin, 0.0])
        return np.asarray(origin + self.scale * (source - origin) + np.array([0.0, 0.0, self.lift]))

    @cached_property
    def _limits(self) -> JointLimits:
        return load_limits().for_skeleton(self.skeleton)

    @cached_property
    def _drivers(self) -> BoneDrivers:
        # the method of the thesis does not drive extra bones
        extra = self.mode == "full"
        loose = self.skeleton.names if self.positions_only else self.loose
        return BoneDrivers(self.skeleton, self.match, extra, self.rest_links, loose)


def skeleton_ankle_to_head(skeleton: Skeleton) -> float:
    """Ankle-to-head height of a skeleton along its bones, metres."""

    def lengths(*names: str) -> float:
        return float(sum(skeleton.lengths[skeleton.bone(name)] for name in names))

    legs = (lengths("l_hip", "l_knee") + lengths("r_hip", "r_knee")) / 2
    hips = skeleton.heads[[skeleton.bone("l_hip"), skeleton.bone("r_hip")]].mean(0)
    to_hips = float(np.linalg.norm(skeleton.heads[skeleton.bone("sacroiliac")] - hips))
    return legs + to_hips + lengths("sacroiliac", "vl5", "vt3")


def _root_scale(
    poses: JointPoses, motion: WorldMotion, skeleton: Skeleton, measure: RootScale | float
) -> float:
    if measure == "legs":
        return _leg_scale(poses, motion.match, skeleton)
    if measure == "height":
        return skeleton_ankle_to_head(skeleton) / (motion.frame.ankle_to_head * motion.frame.unit)
    if isinstance(measure, str) or not 0 < measure < np.inf:
        raise MotionError(f"root scale is 'height', 'legs' or a number above 0, not {measure!r}")
    return float(measure)


def _leg_scale(poses: JointPoses, match: JointMatch, skeleton: Skeleton) -> float:
    """Ratio of leg lengths, of the skeleton to the joints (median over the poses). A leg goes from hip to
    ankle, or to the knee if the ankle is unknown."""
    bones, links = 0.0, np.zeros(len(poses.positions))
    for side, prefix in (("Left", "l"), ("Right", "r")):
        for start, end, bone in (("Hip", "Knee", "hip"), ("Knee", "Ankle", "knee")):
            if (s := match.roles.get(side + start)) is None or (e := match.roles.get(side + end)) is None:
                continue
            links += np.linalg.norm(poses.positions[:, e] - poses.positions[:, s], axis=-1)
            bones += float(skeleton.lengths[skeleton.bone(f"{prefix}_{bone}")])
    length = float(np.median(links))
    if not length > 10 * SHORTEST_LINK:
        raise MotionError("the legs have no length: hips, knees and ankles are at one place")
    return bones / length
