"""Match joints to bones by the names of the joints.

Names are compared in a common spelling: without a common prefix, with left and right found from pairs of
names. For fingers, one table of words serves the names of all programs: Mixamo and HumanIK
``LeftHandIndex1``, VRM and Unity ``leftIndexProximal``, Unreal ``index_01_l``, Biped ``L Finger11``, Rigify
``f_index.01.L``, SMPL-X ``left_index1``, Xsens ``LeftSecondPP``, Rokoko ``LeftFinger2Proximal``, MakeHuman
``finger2-1.L``, Daz ``lIndex1``, ARKit ``left_handIndex_1_joint``, MikuMikuDance ``左人指１``, H-Anim 2
``l_carpal_proximal_interphalangeal_2``.
"""

from __future__ import annotations

import itertools
import os
import re
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import replace
from functools import lru_cache
from pathlib import Path

import numpy as np

from humansim_ros.errors import MotionError, unknown
from humansim_ros.files.reading import exists, read_table
from humansim_ros.geometry import lengths_of, rotate
from humansim_ros.motion.body.kinematics import Motion, refuse_cycle
from humansim_ros.motion.body.skeleton import DETAIL_BONES, FINGERS, JOINT_NAMES
from humansim_ros.motion.matching.joint_tables import (
    ARM_BONES,
    LEFT,
    REQUIRED_BONES,
    REQUIRED_ROLES,
    JointMatch,
    JointTable,
    built_in_tables,
    load_table,
    match_roles,
)
from humansim_ros.types import Array, Indices

#: Most names with cached keys: the names of all tables and of some motions.
_MAX_KEYS = 1 << 13
#: Prefixes that programs put before the joint names of a character.
_PREFIX = re.compile(r"^(.*:|mixamorig\d*|character\d*_|robot_|bip\d+[ _]?)", re.IGNORECASE)
#: Words in names of fingers, jaw and eyes, with their meanings, by kind: sides, fingers, segments, parts of a
#: face and words next to them. Joints with words of the kind ``other`` are controls of a rig. Metacarpals of
#: fingers are in the palm, so only that of the thumb moves a bone.
_WORDS: dict[str, dict[str, str]] = {
    kind: {word: meaning for meaning, words in table.items() for word in words.split()}
    for kind, table in read_table("detail_words").items()
}
_WORD = re.compile(r"[A-Z]+(?=[A-Z][a-z])|[A-Z]?[a-z]+|[A-Z]+|\d+")
#: Words without a separator between them: ``lthumb``, ``lefthandindex``, ``ringfinger``.
_FUSED = re.compile(rf"(left|right|l|r)?(?:hand)?({'|'.join([*_WORDS['fingers'], 'finger'])})(?:finger)?")
#: Word of Biped for the end of a finger. Biped counts fingers from 0.
_NUB = re.compile("nub", re.IGNORECASE)
_MMD = re.compile(r"([左右])(?:([親人中薬小])差?指([0-3０-３])|(目))$")
_MMD_FINGERS = dict(zip("親人中薬小", FINGERS, strict=True))
#: Joints of H-Anim 2 by finger and number, and the segments of H-Anim 2 that rotate with them.
_HANIM = {row.hanim2: row.name for row in JOINT_NAMES if row.hanim2 and row.name in DETAIL_BONES} | {
    f"{side}_{segment}_{number}": f"{side}_{finger}{joint}"
    for side in "lr"
    for number, finger in enumerate(FINGERS, 1)
    for joint, segment in enumerate(
        (
            "metacarpal" if finger == "thumb" else "carpal_proximal_phalanx",
            "carpal_proximal_phalanx" if finger == "thumb" else "carpal_middle_phalanx",
            "carpal_distal_phalanx",
        ),
        1,
    )
}
#: Order of the joints of a finger that are named by words.
_ORDER = ("metacarpal", "proximal", "intermediate", "distal")


@lru_cache(_MAX_KEYS)
def plain_name(joint: str) -> str:
    """Name of a joint without the namespace of a program (``mixamorig:Hips`` -> ``Hips``)."""
    return _PREFIX.sub("", joint) or joint


@lru_cache(_MAX_KEYS)
def comparison_key(joint: str) -> str:
    """Name of a joint for comparisons: without namespace, case, blanks and punctuation."""
    return re.sub(r"[\s._-]+", "", plain_name(joint)).casefold()


@lru_cache(_MAX_KEYS)
def _finger_joint(name: str) -> tuple[str, str, str | int] | None:
    """Side, finger and segment of a finger joint. None for other joints. The segment is a word of
    :data:`_ORDER`, or the number in the name. Numbers start at 1, or at 0 if the thumb starts at 0."""
    plain = plain_name(name)
    bone = plain if plain in DETAIL_BONES else _HANIM.get(plain, "")
    if bone[-1:].isdigit():
        return bone[0], bone[2:-1], int(bone[-1])
    if (match := _MMD.search(plain)) is not None and match[2]:
        side = "l" if match[1] == "左" else "r"
        return side, _MMD_FINGERS[match[2]], int(match[3]) + (match[2] == "親")
    words = _words(plain)
    side, finger, segment = (
        next((_WORDS[kind][word] for word in reversed(words) if word in _WORDS[kind]), "")
        for kind in ("sides", "fingers", "segments")
    )
    if not side or _WORDS["other"].keys() & set(words):
        return None
    start = next((n for n, word in enumerate(words) if word == "finger" or word in _WORDS["fingers"]), None)
    numbers = [word for word in words[start:] if word.isdigit()] if start is not None else []
    if not finger and numbers:
        finger, numbers = _counted(numbers, bool(_NUB.search(plain)), bool(segment))
    if not finger or len(numbers) > 1 or (not numbers and not segment):
        return None
    return side, finger, segment or int(numbers[0])


def _counted(numbers: list[str], is_nub: bool, has_segment: bool) -> tuple[str, list[str]]:
    """Return the finger that a number stands for, and the other numbers of the name. Biped counts fingers
    from 0. Its joints after the first have a second digit, and an end has the second digit of its joint."""
    first, *others = numbers
    if not others and (not has_segment or len(first) == 2 or is_nub):
        others = [] if has_segment else [str(int(first[1:] or "0") + 1)]
        first = str(int(first[0]) + 1)
    return (FINGERS[int(first) - 1] if 0 < int(first) <= 5 else ""), others


def _words(name: str) -> list[str]:
    """Words and numbers of a name in lower case."""
    words: list[str] = []
    for word in map(str.casefold, _WORD.findall(name)):
        fused = None if word in _WORDS["segments"] else _FUSED.fullmatch(word)
        words += [word] if fused is None else [each for each in fused.groups() if each]
    return words


@lru_cache(_MAX_KEYS)
def _face_bone(name: str) -> str | None:
    """Bone of the jaw or an eye that a joint with this name drives. None if there is no such bone."""
    plain = plain_name(name)
    if plain in DETAIL_BONES:
        return plain if plain.endswith(("eyeball_joint", "temporomandibular")) else None
    if (match := _MMD.search(plain)) is not None and match[4]:
        return f"{'l' if match[1] == '左' else 'r'}_eyeball_joint"
    found = [word.casefold() for word in _WORD.findall(plain)]
    words = {part for word in found for part in ((word[0], "eye") if word in ("leye", "reye") else (word,))}
    sides = {_WORDS["sides"][word] for word in words if word in _WORDS["sides"]}
    parts = {_WORDS["face"][word] for word in words if word in _WORDS["face"]}
    if words - _WORDS["sides"].keys() - _WORDS["face"].keys() - _WORDS["with_face"].keys():
        return None
    if parts == {"eyeball_joint"} and len(sides) == 1:
        return f"{sides.pop()}_eyeball_joint"
    return "temporomandibular" if parts == {"temporomandibular"} and not sides else None


def detail_joints(
    joint_names: Sequence[str], roles: Mapping[str, int], parents: Indices | None = None
) -> dict[str, tuple[int, int]]:
    """Find the joints that drive bones of fingers, toes, jaw and eyes.

    A finger must have at least two joints. A finger with one joint only shows the direction of the hand.

    Args:
        joint_names: Names of J joints.
        roles: Role -> joint.
        parents: (J,) parent of each joint, where known. Fingers descend from the wrist, each joint from the
            joint before it.

    Returns:
        Bone -> (start joint, end joint) of the link that the bone is parallel to. The same joint twice means
        that the bone takes the rotation of the joint. This is so for toes, jaw and eyes, and for the last
        joint of a finger if its end is unknown.
    """
    named: dict[tuple[str, str], dict[str | int, int]] = {}
    face: dict[str, tuple[int, int]] = {}
    # a name that begins with _ belongs to a helper joint
    for joint, name in sorted(enumerate(joint_names), key=lambda each: each[1].startswith("_")):
        if (found := _finger_joint(name)) is not None:
            named.setdefault(found[:2], {}).setdefault(found[2], joint)
        elif (bone := _face_bone(name)) is not None:
            face.setdefault(bone, (joint, joint))
    out: dict[str, tuple[int, int]] = {}
    for (side, finger), joints in named.items():
        chain, tip = _in_order(joints, finger, joint_names)
        wrist = roles.get(f"{'Left' if side == 'l' else 'Right'}Wrist")
        above = () if wrist is None else (wrist,)
        if len(chain) < 2 or (parents is not None and not _is_chain((*above, *chain), parents)):
            continue
        if tip is None or (parents is not None and not _is_chain((chain[-1], tip), parents)):
            tip = _tip(chain[-1], joint_names, parents)
        for number, (start, end) in enumerate(itertools.pairwise((*chain, tip)), 1):
            out[f"{side}_{finger}{number}"] = (start, end)
    for side in ("Left", "Right"):
        toe = roles.get(f"{side}Toe")
        if toe is not None and not joint_names[toe].endswith("_end"):
            out[f"{side[0].lower()}_metatarsal"] = (toe, toe)
    out |= face
    return {bone: out[bone] for bone in DETAIL_BONES if bone in out}


def _in_order(
    joints: Mapping[str | int, int], finger: str, joint_names: Sequence[str]
) -> tuple[tuple[int, ...], int | None]:
    """Return at most three joints of a finger, from its base on, and its tip."""
    numbers = sorted(each for each in joints if isinstance(each, int) and (each or finger == "thumb"))
    words = [word for word in _ORDER if word in joints and (finger == "thumb" or word != "metacarpal")]
    chain = [joints[word] for word in words if not numbers or word == "metacarpal"]
    chain += [joints[number] for number in numbers]
    tip = joints.get("tip")
    if tip is not None and chain and joint_names[tip] == f"{joint_names[chain[-1]]}_end":
        tip = None  # if there is no end site, the last joint may be the tip
    if len(chain) > 3 and (tip is not None or len(chain) > 4 or 0 in numbers):
        chain = chain[1:]  # the first joint is in the palm, for example in files of SOMA and Meta Quest
    return tuple(chain[:3]), chain[3] if len(chain) > 3 else tip


def _tip(joint: int, joint_names: Sequence[str], parents: Indices | None) -> int:
    """End of the last joint of a finger. If there is no end, the joint itself."""
    if (end := f"{joint_names[joint]}_end") in joint_names:
        return list(joint_names).index(end)
    below = [] if parents is None else np.flatnonzero(parents == joint).tolist()
    return int(below[0]) if below else joint


def _is_chain(joints: Sequence[int], parents: Indices) -> bool:
    """Whether each of the joints descends from the joint before it."""
    return all(above in ancestors(joint, parents) for above, joint in itertools.pairwise(joints))


#: Spellings of the sides, at the start or the end of a name.
_SIDES = (("left", "right"), ("l", "r"))
_SEPARATORS = " _.-|:"
#: Patterns for left in names of a joint table, the most certain first: as a word or letter of its own, as a
#: letter before a capital, as the first letter.
_LEFT = (LEFT, re.compile(r"^l(?=[A-Z])"), re.compile(r"^l"))


@lru_cache(4)
def loose_keys(names: tuple[str, ...]) -> list[str]:
    """Keys of joint names: ``L_UpLeg_x``, ``lUpLeg`` and ``upleg.L`` become ``left upleg``. What all names
    begin or end with is left out. A letter is a side only if the name of the other side exists."""
    keys = [comparison_key(name) for name in _without_common_parts(names)]
    present = set(keys)
    return [_with_side(key, present) for key in keys]


@lru_cache(_MAX_KEYS)
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
            rest, start = key.removeprefix(own), key.removesuffix(own)
            if rest != key and other + rest in present:
                return f"{side} {rest}"
            if start != key and start + other in present:
                return f"{side} {start}"
    return key


def _without_common_parts(names: Sequence[str]) -> list[str]:
    """Names without the beginning and the end that all names share, up to a separator."""
    joints = [name for name in names if not name.endswith("_end")]
    if len(joints) < 2:
        return list(names)
    start = _common_start(joints)
    end = _common_start([name[len(start) :][::-1] for name in joints])[::-1]
    return [name.removeprefix(start).removesuffix(end) for name in names]


def _common_start(texts: Sequence[str]) -> str:
    """Longest text that all texts begin with, up to a separator."""
    first, last = min(texts), max(texts)  # all other texts are between these two in order
    length = next((n for n, (a, b) in enumerate(zip(first, last, strict=False)) if a != b), len(first))
    return first[: 1 + max(first.rfind(mark, 0, length) for mark in _SEPARATORS)]


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


def match_names_in_motion(motion: Motion, table: str | os.PathLike[str] | None) -> JointMatch:
    """Match joints by their names. If inverse kinematics moves a foot or a hand, its joint is not below its
    limb in the hierarchy. The joint counts if it is at the end of the limb in all frames."""
    names, parents = motion.joint_names, np.array(motion.parents)
    found: JointMatch | None = None
    with suppress(MotionError):
        found = match_names(names, table, motion.path, parents)
    limbs = [[side + part for part in limb] for side in ("Left", "Right") for limb in LIMBS]
    if motion.n_frames > 1 and (found is None or not all(end in found.roles for _, _, end in limbs)):
        tables = _candidates(table, motion.path)
        by_names = [_best_match(tables, names, None, loose) for loose in (False, True)]
        roles = max(by_names, key=lambda match: match.complete).roles
        frames = motion.world_transforms(spread_frames(motion, 2000))
        for joints in ([roles.get(role, -1) for role in limb] for limb in limbs):
            _, lower, end = joints
            related = lower in ancestors(end, parents) or end in ancestors(lower, parents)
            if min(joints) >= 0 and not related and _is_limb(frames[:, joints]):
                parents[end] = lower
                found = None
    return match_names(names, table, motion.path, parents) if found is None else found


def _is_limb(frames: Array) -> bool:
    """Whether the third of three joints (F, 3, 4, 4) stays at the end of the second, as a foot on a shin."""
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
        path = [joint, *ancestors(joint, parents)]
        known.update(path)
        if role.removeprefix("Left").removeprefix("Right") in _ABOVE_ARMS:
            inner.update(path[role == "Head" :])
    above = parents.tolist()
    unknown = {joint for joint, parent in enumerate(above) if parent in inner and joint not in known}
    return any(above[joint] in unknown and not name.endswith("_end") for joint, name in enumerate(names))


def _best_match(
    tables: Sequence[JointTable], joint_names: Sequence[str], parents: Indices | None, loose: bool = False
) -> JointMatch:
    """Match by the best table. If several are complete, the table of common names comes last."""
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
    """Numbers of joints (the first of equal names): by plain name, and by comparison key."""
    numbered = list(reversed(list(enumerate(names))))
    exact = {plain_name(name): number for number, name in numbered}
    return exact, {comparison_key(name): number for number, name in numbered}


def _named_roles(table: JointTable, joint_names: Sequence[str]) -> dict[str, int]:
    """Find the joint of each role of a table by its names, in their order: by equal name or equal key."""
    exact, similar = _numbers_by_name(tuple(joint_names))
    roles: dict[str, int] = {}
    for role, names in table.joints.items():
        for name in names:
            joint = exact.get(name, similar.get(comparison_key(name)))
            if joint is not None:
                roles.setdefault(role, joint)
    return roles


def _loose_roles(table: JointTable, joint_names: Sequence[str]) -> dict[str, int]:
    """Do what :func:`_named_roles` does, but accept any spelling of left and right."""
    joint_of = {key: number for number, key in reversed(list(enumerate(loose_keys(tuple(joint_names)))))}
    roles: dict[str, int] = {}
    for role, names in table.joints.items():
        left = f"Left{role[5:]}" if role.startswith("Right") else role
        for name in table.joints.get(left, names):
            key = loose_table_key(left, name)
            joint = joint_of.get(key if left == role else key.replace("left", "right", 1))
            if joint is not None:
                roles.setdefault(role, joint)
    return roles


def _consistent_roles(roles: Mapping[str, int], parents: Indices) -> dict[str, int]:
    """Return the roles without joints that do not descend from the joint before them in a chain."""
    consistent = dict(roles)
    legs = [roles[role] for role in ("LeftHip", "RightHip") if role in roles]
    pelvis = roles.get("Hips", -1)
    while pelvis >= 0 and not all(pelvis in ancestors(leg, parents) for leg in legs):
        pelvis = int(parents[pelvis])
    if pelvis >= 0 and len(legs) == 2:
        consistent["Hips"] = pelvis  # the joint called hips may carry only the trunk
    for chain in _CHAINS:
        above = -1
        for role in [role for role in chain if role in consistent]:
            joint = consistent[role]
            is_same = role == "Chest" and joint == above
            if above < 0 or is_same or above in ancestors(joint, parents):
                above = joint
            else:
                del consistent[role]
    return consistent


def spread_frames(motion: Motion, most: int) -> Indices:
    """Numbers of at most ``most`` frames, spread evenly over a motion."""
    return np.unique(np.linspace(0, motion.n_frames - 1, most).astype(np.intp))


def ancestors(joint: int, parents: Indices) -> list[int]:
    """Ancestors of a joint, upwards."""
    found: list[int] = []
    while (joint := int(parents[joint])) >= 0 and len(found) < len(parents):  # a cycle would not end
        found.append(joint)
    return found


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
