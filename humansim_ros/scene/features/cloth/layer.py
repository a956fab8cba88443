"""Swing of loose cloth and hair: each end is a damped spring that the body carries along.

The swing at a time is a convolution of the earlier path of the end, sampled at fixed times, with the response
of the spring. The swing has no state: it depends only on the motion and the time, so times may come in any
order.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import ClassVar

import numpy as np

from humansim_ros.errors import MotionError
from humansim_ros.motion.body import CLOTH, HAIR, JointPoses, Rated, swing_at_rest
from humansim_ros.motion.pose import PoseStage
from humansim_ros.people.humans import Human
from humansim_ros.scene.core.actor import Actor
from humansim_ros.scene.core.layers import BodyPoses, PoseLayer
from humansim_ros.types import Array

#: Names of joints that carry the swing begin with this text.
LOOSE_JOINT = "loose/"
#: Largest swing that a message may carry, metres.
_LARGEST = 2.0
#: Seconds between samples of the path, and the number of earlier samples on which the swing depends.
_STEP, _TAPS = 1 / 30, 30
#: Number of samples that are computed together. The blocks are always the same, so that rounding does not
#: depend on the times that are requested.
_BLOCK, _MOST_BLOCKS = 8, 64
#: No part of a person is faster than this, m/s, so a longer step of the path is a jump.
_FASTEST = 20.0
#: Ends swing at most this far into the body, metres.
_INWARDS = 0.01


@dataclass(frozen=True)
class _Spring:
    """A spring: frequency in hertz, damping ratio, seconds of lag at constant speed, largest swing as a share
    of the length."""

    frequency: float
    damping: float
    drag: float
    largest: float

    def response(self) -> Array:
        """Weights (TAPS,) of the past positions relative to the present one. The latest sample comes first.
        For an anchor at x(t), the swing u of the end of the spring follows u'' + 2 d w u' + w^2 u = -x''.
        Integration by parts gives u = -integral of h''(s) (x(t - s) - x(t)), with the impulse response h."""
        times = _STEP * np.arange(1, _TAPS + 1)
        omega = 2 * math.pi * self.frequency
        decay, turn = self.damping * omega, omega * math.sqrt(1 - self.damping**2)
        second = (decay**2 - turn**2) * np.sin(turn * times) / turn - 2 * decay * np.cos(turn * times)
        # the last third of the response fades out
        fade = np.clip(3 * (1 - times / (times[-1] + _STEP)), 0.0, 1.0)
        window = np.exp(-decay * times) * fade
        weights = -second * window * _STEP
        # at constant speed, the end lags by the drag. This corrects what the window and the sums have lost
        correction = times * window
        lost = self.drag - float(weights @ times)
        return np.asarray(weights + lost / float(correction @ times) * correction)


_SPRINGS = {CLOTH: _Spring(1.7, 0.45, 0.03, 0.3), HAIR: _Spring(1.6, 0.42, 0.02, 0.35)}

#: Function of N scene times. Returns positions (N, K, 3) of upper ends and of lower ends, and directions (N,
#: K, 3) outwards.
EndsAt = Callable[[Array], tuple[Array, Array, Array]]


@dataclass(frozen=True, eq=False)
class LooseSwing:
    """Swing of K ends over scene time.

    Attributes:
        kinds: Kinds of the ends.
        ends_at: Returns where the ends are without swing.
    """

    kinds: Sequence[int]
    ends_at: EndsAt
    _kept: dict[int, tuple[Array, Array, Array]] = field(init=False, repr=False, default_factory=dict)

    @cached_property
    def _rest(self) -> Rated:
        return swing_at_rest(len(self.kinds))

    def at(self, seconds: float) -> Rated:
        """Swing at a scene time. A cubic curve connects the samples around the time, with their slopes."""
        place = seconds / _STEP
        number = math.floor(place + 1e-9)
        t = place - number
        p = self._swings(number - 1)
        slopes = (p[2:] - p[:-2]) / 2
        a, b, c = p[1], slopes[0], 3 * (p[2] - p[1]) - 2 * slopes[0] - slopes[1]
        d = 2 * (p[1] - p[2]) + slopes[0] + slopes[1]
        offsets, rates = a + t * (b + t * (c + t * d)), (b + t * (2 * c + 3 * t * d)) / _STEP
        return replace(self._rest, values=offsets, rates=rates)

    def add(self, poses: JointPoses, seconds: float) -> JointPoses:
        """Add the joints that carry the swing to poses (N = 1) of a motion at a scene time."""
        swing, names = self.at(seconds), swing_joints(len(self.kinds))
        positions, linear = poses.at_first_joint(len(names))
        positions[1:] += swing.values
        linear[1:] += swing.rates
        identity = np.tile([0.0, 0.0, 0.0, 1.0], (len(names), 1))
        return poses.with_joints(names, identity, np.zeros_like(linear), positions, linear)

    def _swings(self, first: int) -> Array:
        """Swing (4, K, 3) at four samples from number ``first`` on."""
        uppers, lowers, outwards = self._samples(first - _TAPS, first + 4)
        steps = np.diff(lowers, axis=0)
        steps[np.linalg.norm(steps, axis=-1) > _FASTEST * _STEP] = 0.0  # jumps of the motion
        paths = np.concatenate([np.zeros_like(lowers[:1]), np.cumsum(steps, axis=0)])
        swings = np.empty((4, *lowers.shape[1:]))
        for kind, spring in _SPRINGS.items():
            own = [number for number, other in enumerate(self.kinds) if other == kind]
            if not own:
                continue
            weights = spring.response()[:, None, None]
            for number in range(4):
                now = number + _TAPS
                before = paths[number:now, own][::-1]
                raw = (weights * (before - paths[now, own])).sum(axis=0)
                hanging = lowers[now, own] - uppers[now, own]
                swings[number, own] = _limited(raw, hanging, outwards[now, own], spring.largest)
        return swings

    def _samples(self, first: int, last: int) -> tuple[Array, Array, Array]:
        """Ends at the samples from number ``first`` to ``last``; ``last`` itself is left out."""
        start = first // _BLOCK
        blocks = [self._block(number) for number in range(start, (last - 1) // _BLOCK + 1)]
        some = slice(first - start * _BLOCK, last - start * _BLOCK)
        uppers, lowers, outwards = zip(*blocks, strict=True)
        return np.concatenate(uppers)[some], np.concatenate(lowers)[some], np.concatenate(outwards)[some]

    def _block(self, number: int) -> tuple[Array, Array, Array]:
        found = self._kept.pop(number, None)
        if found is None:
            numbers = np.arange(number * _BLOCK, (number + 1) * _BLOCK)
            found = self.ends_at(_STEP * numbers.astype(float))
        self._kept[number] = found  # the last one in the dictionary is the one with the latest use
        while len(self._kept) > _MOST_BLOCKS:
            del self._kept[next(iter(self._kept))]
        return found


def _limited(swing: Array, hanging: Array, outwards: Array, largest: float) -> Array:
    """Limit a swing (K, 3), so that each part keeps its length and stays outside the body.

    Args:
        swing: Swing of the spring, without limits, (K, 3).
        hanging: Vectors from the upper ends to the lower ends, (K, 3).
        outwards: Directions away from the body, (K, 3).
        largest: Largest swing as a share of the length.
    """
    length = np.linalg.norm(hanging, axis=1, keepdims=True)
    most = np.maximum(largest * length, 1e-6)
    swing = swing / np.sqrt(1 + (np.linalg.norm(swing, axis=1, keepdims=True) / most) ** 2)
    inwards = -(swing * outwards).sum(axis=1, keepdims=True)
    swing = swing + np.maximum(inwards - _INWARDS, 0.0) * outwards
    turned = hanging + swing
    turned *= length / np.maximum(np.linalg.norm(turned, axis=1, keepdims=True), 1e-9)
    return np.asarray(turned - hanging)


def swing_joints(count: int) -> tuple[str, ...]:
    """Names of the joints that carry the swing of some ends: first the origin of the offsets, then the
    ends."""
    return (f"{LOOSE_JOINT}origin", *(f"{LOOSE_JOINT}{number}" for number in range(count))) if count else ()


def check_swing(poses: JointPoses, names: Sequence[str], count: int) -> None:
    """Raise MotionError unless joints of a pose (N = 1) carry the swing of a human.

    Args:
        poses: Joints of a message.
        names: Names of joints that begin with :data:`LOOSE_JOINT`.
        count: Number of loose ends of the human.
    """
    expected = swing_joints(count)
    if set(names) != set(expected):
        listed = f"{expected[0]} and {expected[1]} to {expected[-1]}" if count else "none"
        raise MotionError(f"{len(names)} joints of loose cloth and hair; this body needs {listed}")
    numbers = [poses.names.index(name) for name in expected]
    offsets = poses.positions[0, numbers[1:]] - poses.positions[0, numbers[0]]
    if (np.linalg.norm(offsets, axis=1) > _LARGEST).any():
        raise MotionError(f"loose cloth is more than {_LARGEST:g} m away from where it hangs: a bad frame")


@dataclass(frozen=True, eq=False)
class ClothLayer(PoseLayer):
    """Swings the lower ends of loose cloth and hair. Its settings are the kinds of the ends."""

    name: ClassVar[str] = "cloth"
    stage: ClassVar[PoseStage] = PoseStage.CLOTH
    topic: ClassVar[str] = "swing"
    settings: Sequence[int] = ()

    @classmethod
    def of(cls, human: Human) -> ClothLayer:
        return cls(() if human.loose is None else human.loose.kinds.tolist())

    @property
    def rest(self) -> Rated | None:
        return swing_at_rest(len(self.settings)) if self.settings else None

    def encode(self, poses: JointPoses, seconds: float, human: Actor) -> JointPoses:
        if not self.settings or human.human.loose is None:
            return poses
        swing: LooseSwing | None = human.memory.get(self.name)
        if swing is None:

            def ends(times: Array) -> tuple[Array, Array, Array]:
                return human.human.loose_ends(human.bones_at(times))

            swing = human.memory[self.name] = LooseSwing(self.settings, ends)
        return swing.add(poses, seconds)

    def carries(self, joint: str) -> bool:
        return joint.startswith(LOOSE_JOINT)

    def sent(self, poses: JointPoses, human: Actor) -> tuple[str, ...]:
        names = super().sent(poses, human)
        if not names:
            return ()
        check_swing(poses, names, len(self.settings))
        return swing_joints(len(self.settings))

    def before_fit(self, body: BodyPoses, own: JointPoses) -> Array:
        return own.positions[:, 1:] - own.positions[:, :1]

    def after_fit(self, body: BodyPoses, data: Array) -> None:
        body.values[self.topic] = swing_at_rest(data.shape[1]), data


LAYER = ClothLayer
