"""Limbs of PCP, as the evaluations on Shelf and Campus count them [Belagiannis 2014]."""

from __future__ import annotations

from collections.abc import Sequence

from humansim_ros.evaluate.joint_pairs import body_joint

#: An end of a limb: a joint, or joints of which it is the middle.
LimbEnd = tuple[int, ...]
#: Ends of each limb by group, joints of the package's skeleton.
_LIMBS = {
    "upper arms": (("l_shoulder", "l_elbow"), ("r_shoulder", "r_elbow")),
    "lower arms": (("l_elbow", "l_wrist"), ("r_elbow", "r_wrist")),
    "upper legs": (("l_hip", "l_knee"), ("r_hip", "r_knee")),
    "lower legs": (("l_knee", "l_ankle"), ("r_knee", "r_ankle")),
    "torso": (("l_hip r_hip", "vt3"),),
    "head": (("vt3", "vt3_end"),),
}


def limbs_of(names: Sequence[str]) -> tuple[tuple[str, ...], list[tuple[LimbEnd, LimbEnd]]]:
    """Limbs whose ends are among joints.

    Returns:
        Group of each limb, such as "upper arms", and the joints at its two ends.
    """
    places = {body_joint(name): index for index, name in reversed(list(enumerate(names)))}
    groups: list[str] = []
    limbs: list[tuple[LimbEnd, LimbEnd]] = []
    for group, members in _LIMBS.items():
        for start, end in members:
            ends = [tuple(places.get(joint, -1) for joint in each.split()) for each in (start, end)]
            if all(index >= 0 for each in ends for index in each):
                groups.append(group)
                limbs.append((ends[0], ends[1]))
    return tuple(groups), limbs
