"""Joints of fingers, toes, jaw and eyes in motions, by their names.

One table of words serves the names of all programs: Mixamo and HumanIK ``LeftHandIndex1``, VRM and Unity
``leftIndexProximal``, Unreal ``index_01_l``, Biped ``L Finger11``, Rigify ``f_index.01.L``, SMPL-X
``left_index1``, Xsens ``LeftSecondPP``, Rokoko ``LeftFinger2Proximal``, MakeHuman ``finger2-1.L``, Daz
``lIndex1``, ARKit ``left_handIndex_1_joint``, MikuMikuDance ``左人指１``, H-Anim 2
``l_carpal_proximal_interphalangeal_2``.
"""

from __future__ import annotations

import itertools
import re
from collections.abc import Mapping, Sequence
from functools import lru_cache

import numpy as np

from humansim_ros.motion.body.joint_names import DETAIL_BONES, FINGERS, JOINT_NAMES
from humansim_ros.motion.matching.joint_tables import plain_name
from humansim_ros.types import Indices

#: Words in names that mean a finger.
_FINGER_WORDS = {
    "thumb": "thumb",
    **dict.fromkeys(("index", "pointer"), "index"),
    **dict.fromkeys(("middle", "mid"), "middle"),
    "ring": "ring",
    **dict.fromkeys(("pinky", "pinkie", "little"), "pinky"),
}
_ORDINALS = dict(zip(("first", "second", "third", "fourth", "fifth"), FINGERS, strict=True))
_SIDES = {"left": "l", "l": "l", "right": "r", "r": "r"}
#: Words in names that mean a segment. Metacarpals of fingers are in the palm, so only that of the thumb moves
#: a bone.
_SEGMENTS = {
    **dict.fromkeys(("metacarpal", "mc", "start"), "metacarpal"),
    **dict.fromkeys(("proximal", "pp"), "proximal"),
    **dict.fromkeys(("intermediate", "medial", "mp"), "intermediate"),
    **dict.fromkeys(("distal", "dp"), "distal"),
    **dict.fromkeys(("tip", "nub", "end"), "tip"),
}
#: Joints with these words belong to controls of a rig, not to the hand.
_OTHER = {"ik", "ctrl", "control", "target", "pole", "twist", "helper", "roll", "in", "carpal", "toe"}
#: Words that the name of an eye or a jaw may have in addition to its side.
_FACE_WORDS = {"joint", "bone", "cc", "base", "def", "m", "j", "adj", "face", "smplhf", "lower", "root"}
_FACE = {"eye": "eyeball_joint", "eyeball": "eyeball_joint", "jaw": "temporomandibular"}
_WORD = re.compile(r"[A-Z]+(?=[A-Z][a-z])|[A-Z]?[a-z]+|[A-Z]+|\d+")
#: Words without a separator between them: ``lthumb``, ``lefthandindex``, ``ringfinger``.
_FUSED = re.compile(rf"(left|right|l|r)?(?:hand)?({'|'.join([*_FINGER_WORDS, 'finger'])})(?:finger)?")
#: Word of Biped for the end of a finger. Biped counts fingers from 0.
_NUB = re.compile("nub", re.IGNORECASE)
_MMD = re.compile(r"([左右])(?:([親人中薬小])差?指([0-3０-３])|(目))$")
_MMD_FINGERS = dict(zip("親人中薬小", FINGERS, strict=True))
#: Joints of H-Anim 2 by the finger and its number, and the segments of H-Anim 2 that rotate with these
#: joints.
_HANIM = {
    **{row.hanim2: row.name for row in JOINT_NAMES if row.hanim2 and row.name in DETAIL_BONES},
    **{
        f"{side}_{segment}_{number}": f"{side}_{FINGERS[number - 1]}{joint}"
        for side in "lr"
        for number in range(1, 6)
        for joint, segment in enumerate(
            ("metacarpal", "carpal_proximal_phalanx", "carpal_distal_phalanx")
            if number == 1
            else ("carpal_proximal_phalanx", "carpal_middle_phalanx", "carpal_distal_phalanx"),
            1,
        )
    },
}
#: Order of the joints of a finger that are named by words.
_ORDER = ("metacarpal", "proximal", "intermediate", "distal")


@lru_cache(1 << 13)
def _finger_joint(name: str) -> tuple[str, str, str | int] | None:
    """Side, finger and segment of a finger joint. None for other joints. The segment is a word of
    :data:`_ORDER`, or the number in the name. Numbers start at 1, or at 0 if the thumb starts at 0."""
    plain = plain_name(name)
    if plain in DETAIL_BONES and plain[-1].isdigit():
        return plain[0], plain[2:-1], int(plain[-1])
    if (bone := _HANIM.get(plain)) is not None and bone[-1].isdigit():
        return bone[0], bone[2:-1], int(bone[-1])
    if (match := _MMD.search(plain)) is not None and match[2]:
        side = "l" if match[1] == "左" else "r"
        return side, _MMD_FINGERS[match[2]], int(match[3]) + (match[2] == "親")
    side = finger = segment = ""
    counted = False
    numbers: list[str] = []
    for word in _words(plain):
        if word in _OTHER:
            return None
        side = _SIDES.get(word, side)
        finger = _FINGER_WORDS.get(word) or _ORDINALS.get(word) or finger
        segment = _SEGMENTS.get(word, segment)
        counted |= word == "finger"
        if word.isdigit() and (finger or counted):
            numbers.append(word)
    if not side:
        return None
    if not finger and counted and numbers:
        first = numbers.pop(0)
        # Biped counts fingers from 0. Joints after the first have a second digit. Ends have the second digit
        # of their joint
        if not numbers and (not segment or len(first) == 2 or _NUB.search(plain)):
            if not segment:
                numbers.append(str(int(first[1:] or "0") + 1))
            first = str(int(first[0]) + 1)
        finger = FINGERS[int(first) - 1] if 0 < int(first) <= 5 else ""
    if not finger or len(numbers) > 1 or (not numbers and not segment):
        return None
    return side, finger, segment or int(numbers[0])


def _words(name: str) -> list[str]:
    """Words and numbers of a name in lower case."""
    words: list[str] = []
    for part in _WORD.findall(name):
        word = part.casefold()
        fused = _FUSED.fullmatch(word)
        words += [word] if fused is None or word in _SEGMENTS else [each for each in fused.groups() if each]
    return words


@lru_cache(1 << 13)
def _face_bone(name: str) -> str | None:
    """Bone of the jaw or an eye that a joint with this name drives. None if there is no such bone."""
    plain = plain_name(name)
    if plain in DETAIL_BONES:
        return plain if plain.endswith(("eyeball_joint", "temporomandibular")) else None
    if (match := _MMD.search(plain)) is not None and match[4]:
        return f"{'l' if match[1] == '左' else 'r'}_eyeball_joint"
    sides, parts = set(), set()
    for part in _WORD.findall(plain):
        word = part.casefold()
        if word in _SIDES:
            sides.add(_SIDES[word])
        elif word[1:] == "eye" and word[0] in _SIDES:
            sides.add(word[0])
            parts.add("eyeball_joint")
        elif word in _FACE:
            parts.add(_FACE[word])
        elif word not in _FACE_WORDS:
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
    for above, joint in itertools.pairwise(joints):
        for _ in parents:  # no path is longer than the number of joints, and a cycle would not end
            joint = int(parents[joint])
            if joint < 0 or joint == above:
                break
        if joint != above:
            return False
    return True
