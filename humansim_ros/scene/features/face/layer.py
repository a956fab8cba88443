"""Layer of faces: head, eyes, jaw and skin."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from humansim_ros.errors import MotionError
from humansim_ros.motion.body import (
    FACE_AT_REST,
    Eyes,
    Jaw,
    JointPoses,
    Rated,
    looked_angles,
    with_looks,
    within_limits,
)
from humansim_ros.motion.pose import PoseStage
from humansim_ros.people.humans import Human
from humansim_ros.scene.core.layers import BodyPoses, Owner, PoseLayer
from humansim_ros.scene.features.face.tracks import FACE_JOINT, Face, FacePoses, carried_face, check_face
from humansim_ros.types import Array


@dataclass(frozen=True, eq=False)
class FaceLayer(PoseLayer):
    """Turns head and eyes to what they look at, opens the jaw, and moves the skin of the face.

    Attributes:
        eyes: The eyes; None for a body without eyes.
        jaw: The jaw, which moves with the face; None for one that does not.
    """

    name: ClassVar[str] = "face"
    stage: ClassVar[PoseStage] = PoseStage.HEAD  # to FACE
    topic: ClassVar[str] = "face"
    settings: Face | None = None
    eyes: Eyes | None = None
    jaw: Jaw | None = None

    @classmethod
    def of(cls, human: Human) -> FaceLayer:
        return cls(eyes=Eyes.of(human.skeleton))

    @property
    def rest(self) -> Rated | None:
        return None if self.settings is None else FACE_AT_REST

    def encode(self, poses: JointPoses, seconds: float, human: Owner) -> JointPoses:
        return poses if self.settings is None else self.settings.add(poses, seconds, human)

    def place(self, joints: Array, times: Array, human: Owner) -> Array:
        if self.settings is not None and self.settings.turns_head and self.eyes is not None:
            shares, points = self.settings.head_at(times, human)
            self.eyes.turn_head(joints, points, shares)
        return joints

    def carries(self, joint: str) -> bool:
        return joint.startswith(FACE_JOINT)

    def sent(self, poses: JointPoses, human: Owner) -> tuple[str, ...]:
        names = super().sent(poses, human)
        if names:
            if self.settings is None:
                raise MotionError(f"the scene gives {human.name} no face: add the key face: {{}}")
            check_face(poses)
        return names

    def before_fit(self, body: BodyPoses, own: JointPoses) -> FacePoses:
        return carried_face(own)

    def after_fit(self, body: BodyPoses, data: FacePoses) -> None:
        eyes, weights = self.eyes, data.weights
        if eyes is not None:
            if data.head_shares.any():
                eyes.turn_head(body.bones, data.head_points, data.head_shares)
            angles = looked_angles(weights)
            if data.shares.any():
                angles += data.shares[:, None, None] * eyes.angles_to(body.bones, data.points)
            angles = within_limits(angles)
            eyes.turn(body.bones, angles)
            weights = with_looks(weights, angles)
        body.joints = body.bones if self.jaw is None else self.jaw.open(body.bones, weights, body.sizes)
        body.values[self.topic] = FACE_AT_REST, weights

    def skinned(self, human: Human, values: Array) -> Array:
        return human.of_actions(values)

    def moved_bone(self, rated: Rated) -> int:
        if self.jaw is None or not self.jaw.moves(np.stack([rated.values, rated.rates])):
            return -1
        return self.jaw.bone

    def undone(self, bone: Array, values: Array, size: float) -> Array:
        assert self.jaw is not None
        return self.jaw.closed(bone, values, size)


LAYER = FaceLayer
