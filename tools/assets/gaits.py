"""Walks at other speeds than make_walk.py's, and the first and the last step of a walk.

    python tools/assets/make_motions.py walk_slow walk_brisk walk_start walk_stop

A walk at another speed is the same plan, fitted to the published curves scaled by the length of its stride.
The first step leads from the pose of somebody who stands to the heel strike of the left foot, with which the
walk straight ahead begins; the last step leads from that heel strike to the standing pose. The foot on the
floor does not move in either.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache

import numpy as np
from figure import Figure, Pose, minimum_jerk, mixed, posed
from make_walk import (
    CLEARANCE,
    SIDES,
    SPEED,
    STEP_WIDTH,
    STRIDE_TIME,
    TOE_OFF,
    TOE_OUT,
    Array,
    Foot,
    Path2D,
    Walk,
    apply,
    fit,
    rot,
)

#: Gaits by name: metres per second, seconds of a stride (half of it is a whole number of frames). Cadence and
#: stride change alike with the speed.
GAITS = {"walk_slow": (0.8, 1.2), "walk_brisk": (1.65, 28 / 30)}
#: The walk of make_walk.py.
NORMAL = (SPEED, STRIDE_TIME)
#: Seconds of the first and the last step in strides, and share of the last one in which the hips arrive.
FIRST_STEP, LAST_STEP, _ARRIVE = 1.1, 1.0, 0.6
#: Share of the first step after which the foot leaves the floor; phase of the stride in which a foot is flat.
_LEAVE, _FLAT = 0.33, 0.16
#: Height of a swing, metres; pitch that it adds, radians; share with which the rotation of the foot that
#: pushes off goes on in its swing.
_LIFT, _PUSH, _GOES_ON = 0.05, 0.15, 0.15
#: Metres of air below the foot in the swing of a slow walk, which the curves of the normal one do not give.
_SLOW_CLEARANCE = 0.034
#: Pitch of the first swing in the normal walk, with which the toes stay behind, radians.
_PUSH_OFF = 0.7
#: Radians by which the arms are aside in the middle of a step.
_ASIDE = 0.12
#: Metres by which the hips sink in the first step.
_DIP = 0.018
#: Seconds before the strike in which the foot of the first step comes onto its way in the walk.
_LANDING = 0.2
#: Seconds between a contact with the floor and the moment in which the foot is measured.
_JUST = 1e-3


@lru_cache
def walk_of(figure: Figure, speed: float, stride_time: float) -> Walk:
    """A walk straight ahead, fitted."""
    path = Path2D(0.0)
    clear = CLEARANCE if speed >= SPEED else _SLOW_CLEARANCE
    return Walk(figure.body, fit(figure.body, path, speed, stride_time, clear), path, speed, stride_time)


@dataclass(frozen=True)
class State:
    """Values (C,) of something that moves, and their change in a second."""

    value: Array
    rate: Array

    @staticmethod
    def at(values: Callable[[Array], Array], time: float, step: float = 5e-4) -> State:
        """State at a time of something whose values (T, C) at times (T,) are known."""
        before, here, after = values(np.array([time - step, time, time + step]))
        return State(here, (after - before) / (2 * step))

    @staticmethod
    def still(value: Array) -> State:
        """Something that does not move."""
        return State(value, 0 * value)


def way(time: Array, begin: float, end: float, start: State, goal: State) -> Array:
    """Values (T, C) on the smoothest way from one state to another, which it stays in before and after."""
    length = end - begin
    w = np.clip((time - begin) / length, 0, 1)[:, None]
    whole = w**3 * (10 - 15 * w + 6 * w**2)
    out = start.value + whole * (goal.value - start.value)
    out = out + length * (w * (1 - 6 * w**2 + 8 * w**3 - 3 * w**4)) * start.rate
    return np.asarray(out - length * (w**3 * (4 - 7 * w + 3 * w**2)) * goal.rate)


@dataclass(frozen=True)
class Transition:
    """A walk, and somebody who stands with one foot in a footprint of it.

    Attributes:
        figure: The body.
        walk: The walk; its left heel strikes at time 0.
        side: Foot that stands in its footprint.
    """

    figure: Figure
    walk: Walk
    side: str

    @cached_property
    def turn(self) -> Array:
        """Rotation (3, 3) of the person who stands."""
        return rot("y", SIDES[self.side] * TOE_OUT)

    @cached_property
    def place(self) -> Array:
        """Translation (3,) of the person who stands."""
        ankle = self.figure.body.joints[f"{self.side}Ankle"]
        ahead = self.walk.plan.lead - (self.walk.stride / 2 if self.side == "Right" else 0.0)
        footprint = np.array([SIDES[self.side] * STEP_WIDTH / 2, ankle[1], ahead])
        return np.asarray(footprint - self.turn @ ankle)

    def standing_foot(self, side: str) -> Array:
        """Ankle, pitch and yaw (5,) of a foot of the person who stands."""
        ankle = self.turn @ self.figure.body.joints[f"{side}Ankle"] + self.place
        return np.array([*ankle, 0.0, SIDES[self.side] * TOE_OUT])

    def walking_foot(self, side: str, time: Array) -> Array:
        """Ankle, pitch and yaw (T, 5) of a foot of the walk."""
        rotation, ankle = self.walk.foot(side, time)
        yaw = SIDES[side] * TOE_OUT
        tilt = rot("y", -yaw) @ rotation @ rot("y", Foot.of(self.figure.body, side).yaw)
        pitch = -np.arctan2(tilt[:, 2, 1], tilt[:, 1, 1])
        return np.column_stack([ankle, pitch, np.full(len(time), yaw)])

    def foot(self, side: str, way: Array) -> tuple[Array, Array]:
        """Rotation and ankle of a foot from its ankle, pitch and yaw (T, 5)."""
        turn = rot("y", way[:, 4]) @ rot("x", -way[:, 3])
        return turn @ rot("y", -Foot.of(self.figure.body, side).yaw), way[:, :3]

    def pose(self, time: Array, share: Array, hips: Array, feet: dict[str, Array]) -> Pose:
        """Pose of the person who walks (``share`` 1) or stands (0); feet as for :meth:`foot`."""
        still = posed(self.figure, np.linspace(0.0, 1.0, 2), ())
        moving, _ = self.walk.rotations(time)

        def blend(one: Array, other: Array) -> Array:
            return mixed(np.broadcast_to(self.turn @ one[0], other.shape), other, share)

        arms = {}
        for side in SIDES:
            upper, fore = (
                blend(each, moving[side + joint] @ self.figure.straight(side, end).T)
                for each, joint, end in zip(
                    still.arms[side][:2], ("Shoulder", "Elbow"), ("Elbow", "Wrist"), strict=True
                )
            )
            # past the thigh, which is not below the shoulder in a step to the side
            aside = rot("z", SIDES[side] * _ASIDE * np.sin(np.pi * share) ** 2)
            arms[side] = (aside @ upper, aside @ fore, np.eye(3))
        trunk = (
            blend(one, moving[joint])
            for one, joint in ((still.chest, "Chest"), (still.neck, "Neck"), (still.head, "Head"))
        )
        planes = {side: self.foot(side, way) for side, way in feet.items()}
        return Pose(blend(still.pelvis, moving["Hips"]), hips, *trunk, planes, arms)

    def standing_hips(self) -> Array:
        """Hips (3,) of the person who stands."""
        return np.asarray(self.turn @ posed(self.figure, np.linspace(0.0, 1.0, 2), ()).hips[0] + self.place)


def first_step(figure: Figure, walk: Walk, time: Array) -> Pose:
    """From standing to the heel strike of the left foot; the right foot is on the floor."""
    move, end = Transition(figure, walk, "Right"), time[-1]
    leave, at = _LEAVE * end, time - end
    still, goal = State.still(move.standing_hips()), _hips(walk, 0.0)
    hips = way(time, 0.0, end, still, goal)
    hips[:, 1] -= _DIP * np.sin(np.pi * time / end) ** 1.5
    # the weight goes to the standing foot first
    hips[:, 0] = way(time, 0.0, 0.85 * end, still, State.still(goal.value))[:, 0]
    push = _PUSH_OFF * walk.effort**3.2
    swing = _swing(time, leave, end, State.still(move.standing_foot("Left")), _foot(move, "Left", -_JUST))
    inside = np.clip((time - leave) / (end - leave), 0, 1)
    swing[:, 3] -= push * np.sin(np.pi * inside**1.2) ** 2
    swing[:, 1] += 0.15 * push * np.sin(np.pi * inside) ** 2
    # the foot lands as in the walk
    landing = minimum_jerk(1 + at / _LANDING)[:, None]
    feet = {
        "Left": swing + landing * (move.walking_foot("Left", np.minimum(at, -1e-9)) - swing),
        "Right": move.walking_foot("Right", np.maximum(at, (_FLAT - 0.5) * walk.stride_time)),
    }
    return move.pose(at, minimum_jerk(time / end), hips, feet)


def last_step(figure: Figure, walk: Walk, time: Array) -> Pose:
    """From the heel strike of the left foot, which stays, to standing."""
    move, end = Transition(figure, walk, "Left"), time[-1]
    leave, land = (TOE_OFF - 0.5) * walk.stride_time, 0.9 * end
    hips = way(time, 0.0, _ARRIVE * end, _hips(walk, 0.0), State.still(move.standing_hips()))
    off = _foot(move, "Right", leave - _JUST)
    off = replace(off, rate=off.rate * (1, 1, 1, _GOES_ON, 1))
    swing = _swing(time, leave, land, off, State.still(move.standing_foot("Right")))
    walking = move.walking_foot("Right", np.minimum(time, leave))
    feet = {
        "Left": move.walking_foot("Left", np.minimum(time, _FLAT * walk.stride_time)),
        "Right": np.where((time < leave)[:, None], walking, swing),
    }
    return move.pose(time, 1 - minimum_jerk(time / end), hips, feet)


def _hips(walk: Walk, time: float) -> State:
    return State.at(lambda times: walk.pelvis(times)[1], time)


def _foot(move: Transition, side: str, time: float) -> State:
    return State.at(lambda times: move.walking_foot(side, times), time)


def _swing(time: Array, leave: float, land: float, start: State, end: State) -> Array:
    """Ankle, pitch and yaw (T, 5) of a foot in the air."""
    out = way(time, leave, land, start, end)
    inside = np.clip((time - leave) / (land - leave), 0, 1)
    out[:, 1] += _LIFT * np.sin(np.pi * inside) ** 1.3
    out[:, 3] -= _PUSH * np.sin(2 * np.pi * inside) * np.sin(np.pi * inside)
    return out


#: Wrists of somebody who carries a box, from the joint of the chest, for the left arm, metres; their elbow.
_CARRY, _ELBOW = np.array([0.19, -0.05, 0.36]), np.array([0.5, -1.0, -0.3])


def carry(figure: Figure, walk: Walk, time: Array) -> tuple[dict[str, Array], Array]:
    """World rotations of all joints and positions of the hips of a walk with a box in both hands."""
    rotations, hips = walk.rotations(time)
    pelvis, chest = rotations["Hips"], rotations["Chest"]
    origin = hips + apply(pelvis, figure.body.link("Chest"))
    for side, sign in SIDES.items():
        wrist = origin + apply(chest, _CARRY * (sign, 1, 1))
        elbow = apply(chest, _ELBOW * (sign, 1, 1))
        upper, fore = figure.reaching(side, figure.shoulder(side, chest, hips, pelvis), wrist, elbow)
        for joint, end, world in (
            ("Shoulder", "Elbow", upper),
            ("Elbow", "Wrist", fore),
            ("Wrist", "Wrist_end", fore),
        ):
            rotations[side + joint] = world @ figure.straight(side, end)
    return rotations, hips
