"""Match the joints of a motion to the bones of a skeleton: by names, or else by shape."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path

from humansim_ros.errors import MotionError, did_you_mean
from humansim_ros.io.files import exists
from humansim_ros.motion.animals import look_at_body
from humansim_ros.motion.joint_keys import loose_keys, loose_table_key
from humansim_ros.motion.joint_match import MIN_CONFIDENCE, REQUIRED_BONES, JointMatch, match_roles
from humansim_ros.motion.joint_tables import (
    REQUIRED_ROLES,
    JointTable,
    built_in_tables,
    comparison_key,
    load_table,
    plain_name,
)
from humansim_ros.motion.kinematics import Motion
from humansim_ros.motion.skeleton_matching import match_shape
from humansim_ros.types import Indices

#: Table of common names, which is used where no other fits.
_COMMON = "common"
#: Chains of roles: the joint of each is a descendant of the joint before it.
_CHAINS = (
    ("Hips", "LeftHip", "LeftKnee", "LeftAnkle", "LeftToe"),
    ("Hips", "RightHip", "RightKnee", "RightAnkle", "RightToe"),
    ("LeftCollar", "LeftShoulder", "LeftElbow", "LeftWrist", "LeftFingers"),
    ("RightCollar", "RightShoulder", "RightElbow", "RightWrist", "RightFingers"),
    ("Spine", "Chest", "Neck", "Head", "HeadTop"),
)


def match_motion(
    motion: Motion,
    table: str | os.PathLike[str] | None = None,
    min_confidence: float | None = None,
) -> JointMatch:
    """Match the joints of a motion to bones.

    By ``table`` (the name of a built-in table or a YAML file); else by the built-in table whose names and
    hierarchy fit best; else by the shape of the skeleton. Signs of an animal lower the confidence.

    Raises:
        MotionError: The table does not fit, or the motion is not that of a person: its confidence is below
            ``min_confidence`` (by default 0.12).
    """
    min_confidence = MIN_CONFIDENCE if min_confidence is None else min_confidence
    try:
        match = match_names(motion.joint_names, table, motion.path, motion.parents)
    except MotionError as by_names:
        if table is not None:
            raise
        by_shape = match_shape(motion, min_confidence)
        if by_shape is None:
            message = f"{by_names.message}. Nor has the skeleton the shape of a person"
            raise MotionError(message, path=motion.path) from None
        match = by_shape
    signs = look_at_body(motion, match.roles)
    if signs is not None and signs.plausibility < 1:
        # reasons alone refuse nobody
        least = 0.0 if signs.is_animal else min(match.confidence, MIN_CONFIDENCE)
        confidence = max(match.confidence * signs.plausibility, least)
        match = replace(match, confidence=confidence, reasons=signs.reasons)
    if match.confidence < min_confidence:
        raise MotionError(
            "this is not a person"
            + (f" but rather an animal: {', '.join(match.reasons)}" if match.reasons else "")
            + f" (confidence {match.confidence:.1%}, below {min_confidence:.0%}). To play it nevertheless, "
            "set min_confidence to 0 (--min-confidence 0)",
            path=motion.path,
        )
    return match


def match_names(
    joint_names: Sequence[str],
    table: str | os.PathLike[str] | None = None,
    path: str | os.PathLike[str] | None = None,
    parents: Indices | None = None,
) -> JointMatch:
    """Match joints to bones by their names.

    Args:
        joint_names: Names of J joints.
        table: Name of a built-in joint table, or a YAML file; None: the built-in table that fits best.
        path: File of the motion, for messages.
        parents: (J,) parent of each joint, where known. Joints that contradict the hierarchy do not match.

    Raises:
        MotionError: No table fits; the message names the bones and roles without joints.
    """
    tables = _candidates(table, path)
    best = _best_match(tables, joint_names, parents)
    if not best.complete:
        loose = _best_match(tables, joint_names, parents, loose=True)
        best = loose if loose.complete else best

    if not best.complete:
        lacking = [
            bone for bone in REQUIRED_BONES if bone not in best.parallel and bone not in best.difference
        ]
        lacking += [role for role in REQUIRED_ROLES if role not in best.roles]
        shown = ", ".join(joint_names[:12]) + (", …" if len(joint_names) > 12 else "")
        raise MotionError(
            f"no joint table fits these joints ({shown}); "
            f"the nearest is {best.table!r}, which finds nothing for {', '.join(lacking)}. "
            "Copy one of config/joint_names, put your names in, and pass it as the joint table",
            path=path,
        )
    return best if table is None else replace(best, by="given")


def _best_match(
    tables: Sequence[JointTable], joint_names: Sequence[str], parents: Indices | None, loose: bool = False
) -> JointMatch:
    """Match by the table that fits best. Exactly spelt, the table of common names yields to all others."""
    matches = [match_table(candidate, joint_names, parents, loose) for candidate in tables]
    present = {comparison_key(name) for name in joint_names}

    def fit(pair: tuple[JointTable, JointMatch]) -> tuple[bool, bool, int, int, int, float]:
        candidate, match = pair
        hints = sum(comparison_key(hint) in present for hint in candidate.hints)
        named = sum(role in match.roles for role in candidate.joints)
        return (
            match.complete,
            loose or candidate.name != _COMMON,
            len(match.parallel) + len(match.difference),
            hints,
            named,
            named / len(candidate.joints),
        )

    return max(zip(tables, matches, strict=True), key=fit)[1]


def match_table(
    table: JointTable, joint_names: Sequence[str], parents: Indices | None = None, loose: bool = False
) -> JointMatch:
    """Match joints to bones by one table.

    Args:
        table: Joint table.
        joint_names: Names of J joints.
        parents: (J,) parent of each joint, where known; joints that contradict their role are left out.
        loose: Compare names without what all joints begin or end with, and in any spelling of the sides.
    """
    roles = _loose_roles(table, joint_names) if loose else _named_roles(table, joint_names)
    if parents is not None:
        roles = _consistent_roles(roles, parents)
    ends = {name: number for number, name in enumerate(joint_names)}
    for role in sorted({role for link in table.parallel.values() for role in link} - set(table.joints)):
        base = roles.get(role.removesuffix("_end"))
        if base is not None and (joint := ends.get(f"{joint_names[base]}_end")) is not None:
            roles[role] = joint
    return match_roles(table, roles, joint_names)


def _named_roles(table: JointTable, joint_names: Sequence[str]) -> dict[str, int]:
    """Joint of each role of a table: the first of its names that is there, exactly or nearly so."""
    numbered = list(reversed(list(enumerate(joint_names))))
    exact = {plain_name(name): number for number, name in numbered}
    similar = {comparison_key(name): number for number, name in numbered}
    roles = {}
    for role, names in table.joints.items():
        joints = (exact.get(name, similar.get(comparison_key(name))) for name in names)
        roles[role] = next((joint for joint in joints if joint is not None), None)
    return {role: joint for role, joint in roles.items() if joint is not None}


def _loose_roles(table: JointTable, joint_names: Sequence[str]) -> dict[str, int]:
    """As :func:`_named_roles`, in any spelling of the sides. Right sides are spelt as the left ones."""
    joint_of = {key: number for number, key in reversed(list(enumerate(loose_keys(tuple(joint_names)))))}
    roles = {}
    for role, names in table.joints.items():
        left = f"Left{role[5:]}" if role.startswith("Right") else role
        keys = [loose_table_key(left, name) for name in table.joints.get(left, names)]
        if left != role:
            keys = [key.replace("left", "right", 1) for key in keys]
        roles[role] = next((joint_of[key] for key in keys if key in joint_of), None)
    return {role: joint for role, joint in roles.items() if joint is not None}


def _consistent_roles(roles: Mapping[str, int], parents: Indices) -> dict[str, int]:
    """Roles without those whose joint does not descend from the joint before it in a chain."""
    consistent = dict(roles)
    for chain in _CHAINS:
        above: str | None = None
        for role in chain:
            if role not in consistent:
                continue
            same = role == "Chest" and above is not None and consistent[role] == consistent[above]
            if (
                above is not None
                and not same
                and not _is_descendant(consistent[role], consistent[above], parents)
            ):
                del consistent[role]
                continue
            above = role
    return consistent


def _is_descendant(joint: int, ancestor: int, parents: Indices) -> bool:
    while joint >= 0 and joint != ancestor:
        joint = int(parents[joint])
        if joint == ancestor:
            return True
    return False


def _candidates(
    table: str | os.PathLike[str] | None, path: str | os.PathLike[str] | None
) -> Sequence[JointTable]:
    tables = built_in_tables()
    if table is None:
        return tables
    named = [t for t in tables if t.name == os.fspath(table)]
    if not named and not exists(Path(table)):
        name = os.fspath(table)
        known = ", ".join(t.name for t in tables) + did_you_mean(name, (t.name for t in tables))
        raise MotionError(f"no joint table {name!r}: give a YAML file or one of {known}", path=path)
    return named or [load_table(table)]
