"""Poses of the people over a whole export, and their BVH files."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace

import numpy as np

from humansim_ros.errors import warn_about
from humansim_ros.export.writer import ExportFolder, ExportFrame, FormatWriter, Record
from humansim_ros.humans.human import Human
from humansim_ros.motion.bvh import write_bvh
from humansim_ros.motion.posed_bones import PosedBones
from humansim_ros.rotations import quaternion_to_matrix, transform
from humansim_ros.types import Array

#: Sizes that differ by less are the same up to rounding.
_SAME_SIZE = 1e-6


@dataclass(frozen=True)
class AnimatedHuman:
    """A human with its pose in F frames.

    Attributes:
        human: Mesh, skeleton, weights and outfit.
        bones: Posed bone frames (F, B, 4, 4) in ``map``, as in ``HumanState.joints[:B]``.
        sizes: Scale of the body (F,) by keyframes, as ``HumanState.size``.
    """

    human: Human
    bones: Array
    sizes: Array


def posed_bones(name: str, person: AnimatedHuman, frame_time: float) -> PosedBones:
    """Posed bones for BVH files, whose bones have constant lengths: those of the first frame.

    Warns (HumansimWarning) if keyframes change the size of the person. ``name``: of the person, for the
    warning. ``frame_time``: seconds.
    """
    skeleton, size = person.human.skeleton, float(person.sizes[0])
    if np.ptp(person.sizes) > _SAME_SIZE:
        warn_about(
            f"{name}.bvh", f"the size of {name} changes, which BVH cannot hold: bones keep their first length"
        )
    scaled = replace(skeleton, heads=skeleton.heads * size, tails=skeleton.tails * size)
    return PosedBones(scaled, person.bones, frame_time)


class PoseWriter(FormatWriter):
    """Base of writers that need the bones of all frames."""

    def frame(self, frame: ExportFrame, folder: ExportFolder) -> Record:
        """Pose of each person: heads and rotations of the bones, and size."""
        record = {}
        for name, state in frame.frame.humans.items():
            bones = len(self.settings.scene.humans[name].skeleton)
            record[name] = [state.positions[:bones], state.rotations[:bones], state.size]
        return record

    def people(self, records: Iterable[tuple[int, Record]]) -> dict[str, AnimatedHuman]:
        """People with their poses in all frames."""
        frames: dict[str, list[list[Array]]] = {}
        for _, record in records:
            for name, parts in record.items():
                frames.setdefault(name, []).append([np.asarray(part, dtype=float) for part in parts])
        people = {}
        for name, poses in frames.items():
            heads, rotations, sizes = (np.array(parts) for parts in zip(*poses, strict=True))
            bones = transform(quaternion_to_matrix(rotations), heads)
            people[name] = AnimatedHuman(self.settings.scene.humans[name], bones, sizes)
        return people


class BvhWriter(PoseWriter):
    """A BVH file for each person: the skeleton of its body with the motion that was put on it."""

    def finish(self, records: Iterable[tuple[int, Record]], folder: ExportFolder) -> None:
        """Write all files."""
        for name, person in self.people(records).items():
            motion = posed_bones(name, person, 1.0 / self.settings.rate).to_motion()
            with folder.path(f"{name}.bvh") as path:
                write_bvh(path, motion)
