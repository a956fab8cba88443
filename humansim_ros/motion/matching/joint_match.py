"""Joint matches: which joints of a motion drive which bones of a skeleton."""

from __future__ import annotations

import os
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Literal

import numpy as np
import yaml

from humansim_ros.files.reading import atomic_path
from humansim_ros.motion.body.kinematics import Motion
from humansim_ros.motion.body.skeleton import hanim_skeleton
from humansim_ros.motion.matching.joint_tables import FALLBACK_ROLES, REQUIRED_ROLES, JointTable, right_name
from humansim_ros.types import Indices

#: Bones that the motion of a person must drive.
REQUIRED_BONES = (
    "HumanoidRoot",
    "l_hip",
    "l_knee",
    "l_shoulder",
    "l_elbow",
    "r_hip",
    "r_knee",
    "r_shoulder",
    "r_elbow",
)
#: Bones that may lack a driver, if the motion has no joints for them.
ARM_BONES = ("l_shoulder", "l_elbow", "r_shoulder", "r_elbow")
#: A motion with a lower confidence of its match is refused, since it is not that of a person.
MIN_CONFIDENCE = 0.12
#: Scenes and commands report a confidence below this value.
LOW_CONFIDENCE = 0.7
#: Deeper joints are not indented further.
_MAX_INDENT = 40


@dataclass(frozen=True)
class JointMatch:
    """A joint table applied to the joints of a motion: joint indices instead of names.

    Attributes:
        table: Name of the table.
        parallel: Bone -> (start joint, end joint) of the link that the bone is parallel to.
        difference: Bone -> joint. The bone takes the rotation of the joint.
        roles: Role -> joint.
        missing: Bones without a driver, which stay at rest.
        by: Method of the match.
        confidence: 0 to 1.
        extra: The same as ``difference``, for bones that the general skeleton lacks.
        details: Bone of a finger, a toe, the jaw or an eye -> (start joint, end joint) of its link. The same
            joint twice means that the bone takes the rotation of the joint.

        reasons: Reasons why the motion may not be that of a person.
    """

    table: str
    parallel: Mapping[str, tuple[int, int]]
    difference: Mapping[str, int]
    roles: Mapping[str, int]
    missing: tuple[str, ...]
    by: Literal["names", "shape", "given"] = "names"
    confidence: float = 1.0
    extra: Mapping[str, int] = field(default_factory=dict)
    reasons: tuple[str, ...] = ()
    details: Mapping[str, tuple[int, int]] = field(default_factory=dict)

    def with_extra_bones(self, bone_names: Sequence[str], joint_names: Sequence[str]) -> JointMatch:
        """Match bones that the general skeleton does not have, by :attr:`details` and by equal names."""
        general = set(hanim_skeleton().names)
        joints = {name: number for number, name in enumerate(joint_names)}
        extra = {name: joints[name] for name in bone_names if name in joints and name not in general}
        present = {bone: link for bone, link in self.details.items() if bone in bone_names}
        links = {bone: (start, end) for bone, (start, end) in present.items() if start != end}
        extra |= {bone: start for bone, (start, end) in present.items() if start == end}
        extra = {bone: joint for bone, joint in extra.items() if bone not in links}
        return replace(self, extra=extra, parallel={**self.parallel, **links})

    @property
    def held(self) -> tuple[str, ...]:
        """Bones of the arms without a driver. These arms hang down."""
        return tuple(bone for bone in REQUIRED_BONES if bone in ARM_BONES and bone in self.missing)

    @property
    def warning(self) -> str | None:
        """Message about joints that the person lacks, or about a low confidence and its reasons. None if all
        is well."""
        if self.held:
            trunk = () if self.roles.keys() & {"Spine", "Chest", "Neck", "Head"} else ("trunk", "head")
            lacking = ", ".join((*trunk, *self.held))
            return (
                f"the file has no joints for {lacking}: the arms hang down"
                + " from an upright trunk" * bool(trunk)
            )
        if self.confidence >= LOW_CONFIDENCE:
            return None
        why = "".join(f"; {reason}" for reason in self.reasons)
        return (
            f"the joints of a person are matched by {self.by} with a confidence of {self.confidence:.0%}{why}"
        )

    @property
    def complete(self) -> bool:
        """Whether all required bones have drivers and all required roles have joints."""
        driven = all(bone in self.parallel or bone in self.difference for bone in REQUIRED_BONES)
        return driven and all(role in self.roles for role in REQUIRED_ROLES)


def match_roles(table: JointTable, roles: Mapping[str, int], joint_names: Sequence[str]) -> JointMatch:
    """Match bones to joints (role -> joint index). A bone without a driver of its own takes a fallback."""
    parallel, difference = {}, {}
    ends = {name: number for number, name in enumerate(joint_names)}
    for bone, (start, end) in table.parallel.items():
        if start not in roles:
            continue
        tip = roles.get(end, ends.get(f"{joint_names[roles[start]]}_end"))
        if tip is not None:
            parallel[bone] = (roles[start], tip)
        else:
            difference[bone] = roles[start]  # if there is no link, use only the rotation of the joint
    for bone, role in table.difference.items():
        known = next((r for r in (role, *FALLBACK_ROLES.get(role, ())) if r in roles), None)
        if known is not None:
            difference[bone] = roles[known]
    bones = (*table.parallel, *table.difference)
    missing = tuple(bone for bone in bones if bone not in parallel and bone not in difference)
    match = JointMatch(table.name, parallel, difference, roles, missing)
    return replace(match, confidence=1 - len(missing) / max(len(bones), 1))


def opposite_joints(names: Sequence[str], roles: Mapping[str, int]) -> Indices:
    """Index (J,) of the joint on the other side, by name and by role. A joint without an opposite joint has
    its own index."""
    pairs = np.arange(len(names))
    index = {name: number for number, name in enumerate(names)}
    lower = {name.lower(): number for name, number in index.items()}
    for number, name in enumerate(names):
        right = right_name(name)
        if right is not None and right.lower() in lower:
            pairs[number], pairs[lower[right.lower()]] = lower[right.lower()], number
    for role, joint in roles.items():
        if role.startswith("Left") and (right_joint := roles.get(f"Right{role[4:]}")) is not None:
            pairs[joint], pairs[right_joint] = right_joint, joint
    # a pair counts only if each joint is the opposite of the other
    return np.where(pairs[pairs] == np.arange(len(names)), pairs, np.arange(len(names)))


def table_text(match: JointMatch, motion: Motion) -> str:
    """Write a match as the YAML text of a joint table, which can be edited and passed back. Comments give the
    method of the match, and the joints of the motion with their roles."""
    role_of = {joint: role for role, joint in reversed(list(match.roles.items()))}

    def link(start: int, end: int) -> list[str]:
        # an end site has no role of its own
        return [role_of[start], role_of.get(end, f"{role_of[start]}_end")]

    data = {
        "name": match.table,
        "joints": {role: [motion.joint_names[joint]] for role, joint in match.roles.items()},
        "parallel": {bone: link(start, end) for bone, (start, end) in match.parallel.items()},
        "difference": {bone: role_of[joint] for bone, joint in match.difference.items()},
    }
    head = [f"found by {match.by}, confidence {match.confidence:.0%}; the joints and their roles:"]
    head += _hierarchy_lines(motion, match)
    body = yaml.safe_dump(data, sort_keys=False, allow_unicode=True)
    return "".join(f"# {line}\n" for line in head) + body


def write_table(match: JointMatch, motion: Motion, path: str | os.PathLike[str]) -> None:
    """Write :func:`table_text` to a file."""
    with atomic_path(path) as temporary:
        temporary.write_text(table_text(match, motion), encoding="utf-8")


def _hierarchy_lines(motion: Motion, match: JointMatch) -> Iterator[str]:
    """Make a line for each joint with its roles, indented by its depth."""
    depth: list[int] = []
    for joint, (name, parent) in enumerate(zip(motion.joint_names, motion.parents.tolist(), strict=True)):
        depth.append(depth[parent] + 1 if parent >= 0 else 0)
        roles = ", ".join(role for role, number in match.roles.items() if number == joint)
        printable = "".join(c if c.isprintable() else "?" for c in name)
        yield "  " * min(depth[joint], _MAX_INDENT) + printable + (f": {roles}" if roles else "")
