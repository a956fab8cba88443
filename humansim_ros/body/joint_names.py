"""Names of the joints of the general skeleton: their places in plain words, and their names in other sets.

One table for code, commands and documents (docs/joints.md). A joint of another set is the same anatomical
joint, or only the nearest one: the second kind is listed in ``near``, and its place differs by centimetres.
"""

from __future__ import annotations

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
_FINGERS = tuple(
    f"{side}_{finger}{number}"
    for side in ("left", "right")
    for finger in ("index", "middle", "pinky", "ring", "thumb")
    for number in (1, 2, 3)
)
#: Names of the joints of SMPL, SMPL+H and SMPL-X by their number.
SMPL_MODELS = {
    24: SMPL,
    52: (*SMPL[:22], *_FINGERS),
    55: (*SMPL[:22], "jaw", "left_eye_smplhf", "right_eye_smplhf", *_FINGERS),
}
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
        smpl: Name in SMPL; None without one.
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


def _on_side(row: JointName, side: str) -> JointName:
    words = {"s": side[0], "S": side[0].upper(), "side": side}
    texts: dict[str, Any] = {k: v.format(**words) for k, v in vars(row).items() if isinstance(v, str)}
    return replace(row, **texts)


#: All joints of the general skeleton: the trunk from below, then the left and the right side.
JOINT_NAMES = (*_TRUNK, *(_on_side(row, side) for side in ("left", "right") for row in _SIDE))
#: Joints of other sets that have no counterpart, by field of :class:`JointName`.
WITHOUT_JOINT = {
    column: tuple(name for name in names if name not in {getattr(row, column) for row in JOINT_NAMES})
    for column, names in (("smpl", SMPL), ("coco", COCO), ("body_25", BODY_25))
}
