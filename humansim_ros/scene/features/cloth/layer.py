"""Layer of loose cloth and hair."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import ClassVar

from humansim_ros.motion.body import JointPoses, Rated, swing_at_rest
from humansim_ros.motion.pose import PoseStage
from humansim_ros.people.humans import Human
from humansim_ros.scene.core.layers import BodyPoses, Owner, PoseLayer
from humansim_ros.scene.features.cloth.swing import LOOSE_JOINT, LooseSwing, check_swing, swing_joints
from humansim_ros.types import Array


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

    def encode(self, poses: JointPoses, seconds: float, human: Owner) -> JointPoses:
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

    def sent(self, poses: JointPoses, human: Owner) -> tuple[str, ...]:
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
