"""Key ``face`` of the humans of a scene file. The module imports no meshes."""

from __future__ import annotations

from typing import Annotated, ClassVar

from pydantic import BeforeValidator, Field, field_validator

from humansim_ros.errors import MotionError
from humansim_ros.files.yaml import FileName, Share, ShortSection, alone_in_list, one_or_more
from humansim_ros.motion.body import ExpressionName, face_weights
from humansim_ros.scene.config.camera_config import BoundedVector3

#: Gaze without a target: the eyes look ahead.
AHEAD = "ahead"


class FaceKeyConfig(ShortSection):
    """What a face does from a time on; what a key does not name goes on."""

    short_key: ClassVar[str] = "expression"

    time: float = Field(default=0.0, ge=0, le=1e6, description="when it begins, seconds of the scene")
    expression: ExpressionName | None = Field(default=None, description="name of the expression")
    strength: Share = Field(default=1.0, description="strength of the expression")
    actions: dict[str, float] | None = Field(
        default=None,
        description="weights from 0 to 1 of actions in ARKit's names, beside the expression; {} ends them",
    )
    gaze: BoundedVector3 | str | None = Field(
        default=None,
        description="what the eyes look at: a point in map, the name of a human or a camera, or ahead",
    )
    speak: float | None = Field(default=None, gt=0, le=3600, description="seconds for which it speaks")
    blend: float = Field(
        default=0.3, ge=0, le=1e4, description="duration of the change of expression and actions, seconds"
    )

    @field_validator("actions")
    @classmethod
    def _known_actions(cls, actions: dict[str, float] | None) -> dict[str, float] | None:
        try:
            face_weights(actions or {})
        except MotionError as error:
            raise ValueError(error.message) from None
        return actions


class FaceConfig(ShortSection):
    """Face of a human over the time of the scene."""

    short_key: ClassVar[str] = "keys"

    alive: bool = Field(default=False, description="blink, and let the eyes glance around")
    seed: int = Field(default=1, ge=0, description="the same seed gives a human the same life and speech")
    head: float = Field(
        default=0.0,
        ge=0,
        le=1,
        description="how far the head turns with a gaze: 0 not at all, 1 as people turn it",
    )
    mouth: bool = Field(default=False, description="show teeth and tongue in an open mouth")
    keys: Annotated[tuple[FaceKeyConfig, ...], BeforeValidator(alone_in_list)] = Field(
        default=(),
        max_length=1000,
        description="expressions, actions, gaze and speech over time",
        json_schema_extra=one_or_more,
    )
    file: FileName | None = Field(
        default=None,
        description="recording of a face, from time 0 on, or with the motion of the same file: the CSV file "
        "of Live Link Face, or the animated face of a .glb, .gltf, .vrm or .vrma file (take.glb#Name)",
    )


def living_face(alive: bool, seed: int) -> FaceConfig | None:
    """Face of a random human: alive, or stiff."""
    return FaceConfig(alive=True, seed=seed) if alive else None
