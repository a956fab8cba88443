"""Retargeted motions for other programs: all bones of all frames as BVH, NumPy arrays or JSON."""

from __future__ import annotations

import json
import os
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from humansim_ros.body.skeleton import Skeleton
from humansim_ros.errors import MotionError
from humansim_ros.io.files import atomic_path
from humansim_ros.motion.bvh import write_bvh
from humansim_ros.motion.kinematics import Motion
from humansim_ros.rotations import WORLD_FROM_BODY, matrix_to_quaternion
from humansim_ros.types import Array

SUFFIXES = (".bvh", ".npz", ".json")
_CENTIMETRES = 100.0
_ORDER = "ZXY"


@dataclass(frozen=True)
class PosedBones:
    """Posed bone frames (N, B, 4, 4) of a skeleton in ``map``, every ``frame_time`` seconds."""

    skeleton: Skeleton
    posed: Array
    frame_time: float

    @property
    def heads(self) -> Array:
        """(N, B, 3) metres."""
        return self.posed[..., :3, 3]

    @property
    def tails(self) -> Array:
        """(N, B, 3) metres."""
        return self.heads + self.posed[..., :3, 1] * self.skeleton.lengths[:, None]

    @property
    def rotations(self) -> Array:
        """Turns of the bones' frames in ``map`` (y along the bone), (N, B, 4) xyzw."""
        return matrix_to_quaternion(self.posed[..., :3, :3])

    def to_dicts(self) -> list[dict[str, dict[str, list[float]]]]:
        """Per frame: bone -> head, tail, rotation_xyzw."""
        heads, tails, turns = self.heads.tolist(), self.tails.tolist(), self.rotations.tolist()
        return [
            {
                name: {"head": head, "tail": tail, "rotation_xyzw": turn}
                for name, head, tail, turn in zip(self.skeleton.names, *frame, strict=True)
            }
            for frame in zip(heads, tails, turns, strict=True)
        ]

    def to_motion(self) -> Motion:
        """A BVH motion whose joints are the bones' heads: y up, facing +z, centimetres, rest as the
        skeleton's; end sites are the tails of the last bones.
        """
        skeleton = self.skeleton
        parents = skeleton.parents
        turns = WORLD_FROM_BODY.T @ self.posed[..., :3, :3] @ np.swapaxes(skeleton.rest[:, :3, :3], -1, -2)
        above = np.where((parents < 0)[:, None, None], np.eye(3), turns[:, parents])
        local = Rotation.from_matrix((np.swapaxes(above, -1, -2) @ turns).reshape(-1, 3, 3))
        angles = np.unwrap(local.as_euler(_ORDER, degrees=True).reshape(*turns.shape[:2], 3), 360.0, axis=0)
        places = self.heads @ WORLD_FROM_BODY * _CENTIMETRES

        turning = tuple(f"{axis}rotation" for axis in _ORDER)
        moving = ("Xposition", "Yposition", "Zposition")
        names: list[str] = []
        above_joint: list[int] = []
        offsets: list[Array] = []
        channels: list[tuple[str, ...]] = []
        values: list[Array] = []
        joint_of: dict[int, int] = {}
        for bone, parent in enumerate(parents.tolist()):
            joint_of[bone] = len(names)
            names.append(skeleton.names[bone])
            above_joint.append(joint_of[parent] if parent >= 0 else -1)
            offsets.append(skeleton.heads[bone] - (skeleton.heads[parent] if parent >= 0 else 0.0))
            channels.append(turning if parent >= 0 else moving + turning)
            values += [angles[:, bone]] if parent >= 0 else [places[:, bone], angles[:, bone]]
            if bone in skeleton.leaves:
                names.append(f"{skeleton.names[bone]}_end")
                above_joint.append(joint_of[bone])
                offsets.append(skeleton.tails[bone] - skeleton.heads[bone])
                channels.append(())
        return Motion(
            tuple(names),
            np.array(above_joint, dtype=np.intp),
            np.array(offsets) * _CENTIMETRES,
            tuple(channels),
            np.concatenate(values, axis=1),
            self.frame_time,
        )


def write_bones(path: str | os.PathLike[str], bones: PosedBones) -> None:
    """Write all frames, whole or not at all: .bvh (:meth:`PosedBones.to_motion`), .npz (``bones``,
    ``parents``, ``times``, ``heads``, ``tails``, ``rotations_xyzw``) or .json (``frame_time``, ``frames``).
    """
    check_suffix(path)
    suffix = Path(path).suffix.lower()
    if suffix == ".bvh":
        write_bvh(path, bones.to_motion())
        return
    with atomic_path(path) as temporary, temporary.open("wb") as file:
        if suffix == ".npz":
            np.savez_compressed(file, **_arrays(bones))
        else:
            data = {"frame_time": bones.frame_time, "frames": bones.to_dicts()}
            file.write(json.dumps(data, allow_nan=False).encode())


def check_suffix(path: str | os.PathLike[str]) -> None:
    """MotionError for a file of a kind that bones are not written as."""
    if Path(path).suffix.lower() not in SUFFIXES:
        raise MotionError(
            "bones are written as .bvh, .npz or .json: give the file one of these names", path=path
        )


def _arrays(bones: PosedBones) -> dict[str, Any]:
    return {
        "bones": np.array(bones.skeleton.names),
        "parents": bones.skeleton.parents,
        "times": np.arange(len(bones.posed)) * bones.frame_time,
        "heads": bones.heads,
        "tails": bones.tails,
        "rotations_xyzw": bones.rotations,
    }
