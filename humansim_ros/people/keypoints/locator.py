"""Places of keypoints on a human: joints, points between joints, points of the skin."""

from __future__ import annotations

import weakref
from dataclasses import dataclass
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from humansim_ros.motion.body import JOINT_NAMES, Skeleton, dominant_bones
from humansim_ros.people.humans.human import Human, joint_surfaces
from humansim_ros.people.keypoints.sets import KeypointSet
from humansim_ros.people.keypoints.skin import MIXES, place_on_skin
from humansim_ros.types import Array, Indices

#: Names of joints that all humans have, or all humans with fingers.
_JOINTS = {joint.name for joint in JOINT_NAMES}


@dataclass(frozen=True, eq=False)
class KeypointLocator:
    """Computes the K keypoints of a set on one human, in any pose.

    Attributes:
        keypoints: The set.
        on_surface: (K,) whether the keypoint is a point of the skin.
        certain: (K,) whether its place is known exactly. On meshes from other programs, points of the skin
            are found by fitting, and are not certain. Points that a human lacks, such as fingers, are not
            certain either.
        surfaces: Part labels (K, 256) that are skin around each keypoint.
    """

    keypoints: KeypointSet
    on_surface: NDArray[np.bool_]
    certain: NDArray[np.bool_]
    surfaces: NDArray[np.bool_]
    _joint_shares: Array
    _corners: Indices
    _corner_weights: Array

    _known: ClassVar[dict[tuple[int, str], KeypointLocator]] = {}

    def __repr__(self) -> str:
        return f"KeypointLocator({self.keypoints.name!r}, {int(self.on_surface.sum())} on the skin)"

    @classmethod
    def of(cls, human: Human, keypoints: KeypointSet) -> KeypointLocator:
        """Locator of a keypoint set on a human. It is made once and cached.

        Example:
            >>> from humansim_ros.people import load_human
            >>> from humansim_ros.people import keypoint_set
            >>> KeypointLocator.of(load_human("child"), keypoint_set("coco17"))
            KeypointLocator('coco17', 5 on the skin)
        """
        key = id(human), keypoints.name
        locator = cls._known.get(key)
        if locator is None or locator.keypoints is not keypoints:
            locator = _locate(human, keypoints)
            cls._known[key] = locator
            weakref.finalize(human, cls._known.pop, key, None)
        return locator

    def positions(self, joints: Array, vertices: NDArray[np.floating]) -> Array:
        """Positions (K, 3) of the keypoints, in the space of the joints and vertices. NaN for points that the
        human lacks. ``joints``: (J, 3) in the order of the joint names of the skeleton. ``vertices``: (V, 3)
        of the mesh."""
        skin = np.einsum("nk,nkj->nj", self._corner_weights, vertices[self._corners])
        positions = np.asarray(self._joint_shares @ joints, dtype=float)
        positions[self.on_surface] = skin
        return positions


def _locate(human: Human, keypoints: KeypointSet) -> KeypointLocator:
    names = human.skeleton.joint_names
    around = joint_surfaces(human)
    shares = np.zeros((len(keypoints), len(names)))
    on_surface = np.zeros(len(keypoints), bool)
    for number, point in enumerate(keypoints.points):
        if point in names:
            shares[number, names.index(point)] = 1
        elif point in _JOINTS:  # a body without fingers: nobody knows where they are
            shares[number] = np.nan
        elif point in MIXES:
            for joint, share in MIXES[point].items():
                shares[number, names.index(joint)] = share
        else:
            on_surface[number] = True
    places = place_on_skin(human, [keypoints.points[k] for k in np.flatnonzero(on_surface)])
    surfaces = np.array(
        [around[_joints_between(human.skeleton, row)].any(axis=0) for row in np.nan_to_num(shares)]
    )
    bones = dominant_bones(human.weights)[places.corners]
    for number, own in zip(np.flatnonzero(on_surface).tolist(), bones, strict=True):
        surfaces[number, own + 1] = True
    certain = np.isfinite(shares).all(axis=1).astype(bool)
    certain[on_surface] = places.certain
    return KeypointLocator(keypoints, on_surface, certain, surfaces, shares, places.corners, places.weights)


def _joints_between(skeleton: Skeleton, shares: Array) -> list[int]:
    """Joints with a share (J,), and the heads of the bones on the way between them."""
    joints = np.flatnonzero(shares).tolist()
    ways = [_ancestors(skeleton, skeleton.joint_bones[joint]) for joint in joints]
    common = set.intersection(*map(set, ways)) if ways else set()
    # parents come before children, so the largest common ancestor is the nearest one
    nearest = max(common, default=-1)
    return sorted({*joints, *(bone for way in ways for bone in way if bone not in common or bone == nearest)})


def _ancestors(skeleton: Skeleton, bone: int) -> list[int]:
    """A bone, its parent, and so on to the root."""
    way = []
    while bone >= 0:
        way.append(bone)
        bone = int(skeleton.parents[bone])
    return way
