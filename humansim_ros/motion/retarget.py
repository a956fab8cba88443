"""Joint poses of a motion to bone rotations of a skeleton (thesis 7.2 and 9.7, and beyond)."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from humansim_ros.body.skeleton import Skeleton
from humansim_ros.errors import MotionError
from humansim_ros.motion.joint_tables import JointMatch
from humansim_ros.motion.limits import JointLimits, load_limits
from humansim_ros.motion.world_motion import JointPoses, WorldMotion, floor_height
from humansim_ros.rotations import (
    WORLD_FROM_BODY,
    from_y_axis,
    matrix_to_quaternion,
    quaternion_to_matrix,
    rotate,
    transform,
    unit_vectors,
)
from humansim_ros.types import Array

Mode = Literal["full", "thesis"]
#: What the scale of the root's way is measured by: ankle-to-head height (thesis 7.2), or the legs' length.
RootScale = Literal["height", "legs"]

#: A link shorter than this (metres) has no direction: its bone stays as its parent carries it.
_SHORTEST_LINK = 1e-4
#: Rotations of a source that differ by less than this (radians) from each other and over time say nothing.
_NO_TURN = 1e-6
#: Height above the floor up to which the lowest joint of a person that stands may be, metres.
_LOWEST_JOINT = 0.15
#: Percentage of the poses, those with the lowest ankles, that show how feet stand.
_STANDING_SHARE = 20
#: A hinge is known where its bends agree this well (length of the mean of unit axes).
_HINGE_AGREES = 0.8


@dataclass(frozen=True)
class Retargeter:
    """Turns joint poses in ``map`` into a pose of ``skeleton``; a pure function with its constants.

    ``mode`` "full": every bone takes the whole rotation of its joint, twist included, from a rest pose that
    both skeletons share, and bones with a joint link are then made exactly parallel to it. "thesis": bones
    with a link become parallel to it by the shortest turn from where their parent carries them (swing only,
    thesis 7.2); difference-only bones take their joint's turn.

    The middle of the hips goes where the motion's is, scaled by ``scale`` about ``origin`` (x, y) on the
    floor and lifted by ``lift`` metres. ``rest`` (B, 3, 3): for "full", each bone's axes as its joint's turn
    carries them: bone = turn of the joint x rest. ``positions_only``: the joints' rotations mean nothing.
    ``clamp``: bones are kept within the limits of their joints (docs/limits.md).
    """

    skeleton: Skeleton
    match: JointMatch
    scale: float = 1.0
    origin: tuple[float, float] = (0.0, 0.0)
    lift: float = 0.0
    mode: Mode = "thesis"
    rest: Array | None = None
    positions_only: bool = False
    clamp: bool = False

    @classmethod
    def fit(
        cls,
        motion: WorldMotion,
        skeleton: Skeleton,
        mode: Mode = "full",
        root_scale: RootScale | float | None = None,
        clamp: bool = False,
    ) -> Retargeter:
        """Find the shared rest pose and the scale; lift so that the lowest toe or ankle stands on the floor.

        ``root_scale``: what the scale is measured by, or the scale itself; None: the legs, with which feet
        slide least, and the height in the thesis' mode.
        """
        if root_scale is None:
            root_scale = "legs" if mode == "full" else "height"
        motion = replace(motion, clean_up=None)
        times = motion.frame_times
        times = times[:: len(times) // 400 + 1]
        poses = replace(motion, loop="none", speed=1.0).sample(np.minimum(times, motion.round_length))
        position = motion.placement.position
        scale = _root_scale(poses, motion, skeleton, root_scale)
        ground = cls(skeleton, motion.match, scale, (float(position[0]), float(position[1])), mode=mode)
        ground = replace(ground, clamp=clamp)
        if mode == "full":
            rest = ground._shared_rest(_rest_links(poses, motion.match))
            if not motion.frame.rest_stands:
                # the rest pose is some frame of the motion: what is twisted in it, hinges tell better
                rest = ground._feet_aligned(ground._hinges_aligned(rest, poses), poses)
            ground = replace(ground, rest=rest)
        lowest = sole_heights(skeleton, ground.pose(poses)).min(-1)
        return replace(ground, lift=-floor_height(lowest))

    @classmethod
    def observe(cls, poses: JointPoses, match: JointMatch, skeleton: Skeleton) -> Retargeter:
        """Fit to a live source of which only some poses (N >= 1) are known, floor at z = 0.

        Rotations may be turns from a standing rest pose that faces +x, as a motion player's, or of any other
        constant convention: then the first pose shows how they lie. Without rotations (all zero, or all the
        same) bones follow links only, the trunk the hips and shoulders. The scale is that of the legs, about
        the origin of ``map``. Raises MotionError if the legs have no length.
        """
        ground = cls(skeleton, match, _leg_scale(poses, match, skeleton))
        if has_turns(poses):
            stands = _stands(poses, match)
            rest = ground._shared_rest(_rest_links(poses, match)) if stands else ground._rest_of_pose(poses)
            ground = replace(ground, mode="full", rest=rest)
        else:
            ground = replace(ground, positions_only=True)
        lowest = sole_heights(skeleton, ground.pose(poses)).min(-1)
        # somebody who starts in a jump is in the air, not on the floor
        above = np.maximum(poses.positions[..., 2].min(-1) - _LOWEST_JOINT, 0.0)
        return replace(ground, lift=-floor_height(lowest - ground.scale * above))

    def to_dict(self) -> dict[str, Any]:
        """Everything but the skeleton, as JSON can hold it; :meth:`from_dict` takes it back."""
        match = self.match
        return {
            "table": match.table,
            "by": match.by,
            "confidence": match.confidence,
            "parallel": {bone: [int(j) for j in link] for bone, link in match.parallel.items()},
            "difference": {bone: int(joint) for bone, joint in match.difference.items()},
            "roles": {role: int(joint) for role, joint in match.roles.items()},
            "missing": list(match.missing),
            "own": {bone: int(joint) for bone, joint in match.own.items()},
            "mode": self.mode,
            "scale": self.scale,
            "origin": list(self.origin),
            "lift": self.lift,
            "rest": None if self.rest is None else self.rest.tolist(),
            "positions_only": self.positions_only,
            "clamp": self.clamp,
        }

    @classmethod
    def from_dict(cls, data: Mapping[str, Any], skeleton: Skeleton) -> Retargeter:
        """The retargeter that :meth:`to_dict` wrote down; MotionError if it is none for this skeleton."""
        try:
            match = JointMatch(
                table=str(data["table"]),
                parallel={str(b): (int(s), int(e)) for b, (s, e) in data["parallel"].items()},
                difference={str(b): int(j) for b, j in data["difference"].items()},
                roles={str(r): int(j) for r, j in data["roles"].items()},
                missing=tuple(data["missing"]),
                by=data["by"],
                confidence=float(data["confidence"]),
                own={str(b): int(j) for b, j in data.get("own", {}).items()},
            )
            rest = None if data["rest"] is None else np.array(data["rest"], dtype=float)
            x, y = data["origin"]
            numbers = [float(data["scale"]), float(x), float(y), float(data["lift"])]
            mode: Mode = data["mode"]
        except (KeyError, TypeError, ValueError, AttributeError) as reason:
            raise MotionError(f"these are no constants of a retargeter: {reason!r}") from None
        sizes = rest is None or (rest.shape == (len(skeleton), 3, 3) and np.isfinite(rest).all())
        if mode not in ("full", "thesis") or not np.isfinite(numbers).all() or not sizes:
            raise MotionError("these are no constants of a retargeter for this skeleton")
        scale, x, y, lift = numbers
        return cls(
            skeleton,
            match,
            scale,
            (x, y),
            lift,
            mode,
            rest,
            bool(data.get("positions_only")),
            bool(data.get("clamp")),
        )

    def apply(self, poses: JointPoses) -> tuple[Array, Array]:
        """Bone rotations (N, B, 4) xyzw in bone space, and world-from-body transforms (N, 4, 4).

        ``skeleton.pose(*apply(poses))`` is :meth:`pose`.
        """
        turns, _, shift = self._solve(poses)
        local = self.skeleton.rest_in_parent[:, :3, :3]
        parents = self.skeleton.parents
        carried = np.where((parents < 0)[:, None, None], WORLD_FROM_BODY, turns[:, parents]) @ local
        rotations = matrix_to_quaternion(np.swapaxes(carried, -1, -2) @ turns)
        if self.clamp:
            rotations = self._limits.clamp(rotations)
        return rotations, transform(WORLD_FROM_BODY, shift)

    def pose(self, poses: JointPoses) -> Array:
        """Posed bone frames (N, B, 4, 4) in ``map``."""
        if self.clamp:
            return self.skeleton.pose(*self.apply(poses))
        turns, heads, shift = self._solve(poses)
        return transform(turns, heads + shift[:, None])

    def _solve(self, poses: JointPoses) -> tuple[Array, Array, Array]:
        """In ``map`` axes, from an unplaced body, bone turns (N, B, 3, 3) and heads (N, B, 3); and the
        translation (N, 3) that places it.
        """
        joint_turns = quaternion_to_matrix(poses.rotations)
        if self.rest is None:
            if self.positions_only:
                joint_turns = _turns_of_positions(poses, self.match)
            turns = self._swung(poses.positions, joint_turns)
        else:
            turns = self._carried(poses.positions, joint_turns)
        heads = np.empty((len(turns), len(self.skeleton), 3))
        local = self.skeleton.rest_in_parent[:, :3, 3]
        first, *others = self.skeleton.levels
        heads[:, first] = local[first] @ WORLD_FROM_BODY.T
        for bones in others:
            parents = self.skeleton.parents[bones]
            heads[:, bones] = heads[:, parents] + rotate(turns[:, parents], local[bones])
        hips = [self.skeleton.bone("l_hip"), self.skeleton.bone("r_hip")]
        return turns, heads, self._hips(poses) - heads[:, hips].mean(1)

    def _swung(self, positions: Array, joint_turns: Array) -> Array:
        """Bone turns (N, B, 3, 3) the thesis' way: the shortest turn to the link, level by level."""
        skeleton = self.skeleton
        turns = np.empty((len(positions), len(skeleton), 3, 3))
        for bones, links, joints in self._levels:
            carried = self._from_parents(turns, bones)
            turns[:, bones] = carried
            if len(links.bones):
                mine = carried[:, links.places]
                turns[:, links.bones] = mine @ _swing_to(
                    np.swapaxes(mine, -1, -2), _links(positions, links.starts, links.ends)
                )
            if len(joints.bones):
                rest = WORLD_FROM_BODY @ skeleton.rest[joints.bones, :3, :3]
                turns[:, joints.bones] = joint_turns[:, joints.starts] @ rest
        return turns

    def _carried(self, positions: Array, joint_turns: Array) -> Array:
        """Bone turns (N, B, 3, 3) as the joints' whole rotations carry the bones from the shared rest."""
        assert self.rest is not None
        turns = np.empty((len(positions), len(self.skeleton), 3, 3))
        links, joints = self._driven
        for driven in (links, joints):
            turns[:, driven.bones] = joint_turns[:, driven.starts] @ self.rest[driven.bones]
        if len(links.bones):
            mine = turns[:, links.bones]
            turns[:, links.bones] = mine @ _swing_to(
                np.swapaxes(mine, -1, -2), _links(positions, links.starts, links.ends)
            )
        driven_bones = {*links.bones.tolist(), *joints.bones.tolist()}
        for bone in range(len(self.skeleton)):  # parents come first
            if bone not in driven_bones:
                turns[:, [bone]] = self._from_parents(turns, np.array([bone]))
        return turns

    def _from_parents(self, turns: Array, bones: NDArray[np.intp]) -> Array:
        """Turns (N, b, 3, 3) of bones of one level as their parents carry them."""
        local = self.skeleton.rest_in_parent[bones, :3, :3]
        parents = self.skeleton.parents[bones]
        above = np.where((parents < 0)[:, None, None], WORLD_FROM_BODY, turns[:, parents])
        return np.asarray(above @ local)

    def _shared_rest(self, links: Array) -> Array:
        """Bone axes (B, 3, 3) in the pose in which all joints are at rest, by the directions of the links
        of ``parallel`` (P, 3) there.
        """
        n_joints = 1 + max(j for link in self.match.parallel.values() for j in link)
        joints_used = (*self.match.difference.values(), *self.match.own.values())
        n_joints = max(n_joints, 1 + max(joints_used, default=0))
        further = [self.skeleton.bone(bone) for bone in self.match.own]
        still = np.broadcast_to(np.eye(3), (1, n_joints, 3, 3))
        directions = dict(zip(self.match.parallel, links, strict=True))
        turns = np.empty((1, len(self.skeleton), 3, 3))
        for bones, driven, joints in self._levels:
            carried = self._from_parents(turns, bones)
            turns[:, bones] = carried
            for place, bone in zip(driven.places, driven.bones, strict=True):
                mine = carried[:, [place]]
                link = directions[self.skeleton.names[bone]]
                turns[:, [bone]] = mine @ _swing_to(np.swapaxes(mine, -1, -2), link[None, None])
            rest = WORLD_FROM_BODY @ self.skeleton.rest[joints.bones, :3, :3]
            # further bones lie as their parents carry them: fingers go on from hands that are held elsewhere
            stays = np.isin(joints.bones, further)
            turns[:, joints.bones[~stays]] = still[:, joints.starts[~stays]] @ rest[~stays]
        return turns[0]

    def _rest_of_pose(self, poses: JointPoses) -> Array:
        """Bone axes (B, 3, 3) in their joints' axes, from how the first pose looks: the bones stand there as
        swing alone puts them, whatever the joints' axes are.
        """
        first = poses.positions[:1]
        seen = replace(self, mode="thesis", rest=None)._swung(
            first, _turns_of_positions(poses, self.match)[:1]
        )
        turns = quaternion_to_matrix(poses.rotations[0])
        links, joints = self._driven
        rest = np.array(seen[0])
        for driven in (links, joints):
            rest[driven.bones] = np.swapaxes(turns[driven.starts], -1, -2) @ seen[0, driven.bones]
        return rest

    def _hinges_aligned(self, rest: Array, poses: JointPoses) -> Array:
        """``rest`` with upper arms and thighs (and what follows them) twisted so that elbows and knees bend
        about the axes that the skeleton's have: forwards and backwards from a T pose.
        """
        rest = np.array(rest)
        turns = quaternion_to_matrix(poses.rotations)
        for upper, lower, axis in (
            ("l_shoulder", "l_elbow", (0.0, 0.0, -1.0)),
            ("r_shoulder", "r_elbow", (0.0, 0.0, 1.0)),
            ("l_hip", "l_knee", (0.0, 1.0, 0.0)),
            ("r_hip", "r_knee", (0.0, 1.0, 0.0)),
        ):
            if upper not in self.match.parallel or lower not in self.match.parallel:
                continue
            u, v = (
                _links(poses.positions, *np.array([self.match.parallel[b]]).T)[:, 0] for b in (upper, lower)
            )
            bend = np.asarray(np.cross(u, v), dtype=float)
            for bone in (upper, lower):
                index = self.skeleton.bone(bone)
                driver = turns[:, self.match.parallel[bone][0]]
                seen = rotate(np.swapaxes(driver, -1, -2), bend).sum(0)
                bends = np.linalg.norm(bend, axis=-1).sum()
                if np.linalg.norm(seen) < max(_HINGE_AGREES * bends, 0.1 * len(u) * np.abs(u).mean() ** 2):
                    continue
                own = WORLD_FROM_BODY @ self.skeleton.rest[index, :3, :3]
                expected = own.T @ np.array(axis)  # in bone space
                actual = rest[index].T @ (seen / np.linalg.norm(seen))
                angle = np.arctan2(*actual[[0, 2]]) - np.arctan2(*expected[[0, 2]])
                c, s = np.cos(angle), np.sin(angle)
                rest[index] = rest[index] @ np.array([[c, 0, s], [0, 1, 0], [-s, 0, c]])
        return rest

    def _feet_aligned(self, rest: Array, poses: JointPoses) -> Array:
        """``rest`` with feet that lie flat, and point where the links from ankle to toes do, in the poses in
        which the ankles are lowest: then they stand.
        """
        rest = np.array(rest)
        turns = quaternion_to_matrix(poses.rotations)
        for side, bone in (("Left", "l_ankle"), ("Right", "r_ankle")):
            ankle, toe = (self.match.roles.get(f"{side}{part}") for part in ("Ankle", "Toe"))
            if ankle is None or toe is None or self.match.difference.get(bone) != ankle:
                continue
            index = self.skeleton.bone(bone)
            height = poses.positions[:, ankle, 2]
            stands = height <= np.percentile(height, _STANDING_SHARE)
            way = (poses.positions[:, toe] - poses.positions[:, ankle])[stands]
            way[:, 2] = 0.0
            way = unit_vectors(way)
            own = WORLD_FROM_BODY @ self.skeleton.rest[index, :3, 1]
            flat = np.linalg.norm(own[:2]) * way + np.array([0.0, 0.0, own[2]])
            seen = rotate(np.swapaxes(turns[stands, ankle], -1, -2), flat).mean(0)
            rest[index] = rest[index] @ _swing_to(rest[index].T[None, None], seen[None, None])[0, 0]
        return rest

    def _hips(self, poses: JointPoses) -> Array:
        """Where the middle of the hips goes (N, 3)."""
        roles = self.match.roles
        source = (poses.positions[:, roles["LeftHip"]] + poses.positions[:, roles["RightHip"]]) / 2
        origin = np.array([*self.origin, 0.0])
        return np.asarray(origin + self.scale * (source - origin) + np.array([0.0, 0.0, self.lift]))

    @cached_property
    def _limits(self) -> JointLimits:
        return load_limits().for_skeleton(self.skeleton)

    @cached_property
    def _joint_drivers(self) -> dict[str, tuple[int, int]]:
        # the thesis knows no further bones: they stay as their parents carry them
        own = self.match.own if self.mode == "full" else {}
        drivers = {**own, **self.match.difference}.items()
        return {bone: (joint, joint) for bone, joint in drivers if bone not in self.match.parallel}

    @cached_property
    def _driven(self) -> tuple[_Driven, _Driven]:
        """Bones that follow links, and bones that follow joints."""
        bones = np.arange(len(self.skeleton))
        return (
            _Driven.among(bones, self.skeleton, self.match.parallel),
            _Driven.among(bones, self.skeleton, self._joint_drivers),
        )

    @cached_property
    def _levels(self) -> tuple[tuple[NDArray[np.intp], _Driven, _Driven], ...]:
        """For each level of the skeleton: its bones, those that follow links, those that follow joints."""
        return tuple(
            (
                bones,
                _Driven.among(bones, self.skeleton, self.match.parallel),
                _Driven.among(bones, self.skeleton, self._joint_drivers),
            )
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


def _links(positions: Array, starts: NDArray[np.intp], ends: NDArray[np.intp]) -> Array:
    return positions[:, ends] - positions[:, starts]


def _swing_to(back: Array, links: Array) -> Array:
    """Rotations (N, b, 3, 3) in bone space that turn +y to links (N, b, 3) by the shortest way.

    ``back``: (N, b, 3, 3) world to bone space. A link without length turns nothing.
    """
    length = np.linalg.norm(links, axis=-1, keepdims=True)
    goal = np.where(length < _SHORTEST_LINK, [0.0, 1.0, 0.0], rotate(back, links) / np.maximum(length, 1e-12))
    return quaternion_to_matrix(from_y_axis(goal))


def _root_scale(poses: JointPoses, motion: WorldMotion, skeleton: Skeleton, by: RootScale | float) -> float:
    if by == "legs":
        return _leg_scale(poses, motion.match, skeleton)
    if by == "height":
        return skeleton_ankle_to_head(skeleton) / (motion.frame.ankle_to_head * motion.frame.unit)
    if isinstance(by, str) or not 0 < by < np.inf:
        raise MotionError(f"root scale is 'height', 'legs' or a number above 0, not {by!r}")
    return float(by)


def leg_length(poses: JointPoses, match: JointMatch) -> float:
    """Length of both legs from hip to ankle (to the knee where no ankle is known), metres: median over all
    poses.
    """
    return _legs(poses, match, None)[0]


def _leg_scale(poses: JointPoses, match: JointMatch, skeleton: Skeleton) -> float:
    """Leg length of the skeleton by that of the joints."""
    theirs, ours = _legs(poses, match, skeleton)
    if not theirs > 10 * _SHORTEST_LINK:
        raise MotionError("the legs have no length: hips, knees and ankles are at one place")
    return ours / theirs


def _legs(poses: JointPoses, match: JointMatch, skeleton: Skeleton | None) -> tuple[float, float]:
    """Length of the legs that the joints have, and of the same parts of a skeleton's."""
    ours, theirs = 0.0, np.zeros(len(poses.positions))
    for side, prefix in (("Left", "l"), ("Right", "r")):
        for start, end, bone in (("Hip", "Knee", "hip"), ("Knee", "Ankle", "knee")):
            if (s := match.roles.get(side + start)) is None or (e := match.roles.get(side + end)) is None:
                continue
            theirs += np.linalg.norm(poses.positions[:, e] - poses.positions[:, s], axis=-1)
            if skeleton is not None:
                ours += float(skeleton.lengths[skeleton.bone(f"{prefix}_{bone}")])
    return float(np.median(theirs)), ours


def _stands(poses: JointPoses, match: JointMatch) -> bool:
    """Whether the joints' turns are those from a person that stands facing +x."""
    links = dict(zip(match.parallel, _rest_links(poses, match), strict=True))
    legs = [links[bone] for bone in ("l_hip", "r_hip", "l_knee", "r_knee") if bone in links]
    across = poses.positions[:, match.roles["LeftHip"]] - poses.positions[:, match.roles["RightHip"]]
    hips = quaternion_to_matrix(poses.rotations[:, match.roles["Hips"]])
    left = rotate(np.swapaxes(hips, -1, -2), across).mean(0)
    arms = [links[bone] for bone in ("l_shoulder", "l_sternoclavicular") if bone in links]
    sideways = left[1] > 0.8 * np.linalg.norm(left) and all(arm[1] > -0.5 for arm in arms)
    return bool(sideways and all(leg[2] < -0.7 for leg in legs))


def _rest_links(poses: JointPoses, match: JointMatch) -> Array:
    """Directions (P, 3) of the links of ``match.parallel`` with their joints at rest; zero where a link has
    no length.

    A link is carried by its start joint, so that every pose tells: averaged over all.
    """
    starts, ends = np.array(list(match.parallel.values())).T
    links = _links(poses.positions, starts, ends)
    length = np.linalg.norm(links, axis=-1, keepdims=True)
    links = np.where(length < _SHORTEST_LINK, 0.0, links / np.maximum(length, 1e-12))
    back = np.swapaxes(quaternion_to_matrix(poses.rotations[:, starts]), -1, -2)
    mean = rotate(back, links).mean(0)
    size = np.linalg.norm(mean, axis=-1, keepdims=True)
    return np.where(size < 0.05, 0.0, mean / np.maximum(size, 1e-12))


def _turns_of_positions(poses: JointPoses, match: JointMatch) -> Array:
    """Joint turns (N, J, 3, 3) of a source that has positions only: hips and what is below them as the hips
    lie, what is above as the shoulders do.
    """
    roles, points = match.roles, poses.positions

    def at(role: str) -> Array:
        return points[:, roles[role]]

    hips = (at("LeftHip") + at("RightHip")) / 2
    top = next((role for role in ("Neck", "Head", "LeftShoulder") if role in roles), "Hips")
    chest = (
        (at("LeftShoulder") + at("RightShoulder")) / 2
        if {"LeftShoulder", "RightShoulder"} <= {*roles}
        else at(top)
    )
    pelvis = _facing(at("LeftHip") - at("RightHip"), chest - hips)
    turns = np.repeat(pelvis[:, None], points.shape[1], axis=1)
    if {"LeftShoulder", "RightShoulder"} <= {*roles}:
        trunk = _facing(at("LeftShoulder") - at("RightShoulder"), chest - hips)
        for bone, joint in match.difference.items():
            if bone in ("vl5", "vt3") or "sternoclavicular" in bone:
                turns[:, joint] = trunk
    # a foot goes on from its shin: as the shin has turned by the shortest way from straight down
    for side, bone in (("Left", "l_ankle"), ("Right", "r_ankle")):
        if bone in match.difference and {f"{side}Knee", f"{side}Ankle"} <= {*roles}:
            shin = at(f"{side}Ankle") - at(f"{side}Knee")
            own = rotate(np.swapaxes(pelvis, -1, -2), -shin)
            own = unit_vectors(own)
            up = quaternion_to_matrix(from_y_axis(own[:, [1, 2, 0]]))
            order = np.eye(3)[[1, 2, 0]]
            turns[:, match.difference[bone]] = pelvis @ order.T @ up @ order
    return turns


def _facing(left: Array, up: Array) -> Array:
    """Rotations (N, 3, 3) of a body (x forward, y left, z up) whose left and up are near these (N, 3)."""
    y = unit_vectors(left)
    x = unit_vectors(np.cross(y, up))
    return np.stack([x, y, np.cross(x, y)], axis=-1)


def has_turns(poses: JointPoses) -> bool:
    """Whether a source says how its joints turn: not if all its rotations are the same, or none at all."""
    rotations = poses.rotations
    if not (np.linalg.norm(rotations, axis=-1) > 0.5).all():
        return False
    cosine = np.abs((rotations * rotations[:1, :1]).sum(-1))
    return bool((cosine < np.cos(_NO_TURN / 2) - 1e-12).any())


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


def sole_heights(skeleton: Skeleton, posed: Array) -> Array:
    """World heights (..., 4) of the toes and heels of both feet."""
    heights = sole_points(skeleton, posed)[..., 2]
    return heights.reshape(*heights.shape[:-2], 4)


def sole_points(skeleton: Skeleton, posed: Array) -> Array:
    """World positions (..., 2, 2, 3) of what the left and right foot stand on, toe and heel: at height 0 at
    rest.
    """
    points = []
    for name in ("l_ankle", "r_ankle"):
        bone = skeleton.bone(name)
        head, tail = skeleton.heads[bone], skeleton.tails[bone]
        for point in ((tail[0], 0.0, tail[2]), (head[0], 0.0, head[2] - 0.04)):
            offset = skeleton.rest_inverse[bone] @ np.array([*point, 1.0])
            points.append((posed[..., bone, :, :] @ offset)[..., :3])
    stacked = np.stack(points, axis=-2)
    return stacked.reshape(*stacked.shape[:-2], 2, 2, 3)
