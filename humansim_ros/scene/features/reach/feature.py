"""Hands that reach for points, objects, joints of others, and others' hands."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from graphlib import CycleError, TopologicalSorter
from typing import ClassVar, Literal

import numpy as np

from humansim_ros.errors import SceneError, in_section, unknown
from humansim_ros.geometry import quaternion_to_matrix, rotate, unit_vectors
from humansim_ros.motion.body import JointPoses
from humansim_ros.motion.pose import (
    BODY,
    PALM,
    WITHOUT_REACH,
    GoalAt,
    HandGoal,
    PoseStage,
    Reach,
    Reaches,
    ReachingHand,
    in_round,
)
from humansim_ros.scene.config.config import LIVE, HumanConfig, MotionConfig
from humansim_ros.scene.core.actor import Actor
from humansim_ros.scene.core.features import Draft
from humansim_ros.scene.core.findings import CheckedFeature, Finding, SceneSamples, numbers
from humansim_ros.scene.core.layers import PoseLayer
from humansim_ros.scene.core.objects import SceneObject
from humansim_ros.scene.core.world import World
from humansim_ros.scene.features.reach import ReachConfig
from humansim_ros.types import Array


@dataclass(frozen=True, eq=False)
class ReachLayer(PoseLayer):
    """Bends the arms so that the hands reach their goals."""

    name: ClassVar[str] = "reach"
    stage: ClassVar[PoseStage] = PoseStage.ARMS
    settings: Reaches | None = None

    def fitted(self, human: Actor, config: MotionConfig) -> ReachLayer:
        if self.settings is None:
            return self
        reaches = replace(self.settings, motion=human.motion.motion, retargeter=human.retargeter)
        return replace(self, settings=reaches)

    def encode(self, poses: JointPoses, seconds: float, human: Actor) -> JointPoses:
        if self.settings is None:
            return poses
        return self.settings.apply_at(poses, seconds, human.asking(), human.space_at)

    def bend(self, poses: JointPoses, times: Array, human: Actor) -> JointPoses:
        if self.settings is None:
            return poses
        return self.settings.apply(poses, times, human.asking(), human.space_at(times))


LAYER = ReachLayer


#: Metres between a joint and the skin that a palm touches there.
_FLESH = 0.055
#: Two people shake hands this share of the length of an arm below their shoulders. Held hands hang at the
#: larger one.
_SHAKES, _HANGS = 0.5, 0.9
#: Share of its length to which an arm is stretched for the hand of somebody else.
_STRETCHED = 0.93
#: Up and down movements per second of a handshake.
_SHAKES_PER_SECOND = 2.2
_UP = np.array([0.0, 0.0, 1.0])


@dataclass(frozen=True)
class PointGoal:
    """A point in ``map``, with directions in ``map``."""

    point: tuple[float, float, float]
    palm: tuple[float, float, float] | None
    fingers: tuple[float, float, float] | None

    def __call__(self, times: Array, others: World) -> HandGoal:
        """The goal at scene times (N,)."""
        place, palm, fingers = (
            None if each is None else np.broadcast_to(np.array(each, dtype=float), (len(times), 3))
            for each in (self.point, self.palm, self.fingers)
        )
        assert place is not None
        return HandGoal(place, palm, fingers)


@dataclass(frozen=True, eq=False)
class ObjectGoal:
    """A point of an object, with directions, all in the axes of the object: metres from its origin.

    Attributes:
        own: Point and directions.
        name: Name of the object.
        size: Size of the object without keyframes: what scales it moves the point.
    """

    own: PointGoal
    name: str
    size: Array

    def __call__(self, times: Array, others: World) -> HandGoal:
        """The goal at scene times (N,)."""
        poses = [others.object_pose(self.name, time) for time in times.tolist()]
        turns = quaternion_to_matrix(np.array([pose.rotation for pose in poses]))
        scales = np.array([pose.size for pose in poses]) / self.size
        own = self.own(times, others)
        place = np.array([pose.position for pose in poses]) + rotate(turns, scales * own.place)
        palm, fingers = (None if each is None else rotate(turns, each) for each in (own.palm, own.fingers))
        return HandGoal(place, palm, fingers)


@dataclass(frozen=True, eq=False)
class JointGoal:
    """The skin at a joint of another human, on the side of the arm that reaches for it.

    Attributes:
        name: Who reaches.
        side: The hand.
        other: The other human.
        joint: Joint of the other human.
        own: Directions of the hand.
    """

    name: str
    side: str
    other: str
    joint: str
    own: PointGoal

    def __call__(self, times: Array, others: World) -> HandGoal:
        """The goal at scene times (N,)."""
        index = others.skeleton(self.other).joint_names.index(self.joint)
        middle = others.joints(self.other, times, BODY)[:, index, :3, 3]
        own = self.own(times, others)
        if own.palm is not None:
            return replace(own, place=middle - _FLESH * unit_vectors(own.palm))
        towards = unit_vectors(middle - _ArmAt.of(others, self.name, self.side, times).shoulder)
        return replace(own, place=middle - _FLESH * towards)


@dataclass(frozen=True)
class _ArmAt:
    """A shoulder (N, 3), the way that its body faces (N, 3), and metres from the shoulder to the palm."""

    shoulder: Array
    ahead: Array
    length: float

    @classmethod
    def of(cls, others: World, name: str, side: str, times: Array) -> _ArmAt:
        skeleton, joints = others.skeleton(name), others.joints(name, times, WITHOUT_REACH)
        left, right = (joints[:, skeleton.bone(f"{each}_shoulder"), :3, 3] for each in "lr")
        upper, lower, hand = (skeleton.bone(f"{side[0]}_{part}") for part in ("shoulder", "elbow", "wrist"))
        lengths = skeleton.lengths
        length = float(lengths[upper] + lengths[lower] + PALM * lengths[hand])
        length = others.size(name, float(times[0])) * length
        ahead = unit_vectors(np.cross(left - right, _UP))
        return cls(left if side == "left" else right, ahead, length)


@dataclass(frozen=True, eq=False)
class MeetingGoal:
    """The hand of another human who reaches for this human: both palms meet between both shoulders.

    The place follows from both arms in their motions, so that it is the same for both humans. Two right hands
    shake with the thumbs up, as two left hands do. A right and a left hand hold each other: they hang if the
    humans face the same way. If the humans face each other, one hand is on the other.

    Attributes:
        hands: This human and its hand, then the other one and its hand.
        holds: Scene times from and to which the hands hold, seconds.
        repeat: Seconds after which the hands meet again; infinite for once.
        shake: Metres by which the hands go up and down; 0 for hands that hold still.
    """

    hands: tuple[tuple[str, str], tuple[str, str]]
    holds: tuple[float, float]
    repeat: float
    shake: float

    def __call__(self, times: Array, others: World) -> HandGoal:
        """The goal at scene times (N,)."""
        (own_side, other_side) = (side for _, side in self.hands)
        # in the order of their names, so that both find the same bits
        arms = {hand: _ArmAt.of(others, *hand, times) for hand in sorted(self.hands)}
        own, other = (arms[hand] for hand in self.hands)
        first, second = arms.values()
        line = second.shoulder - first.shoulder
        place = first.shoulder + first.length / (first.length + second.length) * line
        away = unit_vectors(other.shoulder - own.shoulder)
        beside = (first.ahead * second.ahead).sum(axis=-1) > 0
        same = own_side == other_side
        drop = np.where(beside & (not same), _HANGS, _SHAKES)
        place[:, 2] = self._height(place, drop, first, second)
        if self.shake:
            place[:, 2] += self.shake * self._shaking(times)
        if same:
            # the palm of a right hand faces left
            palm = (1.0 if own_side == "right" else -1.0) * unit_vectors(np.cross(_UP, away))
            return HandGoal(place, palm, away)
        ahead = unit_vectors(first.ahead + second.ahead)
        right = 1.0 if own_side == "right" else -1.0
        level = unit_vectors(away * (1, 1, 0))
        palm = np.where(beside[:, None], -right * ahead, right * _UP)
        return HandGoal(place, palm, np.where(beside[:, None], -_UP, level))

    def _height(self, place: Array, drop: Array, *arms: _ArmAt) -> Array:
        """Height (N,) of the place: below both shoulders as far as both arms reach."""
        heights, lowest, highest = [], [], []
        for arm in arms:
            shoulder = arm.shoulder[:, 2]
            across = np.linalg.norm((place - arm.shoulder)[:, :2], axis=-1)
            most = np.sqrt(np.maximum((_STRETCHED * arm.length) ** 2 - across**2, 0.0))
            heights.append(shoulder - drop * arm.length)
            lowest.append(shoulder - most)
            highest.append(shoulder + most)
        height = np.maximum(np.mean(heights, axis=0), np.max(lowest, axis=0))
        return np.asarray(np.minimum(height, np.min(highest, axis=0)))

    def _shaking(self, times: Array) -> Array:
        """Height (N,) of the hands over their middle height, as a share."""
        start, end = self.holds
        count = max(1, round(_SHAKES_PER_SECOND * min(end - start, 2.0)))
        own = in_round(times, start, self.repeat)
        share = np.clip((own - start) * _SHAKES_PER_SECOND / count, 0.0, 1.0)
        # it starts and ends slowly
        return np.asarray(np.sin(np.pi * share) ** 2 * np.sin(2 * np.pi * count * share))


#: Metres to which a palm must come, times at which it is measured, and the longest contact that is measured.
_TOUCHES, _MEASURED, _LONGEST = 0.005, 40, 60.0


class ReachingHands(CheckedFeature):
    """The key ``reach`` of humans."""

    def furnish(self, draft: Draft) -> None:
        """Let hands reach for what the sections say. Raises HumansimError, which names the key, such as of an
        unknown object."""
        configs, objects = draft.config.humans, draft.objects
        makes = _Goals(draft.actors, configs, objects)
        for name, config in configs.items():
            if not config.reach:
                continue
            with in_section(f"humans.{name}.reach"):
                _refuse_overlaps(config.reach)
                reaches = []
                for number, each in enumerate(config.reach):
                    with in_section(str(number)):
                        goal = makes.goal(name, each)
                    times = each.start, each.until, each.blend
                    repeat = each.repeat or math.inf
                    reaches.append(Reach(each.hand, *times, goal, repeat, f"reach.{number}.to"))
                both = zip(reaches, config.reach, strict=True)
                poses = [ReachingHand(each.side, own.pose, each.shares) for each, own in both if own.pose]
                draft.reach(name, reaches, poses)
        makes.refuse_circles()

    def check(self, samples: SceneSamples) -> Iterator[Finding]:
        for name in samples.joints:
            actor, config = samples.scene.actors[name], samples.scene.config.humans[name]
            all_reaches: Reaches | None = actor.settings("reach")
            if all_reaches is None or actor.others is None:
                continue
            targets = {f"reach.{number}.to": each.to for number, each in enumerate(config.reach)}
            for reach in all_reaches.reaches:
                first = max(reach.start, 0.0) + reach.blend
                times = np.linspace(first, min(reach.end - reach.blend, first + _LONGEST), _MEASURED)
                places = reach.goal(times, actor.others).place
                lacks = np.linalg.norm(actor.palms_at(reach.side, times) - places, axis=-1)
                if lacks.max() < _TOUCHES:
                    continue
                worst, never = int(np.argmax(lacks)), bool(lacks.min() >= _TOUCHES)
                target = targets.get(reach.key, reach.key)
                target = target if isinstance(target, str) else numbers(target)
                text = (
                    f"the {reach.side} hand of {name} does not reach {target}"
                    f"{' at any time' if never else ''}: it lacks {lacks[worst]:.2g} m at "
                    f"{times[worst]:.1f} s; move the human nearer (motion.position), or the place that it "
                    "touches (at)"
                )
                yield Finding("error" if never else "warning", f"humans.{name}.{reach.key}", text)


def _refuse_overlaps(reaches: tuple[ReachConfig, ...]) -> None:
    """Raise SceneError for two reaches of one hand at one time."""
    for second, other in enumerate(reaches):
        for first, one in enumerate(reaches[:second]):
            if one.hand != other.hand:
                continue
            if one.repeat != other.repeat:
                raise SceneError(
                    f"reaches of the {one.hand} hand must have the same repeat, as {first} and {second}",
                    key=f"{second}.repeat",
                )
            if one.repeat is None:
                apart = one.until <= other.start or other.until <= one.start
            else:  # the other one begins some time after this one, and ends before its next round
                later = (other.start - one.start) % one.repeat
                apart = one.until - one.start <= later <= one.repeat - (other.until - other.start)
            if not apart:
                raise SceneError(
                    f"two reaches of the {one.hand} hand overlap, {first} ({one.span}) and {second} "
                    f"({other.span}): let one end before the other starts",
                    key=str(second),
                )


@dataclass(frozen=True)
class _Goals:
    """Makes the goals of reaches. It needs the humans and objects by name, and the sections of the humans."""

    people: Mapping[str, Actor]
    configs: Mapping[str, HumanConfig]
    objects: Mapping[str, SceneObject]

    def goal(self, name: str, config: ReachConfig) -> GoalAt:
        """Goal of a reach of a human."""
        target = config.to
        if not isinstance(target, str):
            if config.at is not None:
                raise SceneError("a point needs no place on it: remove it, or name an object", key="at")
            return PointGoal(target, config.palm, config.fingers)
        with in_section("to"):
            kind = self._kind(name, target)
        if kind == "object":
            return self._on_object(name, target, config)
        if isinstance(config.at, tuple):
            raise SceneError(f"{target} is a human: give the name of a joint, such as l_shoulder", key="at")
        if config.at is None:
            return self._meeting(name, target, config)
        known = self.people[target].human.skeleton.joint_names
        if config.at not in known:
            raise SceneError(unknown("joint", config.at, known, target), key="at")
        own = PointGoal((0.0, 0.0, 0.0), config.palm, config.fingers)
        return JointGoal(name, config.hand, target, config.at, own)

    def _kind(self, name: str, target: str) -> Literal["human", "object"]:
        if target == name:
            raise SceneError("nobody reaches for the own hand: name another human, an object or a point")
        if target in self.people and target in self.objects:
            raise SceneError(f"{target} is a human and an object: give one of them another name")
        if target in self.objects:
            return "object"
        if target not in self.people:
            known = [*(each for each in self.people if each != name), *self.objects]
            raise SceneError(unknown("human and no object", target, known))
        if self.configs[target].motion.file == LIVE:
            raise SceneError(f"another node moves {target}, so that its place is not known: give a point")
        return "human"

    def _on_object(self, name: str, target: str, config: ReachConfig) -> ObjectGoal:
        if isinstance(config.at, str):
            raise SceneError(f"{target} is an object: give a point of it, such as [0, 0, 1]", key="at")
        item = self.objects[target]
        own = PointGoal(config.at or (0.0, 0.0, 0.0), config.palm, config.fingers)
        return ObjectGoal(own, target, item.initial_pose.size)

    def _meeting(self, name: str, target: str, config: ReachConfig) -> MeetingGoal:
        partners = [
            each
            for each in self.configs[target].reach
            if each.to == name and each.at is None and each.start < config.until and config.start < each.until
        ]
        if len(partners) != 1:
            what = "does not reach" if not partners else "reaches more than once"
            raise SceneError(
                f"{target} {what} for {name} from {config.span}: give {target} one reach to {name} at the "
                "same time, or say which joint is touched (at: l_shoulder)",
                key="to",
            )
        other = partners[0]
        if config.palm is not None or config.fingers is not None:
            key = "palm" if config.palm is not None else "fingers"
            raise SceneError("hands that meet turn to each other: remove it", key=key)
        start = max(config.start + config.blend, other.start + other.blend)
        end = min(config.until - config.blend, other.until - other.blend)
        if end < start or config.repeat != other.repeat:
            raise SceneError(
                f"{name} ({config.span}) and {target} ({other.span}) are not there together: give both the "
                "same start, end, blend and repeat",
                key="to",
            )
        shake = min(config.shake, other.shake) if config.hand == other.hand else 0.0
        hands = ((name, config.hand), (target, other.hand))
        return MeetingGoal(hands, (start, end), config.repeat or math.inf, shake)

    def refuse_circles(self) -> None:
        """Raise SceneError for humans who reach for each other's joints in a circle."""
        follows = {
            name: {each.to for each in config.reach if isinstance(each.to, str) and isinstance(each.at, str)}
            for name, config in self.configs.items()
        }
        try:
            TopologicalSorter(follows).prepare()
        except CycleError as error:
            name = next(name for name in follows if name in error.args[1])
            raise SceneError(
                f"{name} reaches for a joint of somebody who reaches for a joint of {name}: let both reach "
                "for each other without 'at', or give one of them a point",
                key=f"humans.{name}.reach",
            ) from None


FEATURE = ReachingHands()
