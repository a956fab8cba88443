"""Which joint of a motion drives which bone: name tables (YAML), and how they are found for a file."""

from __future__ import annotations

import functools
import os
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, Literal

from pydantic import ValidationError, model_validator

from humansim_ros.body.skeleton import hanim_skeleton
from humansim_ros.errors import MotionError
from humansim_ros.io.schema import Section
from humansim_ros.io.yaml import read_yaml, validation_error
from humansim_ros.resources import resource_path

#: Without these bones nobody would call the result a person moving.
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
#: Without these joints nobody could say how tall the person is, where it faces and where it stands.
REQUIRED_ROLES = ("Hips", "LeftHip", "LeftKnee", "RightHip", "RightKnee")
#: Chains of roles, each a descendant of the one before wherever a file has both.
CHAINS = (
    ("Hips", "LeftHip", "LeftKnee", "LeftAnkle", "LeftToe"),
    ("Hips", "RightHip", "RightKnee", "RightAnkle", "RightToe"),
    ("LeftCollar", "LeftShoulder", "LeftElbow", "LeftWrist", "LeftFingers"),
    ("RightCollar", "RightShoulder", "RightElbow", "RightWrist", "RightFingers"),
    ("Spine", "Chest", "Neck", "Head", "HeadTop"),
)
#: Links and drivers of the bones where a table says nothing else.
_LINKS = {
    "sternoclavicular": ("Collar", "Shoulder"),
    "shoulder": ("Shoulder", "Elbow"),
    "elbow": ("Elbow", "Wrist"),
    "wrist": ("Wrist", "Fingers"),
    "hip": ("Hip", "Knee"),
    "knee": ("Knee", "Ankle"),
}
_DRIVERS = {
    "HumanoidRoot": "Hips",
    "HumanoidRoot_to_l_hip": "Hips",
    "HumanoidRoot_to_r_hip": "Hips",
    "sacroiliac": "Spine",
    "vl5": "Chest",
    "vl5_to_l_sternoclavicular": "Chest",
    "vl5_to_r_sternoclavicular": "Chest",
    "vt3": "Head",
    "l_ankle": "LeftAnkle",
    "r_ankle": "RightAnkle",
}
#: What drives a bone whose own joint a file lacks.
_INSTEAD = {"Spine": ("Chest", "Hips"), "Chest": ("Spine", "Hips"), "Head": ("Neck", "Chest", "Spine")}
#: What programs put before the names of a character's joints.
_PREFIX = re.compile(r"^(.*:|mixamorig\d*|character\d*_|robot_|bip\d+[ _]?)", re.IGNORECASE)
#: Ways of saying left in joint names, and right in the same place.
_SIDES = (
    (r"left", "right"),
    (r"(?<![a-zA-Z])l(?=[_. -])", "r"),
    (r"(?<=[_. :-])l(?![a-zA-Z])", "r"),
    (r"(?<![A-Za-z])l(?=[A-Z])", "r"),
)


def other_side(name: str) -> str | None:
    """The name of a left joint's counterpart on the right; None if the name says nothing of left."""
    for left, right in _SIDES:
        flags = 0 if "[A-Z])" in left else re.IGNORECASE

        def mirrored(match: re.Match[str], right: str = right) -> str:
            found = match.group()
            return right.upper() if found.isupper() else right.title() if found[0].isupper() else right

        other = re.sub(left, mirrored, name, count=1, flags=flags)
        if flags == 0 and other == name:
            other = re.sub(left.replace("l(?=", "L(?="), "R", name, count=1)
        if other != name:
            return other
    return None


class JointTable(Section):
    """A name table. ``joints``: role -> the names it occurs under, the likeliest first.

    ``parallel``: bone -> (start role, end role). ``difference``: bone -> role of the joint whose turn from
    the motion's rest pose the bone takes (thesis 7.2). What a file leaves out of these two is the usual;
    right sides that it leaves out have the left's names, mirrored. ``hints``: names that tell this family
    from others that name their joints alike. ``source``: where the names are from.
    """

    name: str
    source: str = ""
    joints: Mapping[str, Sequence[str]]
    parallel: Mapping[str, tuple[str, str]]
    difference: Mapping[str, str]
    hints: Sequence[str] = ()

    @model_validator(mode="before")
    @classmethod
    def _the_rest_is_as_usual(cls, data: Any) -> Any:
        if not isinstance(data, Mapping) or not isinstance(data.get("joints"), Mapping):
            return data
        joints = dict(data["joints"])
        for role, names in data["joints"].items():
            right = f"Right{role[4:]}"
            if str(role).startswith("Left") and right not in joints and isinstance(names, list):
                mirrored = [other for name in names if (other := other_side(str(name))) is not None]
                if mirrored:
                    joints[right] = mirrored
        parallel, difference = (dict(data.get(key) or {}) for key in ("parallel", "difference"))
        usual, drivers = _usual(joints)
        for bone, link in usual.items():
            if bone not in difference:
                parallel.setdefault(bone, link)
        for bone, role in drivers.items():
            if bone not in parallel:
                difference.setdefault(bone, role)
        return {**data, "joints": joints, "parallel": parallel, "difference": difference}

    @model_validator(mode="after")
    def _names_are_known(self) -> JointTable:
        bones = hanim_skeleton().names
        for bone in (*self.parallel, *self.difference):
            if bone not in bones:
                raise ValueError(f"no bone {bone!r}; the bones are {', '.join(bones)}")
        for role in REQUIRED_ROLES:
            if role not in self.joints:
                raise ValueError(f"the role {role!r} is missing under 'joints'")
        ends = {f"{role}_end" for role in self.joints}
        for role in (*(r for link in self.parallel.values() for r in link), *self.difference.values()):
            if role not in self.joints and role not in ends:
                raise ValueError(f"no role {role!r} under 'joints'")
        return self


def _usual(joints: Mapping[str, Any]) -> tuple[dict[str, tuple[str, str]], dict[str, str]]:
    """Links and drivers of the bones for roles that a table has."""
    links = {}
    for side, prefix in (("Left", "l"), ("Right", "r")):
        for part, (start, end) in _LINKS.items():
            start, end = side + start, side + end
            if end not in joints and part == "wrist":
                end = f"{start}_end"
            if start in joints and (end in joints or end.endswith("_end")):
                links[f"{prefix}_{part}"] = (start, end)
    drivers = {}
    for bone, role in _DRIVERS.items():
        known = next((r for r in (role, *_INSTEAD.get(role, ())) if r in joints), None)
        if known is not None:
            drivers[bone] = known
    return links, drivers


@dataclass(frozen=True)
class JointMatch:
    """A table applied to the joints of one motion: joint indices instead of names.

    ``parallel``: bone -> (start joint, end joint). ``difference``: bone -> joint. ``roles``: role -> joint.
    ``missing``: bones that no joint drives; they stay as at rest. ``by``: how it was found; ``confidence``:
    how sure that is, 0 to 1. ``own``: bone -> joint, of a skeleton's further bones (fingers, say) that joints
    of the same names drive.
    """

    table: str
    parallel: Mapping[str, tuple[int, int]]
    difference: Mapping[str, int]
    roles: Mapping[str, int]
    missing: tuple[str, ...]
    by: Literal["names", "shape", "given"] = "names"
    confidence: float = 1.0
    own: Mapping[str, int] = field(default_factory=dict)

    def with_own(self, bone_names: Sequence[str], joint_names: Sequence[str]) -> JointMatch:
        """With the joints that drive those further bones that have their names."""
        general = set(hanim_skeleton().names)
        joints = {name: number for number, name in enumerate(joint_names)}
        own = {name: joints[name] for name in bone_names if name in joints and name not in general}
        return replace(self, own=own)

    @property
    def complete(self) -> bool:
        driven = all(bone in self.parallel or bone in self.difference for bone in REQUIRED_BONES)
        return driven and all(role in self.roles for role in REQUIRED_ROLES)


def plain_name(joint: str) -> str:
    """A joint's name without the namespace a program put before it (``mixamorig:Hips`` -> ``Hips``)."""
    return _PREFIX.sub("", joint) or joint


def _key(name: str) -> str:
    """What of a name is compared: not case, nor blanks and points between its parts."""
    return re.sub(r"[\s._-]+", "", plain_name(name)).casefold()


def load_table(path: str | os.PathLike[str]) -> JointTable:
    """Read a joint table (YAML); MotionError with file and key if it is not one."""
    data, tree = read_yaml(path, MotionError, "joint table")
    try:
        return JointTable.model_validate(data)
    except ValidationError as reason:
        raise validation_error(reason, tree, MotionError, path) from None


@functools.cache
def built_in_tables() -> tuple[JointTable, ...]:
    """The tables that come with the package (config/joint_names)."""
    return tuple(load_table(path) for path in sorted(resource_path("config/joint_names").glob("*.yaml")))


def match_roles(table: JointTable, roles: Mapping[str, int], joint_names: Sequence[str]) -> JointMatch:
    """The bones' drivers for joints whose roles are known; what has none of its own takes the next best."""
    parallel, difference = {}, {}
    ends = {name: number for number, name in enumerate(joint_names)}
    for bone, (start, end) in table.parallel.items():
        if start not in roles:
            continue
        tip = roles.get(end, ends.get(f"{joint_names[roles[start]]}_end"))
        if tip is not None:
            parallel[bone] = (roles[start], tip)
        else:
            difference[bone] = roles[start]  # no link to be parallel to: the joint's turn alone
    for bone, role in table.difference.items():
        known = next((r for r in (role, *_INSTEAD.get(role, ())) if r in roles), None)
        if known is not None:
            difference[bone] = roles[known]
    bones = (*table.parallel, *table.difference)
    missing = tuple(bone for bone in bones if bone not in parallel and bone not in difference)
    match = JointMatch(table.name, parallel, difference, roles, missing)
    return replace(match, confidence=1 - len(missing) / max(len(bones), 1))
