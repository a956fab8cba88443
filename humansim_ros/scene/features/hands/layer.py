"""Layer of hand poses."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

from humansim_ros.motion.body import JointPoses
from humansim_ros.motion.pose import HAND_JOINT, HAND_JOINTS, HandKeys, PoseStage
from humansim_ros.scene.core.layers import BodyPoses, Owner, PoseLayer


@dataclass(frozen=True, eq=False)
class HandLayer(PoseLayer):
    """Appends one joint for each finger bone that a hand pose moves."""

    name: ClassVar[str] = "hands"
    stage: ClassVar[PoseStage] = PoseStage.FINGERS
    settings: HandKeys | None = None

    def encode(self, poses: JointPoses, seconds: float, human: Owner) -> JointPoses:
        if self.settings is None:
            return poses
        return self.settings.add(poses, seconds + human.offset, human.ahead, human.offset)

    def carries(self, joint: str) -> bool:
        return joint in HAND_JOINTS

    def before_fit(self, body: BodyPoses, own: JointPoses) -> None:
        bones = (name.removeprefix(HAND_JOINT) for name in own.names)
        body.turns = dict(zip(bones, own.rotations.swapaxes(0, 1), strict=True))


LAYER = HandLayer
