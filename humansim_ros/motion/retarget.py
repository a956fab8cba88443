"""Joint poses of a motion to bone rotations of a skeleton (thesis 7.2 and 9.7)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from humansim_ros.body.skeleton import Skeleton
from humansim_ros.motion.joint_names import JointMatch
from humansim_ros.motion.world import JointPoses, WorldMotion, floor_height
from humansim_ros.rotations import (
    WORLD_FROM_BODY,
    Array,
    from_y_axis,
    matrix_to_quaternion,
    quaternion_to_matrix,
    transform,
)

#: A link shorter than this (metres) has no direction: its bone stays as its parent carries it.
_SHORTEST_LINK = 1e-4


@dataclass(frozen=True)
class Retargeter:
    """Turns joint poses in ``map`` into a pose of ``skeleton``; a pure function with its constants.

    Bones with a joint link become parallel to it by the shortest turn from where their parent carries them;
    difference-only bones take their joint's turn from the motion's rest pose. The middle of the hips goes
    where the motion's is, scaled by ``scale`` about ``origin`` (x, y) on the floor and lifted by ``lift``
    metres.
    """

    skeleton: Skeleton
    match: JointMatch
    scale: float = 1.0
    origin: tuple[float, float] = (0.0, 0.0)
    lift: float = 0.0

    @classmethod
    def fit(cls, motion: WorldMotion, skeleton: Skeleton) -> Retargeter:
        """Scale by ankle-to-head height (thesis 7.2); lift so that the lowest toe or ankle stands on the
        floor.
        """
        scale = skeleton_ankle_to_head(skeleton) / (motion.frame.ankle_to_head * motion.frame.unit)
        position = motion.placement.position
        ground = cls(skeleton, motion.match, scale, (float(position[0]), float(position[1])))
        times = np.arange(motion.motion.n_frames) * motion.motion.frame_time
        if len(times) > 400:
            times = times[:: len(times) // 400 + 1]
        rotations, root = ground.apply(motion.sample(np.minimum(times, motion.motion.duration - 1e-9)))
        lowest = _sole_heights(skeleton, skeleton.pose(rotations, root)).min(-1)
        return cls(skeleton, motion.match, scale, ground.origin, -floor_height(lowest))

    def apply(self, poses: JointPoses) -> tuple[Array, Array]:
        """Bone rotations (N, B, 4) xyzw in bone space, and world-from-body transforms (N, 4, 4)."""
        skeleton = self.skeleton
        n = len(poses.positions)
        turns = quaternion_to_matrix(poses.rotations)
        local = skeleton.rest_in_parent[:, :3, :3]
        rest = skeleton.rest[:, :3, :3]
        world = np.empty((n, len(skeleton), 3, 3))
        rotations = np.zeros((n, len(skeleton), 4))
        rotations[..., 3] = 1.0
        for bone, name in enumerate(skeleton.names):
            parent = skeleton.parents[bone]
            carried = (WORLD_FROM_BODY if parent < 0 else world[:, parent]) @ local[bone]
            if name in self.match.parallel:
                start, end = self.match.parallel[name]
                link = poses.positions[:, end] - poses.positions[:, start]
                length = np.linalg.norm(link, axis=-1, keepdims=True)
                aim = (np.swapaxes(carried, -1, -2) @ link[..., None])[..., 0] / np.maximum(length, 1e-12)
                rotations[:, bone] = np.where(length < _SHORTEST_LINK, rotations[:, bone], from_y_axis(aim))
            elif name in self.match.difference:
                goal = turns[:, self.match.difference[name]] @ WORLD_FROM_BODY @ rest[bone]
                rotations[:, bone] = matrix_to_quaternion(np.swapaxes(carried, -1, -2) @ goal)
            world[:, bone] = carried @ quaternion_to_matrix(rotations[:, bone])
        return rotations, self._root(poses, rotations)

    def _root(self, poses: JointPoses, rotations: Array) -> Array:
        roles = self.match.roles
        source = (poses.positions[:, roles["LeftHip"]] + poses.positions[:, roles["RightHip"]]) / 2
        origin = np.array([*self.origin, 0.0])
        target = origin + self.scale * (source - origin) + np.array([0.0, 0.0, self.lift])
        unplaced = transform(WORLD_FROM_BODY, np.zeros(3))
        hips = [self.skeleton.bone("l_hip"), self.skeleton.bone("r_hip")]
        posed = self.skeleton.pose(rotations, unplaced)[:, hips][..., :3, 3].mean(1)
        return transform(WORLD_FROM_BODY, target - posed)


def skeleton_ankle_to_head(skeleton: Skeleton) -> float:
    """Ankle-to-head height of a skeleton along its bones, metres: what a motion's own height is compared
    with.
    """

    def lengths(*names: str) -> float:
        return float(sum(skeleton.lengths[skeleton.bone(name)] for name in names))

    legs = (lengths("l_hip", "l_knee") + lengths("r_hip", "r_knee")) / 2
    hips = skeleton.heads[[skeleton.bone("l_hip"), skeleton.bone("r_hip")]].mean(0)
    to_hips = float(np.linalg.norm(skeleton.heads[skeleton.bone("sacroiliac")] - hips))
    return legs + to_hips + lengths("sacroiliac", "vl5", "vt3")


def _sole_heights(skeleton: Skeleton, posed: Array) -> Array:
    """World heights (..., 4) of toes and heels: the points of the feet that stand at height 0 at rest."""
    heights = []
    for name in ("l_ankle", "r_ankle"):
        bone = skeleton.bone(name)
        head, tail = skeleton.heads[bone], skeleton.tails[bone]
        for point in ((tail[0], 0.0, tail[2]), (head[0], 0.0, head[2] - 0.04)):
            offset = skeleton.rest_inverse[bone] @ np.array([*point, 1.0])
            heights.append((posed[..., bone, :, :] @ offset)[..., 2])
    return np.stack(heights, axis=-1)
