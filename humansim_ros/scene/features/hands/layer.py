"""Layer of hand poses."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import ClassVar

from humansim_ros.errors import MotionError, in_section, warn_about
from humansim_ros.motion.body import JointPoses
from humansim_ros.motion.pose import (
    BUILT_IN_HANDS,
    HAND_JOINT,
    HAND_JOINTS,
    HandKey,
    HandKeys,
    PoseStage,
    Reaches,
)
from humansim_ros.scene.config.config import LIVE, MotionConfig
from humansim_ros.scene.core.actor import Actor
from humansim_ros.scene.core.layers import BodyPoses, PoseLayer

_NOTHING_MOVES = "moves nothing: the body has no fingers, or the motion moves them all"


@dataclass(frozen=True, eq=False)
class HandLayer(PoseLayer):
    """Appends one joint for each finger bone that a hand pose moves."""

    name: ClassVar[str] = "hands"
    stage: ClassVar[PoseStage] = PoseStage.FINGERS
    keys: ClassVar[frozenset[str]] = frozenset({"hands"})
    settings: HandKeys | None = None

    def fitted(self, human: Actor, config: MotionConfig) -> HandLayer:
        with in_section("hands"):
            hands = HandKeys.of(_keys(config), human.human.skeleton, human.motion, human.retargeter.match)
        if config.hands and hands is None:
            warn_about(human.name, f"'hands' {_NOTHING_MOVES}")
        return replace(self, settings=hands)

    def changed(self, human: Actor, config: MotionConfig) -> HandLayer:
        with in_section("hands"):
            if config.hands and config.file == LIVE:
                raise MotionError("the sender of live joints poses the hands, too (docs/keyframes.md)")
            motion = human.motion if self.settings is None else self.settings.motion
            hands = HandKeys.of(_keys(config), human.human.skeleton, motion, human.retargeter.match)
            if config.hands and hands is None:
                raise MotionError(_NOTHING_MOVES)
        return replace(self, settings=hands)

    def joined(self, human: Actor) -> HandLayer:
        reaches: Reaches | None = human.settings("reach")
        poses = () if reaches is None else reaches.poses
        hands = self.settings
        if not poses:
            bare = hands is None or not hands.reaching
            return self if bare else replace(self, settings=hands and replace(hands, reaching=()))
        if hands is None:
            keys = [HandKey("relaxed", human.motion.start, each.side) for each in poses]
            hands = HandKeys.of(keys, human.human.skeleton, human.motion, human.retargeter.match)
        if hands is None:
            raise MotionError(_NOTHING_MOVES, key="pose")
        return replace(self, settings=hands.reaching_for(poses))

    def encode(self, poses: JointPoses, seconds: float, human: Actor) -> JointPoses:
        if self.settings is None:
            return poses
        return self.settings.add(poses, seconds + human.offset, human.ahead, human.offset)

    def carries(self, joint: str) -> bool:
        return joint in HAND_JOINTS

    def before_fit(self, body: BodyPoses, own: JointPoses) -> None:
        bones = (name.removeprefix(HAND_JOINT) for name in own.names)
        body.turns = dict(zip(bones, own.rotations.swapaxes(0, 1), strict=True))


def _keys(config: MotionConfig) -> Sequence[HandKey]:
    """Keys of the hands of a motion: of the scene, or of a built-in motion that plays from its start."""
    if config.hands is not None:
        return [key.key for key in config.hands]
    whole = config.start == 0 and config.end is None
    return BUILT_IN_HANDS.get(config.file, ()) if whole else ()


LAYER = HandLayer
