"""Tables of the keypoint sets: names in their order, place in the body, lines to draw, OKS constants."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import pairwise
from typing import TypeVar

from humansim_ros.errors import KeypointError, did_you_mean

_Value = TypeVar("_Value")
#: Set of all keypoints of OpenPose.
_OPENPOSE = "openpose137"
#: Names of the points of Face Mesh begin with this.
_MESH = "mesh-"


@dataclass(frozen=True, repr=False)
class KeypointSet:
    """A set of K keypoints. Left and right are the person's.

    Attributes:
        name: Name in scenes, commands and topics, such as ``coco17``.
        title: Name for people.
        names: K names in the order of the field.
        points: Anatomical point of each keypoint: a joint of the skeleton, or a name of
            :mod:`humansim_ros.keypoints.skin`.
        edges: Pairs of keypoints to connect by lines.
        sigmas: K constants of the object keypoint similarity (OKS), where they are published; else None.
        source: Citation with URL.
    """

    name: str
    title: str
    names: tuple[str, ...]
    points: tuple[str, ...]
    edges: tuple[tuple[int, int], ...]
    sigmas: tuple[float, ...] | None
    source: str

    def __repr__(self) -> str:
        return f"KeypointSet({self.name!r}, {len(self)} keypoints)"

    def __len__(self) -> int:
        return len(self.names)

    @cached_property
    def mirrored(self) -> tuple[int, ...]:
        """(K,) number of the same keypoint of the other side; its own number if there is none.

        Example:
            >>> coco17 = keypoint_set("coco17")
            >>> coco17.names[coco17.mirrored[coco17.index("left_knee")]]
            'right_knee'
        """
        return tuple(map(self._mirrored, range(len(self))))

    def _mirrored(self, number: int) -> int:
        name, opposite = self.names[number], _other_side(self.points[number])
        partner = _other_side(name)
        if partner != name or "-" not in name:
            return self.names.index(partner) if partner in self.names else number
        # numbered keypoints, such as face-16, have the side of their point
        return self.names.index(
            next(
                other
                for other, place in zip(self.names, self.points, strict=True)
                if place == opposite and other.partition("-")[0] == name.partition("-")[0]
            )
        )

    @cached_property
    def parts(self) -> Mapping[str, tuple[int, ...]]:
        """Numbers of the keypoints of ``face`` (68), ``left_hand`` and ``right_hand`` (21), if it has them.

        Example:
            >>> min(keypoint_set("wholebody133").parts["left_hand"])
            91
        """
        names = {"face": tuple(_FACE), **{f"{side}_hand": tuple(_hand(side)) for side in _SIDES}}
        return {
            part: tuple(map(self.names.index, own))
            for part, own in names.items()
            if set(own) <= set(self.names)
        }

    def subset(self, numbers: Sequence[int], sigmas: tuple[float, ...] | None = None) -> KeypointSet:
        """Set of some of the keypoints. ``sigmas``: their OKS constants."""
        names, points = (tuple(each[number] for number in numbers) for each in (self.names, self.points))
        places = {number: place for place, number in enumerate(numbers)}
        edges = tuple((places[a], places[b]) for a, b in self.edges if a in places and b in places)
        return replace(self, names=names, points=points, edges=edges, sigmas=sigmas)

    @cached_property
    def openpose_fields(self) -> Mapping[str, tuple[int, ...]]:
        """Numbers of the keypoints in each field of a person in files of OpenPose.

        OpenPose has fields of their own for the parts of ``openpose137``; other sets are in one field, as
        Pose2Sim has them.

        Example:
            >>> fields = keypoint_set("openpose137").openpose_fields
            >>> {field: len(numbers) for field, numbers in fields.items()}
            {'pose': 25, 'face': 70, 'hand_left': 21, 'hand_right': 21}
        """
        fields = {"pose": range(len(self)), "face": (), "hand_left": (), "hand_right": ()}
        if self.name == _OPENPOSE:
            start = self.index("face-0")
            hands = (self.parts[f"{side}_hand"] for side in _SIDES)
            fields = dict(
                zip(fields, (range(start), range(start, start + len(_FACE70)), *hands), strict=True)
            )
        return {field: tuple(numbers) for field, numbers in fields.items()}

    @property
    def has_body(self) -> bool:
        """Whether it has more than a hand or a face."""
        own = sum(not name.startswith(_MESH) for name in self.names)
        return own - sum(map(len, self.parts.values())) > 2  # face70 has pupils

    def index(self, name: str) -> int:
        """Number of a keypoint. Raises KeypointError for an unknown name."""
        if name not in self.names:
            raise KeypointError(f"{self.name} has no keypoint {name!r}{did_you_mean(name, self.names)}")
        return self.names.index(name)


def _other_side(name: str) -> str:
    """Name of a keypoint with left and right exchanged: ``left_knee``, ``LKnee``, ``lKnee``."""
    exchanged = {"left": "right", "right": "left", "L": "R", "R": "L", "l": "r", "r": "l"}
    return re.sub(r"left|right|^[LRlr](?=[A-Z])", lambda found: exchanged[found.group()], name)


def keypoint_set(name: str) -> KeypointSet:
    """Keypoint set of a name. Raises KeypointError, which lists the known names.

    Example:
        >>> keypoint_set("coco17").names[:3]
        ('nose', 'left_eye', 'right_eye')
    """
    if name not in KEYPOINT_SETS:
        known = ", ".join(KEYPOINT_SETS)
        message = f"no keypoint set {name!r}; the sets are {known}{did_you_mean(name, KEYPOINT_SETS)}"
        raise KeypointError(message)
    return KEYPOINT_SETS[name]


class BySet(Mapping[str, _Value]):
    """Values of all keypoint sets by name, each computed on first access.

    Raises KeypointError, which is a KeyError, for the name of no set.
    """

    def __init__(self, compute: Callable[[KeypointSet], _Value]) -> None:
        self._compute = compute
        self._values: dict[str, _Value] = {}

    def __getitem__(self, name: str) -> _Value:
        if name not in self._values:
            self._values[name] = self._compute(keypoint_set(name))
        return self._values[name]

    def __iter__(self) -> Iterator[str]:
        return iter(KEYPOINT_SETS)

    def __len__(self) -> int:
        return len(KEYPOINT_SETS)


def _make(
    name: str,
    title: str,
    points: Mapping[str, str],
    lines: Iterable[str],
    source: str,
    sigmas: tuple[float, ...] | None = None,
) -> KeypointSet:
    """Make a set. ``lines``: chains of keypoints, separated by spaces. ``source``: citation."""
    names = tuple(points)
    number = {keypoint: index for index, keypoint in enumerate(names)}
    edges = []
    for line in lines:
        chain = line.split()
        edges += [(number[a], number[b]) for a, b in pairwise(chain)]
    return KeypointSet(name, title, names, tuple(points.values()), tuple(edges), sigmas, source)


_SIDES = ("left", "right")
_LIMBS = ("shoulder", "elbow", "wrist", "hip", "knee", "ankle")
#: Prefix of a side in the names of joints of the skeleton.
_JOINT_SIDE = {"left": "l", "right": "r"}


def _rows(text: str) -> dict[str, str]:
    """Anatomical point by keypoint, from ``keypoint point, keypoint point``."""
    return dict(row.split() for row in text.split(","))


def _both(*names: str) -> dict[str, str]:
    """Points of the skin of both sides, the left one first, under their own names."""
    return {f"{side}_{name}": f"{side}_{name}" for name in names for side in _SIDES}


def _limb(side: str, *joints: str, name: str = "{side}_{joint}") -> dict[str, str]:
    """Joints of the limbs of one side; ``name``: pattern of the names in the set."""
    letter = side[0].upper()
    return {
        name.format(side=side, joint=joint, S=letter, s=side[0], Joint=joint.title()): (
            f"{_JOINT_SIDE[side]}_{joint}"
        )
        for joint in joints
    }


#: Constants of the object keypoint similarity [Lin 2014], in the order of COCO.
_COCO_SIGMAS = (
    *(0.026, 0.025, 0.025, 0.035, 0.035, 0.079, 0.079, 0.072, 0.072),
    *(0.062, 0.062, 0.107, 0.107, 0.087, 0.087, 0.089, 0.089),
)
_COCO = {
    "nose": "nose",
    **_both("eye", "ear"),
    **{name: point for joint in _LIMBS for side in _SIDES for name, point in _limb(side, joint).items()},
}
_FACE_LINES = (
    "left_eye left_ear",
    "nose left_eye right_eye nose",
    "right_eye right_ear",
)
_ARM_LINES = tuple(f"{side}_shoulder {side}_elbow {side}_wrist" for side in _SIDES)
_LEG_LINES = tuple(f"{side}_hip {side}_knee {side}_ankle" for side in _SIDES)
_COCO17 = _make(
    "coco17",
    "COCO, 17 keypoints",
    _COCO,
    (
        *_FACE_LINES,
        *_ARM_LINES,
        *_LEG_LINES,
        "left_ear left_shoulder right_shoulder right_ear",
        "left_shoulder left_hip right_hip right_shoulder",
    ),
    "T.-Y. Lin et al.: Microsoft COCO: common objects in context, ECCV 2014. "
    "https://cocodataset.org/#keypoints-eval",
    _COCO_SIGMAS,
)
_HALPE26_LINES = (
    *_FACE_LINES,
    *_ARM_LINES,
    *_LEG_LINES,
    "head neck hip",
    *(f"neck {side}_shoulder" for side in _SIDES),
    *(f"hip {side}_hip" for side in _SIDES),
    *(f"{side}_ankle {side}_{toe}" for side in _SIDES for toe in ("big_toe", "small_toe", "heel")),
)
_HALPE26 = _make(
    "halpe26",
    "HALPE, 26 keypoints (AlphaPose)",
    _COCO
    | {"head": "head_top", "neck": "neck_base", "hip": "mid_hip"}
    | _both("big_toe", "small_toe", "heel"),
    _HALPE26_LINES,
    "H.-S. Fang et al.: AlphaPose: whole-body regional multi-person pose estimation and tracking in "
    "real-time, TPAMI 2022. https://github.com/Fang-Haoshu/Halpe-FullBody",
    (*_COCO_SIGMAS, 0.026, 0.026, 0.066, 0.079, 0.079, 0.079, 0.079, 0.079, 0.079),
)
_BODY25_LINES = (
    "Nose Neck MidHip",
    *(f"Neck {s}Shoulder {s}Elbow {s}Wrist" for s in "RL"),
    *(f"MidHip {s}Hip {s}Knee {s}Ankle" for s in "RL"),
    *(f"Nose {s}Eye {s}Ear" for s in "RL"),
    *(f"{s}Ankle {s}BigToe {s}SmallToe" for s in "RL"),
    *(f"{s}Ankle {s}Heel" for s in "RL"),
)
_BODY25 = _make(
    "body25",
    "OpenPose BODY_25",
    {
        "Nose": "nose",
        "Neck": "mid_shoulder",
        **_limb("right", "shoulder", "elbow", "wrist", name="{S}{Joint}"),
        **_limb("left", "shoulder", "elbow", "wrist", name="{S}{Joint}"),
        "MidHip": "mid_hip",
        **_limb("right", "hip", "knee", "ankle", name="{S}{Joint}"),
        **_limb("left", "hip", "knee", "ankle", name="{S}{Joint}"),
        **_rows("REye right_eye, LEye left_eye, REar right_ear, LEar left_ear"),
        **_rows("LBigToe left_big_toe, LSmallToe left_small_toe, LHeel left_heel"),
        **_rows("RBigToe right_big_toe, RSmallToe right_small_toe, RHeel right_heel"),
    },
    _BODY25_LINES,
    "Z. Cao et al.: OpenPose: realtime multi-person 2D pose estimation using part affinity fields, "
    "TPAMI 2019. https://cmu-perceptual-computing-lab.github.io/openpose/web/html/doc/md_doc_02_output.html",
)
_H36M17 = _make(
    "h36m17",
    "Human3.6M, 17 joints",
    {
        "Hip": "mid_hip",
        **_rows("RHip r_hip, RKnee r_knee, RFoot r_ankle"),
        **_rows("LHip l_hip, LKnee l_knee, LFoot l_ankle"),
        **_rows("Spine spine_middle, Thorax neck_base, Neck/Nose skull_middle, Head vt3_end"),
        **_limb("left", "shoulder", "elbow", "wrist", name="{S}{Joint}"),
        **_limb("right", "shoulder", "elbow", "wrist", name="{S}{Joint}"),
    },
    (
        "Hip Spine Thorax Neck/Nose Head",
        *(f"Hip {s}Hip {s}Knee {s}Foot" for s in "RL"),
        *(f"Thorax {s}Shoulder {s}Elbow {s}Wrist" for s in "LR"),
    ),
    "C. Ionescu et al.: Human3.6M: large scale datasets and predictive methods for 3D human sensing in "
    "natural environments, TPAMI 2014. http://vision.imar.ro/human3.6m/",
)
_PANOPTIC19 = _make(
    "panoptic19",
    "CMU Panoptic, 19 joints",
    {
        **_rows("Neck neck_base, Nose nose, BodyCenter mid_hip"),
        **_limb("left", *_LIMBS, name="{s}{Joint}"),
        **_limb("right", *_LIMBS, name="{s}{Joint}"),
        **_rows("lEye left_eye, lEar left_ear, rEye right_eye, rEar right_ear"),
    },
    (
        "Nose Neck BodyCenter",
        *(f"Neck {s}Shoulder {s}Elbow {s}Wrist" for s in "lr"),
        *(f"BodyCenter {s}Hip {s}Knee {s}Ankle" for s in "lr"),
        *(f"Nose {s}Eye {s}Ear" for s in "lr"),
    ),
    "H. Joo et al.: Panoptic Studio: a massively multiview system for social interaction capture, "
    "TPAMI 2017. http://domedb.perception.cs.cmu.edu/",
)
_SMPL24 = _make(
    "smpl24",
    "SMPL, 24 joints",
    {
        **_rows("pelvis pelvis, left_hip l_hip, right_hip r_hip, spine1 spine_1"),
        **_rows("left_knee l_knee, right_knee r_knee, spine2 spine_2"),
        **_rows("left_ankle l_ankle, right_ankle r_ankle, spine3 spine_3"),
        **_rows("left_foot l_foot_ball, right_foot r_foot_ball, neck vt3"),
        **_rows("left_collar l_collar, right_collar r_collar, head head_joint"),
        **{
            f"{side}_{joint}": f"{side[0]}_{joint}"
            for joint in ("shoulder", "elbow", "wrist")
            for side in _SIDES
        },
        **_rows("left_hand l_palm, right_hand r_palm"),
    },
    (
        "pelvis spine1 spine2 spine3 neck head",
        *(f"pelvis {side}_hip {side}_knee {side}_ankle {side}_foot" for side in _SIDES),
        *(f"spine3 {side}_collar {side}_shoulder {side}_elbow {side}_wrist {side}_hand" for side in _SIDES),
    ),
    "M. Loper et al.: SMPL: a skinned multi-person linear model, ACM TOG 2015. https://smpl.is.tue.mpg.de",
)
_MEDIAPIPE33 = _make(
    "mediapipe33",
    "MediaPipe Pose, 33 landmarks",
    {
        "nose": "nose",
        **{f"{side}_{eye}": f"{side}_{eye}" for side in _SIDES for eye in ("eye_inner", "eye", "eye_outer")},
        **_both("ear"),
        **_rows("mouth_left left_mouth, mouth_right right_mouth"),
        **{f"{side}_{j}": f"{side[0]}_{j}" for j in ("shoulder", "elbow", "wrist") for side in _SIDES},
        **{f"{side}_{f}": f"{side}_{f}_knuckle" for f in ("pinky", "index", "thumb") for side in _SIDES},
        **{f"{side}_{j}": f"{side[0]}_{j}" for j in ("hip", "knee", "ankle") for side in _SIDES},
        **_both("heel"),
        **{f"{side}_foot_index": f"{side}_big_toe" for side in _SIDES},
    },
    (
        *(f"nose {side}_eye_inner {side}_eye {side}_eye_outer {side}_ear" for side in _SIDES),
        "mouth_left mouth_right",
        *_ARM_LINES,
        *(f"{side}_wrist {side}_pinky {side}_index {side}_wrist {side}_thumb" for side in _SIDES),
        "left_shoulder right_shoulder right_hip left_hip left_shoulder",
        *_LEG_LINES,
        *(f"{side}_ankle {side}_heel {side}_foot_index {side}_ankle" for side in _SIDES),
    ),
    "V. Bazarevsky et al.: BlazePose: on-device real-time body pose tracking, 2020. "
    "https://ai.google.dev/edge/mediapipe/solutions/vision/pose_landmarker",
)
#: Markers of one side: of arm and head, then of the leg.
_ARM_MARKERS = {
    **_rows("SHO acromion, UPA upper_arm_{share}, ELB elbow_lateral, FRM forearm_{share}"),
    **_rows("WRA wrist_thumb, WRB wrist_pinky, FIN hand_back"),
}
_LEG_MARKERS = {
    **_rows("THI thigh_{share}, KNE knee_lateral, TIB shank_{share}, ANK ankle_lateral"),
    **_rows("HEE heel, TOE metatarsal"),
}
#: Markers in the upper third of their segment; the others are in the lower third. Sides differ, so that
#: software can tell them apart.
_UPPER = ("LUPA", "RFRM", "RTHI", "RTIB")


def _markers(side: str, markers: Mapping[str, str]) -> dict[str, str]:
    rows = {f"{side[0].upper()}{marker}": f"{side}_{point}" for marker, point in markers.items()}
    return {name: point.format(share="upper" if name in _UPPER else "lower") for name, point in rows.items()}


_PLUG_IN_GAIT = _make(
    "plug_in_gait",
    "Plug-in Gait, 39 surface markers",
    {
        **_rows("LFHD left_head_front, RFHD right_head_front"),
        **_rows("LBHD left_head_back, RBHD right_head_back"),
        **_rows("C7 c7, T10 t10, CLAV jugular_notch, STRN xiphoid, RBAK right_scapula"),
        **_markers("left", _ARM_MARKERS),
        **_markers("right", _ARM_MARKERS),
        **_rows("LASI left_asis, RASI right_asis, LPSI left_psis, RPSI right_psis"),
        **_markers("left", _LEG_MARKERS),
        **_markers("right", _LEG_MARKERS),
    },
    (
        "LFHD RFHD RBHD LBHD LFHD",
        "C7 CLAV STRN T10 C7 RBAK T10",
        "LASI RASI RPSI LPSI LASI",
        *(f"CLAV {s}SHO {s}UPA {s}ELB {s}FRM {s}WRA {s}FIN {s}WRB {s}FRM" for s in "LR"),
        *(f"{s}ASI {s}THI {s}KNE {s}TIB {s}ANK {s}TOE {s}HEE {s}ANK" for s in "LR"),
    ),
    "Vicon Motion Systems: Plug-in Gait reference guide. https://help.vicon.com",
)

_HANDS = (
    ("thumb", "thumb"),
    ("forefinger", "index"),
    ("middle_finger", "middle"),
    ("ring_finger", "ring"),
    ("pinky_finger", "pinky"),
)


def _hand(side: str) -> dict[str, str]:
    """The wrist and four points of each finger of a side: three joints, and the tip."""
    joints = {
        f"{side}_{name}{number}": f"{side[0]}_{finger}{number}" if number < 4 else f"{side[0]}_{finger}3_end"
        for name, finger in _HANDS
        for number in range(1, 5)
    }
    return {f"{side}_hand_root": f"{side[0]}_wrist"} | joints


def _hand_lines(side: str, root: str = "{side}_hand_root") -> tuple[str, ...]:
    return tuple(
        " ".join([root.format(side=side), *(f"{side}_{name}{number}" for number in range(1, 5))])
        for name, _ in _HANDS
    )


_JAW = (
    *(f"right_jaw_{number}" for number in range(1, 9)),
    "chin",
    *(f"left_jaw_{number}" for number in range(8, 0, -1)),
)
_BROWS = (
    *(f"right_brow_{number}" for number in range(5, 0, -1)),
    *(f"left_brow_{number}" for number in range(1, 6)),
)
_LIDS = (
    *(f"right_{part}" for part in ("eye_outer", "upper_lid_outer", "upper_lid_inner", "eye_inner")),
    *(f"right_{part}" for part in ("lower_lid_inner", "lower_lid_outer")),
    *(f"left_{part}" for part in ("eye_inner", "upper_lid_inner", "upper_lid_outer", "eye_outer")),
    *(f"left_{part}" for part in ("lower_lid_outer", "lower_lid_inner")),
)
_LIPS = (
    *("right_mouth", "right_upper_lip", "right_lip_peak", "upper_lip", "left_lip_peak", "left_upper_lip"),
    *("left_mouth", "left_lower_lip_outer", "left_lower_lip", "lower_lip", "right_lower_lip"),
    *("right_lower_lip_outer", "right_mouth_inner", "right_upper_lip_inner", "upper_lip_inner"),
    *("left_upper_lip_inner", "left_mouth_inner", "left_lower_lip_inner", "lower_lip_inner"),
    "right_lower_lip_inner",
)
#: Points of the face in the order of iBUG 300-W.
_FACE = {
    f"face-{number}": point
    for number, point in enumerate(
        (
            *_JAW,
            *_BROWS,
            *("nasion", "nose_bridge_upper", "nose_bridge_lower", "nose"),
            *("right_nose_wing", "right_nostril", "nose_base", "left_nostril", "left_nose_wing"),
            *_LIDS,
            *_LIPS,
        )
    )
}


def _face_line(*numbers: int) -> str:
    return " ".join(f"face-{number}" for number in numbers)


_FACE_CONTOURS = (
    _face_line(*range(17)),
    _face_line(*range(17, 22)),
    _face_line(*range(22, 27)),
    _face_line(*range(27, 31)),
    _face_line(*range(31, 36)),
    *(_face_line(*range(first, last), first) for first, last in ((36, 42), (42, 48), (48, 60), (60, 68))),
)
_FACE68 = _make(
    "face68",
    "iBUG 300-W, 68 points of the face",
    _FACE,
    _FACE_CONTOURS,
    "C. Sagonas et al.: 300 faces in-the-wild challenge: database and results, IVC 2016. "
    "https://ibug.doc.ic.ac.uk/resources/facial-point-annotations/",
)
_FACE70 = _make(
    "face70",
    "OpenPose face, 70 points",
    _FACE | {"face-68": "right_eye", "face-69": "left_eye"},
    _FACE_CONTOURS,
    "Z. Cao et al.: OpenPose: realtime multi-person 2D pose estimation using part affinity fields, "
    "TPAMI 2019. https://cmu-perceptual-computing-lab.github.io/openpose/web/html/doc/md_doc_02_output.html",
)
#: Landmarks of Face Mesh on the right side of the person, each with its mirror image on the left.
_MESH_PAIRS = (
    "3 248, 7 249, 20 250, 21 251, 22 252, 23 253, 24 254, 25 255, 26 256, 27 257, 28 258, 29 259, "
    "30 260, 31 261, 32 262, 33 263, 34 264, 35 265, 36 266, 37 267, 38 268, 39 269, 40 270, 41 271, "
    "42 272, 43 273, 44 274, 45 275, 46 276, 47 277, 48 278, 49 279, 50 280, 51 281, 52 282, 53 283, "
    "54 284, 55 285, 56 286, 57 287, 58 288, 59 289, 60 290, 61 291, 62 292, 63 293, 64 294, 65 295, "
    "66 296, 67 297, 68 298, 69 299, 70 300, 71 301, 72 302, 73 303, 74 304, 75 305, 76 306, 77 307, "
    "78 308, 79 309, 80 310, 81 311, 82 312, 83 313, 84 314, 85 315, 86 316, 87 317, 88 318, 89 319, "
    "90 320, 91 321, 92 322, 93 323, 95 324, 96 325, 97 326, 98 327, 99 328, 100 329, 101 330, "
    "102 331, 103 332, 104 333, 105 334, 106 335, 107 336, 108 337, 109 338, 110 339, 111 340, "
    "112 341, 113 342, 114 343, 115 344, 116 345, 117 346, 118 347, 119 348, 120 349, 121 350, "
    "122 351, 123 352, 124 353, 125 354, 126 355, 127 356, 128 357, 129 358, 130 359, 131 360, "
    "132 361, 133 362, 134 363, 135 364, 136 365, 137 366, 138 367, 139 368, 140 369, 141 370, "
    "142 371, 143 372, 144 373, 145 374, 146 375, 147 376, 148 377, 149 378, 150 379, 153 380, "
    "154 381, 155 382, 156 383, 157 384, 158 385, 159 386, 160 387, 161 388, 162 389, 163 390, "
    "165 391, 166 392, 167 393, 169 394, 170 395, 171 396, 172 397, 173 398, 174 399, 176 400, "
    "177 401, 178 402, 179 403, 180 404, 181 405, 182 406, 183 407, 184 408, 185 409, 186 410, "
    "187 411, 188 412, 189 413, 190 414, 191 415, 192 416, 193 417, 194 418, 196 419, 198 420, "
    "201 421, 202 422, 203 423, 204 424, 205 425, 206 426, 207 427, 208 428, 209 429, 210 430, "
    "211 431, 212 432, 213 433, 214 434, 215 435, 216 436, 217 437, 218 438, 219 439, 220 440, "
    "221 441, 222 442, 223 443, 224 444, 225 445, 226 446, 227 447, 228 448, 229 449, 230 450, "
    "231 451, 232 452, 233 453, 234 454, 235 455, 236 456, 237 457, 238 458, 239 459, 240 460, "
    "241 461, 242 462, 243 463, 244 464, 245 465, 246 466, 247 467"
)
#: Landmarks of Face Mesh that are points of 300-W: on the right side, and in the middle.
_MESH_RIGHT = _rows(
    "33 eye_outer, 160 upper_lid_outer, 158 upper_lid_inner, 133 eye_inner, 153 lower_lid_inner, "
    "144 lower_lid_outer, 61 mouth, 78 mouth_inner, 81 upper_lip_inner, 178 lower_lip_inner"
)
_MESH_MIDDLE = _rows("0 upper_lip, 13 upper_lip_inner, 14 lower_lip_inner, 17 lower_lip, 2 nose_base")


def _mesh_points() -> dict[str, str]:
    """Points of Face Mesh in their order."""
    points = {
        number: f"{side}_{_MESH_RIGHT.get(right, f'face_mesh_{right}')}"
        for right, left in _rows(_MESH_PAIRS).items()
        for number, side in ((right, "right"), (left, "left"))
    }
    return {
        f"{_MESH}{number}": points.get(number) or _MESH_MIDDLE.get(number, f"face_mesh_{number}")
        for number in map(str, range(468))
    }


def _mesh_line(text: str) -> str:
    return " ".join(f"{_MESH}{number}" for number in text.split())


_FACE468 = _make(
    "face468",
    "MediaPipe Face Mesh, 468 points of the face",
    _mesh_points(),
    (
        _mesh_line(
            "10 338 297 332 284 251 389 356 454 323 361 288 397 365 379 378 400 377 152 148 176 149 150 136 "
            "172 58 132 93 234 127 162 21 54 103 67 109 10"
        ),
        _mesh_line("61 185 40 39 37 0 267 269 270 409 291 375 321 405 314 17 84 181 91 146 61"),
        _mesh_line("78 191 80 81 82 13 312 311 310 415 308 324 318 402 317 14 87 178 88 95 78"),
        _mesh_line("33 246 161 160 159 158 157 173 133 155 154 153 145 144 163 7 33"),
        _mesh_line("263 466 388 387 386 385 384 398 362 382 381 380 374 373 390 249 263"),
        *map(
            _mesh_line, ("46 53 52 65 55", "70 63 105 66 107", "276 283 282 295 285", "300 293 334 296 336")
        ),
        _mesh_line("168 6 197 195 5 4"),
    ),
    "Y. Kartynnik, A. Ablavatski, I. Grishchenko, M. Grundmann: Real-time facial surface geometry from "
    "monocular video on mobile GPUs, 2019. "
    "https://ai.google.dev/edge/mediapipe/solutions/vision/face_landmarker",
)
_LEFT_HAND21, _RIGHT_HAND21 = (
    _make(
        f"{side}_hand21",
        f"{side} hand, 21 points (OpenPose, MediaPipe, COCO-WholeBody)",
        _hand(side),
        _hand_lines(side),
        "T. Simon et al.: Hand keypoint detection in single images using multiview bootstrapping, CVPR 2017. "
        "https://ai.google.dev/edge/mediapipe/solutions/vision/hand_landmarker",
    )
    for side in _SIDES
)
#: Constants of the object keypoint similarity of COCO-WholeBody [Jin 2020, evaluation/myeval_wholebody.py].
_FOOT_SIGMAS = (0.068, 0.066, 0.066, 0.092, 0.094, 0.094)
_FACE_SIGMAS = (
    *(0.042, 0.043, 0.044, 0.043, 0.040, 0.035, 0.031, 0.025, 0.020, 0.023, 0.029, 0.032, 0.037, 0.038),
    *(0.043, 0.041, 0.045, 0.013, 0.012, 0.011, 0.011, 0.012, 0.012, 0.011, 0.011, 0.013, 0.015, 0.009),
    *(0.007, 0.007, 0.007, 0.012, 0.009, 0.008, 0.016, 0.010, 0.017, 0.011, 0.009, 0.011, 0.009, 0.007),
    *(0.013, 0.008, 0.011, 0.012, 0.010, 0.034, 0.008, 0.008, 0.009, 0.008, 0.008, 0.007, 0.010, 0.008),
    *(0.009, 0.009, 0.009, 0.007, 0.007, 0.008, 0.011, 0.008, 0.008, 0.008, 0.010, 0.008),
)
_HAND_SIGMAS = (
    *(0.029, 0.022, 0.035, 0.037, 0.047, 0.026, 0.025, 0.024, 0.035, 0.018, 0.024, 0.022, 0.026, 0.017),
    *(0.021, 0.021, 0.032, 0.020, 0.019, 0.022, 0.031),
)
_TOES = ("big_toe", "small_toe", "heel")
_FOOT_LINES = tuple(f"{side}_ankle {side}_{toe}" for side in _SIDES for toe in _TOES)
_WHOLEBODY133 = _make(
    "wholebody133",
    "COCO-WholeBody, 133 keypoints",
    _COCO
    | {f"{side}_{toe}": f"{side}_{toe}" for side in _SIDES for toe in _TOES}
    | _FACE
    | _hand("left")
    | _hand("right"),
    (
        *_FACE_LINES,
        *_ARM_LINES,
        *_LEG_LINES,
        "left_ear left_shoulder right_shoulder right_ear",
        "left_shoulder left_hip right_hip right_shoulder",
        *_FOOT_LINES,
        *_FACE_CONTOURS,
        *(line for side in _SIDES for line in _hand_lines(side)),
    ),
    "S. Jin et al.: Whole-body human pose estimation in the wild, ECCV 2020. "
    "https://github.com/jin-s13/COCO-WholeBody",
    (*_COCO_SIGMAS, *_FOOT_SIGMAS, *_FACE_SIGMAS, *_HAND_SIGMAS, *_HAND_SIGMAS),
)
_HALPE136 = _make(
    "halpe136",
    "HALPE full body, 136 keypoints (AlphaPose)",
    dict(zip(_HALPE26.names, _HALPE26.points, strict=True)) | _FACE | _hand("left") | _hand("right"),
    (
        *_HALPE26_LINES,
        *_FACE_CONTOURS,
        *(line for side in _SIDES for line in _hand_lines(side)),
    ),
    _HALPE26.source,
    # halpecocotools/cocoeval.py of that source, which has other constants for the 26 points
    (*_COCO_SIGMAS, *3 * (0.08,), *6 * (0.089,), *110 * (0.015,)),
)
_OPENPOSE137 = _make(
    _OPENPOSE,
    "OpenPose, BODY_25 with face and hands",
    dict(zip(_BODY25.names, _BODY25.points, strict=True))
    | dict(zip(_FACE70.names, _FACE70.points, strict=True))
    | _hand("left")
    | _hand("right"),
    (
        *_BODY25_LINES,
        *_FACE_CONTOURS,
        *(line for side in _SIDES for line in _hand_lines(side)),
    ),
    _FACE70.source,
)

#: All keypoint sets by name.
KEYPOINT_SETS: Mapping[str, KeypointSet] = {
    keypoints.name: keypoints
    for keypoints in (
        *(_COCO17, _HALPE26, _BODY25, _H36M17, _PANOPTIC19, _SMPL24, _MEDIAPIPE33, _PLUG_IN_GAIT),
        *(_LEFT_HAND21, _RIGHT_HAND21, _FACE68, _FACE70, _FACE468, _WHOLEBODY133, _HALPE136),
        _OPENPOSE137,
    )
}

#: Sets of detectors that write keypoints without names, by the number of the keypoints. 18 are those of
#: OpenPose's model COCO: BODY_25 without the middle of the hips and the feet.
COUNTED_SETS: Mapping[int, KeypointSet] = {
    len(keypoints): keypoints
    for keypoints in (
        *(_COCO17, _HALPE26, _BODY25, _MEDIAPIPE33, _WHOLEBODY133, _HALPE136),
        _BODY25.subset((*range(8), *range(9, 19))),
    )
}
