"""Rest pose that a motion and a skeleton share: the bones' axes at joint rotation zero."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import replace

import numpy as np

from humansim_ros.body.skeleton import Skeleton
from humansim_ros.motion.bone_drivers import (
    LINE_ROTATIONS,
    SHORTEST_LINK,
    BoneDrivers,
    line_rotations,
    link_vectors,
    swing_onto,
)
from humansim_ros.motion.file_frame import BodyLines
from humansim_ros.motion.joint_match import JointMatch
from humansim_ros.motion.kinematics import JointPoses
from humansim_ros.rotations import (
    WORLD_FROM_BODY,
    angle_between,
    quaternion_to_matrix,
    rotate,
    rotation_vector_to_matrix,
    unit_vectors,
)
from humansim_ros.types import Array

#: Percentage of the poses, lowest ankles first, in which feet are flat on the floor.
_FLAT_PERCENTILE = 20
#: A hinge axis is known where bends agree this well (length of the mean of unit axes).
_HINGE_AGREEMENT = 0.8
#: Bones that leave their rest pose as their links do, instead of being parallel to them: in most files these
#: links rise from the spine to the shoulders at rest.
COLLARS = ("l_sternoclavicular", "r_sternoclavicular")
#: Angle (degrees) by which the trunks of body and joints may differ.
_TRUNK_TOLERANCE = 13.0
_TRUNK = ("sacroiliac", "vl5", "vl5_to_l_sternoclavicular", "vl5_to_r_sternoclavicular")
#: Hinges of elbows and knees: upper and lower bone, axis of a bend forwards and backwards from a T pose.
_HINGES = (
    ("l_shoulder", "l_elbow", (0.0, 0.0, -1.0)),
    ("r_shoulder", "r_elbow", (0.0, 0.0, 1.0)),
    ("l_hip", "l_knee", (0.0, 1.0, 0.0)),
    ("r_hip", "r_knee", (0.0, 1.0, 0.0)),
)


def link_directions_at_rest(poses: JointPoses, match: JointMatch) -> Array:
    """Directions (P, 3) of the links of ``match.parallel`` at joint rotation zero; zero without length.

    A link rotates with its start joint, so that every pose measures it: the mean over all poses.
    """
    starts, ends = np.array(list(match.parallel.values())).T
    links = link_vectors(poses.positions, starts, ends)
    length = np.linalg.norm(links, axis=-1, keepdims=True)
    links = np.where(length < SHORTEST_LINK, 0.0, links / np.maximum(length, 1e-12))
    back = np.swapaxes(quaternion_to_matrix(poses.rotations[:, starts]), -1, -2)
    mean = rotate(back, links).mean(0)
    size = np.linalg.norm(mean, axis=-1, keepdims=True)
    return np.where(size < 0.05, 0.0, mean / np.maximum(size, 1e-12))


def is_standing_at_rest(poses: JointPoses, match: JointMatch) -> bool:
    """Whether the joint rotations count from a rest pose that stands and faces +x."""
    links = dict(zip(match.parallel, link_directions_at_rest(poses, match), strict=True))
    legs = [links[bone] for bone in ("l_hip", "r_hip", "l_knee", "r_knee") if bone in links]
    across = poses.positions[:, match.roles["LeftHip"]] - poses.positions[:, match.roles["RightHip"]]
    hips = quaternion_to_matrix(poses.rotations[:, match.roles["Hips"]])
    left = rotate(np.swapaxes(hips, -1, -2), across).mean(0)
    arms = [links[bone] for bone in ("l_shoulder", "l_sternoclavicular") if bone in links]
    sideways = left[1] > 0.8 * np.linalg.norm(left) and all(arm[1] > -0.5 for arm in arms)
    return bool(sideways and all(leg[2] < -0.7 for leg in legs))


def shared_rest(drivers: BoneDrivers, poses: JointPoses) -> Array:
    """Bone axes (B, 3, 3) in the rest pose of a motion: bones with a link are parallel to it."""
    skeleton, match = drivers.skeleton, drivers.match
    extra = [skeleton.bone(bone) for bone in match.extra]
    directions = dict(zip(match.parallel, link_directions_at_rest(poses, match), strict=True))
    rotations = np.empty((1, len(skeleton), 3, 3))
    for bones, links, joints in drivers.levels:
        inherited = drivers.inherited(rotations, bones)
        rotations[:, bones] = inherited
        for place, bone in zip(links.places, links.bones, strict=True):
            direction = directions[skeleton.names[bone]]
            rotations[:, [bone]] = swing_onto(inherited[:, [place]], direction[None, None])
        # extra bones keep the rotation that they inherit: fingers follow hands that are held elsewhere
        general = joints.bones[~np.isin(joints.bones, extra)]
        rotations[:, general] = WORLD_FROM_BODY @ skeleton.rest[general, :3, :3]
    return rotations[0]


def rest_from_first_pose(drivers: BoneDrivers, poses: JointPoses) -> Array:
    """Bone axes (B, 3, 3) in the axes of their joints, whatever these are.

    In the first pose, the bones are where the shortest rotations put them.
    """
    skeleton = drivers.skeleton
    by_lines = replace(drivers, extra=False, loose=skeleton.names, rest_links={})
    first = JointPoses(poses.names, poses.positions[:1], poses.rotations[:1])
    posed = by_lines.swing(first.positions, line_rotations(first, drivers.match))[0]
    rotations = quaternion_to_matrix(poses.rotations[0])
    rest = WORLD_FROM_BODY @ skeleton.rest[:, :3, :3]
    for driven in drivers.driven:
        _, of_joints = driven.split(driven.starts >= 0)
        rest[of_joints.bones] = np.swapaxes(rotations[of_joints.starts], -1, -2) @ posed[of_joints.bones]
    return np.asarray(rest)


def collar_links(
    skeleton: Skeleton, directions: Mapping[str, Array]
) -> dict[str, tuple[float, float, float]]:
    """Directions of the links of the collars at rest, in the axes of the bones at rest.

    ``directions``: bone -> direction (3,) of its link at rest, in a body that faces +x.
    """
    out = {}
    for bone in COLLARS:
        if bone in directions and np.linalg.norm(directions[bone]) > 0:
            at_rest = WORLD_FROM_BODY @ skeleton.rest[skeleton.bone(bone), :3, :3]
            x, y, z = (at_rest.T @ directions[bone]).tolist()
            out[bone] = (x, y, z)
    return out


def collar_directions(poses: JointPoses, match: JointMatch, loose: Collection[str]) -> dict[str, Array]:
    """Directions (3,) of the links of the collars at joint rotation zero, in a body that faces +x.

    Those of ``loose`` bones are the mean directions from the chest.
    """
    chest = line_rotations(poses, match)[:, LINE_ROTATIONS.index("chest")]
    at_zero = dict(zip(match.parallel, link_directions_at_rest(poses, match), strict=True))
    out = {}
    for bone in set(COLLARS) & at_zero.keys():
        start, end = match.parallel[bone]
        link = unit_vectors(poses.positions[:, end] - poses.positions[:, start])
        from_chest = unit_vectors(rotate(np.swapaxes(chest, -1, -2), link).mean(0))
        out[bone] = from_chest if bone in loose else at_zero[bone]
    return out


def align_hinges(drivers: BoneDrivers, rest: Array, poses: JointPoses) -> Array:
    """``rest`` with upper and lower limbs twisted so that elbows and knees bend about the skeleton's axes."""
    skeleton, match = drivers.skeleton, drivers.match
    rest = np.array(rest)
    rotations = quaternion_to_matrix(poses.rotations)
    for upper, lower, axis in _HINGES:
        if upper not in match.parallel or lower not in match.parallel:
            continue
        u, v = (link_vectors(poses.positions, *np.array([match.parallel[b]]).T)[:, 0] for b in (upper, lower))
        bend = np.asarray(np.cross(u, v), dtype=float)
        for bone in (upper, lower):
            index = skeleton.bone(bone)
            driver = rotations[:, match.parallel[bone][0]]
            measured = rotate(np.swapaxes(driver, -1, -2), bend).sum(0)
            total = np.linalg.norm(bend, axis=-1).sum()
            least = max(_HINGE_AGREEMENT * total, 0.1 * len(u) * np.abs(u).mean() ** 2)
            if np.linalg.norm(measured) < least:
                continue
            at_rest = WORLD_FROM_BODY @ skeleton.rest[index, :3, :3]
            expected = at_rest.T @ np.array(axis)  # in bone space
            actual = rest[index].T @ (measured / np.linalg.norm(measured))
            angle = np.arctan2(*actual[[0, 2]]) - np.arctan2(*expected[[0, 2]])
            c, s = np.cos(angle), np.sin(angle)
            rest[index] = rest[index] @ np.array([[c, 0, s], [0, 1, 0], [-s, 0, c]])
    return rest


def align_trunk(drivers: BoneDrivers, rest: Array, poses: JointPoses, posed: Array) -> Array:
    """``rest`` with a trunk that differs from the joints' trunk by a tolerance at most.

    Skeletons place the shoulders a little in front of the hips or behind them, and a body keeps its own
    proportions. A larger difference is the posture of the person.

    Args:
        drivers: Drivers of the bones.
        rest: Bone axes (B, 3, 3) at joint rotation zero.
        poses: Joint poses at N times.
        posed: Bone frames (N, B, 4, 4) of these poses with ``rest``.
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


def align_feet(drivers: BoneDrivers, rest: Array, poses: JointPoses) -> Array:
    """``rest`` with feet flat, and along the links from ankle to toe, in the poses with the lowest ankles."""
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
        rest[index] = swing_onto(rest[index][None, None], in_joint[None, None])[0, 0]
    return rest
