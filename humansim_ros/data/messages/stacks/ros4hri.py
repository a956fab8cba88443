"""Links of a human as ROS4HRI names them (REP-155, draft): true poses, URDF, and nearest joint angles.

When all angles of the model are zero, a person stands with hanging arms, and all links have the axes of the
body: x forward, y to the person's left, z up. Links, joints and axes of rotation are those of the package
human_description of ROS4HRI; the lengths are those of the skeleton. The model has one joint in the spine, no
clavicles, and fixed wrists and ankles. So the angles of the model can only come near to a pose, but the poses
of :meth:`HriLinks.poses` are exact.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple
from xml.etree import ElementTree

import numpy as np

from humansim_ros.geometry import (
    cross_products,
    perpendicular,
    rotation_vector_to_matrix,
    shortest_rotations,
    transform,
    unit_vectors,
)
from humansim_ros.motion.body import EYE_BONES, Skeleton
from humansim_ros.types import Array


class UrdfJoint(NamedTuple):
    """A joint of the URDF model. ``axis``: axis of rotation; None for a fixed joint."""

    name: str
    parent: str
    child: str
    axis: tuple[int, int, int] | None


def _arm(side: str) -> tuple[UrdfJoint, ...]:
    """Joints of an arm. Axes of the right side are mirrored, as in human_description."""
    out = 1 if side == "l" else -1
    return (
        UrdfJoint(f"{side}_y_shoulder", "torso", f"{side}_y_shoulder", (0, 0, -out)),
        UrdfJoint(f"{side}_p_shoulder", f"{side}_y_shoulder", f"{side}_p_shoulder", (out, 0, 0)),
        UrdfJoint(f"{side}_r_shoulder", f"{side}_p_shoulder", f"{side}_shoulder", (0, 0, out)),
        UrdfJoint(f"{side}_elbow", f"{side}_shoulder", f"{side}_elbow", (0, -1, 0)),
        UrdfJoint(f"{side}_wrist", f"{side}_elbow", f"{side}_wrist", None),
    )


def _leg(side: str) -> tuple[UrdfJoint, ...]:
    out = 1 if side == "l" else -1
    return (
        UrdfJoint(f"{side}_y_hip", "body", f"{side}_y_hip", (0, 0, -1)),
        UrdfJoint(f"{side}_p_hip", f"{side}_y_hip", f"{side}_p_hip", (out, 0, 0)),
        UrdfJoint(f"{side}_r_hip", f"{side}_p_hip", f"{side}_hip", (0, -1, 0)),
        UrdfJoint(f"{side}_knee", f"{side}_hip", f"{side}_knee", (0, -1, 0)),
        UrdfJoint(f"{side}_ankle", f"{side}_knee", f"{side}_ankle", None),
    )


#: Joints of the model, parents before children.
URDF_JOINTS: tuple[UrdfJoint, ...] = (
    UrdfJoint("waist", "body", "waist", (0, 1, 0)),
    UrdfJoint("torso", "waist", "torso", None),
    UrdfJoint("r_head", "torso", "r_head", (1, 0, 0)),
    UrdfJoint("y_head", "r_head", "y_head", (0, 0, 1)),
    UrdfJoint("p_head", "y_head", "p_head", (0, -1, 0)),
    UrdfJoint("head", "p_head", "head", None),
    *_arm("l"),
    *_arm("r"),
    *_leg("l"),
    *_leg("r"),
)
#: Names of the links, the root first; and names of the 20 joints that are not fixed.
LINKS: tuple[str, ...] = ("body", *(joint.child for joint in URDF_JOINTS))
JOINTS: tuple[str, ...] = tuple(joint.name for joint in URDF_JOINTS if joint.axis is not None)

_AXES = {joint.name: np.array(joint.axis, float) for joint in URDF_JOINTS if joint.axis is not None}
#: Axes of a link when all angles are zero, as columns in body space: forward, left, up.
_UPRIGHT: Array = np.array([[0.0, 1.0, 0.0], [0.0, 0.0, 1.0], [1.0, 0.0, 0.0]])
_DOWN: Array = np.array([0.0, -1.0, 0.0])
#: Bone that a link is attached to, by link.
_BONES = {
    "body": "HumanoidRoot",
    "waist": "vl5",
    "torso": "vl5",
    "head": "vt3",
    **{f"{side}_{name}": f"{side}_{name}" for side in "lr" for name in ("hip", "knee", "ankle")},
    **{f"{side}_{name}": f"{side}_{name}" for side in "lr" for name in ("shoulder", "elbow", "wrist")},
}


class _Limb(NamedTuple):
    """Links of an arm or leg. ``bend``: 1 if the limb bends forward like an elbow, -1 if backward like a
    knee."""

    upper: str
    lower: str
    end: str
    parent: str
    bend: float


class _Ball(NamedTuple):
    """Ball joint, made of three joints with one axis each: their names, parent link, child link."""

    names: tuple[str, str, str]
    parent: str
    end: str


_LIMBS = (
    *(_Limb(f"{side}_shoulder", f"{side}_elbow", f"{side}_wrist", "torso", 1.0) for side in "lr"),
    *(_Limb(f"{side}_hip", f"{side}_knee", f"{side}_ankle", "body", -1.0) for side in "lr"),
)
_BALLS = (
    _Ball(("r_head", "y_head", "p_head"), "torso", "p_head"),
    *(
        _Ball((f"{side}_y_{name}", f"{side}_p_{name}", f"{side}_r_{name}"), parent, f"{side}_{name}")
        for side in "lr"
        for name, parent in (("shoulder", "torso"), ("hip", "body"))
    ),
)
#: If the sine of the angle at elbow or knee is below this, the twist of the limb is taken from the bone,
#: since the direction of the bend is uncertain.
_STRAIGHT = 0.1
#: Radius of limbs and of the head as the URDF draws them, metres.
_LIMB_RADIUS, _HEAD_RADIUS = 0.03, 0.1
#: Placeholder for the id of a body in a cached URDF.
_ID = "@"
#: Height of the origin of link ``head`` for a skeleton without eyes: share of the way from the base of the
#: neck to the top of the head.
_EYE_HEIGHT = 0.55


@dataclass(frozen=True)
class HriLinks:
    """Computes the links of ROS4HRI for a skeleton. ``skeleton``: must have the 22 general bones."""

    skeleton: Skeleton

    @classmethod
    def of(cls, skeleton: Skeleton) -> HriLinks | None:
        """Create the object for a skeleton; None if the skeleton lacks bones that ROS4HRI needs."""
        return cls(skeleton) if set(_BONES.values()) <= set(skeleton.names) else None

    def poses(self, joints: Array) -> dict[str, Array]:
        """True poses (4, 4) of all links in ``map`` by name, from joints (J, 4, 4) of the skeleton. The
        origin of a link is its joint. The links between the three axes of neck, shoulder or hip are included.
        They are turned by the angles of these axes."""
        size = self.size(joints)
        rotations = {link: joints[self._bone[link], :3, :3] @ self._turns[link] for link in _BONES}
        places = {link: joints[self._bone[link], :3, 3] for link in _BONES}
        places["body"] = (places["l_hip"] + places["r_hip"]) / 2
        for link in ("torso", "head"):
            places[link] = places[link] + size * rotations[link] @ self.origins[link]
        places["p_head"], rotations["p_head"] = joints[self._bone["head"], :3, 3], rotations["head"]
        for names, parent, end in _BALLS:
            angles = _ball_angles(names, rotations[parent].T @ rotations[end])
            turn = rotations[parent]
            for name, angle in zip(names[:2], angles, strict=False):
                turn = turn @ rotation_vector_to_matrix(_AXES[name] * angle)
                rotations[name], places[name] = turn, places[end]
        return {link: transform(rotations[link], places[link]) for link in LINKS}

    def angles(self, joints: Array) -> Array:
        """Angles (20,) of the model that come nearest to a pose, radians, in the order of :data:`JOINTS`.
        ``joints``: (J, 4, 4) joints of the pose.

        Link ``body`` has its true pose. The waist turns so that the sum of squared distances of neck and
        shoulders is smallest. Then head and limbs get their true directions, and elbows and knees their true
        angles. A nearly straight limb takes its twist from the bone.
        """
        size, true = self.size(joints), self.poses(joints)
        body = true["body"]
        start = body[:3, 3] + size * body[:3, :3] @ self.origins["waist"]
        fixed = self.origins["torso"] + np.stack(
            [self.origins[name] for name in ("r_head", "l_y_shoulder", "r_y_shoulder")]
        )
        seen = np.stack([true[name][:3, 3] for name in ("p_head", "l_shoulder", "r_shoulder")]) - start
        (x, _, z), (a, _, c) = fixed.T, (seen @ body[:3, :3]).T
        waist = math.atan2(a @ z - c @ x, a @ x + c @ z)
        torso = body[:3, :3] @ rotation_vector_to_matrix(_AXES["waist"] * waist)
        found = {"waist": waist}
        targets = {"p_head": torso.T @ true["head"][:3, :3]}
        for upper, lower, end, parent, bend in _LIMBS:
            first, second, third = (true[link][:3, 3] for link in (upper, lower, end))
            along, beyond = unit_vectors(second - first), unit_vectors(third - second)
            turn = _hinged(along, bend * perpendicular(beyond, along), true[upper][:3, 0])
            ahead = turn.T @ beyond
            found[lower] = math.atan2(ahead[0], -ahead[2])
            targets[upper] = (torso if parent == "torso" else body[:3, :3]).T @ turn
        for names, _, end in _BALLS:
            found |= zip(names, _ball_angles(names, targets[end]), strict=True)
        return np.array([found[name] for name in JOINTS])

    def gaze(self, joints: Array) -> Array:
        """Rotation (3, 3) in ``map`` of the gaze: z along the mean direction of both eyes, x right, y down.
        For a skeleton without eyes, z is the x axis of the head."""
        head = joints[self._bone["head"], :3, :3] @ self._turns["head"]
        ahead = head[:, 0]
        if set(EYE_BONES) <= set(self.skeleton.names):
            ahead = unit_vectors(joints[[self.skeleton.bone(name) for name in EYE_BONES], :3, 1].sum(axis=0))
        right = unit_vectors(cross_products(-head[:, 2], ahead))
        return np.stack([right, cross_products(ahead, right), ahead], axis=1)

    @cached_property
    def origins(self) -> dict[str, Array]:
        """Origin (3,) of each link, except the root, in the axes of its parent when all angles are zero,
        metres."""
        own = self._rest_places
        shoulders = (own["l_shoulder"] + own["r_shoulder"]) / 2
        neck, middle = own["head"], (own["l_hip"] + own["r_hip"]) / 2
        out = {
            "waist": _UPRIGHT.T @ (own["waist"] - middle),
            "torso": _UPRIGHT.T @ (shoulders - own["waist"]),
            "r_head": _UPRIGHT.T @ (neck - shoulders),
            "y_head": np.zeros(3),
            "p_head": np.zeros(3),
            "head": _UPRIGHT.T @ (self._face - neck),
        }
        for upper, lower, end, parent, _ in _LIMBS:
            base = shoulders if parent == "torso" else middle
            side, _, name = upper.partition("_")
            out[f"{side}_y_{name}"] = _UPRIGHT.T @ (own[upper] - base)
            out[f"{side}_p_{name}"] = out[upper] = np.zeros(3)
            out[lower] = np.array([0.0, 0.0, -np.linalg.norm(own[lower] - own[upper])])
            out[end] = np.array([0.0, 0.0, -np.linalg.norm(own[end] - own[lower])])
        return out

    def urdf(self, body: str, size: float = 1.0) -> str:
        """URDF of the person with the suffix ``_<body>`` on all links and joints.

        Lengths are those of the skeleton. Joints have limits of half a turn, so that every pose is possible.

        Args:
            body: Id of the body.
            size: Scale of the person, see :meth:`size`.
        """
        text = self._unscaled if size == 1.0 else self._urdf_of(size)
        return text.replace(_ID, body)

    @cached_property
    def _unscaled(self) -> str:
        return self._urdf_of(1.0)

    def _urdf_of(self, size: float) -> str:
        """URDF for a scale, with :data:`_ID` in place of the id of the body. Cached."""
        add, robot = ElementTree.SubElement, ElementTree.Element("robot", name=f"human_{_ID}")
        add(add(robot, "material", name="skin"), "color", rgba="0.9 0.65 0.5 1")
        for link in LINKS:
            element = add(robot, "link", name=f"{link}_{_ID}")
            if link == "head":
                _visual(element, ElementTree.Element("sphere", radius=_text(size * _HEAD_RADIUS)))
            for joint in URDF_JOINTS:
                if joint.parent == link and self.origins[joint.child].any():
                    _segment(element, size * self.origins[joint.child], size * _LIMB_RADIUS)
        half = _text(math.pi)
        for joint in URDF_JOINTS:
            kind = "fixed" if joint.axis is None else "revolute"
            element = add(robot, "joint", name=f"{joint.name}_{_ID}", type=kind)
            add(element, "parent", link=f"{joint.parent}_{_ID}")
            add(element, "child", link=f"{joint.child}_{_ID}")
            add(element, "origin", xyz=_text(*(size * self.origins[joint.child])))
            if joint.axis is not None:
                add(element, "axis", xyz=_text(*joint.axis))
                add(element, "limit", lower=f"-{half}", upper=half, effort="1000", velocity="10")
        ElementTree.indent(robot)
        return '<?xml version="1.0"?>\n' + ElementTree.tostring(robot, encoding="unicode") + "\n"

    def size(self, joints: Array) -> float:
        """Scale of the person in a pose, relative to the skeleton at rest. Keyframes may change the size of a
        person."""
        return self.skeleton.size_of(joints[: len(self.skeleton), :3, 3])

    @cached_property
    def _bone(self) -> dict[str, int]:
        return {link: self.skeleton.bone(bone) for link, bone in _BONES.items()}

    @cached_property
    def _rest_places(self) -> dict[str, Array]:
        """Place (3,) of each link of :data:`_BONES` at rest in body space, metres."""
        return {link: self.skeleton.heads[bone] for link, bone in self._bone.items()}

    @cached_property
    def _face(self) -> Array:
        """Middle between both eyes (3,) at rest in body space, metres."""
        skeleton = self.skeleton
        if set(EYE_BONES) <= set(skeleton.names):
            return np.asarray(skeleton.heads[[skeleton.bone(name) for name in EYE_BONES]].mean(axis=0))
        neck = self._bone["head"]
        return np.asarray(skeleton.heads[neck] + _EYE_HEIGHT * (skeleton.tails[neck] - skeleton.heads[neck]))

    @cached_property
    def _turns(self) -> dict[str, Array]:
        """Rotation (3, 3) of each link of :data:`_BONES` relative to its bone."""
        own, rest = self._rest_places, dict.fromkeys(("body", "waist", "torso", "head"), _UPRIGHT)
        for upper, lower, end, *_ in _LIMBS:
            first = unit_vectors(own[lower] - own[upper])
            second = unit_vectors(own[end] - own[lower])
            rest[upper] = shortest_rotations(_DOWN, first) @ _UPRIGHT
            rest[lower] = rest[end] = shortest_rotations(first, second) @ rest[upper]
        return {link: self.skeleton.rest[self._bone[link], :3, :3].T @ turn for link, turn in rest.items()}


def _ball_angles(names: tuple[str, str, str], turn: Array) -> tuple[float, float, float]:
    """Split a rotation (3, 3) into the angles about the three axes of a ball joint. Shoulders turn about z,
    x, z (the angle about x is from 0 to half a turn), hips about z, x, y, and the head about x, z, y."""
    signs = [_AXES[name].sum() for name in names]
    if names[0].endswith("shoulder"):
        away = math.hypot(turn[2, 0], turn[2, 1])
        side = signs[1]  # lifts an arm outwards
        if away < 1e-9:  # the arm hangs, or points straight up: the last axis has the whole twist
            first, last = 0.0, math.atan2(turn[1, 0], turn[0, 0])
        else:
            first = math.atan2(side * turn[0, 2], -side * turn[1, 2])
            last = math.atan2(side * turn[2, 0], side * turn[2, 1])
        found = (first, side * math.atan2(away, turn[2, 2]), last)
    elif names[0].endswith("hip"):
        second = math.asin(min(1.0, max(-1.0, turn[2, 1])))
        found = (math.atan2(-turn[0, 1], turn[1, 1]), second, math.atan2(-turn[2, 0], turn[2, 2]))
    else:
        second = math.asin(min(1.0, max(-1.0, -turn[0, 1])))
        found = (math.atan2(turn[2, 1], turn[1, 1]), second, math.atan2(turn[0, 2], turn[0, 0]))
    first, second, last = (float(sign * angle) for sign, angle in zip(signs, found, strict=True))
    return first, second, last


def _hinged(along: Array, bend: Array, ahead: Array) -> Array:
    """Rotation (3, 3) of an upper arm or thigh, so that the limb bends at elbow or knee in its true plane.

    Args:
        along: Direction (3,) of the upper part of the limb; the z axis points the opposite way.
        bend: Direction (3,) towards which the limb bends. Its length is the sine of the angle.
        ahead: x axis (3,) of the bone, used if the limb is nearly straight.
    """
    weight = _STRAIGHT * math.exp(-float(bend @ bend) / _STRAIGHT**2)
    x = unit_vectors(perpendicular(bend + weight * ahead, along))
    return np.stack([x, cross_products(-along, x), -along], axis=1)


def _text(*numbers: float) -> str:
    return " ".join(f"{number:.12g}" for number in numbers)


def _visual(link: ElementTree.Element, shape: ElementTree.Element) -> ElementTree.Element:
    visual = ElementTree.SubElement(link, "visual")
    ElementTree.SubElement(visual, "geometry").append(shape)
    ElementTree.SubElement(visual, "material", name="skin")
    return visual


def _segment(link: ElementTree.Element, to: Array, radius: float) -> None:
    """Add to a link a cylinder from its origin to the point ``to`` (3,)."""
    length = float(np.linalg.norm(to))
    visual = _visual(link, ElementTree.Element("cylinder", radius=_text(radius), length=_text(length)))
    x, y, z = unit_vectors(to)
    rpy = _text(0.0, math.atan2(math.hypot(x, y), z), math.atan2(y, x))
    ElementTree.SubElement(visual, "origin", xyz=_text(*(to / 2)), rpy=rpy)
