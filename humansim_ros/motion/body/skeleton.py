"""Skeletons: rest pose, forward kinematics, the general H-Anim skeleton [thesis table 4.1], joint names.

All humans have the joints of the general skeleton. The built-in humans also have :data:`DETAIL_BONES`. The
names of joints in other sets come from config/joints.json (docs/joints.md).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from humansim_ros.errors import MeshError, unknown
from humansim_ros.files.mesh import LARGEST
from humansim_ros.files.reading import read_table
from humansim_ros.geometry import from_y_axis, invert_rigid, levels, quaternion_to_matrix, transform
from humansim_ros.types import Array

_TABLE = read_table("joints")
#: Joints of SMPL, in the order of their numbers.
SMPL: tuple[str, ...] = tuple(_TABLE["smpl"])
_SMPL_FINGERS = tuple(
    f"{side}_{finger}{number}"
    for side in ("left", "right")
    for finger in ("index", "middle", "pinky", "ring", "thumb")
    for number in (1, 2, 3)
)
#: Names of the joints of SMPL, SMPL+H and SMPL-X by their number.
SMPL_MODELS = {
    24: SMPL,
    52: (*SMPL[:22], *_SMPL_FINGERS),
    55: (*SMPL[:22], "jaw", "left_eye_smplhf", "right_eye_smplhf", *_SMPL_FINGERS),
}
#: Fingers of a hand in the order of their bones.
FINGERS = ("thumb", "index", "middle", "ring", "pinky")


def finger_bones(side: str) -> tuple[str, ...]:
    """Names of the 15 finger bones of a hand, three for each of :data:`FINGERS`. ``side``: l or r.

    Example:
        >>> finger_bones("l")[:4]
        ('l_thumb1', 'l_thumb2', 'l_thumb3', 'l_index1')
    """
    return tuple(f"{side}_{finger}{number}" for finger in FINGERS for number in (1, 2, 3))


#: Parents, by name, of the bones that the built-in humans have after those of the general skeleton, in their
#: order: 15 fingers of the left and of the right hand, toes, jaw and eyes (H-Anim 1.1).
DETAIL_BONES: Mapping[str, str] = {
    **{
        bone: f"{side}_wrist" if bone[-1] == "1" else f"{bone[:-1]}{int(bone[-1]) - 1}"
        for side in "lr"
        for bone in finger_bones(side)
    },
    **{f"{side}_metatarsal": f"{side}_ankle" for side in "lr"},
    **dict.fromkeys(("temporomandibular", "l_eyeball_joint", "r_eyeball_joint"), "vt3"),
}


def body_joints(names: Sequence[str]) -> list[int]:
    """Numbers of the joints that do not belong to :data:`DETAIL_BONES`, for uses without fingers.

    Example:
        >>> body_joints(["l_wrist", "l_index1", "l_index3_end", "l_wrist_end"])
        [0, 3]
    """
    return [number for number, name in enumerate(names) if name.removesuffix("_end") not in DETAIL_BONES]


#: Titles of other sets of joints, by field of :class:`JointName`.
SETS = {"hanim2": "H-Anim 2", "smpl": "SMPL", "coco": "COCO", "body_25": "OpenPose BODY_25"}


@dataclass(frozen=True)
class JointName:
    """Names of one joint.

    Attributes:
        name: Name in this package (H-Anim 1.1).
        place: Place in the body, in plain words.
        bone: Bone that turns about the joint. Empty for the end of a bone.
        hanim2: Name of a joint or site in H-Anim 2 (ISO/IEC 19774-1:2019), or None.
        smpl: Name in SMPL (in SMPL-X for fingers, jaw and eyes), or None.
        coco: Name in the 17 keypoints of COCO, or None.
        body_25: Name in BODY_25 of OpenPose, or None.
        near: Fields of the sets that only have a joint nearby, some centimetres away.
    """

    name: str
    place: str
    bone: str = ""
    hanim2: str | None = None
    smpl: str | None = None
    coco: str | None = None
    body_25: str | None = None
    near: tuple[str, ...] = ()

    def in_set(self, column: str) -> str:
        """Name in another set (a key of :data:`SETS`), with ``~`` if it is in ``near``. Empty for None."""
        name = getattr(self, column)
        return "" if name is None else f"~{name}" if column in self.near else name


#: All joints: first those of the general skeleton (trunk from below, left side, right side), then those of
#: :data:`DETAIL_BONES` with their ends.
JOINT_NAMES = tuple(JointName(**{**row, "near": tuple(row.get("near", ()))}) for row in _TABLE["joints"])


@dataclass(frozen=True, repr=False)
class Skeleton:
    """Bones in body space (metres, y up, faces +z, +x is the person's left), parents before children.

    ``names``: B names. ``parents``: (B,) parent index or -1. ``heads``, ``tails``: (B, 3). ``rolls``: (B,)
    radians, rotation of the bone frame about its y axis, as in Blender. Raises MeshError if the bones are no
    tree.
    """

    names: tuple[str, ...]
    parents: NDArray[np.intp]
    heads: Array
    tails: Array
    rolls: Array

    def __post_init__(self) -> None:
        n = len(self.names)
        shapes = (self.parents.shape, self.heads.shape, self.tails.shape, self.rolls.shape)
        if n == 0 or shapes != ((n,), (n, 3), (n, 3), (n,)):
            raise MeshError(f"a skeleton of {n} bones cannot have arrays of shapes {shapes}")
        if not all(-1 <= parent < bone for bone, parent in enumerate(self.parents)):
            raise MeshError(
                "every bone's parent must come before it; the hierarchy has a cycle or is out of order"
            )
        if not all((np.abs(part) <= LARGEST).all() for part in (self.heads, self.tails, self.rolls)):
            raise MeshError(f"a bone's head, tail or roll is not a finite number, or beyond {LARGEST:g}")
        if (np.linalg.norm(self.tails - self.heads, axis=1) < 1e-9).any():
            raise MeshError("a bone has no length: its head and tail are the same point")

    def __repr__(self) -> str:
        return f"Skeleton({len(self.names)} bones)"

    def __len__(self) -> int:
        return len(self.names)

    def bone(self, name: str) -> int:
        """Index of a bone. Raises MeshError for an unknown name."""
        try:
            return self.names.index(name)
        except ValueError:
            raise MeshError(unknown("bone", name, self.names, most=80)) from None

    @cached_property
    def lengths(self) -> Array:
        """(B,) metres from head to tail."""
        return np.asarray(np.linalg.norm(self.tails - self.heads, axis=1))

    @cached_property
    def rest(self) -> Array:
        """Bone frames at rest (B, 4, 4) in body space: origin at the head, y along the bone [thesis §9.5].

        With roll 0 the frame is the shortest rotation from +y to the bone (``bone.matrix_local`` of Blender).
        """
        swing = quaternion_to_matrix(from_y_axis((self.tails - self.heads) / self.lengths[:, None]))
        half = self.rolls / 2
        zero = np.zeros_like(half)
        roll = quaternion_to_matrix(np.stack([zero, np.sin(half), zero, np.cos(half)], axis=-1))
        return transform(swing @ roll, self.heads)

    @cached_property
    def rest_inverse(self) -> Array:
        """Inverses of :attr:`rest` (B, 4, 4)."""
        return invert_rigid(self.rest)

    @cached_property
    def rest_in_parent(self) -> Array:
        """Rest frame of each bone relative to its parent (B, 4, 4); of a root, relative to body space."""
        parent = np.where((self.parents < 0)[:, None, None], np.eye(4), self.rest_inverse[self.parents])
        return parent @ self.rest

    def pose(self, rotations: NDArray[np.float64], root: NDArray[np.float64] | None = None) -> Array:
        """Posed bone frames (..., B, 4, 4). ``rotations``: (..., B, 4) quaternions xyzw in bone space.
        ``root``: (..., 4, 4) transform of body space, such as world-from-body. If None, the identity.
        ``pose[b] = pose[parent] rest[parent]^-1 rest[b] R(q_b)`` [thesis §9.5], as Blender's armatures."""
        local = self.rest_in_parent @ transform(quaternion_to_matrix(rotations), np.zeros(3))
        first, *rest = self.levels
        batch = local.shape[:-3] if root is None else np.broadcast_shapes(local.shape[:-3], root.shape[:-2])
        out = np.array(np.broadcast_to(local, (*batch, *local.shape[-3:])))
        if root is not None:
            out[..., first, :, :] = root[..., None, :, :] @ local[..., first, :, :]
        for bones in rest:
            out[..., bones, :, :] = out[..., self.parents[bones], :, :] @ local[..., bones, :, :]
        return out

    def size_of(self, heads: Array, but: int = -1) -> float:
        """Scale of a body in any pose, relative to the rest pose. ``heads``: (B, 3) heads of the posed bones.
        ``but``: number of a bone that is left out."""
        child = np.flatnonzero((self.parents >= 0) & (np.arange(len(self)) != but))
        above = self.parents[child]
        now, rest = (np.linalg.norm(p[child] - p[above], axis=1).sum() for p in (heads, self.heads))
        size = float(now / rest) if rest > 0 else 1.0
        return 1.0 if abs(size - 1) < 1e-6 else size

    @cached_property
    def levels(self) -> tuple[NDArray[np.intp], ...]:
        """Bones by depth in the tree, roots first."""
        return levels(self.parents)

    @cached_property
    def leaves(self) -> tuple[int, ...]:
        """Bones without children."""
        return tuple(sorted(set(range(len(self))) - {int(p) for p in self.parents}))

    @cached_property
    def ends(self) -> tuple[int, ...]:
        """Bones with a tail that counts as a joint: bones without children; and head, hands and feet,
        although these may have bones of fingers, toes, jaw and eyes."""
        extremities = (bone for bone, name in enumerate(self.names) if name in _EXTREMITIES)
        return tuple(sorted({*self.leaves, *extremities}))

    @cached_property
    def wholes(self) -> NDArray[np.intp]:
        """(B,) number of the hand, foot or head that a detail belongs to; for any other bone, its own number.
        Details are fingers, toes, jaw and eyes (found by name), and the bones that they carry."""
        wholes = np.arange(len(self))
        for bone, parent in enumerate(self.parents.tolist()):
            if parent < 0:
                continue
            above = DETAIL_BONES.get(self.names[bone])
            if above in self.names[:bone]:  # past other bones of the palm
                wholes[bone] = wholes[self.names.index(above)]
            elif above is not None or wholes[parent] != parent:
                wholes[bone] = wholes[parent]
        return wholes

    @cached_property
    def detail_levels(self) -> tuple[NDArray[np.intp], ...]:
        """Fingers, toes, jaw and eyes by depth in the tree, the bones at hand, foot and head first."""
        details = (level[self.wholes[level] != level] for level in self.levels)
        return tuple(level for level in details if len(level))

    def part(self, bones: NDArray[np.intp]) -> Skeleton:
        """Keep only the bones (b,), in this order. They must include the parent of each of them."""
        place = np.full(len(self) + 1, -1)
        place[bones] = np.arange(len(bones))
        rows = (self.heads[bones], self.tails[bones], self.rolls[bones])
        return Skeleton(tuple(self.names[bone] for bone in bones), place[self.parents[bones]], *rows)

    @property
    def joint_names(self) -> tuple[str, ...]:
        """Names of the J ground-truth joints: heads of all bones, then ``<bone>_end`` of :attr:`ends`."""
        return (*self.names, *(f"{self.names[bone]}_end" for bone in self.ends))

    @property
    def joint_parents(self) -> tuple[str | None, ...]:
        """Name of the parent of each of :attr:`joint_names`; None for roots."""
        of_bones = [self.names[parent] if parent >= 0 else None for parent in self.parents]
        return (*of_bones, *(self.names[bone] for bone in self.ends))

    @property
    def joint_bones(self) -> tuple[int, ...]:
        """Bone of each of :attr:`joint_names`."""
        return (*range(len(self)), *self.ends)

    def joint_transforms(self, posed: Array) -> Array:
        """Frames of the ground-truth joints (..., J, 4, 4) from posed bone frames (..., B, 4, 4)."""
        bones = list(self.ends)
        ends = np.array(posed[..., bones, :, :])
        ends[..., :3, 3] += ends[..., :3, 1] * self.lengths[bones][:, None]
        return np.concatenate([posed, ends], axis=-3)


#: Bones with a tail that is a joint although they may have children.
_EXTREMITIES = DETAIL_BONES.keys() ^ set(DETAIL_BONES.values())


def side_of(name: str) -> int:
    """Side of the body of a bone or joint, from its H-Anim name: 1 left, -1 right, 0 neither."""
    if name.startswith("l_") or "_l_" in name:
        return 1
    return -1 if name.startswith("r_") or "_r_" in name else 0


def hanim_skeleton() -> Skeleton:
    """The general skeleton of 22 bones in T pose [thesis table 4.1], with corrected parents of the shoulders
    (config/skeleton.json). The right collar joint is not the mirror image of the left one.

    Example:
        >>> skeleton = hanim_skeleton()
        >>> len(skeleton), skeleton.names[0]
        (22, 'HumanoidRoot')
    """
    table = read_table("skeleton")
    names = tuple(row["name"] for row in table)
    return Skeleton(
        names=names,
        parents=np.array([-1 if row["parent"] is None else names.index(row["parent"]) for row in table]),
        heads=np.array([row["head"] for row in table], dtype=float),
        tails=np.array([row["tail"] for row in table], dtype=float),
        rolls=np.zeros(len(names)),
    )


#: The heel is behind the ankle by this distance, metres.
_HEEL = 0.04


def sole_points(skeleton: Skeleton, posed: Array) -> Array:
    """World positions (..., 2, 2, 3) of toe and heel of left and right foot. At rest, their height is 0."""
    points = []
    for name in ("l_ankle", "r_ankle"):
        bone = skeleton.bone(name)
        head, tail = skeleton.heads[bone], skeleton.tails[bone]
        for point in ((tail[0], 0.0, tail[2]), (head[0], 0.0, head[2] - _HEEL)):
            offset = skeleton.rest_inverse[bone] @ np.array([*point, 1.0])
            points.append((posed[..., bone, :, :] @ offset)[..., :3])
    stacked = np.stack(points, axis=-2)
    return stacked.reshape(*stacked.shape[:-2], 2, 2, 3)


def sole_heights(skeleton: Skeleton, posed: Array) -> Array:
    """World heights (..., 4) of toes and heels of both feet."""
    heights = sole_points(skeleton, posed)[..., 2]
    return heights.reshape(*heights.shape[:-2], 4)
