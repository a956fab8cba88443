"""Faces: actions with the names of Apple's ARKit, eyes that turn to a point with the head, and the jaw."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Literal, get_args

import numpy as np

from humansim_ros.errors import MotionError, unknown
from humansim_ros.files.reading import read_table
from humansim_ros.geometry import fit_similarity, rotate, smooth_step, unit_vectors
from humansim_ros.motion.body.kinematics import Rated
from humansim_ros.motion.body.skeleton import Skeleton
from humansim_ros.types import Array, Indices

_TABLE = read_table("faces")
#: Names of the 52 actions [Apple, ARFaceAnchor.BlendShapeLocation], sorted. Weights are from 0 to 1.
ACTIONS: tuple[str, ...] = tuple(_TABLE["actions"])
_NUMBERS = {name: number for number, name in enumerate(ACTIONS)}


def both_sides(weights: Mapping[str, float]) -> dict[str, float]:
    """Return weights by action. A name without a side becomes two names, one for each side.

    Example:
        >>> both_sides({"mouthSmile": 0.5, "jawOpen": 0.2})
        {'mouthSmileLeft': 0.5, 'mouthSmileRight': 0.5, 'jawOpen': 0.2}
    """
    return {
        each: weight
        for name, weight in weights.items()
        for each in ((name,) if name in _NUMBERS else (f"{name}Left", f"{name}Right"))
    }


def face_weights(weights: Mapping[str, float], names: Iterable[str] = ACTIONS) -> Array:
    """Weights (S,) in the order of ``names``, from weights by name. Actions without a weight get 0.

    Raises:
        MotionError: There is no such action, or a weight is not from 0 to 1.

    Example:
        >>> float(face_weights({"jawOpen": 0.5})[ACTIONS.index("jawOpen")])
        0.5
    """
    numbers = _NUMBERS if names is ACTIONS else {name: number for number, name in enumerate(names)}
    out = np.zeros(len(numbers))
    for name, weight in weights.items():
        if name not in numbers:
            message = unknown("action of the face", name, numbers, most=5)
            raise MotionError(f"{message} (docs/faces.md)")
        if not 0 <= weight <= 1:  # refuses NaN too
            raise MotionError(f"the weight of {name} must be from 0 to 1, not {weight!r}")
        out[numbers[name]] = weight
    return out


#: Actions for each action unit of FACS [Ekman 1978], without their sides.
_UNITS: dict[int, str] = {int(unit): action for unit, action in _TABLE["units"].items()}
ExpressionName = Literal["neutral", "happiness", "sadness", "surprise", "fear", "anger", "disgust"]
#: Action units of the six basic emotions [Friesen 1983]. The weights look natural on the built-in humans.
EXPRESSIONS: dict[str, dict[int, float]] = {
    name: {int(unit): weight for unit, weight in units.items()}
    for name, units in _TABLE["expressions"].items()
}
assert tuple(EXPRESSIONS) == get_args(ExpressionName)


def expression(name: str) -> Mapping[str, float]:
    """Weights by action for an expression at full strength: ``neutral`` or one of the six basic emotions.

    Raises:
        MotionError: There is no such expression.

    Example:
        >>> expression("surprise")["jawOpen"]
        0.4
    """
    if name not in EXPRESSIONS:
        raise MotionError(unknown("expression", name, EXPRESSIONS))
    return both_sides({_UNITS[unit]: weight for unit, weight in EXPRESSIONS[name].items()})


#: Weights of a face at rest.
FACE_AT_REST = Rated.at_rest(ACTIONS, (len(ACTIONS),), (0.0, 1.0))


# Yaw (to the person's left) and pitch (upwards) of an eye are angles from looking straight ahead, in the axes
# of the head. An action such as ``eyeLookUpLeft`` has the weight 1 where the eye is at its limit. It also
# moves the skin around the eye, since lids follow the eyes up and down [Leigh 2015].

#: The eyes, left first.
EYE_BONES = ("l_eyeball_joint", "r_eyeball_joint")
_HEAD, _TRUNK = "vt3", "vl5"
#: First value: up to this angle (degrees) only the eyes turn. Second: beyond this angle, the head turns, too,
#: by this share of the remaining angle [Stahl 1999]. Third: half the width of the smooth transition, degrees.
_EYES_ALONE, _HEAD_SHARE, _BEND = 18.0, 0.77, 10.0
#: First: yaws between which the head turns back until it is straight, since nobody looks behind. Second:
#: pitches between which the head turns less and less to the side. Degrees.
_TURNS_BACK, _STEEP = (150.0, 180.0), (45.0, 75.0)
#: Limits of the neck to the sides, downwards and upwards, radians: ``vt3`` of joint_limits/normal.yaml.
NECK_LIMITS: Array = np.radians([[-80.0, -50.0], [80.0, 60.0]])
#: Directions in the names of eye actions (2, 2, 2), for yaw and pitch of the left and the right eye.
_WAYS = [[("Out", "In"), ("Up", "Down")], [("In", "Out"), ("Up", "Down")]]
#: (2, 2, 2) numbers, in :data:`ACTIONS`, of the actions for these directions.
LOOKS: Indices = np.array(
    [
        [[ACTIONS.index(f"eyeLook{way}{side}") for way in ways] for ways in eye]
        for side, eye in zip(("Left", "Right"), _WAYS, strict=True)
    ]
)
#: Largest angles of the eyes, degrees [Shechtman 2005]: ``eyeball_joint`` of config/joint_limits/normal.yaml.
_LIMITS = {"Up": 28.0, "Down": 47.0, "In": 45.0, "Out": 44.0}
#: (2, 2, 2) limits of the actions of :data:`LOOKS`, radians.
LIMITS: Array = np.radians([[[_LIMITS[way] for way in ways] for ways in eye] for eye in _WAYS])


def looked_angles(weights: Array) -> Array:
    """Return yaw and pitch of both eyes (N, 2, 2), radians, for weights (N, 52) of the actions."""
    towards, away = np.moveaxis(weights[:, LOOKS] * LIMITS, -1, 0)
    return np.asarray(towards - away)


def with_looks(weights: Array, angles: Array) -> Array:
    """Set the weights (N, 52) of the actions of the eyes for angles (N, 2, 2), to 1 at most."""
    out = np.array(weights)
    out[:, LOOKS] = np.clip(np.stack([angles, -angles], axis=-1) / LIMITS, 0.0, 1.0)
    return out


def within_limits(angles: Array) -> Array:
    """Limit angles (N, 2, 2), radians, to the range in which eyes can turn."""
    return np.clip(angles, -LIMITS[..., 1], LIMITS[..., 0])


def head_turn(angles: Array) -> Array:
    """Return yaw and pitch (N, 2) by which the head turns when the eyes look to angles (N, 2), all in
    radians. For small angles, only the eyes turn. For larger angles, the head turns by a share of the
    remaining angle [Stahl 1999], as the head of a monkey does [Freedman 1997]. The transition is smooth."""
    away = np.degrees(np.linalg.norm(angles, axis=-1))
    beyond = away - _EYES_ALONE
    bent = np.where(beyond > _BEND, beyond, np.clip(beyond + _BEND, 0.0, None) ** 2 / (4 * _BEND))
    yaw, pitch = np.moveaxis(np.degrees(np.abs(angles)), -1, 0)
    back, steep = (
        smooth_step((angle - start) / (end - start))
        for angle, (start, end) in ((yaw, _TURNS_BACK), (pitch, _STEEP))
    )
    kept = np.stack([(1 - back) * (1 - steep), 1 - back * (1 - steep)], axis=-1)
    return np.asarray(kept * angles * (_HEAD_SHARE * bent / np.maximum(away, 1e-9))[..., None])


@dataclass(frozen=True)
class Eyes:
    """The eyeballs of a skeleton, and the head that turns with them.

    Attributes:
        head: Number of the bone of head and neck.
        bones: (2,) numbers of the bones of the eyes, left first.
        ends: (2,) numbers of the joints at the pupils.
        head_rest, rest: Rotations of the head (3, 3) and of the eyes (2, 3, 3) at rest.
    """

    skeleton: Skeleton
    head: int
    bones: Indices
    ends: Indices
    head_rest: Array
    rest: Array

    @classmethod
    def of(cls, skeleton: Skeleton) -> Eyes | None:
        """Eyes of a skeleton; None if the skeleton has no bones of eyes."""
        if not {_HEAD, _TRUNK, *EYE_BONES} <= set(skeleton.names):
            return None
        head, bones = skeleton.bone(_HEAD), np.array([skeleton.bone(name) for name in EYE_BONES])
        names = skeleton.joint_names
        ends = np.array([names.index(f"{name}_end") for name in EYE_BONES])
        rest = skeleton.rest[:, :3, :3]
        return cls(skeleton, head, bones, ends, rest[head], rest[bones])

    def rays(self, joints: Array) -> tuple[Array, Array]:
        """Point (N, 3) midway between the eyes; direction (N, 3) straight ahead. ``joints``: (N, J, 4, 4)."""
        ahead = self._head(joints) @ self.rest[:, :, 1].mean(0)
        return _positions(joints)[:, self.bones].mean(1), unit_vectors(ahead)

    def _head(self, joints: Array) -> Array:
        """Rotations (N, 3, 3) of the head from rest."""
        return np.asarray(joints[:, self.head, :3, :3] @ self.head_rest.T)

    def angles_to(self, joints: Array, points: Array) -> Array:
        """Angles (N, 2, 2) with which eyes look at points (N, 3). ``joints``: (N, J, 4, 4)."""
        back = self._head(joints).swapaxes(-1, -2)
        lines = points[:, None] - _positions(joints)[:, self.bones]
        return gaze_angles(rotate(back[:, None], lines)) - self._rest_angles

    def turn_head(self, joints: Array, points: Array, shares: Array) -> None:
        """Turn the head of joints (N, J, 4, 4), and all joints that the head carries, towards points (N, 3),
        by shares (N,) of the full turn. The head turns to the side first, then up or down, within the limits
        of the neck. If the motion already turned the head beyond a limit, that angle is kept."""
        head = self._head(joints)
        line = points - _positions(joints)[:, self.bones].mean(axis=1)
        angles = gaze_angles(rotate(head.swapaxes(-1, -2), line)) - self._rest_angles.mean(axis=0)
        turn = shares[:, None] * head_turn(angles)
        trunk = self.skeleton.bone(_TRUNK)
        trunk_turn = joints[:, trunk, :3, :3] @ self.skeleton.rest[trunk, :3, :3].T
        neck = gaze_angles((trunk_turn.swapaxes(-1, -2) @ head)[..., 2])
        lowest, highest = np.minimum(NECK_LIMITS[0], neck), np.maximum(NECK_LIMITS[1], neck)
        turn = np.clip(neck + turn, lowest, highest) - neck
        about = head @ _turns(turn) @ head.swapaxes(-1, -2)
        places, carried = _positions(joints), self._carried
        pivot = places[:, [self.head]]
        places[:, carried] = pivot + rotate(about[:, None], places[:, carried] - pivot)
        joints[:, carried, :3, :3] = about[:, None] @ joints[:, carried, :3, :3]

    @cached_property
    def _carried(self) -> Indices:
        """Numbers of the joints that the head carries, including its own joint."""
        bones = {self.head}
        for bone, parent in enumerate(self.skeleton.parents.tolist()):
            if parent in bones:
                bones.add(bone)
        return np.flatnonzero(np.isin(self.skeleton.joint_bones, list(bones)))

    def turn(self, joints: Array, angles: Array) -> None:
        """Set the eyes and pupils of joints (N, J, 4, 4) to angles (N, 2, 2) from rest."""
        head, rest = self._head(joints), self._rest_angles
        turned = head[:, None] @ _turns(rest + angles) @ _turns(rest).swapaxes(-1, -2) @ self.rest
        places = _positions(joints)
        centers = places[:, self.bones]
        reach = np.linalg.norm(places[:, self.ends] - centers, axis=-1, keepdims=True)
        joints[:, self.bones, :3, :3] = joints[:, self.ends, :3, :3] = turned
        places[:, self.ends] = centers + reach * turned[..., 1]

    @property
    def _rest_angles(self) -> Array:
        return gaze_angles(self.rest[:, :, 1])


def _positions(joints: Array) -> Array:
    """View (N, J, 3) of the positions of joints (N, J, 4, 4)."""
    return joints[..., :3, 3]


def gaze_angles(lines: Array) -> Array:
    """Yaw and pitch (..., 2) of directions (..., 3) in body space."""
    x, y, z = np.moveaxis(lines, -1, 0)
    return np.stack([np.arctan2(x, z), np.arctan2(y, np.hypot(x, z))], axis=-1)


def _turns(angles: Array) -> Array:
    """Rotations (..., 3, 3) that turn the z axis of body space to yaw and pitch (..., 2)."""
    (a, b), (c, d) = np.moveaxis(np.sin(angles), -1, 0), np.moveaxis(np.cos(angles), -1, 0)
    out = np.zeros((*angles.shape[:-1], 3, 3))
    out[..., 0, 0], out[..., 0, 1], out[..., 0, 2] = c, -a * b, a * d
    out[..., 1, 1], out[..., 1, 2] = d, b
    out[..., 2, 0], out[..., 2, 1], out[..., 2, 2] = -a, -c * b, c * d
    return out


BONE = "temporomandibular"
#: Actions that move the jaw.
MOVES = ("jawForward", "jawLeft", "jawOpen", "jawRight")


@dataclass(frozen=True, eq=False)
class Jaw:
    """The bone of the jaw, and the offsets by which actions of the face move the lower teeth.

    The shapes of the actions move the skin as well, so the bone does not move any skin. The bone gets the
    rigid motion that fits the offsets of the lower teeth best [Umeyama 1991].

    Attributes:
        bone, end: Numbers of the bone, and of the joint at the chin.
        rest: Frame (4, 4) of the bone at rest.
        actions: (A,) numbers of the actions.
        teeth, offsets: (K, 3) vertices of the lower teeth at rest, and their offsets (A, K, 3) by each action
            at weight 1, metres.
    """

    bone: int
    end: int
    rest: Array
    actions: Indices
    teeth: Array
    offsets: Array

    @classmethod
    def of(cls, skeleton: Skeleton, teeth: Array, offsets: Mapping[str, Array]) -> Jaw:
        """Create the jaw of a skeleton. ``teeth``: (K, 3). ``offsets``: action -> (K, 3)."""
        bone, end = skeleton.bone(BONE), skeleton.joint_names.index(f"{BONE}_end")
        actions, moved = zip(*((ACTIONS.index(name), offsets[name]) for name in MOVES), strict=True)
        return cls(bone, end, skeleton.rest[bone], np.array(actions), teeth, np.array(moved))

    def moves(self, weights: Array) -> bool:
        """Whether weights (..., 52) of the actions move the jaw."""
        return bool(weights[..., self.actions].any())

    def motions(self, weights: Array) -> tuple[Array, Array]:
        """Rotations (N, 3, 3) and shifts (N, 3), metres, of the jaw in the frame of its bone."""
        goals = self.teeth + np.einsum("na,aki->nki", weights[:, self.actions], self.offsets)
        teeth = np.broadcast_to(self.teeth, goals.shape)
        _, rotations, translations = fit_similarity(teeth, goals, scale=1.0)
        axes, head = self.rest[:3, :3], self.rest[:3, 3]
        shifts = rotate(rotations, head) + translations - head
        return np.asarray(axes.T @ rotations @ axes), shifts @ axes

    def open(self, joints: Array, weights: Array, sizes: Array) -> Array:
        """Return frames (N, J, 4, 4), jaw moved by weights (N, 52). ``sizes``: (N,) scale of the body."""
        if not self.moves(weights):
            return joints
        turns, shifts = self.motions(weights)
        out, both = joints.copy(), [self.bone, self.end]
        before = joints[:, self.bone, :3, :3]
        chin = np.swapaxes(before, -1, -2) @ (joints[:, self.end] - joints[:, self.bone])[:, :3, 3:]
        out[:, both, :3, :3] = (before @ turns)[:, None]
        out[:, self.bone, :3, 3] += sizes[:, None] * rotate(before, shifts)
        out[:, self.end, :3, 3] = out[:, self.bone, :3, 3] + rotate(before @ turns, chin[..., 0])
        return out

    def closed(self, bone: Array, weights: Array, size: float) -> Array:
        """Undo the motion by weights (52,) in a frame (4, 4) of the bone. ``size``: scale of the body."""
        (turn,), (shift,) = self.motions(weights[None])
        out = bone.copy()
        out[:3, :3] = bone[:3, :3] @ turn.T
        out[:3, 3] -= size * out[:3, :3] @ shift
        return out
