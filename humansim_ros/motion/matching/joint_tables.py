"""Joint tables (YAML), and matches of their joints with the joints of a motion.

A table has the joint names of a family of motion files, their roles, and the bones that they drive.
"""

from __future__ import annotations

import functools
import os
import re
from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, Literal

import numpy as np
import yaml
from pydantic import model_validator

from humansim_ros.errors import MotionError, unknown
from humansim_ros.files.reading import read_bytes, read_table, resource_path
from humansim_ros.files.yaml import MAX_BYTES, Section, read_yaml, validated
from humansim_ros.motion.body.kinematics import Motion
from humansim_ros.motion.body.skeleton import hanim_skeleton
from humansim_ros.types import Indices

#: Required roles. Without them, height, facing and place of a person are unknown.
REQUIRED_ROLES = ("Hips", "LeftHip", "LeftKnee", "RightHip", "RightKnee")
#: Default drivers of the bones: roles at the start and the end of a link, or the role of the joint with the
#: rotation that the bone takes. ``instead``: role -> roles that replace it, best first.
_USUAL = read_table("usual_drivers")
#: Left and right as a word, or as a letter of its own, in joint names.
LEFT, RIGHT = (
    re.compile(rf"{side}|(?<![a-z]){side[0]}(?=[_. -])|(?<=[_. :-]){side[0]}(?![a-z])", re.IGNORECASE)
    for side in ("left", "right")
)
#: Left in joint names, the most certain pattern first. The last one is a letter before a capital.
_LEFT = (LEFT, re.compile(r"(?<![A-Za-z])[lL](?=[A-Z])"))


class JointTable(Section):
    """A joint table.

    Attributes:
        name: Name of the table.
        source: Origin of the names.
        joints: Role -> names of the joint, the most frequent first. By default, the names of right sides are
            those of left sides, mirrored.
        parallel: Bone -> (start role, end role) of the link that the bone is parallel to.
        difference: Bone -> role of a joint. The bone takes the rotation of the joint from the rest pose of
            the motion [thesis §7.2]. By default, ``parallel`` and ``difference`` have the usual links and
            drivers.
        hints: Names that distinguish this family of files from others with the same joint names.
    """

    name: str
    source: str = ""
    joints: Mapping[str, Sequence[str]]
    parallel: Mapping[str, tuple[str, str]]
    difference: Mapping[str, str]
    hints: Sequence[str] = ()

    @model_validator(mode="before")
    @classmethod
    def _fill_defaults(cls, data: Any) -> Any:
        if not isinstance(data, Mapping) or not isinstance(data.get("joints"), Mapping):
            return data
        mappings = [data.get(key) or {} for key in ("joints", "parallel", "difference")]
        if not all(isinstance(part, Mapping) and all(isinstance(k, str) for k in part) for part in mappings):
            return data  # the schema names the fault
        joints = dict(data["joints"])
        for role, names in data["joints"].items():
            right = f"Right{role[4:]}"
            if role.startswith("Left") and right not in joints and isinstance(names, list):
                mirrored = [other for name in names if (other := right_name(str(name))) is not None]
                joints |= {right: mirrored} if mirrored else {}
        parallel, difference = (dict(data.get(key) or {}) for key in ("parallel", "difference"))
        links, drivers = _default_drivers(joints)
        parallel |= {bone: link for bone, link in links.items() if bone not in {*parallel, *difference}}
        difference |= {bone: role for bone, role in drivers.items() if bone not in {*parallel, *difference}}
        return {**data, "joints": joints, "parallel": parallel, "difference": difference}

    @model_validator(mode="after")
    def _check_names(self) -> JointTable:
        bones = hanim_skeleton().names
        for bone in (*self.parallel, *self.difference):
            if bone not in bones:
                raise ValueError(unknown("bone", bone, bones, most=80))
        for role in REQUIRED_ROLES:
            if role not in self.joints:
                raise ValueError(f"the role {role!r} is missing under 'joints'")
        ends = {f"{role}_end" for role in self.joints}
        for role in (*(r for link in self.parallel.values() for r in link), *self.difference.values()):
            if role not in self.joints and role not in ends:
                raise ValueError(f"no role {role!r} under 'joints'")
        return self


def load_table(path: str | os.PathLike[str]) -> JointTable:
    """Read a joint table (YAML). Raises MotionError, which names file and key, if the table is not valid."""
    data, tree = read_yaml(path, MotionError, "joint table")
    return validated(JointTable, data, MotionError, path, tree)


@functools.cache
def built_in_tables() -> tuple[JointTable, ...]:
    """Tables of the package (config/joint_names). This function does not check their keys; a test does."""
    loader = getattr(yaml, "CSafeLoader", yaml.SafeLoader)  # seven times faster than the loader that checks
    files = sorted(resource_path("config/joint_names").glob("*.yaml"))
    contents = (read_bytes(file, MotionError, "joint table", MAX_BYTES) for file in files)
    return tuple(JointTable.model_validate(yaml.load(content, loader)) for content in contents)


def right_name(joint: str) -> str | None:
    """Name of the counterpart of a left joint on the right. None if the name has no word for left."""

    def mirrored(left: re.Match[str]) -> str:
        text, right = left.group(), "right" if len(left.group()) > 1 else "r"
        return right.upper() if text.isupper() else right.title() if text[0].isupper() else right

    names = (pattern.sub(mirrored, joint, count=1) for pattern in _LEFT)
    return next((name for name in names if name != joint), None)


def _default_drivers(joints: Mapping[str, Any]) -> tuple[dict[str, tuple[str, str]], dict[str, str]]:
    """Default links and drivers of the bones, for the roles of a table."""
    links = {}
    for bone, (start, end) in _USUAL["links"].items():
        if bone.endswith("wrist") and end not in joints:
            end = f"{start}_end"
        if start in joints and (end in joints or end.endswith("_end")):
            links[bone] = (start, end)
    drivers = {bone: known_role(role, joints) for bone, role in _USUAL["drivers"].items()}
    return links, {bone: role for bone, role in drivers.items() if role is not None}


def known_role(role: str, known: Collection[str]) -> str | None:
    """Return the role if it is known, else the first known role that replaces it. None if there is none."""
    return next((each for each in (role, *_USUAL["instead"].get(role, ())) if each in known), None)


#: Bones that may lack a driver, if the motion has no joints for them.
ARM_BONES = ("l_shoulder", "l_elbow", "r_shoulder", "r_elbow")
#: Bones that the motion of a person must drive.
REQUIRED_BONES = ("HumanoidRoot", "l_hip", "l_knee", *ARM_BONES[:2], "r_hip", "r_knee", *ARM_BONES[2:])
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
        """Message about missing joints, or a low confidence with its reasons. None if all is well."""
        if self.held:
            trunk = () if self.roles.keys() & {"Spine", "Chest", "Neck", "Head"} else ("trunk", "head")
            lacking, where = ", ".join((*trunk, *self.held)), " from an upright trunk" if trunk else ""
            return f"the file has no joints for {lacking}: the arms hang down{where}"
        if self.confidence >= LOW_CONFIDENCE:
            return None
        why = "".join(f"; {reason}" for reason in self.reasons)
        found = f"the joints of a person are matched by {self.by}"
        return f"{found} with a confidence of {self.confidence:.0%}{why}"

    @property
    def complete(self) -> bool:
        """Whether all required bones have drivers and all required roles have joints."""
        driven = all(bone in self.parallel or bone in self.difference for bone in REQUIRED_BONES)
        return driven and all(role in self.roles for role in REQUIRED_ROLES)


def match_roles(table: JointTable, roles: Mapping[str, int], joint_names: Sequence[str]) -> JointMatch:
    """Match bones to joints. ``roles``: role -> joint. Bones without a link take the rotation of a joint."""
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
        if (known := known_role(role, roles)) is not None:
            difference[bone] = roles[known]
    bones = (*table.parallel, *table.difference)
    missing = tuple(bone for bone in bones if bone not in parallel and bone not in difference)
    match = JointMatch(table.name, parallel, difference, roles, missing)
    return replace(match, confidence=1 - len(missing) / max(len(bones), 1))


def opposite_joints(names: Sequence[str], roles: Mapping[str, int]) -> Indices:
    """Index (J,) of the joint on the other side, by name and by role, else of the joint itself."""
    pairs = np.arange(len(names))
    lower = {name.lower(): number for number, name in enumerate(names)}
    for number, name in enumerate(names):
        right = lower.get((right_name(name) or "").lower())
        if right is not None:
            pairs[number], pairs[right] = right, number
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


def _hierarchy_lines(motion: Motion, match: JointMatch) -> Iterator[str]:
    """Make a line for each joint with its roles, indented by its depth."""
    depth: list[int] = []
    for joint, (name, parent) in enumerate(zip(motion.joint_names, motion.parents.tolist(), strict=True)):
        depth.append(depth[parent] + 1 if parent >= 0 else 0)
        roles = ", ".join(role for role, number in match.roles.items() if number == joint)
        printable = "".join(c if c.isprintable() else "?" for c in name)
        yield "  " * min(depth[joint], _MAX_INDENT) + printable + (f": {roles}" if roles else "")
