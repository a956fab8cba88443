"""Part labels of the skin around joints."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from humansim_ros.humans.human import Human
from humansim_ros.types import Array


def joint_surfaces(human: Human) -> NDArray[np.bool_]:
    """Part labels (J, 256) that are skin around each joint: those of the bones that meet there."""
    skeleton = human.skeleton
    with_skin = set((human.triangle_parts - 1).tolist())
    bones_of_joints: list[set[int]] = []
    for joint, bone in enumerate(skeleton.joint_bones):
        is_end = joint >= len(skeleton)
        meeting = {bone} if is_end else {bone, *_siblings(skeleton.parents, skeleton.heads, bone)}
        if not is_end and skeleton.parents[bone] >= 0:
            meeting.add(int(skeleton.parents[bone]))
        if skeleton.parents[bone] < 0:
            meeting |= set(np.flatnonzero(skeleton.parents == bone).tolist())
        # a connector bone has no skin: the bones that it connects meet here
        for bare in meeting - with_skin:
            parent = int(skeleton.parents[bare])
            meeting |= {parent, *np.flatnonzero(skeleton.parents == bare).tolist()}
            if parent >= 0 and skeleton.parents[parent] < 0:  # the pelvis is beside the connectors of thighs
                meeting |= set(_siblings(skeleton.parents, skeleton.heads, bare))
        bones_of_joints.append(meeting - {-1})
    table = np.zeros((len(bones_of_joints), 256), dtype=bool)
    for joint, bones in enumerate(bones_of_joints):
        table[joint, [bone + 1 for bone in bones]] = True
    return table


def _siblings(parents: NDArray[np.intp], heads: Array, bone: int) -> list[int]:
    same = (parents == parents[bone]) & (np.linalg.norm(heads - heads[bone], axis=1) < 1e-6)
    return [int(b) for b in np.flatnonzero(same)]
