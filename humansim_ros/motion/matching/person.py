"""Match the joints of a motion to bones, by names or else by shape. Refuse animals on four legs.

Because a person may crawl, several signs of an animal must come together.
"""

from __future__ import annotations

import os
import re
from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

from humansim_ros.errors import MotionError
from humansim_ros.geometry import unit_vectors
from humansim_ros.motion.body.kinematics import Motion
from humansim_ros.motion.matching.by_name import (
    LIMBS,
    ancestors,
    detail_joints,
    match_names_in_motion,
    spread_frames,
)
from humansim_ros.motion.matching.by_shape import match_shape
from humansim_ros.motion.matching.joint_tables import MIN_CONFIDENCE, JointMatch
from humansim_ros.types import Array

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
#: Factors of the confidence for an animal, and for a body that may be an animal.
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
        """Whether the signs together show an animal."""
        signs = bool(self.tail) + self.has_animal_proportions
        moves = (signs == 1 and self.fours >= _FOURS) or (signs == 2 and self.upright < _UPRIGHT)
        return moves and not self.stands_in_offsets

    @property
    def plausibility(self) -> float:
        """Factor of the confidence that this is a person: 1, or less for signs of an animal."""
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
            reasons += [
                f"the legs are {self.legs:.1f} times as long as the trunk (a person's: 1.5 to 2.3)",
                f"the arms {self.arms:.1f} times as long as the legs (a person's: 0.5 to 0.7)",
            ]
        if self.tail:
            reasons.append(f"it has a tail ({', '.join(self.tail[:2])})")
        return tuple(reasons)


def look_at_body(motion: Motion, roles: Mapping[str, int]) -> BodySigns | None:
    """Find signs of an animal in a motion with joints ``roles``. None without shoulders or elbows."""
    if not all(side + part in roles for side in ("Left", "Right") for part in _PARTS):
        return None
    points = motion.world_positions(spread_frames(motion, _MAX_SAMPLES))
    trunk, legs, arms = _directions(points, roles)
    leg, arm = (_length(points, roles, limb) for limb in LIMBS)
    upright = _cosine(trunk, legs) < _TRUNK_TO_LEGS
    at_rest, legs_at_rest, _ = _directions(motion.rest_positions()[None], roles)
    return BodySigns(
        fours=float((~upright & (_cosine(arms, legs) > _ARMS_TO_LEGS)).mean()),
        upright=float(upright.mean()),
        stands_in_offsets=bool(_cosine(at_rest, legs_at_rest)[0] < _STANDING),
        tail=_tail(motion, roles),
        legs=leg / max(float(np.median(np.linalg.norm(trunk, axis=-1))), 1e-9),
        arms=arm / max(leg, 1e-9),
    )


def _directions(points: Array, roles: Mapping[str, int]) -> tuple[Array, Array, Array]:
    """Vectors (F, 3) of poses (F, J, 3): hips to shoulders, hips to ankles, shoulders to wrists. Knees and
    elbows replace unknown ankles and wrists."""

    def middle(part: str, instead: str = "") -> Array:
        joints = (roles.get(side + part, roles.get(side + instead, -1)) for side in ("Left", "Right"))
        return np.asarray(sum(points[:, joint] for joint in joints) / 2)

    hips, shoulders = middle("Hip"), middle("Shoulder")
    return shoulders - hips, middle("Ankle", "Knee") - hips, middle("Wrist", "Elbow") - shoulders


def _length(points: Array, roles: Mapping[str, int], limb: tuple[str, str, str]) -> float:
    """Mean length of a limb of both sides. The length of each side is the median over all poses."""
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
    """Names of joints of a tail. Hair (a ponytail) and coats above the shoulders do not count."""
    upper = {roles[role] for role in ("Neck", "Head", "LeftShoulder", "RightShoulder") if role in roles}
    tails = ((joint, name) for joint, name in enumerate(motion.joint_names) if _TAIL.search(name))
    return tuple(n for joint, n in tails if upper.isdisjoint((joint, *ancestors(joint, motion.parents))))


def match_motion(
    motion: Motion, table: str | os.PathLike[str] | None = None, min_confidence: float | None = None
) -> JointMatch:
    """Match the joints of a motion to bones.

    If ``table`` is given (name of a built-in table, or a YAML file), this table is used. Otherwise the
    built-in table is used that best fits names and hierarchy. If none fits, the shape of the skeleton
    decides. Signs of an animal lower the confidence.

    Raises:
        MotionError: The table does not fit, or the motion is not that of a person: the confidence is below
            ``min_confidence`` (by default 0.12).
    """
    min_confidence = MIN_CONFIDENCE if min_confidence is None else min_confidence
    try:
        match = match_names_in_motion(motion, table)
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
        animal = f" but rather an animal: {', '.join(match.reasons)}" if match.reasons else ""
        raise MotionError(
            f"this is not a person{animal} (confidence {match.confidence:.1%}, below {min_confidence:.0%}). "
            "To play it nevertheless, set min_confidence to 0 (--min-confidence 0)",
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
