"""Signs of an animal: bodies on four legs have the same joint tree, and often the same names, as a person.

A person may crawl, sit with the hands on the knees, have a tail or short legs. Only several signs together
make an animal, and never if the OFFSETs are a standing person.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from humansim_ros.motion.kinematics import Motion
from humansim_ros.rotations import unit_vectors
from humansim_ros.types import Array

#: Most frames, spread over the motion, that are looked at.
_MAX_SAMPLES = 100
#: The trunk stands on the legs if the angle between hips-shoulders and hips-ankles has at most this cosine.
_STANDING = -0.7
#: On all fours, the trunk is not opposite to the legs, and arms and legs point to the same side.
_TRUNK_TO_LEGS, _ARMS_TO_LEGS = -0.6, 0.3
#: People have legs of 1.5 to 2.3 times the trunk and arms of 0.54 to 0.68 times the legs; dogs, cats and
#: horses 0.7, and 0.9 to 1.0.
_SHORT_LEGS, _LONG_ARMS = 1.0, 0.8
#: One sign of the body means an animal if it is on all fours in this share of the frames; two signs, if the
#: trunk is opposite to the legs in less than the second share.
_FOURS, _UPRIGHT = 0.9, 0.5
#: Factor of the confidence for an animal, and for a body that may be one.
_ANIMAL, _DOUBTFUL = 0.05, 0.5
#: Parts, without their side, that a body needs to be looked at.
_PARTS = ("Hip", "Knee", "Shoulder", "Elbow")
_TAIL = re.compile(r"tail(?!or)", re.IGNORECASE)


@dataclass(frozen=True)
class BodySigns:
    """Signs that a body is that of an animal.

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
        """Whether legs are as short, and arms as long, as those of animals."""
        return self.legs < _SHORT_LEGS and self.arms > _LONG_ARMS

    @property
    def is_animal(self) -> bool:
        """Whether enough signs come together to say that this is no person."""
        signs = bool(self.tail) + self.has_animal_proportions
        moves = (signs == 1 and self.fours >= _FOURS) or (signs == 2 and self.upright < _UPRIGHT)
        return moves and not self.stands_in_offsets

    @property
    def plausibility(self) -> float:
        """Factor of the confidence that this is a person: 1, or less with signs of an animal."""
        if self.is_animal:
            return _ANIMAL
        crawls = self.fours >= _FOURS and not self.stands_in_offsets
        return _DOUBTFUL if crawls or self.has_animal_proportions else 1.0

    @property
    def reasons(self) -> tuple[str, ...]:
        """The signs of an animal, in words; nothing where the body is plausible."""
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
    """Signs of an animal in a motion with these joints (role -> joint); None without shoulders or elbows."""
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
    """Joint of the first part that a side has."""
    return next(roles[side + part] for part in parts if side + part in roles)


def _length(points: Array, roles: Mapping[str, int], limb: tuple[str, str, str]) -> float:
    """Mean length of a limb of both sides, median over poses."""
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
    """Names of the joints of a tail: called so, and not hair (a ponytail) or a coat above the shoulders."""
    upper = {roles[role] for role in ("Neck", "Head", "LeftShoulder", "RightShoulder") if role in roles}
    names = []
    for joint, name in enumerate(motion.joint_names):
        above = joint
        while above >= 0 and above not in upper:
            above = int(motion.parents[above])
        if above < 0 and _TAIL.search(name):
            names.append(name)
    return tuple(names)
