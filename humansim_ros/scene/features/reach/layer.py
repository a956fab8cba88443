"""Layer of hands that reach."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import ClassVar

from humansim_ros.motion.body import JointPoses
from humansim_ros.motion.pose import PoseStage, Reaches
from humansim_ros.scene.config.config import MotionConfig
from humansim_ros.scene.core.layers import Owner, PoseLayer
from humansim_ros.types import Array


@dataclass(frozen=True, eq=False)
class ReachLayer(PoseLayer):
    """Bends the arms so that the hands reach their goals."""

    name: ClassVar[str] = "reach"
    stage: ClassVar[PoseStage] = PoseStage.ARMS
    settings: Reaches | None = None

    def fitted(self, human: Owner, config: MotionConfig) -> ReachLayer:
        if self.settings is None:
            return self
        reaches = replace(self.settings, motion=human.motion.motion, retargeter=human.retargeter)
        return replace(self, settings=reaches)

    def encode(self, poses: JointPoses, seconds: float, human: Owner) -> JointPoses:
        if self.settings is None:
            return poses
        return self.settings.apply_at(poses, seconds, human.asking(), human.space_at)

    def bend(self, poses: JointPoses, times: Array, human: Owner) -> JointPoses:
        if self.settings is None:
            return poses
        return self.settings.apply(poses, times, human.asking(), human.space_at(times))


LAYER = ReachLayer
