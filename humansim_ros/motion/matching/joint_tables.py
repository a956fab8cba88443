"""Joint tables (YAML): the joint names of a family of motion files, their roles and the bones they drive."""

from __future__ import annotations

import functools
import os
import re
from collections.abc import Mapping, Sequence
from typing import Any

import yaml
from pydantic import model_validator

from humansim_ros.errors import MotionError, unknown
from humansim_ros.files.reading import read_bytes, resource_path
from humansim_ros.files.yaml import MAX_BYTES, Section, read_yaml, validated
from humansim_ros.motion.body.skeleton import hanim_skeleton

#: Required roles. Without them, height, facing and place of a person are unknown.
REQUIRED_ROLES = ("Hips", "LeftHip", "LeftKnee", "RightHip", "RightKnee")
#: Role -> roles that replace it if the file has no joint for it, best first.
FALLBACK_ROLES = {"Spine": ("Chest", "Hips"), "Chest": ("Spine", "Hips"), "Head": ("Neck", "Chest", "Spine")}
#: Default links of the bones: roles of the joints at the start and the end of a link, without the side.
_LINKS = {
    "sternoclavicular": ("Collar", "Shoulder"),
    "shoulder": ("Shoulder", "Elbow"),
    "elbow": ("Elbow", "Wrist"),
    "wrist": ("Wrist", "Fingers"),
    "hip": ("Hip", "Knee"),
    "knee": ("Knee", "Ankle"),
}
#: Bone -> role of the joint with the rotation that the bone takes by default.
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
#: Prefixes that programs put before the joint names of a character.
_PREFIX = re.compile(r"^(.*:|mixamorig\d*|character\d*_|robot_|bip\d+[ _]?)", re.IGNORECASE)
#: Patterns for left in joint names, each with the text for right in the same place.
_SIDES = (
    (r"left", "right"),
    (r"(?<![a-zA-Z])l(?=[_. -])", "r"),
    (r"(?<=[_. :-])l(?![a-zA-Z])", "r"),
    (r"(?<![A-Za-z])l(?=[A-Z])", "r"),
)


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
            if str(role).startswith("Left") and right not in joints and isinstance(names, list):
                mirrored = [other for name in names if (other := right_name(str(name))) is not None]
                if mirrored:
                    joints[right] = mirrored
        parallel, difference = (dict(data.get(key) or {}) for key in ("parallel", "difference"))
        links, drivers = _default_drivers(joints)
        for bone, link in links.items():
            if bone not in difference:
                parallel.setdefault(bone, link)
        for bone, role in drivers.items():
            if bone not in parallel:
                difference.setdefault(bone, role)
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


#: Most names with cached keys: the names of all tables and of some motions.
_MAX_KEYS = 1 << 13


@functools.cache
def built_in_tables() -> tuple[JointTable, ...]:
    """Tables of the package (config/joint_names). They are not checked here: a test checks their keys as
    :func:`load_table` does."""
    loader = getattr(yaml, "CSafeLoader", yaml.SafeLoader)  # seven times faster than the loader that checks
    files = sorted(resource_path("config/joint_names").glob("*.yaml"))
    contents = (read_bytes(file, MotionError, "joint table", MAX_BYTES) for file in files)
    return tuple(JointTable.model_validate(yaml.load(content, loader)) for content in contents)


@functools.lru_cache(_MAX_KEYS)
def plain_name(joint: str) -> str:
    """Name of a joint without the namespace of a program (``mixamorig:Hips`` -> ``Hips``)."""
    return _PREFIX.sub("", joint) or joint


@functools.lru_cache(_MAX_KEYS)
def comparison_key(joint: str) -> str:
    """Name of a joint for comparisons: without namespace, case, blanks and punctuation."""
    return re.sub(r"[\s._-]+", "", plain_name(joint)).casefold()


def right_name(joint: str) -> str | None:
    """Name of the counterpart of a left joint on the right. None if the name has no word for left."""
    for left, right in _SIDES:
        flags = 0 if "[A-Z])" in left else re.IGNORECASE

        def mirrored(match: re.Match[str], right: str = right) -> str:
            text = match.group()
            return right.upper() if text.isupper() else right.title() if text[0].isupper() else right

        other = re.sub(left, mirrored, joint, count=1, flags=flags)
        if flags == 0 and other == joint:
            other = re.sub(left.replace("l(?=", "L(?="), "R", joint, count=1)
        if other != joint:
            return other
    return None


def _default_drivers(joints: Mapping[str, Any]) -> tuple[dict[str, tuple[str, str]], dict[str, str]]:
    """Default links and drivers of the bones, for the roles of a table."""
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
        known = next((r for r in (role, *FALLBACK_ROLES.get(role, ())) if r in joints), None)
        if known is not None:
            drivers[bone] = known
    return links, drivers
