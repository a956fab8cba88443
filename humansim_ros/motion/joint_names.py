"""Which joint of a motion drives which bone: name tables (YAML), and how they are found for a file."""

from __future__ import annotations

import functools
import os
import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np
import yaml
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, ValidationError, model_validator

from humansim_ros.body.skeleton import hanim_skeleton
from humansim_ros.errors import MotionError
from humansim_ros.files import atomic_path, is_there
from humansim_ros.motion.bvh import Motion
from humansim_ros.resources import resource_path
from humansim_ros.yaml_files import invalid, read_yaml

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
#: Deeper joints are not indented more.
_DEEPEST = 40
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


class JointTable(BaseModel):
    """A name table. ``joints``: role -> the names it occurs under, the likeliest first.

    ``parallel``: bone -> (start role, end role). ``difference``: bone -> role of the joint whose turn from
    the motion's rest pose the bone takes (thesis 7.2). What a file leaves out of these two is the usual;
    right sides that it leaves out have the left's names, mirrored. ``hints``: names that tell this family
    from others that name their joints alike. ``source``: where the names are from.
    """

    model_config = ConfigDict(extra="forbid", frozen=True)

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
        raise invalid(reason, tree, MotionError, path) from None


@functools.cache
def built_in_tables() -> tuple[JointTable, ...]:
    """The tables that come with the package (config/joint_names)."""
    return tuple(load_table(path) for path in sorted(resource_path("config/joint_names").glob("*.yaml")))


def match_table(
    table: JointTable, joint_names: Sequence[str], parents: NDArray[np.intp] | None = None
) -> JointMatch:
    """Find the joints of a table among the joints of a motion; those whose ``parents`` (J,) contradict their
    role are left out.
    """
    numbered = list(reversed(list(enumerate(joint_names))))
    exactly = {plain_name(name): number for number, name in numbered}
    nearly = {_key(name): number for number, name in numbered}

    def find(names: Iterable[str]) -> int | None:
        found = (exactly.get(name, nearly.get(_key(name))) for name in names)
        return next((joint for joint in found if joint is not None), None)

    roles = {role: joint for role, names in table.joints.items() if (joint := find(names)) is not None}
    if parents is not None:
        roles = _without_strangers(roles, parents)
    for role in sorted({role for link in table.parallel.values() for role in link} - set(table.joints)):
        base = roles.get(role.removesuffix("_end"))
        if base is not None and (joint := find([f"{joint_names[base]}_end"])) is not None:
            roles[role] = joint
    return match_roles(table, roles, joint_names)


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


def _without_strangers(roles: Mapping[str, int], parents: NDArray[np.intp]) -> dict[str, int]:
    """Roles without those whose joint is no descendant of the joint that it must hang on."""
    kept = dict(roles)
    for chain in CHAINS:
        above: str | None = None
        for role in chain:
            if role not in kept:
                continue
            same = role == "Chest" and above is not None and kept[role] == kept[above]
            if above is not None and not same and not _is_below(kept[role], kept[above], parents):
                del kept[role]
                continue
            above = role
    return kept


def _is_below(joint: int, ancestor: int, parents: NDArray[np.intp]) -> bool:
    while joint >= 0 and joint != ancestor:
        joint = int(parents[joint])
        if joint == ancestor:
            return True
    return False


def find_match(
    joint_names: Sequence[str],
    table: str | os.PathLike[str] | None = None,
    path: str | os.PathLike[str] | None = None,
    parents: NDArray[np.intp] | None = None,
) -> JointMatch:
    """The joints that drive the bones, by names (and kinship, where ``parents`` are known).

    By the given table (a built-in name or a YAML file), else by the best built-in.

    ``path`` is the motion's file, for messages. Raises MotionError naming what is missing if no table fits.
    """
    tables = _candidates(table, path)
    matches = [match_table(candidate, joint_names, parents) for candidate in tables]
    present = {_key(name) for name in joint_names}

    def fit(pair: tuple[JointTable, JointMatch]) -> tuple[bool, int, int, int, float]:
        candidate, match = pair
        hints = sum(_key(hint) in present for hint in candidate.hints)
        named = sum(role in match.roles for role in candidate.joints)
        return (
            match.complete,
            len(match.parallel) + len(match.difference),
            hints,
            named,
            named / len(candidate.joints),
        )

    _, best = max(zip(tables, matches, strict=True), key=fit)
    if not best.complete:
        lacking = [
            bone for bone in REQUIRED_BONES if bone not in best.parallel and bone not in best.difference
        ]
        shown = ", ".join(joint_names[:12]) + (", …" if len(joint_names) > 12 else "")
        lacking += [role for role in REQUIRED_ROLES if role not in best.roles]
        raise MotionError(
            f"no joint table fits these joints ({shown}); "
            f"the nearest is {best.table!r}, which finds nothing for {', '.join(lacking)}. "
            "Copy one of config/joint_names, put your names in, and pass it as the joint table",
            path=path,
        )
    return best if table is None else replace(best, by="given")


def _candidates(
    table: str | os.PathLike[str] | None, path: str | os.PathLike[str] | None
) -> Sequence[JointTable]:
    tables = built_in_tables()
    if table is None:
        return tables
    named = [t for t in tables if t.name == os.fspath(table)]
    if not named and not is_there(Path(table)):
        known = ", ".join(t.name for t in tables)
        raise MotionError(
            f"no joint table {os.fspath(table)!r}: give a YAML file or one of {known}", path=path
        )
    return named or [load_table(table)]


def match_motion(motion: Motion, table: str | os.PathLike[str] | None = None) -> JointMatch:
    """The joints of a motion that drive the bones: by the given table, else by the built-in one whose names
    and kinship fit best, else by the shape of the skeleton. MotionError if it is no person.
    """
    from humansim_ros.motion.shape import match_shape

    try:
        return find_match(motion.joint_names, table, motion.path, motion.parents)
    except MotionError as by_names:
        if table is not None:
            raise
        match = match_shape(motion)
        if match is None:
            message = f"{by_names.message}. Nor has the skeleton the shape of a person"
            raise MotionError(message, path=motion.path) from None
        return match


def table_text(match: JointMatch, motion: Motion) -> str:
    """The table found for a motion as YAML, to be edited and passed back as the joint table; as comments,
    how it was found and the motion's joints with their roles.
    """
    role_of = {joint: role for role, joint in reversed(list(match.roles.items()))}
    data = {
        "name": match.table,
        "joints": {role: [motion.joint_names[joint]] for role, joint in match.roles.items()},
        "parallel": {bone: [role_of[s], role_of[e]] for bone, (s, e) in match.parallel.items()},
        "difference": {bone: role_of[joint] for bone, joint in match.difference.items()},
    }
    head = [f"found by {match.by}, confidence {match.confidence:.0%}; the joints and their roles:"]
    head += _tree(motion, match)
    body = yaml.safe_dump(data, sort_keys=False, allow_unicode=True)
    return "".join(f"# {line}\n" for line in head) + body


def _tree(motion: Motion, match: JointMatch) -> Iterator[str]:
    """A line for each joint, indented by its depth, with all its roles."""
    depth: list[int] = []
    for joint, (name, parent) in enumerate(zip(motion.joint_names, motion.parents.tolist(), strict=True)):
        depth.append(depth[parent] + 1 if parent >= 0 else 0)
        roles = ", ".join(role for role, number in match.roles.items() if number == joint)
        shown = "".join(c if c.isprintable() else "?" for c in name)
        yield "  " * min(depth[joint], _DEEPEST) + shown + (f": {roles}" if roles else "")


def write_table(match: JointMatch, motion: Motion, path: str | os.PathLike[str]) -> None:
    """Write :func:`table_text` to a file."""
    with atomic_path(path) as temporary:
        temporary.write_text(table_text(match, motion), encoding="utf-8")
