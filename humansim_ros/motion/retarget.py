"""Joint poses of a motion to bone rotations of a skeleton (thesis 7.2 and 9.7)."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

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
        posed = ground.pose(motion.sample(np.minimum(times, motion.motion.duration - 1e-9)))
        lowest = _sole_heights(skeleton, posed).min(-1)
        return cls(skeleton, motion.match, scale, ground.origin, -floor_height(lowest))

    def apply(self, poses: JointPoses) -> tuple[Array, Array]:
        """Bone rotations (N, B, 4) xyzw in bone space, and world-from-body transforms (N, 4, 4).

        ``skeleton.pose(*apply(poses))`` is :meth:`pose`.
        """
        rotations, _, _, shift = self._solve(poses)
        return rotations, transform(WORLD_FROM_BODY, shift)

    def pose(self, poses: JointPoses) -> Array:
        """Posed bone frames (N, B, 4, 4) in ``map``."""
        _, turns, heads, shift = self._solve(poses)
        return transform(turns, heads + shift[:, None])

    def _solve(self, poses: JointPoses) -> tuple[Array, Array, Array, Array]:
        """Bone rotations (N, B, 4); in ``map`` axes, from an unplaced body, bone turns (N, B, 3, 3) and heads
        (N, B, 3); and the translation (N, 3) that places it.
        """
        skeleton = self.skeleton
        n = len(poses.positions)
        joint_turns = quaternion_to_matrix(poses.rotations)
        local = skeleton.rest_in_parent
        turns, heads = np.empty((n, len(skeleton), 3, 3)), np.empty((n, len(skeleton), 3))
        rotations = np.zeros((n, len(skeleton), 4))
        rotations[..., 3] = 1.0
        for bones, links, joints in self._levels:
            parents = skeleton.parents[bones]
            if parents[0] < 0:
                carried = np.broadcast_to(WORLD_FROM_BODY @ local[bones, :3, :3], (n, len(bones), 3, 3))
                heads[:, bones] = local[bones, :3, 3] @ WORLD_FROM_BODY.T
            else:
                carried = turns[:, parents] @ local[bones, :3, :3]
                heads[:, bones] = heads[:, parents] + _apply(turns[:, parents], local[bones, :3, 3])
            back = np.swapaxes(carried, -1, -2)
            if len(links.bones):
                link = poses.positions[:, links.ends] - poses.positions[:, links.starts]
                length = np.linalg.norm(link, axis=-1, keepdims=True)
                swing = from_y_axis(_apply(back[:, links.places], link) / np.maximum(length, 1e-12))
                rest = rotations[:, links.bones]
                rotations[:, links.bones] = np.where(length < _SHORTEST_LINK, rest, swing)
            if len(joints.bones):
                goal = joint_turns[:, joints.starts] @ (WORLD_FROM_BODY @ skeleton.rest[joints.bones, :3, :3])
                rotations[:, joints.bones] = matrix_to_quaternion(back[:, joints.places] @ goal)
            turns[:, bones] = carried @ quaternion_to_matrix(rotations[:, bones])
        hips = [skeleton.bone("l_hip"), skeleton.bone("r_hip")]
        return rotations, turns, heads, self._hips(poses) - heads[:, hips].mean(1)

    def _hips(self, poses: JointPoses) -> Array:
        """Where the middle of the hips goes (N, 3)."""
        roles = self.match.roles
        source = (poses.positions[:, roles["LeftHip"]] + poses.positions[:, roles["RightHip"]]) / 2
        origin = np.array([*self.origin, 0.0])
        return np.asarray(origin + self.scale * (source - origin) + np.array([0.0, 0.0, self.lift]))

    @cached_property
    def _levels(self) -> tuple[tuple[NDArray[np.intp], _Driven, _Driven], ...]:
        """For each level of the skeleton: its bones, those that follow links, those that follow joints."""
        links = self.match.parallel
        joints = {bone: (joint, joint) for bone, joint in self.match.difference.items() if bone not in links}
        return tuple(
            (bones, _Driven.among(bones, self.skeleton, links), _Driven.among(bones, self.skeleton, joints))
            for bones in self.skeleton.levels
        )


@dataclass(frozen=True)
class _Driven:
    """Bones of one level: their ``places`` in it, their indices, the joints that drive them (start, end)."""

    places: NDArray[np.intp]
    bones: NDArray[np.intp]
    starts: NDArray[np.intp]
    ends: NDArray[np.intp]

    @classmethod
    def among(
        cls, bones: NDArray[np.intp], skeleton: Skeleton, drivers: Mapping[str, tuple[int, int]]
    ) -> _Driven:
        rows = [
            (place, bone, *drivers[skeleton.names[bone]])
            for place, bone in enumerate(bones)
            if skeleton.names[bone] in drivers
        ]
        return cls(*np.array(rows, dtype=np.intp).reshape(-1, 4).T)


def _apply(matrices: Array, vectors: Array) -> Array:
    return np.asarray((matrices @ vectors[..., None])[..., 0])


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
