"""Find the joints of a motion that drive the bones of a skeleton, by name or by shape."""

from __future__ import annotations

import os
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import yaml
from numpy.typing import NDArray

from humansim_ros.errors import MotionError
from humansim_ros.io.files import atomic_path, exists
from humansim_ros.motion.bvh import Motion
from humansim_ros.motion.joint_tables import (
    CHAINS,
    REQUIRED_BONES,
    REQUIRED_ROLES,
    JointMatch,
    JointTable,
    _key,
    built_in_tables,
    load_table,
    match_roles,
    plain_name,
)

#: Deeper joints are not indented more.
_DEEPEST = 40


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
    if not named and not exists(Path(table)):
        known = ", ".join(t.name for t in tables)
        raise MotionError(
            f"no joint table {os.fspath(table)!r}: give a YAML file or one of {known}", path=path
        )
    return named or [load_table(table)]


def match_motion(motion: Motion, table: str | os.PathLike[str] | None = None) -> JointMatch:
    """The joints of a motion that drive the bones: by the given table, else by the built-in one whose names
    and kinship fit best, else by the shape of the skeleton. MotionError if it is no person.
    """
    from humansim_ros.motion.skeleton_matching import match_shape

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
