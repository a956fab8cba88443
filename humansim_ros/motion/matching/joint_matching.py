"""Match the joints of a motion to the bones of a skeleton: by names first, and by shape if names fail.

Names are compared in a common spelling: without a common prefix, with left and right found from pairs of
names. Animals on four legs are refused. Because a person may crawl, several signs of an animal must come
together.
"""

from __future__ import annotations

import os
import re
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path

import numpy as np

from humansim_ros.errors import MotionError, unknown
from humansim_ros.files.reading import exists
from humansim_ros.geometry import lengths_of, rotate, unit_vectors
from humansim_ros.motion.body.kinematics import Motion, refuse_cycle
from humansim_ros.motion.matching.detail_joints import detail_joints
from humansim_ros.motion.matching.joint_match import (
    ARM_BONES,
    MIN_CONFIDENCE,
    REQUIRED_BONES,
    JointMatch,
    match_roles,
)
from humansim_ros.motion.matching.joint_tables import (
    REQUIRED_ROLES,
    JointTable,
    built_in_tables,
    comparison_key,
    load_table,
    plain_name,
)
from humansim_ros.motion.matching.skeleton_matching import match_shape
from humansim_ros.types import Array, Indices

#: Most frames that are examined, spread over the motion.
_MAX_SAMPLES = 100
#: The trunk stands on the legs if the cosine of the angle between two directions (hips to shoulders, hips to
#: ankles) is at most this value.
_STANDING = -0.7
#: A body is on all fours if the trunk is not opposite to the legs, and arms and legs point to the same side.
#: These are limits of the cosines.
_TRUNK_TO_LEGS, _ARMS_TO_LEGS = -0.6, 0.3
#: Legs of an animal are shorter than the first value, as a multiple of the trunk. Its arms are longer than
#: the second, as a multiple of the legs. People have 1.5 to 2.3 and 0.54 to 0.68; dogs, cats and horses have
#: 0.7 and 0.9 to 1.0.
_SHORT_LEGS, _LONG_ARMS = 1.0, 0.8
#: A body with one sign is an animal if it is on all fours in this share of the frames. A body with two signs
#: is an animal if the trunk is opposite to the legs in less than the second share.
_FOURS, _UPRIGHT = 0.9, 0.5
#: The confidence is multiplied by the first value for an animal, and by the second for a body that may be an
#: animal.
_ANIMAL, _DOUBTFUL = 0.05, 0.5
#: Parts that a body must have on a side to be examined.
_PARTS = ("Hip", "Knee", "Shoulder", "Elbow")
_TAIL = re.compile(r"tail(?!or)", re.IGNORECASE)


@dataclass(frozen=True)
class BodySigns:
    """Signs of an animal's body.

    Attributes:
        fours: Share of the frames in which the body is on all fours, 0 to 1.
        upright: Share of the frames in which the trunk is opposite to the legs, 0 to 1.
        stands_in_offsets: Whether the OFFSETs are a body that stands upright.
        tail: Names of the joints of a tail.
        legs: Length of the legs, as a multiple of the trunk.
        arms: Length of the arms, as a multiple of the legs.
    """

    fours: float
    upright: float
    stands_in_offsets: bool
    tail: tuple[str, ...]
    legs: float
    arms: float

    @property
    def has_animal_proportions(self) -> bool:
        """Whether the legs are as short and the arms as long as those of an animal."""
        return self.legs < _SHORT_LEGS and self.arms > _LONG_ARMS

    @property
    def is_animal(self) -> bool:
        """Whether enough signs of an animal come together."""
        signs = bool(self.tail) + self.has_animal_proportions
        moves = (signs == 1 and self.fours >= _FOURS) or (signs == 2 and self.upright < _UPRIGHT)
        return moves and not self.stands_in_offsets

    @property
    def plausibility(self) -> float:
        """Factor of the confidence that this is a person. It is 1, or less if there are signs of an
        animal."""
        if self.is_animal:
            return _ANIMAL
        crawls = self.fours >= _FOURS and not self.stands_in_offsets
        return _DOUBTFUL if crawls or self.has_animal_proportions else 1.0

    @property
    def reasons(self) -> tuple[str, ...]:
        """The signs of an animal in words. Empty if the body is plausible."""
        if self.plausibility == 1:
            return ()
        reasons = []
        if self.fours >= _UPRIGHT:
            reasons.append(f"the body is on all fours in {self.fours:.0%} of the frames")
        if self.has_animal_proportions:
            reasons.append(
                f"the legs are {self.legs:.1f} times as long as the trunk (a person's: 1.5 to 2.3)"
            )
            reasons.append(f"the arms {self.arms:.1f} times as long as the legs (a person's: 0.5 to 0.7)")
        if self.tail:
            reasons.append(f"it has a tail ({', '.join(self.tail[:2])})")
        return tuple(reasons)


def look_at_body(motion: Motion, roles: Mapping[str, int]) -> BodySigns | None:
    """Look for signs of an animal in a motion with these joints (role -> joint). None if shoulders or elbows
    are unknown."""
    if not all(side + part in roles for side in ("Left", "Right") for part in _PARTS):
        return None
    points = motion.world_positions(np.unique(np.linspace(0, motion.n_frames - 1, _MAX_SAMPLES).astype(int)))
    trunk, legs, arms = _directions(points, roles)
    leg, arm = (
        _length(points, roles, limb) for limb in (("Hip", "Knee", "Ankle"), ("Shoulder", "Elbow", "Wrist"))
    )
    trunk_length = max(float(np.median(np.linalg.norm(trunk, axis=-1))), 1e-9)
    upright = _cosine(trunk, legs) < _TRUNK_TO_LEGS
    fours = ~upright & (_cosine(arms, legs) > _ARMS_TO_LEGS)
    at_rest, legs_at_rest, _ = _directions(motion.rest_positions()[None], roles)
    return BodySigns(
        fours=float(fours.mean()),
        upright=float(upright.mean()),
        stands_in_offsets=bool(_cosine(at_rest, legs_at_rest)[0] < _STANDING),
        tail=_tail(motion, roles),
        legs=leg / trunk_length,
        arms=arm / max(leg, 1e-9),
    )


def _directions(points: Array, roles: Mapping[str, int]) -> tuple[Array, Array, Array]:
    """Vectors (F, 3) of poses (F, J, 3): hips to shoulders, hips to ankles, shoulders to wrists."""

    def middle(*parts: str) -> Array:
        return np.asarray(sum(points[:, _joint(roles, side, *parts)] for side in ("Left", "Right")) / 2)

    hips, shoulders = middle("Hip"), middle("Shoulder")
    return shoulders - hips, middle("Ankle", "Knee") - hips, middle("Wrist", "Elbow") - shoulders


def _joint(roles: Mapping[str, int], side: str, *parts: str) -> int:
    """Joint of the first part that is known on a side."""
    return next(roles[side + part] for part in parts if side + part in roles)


def _length(points: Array, roles: Mapping[str, int], limb: tuple[str, str, str]) -> float:
    """Mean length of a limb over both sides. The median over all poses is taken."""
    lengths = []
    for side in ("Left", "Right"):
        joints = [roles[side + part] for part in limb if side + part in roles]
        links = np.linalg.norm(np.diff(points[:, joints], axis=1), axis=-1)
        lengths.append(float(np.median(links.sum(1))))
    return sum(lengths) / 2


def _cosine(a: Array, b: Array) -> Array:
    """Cosines (F,) of the angles between vectors (F, 3)."""
    return np.asarray((unit_vectors(a) * unit_vectors(b)).sum(-1))


def _tail(motion: Motion, roles: Mapping[str, int]) -> tuple[str, ...]:
    """Names of joints of a tail. Names that mean hair (a ponytail) or a coat above the shoulders do not
    count."""
    upper = {roles[role] for role in ("Neck", "Head", "LeftShoulder", "RightShoulder") if role in roles}
    names = []
    for joint, name in enumerate(motion.joint_names):
        above = joint
        while above >= 0 and above not in upper:
            above = int(motion.parents[above])
        if above < 0 and _TAIL.search(name):
            names.append(name)
    return tuple(names)


#: Spellings of the sides, at the start or the end of a name.
_SIDES = (("left", "right"), ("l", "r"))
_SEPARATORS = " _.-|:"
#: Patterns for left in names of a joint table, the most certain first: as a word or letter of its own, as a
#: letter before a capital, as the first letter.
_LEFT = (
    re.compile(r"left|(?<![a-z])l(?=[_. -])|(?<=[_. :-])l(?![a-z])", re.IGNORECASE),
    re.compile(r"^l(?=[A-Z])"),
    re.compile(r"^l"),
)


@lru_cache(4)
def loose_keys(names: tuple[str, ...]) -> list[str]:
    """Keys of joint names: ``L_UpLeg_x``, ``lUpLeg`` and ``upleg.L`` all become ``left upleg``. A beginning
    or an end that all names share is left out. A letter counts as a side only if the name of the other side
    also exists."""
    keys = [comparison_key(name) for name in _without_common_parts(names)]
    present = set(keys)
    return [_with_side(key, present) for key in keys]


@lru_cache(1 << 13)
def loose_table_key(role: str, name: str) -> str:
    """Key of a name in a joint table. :func:`loose_keys` gives the same key to a joint with this name."""
    if not role.startswith("Left"):
        return comparison_key(name)
    found = next((match for pattern in _LEFT if (match := pattern.search(name))), None)
    base = name if found is None else name[: found.start()] + name[found.end() :]
    return f"left {comparison_key(base)}"


def _with_side(key: str, present: set[str]) -> str:
    for pair in _SIDES:
        for side, own, other in (("left", *pair), ("right", *reversed(pair))):
            if key.startswith(own) and other + key[len(own) :] in present:
                return f"{side} {key[len(own) :]}"
            if key.endswith(own) and key[: len(key) - len(own)] + other in present:
                return f"{side} {key[: len(key) - len(own)]}"
    return key


def _without_common_parts(names: Sequence[str]) -> list[str]:
    """Names without the beginning and the end that all names share, up to a separator."""
    joints = [name for name in names if not name.endswith("_end")]
    if len(joints) < 2:
        return list(names)
    start = _common_start(joints)
    start = start[: 1 + max(start.rfind(mark) for mark in _SEPARATORS)]
    end = _common_start([name[len(start) :][::-1] for name in joints])
    end = end[: 1 + max(end.rfind(mark) for mark in _SEPARATORS)][::-1]
    return [name.removeprefix(start).removesuffix(end) for name in names]


def _common_start(texts: Sequence[str]) -> str:
    """Longest text that all texts begin with."""
    first, last = min(texts), max(texts)  # all other texts are between these two in order
    length = next((n for n, (a, b) in enumerate(zip(first, last, strict=False)) if a != b), len(first))
    return first[:length]


#: Roles of the joints of each limb, without their side.
LIMBS = (("Hip", "Knee", "Ankle"), ("Shoulder", "Elbow", "Wrist"))
#: A joint counts as the end of a limb if its distance from the end varies by at most this share of the lower
#: part of the limb. The lower part is between these multiples of the upper part.
_END_GAP, _LOWER_BY_UPPER = 0.1, (0.4, 2.5)
#: Table of common names. It is used if no other table fits.
_COMMON = "common"
#: Chains of roles. The joint of each role is a descendant of the joint before it.
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

    If ``table`` is given (name of a built-in table, or a YAML file), this table is used. Otherwise the
    built-in table is used that best fits names and hierarchy. If none fits, the shape of the skeleton
    decides. Signs of an animal lower the confidence.

    Raises:
        MotionError: The table does not fit, or the motion is not that of a person. The second is so if the
            confidence is below ``min_confidence`` (by default 0.12).
    """
    min_confidence = MIN_CONFIDENCE if min_confidence is None else min_confidence
    try:
        match = _match_names_in_motion(motion, table)
    except MotionError as by_names:
        if table is not None:
            raise
        by_shape = match_shape(motion, min_confidence)
        if by_shape is None:
            message = f"{by_names.message}. Nor has the skeleton the shape of a person"
            raise MotionError(message, path=motion.path) from None
        match = replace(by_shape, details=detail_joints(motion.joint_names, by_shape.roles, motion.parents))
    signs = look_at_body(motion, match.roles)
    if signs is not None and signs.plausibility < 1:
        # a motion is not refused for reasons alone
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


def is_person(motion: Motion) -> bool:
    """Whether the joints of a motion are those of a person."""
    try:
        match_motion(motion)
    except MotionError:
        return False
    return True


def _match_names_in_motion(motion: Motion, table: str | os.PathLike[str] | None) -> JointMatch:
    """Match joints by their names. In some files, inverse kinematics moves a foot or a hand, so that the
    joint is not below its limb in the hierarchy. Such a joint counts if it is at the end of the limb in all
    frames."""
    names, parents = motion.joint_names, np.array(motion.parents)
    found: JointMatch | None = None
    with suppress(MotionError):
        found = match_names(names, table, motion.path, parents)
    limbs = [[side + part for part in limb] for side in ("Left", "Right") for limb in LIMBS]
    if motion.n_frames > 1 and (found is None or not all(end in found.roles for _, _, end in limbs)):
        tables = _candidates(table, motion.path)
        by_names = [_best_match(tables, names, None, loose) for loose in (False, True)]
        roles = max(by_names, key=lambda match: match.complete).roles
        frames = motion.world_transforms(np.unique(np.linspace(0, motion.n_frames - 1, 2000).astype(int)))
        for joints in ([roles.get(role, -1) for role in limb] for limb in limbs):
            _, lower, end = joints
            related = _is_descendant(end, lower, parents) or _is_descendant(lower, end, parents)
            if min(joints) >= 0 and not related and _is_limb(frames[:, joints]):
                parents[end] = lower
                found = None
    return match_names(names, table, motion.path, parents) if found is None else found


def _is_limb(frames: Array) -> bool:
    """Whether the third of three joints (F, 3, 4, 4) stays at the end of the second, as a foot does on a
    shin."""
    upper, lower, end = (frames[:, joint, :3, 3] for joint in range(3))
    inside = rotate(np.swapaxes(frames[:, 1, :3, :3], -1, -2), end - lower)
    middle = np.median(inside, axis=0)
    length, above = lengths_of(middle), lengths_of(lower - upper).mean()
    fits = _LOWER_BY_UPPER[0] * above < length < _LOWER_BY_UPPER[1] * above
    return bool(fits and lengths_of(inside - middle).max() < _END_GAP * length)


def match_names(
    joint_names: Sequence[str],
    table: str | os.PathLike[str] | None = None,
    path: str | os.PathLike[str] | None = None,
    parents: Indices | None = None,
) -> JointMatch:
    """Match joints to bones by their names.

    Args:
        joint_names: Names of J joints.
        table: Name of a built-in joint table, or a YAML file. If None, the built-in table that fits best.
        path: File of the motion, for messages.
        parents: (J,) parent of each joint. Joints that contradict this hierarchy do not match. None if
            unknown.

    Raises:
        MotionError: No table fits, or the parents have a cycle. The message names the bones and roles without
            joints, or the joints of the cycle.
    """
    if parents is not None:
        refuse_cycle(joint_names, parents, path)
    tables = _candidates(table, path)
    best = _best_match(tables, joint_names, parents)
    if not best.complete:
        loose = _best_match(tables, joint_names, parents, loose=True)
        best = loose if loose.complete else best

    lacking = [
        *(bone for bone in REQUIRED_BONES if bone not in best.parallel and bone not in best.difference),
        *(role for role in REQUIRED_ROLES if role not in best.roles),
    ]
    if not set(lacking) <= set(ARM_BONES) or (lacking and _may_have_arms(best, joint_names, parents)):
        shown = ", ".join(joint_names[:12]) + (", …" if len(joint_names) > 12 else "")
        raise MotionError(
            f"no joint table fits these joints ({shown}); "
            f"the nearest is {best.table!r}, which finds nothing for {', '.join(lacking)}. "
            "Copy one of config/joint_names, put your names in, and pass it as the joint table",
            path=path,
        )
    best = replace(best, details=detail_joints(joint_names, best.roles, parents))
    return best if table is None else replace(best, by="given")


#: Roles of joints from which arms may branch off.
_ABOVE_ARMS = ("Hips", "Spine", "Chest", "Neck", "Head", "Collar", "Shoulder")


def _may_have_arms(match: JointMatch, names: Sequence[str], parents: Indices | None) -> bool:
    """Whether there may be arms that did not match: two unknown joints branch off, or a wrist ends an arm."""
    sides = {"l": "Left", "r": "Right"}
    if parents is None or any(f"{sides[bone[0]]}Wrist" in match.roles for bone in match.held):
        return True
    known: set[int] = set()
    inner: set[int] = set()
    for role, joint in match.roles.items():
        path = [joint]
        while parents[path[-1]] >= 0:
            path.append(int(parents[path[-1]]))
        known.update(path)
        if role.removeprefix("Left").removeprefix("Right") in _ABOVE_ARMS:
            inner.update(path[role == "Head" :])
    above = parents.tolist()
    unknown = {joint for joint, parent in enumerate(above) if parent in inner and joint not in known}
    return any(above[joint] in unknown and not name.endswith("_end") for joint, name in enumerate(names))


def _best_match(
    tables: Sequence[JointTable], joint_names: Sequence[str], parents: Indices | None, loose: bool = False
) -> JointMatch:
    """Match by the table that fits best. If several tables are complete, the table of common names has the
    lowest rank."""
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
        parents: (J,) parent of each joint. Joints that contradict their role are left out. None if unknown.
        loose: Whether to ignore the prefix and suffix that all joints share, and to accept any spelling of
            the sides.
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


@lru_cache(4)
def _numbers_by_name(names: tuple[str, ...]) -> tuple[dict[str, int], dict[str, int]]:
    """Number of the first joint with each name. By plain name, and by comparison key."""
    numbered = list(reversed(list(enumerate(names))))
    exact = {plain_name(name): number for number, name in numbered}
    return exact, {comparison_key(name): number for number, name in numbered}


def _named_roles(table: JointTable, joint_names: Sequence[str]) -> dict[str, int]:
    """Joint of each role of a table. The first name of the role that exists is used, exact or nearly so."""
    exact, similar = _numbers_by_name(tuple(joint_names))
    roles = {}
    for role, names in table.joints.items():
        joints = (exact.get(name, similar.get(comparison_key(name))) for name in names)
        roles[role] = next((joint for joint in joints if joint is not None), None)
    return {role: joint for role, joint in roles.items() if joint is not None}


def _loose_roles(table: JointTable, joint_names: Sequence[str]) -> dict[str, int]:
    """Do the same as :func:`_named_roles`, in any spelling of the sides. Right sides are spelt as the left
    ones are."""
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
    """Return the roles, without those that have a joint which does not descend from the joint before it in a
    chain."""
    consistent = dict(roles)
    legs = [roles[role] for role in ("LeftHip", "RightHip") if role in roles]
    pelvis = roles.get("Hips", -1)
    while pelvis >= 0 and not all(_is_descendant(leg, pelvis, parents) for leg in legs):
        pelvis = int(parents[pelvis])
    if pelvis >= 0 and len(legs) == 2:
        consistent["Hips"] = pelvis  # the joint called hips may carry only the trunk
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
    above = joint
    for _ in parents:  # no path is longer than the number of joints, and a cycle would not end
        above = int(parents[above])
        if above < 0 or above == ancestor:
            return above == ancestor
    return False


def _candidates(
    table: str | os.PathLike[str] | None, path: str | os.PathLike[str] | None
) -> Sequence[JointTable]:
    tables = built_in_tables()
    if table is None:
        return tables
    named = [t for t in tables if t.name == os.fspath(table)]
    if not named and not exists(Path(table)):
        text = unknown("joint table and no YAML file", os.fspath(table), (t.name for t in tables))
        raise MotionError(text, path=path)
    return named or [load_table(table)]
