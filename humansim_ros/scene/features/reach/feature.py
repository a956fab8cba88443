"""Hands that reach for points, objects, joints of others, and others' hands."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Literal

import numpy as np

from humansim_ros.errors import SceneError, in_section, some_of, unknown
from humansim_ros.motion.pose import GoalAt, Reach, Reaches, ReachingHand
from humansim_ros.scene.config.config import LIVE, HumanConfig
from humansim_ros.scene.core.actor import Actor
from humansim_ros.scene.core.draft import Draft
from humansim_ros.scene.core.findings import CheckedFeature, Finding, SceneSamples, numbers
from humansim_ros.scene.core.objects import SceneObject
from humansim_ros.scene.features.reach.goals import JointGoal, MeetingGoal, ObjectGoal, PointGoal
from humansim_ros.scene.features.reach.keys import ReachConfig

#: Metres to which a palm must come, times at which it is measured, and the longest contact that is measured.
_TOUCHES, _MEASURED, _LONGEST = 0.005, 40, 60.0


class ReachingHands(CheckedFeature):
    """The key ``reach`` of humans."""

    def furnish(self, draft: Draft) -> None:
        """Let hands reach for what the sections say. Raises HumansimError, which names the key, as of an
        unknown object."""
        configs, objects = draft.config.humans, draft.objects
        makes = _Goals(draft.actors, configs, objects)
        for name, config in configs.items():
            if not config.reach:
                continue
            with in_section(f"humans.{name}.reach"):
                if config.motion.file == LIVE:
                    raise SceneError(f"another node moves {name}, and its hands")
                if held := [item.name for item in objects.values() if item.held_by == name]:
                    raise SceneError(
                        f"{name} holds {some_of(held)} in both hands: they reach for nothing else"
                    )
                _refuse_overlaps(config.reach)
                reaches = []
                for number, each in enumerate(config.reach):
                    with in_section(str(number)):
                        goal = makes.goal(name, each)
                    times = each.start, each.until, each.blend
                    repeat = each.repeat or math.inf
                    reaches.append(Reach(each.hand, *times, goal, repeat, f"reach.{number}.to"))
                poses = [
                    ReachingHand(each.side, own.pose, each.shares)
                    for each, own in zip(reaches, config.reach, strict=True)
                    if own.pose is not None
                ]
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
                first = reach.start + reach.blend
                times = np.linspace(first, min(reach.end - reach.blend, first + _LONGEST), _MEASURED)
                lacks = np.linalg.norm(
                    actor.palms_at(reach.side, times) - reach.goal(times, actor.others).place, axis=-1
                )
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
    """Makes the goals of reaches; from the humans by name, their sections, and the objects by name."""

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
        holds = (
            max(config.start + config.blend, other.start + other.blend),
            min(config.until - config.blend, other.until - other.blend),
        )
        if holds[1] < holds[0] or config.repeat != other.repeat:
            raise SceneError(
                f"{name} ({config.span}) and {target} ({other.span}) are not there together: give both the "
                "same start, end, blend and repeat",
                key="to",
            )
        shake = min(config.shake, other.shake) if config.hand == other.hand else 0.0
        hands = ((name, config.hand), (target, other.hand))
        return MeetingGoal(hands, holds, config.repeat or math.inf, shake)

    def refuse_circles(self) -> None:
        """Raise SceneError for humans who reach for each other's joints all around."""
        follows = {
            name: {each.to for each in config.reach if isinstance(each.to, str) and isinstance(each.at, str)}
            for name, config in self.configs.items()
        }
        for name in follows:
            seen: set[str] = set()
            ways = set(follows[name])
            while ways:
                seen |= ways
                ways = {target for each in ways for target in follows.get(each, ())} - seen
            if name in seen:
                raise SceneError(
                    f"{name} reaches for a joint of somebody who reaches for a joint of {name}: let both "
                    "reach for each other without 'at', or give one of them a point",
                    key=f"humans.{name}.reach",
                )


FEATURE = ReachingHands()
