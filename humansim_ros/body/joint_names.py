"""Names of the joints of humans: their places in plain words, and their names in other sets.

All humans have the joints of the general skeleton; the built-in humans also have :data:`DETAIL_BONES`. One
table for code, commands and documents (docs/joints.md). A joint of another set is the same anatomical joint,
or only the nearest one: the second kind is listed in ``near``, and its place differs by centimetres.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

#: Joints of other sets, in the order of their numbers.
COCO = (
    *("nose", "left_eye", "right_eye", "left_ear", "right_ear"),
    *("left_shoulder", "right_shoulder", "left_elbow", "right_elbow", "left_wrist", "right_wrist"),
    *("left_hip", "right_hip", "left_knee", "right_knee", "left_ankle", "right_ankle"),
)
BODY_25 = (
    *("Nose", "Neck", "RShoulder", "RElbow", "RWrist", "LShoulder", "LElbow", "LWrist", "MidHip"),
    *("RHip", "RKnee", "RAnkle", "LHip", "LKnee", "LAnkle", "REye", "LEye", "REar", "LEar"),
    *("LBigToe", "LSmallToe", "LHeel", "RBigToe", "RSmallToe", "RHeel"),
)
SMPL = (
    *("pelvis", "left_hip", "right_hip", "spine1", "left_knee", "right_knee", "spine2"),
    *("left_ankle", "right_ankle", "spine3", "left_foot", "right_foot", "neck"),
    *("left_collar", "right_collar", "head", "left_shoulder", "right_shoulder"),
    *("left_elbow", "right_elbow", "left_wrist", "right_wrist", "left_hand", "right_hand"),
)
_SMPL_FINGERS = tuple(
    f"{side}_{finger}{number}"
    for side in ("left", "right")
    for finger in ("index", "middle", "pinky", "ring", "thumb")
    for number in (1, 2, 3)
)
#: Names of the joints of SMPL, SMPL+H and SMPL-X by their number.
SMPL_MODELS = {
    24: SMPL,
    52: (*SMPL[:22], *_SMPL_FINGERS),
    55: (*SMPL[:22], "jaw", "left_eye_smplhf", "right_eye_smplhf", *_SMPL_FINGERS),
}
#: Fingers of a hand in the order of their bones.
FINGERS = ("thumb", "index", "middle", "ring", "pinky")


def finger_bones(side: str) -> tuple[str, ...]:
    """Names of the 15 finger bones of a hand, three for each of :data:`FINGERS`; ``side`` is l or r.

    Example:
        >>> finger_bones("l")[:4]
        ('l_thumb1', 'l_thumb2', 'l_thumb3', 'l_index1')
    """
    return tuple(f"{side}_{finger}{number}" for finger in FINGERS for number in (1, 2, 3))


def _detail_parents() -> dict[str, str]:
    """Parent of each of the bones below."""
    parents = {}
    for side in "lr":
        for bone in finger_bones(side):
            number = int(bone[-1])
            parents[bone] = f"{side}_wrist" if number == 1 else f"{bone[:-1]}{number - 1}"
    parents |= {f"{side}_metatarsal": f"{side}_ankle" for side in "lr"}
    return parents | dict.fromkeys(("temporomandibular", "l_eyeball_joint", "r_eyeball_joint"), "vt3")


#: Parent by name of the bones that the built-in humans have after those of the general skeleton, in their
#: order: 15 fingers of the left hand and of the right hand, toes, jaw and eyes (H-Anim 1.1).
DETAIL_BONES: Mapping[str, str] = _detail_parents()


def body_joints(names: Sequence[str]) -> list[int]:
    """Numbers of the joints that are not of :data:`DETAIL_BONES`: what counts joints is not to count hands.

    Example:
        >>> body_joints(["l_wrist", "l_index1", "l_index3_end", "l_wrist_end"])
        [0, 3]
    """
    return [number for number, name in enumerate(names) if name.removesuffix("_end") not in DETAIL_BONES]


#: Titles of the columns of other sets, by field of :class:`JointName`.
SETS = {"hanim2": "H-Anim 2", "smpl": "SMPL", "coco": "COCO", "body_25": "OpenPose BODY_25"}


@dataclass(frozen=True)
class JointName:
    """Names of one joint.

    Attributes:
        name: Name in this package (H-Anim 1.1).
        place: Place in the body, in plain words.
        bone: The part of the body that the bone of this name spans, which turns about the joint; empty for
            the end of a bone.
        hanim2: Name in H-Anim 2 (ISO/IEC 19774-1:2019), of a joint or of a site; None without one.
        smpl: Name in SMPL, of fingers, jaw and eyes in SMPL-X; None without one.
        coco: Name in the 17 keypoints of COCO; None without one.
        body_25: Name in BODY_25 of OpenPose; None without one.
        near: Fields of the sets whose joint is only the nearest one.
    """

    name: str
    place: str
    bone: str = ""
    hanim2: str | None = None
    smpl: str | None = None
    coco: str | None = None
    body_25: str | None = None
    near: tuple[str, ...] = ()

    def in_set(self, column: str) -> str:
        """Name in another set (a key of :data:`SETS`), with ``~`` before the nearest one; empty if none."""
        name = getattr(self, column)
        return "" if name is None else f"~{name}" if column in self.near else name


_TRUNK = (
    JointName(
        *("HumanoidRoot", "root of the pelvis, below the middle of the hips", "pelvis, to the lower back"),
        hanim2="humanoid_root",
        smpl="pelvis",
        body_25="MidHip",
        near=("smpl", "body_25"),
    ),
    JointName(
        "sacroiliac", "lower back, at the height of the hips", "lower back, to the waist", "sacroiliac"
    ),
    JointName(
        "vl5",
        "waist, below the chest",
        "chest and belly, to the base of the neck",
        "vl5",
        smpl="spine1",
        near=("smpl",),
    ),
    JointName(
        *("vt3", "base of the neck, above the shoulders", "neck and head", "vt3"),
        smpl="neck",
        body_25="Neck",
        near=("smpl", "body_25"),
    ),
    JointName("vt3_end", "top of the head", hanim2="skull_vertex_pt"),
)
#: Joints of the left side; ``{s}`` stands for l and r, ``{side}`` for left and right, ``{S}`` for L and R.
_SIDE = (
    JointName("HumanoidRoot_to_{s}_hip", "as sacroiliac", "connection to the {side} hip"),
    JointName("{s}_hip", "{side} hip", "thigh", "{s}_hip", "{side}_hip", "{side}_hip", "{S}Hip"),
    JointName("{s}_knee", "{side} knee", "shank", "{s}_knee", "{side}_knee", "{side}_knee", "{S}Knee"),
    JointName(
        *("{s}_ankle", "{side} ankle", "foot", "{s}_talocrural", "{side}_ankle", "{side}_ankle", "{S}Ankle")
    ),
    JointName(
        *("{s}_ankle_end", "tip of the {side} foot", "", "{s}_tarsal_distal_phalanx_2_tip", "{side}_foot"),
        body_25="{S}BigToe",
        near=("smpl", "body_25"),
    ),
    JointName("vl5_to_{s}_sternoclavicular", "as vt3", "connection to the {side} collarbone"),
    JointName(
        *("{s}_sternoclavicular", "inner end of the {side} collarbone", "shoulder girdle"),
        *("{s}_sternoclavicular", "{side}_collar"),
        near=("smpl",),
    ),
    JointName(
        *("{s}_shoulder", "{side} shoulder", "upper arm", "{s}_shoulder"),
        *("{side}_shoulder", "{side}_shoulder", "{S}Shoulder"),
    ),
    JointName(
        "{s}_elbow", "{side} elbow", "forearm", "{s}_elbow", "{side}_elbow", "{side}_elbow", "{S}Elbow"
    ),
    JointName(
        *("{s}_wrist", "{side} wrist", "hand", "{s}_radiocarpal", "{side}_wrist", "{side}_wrist", "{S}Wrist")
    ),
    JointName(
        *("{s}_wrist_end", "tip of the {side} hand, if it is straight", ""),
        *("{s}_carpal_distal_phalanx_3_tip", "{side}_hand"),
        near=("hanim2", "smpl"),
    ),
)


#: Fingers, toes, jaw and eyes: words as above, ``{number}`` is 1 (thumb) to 5 in the names of H-Anim 2.
_THUMB = (
    JointName("{s}_thumb1", "base of the {side} thumb", "ball of the thumb", "{s}_carpometacarpal_1"),
    JointName(
        *("{s}_thumb2", "knuckle of the {side} thumb", "first segment of the thumb"),
        "{s}_metacarpophalangeal_1",
    ),
    JointName(
        *("{s}_thumb3", "outer joint of the {side} thumb", "end segment of the thumb"),
        "{s}_carpal_interphalangeal_1",
    ),
    JointName("{s}_thumb3_end", "tip of the {side} thumb", "", "{s}_carpal_distal_phalanx_1_tip"),
)
_FINGER = (
    JointName(
        *("{s}_{finger}1", "knuckle of the {side} {title}", "first segment of the {title}"),
        "{s}_metacarpophalangeal_{number}",
    ),
    JointName(
        *("{s}_{finger}2", "middle joint of the {side} {title}", "middle segment of the {title}"),
        "{s}_carpal_proximal_interphalangeal_{number}",
    ),
    JointName(
        *("{s}_{finger}3", "outer joint of the {side} {title}", "end segment of the {title}"),
        "{s}_carpal_distal_interphalangeal_{number}",
    ),
    JointName("{s}_{finger}3_end", "tip of the {side} {title}", "", "{s}_carpal_distal_phalanx_{number}_tip"),
)
_TITLES = ("thumb", "index finger", "middle finger", "ring finger", "little finger")
_TOES = (
    JointName(
        *("{s}_metatarsal", "ball of the {side} foot", "toes", "{s}_metatarsophalangeal_2"), near=("hanim2",)
    ),
    JointName(
        *("{s}_metatarsal_end", "tip of the {side} toes, if they are bent, too", ""),
        "{s}_tarsal_distal_phalanx_2_tip",
        near=("hanim2",),
    ),
)
_JAW = (
    JointName(
        *("temporomandibular", "hinge of the jaw, in the middle between the ears", "jaw"),
        *("temporomandibular", "jaw"),
    ),
    JointName("temporomandibular_end", "chin", "", "supramenton_pt", near=("hanim2",)),
)
_EYE = (
    JointName(
        *("{s}_eyeball_joint", "centre of the {side} eye", "eye", "{s}_eyeball_joint", "{side}_eye_smplhf"),
        *("{side}_eye", "{S}Eye"),
        near=("coco", "body_25"),
    ),
    JointName("{s}_eyeball_joint_end", "pupil of the {side} eye"),
)


def _on_side(row: JointName, side: str, **more: object) -> JointName:
    words = {"s": side[0], "S": side[0].upper(), "side": side, **more}
    texts: dict[str, Any] = {k: v.format(**words) for k, v in vars(row).items() if isinstance(v, str)}
    return replace(row, **texts)


def _details() -> Iterator[JointName]:
    """Joints of :data:`DETAIL_BONES`, in their order, each chain with its end."""
    for side in ("left", "right"):
        for number, (finger, title) in enumerate(zip(FINGERS, _TITLES, strict=True), 1):
            for row in _THUMB if number == 1 else _FINGER:
                named = _on_side(row, side, finger=finger, title=title, number=number)
                smpl = None if named.name.endswith("_end") else f"{side}_{named.name[2:]}"
                yield replace(named, smpl=smpl)
    for side in ("left", "right"):
        yield from (_on_side(row, side) for row in _TOES)
    yield from _JAW
    for side in ("left", "right"):
        yield from (_on_side(row, side) for row in _EYE)


#: All joints: first those of the general skeleton (trunk from below, left side, right side), then those of
#: :data:`DETAIL_BONES` with their ends.
JOINT_NAMES = (
    *_TRUNK,
    *(_on_side(row, side) for side in ("left", "right") for row in _SIDE),
    *_details(),
)
#: Joints of other sets that have no counterpart, by field of :class:`JointName`.
WITHOUT_JOINT = {
    column: tuple(name for name in names if name not in {getattr(row, column) for row in JOINT_NAMES})
    for column, names in (("smpl", SMPL), ("coco", COCO), ("body_25", BODY_25))
}
