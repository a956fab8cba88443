"""Names of the joints of humans: their places in plain words, and their names in other sets.

All humans have the joints of the general skeleton; the built-in humans also have :data:`DETAIL_BONES`. One
table for code, commands and documents (config/joints.json, docs/joints.md). A joint of another set is the
same anatomical joint, or only the nearest one. The second kind is listed in ``near``. Its place differs by
centimetres.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from humansim_ros.files.reading import read_table

_TABLE = read_table("joints")
#: Joints of other sets, in the order of their numbers.
COCO: tuple[str, ...] = tuple(_TABLE["coco"])
BODY_25: tuple[str, ...] = tuple(_TABLE["body_25"])
SMPL: tuple[str, ...] = tuple(_TABLE["smpl"])
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
    """Names of the 15 finger bones of a hand, three for each of :data:`FINGERS`. ``side``: l or r.

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


#: Parents, by name, of the bones that the built-in humans have after those of the general skeleton, in their
#: order: 15 fingers of the left and of the right hand, toes, jaw and eyes (H-Anim 1.1).
DETAIL_BONES: Mapping[str, str] = _detail_parents()


def body_joints(names: Sequence[str]) -> list[int]:
    """Numbers of the joints without those of :data:`DETAIL_BONES`, for uses that must not count fingers.

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
        bone: Part of the body that turns about the joint: that of the bone with this name. Empty for the end
            of a bone.
        hanim2: Name of a joint or site in H-Anim 2 (ISO/IEC 19774-1:2019), or None.
        smpl: Name in SMPL (in SMPL-X for fingers, jaw and eyes), or None.
        coco: Name in the 17 keypoints of COCO, or None.
        body_25: Name in BODY_25 of OpenPose, or None.
        near: Fields of the sets that have only a nearest joint.
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
        """Name in another set (a key of :data:`SETS`). ``~`` stands before a nearest joint. Empty for no
        joint."""
        name = getattr(self, column)
        return "" if name is None else f"~{name}" if column in self.near else name


#: All joints: first those of the general skeleton (trunk from below, left side, right side), then those of
#: :data:`DETAIL_BONES` with their ends.
JOINT_NAMES = tuple(JointName(**{**row, "near": tuple(row.get("near", ()))}) for row in _TABLE["joints"])
#: Joints of other sets that have no counterpart, by field of :class:`JointName`.
WITHOUT_JOINT = {
    column: tuple(name for name in names if name not in {getattr(row, column) for row in JOINT_NAMES})
    for column, names in (("smpl", SMPL), ("coco", COCO), ("body_25", BODY_25))
}
