"""Write retargeted motions for other programs: all bones of all frames as BVH, NumPy arrays or JSON."""

from __future__ import annotations

import json
import os
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from humansim_ros.errors import MotionError
from humansim_ros.files.reading import atomic_path
from humansim_ros.geometry import WORLD_FROM_BODY, matrix_to_quaternion
from humansim_ros.motion.body.kinematics import CHANNEL_NAMES, Motion
from humansim_ros.motion.body.skeleton import Skeleton
from humansim_ros.motion.files.bvh import write_bvh
from humansim_ros.types import Array

SUFFIXES = (".bvh", ".npz", ".json")
_CENTIMETRES = 100.0
#: Orders of the rotation channels: the first, and others for joints near its gimbal lock.
_ORDERS = ("ZXY", "XZY", "XYZ")
#: Least cosine of the middle angle. Below it, programs that compute with float32 lose digits.
_MIN_COSINE = 0.2


@dataclass(frozen=True)
class PosedBones:
    """Posed bone frames (N, B, 4, 4) of a skeleton in ``map``, at intervals of ``frame_time`` seconds."""

    skeleton: Skeleton
    posed: Array
    frame_time: float

    @property
    def heads(self) -> Array:
        """Heads (N, B, 3), metres."""
        return self.posed[..., :3, 3]

    @property
    def tails(self) -> Array:
        """Tails (N, B, 3), metres."""
        return self.heads + self.posed[..., :3, 1] * self.skeleton.lengths[:, None]

    @property
    def rotations(self) -> Array:
        """Rotations (N, B, 4) xyzw of the bone frames (y along the bone) in ``map``."""
        return matrix_to_quaternion(self.posed[..., :3, :3])

    def to_dicts(self) -> list[dict[str, dict[str, list[float]]]]:
        """Return a dictionary for each frame: bone -> head, tail, rotation_xyzw."""
        heads, tails, rotations = self.heads.tolist(), self.tails.tolist(), self.rotations.tolist()
        return [
            {
                name: {"head": head, "tail": tail, "rotation_xyzw": rotation}
                for name, head, tail, rotation in zip(self.skeleton.names, *frame, strict=True)
            }
            for frame in zip(heads, tails, rotations, strict=True)
        ]

    def to_motion(self) -> Motion:
        """Make a motion for BVH: y up, facing +z, centimetres, in the rest pose. Joints are the heads of
        bones. Rotations have the order ZXY, or another order for joints near the gimbal lock of ZXY."""
        skeleton = self.skeleton
        parents = skeleton.parents
        rest = skeleton.rest[:, :3, :3]
        rotations = WORLD_FROM_BODY.T @ self.posed[..., :3, :3] @ np.swapaxes(rest, -1, -2)
        above = np.where((parents < 0)[:, None, None], np.eye(3), rotations[:, parents])
        local = Rotation.from_matrix((np.swapaxes(above, -1, -2) @ rotations).reshape(-1, 3, 3))
        matrices = local.as_matrix().reshape(rotations.shape)
        orders = [_order(matrices[:, bone], along) for bone, along in enumerate(_directions(skeleton))]
        turns = (Rotation.from_matrix(matrices[:, bone]) for bone in range(len(orders)))
        of_bones = [turn.as_euler(order, degrees=True) for turn, order in zip(turns, orders, strict=True)]
        angles = np.unwrap(np.stack(of_bones, axis=1), 360.0, axis=0)
        positions = self.heads @ WORLD_FROM_BODY * _CENTIMETRES

        joints: list[tuple[str, int, Array, tuple[str, ...]]] = []  # name, parent, OFFSET, channels
        values: list[Array] = []
        joint_of: dict[int, int] = {}
        for bone, parent in enumerate(parents.tolist()):
            joint_of[bone] = len(joints)
            name, head = skeleton.names[bone], skeleton.heads[bone]
            channels = tuple(f"{axis}rotation" for axis in orders[bone])
            if parent < 0:
                channels = CHANNEL_NAMES[:3] + channels
                values.append(positions[:, bone])
            values.append(angles[:, bone])
            origin = skeleton.heads[parent] if parent >= 0 else np.zeros(3)
            joints.append((name, joint_of.get(parent, -1), head - origin, channels))
            if bone in skeleton.ends:
                joints.append((f"{name}_end", joint_of[bone], skeleton.tails[bone] - head, ()))
        names, joint_parents, offsets, all_channels = zip(*joints, strict=True)
        return Motion(
            names,
            np.array(joint_parents, dtype=np.intp),
            np.array(offsets) * _CENTIMETRES,
            all_channels,
            np.concatenate(values, axis=1),
            self.frame_time,
        )


def _directions(skeleton: Skeleton) -> Array:
    """Direction (B, 3) of each bone as programs draw the bone: to its end, or to the mean of its children."""
    ends = skeleton.tails.copy()
    for bone in set(skeleton.parents.tolist()) - {-1, *skeleton.ends}:
        ends[bone] = skeleton.heads[skeleton.parents == bone].mean(axis=0)
    return ends - skeleton.heads


def _order(rotations: Array, along: Array) -> str:
    """Choose the order of the angles of a joint: the first order that stays away from gimbal lock, else the
    best.

    With the middle axis b and the outer axes a and c, the element (a, c) of a rotation is the sine of the
    middle angle. Before Blender computes angles, it turns the rotations to the axes of the bone, where y is
    along the bone. There, the outer axes are exchanged.

    ``rotations``: (N, 3, 3), relative to the rest pose. ``along``: (3,) direction of the bone at rest.
    """
    # the shortest rotation, since there is one vector only
    to_bone = Rotation.align_vectors(along[None], [[0.0, 1.0, 0.0]])[0].as_matrix()
    both = np.concatenate([rotations, to_bone.T @ rotations @ to_bone])

    def cosine(order: str) -> float:
        first, last = ("XYZ".index(order[place]) for place in (0, 2))
        sine = np.abs(both[:, [first, last], [last, first]]).max()
        return float(np.sqrt(max(0.0, 1.0 - sine**2)))

    cosines = {order: cosine(order) for order in _ORDERS}
    clear = (order for order, value in cosines.items() if value >= _MIN_COSINE)
    return next(clear, max(cosines, key=cosines.__getitem__))


def write_bones(path: str | os.PathLike[str], bones: PosedBones) -> None:
    """Write all frames to a file. If an error occurs, no file is written. ``.bvh``:
    :meth:`PosedBones.to_motion`. ``.npz``: arrays ``bones``, ``parents``, ``times``, ``heads``, ``tails``,
    ``rotations_xyzw``. ``.json``: ``frame_time`` and ``frames`` (:meth:`PosedBones.to_dicts`)."""
    check_suffix(path)
    suffix = Path(path).suffix.lower()
    if suffix == ".bvh":
        write_bvh(path, bones.to_motion())
        return
    with atomic_path(path) as temporary, temporary.open("wb") as file:
        if suffix == ".npz":
            np.savez_compressed(
                file,
                bones=np.array(bones.skeleton.names),
                parents=bones.skeleton.parents,
                times=np.arange(len(bones.posed)) * bones.frame_time,
                heads=bones.heads,
                tails=bones.tails,
                rotations_xyzw=bones.rotations,
            )
        else:
            data = {"frame_time": bones.frame_time, "frames": bones.to_dicts()}
            file.write(json.dumps(data, allow_nan=False).encode())


def check_suffix(path: str | os.PathLike[str]) -> None:
    """Raise MotionError if bones cannot be written to a file with this suffix."""
    if Path(path).suffix.lower() not in SUFFIXES:
        text = "bones are written as .bvh, .npz or .json: give the file one of these names"
        raise MotionError(text, path=path)
