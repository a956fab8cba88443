"""Layer of contact with the floor."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import ClassVar

import numpy as np

from humansim_ros.motion.pose import ON_SKIN, FootContacts, PoseStage, SkinContact, WorldMotion, skin_on_floor
from humansim_ros.people.humans import Human
from humansim_ros.scene.core.layers import Fitted, PoseLayer
from humansim_ros.types import Array


@dataclass(frozen=True, eq=False)
class FloorLayer(PoseLayer):
    """Keeps standing feet from sliding, and puts the lowest skin on the floor. It corrects the motion."""

    name: ClassVar[str] = "floor"
    stage: ClassVar[PoseStage] = PoseStage.FLOOR

    @classmethod
    def of(cls, human: Human) -> None:
        return None

    @classmethod
    def corrected(cls, motion: WorldMotion, human: Human, fitted: Fitted) -> WorldMotion:
        config = fitted.config
        if config.pin_feet:
            motion = replace(motion, correction=FootContacts.detect(motion, fitted.retargeter))
        if config.floor == "skin" or (config.floor is None and config.file in ON_SKIN):
            placed = motion

            def settle() -> SkinContact:
                return SkinContact.of(placed, fitted.retargeter, _lowest_skin(human))

            shared = config.model_dump_json(exclude={"position", "yaw_deg", "offset", "speed", "hands"})
            settled = fitted.source.once(settle, "floor", id(human.mesh.vertices), shared)
            motion = replace(motion, correction=replace(settled, before=placed.correction))
        return motion


def _lowest_skin(human: Human) -> Callable[[Array], Array]:
    """Function from posed bones (N, B, 4, 4) to the heights (N,) of the lowest skin, metres."""
    vertices = np.asarray(human.mesh.vertices, dtype=float)
    skin = np.flatnonzero(skin_on_floor(human.skeleton, vertices, human.weights))

    def lowest(posed: Array) -> Array:
        return np.array([float(human.pose(bones)[skin, 2].min()) for bones in posed])

    return lowest


LAYER = FloorLayer
