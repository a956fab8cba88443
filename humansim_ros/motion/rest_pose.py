"""Rest pose that a motion and a skeleton share: the bones' axes at joint rotation zero."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from humansim_ros.motion.bone_drivers import SHORTEST_LINK, BoneDrivers, link_vectors, swing_onto
from humansim_ros.motion.joint_match import JointMatch
from humansim_ros.motion.joint_poses import JointPoses
from humansim_ros.motion.joint_rotations import rotations_from_positions
from humansim_ros.rotations import WORLD_FROM_BODY, quaternion_to_matrix, rotate, unit_vectors
from humansim_ros.types import Array

#: Percentage of the poses, those with the lowest ankles, in which feet are flat on the floor.
_FLAT_PERCENTILE = 20
#: A hinge axis is known where bends agree this well (length of the mean of unit axes).
_HINGE_AGREEMENT = 0.8
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
    first = poses.positions[:1]
    posed = replace(drivers, extra=False).swing(first, rotations_from_positions(poses, drivers.match)[:1])
    rotations = quaternion_to_matrix(poses.rotations[0])
    rest = np.array(posed[0])
    for driven in drivers.driven:
        rest[driven.bones] = np.swapaxes(rotations[driven.starts], -1, -2) @ posed[0, driven.bones]
    return rest


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
