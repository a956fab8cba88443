"""Everyday activities from a seed: built-in motions one after the other, with feet that do not slide.

A motion follows another where their poses match. Somebody who stands can talk, sit down or begin to walk.
Somebody who walks can only walk on or stop. A walk has special first and last steps, so that no foot slides
while it stands. Each errand leads back to its start, so that an activity repeats without a jump.
"""

from __future__ import annotations

import random
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import lru_cache

import numpy as np
from scipy.spatial.transform import Rotation

from humansim_ros.errors import MotionError
from humansim_ros.files.reading import read_table, resource_path
from humansim_ros.geometry import smooth_step
from humansim_ros.motion.body.kinematics import Motion
from humansim_ros.motion.files.bvh import read_bvh
from humansim_ros.motion.matching.joint_tables import opposite_joints
from humansim_ros.types import Array

#: Frames per second of an activity.
RATE = 30
#: The last pose of a part fades into the next part over this number of frames.
_FADE = 8
#: Longest distance from the start, metres, that an errand reaches.
_REACH = 2.6


@dataclass(frozen=True)
class ActivityPart:
    """A part of a built-in motion, between two postures.

    Attributes:
        motion: Name of the motion.
        before: Posture in its first frame: ``stand``, ``sit``, or the name of a gait. In a gait, the left
            heel strikes the floor in this frame.
        after: Posture in its last frame. ``<gait>_half`` means that the right heel strikes the floor.
        start: Start in seconds of the motion.
        end: End in seconds of the motion. If None, the end of the motion.
    """

    motion: str
    before: str
    after: str
    start: float = 0.0
    end: float | None = None

    @property
    def span(self) -> tuple[float, float]:
        """Start and end in seconds of the motion."""
        return self.start, _clip(self.motion).duration if self.end is None else self.end


#: Table of all parts by name, of what people do and how often, and of stride lengths by gait, metres. In the
#: part that stops a gait, left and right are exchanged, since the right heel has struck before.
_TABLE = read_table("activities")
PARTS = {name: ActivityPart(*row) for name, row in _TABLE["parts"].items()}
_CHOICES: dict[str, dict[str, int]] = _TABLE["choices"]
#: Kinds of activity. ``around``: stand, talk, sit, walk on errands; ``desk``: sit, write, eat; ``standing``:
#: talk, phone, wait; ``exercise``: squats, jumping jacks, dance.
_KINDS = tuple(_CHOICES["kinds"])
#: Parts at a table.
_AT_TABLE = ("write", "eat")


@dataclass(frozen=True)
class ActivityStep:
    """A part in the plan of an activity. If ``mirror`` is set, left and right are exchanged."""

    part: str
    mirror: bool = False


def plan_activity(seed: int, seconds: float, kind: str | None = None) -> list[ActivityStep]:
    """Plan the parts of an activity.

    Args:
        seed: The same seed gives the same activity.
        seconds: Shortest duration.
        kind: Kind of activity. If None, the seed decides.

    Returns:
        Parts with matching postures. The last part ends at the place and in the posture where the first part
        begins.

    Example:
        >>> [step.part for step in plan_activity(4, 20, "standing")]
        ['pick_up', 'talk', 'stand']
    """
    plan = _Plan(random.Random(f"activity/{seed}"), seconds)
    chosen = kind or plan.one_of(_CHOICES["kinds"])
    while plan.seconds > 0:
        if chosen == "around":
            plan.around()
        else:
            plan.add(plan.other_of(_CHOICES[chosen]))
    return plan.steps


@dataclass
class _Plan:
    """A plan to which parts are added.

    Attributes:
        random: Random numbers. Every version of Python gives the same ones.
        seconds: Time that is left to fill.
        steps: Parts so far.
    """

    random: random.Random
    seconds: float
    steps: list[ActivityStep] = field(default_factory=list)

    def coin(self) -> bool:
        """Toss a coin."""
        return self.random.random() < 0.5

    def one_of(self, weights: dict[str, int]) -> str:
        """Choose one of some names, by weight."""
        place = self.random.random() * sum(weights.values())
        for name, weight in weights.items():
            place -= weight
            if place < 0:
                return name
        return next(iter(weights))

    def other_of(self, weights: dict[str, int]) -> str:
        """Choose a name as :meth:`one_of` does, but never the name of the last part."""
        last = self.steps[-1].part if self.steps else ""
        return self.one_of({name: weight for name, weight in weights.items() if name != last} or weights)

    def add(self, *parts: str, mirror: bool = False) -> None:
        """Add parts."""
        for name in parts:
            self.steps.append(ActivityStep(name, mirror))
            start, end = PARTS[name].span
            self.seconds -= end - start

    def around(self) -> None:
        """Do something on the feet, sit for a while, or go on an errand and come back."""
        has_sat = bool(self.steps) and PARTS[self.steps[-1].part].motion == "sit_stand"
        what = self.one_of(_CHOICES["around"] | ({"sit": 0} if has_sat else {}))
        if what == "stand":
            name = self.other_of(_CHOICES["standing"])
            self.add(name, mirror=self.coin())
        elif what == "sit":
            self.add("sit_down")
            for _ in range(1 + int(2 * self.random.random())):
                self.add(self.one_of(_CHOICES["seat"]), mirror=self.coin())
            self.add("stand_up")
        else:
            self.errand()

    def errand(self) -> None:
        """Walk to one place or two, do something there, and walk back the same way."""
        gait = self.one_of(_CHOICES["gaits"])
        mirror = self.coin()
        legs = [(0, self._strides(gait))]
        if self.coin():
            legs.append((1 if self.coin() else -1, self._strides(gait)))
        for turn, strides in legs:
            self._turn(turn)
            self._walk(gait, strides, mirror)
            if self.random.random() < 0.7:
                self.add(self.other_of(_CHOICES["standing"]), mirror=self.coin())
        self._turn(2 if self.coin() else -2)
        for turn, strides in reversed(legs):
            self._walk(gait, strides, mirror)
            self._turn(-turn)
        self._turn(2 if self.coin() else -2)

    def _strides(self, gait: str) -> int:
        """Number of whole strides of a walk, so that the errand stays in reach."""
        return int(int(_REACH / _TABLE["strides"][gait]) * self.random.random())

    def _walk(self, gait: str, strides: int, mirror: bool) -> None:
        """Walk straight ahead. At the end, the posture of the feet and the heading are those of the start."""
        self.add(f"{gait}_start", *[gait] * strides, f"{gait}_half", mirror=mirror)
        self.add(f"{gait}_stop", mirror=not mirror)

    def _turn(self, quarters: int) -> None:
        """Turn on the spot by quarters of a circle: to the left, or to the right if negative."""
        self.add(*["turn_left"] * abs(quarters), mirror=quarters < 0)


#: Base name of all activities: ``activity#4`` is the one with seed 4.
ACTIVITY = "activity"
#: Shortest and longest activity, and its usual duration, seconds.
_SHORTEST, _LONGEST, _USUAL = 1.0, 600.0, 60.0


def is_activity(name: str) -> bool:
    """Whether a motion name is the name of an activity, such as ``activity#4,desk``."""
    return name == ACTIVITY or name.startswith(f"{ACTIVITY}#")


def read_activity(name: str) -> Motion:
    """Make the motion of an activity from its name: ``activity#SEED``, with ``,KIND`` and ``,SECONDS``.

    The kind and the seconds may be left out. ``activity`` alone has the seed 1. The same name gives the same
    motion. The motion lasts for the given seconds (a minute by default), and longer until its last part is
    done.

    Raises:
        MotionError: The name has no seed, or an unknown kind, or seconds outside 1 to 600.

    Example:
        >>> read_activity("activity#4,standing,20").duration >= 20
        True
    """
    return joined(plan_activity(*_settings(name)), name)


def _settings(name: str) -> tuple[int, float, str | None]:
    """Seed, seconds and kind of an activity from its name. Raises MotionError."""
    seed, kind, seconds = 1, None, _USUAL
    words = [word.strip() for word in name.removeprefix(ACTIVITY).removeprefix("#").split(",")]
    try:
        seed = seed if name == ACTIVITY else int(words[0])
        for word in words[1:]:
            if word in _KINDS:
                kind = word
            else:
                seconds = float(word)
        if not (seed >= 0 and _SHORTEST <= seconds <= _LONGEST and len(words) <= 3):
            raise ValueError
    except ValueError:
        raise MotionError(
            f"{name[:60]!r} is no activity: give a seed, and if you like a kind and {_SHORTEST:g} to "
            f"{_LONGEST:g} seconds, as in activity#4 or activity#4,desk,120; the kinds are "
            f"{', '.join(_KINDS)}"
        ) from None
    return seed, seconds, kind


def needs_table(name: str) -> bool:
    """Whether a person in a built-in motion or an activity writes or eats at a table."""
    if is_activity(name):
        return any(step.part in _AT_TABLE for step in plan_activity(*_settings(name)))
    return name in _AT_TABLE


def joined(steps: Sequence[ActivityStep], path: str = "") -> Motion:
    """Join parts to one motion. Each must begin in the posture in which the part before it ends.

    Each part begins where the part before it ends: the ankles are in the same place. Other differences of the
    pose fade out in a quarter of a second.
    """
    values = [_values(steps[0])]
    for step in steps[1:]:
        values.append(_continued(values[-1][-1], _values(step))[1:])
    base = _clip(PARTS[steps[0].part].motion)
    return replace(base, values=np.concatenate(values), frame_time=1 / RATE, path=path, up="y")


@lru_cache(maxsize=64)
def _clip(name: str) -> Motion:
    """A built-in motion."""
    return read_bvh(resource_path(f"assets/motions/{name}.bvh"))


def _values(step: ActivityStep) -> Array:
    """Frames (F, C) of a part at the rate of activities."""
    part = PARTS[step.part]
    motion = _clip(part.motion)
    every = round(1 / RATE / motion.frame_time)
    first, last = (round(seconds * RATE) for seconds in part.span)
    values = motion.values[::every][first : last + 1]
    return _mirrored(values) if step.mirror else values


def _mirrored(values: Array) -> Array:
    """Exchange left and right in frames (F, C)."""
    motion = _clip("stand")
    out = values.copy()
    for joint, other in enumerate(opposite_joints(motion.joint_names, {}).tolist()):
        for column, source, channel in zip(
            motion.columns(joint), motion.columns(other), motion.channels[joint], strict=True
        ):
            sign = -1.0 if channel in ("Xposition", "Yrotation", "Zrotation") else 1.0
            out[:, column] = sign * values[:, source]
    return out


def _continued(last: Array, values: Array) -> Array:
    """Move and turn frames (F, C) to go on from the frame ``last`` (C,), and fade from that frame."""
    motion = _clip("stand")
    both = replace(motion, values=np.stack([last, values[0]]))
    feet = both.world_positions()[:, [motion.joint("LeftAnkle"), motion.joint("RightAnkle")]]
    across = feet[:, 0] - feet[:, 1]
    yaw = np.arctan2(across[:, 0], across[:, 2])
    turn = Rotation.from_euler("y", yaw[0] - yaw[1])
    middle = feet.mean(axis=1)
    out = values.copy()
    moved = turn.apply(values[:, :3] - middle[1]) + middle[0]
    out[:, [0, 2]] = moved[:, [0, 2]]
    heading = turn * Rotation.from_euler("ZXY", values[:, 3:6], degrees=True)
    out[:, 3:6] = heading.as_euler("ZXY", degrees=True)
    share = 1 - smooth_step(np.arange(min(_FADE, len(out))) / _FADE)
    for columns in (list(motion.columns(joint))[-3:] for joint, names in enumerate(motion.channels) if names):
        before = Rotation.from_euler("ZXY", last[columns], degrees=True)
        after = Rotation.from_euler("ZXY", out[: len(share), columns], degrees=True)
        rest = (before * after[0].inv()).as_rotvec()
        faded = Rotation.from_rotvec(share[:, None] * rest) * after
        out[: len(share), columns] = faded.as_euler("ZXY", degrees=True)
    out[: len(share), :3] += share[:, None] * (last[:3] - out[0, :3])
    return out
