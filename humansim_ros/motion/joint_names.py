"""Which joint of a motion drives which bone: name tables (YAML) and how they are found for a file."""

from __future__ import annotations

import os
import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import yaml
from pydantic import BaseModel, ConfigDict, ValidationError, model_validator

from humansim_ros.body.skeleton import hanim_skeleton
from humansim_ros.errors import MotionError
from humansim_ros.files import atomic_path, read_text
from humansim_ros.motion.bvh import Motion
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
_PREFIX = re.compile(r"^(.*:|mixamorig\d*)")


class JointTable(BaseModel):
    """A name table. ``joints``: role -> the names it occurs under. ``parallel``: bone -> (start role, end
    role).

    ``difference``: bone -> role of the joint whose turn from the motion's rest pose the bone takes (thesis
    7.2).
    """

    model_config = ConfigDict(extra="forbid", frozen=True)

    name: str
    joints: Mapping[str, Sequence[str]]
    parallel: Mapping[str, tuple[str, str]]
    difference: Mapping[str, str]

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


@dataclass(frozen=True)
class JointMatch:
    """A table applied to the joints of one motion: joint indices instead of names.

    ``parallel``: bone -> (start joint, end joint). ``difference``: bone -> joint. ``roles``: role -> joint.
    ``missing``: bones of the table whose joints the motion lacks; they stay as at rest.
    """

    table: str
    parallel: Mapping[str, tuple[int, int]]
    difference: Mapping[str, int]
    roles: Mapping[str, int]
    missing: tuple[str, ...]
    by: Literal["names", "shape", "given"] = "names"
    confidence: float = 1.0

    @property
    def complete(self) -> bool:
        return all(bone in self.parallel or bone in self.difference for bone in REQUIRED_BONES)


def plain_name(joint: str) -> str:
    """A joint's name without the namespace a program put before it (``mixamorig:Hips`` -> ``Hips``)."""
    return _PREFIX.sub("", joint) or joint


def load_table(path: str | os.PathLike[str]) -> JointTable:
    """Read a joint table (YAML); MotionError with file and key if it is not one."""
    text = read_text(path, MotionError, "joint table")
    try:
        return JointTable.model_validate(yaml.safe_load(text))
    except yaml.YAMLError as reason:
        raise MotionError(f"not valid YAML: {reason}", path=path) from None
    except ValidationError as reason:
        first = reason.errors()[0]
        key = ".".join(map(str, first["loc"]))
        raise MotionError(first["msg"].removeprefix("Value error, "), path=path, key=key or None) from None


def built_in_tables() -> list[JointTable]:
    """The tables that come with the package (config/joint_names)."""
    return [load_table(path) for path in sorted(resource_path("config/joint_names").glob("*.yaml"))]


def match_table(table: JointTable, joint_names: Sequence[str]) -> JointMatch:
    """Find the joints of a table among the joints of a motion."""
    index = {plain_name(name): number for number, name in reversed(list(enumerate(joint_names)))}

    def find(names: Iterable[str]) -> int | None:
        return next((index[name] for name in names if name in index), None)

    roles = {role: joint for role, names in table.joints.items() if (joint := find(names)) is not None}
    for role in {role for link in table.parallel.values() for role in link} - set(table.joints):
        base = roles.get(role.removesuffix("_end"))
        if base is not None and (joint := find([plain_name(joint_names[base]) + "_end"])) is not None:
            roles[role] = joint
    parallel = {b: (roles[s], roles[e]) for b, (s, e) in table.parallel.items() if s in roles and e in roles}
    difference = {bone: roles[role] for bone, role in table.difference.items() if role in roles}
    bones = (*table.parallel, *table.difference)
    missing = tuple(bone for bone in bones if bone not in parallel and bone not in difference)
    return JointMatch(table.name, parallel, difference, roles, missing)


def find_match(
    joint_names: Sequence[str],
    table: str | os.PathLike[str] | None = None,
    path: str | os.PathLike[str] | None = None,
) -> JointMatch:
    """The joints that drive the bones: by the given table (a built-in name or a YAML file), else by the best
    built-in.

    ``path`` is the motion's file, for messages. Raises MotionError naming what is missing if no table fits.
    """
    tables = built_in_tables()
    if table is not None:
        named = [t for t in tables if t.name == os.fspath(table)]
        if not named and not Path(table).is_file():
            known = ", ".join(t.name for t in tables)
            raise MotionError(
                f"no joint table {os.fspath(table)!r}: give a YAML file or one of {known}", path=path
            )
        tables = named or [load_table(table)]
    matches = [match_table(candidate, joint_names) for candidate in tables]
    best = max(matches, key=lambda m: (m.complete, len(m.parallel) + len(m.difference), len(m.roles)))
    if not best.complete:
        lacking = [
            bone for bone in REQUIRED_BONES if bone not in best.parallel and bone not in best.difference
        ]
        shown = ", ".join(joint_names[:12]) + (", …" if len(joint_names) > 12 else "")
        raise MotionError(
            f"no joint table fits these joints ({shown}); "
            f"the nearest is {best.table!r}, which finds nothing for {', '.join(lacking)}. "
            "Copy one of config/joint_names, put your names in, and pass it as the joint table",
            path=path,
        )
    return best


def match_motion(motion: Motion, table: str | os.PathLike[str] | None = None) -> JointMatch:
    """The joints of a motion that drive the bones: by the given table, else by the best built-in."""
    return find_match(motion.joint_names, table, motion.path)


def table_text(match: JointMatch, motion: Motion) -> str:
    """The table found for a motion as YAML, to be edited and passed back as the joint table."""
    role_of = {joint: role for role, joint in reversed(list(match.roles.items()))}
    data = {
        "name": match.table,
        "joints": {role: [motion.joint_names[joint]] for role, joint in match.roles.items()},
        "parallel": {bone: [role_of[s], role_of[e]] for bone, (s, e) in match.parallel.items()},
        "difference": {bone: role_of[joint] for bone, joint in match.difference.items()},
    }
    head = f"# found by {match.by}, confidence {match.confidence:.0%}\n"
    return head + yaml.safe_dump(data, sort_keys=False, allow_unicode=True)


def write_table(match: JointMatch, motion: Motion, path: str | os.PathLike[str]) -> None:
    """Write :func:`table_text` to a file."""
    with atomic_path(path) as temporary:
        temporary.write_text(table_text(match, motion))
