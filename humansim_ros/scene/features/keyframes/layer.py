"""Layer of keyframes."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

from humansim_ros.motion.body import JointPoses
from humansim_ros.motion.files import SPACE_JOINTS, KeyframeSpace, KeyframeTrack, undo_keyframes
from humansim_ros.motion.pose import PoseStage
from humansim_ros.scene.core.layers import BodyPoses, Owner, PoseLayer
from humansim_ros.types import Array


@dataclass(frozen=True, eq=False)
class KeyframeLayer(PoseLayer):
    """Moves, turns and scales the space of a motion. It is undone before the fit, and done again after it."""

    name: ClassVar[str] = "keyframes"
    stage: ClassVar[PoseStage] = PoseStage.SPACE
    settings: KeyframeTrack | None = None

    def encode(self, poses: JointPoses, seconds: float, human: Owner) -> JointPoses:
        return poses if self.settings is None else self.settings.apply(poses, seconds)

    def place(self, joints: Array, times: Array, human: Owner) -> Array:
        space = human.space_at(times)
        return joints if space is None else space.to_map(joints)

    def carries(self, joint: str) -> bool:
        return joint in SPACE_JOINTS

    def sent(self, poses: JointPoses, human: Owner) -> tuple[str, ...]:
        return SPACE_JOINTS if set(SPACE_JOINTS) <= set(poses.names) else ()

    def take(self, poses: JointPoses) -> tuple[JointPoses, JointPoses]:
        # one of these joints alone is a joint of the motion
        return super().take(poses) if poses.names[-2:] == SPACE_JOINTS else (poses, poses.first(0))

    def before_fit(self, body: BodyPoses, own: JointPoses) -> KeyframeSpace:
        body.poses, space = undo_keyframes(body.poses, own)
        return space

    def after_fit(self, body: BodyPoses, data: KeyframeSpace) -> None:
        body.joints = body.bones = data.to_map(body.bones)
        body.sizes = data.size


LAYER = KeyframeLayer
